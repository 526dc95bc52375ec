"""Simulating again after edits gives what a full run gives, and does no more than it must."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Scene
from rfsg.scene.world import World
from rfsg.tracer import diffraction, edges, incremental, solve, stages
from rfsg.tracer.embree import Proxies, brute_spans
from rfsg.tracer.implicit import segments
from rfsg.tracer.launch import search
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act, Chains, Only, Paths, Rays
from rfsg.tracer.simulate import positions, simulate
from tests.tracer import edited


@dataclass(frozen=True)
class Case:
    """A quality, materials, and how many edits of how many scenes."""

    quality: Quality
    kinds: tuple[str, ...]
    round_ones: bool = False
    learned: bool = False


PLAIN = ("metal", "slab", "ground")
CASES = {
    "mirrors": Case(Quality(), PLAIN),
    "edges": Case(Quality(depth=2, diffraction=1), PLAIN),
    "two edges": Case(Quality(depth=1, diffraction=2), PLAIN),
    "curved": Case(Quality(depth=2, diffraction=1), PLAIN, round_ones=True),
    "solids": Case(Quality(depth=2), ("solid", "metal", "slab"), round_ones=True),
    "rough": Case(Quality(depth=2, diffuse=2), ("rough", "metal", "slab")),
    "rays": Case(Quality(depth=2, search="rays", rays=1500), PLAIN, round_ones=True),
    "floor": Case(Quality(depth=3, floor_db=-30.0), PLAIN),
    "learned": Case(Quality(depth=2, curved_depth=1, diffraction=1), PLAIN, learned=True),
}


def follow(case: Case, seed: int, edits: int, receivers: int = 3) -> None:
    """Edits of one scene, each answered from the answer to the one before, and in full."""
    draw = np.random.default_rng(1000 + seed)
    options = {"round_ones": case.round_ones, "learned": case.learned, "receivers": receivers}
    scene = edited.scene(seed, case.kinds, **options)
    result = simulate(scene, quality=case.quality)
    for number in range(edits):
        name, scene = edited.edit(scene, draw, case.kinds, case.round_ones)
        result, full = simulate(scene, previous=result), simulate(scene, quality=case.quality)
        try:
            edited.assert_same(result, full)
        except AssertionError as wrong:
            raise AssertionError(f"seed {seed}, edit {number}: {name}: {wrong}") from wrong
        assert result.redone is not None


@pytest.mark.parametrize("name", [n for n in CASES if n not in ("two edges", "learned")])
def test_an_edit_gives_what_a_full_run_gives(name: str) -> None:
    follow(CASES[name], seed=0, edits=2, receivers=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", range(1, 6))
def test_edits_give_what_full_runs_give(name: str, seed: int) -> None:
    follow(CASES[name], seed, edits=5)  # 9 cases of 5 scenes: 225 edits in all


# what is done again, and what is not


def painted(scene: Scene, path: str) -> Scene:
    """The scene with another material on one thing."""
    return scene.replaced(
        path, Body(scene.node(path).body.shape, Slab(itu="wood", thickness_m=0.07))
    )


def furnished(receivers: int = 2) -> Scene:
    """A room with three things in it."""
    return edited.scene(3, PLAIN, receivers=receivers, round_ones=False)


def forbidden(*_: object, **__: object) -> None:
    raise AssertionError("geometry was touched")


def test_another_material_touches_no_geometry(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = furnished()
    result = simulate(scene)
    assert not result.search.pruned  # else the new material may lift sequences above the floor
    swapped = painted(scene, "/thing1")
    full = simulate(swapped)
    with monkeypatch.context() as patch:
        patch.setattr(stages, "search", forbidden)  # no candidate looked for,
        patch.setattr(solve, "_one_way", forbidden)  # no chain solved,
        patch.setattr(diffraction, "_exact", forbidden)  # no edge point,
        patch.setattr(edges, "is_free", forbidden)
        patch.setattr(incremental, "passages", forbidden)  # and no segment traced
        patch.setattr(Proxies, "spans", forbidden)
        again = simulate(swapped, previous=result)
    edited.assert_same(again, full)
    redone = again.redone
    assert redone is not None and not redone.searched
    assert (redone.solved, redone.diffracted, redone.traced) == (0, 0, 0)
    node = scene.index("/thing1")
    kept = result.kept
    assert kept is not None
    met = (kept.paths.which == node).any(1)
    met[kept.through.crossed[kept.through.crossed[:, 1] == node, 0]] = True
    assert redone.evaluated == int(met.sum()) > 0  # the field of what meets it, and of nothing else
    assert redone.kept == int((~met).sum()) > 0


def test_a_moved_thing_redoes_what_meets_it_alone() -> None:
    scene = furnished()
    result = simulate(scene)
    moved = scene.moved("/thing2", (0.4, 0.1, 0.0))
    again = simulate(moved, previous=result)
    redone, kept = again.redone, again.kept
    assert redone is not None and kept is not None
    node = scene.index("/thing2")
    met = (kept.paths.which == node).any(1)
    length, u = segments(kept.paths.vertices)
    path, segment = torch.nonzero(length > 0, as_tuple=True)
    rays = Rays(kept.paths.vertices[path, segment], u[path, segment], length[path, segment])
    for some in (scene, moved):
        spans = brute_spans(World(some), rays, torch.tensor([node]))
        met[path[spans.ray]] = True
    # an edge that the thing came near or went from is looked at anew, and nothing else beside
    assert redone.kept <= int((~met).sum())
    edge = (kept.paths.act == int(Act.DIFFRACT)).any(1)
    assert redone.kept >= int((~met & ~edge).sum())
    assert redone.searched and redone.diffracted > 0
    assert redone.solved < len(again.chains.tx) / 3


def test_nothing_changed_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    result = simulate(furnished())
    for name in ("passages", "channel"):
        monkeypatch.setattr(incremental, name, forbidden)
    again = result.after(furnished())  # other objects of the same content
    assert again.redone is not None and again.redone.kept == len(result.kept.paths.tx)
    edited.assert_same(again, result)


def test_going_on_takes_frequency_and_quality_along() -> None:
    result = simulate(furnished(1), frequency=3.1e9, quality="draft")
    again = result.after(result.scene.moved("/thing0", (0.1, 0.0, 0.0)))
    assert torch.equal(again.frequency, result.frequency)
    assert again.plan.quality == Quality.named("draft")
    assert again.redone is not None and again.redone.kept
    assert any(said.startswith("incremental: ") for said in again.plan.modelled)


@pytest.mark.parametrize("options", [{"frequency": 2.5e9}, {"quality": "draft"}])
def test_another_question_is_a_full_run(options: dict) -> None:
    scene = furnished(1)
    result = simulate(scene, quality=Quality(depth=1))
    again = simulate(scene, previous=result, **options)
    assert again.redone is not None and again.redone.kept == 0
    assert any("a full run" in said for said in again.plan.modelled)
    given = {"quality": Quality(depth=1), **options}
    edited.assert_same(again, simulate(scene, **given))


def test_what_was_changed_in_place_is_seen() -> None:
    scene = furnished()
    result = simulate(scene)
    node = scene.node("/thing0")
    with torch.no_grad():
        node.pose.translation.add_(0.2)  # as a fit does
        scene.node("/thing1").body.shape.half_size.mul_(1.1)
        scene.receivers[0].position.add_(0.1)
    again = simulate(scene, previous=result)
    edited.assert_same(again, simulate(scene))
    assert again.redone is not None and again.redone.solved > 0


def test_polarised_radios_keep_their_matrices() -> None:
    scene = furnished()
    slanted = [replace(r, polarization="cross") for r in scene.receivers]
    result = simulate(scene)
    crossed = scene.with_receivers(slanted)
    again = simulate(crossed, previous=result)
    edited.assert_same(again, simulate(crossed))
    assert again.channel.jones is not None
    moved = crossed.moved("/thing0", (0.0, 0.3, 0.0))
    third, full = simulate(moved, previous=again), simulate(moved)
    edited.assert_same(third, full)
    one, other = third.channel.jones, full.channel.jones
    assert one is not None and other is not None
    i, j = edited.in_order(third), edited.in_order(full)
    size = other[j].abs().amax((2, 3), keepdim=True)
    assert bool(((one[i] - other[j]).abs() <= 1e-9 * size).all())


@pytest.mark.parametrize("options", [{"accuracy_db": 1.0}, {"budget_s": 1.0}, {"gradients": True}])
def test_what_cannot_be_served_is_named(options: dict) -> None:
    result = simulate(furnished(1), quality=Quality(depth=0))
    with pytest.raises(ValueError, match=f"previous= beside {next(iter(options))}="):
        simulate(result.scene, previous=result, **options)


def test_two_things_of_one_name_are_not_told_apart() -> None:
    scene = furnished(1)
    result = simulate(scene, quality=Quality(depth=1))
    twice = replace(scene, nodes=(*scene.nodes, replace(scene.nodes[-1], pose=Pose.at(1, 1, 1))))
    again = simulate(twice, previous=result)
    assert any("names two things" in said for said in again.plan.modelled)
    edited.assert_same(again, simulate(twice, quality=Quality(depth=1)))


# the stages: restricted, they give what they would give, less what meets nothing marked


def marked(rows: torch.Tensor, of: torch.Tensor) -> torch.Tensor:
    return ((rows >= 0) & of[rows]).any(1)


@pytest.mark.parametrize("seed", range(3))
def test_a_restricted_search_is_a_part_of_the_whole(seed: int) -> None:
    scene = edited.scene(seed, PLAIN, things=3, receivers=4, round_ones=True)
    world, draw = World(scene), torch.Generator().manual_seed(seed)
    tx, rx = (positions(r, "cpu") for r in (scene.transmitters, scene.receivers))
    frequency, quality = torch.tensor([2.4e9], dtype=torch.float64), Quality(depth=2)
    only = Only(
        torch.rand(len(world), generator=draw) < 0.3,
        torch.rand(len(tx), generator=draw) < 0.1,
        torch.rand(len(rx), generator=draw) < 0.3,
        torch.zeros(0, dtype=torch.bool),
    )
    proxies = Proxies(world)
    every, _ = search(world, proxies, tx, rx, frequency, quality)
    some, report = search(world, proxies, tx, rx, frequency, quality, only)
    assert report.restricted
    wanted = marked(every.which, only.node) | only.tx[every.tx] | only.rx[every.rx]

    def listed(chains: Chains) -> list[list[float]]:
        columns = (chains.tx[:, None], chains.rx[:, None], chains.which, chains.patch)
        return sorted(torch.cat([*columns, chains.seed.flatten(1)], 1).tolist())

    assert listed(some) == listed(every.take(torch.nonzero(wanted).squeeze(-1)))


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_restricted_diffraction_is_a_part_of_the_whole(order: int) -> None:
    scene = edited.scene(5, PLAIN, things=3, receivers=3, round_ones=True)
    world, draw = World(scene), torch.Generator().manual_seed(order)
    tx, rx = (positions(r, "cpu") for r in (scene.transmitters, scene.receivers))
    wavelength, quality = 0.125, Quality(depth=2, diffraction=order)
    free = edges.edges_in(world, wavelength)
    only = Only(
        torch.rand(len(world), generator=draw) < 0.3,
        torch.zeros(len(tx), dtype=torch.bool),
        torch.rand(len(rx), generator=draw) < 0.4,
        torch.rand(len(free), generator=draw) < 0.2,
    )
    question = (world, free, tx, rx, wavelength, quality)
    every, some = (Paths.joined(diffraction.paths_of(*question, o).paths) for o in (None, only))
    bent = every.act == int(Act.DIFFRACT)
    mirrors = torch.where(bent, -1, every.which)
    on_edge = torch.where(bent, every.item, -1)
    wanted = marked(mirrors, only.node) | marked(on_edge, only.edge) | only.rx[every.rx]

    def listed(paths: Paths) -> list[list[float]]:
        ends = (paths.tx[:, None], paths.rx[:, None])
        return sorted(torch.cat([*ends, paths.which, paths.act, paths.item], 1).tolist())

    assert listed(some) == listed(every.take(torch.nonzero(wanted).squeeze(-1)))
