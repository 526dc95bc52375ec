"""The floor plan of benchmarks/learn/plan.py: closed forms of what it says, and what it finds again."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import rfsg
from rfsg.learn.baselines import Method, Predictor, Readings
from rfsg.learn.regions import friis_db
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from learn.plan import FloorPlan, depth, received_db

GATEWAYS = np.array([[0.5, 0.5, 2.0], [9.5, 0.6, 2.2], [5.0, 9.5, 2.1]])
COLUMN, HALF = (5.0, 4.5, 1.5), (0.4, 0.4, 1.5)


def column(name: str, place: tuple[float, ...] = COLUMN) -> Node:
    return Node(name, Body(Box(HALF), Slab(thickness_m=0.8, eps_r=5.0)), Pose.at(*place))


def links(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(tx, rx, gateway) of every gateway and places over the room."""
    place = np.random.default_rng(seed).uniform([0, 0, 1.5], [10, 9, 2.0], (count, 3))
    gateway = np.tile(np.arange(len(GATEWAYS)), count)
    return np.repeat(place, len(GATEWAYS), 0), GATEWAYS[gateway], gateway


def free(tx: np.ndarray, rx: np.ndarray) -> np.ndarray:
    apart = torch.as_tensor(np.linalg.norm(tx - rx, axis=1))
    return friis_db(apart, torch.full_like(apart, 2.44e9)).numpy()


def test_depth_in_a_blurred_sphere_through_its_centre():
    """integral of sigmoid((r - |x|) / b) dx = 2 b log(1 + exp(r / b)), a softened 2 r."""
    radius, blur = 0.5, 0.1
    node = Node("/ball", Body(Sphere(radius), Slab(thickness_m=1.0, eps_r=2.0)), Pose.at(1, 2, 3))
    ends = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64) + torch.tensor([[0.0, 3.0, 4.0]])
    begin = 2.0 * torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64) - ends
    exact = 2.0 * blur * math.log1p(math.exp(radius / blur))
    assert float(depth(node, begin, ends, blur)) == pytest.approx(exact, abs=1e-4)


def test_depth_is_none_of_an_object_that_a_line_is_far_from():
    begin = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    for length in (2.0, 9.0):  # too short to come near, and not
        end = begin + torch.tensor([length, 0.0, 0.0])
        assert float(depth(column("/c"), begin, end, 0.05)) < 1e-12


def test_nothing_but_free_space_is_friis():
    """Readings by Friis of 7 dBm: no offset is found where there is none."""
    tx, rx, gateway = links(30, 0)
    plain = FloorPlan(Scene(), objects=False, reverberant=False, pattern_db=0.0)
    fitted = plain.fit(Readings(tx, rx, gateway, 7.0 + free(tx, rx)))
    assert isinstance(plain, Method) and isinstance(fitted, Predictor)
    asked = links(10, 1)
    np.testing.assert_allclose(fitted.predict(*asked).mean, 7.0 + free(*asked[:2]), atol=1e-6)


def test_reverberation_is_what_remains_where_nothing_else_arrives():
    """Far beyond 10 ** (R / 20), where free space is as strong, power no longer falls."""
    how = FloorPlan(Scene(), objects=False, pattern_db=0.0)
    far = np.array([[1e4, 0.0, 0.0], [2e4, 0.0, 0.0]])
    value = {
        "level": torch.tensor(3.0).double(),
        "offset": torch.zeros(1).double(),
        "reverberant": torch.tensor(-65.0).double(),
    }
    said = received_db(value, how.lines(far, np.zeros((2, 3))), torch.zeros(2, dtype=torch.int64))
    torch.testing.assert_close(said, torch.full_like(said, -62.0), rtol=0, atol=1e-3)


@pytest.fixture(scope="module")
def found():
    """A plan fitted to readings of the model itself: 6 and 14 dB in two columns, offsets, 0.01 dB noise.

    What is asked for has a wide prior, the rest stands near the middle of its own: the fit takes
    readings for 4 dB uncertain.
    """
    scene = Scene((column("/Columns/a"), column("/Columns/b", (2.5, 6.5, 1.5))))
    how = FloorPlan(scene, pattern_db=0.0, own_db=100.0)
    tx, rx, gateway = links(100, 2)
    rssi = truth(how, tx, rx, gateway) + np.random.default_rng(3).normal(0, 0.01, len(tx))
    return how, how.fit(Readings(tx, rx, gateway, rssi))


def truth(how: FloorPlan, tx: np.ndarray, rx: np.ndarray, gateway: np.ndarray) -> np.ndarray:
    value = {
        "level": torch.tensor(-10.0).double(),
        "offset": torch.tensor([2.0, -1.0, -1.0]).double(),
        "kind": torch.tensor([10.0]).double(),
        "own": torch.tensor([-4.0, 4.0]).double(),
        "reverberant": torch.tensor(-60.2).double(),
    }
    return received_db(value, how.lines(tx, rx), torch.as_tensor(gateway)).numpy()


def test_losses_of_objects_are_found_again(found):
    _, plan = found
    assert plan.losses_db()["/Columns/a"] == pytest.approx(6.0, abs=0.3)
    assert plan.losses_db()["/Columns/b"] == pytest.approx(14.0, abs=0.3)
    assert plan.std == pytest.approx(0.0, abs=0.1)


def test_what_is_learned_moves_with_its_object(found):
    """Columns moved after the fit: their losses are met where they stand now."""
    how, plan = found
    scene = how.scene.moved("/Columns/a", (1.5, 1.0, 0.0)).moved("/Columns/b", (0.0, -2.0, 0.0))
    moved = FloorPlan(scene, pattern_db=0.0)
    asked = links(60, 4)
    there = type(plan)(moved, plan.gateways, plan.value, plan.std).predict(*asked).mean
    exact = truth(moved, *asked)
    assert np.abs(there - exact).max() < 0.3
    assert np.abs(plan.predict(*asked).mean - exact).max() > 5.0  # it does matter


def test_a_gateway_never_heard_has_no_offset(found):
    """It gets the level of all: readings of gateway 0 are 2 dB stronger."""
    _, plan = found
    tx, rx, gateway = links(20, 5)
    known = plan.predict(tx, rx, np.zeros_like(gateway)).mean
    unheard = plan.predict(tx, rx, np.full_like(gateway, 9)).mean
    np.testing.assert_allclose(known - unheard, known[0] - unheard[0], atol=1e-9)
    assert known[0] - unheard[0] == pytest.approx(2.0, abs=0.5)


def test_patterns_turn_with_everything():
    """A lab turned and moved as a whole predicts the same: directions are vectors, not angles."""
    turn, shift = Pose.at(3.0, -2.0, 0.5, 40.0), np.array([3.0, -2.0, 0.5])
    rotation = turn.rotation.numpy()
    tx, rx, gateway = links(40, 6)
    east = (tx - rx)[:, 0] / np.linalg.norm(tx - rx, axis=1)
    rssi = free(tx, rx) + 3.0 * east * (gateway == 1)
    asked, said = links(15, 7), []
    for a, b in ((np.eye(3), np.zeros(3)), (rotation, shift)):
        where = tuple((a @ np.array(COLUMN) + b).tolist())
        pose = Pose.at(*where, 0.0 if a[0, 0] == 1 else 40.0)
        node = Node("/Columns/a", column("/c").body, pose)
        plan = FloorPlan(rfsg.Scene((node,)))
        fitted = plan.fit(Readings(tx @ a.T + b, rx @ a.T + b, gateway, rssi))
        said.append(fitted.predict(asked[0] @ a.T + b, asked[1] @ a.T + b, asked[2]).mean)
    np.testing.assert_allclose(said[0], said[1], atol=0.02)
