"""A frequency outside the band that objects were learned at: said, with by how much."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.simulate import simulate
from rfsg.tracer.validity import sentences
from tests.scenes import radio


def learned(path: str, band: tuple[float, float] | None, x: float = 0.0) -> Node:
    return Node(path, Body(Box((0.5, 0.5, 0.5)), StochasticSurface(), band), Pose.at(x, 0, 0))


def said(nodes: tuple[Node, ...], *hertz: float) -> list[str]:
    found = sentences(World(Scene(nodes)), torch.tensor(hertz, dtype=torch.float64))
    return [s for s in found if "learned at" in s]


@pytest.mark.parametrize(
    "hertz, words",
    [
        ((5.0e9,), "5 GHz lies 2.5 GHz (100 %) above"),
        ((1.8e9,), "1.8 GHz lies 0.2 GHz (10 %) below"),
        (
            (1.0e9, 2.2e9, 3.0e9),
            "1 GHz lies 1 GHz (50 %) below and 3 GHz lies 0.5 GHz (20 %) above",
        ),
        ((2.51e9,), "2.51 GHz lies 0.01 GHz (0.4 %) above"),
    ],
)
def test_outside_says_by_how_much(hertz, words):
    (sentence,) = said((learned("/a", (2.0e9, 2.5e9)),), *hertz)
    assert sentence.startswith("/a: learned at 2 to 2.5 GHz: ") and words in sentence


@pytest.mark.parametrize("hertz", [(2.0e9,), (2.5e9,), (2.0e9, 2.5e9), (2.3e9,)])
def test_inside_says_nothing(hertz):
    assert said((learned("/a", (2.0e9, 2.5e9)), learned("/b", None, 3.0)), *hertz) == []


def test_objects_of_one_band_share_a_sentence():
    nodes = (
        learned("/a", (2e9, 2e9)),
        learned("/b", (2e9, 2e9), 3.0),
        learned("/c", (1e9, 4e9), 6.0),
    )
    (sentence,) = said(nodes, 3e9)
    assert sentence.startswith("/a, /b: learned at 2 GHz: 3 GHz lies 1 GHz (50 %) above")


def test_a_result_carries_it():
    ball = Node("/ball", Body(Sphere(0.4), Conductor(), (1e9, 2e9)), Pose.at(0, 3, 0))
    scene = Scene((ball,), (radio("/tx", 0.0, 0.0, 0.0),), (radio("/rx", 2.0, 0.0, 0.0),), 2.4e9)
    assert any("2.4 GHz lies 0.4 GHz (20 %) above" in w for w in simulate(scene).warnings)
    assert not any("learned at" in w for w in simulate(scene, 2e9).warnings)
