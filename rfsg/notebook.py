"""How scenes, results, paths, maps and assets show themselves in a notebook: tables and a picture.

Self-contained HTML, pictures inside. What comes from a scene (prim paths, names) is escaped: a
stranger's scene cannot put a script into a notebook. Tables show their first rows and say how many
there are.
"""

import base64
import html as escaping
import io
from collections.abc import Callable, Iterable, Mapping
from functools import singledispatch
from pathlib import Path
from typing import Any

from rfsg import plot, report
from rfsg.objects.plain import array
from rfsg.scene.assets import LoadedAsset
from rfsg.scene.scene import Scene
from rfsg.tracer.radiomap import RadioMap
from rfsg.tracer.records import Act, Paths
from rfsg.tracer.simulate import Result

ROWS = 20  # of a table; the rest is counted
DPI = 80
LINK_COLUMNS = ("tx", "rx", "path_gain_db", "rss_dbm", "delay_spread_ns", "n_paths", "los")


@singledispatch
def html(thing: Any) -> str:
    """A thing as HTML. TypeError for what has no display."""
    raise TypeError(f"{type(thing).__name__}: no notebook display")


@html.register
def _(scene: Scene) -> str:
    return _page(
        str(scene),
        _picture(lambda: plot.scene_figure(scene)) if _has_places(scene) else "",
        _table("objects", report.scene_table(scene)),
        _table("radios", report.radio_table(scene)),
        _list("warnings", scene.warnings),
    )


@html.register
def _(result: Result) -> str:
    links = [{name: row[name] for name in LINK_COLUMNS} for row in result.links()[: ROWS + 1]]
    count = len(result.scene.transmitters) * len(result.scene.receivers)
    return _page(
        str(result),
        _picture(lambda: plot.scene_figure(result.scene, result.paths, result.channel)),
        _table("links", links, count),
        _list("modelled", result.plan.modelled),
        _list("left out", result.plan.left_out),
        _list("warnings", result.warnings),
    )


@html.register
def _(paths: Paths) -> str:
    which, act = array(paths.which), array(paths.act)
    tx, rx, length = array(paths.tx), array(paths.rx), array(paths.length)
    rows = [
        {
            "tx": int(tx[p]),
            "rx": int(rx[p]),
            "length [m]": float(length[p]),
            "interactions": ", ".join(
                f"{Act(int(a)).word}({i})" for a, i in zip(act[p], which[p], strict=True) if i >= 0
            )
            or "line of sight",
        }
        for p in range(min(len(tx), ROWS))
    ]
    return _page(str(paths), _table("paths, by number of radio and object", rows, len(tx)))


@html.register
def _(found: RadioMap) -> str:
    return _page(
        str(found),
        _picture(lambda: plot.map_figure(found, found.scene)),
        _list("modelled", found.modelled),
        _list("left out", found.left_out),
        _list("warnings", found.warnings),
    )


@html.register
def _(asset: LoadedAsset) -> str:
    facts = {"file": Path(asset.path).name, "sha256": asset.sha256, **asset.provenance}
    rows = [{"": name, "value": report.short(value)} for name, value in facts.items()]
    return _page(f"asset {Path(asset.path).stem}", _table("provenance", rows))


def _has_places(scene: Scene) -> bool:
    return bool(scene.nodes or scene.transmitters or scene.receivers)


def _page(title: str, *parts: str) -> str:
    return f"<div><b>{_text(title)}</b>{''.join(parts)}</div>"


def _table(title: str, rows: Iterable[Mapping[str, Any]], count: int | None = None) -> str:
    rows = list(rows)
    if not rows:
        return ""
    count = len(rows) if count is None else count
    head = "".join(f"<th>{_text(name)}</th>" for name in rows[0])
    body = "".join(
        f"<tr>{''.join(f'<td>{_text(_short(value))}</td>' for value in row.values())}</tr>"
        for row in rows[:ROWS]
    )
    more = f"<div>... and {count - ROWS} more</div>" if count > ROWS else ""
    return (
        f"<table><caption>{_text(title)} ({count})</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"
    )


def _list(title: str, sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{_text(sentence)}</li>" for sentence in sentences)
    return f"<details><summary>{title}</summary><ul>{items}</ul></details>" if items else ""


def _picture(draw: Callable[[], Any]) -> str:
    figure = draw()
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI, bbox_inches="tight")
    code = base64.b64encode(stream.getvalue()).decode()
    return f'<div><img alt="" src="data:image/png;base64,{code}"/></div>'


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _text(value: Any) -> str:
    return escaping.escape(str(value), quote=True)
