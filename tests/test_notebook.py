"""What shows itself in a notebook: self-contained, bounded, and harmless."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

import rfsg
from rfsg.scene.assets import load_asset

ROOT = Path(__file__).parents[1]


class Seen(HTMLParser):
    """Tags in order, whether they close, and where sources point."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag != "img":
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def shown(thing) -> Seen:
    seen = Seen(thing._repr_html_())
    assert not seen.open
    return seen


def test_scene_result_paths_and_map_show_themselves(small_run):
    found = rfsg.radio_map(small_run.scene, 2.44e9, height=1.0, cell=1.0, quality="draft")
    for thing, picture in ((small_run.scene, 1), (small_run, 1), (found, 1), (small_run.paths, 0)):
        seen = shown(thing)
        assert seen.tags.count("img") == picture
        assert all(source.startswith("data:image/png;base64,") for source in seen.sources)


def test_an_asset_shows_where_it_comes_from():
    asset = load_asset(ROOT / "assets" / "objects" / "cabinet" / "cabinet.usda")
    assert asset.sha256 in asset._repr_html_()
    shown(asset)


def test_a_hostile_name_stays_text(small_run):
    scene = small_run.scene
    node = replace(scene.nodes[0], path="/World/<script>alert(1)</script>")
    text = replace(scene, nodes=(node,), warnings=('<img src=x onerror="alert(1)">',))._repr_html_()
    assert "<script" not in text and "onerror=&quot;" in text


def test_a_long_table_is_cut_and_says_so():
    radios = tuple(rfsg.Radio.at(f"/World/rx_{i}", i, 0.0, 1.0) for i in range(50))
    scene = rfsg.Scene(transmitters=(rfsg.Radio.at("/World/tx", 0, 5, 1),), receivers=radios)
    text = scene._repr_html_()
    assert "radios (51)" in text and "... and 31 more" in text


def test_as_text_each_is_one_short_line(small_run):
    for thing in (small_run, small_run.scene, small_run.paths):
        assert len(repr(thing)) < 120 and "\n" not in repr(thing)


def test_nothing_else_has_a_display():
    from rfsg.notebook import html

    with pytest.raises(TypeError, match="int: no notebook display"):
        html(3)


def test_the_first_notebook_runs(monkeypatch):
    """Its code cells, one after another, as a kernel would run them from the folder it lies in."""
    file = ROOT / "examples" / "first_steps.ipynb"
    assert file.stat().st_size < 200_000
    cells = json.loads(file.read_text())["cells"]
    monkeypatch.chdir(file.parent)
    names: dict = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            source = "".join(cell["source"])
            assert not re.search(r"^\s*[!%]", source, re.M)  # plain Python, no magic
            exec(compile(source, file.name, "exec"), names)
    assert names["moved_db"] != names["before_db"]
