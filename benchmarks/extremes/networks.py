"""Learned shapes: precision of their weights, and networks that are no shape at all."""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from extremes.measure import Measured, Point, measure, node, refusal
from extremes.table import Note, Row, Section
from rfsg.objects.body import Body
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.assets import load_asset, save_asset
from rfsg.scene.scene import Scene
from rfsg.scene.weights import digest
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate

F = 2.4e9
QUALITY = Quality(depth=1)
TX, RX = ENDS = (2.0, 0.3, 0.2), (1.5, 1.4, -0.3)
BESIDE = (0.3, 2.0, 1.0), (-0.4, 1.5, 0.7)
CABINET = Path(__file__).resolve().parents[2] / "assets" / "objects" / "cabinet" / "cabinet.usda"

FACET = Note(
    "Weights rounded to float32 are another surface, by some 1e-7 of its size. And a derivative turns "
    "the mirror that was measured over the Fresnel zone; it does not measure anew, as a simulation a "
    "step away does, and so lacks how the measured curvature changes along a rough face.",
    "Differentiate paths over learned faces for fitting and steering, not to the last digit; the "
    "weights themselves differentiate through the measurement.",
)
NO_SHAPE = Note(
    "Refused where it is read and where it is simulated, with the prim path, before anything is "
    "traced.",
    "Train again; a network that lost its surface has most likely diverged.",
)


def shape(width: int = 16) -> NeuralShape:
    """Untrained, about a ball of half a metre: what it is matters less than that it ripples."""
    bounds = [[-1.0] * 3, [1.0] * 3]
    return NeuralShape(bounds, width=width, depth=4, skip=2, features=4, lipschitz=3.0)


def precision(quick: bool) -> Section:
    net = shape(8 if quick else 16).double()
    with torch.no_grad():
        for i, weights in enumerate(net.parameters()):
            noise = torch.rand(weights.shape, generator=torch.Generator().manual_seed(i))
            weights += 1e-8 * noise.double()  # digits that float32 cannot hold
    double = Body(net, Conductor())
    rows = [_precision("float64 weights", double, None, *ENDS)]
    if not quick:
        rows.append(_precision("float32 weights", _single(double), double, *ENDS))
        cabinet = Body(load_asset(CABINET).body.shape, Conductor())
        rows.append(_precision("the trained cabinet, float32", cabinet, None, *BESIDE))
    return Section(
        "Precision of networks",
        "A network of 4 layers as it starts, met as a mirror: reciprocity, difference from the same "
        "weights in float64, and the slope of the path gain by the receiver's height against central "
        "differences, relative to 2 pi / lambda times the gain.",
        ("reciprocity", "against float64", "slope"),
        tuple(rows),
        "float32 weights for search and evaluation alike; reciprocity to 1e-6 with either.",
    )


def _single(body: Body) -> Body:
    copy = shape()
    copy.load_state_dict({k: v.float() for k, v in body.shape.state_dict().items()})
    return Body(copy, Conductor())


def _precision(name: str, body: Body, double: Body | None, tx: Point, rx: Point) -> Row:
    there, back = (measure([node(body)], *ends, F, QUALITY) for ends in ((tx, rx), (rx, tx)))
    other = None if double is None else _apart(there, measure([node(double)], tx, rx, F, QUALITY))
    errors = (_apart(there, back), other, _slope_error(there, rx))
    return Row(name, errors, there.status, there.gradient, FACET, 1e-6, expected=True)


def _apart(a: Measured, b: Measured) -> float:
    if len(a.paths) != len(b.paths):
        return math.inf
    pairs = zip(a.paths, b.paths, strict=True)
    return max((abs(x - y) / abs(x) for (_, x), (_, y) in pairs), default=0.0)


def _slope_error(found: Measured, rx: Point) -> float:
    """Of the path gain by the receiver's height, on the chains that were found."""
    step = 1e-5

    def gain(height: float) -> float:
        scene = found.result.scene
        at = torch.tensor((rx[0], rx[1], rx[2] + height), dtype=torch.float64)
        moved = scene.with_receivers([replace(scene.receivers[0], position=at)])
        return float(simulate(moved, F, QUALITY, chains=found.result.chains).path_gain())

    expected = (gain(step) - gain(-step)) / (2 * step)
    return abs(float(found.slope[2]) - expected) / (2 * math.pi * F / 299_792_458.0 * gain(0.0))


Break = Callable[[NeuralShape], None]


def _constant(net: NeuralShape) -> None:
    net.to_value.weight.zero_()
    net.to_value.bias.fill_(0.2)


def _shifted(by: float) -> Break:
    def change(net: NeuralShape) -> None:
        net.to_value.bias += by

    return change


def _nan(net: NeuralShape) -> None:
    net.hidden[0].bias[0] = math.nan


def degenerate(quick: bool) -> Section:
    cases: list[tuple[str, Break, str]] = [
        ("f constant", _constant, "nothing to hit"),
        ("f everywhere positive", _shifted(30.0), "no inside"),
        ("f everywhere negative", _shifted(-30.0), "no outside"),
        ("a weight is NaN", _nan, "not finite"),
    ]
    rows = []
    for name, change, words in cases:
        net = shape()
        with torch.no_grad():
            change(net)
        body = Body(net, Conductor())
        with tempfile.TemporaryDirectory() as folder:
            said = _doors(Path(folder), body)
        right = all(words in s for s in said.values())
        rows.append(Row(name, (0.0 if right else math.inf,), said["simulate"], None, NO_SHAPE))
    rows += [_bad_bounds()]
    return Section(
        "Networks that are no shape",
        "Three doors: simulating a scene made in Python (whose words are shown), reading the asset, "
        "and reading a scene that references it. 0 is the right refusal at all three.",
        ("refused",),
        tuple(rows),
        "any network whose f changes sign within its bounds.",
    )


def _doors(folder: Path, body: Body) -> dict[str, str]:
    """What simulate, load_asset and Scene.from_usd say of a body."""
    path = save_asset(folder / "net.usda", body)
    scene = folder / "scene.usda"
    scene.write_text(SCENE)
    blank = str(folder) + "/"
    said = {
        "simulate": refusal(lambda: measure([node(body, path="/World/Net")], TX, RX, F, QUALITY)),
        "load_asset": refusal(lambda: load_asset(path)),
        "Scene.from_usd": refusal(lambda: Scene.from_usd(scene)),
    }
    assert digest(path.with_suffix(".safetensors").read_bytes())  # the file itself is in order
    return {door: words.replace(blank, "") for door, words in said.items()}


SCENE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    def Xform "Net" (prepend references = @./net.usda@)
    {
    }
}
"""


def _bad_bounds() -> Row:
    said = refusal(lambda: NeuralShape([[0.0] * 3, [0.0, 1.0, math.nan]]))
    right = "expected a finite box" in said
    return Row("bounds that are no box", (0.0 if right else math.inf,), f"constructor: {said}",
               None, NO_SHAPE)  # fmt: skip


SECTIONS = (precision, degenerate)
