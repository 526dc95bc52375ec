"""A wall of several flush boxes is a wall: also for the ray that runs along their seam."""

import math
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import HalfSpace
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.embree import Proxies
from rfsg.tracer.march import crossings
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Rays
from rfsg.tracer.simulate import Result, simulate
from tests.scenes import box_node, radio, vector

DIRECT = Quality(depth=0, floor_db=-300.0)
HALVES = (("/a", (0.0, -1.5, 0.0), (0.1, 1.5, 3.0)), ("/b", (0.0, 1.5, 0.0), (0.1, 1.5, 3.0)))


def run(nodes, tx=(-4.0, 0.0, 0.0), rx=(4.0, 0.0, 0.0)) -> Result:
    return simulate(Scene(tuple(nodes), (radio("/t", *tx),), (radio("/r", *rx),)), 2.4e9, DIRECT)


def gain(nodes, **ends) -> float:
    return float(run(nodes, **ends).path_gain())


def wall(surface=None) -> Node:
    return box_node("/wall", (0.0, 0.0, 0.0), (0.1, 3.0, 3.0), surface)


def turned(node: Node, pose: Pose) -> Node:
    return Node(node.path, node.body, pose.compose(node.pose))


@pytest.mark.parametrize("tilt", [0.0, 1.0])
@pytest.mark.parametrize(
    "parts",
    [
        HALVES,
        HALVES[::-1],
        (*HALVES[:1], ("/b", (0.0, 1.5, 0.0), (0.3, 1.5, 3.0))),  # one thicker than the other
        tuple((f"/{y}{z}", (0.0, y, z), (0.1, 1.5, 1.5)) for y in (-1.5, 1.5) for z in (-1.5, 1.5)),
        (("/a", (0.0, -1.5 - 1e-12, 0.0), (0.1, 1.5, 3.0)), HALVES[1]),  # a gap of rounding
        (("/a", (0.0, -1.5 + 1e-12, 0.0), (0.1, 1.5, 3.0)), HALVES[1]),
    ],
    ids=["halves", "in the other order", "thicker", "quarters", "gap", "overlap"],
)
def test_along_a_seam_a_wall_counts_once(parts, tilt):
    if len(parts) == 4:
        tilt = 0.0  # a ray that climbs from one slab into the next crosses both: draw slabs whole
    ends = {"tx": (-4.0, 0.0, -tilt), "rx": (4.0, 0.0, tilt)}
    expected = gain([wall()], **ends)
    assert expected < 0.2 * gain([], **ends)
    assert gain([box_node(*p) for p in parts], **ends) == pytest.approx(expected, rel=1e-9)
    solid = Solid(eps_r=5.24, sigma=0.05)
    found = run([box_node(*p, solid) for p in parts], **ends).transfer()
    torch.testing.assert_close(found, run([wall(solid)], **ends).transfer(), rtol=1e-9, atol=0.0)
    assert gain([box_node(*p, Conductor()) for p in parts], **ends) == 0.0


@pytest.mark.parametrize("yaw", [30.0, 90.0, 137.0])
@pytest.mark.parametrize("half_turn", [0.0, 180.0])
def test_seams_in_walls_that_stand_askew(yaw, half_turn):
    """Rotated, the seam is a seam to rounding only."""
    outer = Pose.at(0.3, -0.7, 0.2, yaw)
    c, s = 4.0 * math.cos(math.radians(yaw)), 4.0 * math.sin(math.radians(yaw))
    ends = {"tx": (0.3 - c, -0.7 - s, 0.2), "rx": (0.3 + c, -0.7 + s, 0.2)}
    a, b = (box_node(*p) for p in HALVES)
    b = Node(b.path, b.body, b.pose.compose(Pose.at(0.0, 0.0, 0.0, half_turn)))
    found = gain([turned(a, outer), turned(b, outer)], **ends)
    assert found == pytest.approx(gain([turned(wall(), outer)], **ends), rel=1e-9)


def test_a_line_in_a_face_that_nothing_touches_is_free():
    """An antenna on a ceiling sees along it, and one on the ground along the ground."""
    free = gain([])
    assert gain([box_node(*HALVES[0])]) == pytest.approx(free, rel=1e-12)
    assert gain([box_node(*HALVES[1])]) == pytest.approx(free, rel=1e-12)
    ground = Node("/ground", Body(HalfSpace(), Conductor()), Pose.identity())
    assert gain([ground]) == pytest.approx(free, rel=1e-12)
    apart = box_node("/b", (1.0, 1.5, 0.0), (0.1, 1.5, 3.0))  # in one plane, but not side by side
    assert gain([box_node(*HALVES[0]), apart]) == pytest.approx(free, rel=1e-12)


def test_under_the_foot_of_a_wall_that_stands_on_the_ground():
    ground = Node("/ground", Body(HalfSpace(), Conductor()), Pose.identity())
    standing = box_node("/wall", (0.0, 0.0, 1.5), (0.1, 3.0, 1.5))
    assert gain([ground, standing]) == pytest.approx(gain([wall()]), rel=1e-9)


def test_gradients_along_a_seam_are_those_of_the_whole_wall():
    found = []
    for nodes in ([wall()], [box_node(*p) for p in HALVES]):
        at = vector(-4.0, 0.0, 0.0).requires_grad_(True)
        tx = radio("/t", 0.0, 0.0, 0.0)
        scene = Scene(tuple(nodes), (tx,), (radio("/r", 4.0, 0.0, 0.5),))
        scene = scene.with_transmitters([replace(tx, position=at)])
        power = simulate(scene, 2.4e9, DIRECT, gradients=True).path_gain().sum()
        found.append(torch.autograd.grad(power, at)[0])
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=1e-18)


FLOOR = Quality(depth=1, floor_db=-300.0)


def floor(parts, surface=None, order=1) -> Result:
    """A path that bounces at the origin, on a floor of boxes whose tops lie at z = 0."""
    nodes = [
        box_node(f"/{k}", (*c, -0.1), (*h, 0.1), surface) for k, (c, h) in enumerate(parts[::order])
    ]
    ends = (radio("/t", -2.0, 0.0, 2.0),), (radio("/r", 2.0, 0.0, 2.0),)
    return simulate(Scene(tuple(nodes), *ends), 2.4e9, FLOOR)


TILES = [((x, y), (1.5, 1.5)) for x in (-1.5, 1.5) for y in (-1.5, 1.5)]


@pytest.mark.parametrize("surface", [None, Conductor()], ids=["slab", "conductor"])
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(
    "parts",
    [
        [((-1.5, 0.0), (1.5, 3.0)), ((1.5, 0.0), (1.5, 3.0))],
        TILES,
        [((0.0, 0.0), (3.0, 3.0))] * 2,
        [((0.0, 0.0), (3.0, 3.0)), ((-1.5, 0.0), (1.5, 3.0))],
    ],
    ids=["at a seam", "where four tiles meet", "drawn twice", "drawn twice in part"],
)
def test_a_floor_in_pieces_reflects_once(parts, order, surface):
    whole = floor([((0.0, 0.0), (3.0, 3.0))], surface)
    found = floor(parts, surface, order)
    assert len(found.paths.tx) == len(whole.paths.tx) == 2
    assert found.status_counts["DUPLICATE"] == len(parts) - 1
    torch.testing.assert_close(found.transfer(), whole.transfer(), rtol=1e-9, atol=0.0)


def test_an_edge_belongs_to_its_face():
    """Whichever way rounding goes: the same box at many yaws, the bounce on its very edge."""
    for yaw in (0.0, 13.0, 57.0, 90.0, 211.0):
        outer = Pose.at(0.3, -0.2, 0.1, yaw)
        node = turned(box_node("/half", (-1.5, 0.0, -0.1), (1.5, 3.0, 0.1)), outer)
        tx, rx = (outer.point_world(vector(x, 0.0, 2.0)).tolist() for x in (-2.0, 2.0))
        scene = Scene((node,), (radio("/t", *tx),), (radio("/r", *rx),))
        assert simulate(scene, 2.4e9, FLOOR).status_counts == {"OK": 2}


def test_a_ray_without_end_enters_the_ground():
    """In a face is what runs along it, not what goes in for good."""
    world = World(Scene((Node("/g", Body(HalfSpace(), Conductor()), Pose.identity()),)))
    down = torch.nn.functional.normalize(vector(1.0, 0.0, -1e-3), dim=0)
    rays = Rays(
        vector(0.0, 0.0, 1.0).repeat(3, 1),
        torch.stack([vector(0.0, 0.0, -1.0), down, vector(1.0, 0.0, 0.0)]),
        torch.full((3,), math.inf, dtype=torch.float64),
    )
    found = crossings(world, rays, Proxies(world).spans(rays))
    assert found.ray.tolist() == [0, 1]
    torch.testing.assert_close(found.enter, vector(1.0, 1.0 / -down[2]))


def test_radios_nearer_than_a_nanometre_coincide():
    for gap, status in ((1e-8, "OK"), (1e-10, "DEGENERATE"), (1e-130, "DEGENERATE")):
        found = run([], (0.0, 0.0, 0.0), (gap, 0.0, 0.0))
        assert found.status_counts == {status: 1}
