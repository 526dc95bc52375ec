"""Which points beside an edge lie inside another object: boxes first, shapes for what is left."""

import math

import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer import edges


def world(objects: int = 30) -> World:
    """Turned boxes, spheres, one of them scaled, and a ground without bounds."""
    generator = torch.Generator().manual_seed(3)

    def drawn(*size: int) -> torch.Tensor:
        return torch.rand(*size, generator=generator, dtype=torch.float64)

    nodes = [Node("/ground", Body(HalfSpace(), Conductor()), Pose.at(0, 0, 0.4))]
    for i in range(objects):
        shape = Sphere(0.5) if i % 3 == 0 else Box((0.2 + 0.6 * drawn(3)).tolist())
        turn, _ = torch.linalg.qr(drawn(3, 3) - 0.5)
        scale = torch.tensor(1.0 + 0.5 * (i % 2), dtype=torch.float64)
        nodes.append(Node(f"/n{i}", Body(shape, Conductor()), Pose(turn, 4 * drawn(3), scale)))
    return World(Scene(tuple(nodes), (), (), 1e9))


def test_a_point_is_inside_another_object_where_any_shape_but_its_own_says_so(monkeypatch):
    """Plain twin: every shape is asked of every point."""
    scene = world()
    generator = torch.Generator().manual_seed(0)
    point = 5 * torch.rand(4000, 3, generator=generator, dtype=torch.float64) - 0.5
    own = torch.randint(len(scene), (4000,), generator=generator)
    expected = torch.zeros(4000, dtype=torch.bool)
    for k in range(len(scene)):
        value = scene.sdf(torch.full((4000,), k), point)
        expected |= (value < 0) & (own != k)
    assert 0.2 < float(expected.float().mean()) < 0.8
    assert torch.equal(edges._inside_another(scene, own, point), expected)
    monkeypatch.setattr(edges, "PAIRS", 100)  # in many blocks
    assert torch.equal(edges._inside_another(scene, own, point), expected)


def test_an_upright_box_holds_its_object_and_is_no_larger_than_it_must():
    """A turned box reaches |R| h along the axes; one without bounds reaches everywhere."""
    turn = Pose.at(1, 2, 3, yaw_deg=45, scale=2.0)
    nodes = [
        Node("/b", Body(Box((1.0, 1.0, 0.5)), Conductor()), turn),
        Node("/g", Body(HalfSpace(), Conductor()), Pose.identity()),
    ]
    low, high = edges.upright(World(Scene(tuple(nodes), (), (), 1e9)), torch.arange(2))
    reach = torch.tensor([2 * math.sqrt(2), 2 * math.sqrt(2), 1.0], dtype=torch.float64)
    centre = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(low[0], centre - reach, atol=1e-8, rtol=0)
    torch.testing.assert_close(high[0], centre + reach, atol=1e-8, rtol=0)
    assert bool((low[0] <= centre - reach).all() & (high[0] >= centre + reach).all())
    assert bool(torch.isinf(low[1]).all() & torch.isinf(high[1]).all())
