"""Selection: names find parameters, on a private copy, and say who shares them."""

import math
from dataclasses import replace

import pytest
import torch

from rfsg.learn.adam import Adam
from rfsg.learn.errors import LearnError
from rfsg.learn.leaves import rotation
from rfsg.learn.selection import select
from rfsg.objects.body import Body
from rfsg.objects.physics import media
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from tests.learn.rooms import box, learned, room_with, thing


def cups() -> Scene:
    """Two cups of one asset, a metal box, and a wall of ITU concrete."""
    shape = NeuralShape([[-0.1] * 3, [0.1] * 3], width=8, depth=3, skip=1, features=128)
    body = Body(shape, learned(0, bulk=0.5))
    metal, wall = Body(box((1, 1, 1)), Conductor()), Slab(thickness_m=0.1, itu="concrete")
    nodes = (
        Node("/Cups/A", body, Pose.at(1, 1, 1)),
        Node("/Cups/B", body, Pose.at(2, 1, 1)),
        Node("/Safe", metal, Pose.at(3, 3, 1)),
        Node("/Wall", Body(box((1, 1, 1)), wall), Pose.at(5, 3, 1)),
    )
    return replace(room_with(count=2), nodes=nodes)


def test_patterns_find_parts_and_say_who_shares_them():
    chosen = select(cups(), ["/Cups/A.surface", "/Cups/*.pose.translation", "*.gain_db", "power"])
    rows = {(r["parameter"], *r["objects"]): r for r in chosen.rows()}
    assert rows["surface.s", "/Cups/A"]["also"] == ["/Cups/B"]
    assert rows["surface.bulk", "/Cups/A"]["count"] == 129
    assert ("pose.translation", "/Cups/B") in rows and ("offset_db", "power") in rows
    assert {p for p, *_ in rows if p.startswith("shape")} == set()
    assert sorted(chosen.gains) == ["/rx0", "/rx1", "/tx"]
    table = chosen.table()
    assert "/Cups/B" in table and "taught with it" in table


@pytest.mark.parametrize(
    ("patterns", "why"),
    [
        (["/Cup/A"], "near it: .*/Cups/A"),
        (["/Safe"], "conductor has no constants.*StochasticSurface"),
        (["/Wall.surface.eps_r"], "ITU concrete: give a frequency"),
        (["/Cups/A.surface.eps_r"], "it has .*/Cups/A.surface.weights"),
        (["/Cups/A", "/Nothing"], "'/Nothing' matches nothing"),
        ([], "empty"),
    ],
)
def test_a_pattern_that_fits_nothing_says_what_is_near(patterns, why):
    with pytest.raises(LearnError, match=why):
        select(cups(), patterns)


def test_the_callers_scene_is_left_alone():
    scene = cups()
    before = [p.clone() for n in scene.nodes for p in n.body.parameters()]
    wanted = [p.requires_grad for n in scene.nodes for p in n.body.parameters()]
    chosen = select(scene, ["/Cups/*", "/Wall", "/Safe.pose"], frequency=2.4e9)
    with torch.no_grad():
        for p in chosen.parameters():
            p.add_(1.0)
    after = [p for n in scene.nodes for p in n.body.parameters()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert wanted == [p.requires_grad for p in after]
    assert scene.node("/Wall").body.surface.config()["itu"] == "concrete"
    nodes = chosen.scene().nodes
    assert nodes[0].body is nodes[1].body
    assert nodes[2].pose.translation.tolist()[0] == 4.0


def test_only_what_is_selected_asks_for_gradients():
    chosen = select(cups(), ["/Cups/A.surface.s"])
    wanted = {n for n, p in chosen.base.nodes[0].body.named_parameters() if p.requires_grad}
    assert wanted == {"surface.log_sharpness"}


def test_a_head_alone_is_one_row_and_the_others_stay():
    chosen = select(cups(), ["/Cups/A.surface.alpha"])
    weight, bias = chosen.parameters()
    before = weight.clone(), bias.clone()
    masks = chosen.masks()
    assert all(m is not None for m in masks)
    adam = Adam([weight, bias], chosen.rates())
    for _ in range(3):
        adam.step([torch.ones_like(p) * m for p, m in zip((weight, bias), masks, strict=True)], 0.1)
    for p, old in zip((weight, bias), before, strict=True):
        moved = (p != old).reshape(len(p), -1).all(1)
        assert moved.tolist() == [False, True, False, False]
        assert torch.equal(p[0], old[0]) and torch.equal(p[2:], old[2:])


def test_an_itu_material_begins_with_its_constants():
    chosen = select(cups(), ["/Wall.surface.eps_r"], frequency=2.4e9)
    surface = chosen.base.node("/Wall").body.surface
    at = torch.tensor([2.4e9], dtype=torch.float64)
    torch.testing.assert_close(
        surface.medium.permittivity(at), media.complex_permittivity("concrete", at)
    )
    assert "from ITU concrete at 2.4 GHz" in chosen.table()


def test_constants_stay_passive():
    scene = room_with(thing(Slab(thickness_m=0.1, eps_r=1.5, sigma=0.01)))
    chosen = select(scene, ["/thing.surface"])
    with torch.no_grad():
        for p in chosen.parameters():
            p.sub_(9.0)
    chosen.clamp()
    assert [p.item() for p in chosen.parameters()] == [1.0, 0.0]


def test_a_turn_is_rigid_and_has_its_derivative():
    turn = torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64, requires_grad=True)
    r = rotation(turn)
    torch.testing.assert_close(r @ r.mT, torch.eye(3, dtype=torch.float64))
    about_z = rotation(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    x, y, _ = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(about_z @ x, y)
    assert torch.autograd.gradcheck(rotation, (turn,))
    assert torch.autograd.gradcheck(rotation, (torch.zeros_like(turn).requires_grad_(),))


def test_rates_by_pattern():
    chosen = select(cups(), ["/Cups/A.surface.s", "power"])
    assert chosen.rates({"*.s": 3.0}) == [3.0, 100.0]
    with pytest.raises(LearnError, match="expected a pattern over what is learned"):
        chosen.rates({"*.eps_r": 3.0})


def test_adam_takes_the_steps_of_torch():
    generator = torch.Generator().manual_seed(0)
    mine = torch.nn.Parameter(torch.randn(4, generator=generator, dtype=torch.float64))
    theirs = torch.nn.Parameter(mine.detach().clone())
    adam, reference = Adam([mine], [2.0]), torch.optim.Adam([theirs], lr=0.02)
    for _ in range(20):
        gradient = torch.randn(4, generator=generator, dtype=torch.float64)
        theirs.grad = gradient.clone()
        reference.step()
        adam.step([gradient], 0.01)
    torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=0.0)
    again = Adam([mine], [2.0])
    again.load(adam.tensors())
    found, kept = again.tensors(), adam.tensors()
    assert int(found["steps"]) == 20 and all(torch.equal(found[k], kept[k]) for k in kept)
