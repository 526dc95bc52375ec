"""The lab that comes with rfsg: what the first issue promises of it, on its trained objects."""

import math
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.channel import coefficients
from rfsg.tracer.embree import Proxies
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests import shipped
from tests.scenes import radio, room_nodes
from tests.shipped import ASSETS

QUALITY = Quality(depth=2)


@pytest.fixture(scope="module")
def lab() -> Scene:
    scene = shipped.lab()
    return scene.with_receivers(scene.receivers[2::9])


@pytest.fixture(scope="module")
def result(lab):
    return simulate(lab, quality=QUALITY)


def test_the_lab_is_what_it_says(lab):
    assert {"/World/Cabinet", "/World/Person", "/World/Desk"} <= {n.path for n in lab.nodes}
    chairs = [n for n in lab.nodes if "Chair" in n.path]
    assert len(chairs) == 2 and chairs[0].body is chairs[1].body
    assert len(shipped.lab().receivers) >= 20
    assert sum(not n.body.shape.exact for n in lab.nodes) == 5


def test_search_is_complete_and_everything_is_finite(result):
    assert result.search.complete
    assert bool(torch.isfinite(result.channel.gain.abs()).all())
    assert bool((result.channel.gain.abs() > 0).all())
    learned = ~World(result.scene).exact
    reflecting = result.paths.which.clamp(min=0)
    assert int((learned[reflecting] & (result.paths.which >= 0)).any(1).sum()) > 10


def test_reciprocity_of_the_lab(lab, result):
    """Transmitter and receivers change places: no path gain changes by 1e-6."""
    swapped = replace(lab, transmitters=lab.receivers, receivers=lab.transmitters)
    back = simulate(swapped, quality=QUALITY)
    there, here = result.path_gain()[0, :, 0], back.path_gain()[:, 0, 0]
    assert bool(((there - here).abs() <= 1e-6 * there).all())


def test_neural_cabinet_against_the_box_it_was_learned_from():
    """Same known material: delays within 0.05 ns, reflections within 0.5 dB, one path per mirror."""
    cabinet = shipped.shape("cabinet")
    # the mesh (assets/sources): body x +-0.225, y +-0.45, z 0.06 to 1.40, on a plinth set back 4 cm
    box = Body(Box([0.225, 0.45, 0.67]), Conductor())
    walls = room_nodes((5.0, 4.0, 3.0))
    receivers = [(4.1, 0.8 + 0.3 * k, 0.5 + 0.15 * k) for k in range(8)]
    rx = tuple(radio(f"/r{k}", *p) for k, p in enumerate(receivers))
    tx = (radio("/t", 3.6, 3.1, 1.3),)
    found = []
    for node in (
        Node("/c", Body(cabinet, Conductor()), Pose.at(1.2, 1.9, 0.005, 10.0)),
        Node("/c", box, Pose.at(1.2, 1.9, 0.735, 10.0)),
    ):
        result = simulate(Scene((*walls, node), tx, rx, 2.44e9), quality=QUALITY)
        on = (result.paths.which == len(walls)).any(1)
        table: dict[tuple, list] = {}
        for p in torch.nonzero(on).squeeze(-1).tolist():
            key = (int(result.paths.rx[p]), tuple(result.paths.which[p].tolist()))
            table.setdefault(key, []).append(
                (float(result.channel.delay[p]), float(result.channel.gain[p, 0].abs()))
            )
        found.append({k: sorted(v) for k, v in table.items()})
    learned, exact = found
    assert len(exact) > 15
    # paths whose mirror point lies within a hand's breadth of an edge may differ: a learned edge is round
    common = exact.keys() & learned.keys()
    assert len(common) >= 0.9 * len(exact) and len(common) >= 0.9 * len(learned)
    for key in common:
        assert len(learned[key]) == len(exact[key])
        for (delay, gain), (true_delay, true_gain) in zip(learned[key], exact[key], strict=True):
            assert abs(delay - true_delay) <= 0.05e-9
            assert abs(20 * math.log10(gain / true_gain)) <= 0.5


def test_moving_the_cabinet_changes_exactly_what_it_should(lab, result):
    """Paths that neither touch nor cross the cabinet, before or after, are the same to 1e-12; every
    path that came or went does so because of the cabinet."""
    moved_scene = lab.moved("/World/Cabinet", (1.2, 0.0, 0.0))
    moved = simulate(moved_scene, quality=QUALITY)
    index = lab.index("/World/Cabinet")
    before, after = (_table(r, index) for r in (result, moved))
    same = [k for k in before.keys() & after.keys() if not before[k][1] and not after[k][1]]
    assert len(same) > 50
    for key in same:
        assert abs(before[key][0] - after[key][0]) <= 1e-12 * abs(before[key][0])
    changed = 0
    for here, there, other in ((before, after, moved), (after, before, result)):
        for key in here.keys() - there.keys():
            if not here[key][
                1
            ]:  # it does not touch the cabinet here, so over there it must be in the way
                assert _in_the_way(other, index, here[key][2])
            changed += 1
    assert changed > 5


def _table(result, index):
    value = coefficients(result.channel)[:, 0]
    crossing = set(result.channel.crossed[result.channel.crossed[:, 1] == index, 0].tolist())
    out = {}
    for p in range(len(result.paths.tx)):
        chain = tuple(w for w in result.paths.which[p].tolist() if w >= 0)
        key = (int(result.paths.rx[p]), chain, round(float(result.paths.length[p]), 8))
        out[key] = (complex(value[p]), index in chain or p in crossing, result.paths.vertices[p])
    return out


def _in_the_way(result, index, vertices):
    """Does the polyline cross the cabinet's box, where it stands in this result's scene?"""
    world = World(Scene((result.scene.nodes[index],)))
    from rfsg.tracer.records import Rays

    delta = vertices[1:] - vertices[:-1]
    length = delta.norm(dim=-1)
    keep = length > 0
    rays = Rays(vertices[:-1][keep], delta[keep] / length[keep, None], length[keep])
    return len(Proxies(world).spans(rays).ray) > 0


def test_gradients_reach_the_weights_of_a_learned_shape():
    """Length and power of a path that a neural face reflects, by its offset: autograd against
    central differences (a float32 weight, so the difference is exact and the rest float64)."""
    shape = load_asset(ASSETS / "objects" / "cabinet" / "cabinet.usda").body.shape
    node = Node("/c", Body(shape, Conductor()), Pose.at(1.2, 1.9, 0.005, 10.0))
    tx, rx = radio("/t", 3.6, 3.1, 1.3), radio("/r", 4.1, 1.1, 0.65)
    scene = Scene((node,), (tx,), (rx,), 2.44e9)
    quality = Quality(depth=1)
    chains = simulate(scene, quality=quality).chains
    offset = shape.to_value.bias.requires_grad_(True)

    def run(gradients: bool):
        result = simulate(scene, quality=quality, gradients=gradients, chains=chains)
        bounced = int(torch.nonzero((result.paths.which >= 0).any(1))[0])
        return torch.stack([result.paths.length[bounced], result.path_gain().sum() * 1e6])

    found = [torch.autograd.grad(y, offset, retain_graph=True)[0].item() for y in run(True)]
    h = 2.0**-12
    with torch.no_grad():
        offset += h
        above = run(False)
        offset -= 2 * h
        below = run(False)
        offset += h
    expected = ((above - below) / (2 * h)).tolist()
    assert abs(found[0]) > 0.1
    assert found == pytest.approx(expected, rel=1e-3)
