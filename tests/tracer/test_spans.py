"""Embree's spans are complete: held against every ray times every box."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.boxes import layers_of, touching
from rfsg.tracer.embree import Proxies, brute_spans
from rfsg.tracer.launch import fibonacci
from rfsg.tracer.records import Rays
from tests.scenes import box_node, vector


def _scenes():
    flush = (
        box_node("/left", (0.0, -1.5, 1.0), (0.1, 1.0, 1.0)),
        box_node("/door", (0.0, 0.0, 1.0), (0.1, 0.5, 1.0)),
        box_node("/right", (0.0, 1.5, 1.0), (0.1, 1.0, 1.0)),
        box_node("/lintel", (0.0, 0.0, 2.25), (0.1, 2.5, 0.25)),
    )
    inset = (
        box_node("/wall", (0.0, 0.0, 0.0), (0.1, 3.0, 1.5)),
        box_node("/door", (0.0, 0.5, -0.5), (0.1, 0.4, 1.0)),  # both faces flush with the wall's
    )
    stacked = tuple(
        box_node(f"/b{k}", (0.3 * (k % 3), 0.0, 0.5 * k + 0.25), (0.4, 0.4, 0.25)) for k in range(8)
    )
    nested = (
        box_node("/outer", (0, 0, 0), (2.0, 2.0, 2.0)),
        box_node("/middle", (0.5, 0, 0), (1.0, 1.0, 1.0), yaw_deg=30.0),
        Node("/inner", Body(Sphere(0.4), Conductor()), Pose.at(0.4, 0.1, 0.0)),
        Node(
            "/ground",
            Body(HalfSpace(), DielectricHalfSpace(eps_r=3.0, sigma=0.0)),
            Pose.at(0, 0, -3),
        ),
    )
    torch.manual_seed(3)
    crowd = tuple(
        box_node(
            f"/c{k}",
            (torch.rand(3) * 6 - 3).tolist(),
            (torch.rand(3) * 0.8 + 0.01).tolist(),
            yaw_deg=float(torch.rand(()) * 360),
        )
        for k in range(60)
    )
    far = tuple(
        Node(
            n.path,
            n.body,
            Pose(n.pose.rotation, n.pose.translation + vector(1e5, -2e5, 50.0), n.pose.scale),
        )
        for n in crowd
    )
    return {
        "flush": flush, "inset": inset, "stacked": stacked, "nested": nested, "crowd": crowd, "far": far,
    }  # fmt: skip


@pytest.mark.parametrize("name", ["flush", "inset", "stacked", "nested", "crowd", "far"])
def test_spans_are_complete(name):
    _complete(_scenes()[name])


def test_spans_are_complete_where_a_floor_touches_everything():
    """The floor and the lid are hubs: proposed to every ray, not by every box that stands on them."""
    nodes = _hall(60)
    _complete(nodes)
    (layer,) = layers_of(_corners(nodes))
    assert set(layer.boxes.hubs.tolist()) == {60, 61}


def test_spans_are_complete_after_moves():
    """What did not move is not built again; what moved, came or went is right all the same."""
    nodes = _hall(60)
    _complete(nodes)
    (built,) = layers_of(_corners(nodes))
    gone = [n for k, n in enumerate(nodes) if k not in (3, 61)]
    moved = [*gone[:5], box_node("/new", (0.3, 0.2, 0.6), (0.4, 0.1, 0.5)), *gone[5:]]
    moved[8] = box_node("/c8", (0.5, -0.2, 0.4), (0.3, 0.3, 0.4), yaw_deg=20.0)
    moved[9] = moved[10]  # two at one place: one of them stood there before
    standing, few = layers_of(_corners(moved))
    assert standing.boxes is built.boxes
    assert sorted(few.owner.tolist()) == [5, 8, 10]
    _complete(tuple(moved))


def test_touching_boxes_are_found_as_by_looking_at_every_pair():
    torch.manual_seed(5)
    corners = torch.rand(300, 1, 3).double() * 9 + torch.rand(300, 8, 3).double()
    low, high = corners.amin(1) - 1e-3, corners.amax(1) + 1e-3
    every = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(-1).triu(1)
    first, second = touching(corners, 1e-3)
    found = set(zip(*(torch.stack([first, second]).sort(0).values.tolist()), strict=True))
    assert found == set(map(tuple, every.nonzero().tolist())) and len(found) == len(first) > 100


def _hall(count):
    things = tuple(
        box_node(f"/c{k}", (k % 8 - 3.5, k // 8 - 3.5, 0.5), (0.3, 0.2, 0.5)) for k in range(count)
    )
    floor = box_node("/floor", (0, 0, -0.1), (5.0, 5.0, 0.1))
    return (*things, floor, box_node("/lid", (0, 0, 1.1), (5.0, 5.0, 0.1)))


def _corners(nodes):
    proxies = Proxies(World(Scene(tuple(nodes))))
    return proxies.corners(proxies.owner)


def _complete(nodes):
    world = World(Scene(nodes))
    middle = torch.stack([n.pose.translation for n in nodes]).mean(0)
    torch.manual_seed(1)
    count = 4000
    origin = middle + torch.randn(count, 3, dtype=torch.float64) * 2.5
    aim = middle + torch.randn(count, 3, dtype=torch.float64)
    direction = torch.nn.functional.normalize(aim - origin, dim=-1)
    # rays along and just beside faces are where stepping past a hit goes wrong
    axis = torch.eye(3, dtype=torch.float64).repeat(count // 6 + 1, 1)[: count // 2]
    direction = torch.cat([direction[: count - len(axis)], axis])
    limit = torch.where(torch.rand(count) < 0.3, 2.0, torch.inf).double()
    rays = Rays(origin, direction, limit)
    found, twin = Proxies(world).spans(rays), brute_spans(world, rays)
    as_set = lambda s: set(zip(s.ray.tolist(), s.which.tolist(), strict=True))  # noqa: E731
    assert as_set(found) == as_set(twin)
    assert len(twin.ray) > count / 4
    torch.testing.assert_close(found.enter, twin.enter)
    torch.testing.assert_close(found.leave, twin.leave)


def test_no_objects():
    world = World(Scene(()))
    rays = Rays(
        torch.zeros(5, 3, dtype=torch.float64), fibonacci(5), torch.full((5,), 3.0).double()
    )
    assert len(Proxies(world).spans(rays).ray) == 0
