"""``rfsg view``: what it refuses, and the page of one file that it writes."""

import pytest

from rfsg import cli
from tests.test_cli import SCENE


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "scene.usda"
    file.write_text(SCENE)
    return file


def refused(capsys, *words: object) -> tuple[int, str]:
    code = cli.run(["view", *map(str, words), "--no-open"])
    return code, capsys.readouterr().err


@pytest.mark.parametrize("option", ["--save", "--html"])
def test_a_file_that_is_there_is_not_written_over(scene_file, tmp_path, capsys, option):
    taken = tmp_path / "taken.usda"
    taken.write_text("mine")
    code, said = refused(capsys, scene_file, option, taken)
    assert code == 2 and f"{option} {taken}: already exists" in said and "--overwrite" in said
    assert taken.read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--port", "70000"], 2, "--port"),
        (["--quality", "best"], 2, "best"),
        (["--variant", "nonsense"], 2, "nonsense"),
        (["--asset-root", "nowhere"], 2, "nowhere: no such folder"),
        (["--time", "nan"], 2, "--time"),
        (["--library", "nowhere"], 3, "nowhere"),
        (["--move", "/World/Nothing=1,0,0"], 3, "/World/Nothing: nothing at this path"),
        (["--swap", "/World/Cabinet=nowhere.usda"], 3, "nowhere.usda"),
    ],
)
def test_what_is_wrong_is_said(scene_file, capsys, words, code, said):
    found, text = refused(capsys, scene_file, *words)
    assert found == code and said in text


def test_a_scene_that_is_not_there(tmp_path, capsys):
    code, said = refused(capsys, tmp_path / "nowhere.usda")
    assert code == 3 and "nowhere.usda: no such file" in said


def test_without_viser_the_remedy_is_said(scene_file, capsys, monkeypatch):
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    code, said = refused(capsys, scene_file)
    assert code == 2 and "pip install 'rfsg[viewer]'" in said


def test_a_page_of_one_file(scene_file, tmp_path, capsys):
    page = tmp_path / "page.html"
    move = ["--move", "/World/Cabinet=0.5,0,0", "--quality", "draft"]
    code, said = refused(capsys, scene_file, "--html", page, *move)
    assert code == 0, said
    assert "rfsg-card" in page.read_text()
