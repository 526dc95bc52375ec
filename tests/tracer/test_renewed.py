"""What an enumeration finds that follows only what is new: the new part of the whole, at less work."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.scene import Scene
from rfsg.scene.world import World
from rfsg.tracer import prefixes, renewed, sequences
from rfsg.tracer.embree import Proxies
from rfsg.tracer.launch import search
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Chains, Only
from rfsg.tracer.renewed import new_chains
from rfsg.tracer.simulate import positions
from tests.tracer import edited

FREQUENCY = torch.tensor([2.4e9], dtype=torch.float64)


def furnished(seed: int, receivers: int) -> Scene:
    kinds = ("metal", "slab", "ground")
    return edited.scene(seed, kinds, things=3, receivers=receivers, round_ones=False)


def question(scene: Scene) -> tuple[World, Tensor, Tensor]:
    tx, rx = (positions(r, "cpu") for r in (scene.transmitters, scene.receivers))
    return World(scene), tx, rx


def new(scene: Scene, nodes: list[int], receivers: list[int]) -> Only:
    """These things and receivers came."""
    marks = [torch.zeros(n, dtype=torch.bool) for n in (len(scene.nodes), len(scene.receivers))]
    for mark, rows in zip(marks, (nodes, receivers), strict=True):
        mark[rows] = True
    none = torch.zeros(len(scene.transmitters), dtype=torch.bool)
    return Only(marks[0], none, marks[1], none[:0])


def listed(chains: Chains) -> list[list[float]]:
    columns = (chains.tx[:, None], chains.rx[:, None], chains.which, chains.patch)
    return sorted(torch.cat([*columns, chains.seed.flatten(1)], 1).tolist())


@pytest.mark.parametrize("nodes", [[2], [0, 4], []])
@pytest.mark.parametrize("came", [[], [1], [0, 1, 2, 3]])  # none, one, all: the whole
@pytest.mark.parametrize("depth", [2, 3])
def test_it_is_the_new_part_of_the_whole(nodes: list[int], came: list[int], depth: int) -> None:
    scene = furnished(depth, receivers=4)
    world, tx, rx = question(scene)
    quality, only = Quality(depth=depth), new(scene, nodes, came)
    some = new_chains(world, tx, rx, FREQUENCY, quality, only)
    every, report = search(world, Proxies(world), tx, rx, FREQUENCY, quality)
    assert report.enumerated and some is not None
    wanted = ((every.which >= 0) & only.node[every.which]).any(1) | only.rx[every.rx]
    assert listed(some) == listed(every.take(wanted))
    assert bool(wanted.any()) == bool(nodes or came)
    # as seen from the other end, where the enumeration begins there too
    turned = new_chains(world, rx, tx, FREQUENCY, quality, replace(only, tx=only.rx, rx=only.tx))
    assert turned is not None
    assert len(turned.tx) == len(some.tx)


def test_it_is_not_asked_what_it_does_not_know() -> None:
    scene = furnished(1, receivers=2)
    only, standard = new(scene, [2], []), Quality(depth=2)
    everything = replace(only, tx=torch.ones_like(only.tx))
    empty = replace(scene, nodes=())
    for about, quality, some in (
        (empty, standard, new(empty, [], [0])),
        (scene, standard, everything),
        (scene, Quality(depth=1), only),
        (scene, Quality(depth=2, search="rays"), only),
        (scene, Quality(depth=2, floor_db=-3.0), only),
    ):
        assert new_chains(*question(about), FREQUENCY, quality, some) is None
    curved = scene.replaced("/thing0", Body(Sphere(0.2), Conductor()))
    assert new_chains(*question(curved), FREQUENCY, standard, new(curved, [2], [])) is None


def test_it_gives_up_where_the_whole_does(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = furnished(2, receivers=3)
    world, tx, rx = question(scene)
    quality, only = Quality(depth=3, search="enumerate"), new(scene, [2], [1])
    assert prefixes.TooMany is renewed.TooMany
    answered = []
    for most in torch.logspace(1, 6, 40).long().tolist():
        for module in (sequences, renewed):
            monkeypatch.setattr(module, "MOST_PAIRS", most)
        some = new_chains(world, tx, rx, FREQUENCY, quality, only)
        answered.append(some is not None)
        if some is None:
            continue
        search(world, Proxies(world), tx, rx, FREQUENCY, quality)  # raises where it gives up
    assert answered[-1] and not answered[0]
