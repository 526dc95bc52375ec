"""Factors of kept paths: products, and crossings that slide with their surface, against plain twins."""

from dataclasses import replace

import pytest
import torch

from rfsg.learn.factors import multiplied, slide, slide_object
from rfsg.learn.leaves import rotation
from rfsg.objects.body import Body
from rfsg.objects.contract import Crossing
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Slid
from rfsg.scene.world import World
from tests.learn.rooms import learned, room_with, thing

F64 = torch.float64
FREQUENCY = torch.tensor([2.4e9], dtype=F64)


def test_a_path_is_multiplied_by_all_that_it_meets():
    torch.manual_seed(0)
    place = torch.tensor([3, 0, 3, 1, 3, 0])
    value = torch.randn(5, 2, dtype=torch.complex128, requires_grad=True)
    factor = torch.randn(6, 2, dtype=torch.complex128, requires_grad=True)
    plain = list(value)
    for i, f in zip(place.tolist(), factor, strict=True):
        plain[i] = plain[i] * f
    torch.testing.assert_close(
        multiplied(value, place, factor), torch.stack(plain), rtol=1e-14, atol=0
    )
    assert torch.autograd.gradcheck(lambda v, f: multiplied(v, place, f), (value, factor))


def _crossed() -> tuple[World, Body, torch.Tensor, Crossing]:
    """A turned and scaled network in a room, and crossings near its surface: the first begins inside."""
    torch.manual_seed(1)
    shape = NeuralShape([[-0.5] * 3, [0.5] * 3], width=8, depth=3, skip=1, frequencies=2)
    body = Body(shape, learned(1, samples=4)).double()
    with torch.no_grad():
        for weight in body.parameters():
            weight.add_(0.02 * torch.randn_like(weight))
    node = thing(body.surface)
    pose = replace(node.pose, scale=torch.tensor(1.7, dtype=F64))
    world = World(room_with(replace(node, body=body, pose=pose)))
    which = torch.full((6,), len(world) - 1)
    out = torch.nn.functional.normalize(torch.randn(6, 3, dtype=F64), dim=-1)
    away = torch.nn.functional.normalize(out + 0.2 * torch.randn(6, 3, dtype=F64), dim=-1)
    enters = torch.ones(6, 1, dtype=F64)
    enters[0] = 0.0
    crossing = Crossing(
        world.point_world(which, -0.25 * out),
        world.point_world(which, 0.25 * away),
        world.direction_world(which, -out * enters),
        world.direction_world(which, away),
    )
    return world, body, which, crossing


@pytest.mark.parametrize("poses", [False, True])
def test_a_crossing_slides_alike_in_every_frame(poses):
    """In the object's frame, its normals turned by its surface, as in the world's, where they are
    turned by a sweep of their own: coefficients, and their slopes by weights and poses."""
    world, body, which, crossing = _crossed()
    inputs = list(body.parameters())
    if poses:
        move = [torch.zeros(3, dtype=F64, requires_grad=True) for _ in range(2)]
        world.rotation = rotation(move[0]) @ world.rotation
        world.translation = world.translation + move[1]
        inputs += move

    def local(c: Crossing) -> Crossing:
        return Crossing(
            world.point_object(which, c.start),
            world.point_object(which, c.end),
            world.direction_object(which, c.normal_start),
            world.direction_object(which, c.normal_end),
        )

    slid = slide_object(body.shape, local(crossing), dtype=F64)
    plain = local(slide(world, which, crossing))
    assert isinstance(slid, Slid)
    far = (plain.start - local(crossing).start).detach().abs().amax(-1)
    assert far[0] == 0 and (far[1:] > 1e-4).all()  # an end inside stays, the others have to slide
    answers = [
        torch.view_as_real(body.surface.transmission(body.shape, c, FREQUENCY)[:, 0, 0])
        for c in (slid, plain)
    ]
    torch.testing.assert_close(*answers, rtol=1e-12, atol=1e-15)
    seed = torch.randn_like(answers[0])
    slopes = [
        torch.autograd.grad(a, inputs, seed, allow_unused=True, retain_graph=True) for a in answers
    ]
    for one, other in zip(*slopes, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            largest = float(other.abs().max())
            torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12 * largest)
