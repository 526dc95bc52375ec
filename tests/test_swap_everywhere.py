"""One swap, one channel: in the viewer, on the command line, in Python, and in a scene that was written so."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest

from rfsg import cli
from rfsg.objects.plain import array
from rfsg.scene.library import Library
from rfsg.scene.scene import Scene
from rfsg.tracer.simulate import Result, simulate
from rfsg.view.session import Session

OBJECTS = Path(__file__).parents[1] / "assets" / "objects"
CABINET = "/World/Cabinet"
WAIT_S = 300.0  # for a machine under load
AGREED = 1e-9

TEXT = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    custom double rfsg:frequencyHz = 2440000000
    def Xform "Cabinet" (
        prepend references = @./objects/{asset}/{asset}.usda@
    )
    {
        double3 xformOp:translate = (0.1, 0.9, 0.005)
        double xformOp:rotateZ = 20
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
    }
    def Material "Stone"
    {
        custom token rfsg:material:model = "slab"
        custom token rfsg:material:itu = "concrete"
    }
    def Cube "Wall" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {
        double size = 1
        rel material:binding = </World/Stone>
        double3 xformOp:translate = (0, 3, 1.5)
        double3 xformOp:scale = (8, 0.2, 3)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }
    def Xform "AP"
    {
        custom token rfsg:radio:role = "tx"
        double3 xformOp:translate = (-2, 0.1, 1.3)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Xform "rx_0"
    {
        custom token rfsg:radio:role = "rx"
        double3 xformOp:translate = (2.3, -0.4, 1.1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Xform "rx_1"
    {
        custom token rfsg:radio:role = "rx"
        double3 xformOp:translate = (2.1, 1.7, 0.6)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    for name in ("cabinet", "person"):
        shutil.copytree(OBJECTS / name, tmp_path / "objects" / name)
        (tmp_path / f"{name}.usda").write_text(TEXT.replace("{asset}", name))
    return tmp_path


def arriving(channel) -> list[tuple[int, float, complex]]:
    """(receiver, delay [ns], gain) of every path that arrives, in order; channel: by name."""
    there = ~np.asarray(channel("blocked"))
    columns = (channel("rx"), channel("delay") * 1e9, channel("gain")[:, 0])
    return sorted(zip(*(np.asarray(c)[there].tolist() for c in columns), strict=True), key=_order)


def _order(row: tuple[int, float, complex]) -> tuple[int, float]:
    return row[0], round(row[1], 6)


def of_result(result: Result | None) -> list[tuple[int, float, complex]]:
    assert result is not None
    return arriving(lambda name: array(getattr(result.channel, name)))


def agree(one: list, other: list) -> bool:
    if [row[0] for row in one] != [row[0] for row in other]:
        return False
    pairs = zip(one, other, strict=True)
    return all(abs(a[2] - b[2]) <= AGREED * abs(b[2]) for a, b in pairs)


def in_the_viewer(folder: Path) -> list:
    scene = Scene.from_usd(folder / "cabinet.usda")
    session = Session(scene, quality="draft", library=Library(folder / "objects"))
    try:
        assert session.wait(WAIT_S), session.answer
        session.swap(CABINET, "person")  # on from the channel with the cabinet
        assert session.wait(WAIT_S), session.answer
        assert session.answer is not None
        return of_result(session.answer.result)
    finally:
        session.close()


def on_the_command_line(folder: Path) -> tuple[list, list[dict[str, str]]]:
    out = folder / "out"
    asset = folder / "objects" / "person" / "person.usda"
    swap = ["--swap", f"{CABINET}={asset}", "--quality", "draft", "--out", str(out)]
    assert cli.run(["simulate", str(folder / "cabinet.usda"), *swap]) == 0
    with (out / "links.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with np.load(out / "channel.npz") as arrays:
        return arriving(lambda name: arrays[name]), rows


def test_a_swap_gives_the_same_channel_everywhere(folder, capsys):
    before = Scene.from_usd(folder / "cabinet.usda")
    library = Library(folder / "objects")
    python = simulate(before.replaced(CABINET, library["person"]), quality="draft")
    expected = of_result(python)
    assert len(expected) >= 4

    assert agree(in_the_viewer(folder), expected)
    paths, rows = on_the_command_line(folder)
    assert agree(paths, expected)
    for row, link in zip(rows, python.links(), strict=True):
        assert (row["tx"], row["rx"]) == (link["tx"], link["rx"])
        assert float(row["path_gain_db"]) == pytest.approx(link["path_gain_db"], abs=1e-6)
    written_so = simulate(Scene.from_usd(folder / "person.usda"), quality="draft")
    assert agree(of_result(written_so), expected)

    assert not agree(of_result(simulate(before, quality="draft")), expected)
