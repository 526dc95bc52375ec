"""Two searches, one answer: sequences enumerated against rays launched."""

from dataclasses import replace

import pytest
import torch

from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer import candidates
from rfsg.tracer.candidates import numbered
from rfsg.tracer.columns import columns
from rfsg.tracer.embree import Proxies
from rfsg.tracer.lattice import fibonacci, rounds
from rfsg.tracer.launch import SearchReport, search, turned
from rfsg.tracer.places import Places
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Chains
from rfsg.tracer.simulate import simulate
from tests.laws.test_simulation_laws import furnished
from tests.scenes import radio, room, vector

QUALITY = Quality(depth=2, rays=8000, floor_db=-100.0)


def _planar_paths(result):
    flat = {i for i, n in enumerate(result.scene.nodes) if n.body.shape.kind == "box"}
    out = set()
    for p in range(len(result.paths.tx)):
        chain = tuple(w for w in result.paths.which[p].tolist() if w >= 0)
        if set(chain) <= flat:
            ends = (int(result.paths.tx[p]), int(result.paths.rx[p]))
            out.add((*ends, chain, round(float(result.paths.length[p]), 7)))
    return out


def test_rays_find_nothing_that_the_enumeration_misses():
    scene = furnished()
    every = simulate(scene, quality=replace(QUALITY, search="enumerate"))
    rays = simulate(scene, quality=replace(QUALITY, search="rays"))
    assert every.search.complete and not rays.search.complete
    all_of_them, some = _planar_paths(every), _planar_paths(rays)
    assert some <= all_of_them
    assert len(some) > 0.95 * len(all_of_them)


def test_rays_find_the_whole_room():
    """The issue's box room to depth three, by launched rays alone."""
    result = simulate(room(), quality=Quality(search="rays", floor_db=-200.0))
    assert torch.bincount(result.paths.rx).tolist() == [63] * 4


# launched rays: receivers in a tree, the side with fewer radios, in rounds


def found_by(scene: Scene, quality: Quality) -> tuple[Chains, SearchReport]:
    world = World(scene)
    ends = (torch.stack([r.position for r in x]) for x in (scene.transmitters, scene.receivers))
    return search(world, Proxies(world), *ends, torch.tensor([2.4e9]).double(), quality)


def as_set(chains: Chains, back: bool = False) -> set[tuple]:
    """Links and (node, patch) sequences, read from the other end if ``back``."""
    out = set()
    for tx, rx, which, patch in zip(chains.tx.tolist(), chains.rx.tolist(), chains.which.tolist(),
                                    chains.patch.tolist(), strict=True):  # fmt: skip
        steps = [(w, p) for w, p in zip(which, patch, strict=True) if w >= 0]
        out.add(((rx, tx), *steps[::-1]) if back else ((tx, rx), *steps))
    assert len(out) == len(chains.tx)
    return out


def crowd(count: int) -> Scene:
    """The furnished room with many receivers."""
    generator = torch.Generator().manual_seed(2)
    places = 0.1 + torch.rand(count, 3, generator=generator).double() * vector(5.8, 3.8, 2.8)
    receivers = tuple(radio(f"/r{k}", *p) for k, p in enumerate(places.tolist()))
    return replace(furnished(), receivers=receivers)


def swapped(scene: Scene) -> Scene:
    return replace(scene, transmitters=scene.receivers, receivers=scene.transmitters)


RAYS = replace(QUALITY, search="rays", rays=4000)


def test_chains_are_those_of_asking_every_receiver(monkeypatch):
    scene = crowd(60)
    chains, report = found_by(scene, RAYS)

    def plain(self, cones, most):
        tube = torch.arange(len(cones)).repeat_interleave(len(self))
        place = torch.arange(len(self)).repeat(len(cones))
        miss = cones.miss(tube, columns(self.point[place]))
        yield tube[miss < most], place[miss < most], miss[miss < most]

    monkeypatch.setattr(Places, "within", plain)
    monkeypatch.setattr(candidates, "GATHERED", 100)
    expected, plainly = found_by(scene, RAYS)
    assert as_set(chains) == as_set(expected) and len(chains.tx) > 1000
    assert (report.rays, report.once) == (plainly.rays, plainly.once)


def test_each_chain_is_seeded_by_the_closest_ray():
    """Its ray's last stretch passes the receiver nearer than any other ray's of that sequence."""
    scene = room()
    chains, _ = found_by(scene, replace(RAYS, depth=1, rays=400))
    best = {}
    for r, receiver in enumerate(scene.receivers):
        for c in torch.nonzero((chains.rx == r) & (chains.which[:, 0] >= 0)).squeeze(-1).tolist():
            best[(r, int(chains.which[c, 0]))] = chains.seed[c, 0], receiver.position
    source, direction = scene.transmitters[0].position, fibonacci(400)
    assert len(best) == 24
    inner = {
        "x0": (0, 0.0),
        "x1": (0, 6.0),
        "y0": (1, 0.0),
        "y1": (1, 4.0),
        "z0": (2, 0.0),
        "z1": (2, 3.0),
    }
    for (_, node), (seed, target) in best.items():
        axis, place = inner[scene.nodes[node].path[1:]]
        t = (place - source[axis]) / direction[:, axis]
        point = source + t[:, None] * direction
        others = [k for k in range(3) if k != axis]
        size = vector(6.0, 4.0, 3.0)[others]
        on = (t > 0) & ((point[:, others] > 0) & (point[:, others] < size)).all(1)
        out = direction.clone()
        out[:, axis] = -out[:, axis]
        away = target - point
        along = (away * out).sum(-1)
        angle = torch.sqrt((away * away).sum(-1) - along**2) / (t + along)
        closest = torch.where(on & (along > 0), angle, torch.inf).argmin()
        torch.testing.assert_close(seed, point[closest], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("how", ["rays", "enumerate"])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_both_ways_of_a_link_have_the_same_chains(how, count):
    """Two transmitters, and fewer, as many or more receivers: the rays start where the fewer are."""
    scene = crowd(count)
    quality = replace(RAYS, search=how, floor_db=-200.0)
    (there, report), (back, reversed_) = (found_by(s, quality) for s in (scene, swapped(scene)))
    assert as_set(there) == as_set(back, back=True)
    if how == "rays":
        assert report.asked == reversed_.asked == min(2, count) * quality.rays
        assert {report.launched_from, reversed_.launched_from} == {"transmitters", "receivers"}
        assert count == 2 or (report.launched_from == "receivers") == (count < 2)


def test_either_side_finds_the_whole_room(monkeypatch):
    """What the receivers' rays find, the transmitter's find too: all 63 paths of each link."""
    few = replace(room(), receivers=room().receivers[:1])
    many = replace(few, transmitters=(*few.transmitters, radio("/t1", 5.1, 0.7, 2.2)))
    quality = Quality(search="rays", floor_db=-200.0)
    sides = []
    for back in (False, True):
        monkeypatch.setattr("rfsg.tracer.launch._from_receivers", lambda *_, back=back: back)
        result = simulate(many, quality=quality)
        assert result.search.asked == (1 if back else 2) * quality.rays
        sides.append(sorted(result.paths.length.tolist()))
        assert torch.bincount(result.paths.tx).tolist() == [63, 63]
    assert sides[0] == pytest.approx(sides[1], rel=1e-12)


def test_turned_chains():
    which = torch.tensor([[3, 1, 2], [4, 5, -1], [-1, -1, -1]])
    seed = torch.arange(27, dtype=torch.float64).reshape(3, 3, 3)
    seed = torch.where((which >= 0)[..., None], seed, 0.0)
    chains = Chains(torch.tensor([0, 1, 2]), torch.tensor([7, 8, 9]), which, 10 * which, seed)
    back = turned(chains)
    assert back.which.tolist() == [[2, 1, 3], [5, 4, -1], [-1, -1, -1]]
    assert back.tx.tolist() == [7, 8, 9] and torch.equal(back.seed[0], seed[0].flip(0))
    again = turned(back)
    for name in ("tx", "rx", "which", "seed"):
        assert torch.equal(getattr(again, name), getattr(chains, name))


@pytest.mark.parametrize("scene", [room(), furnished(), swapped(furnished())])
def test_rounds_lose_nothing_but_what_the_report_admits(scene, monkeypatch):
    """Against the whole lattice at once, its twin: the same rays, if no round was the last."""
    quality = replace(QUALITY, depth=3, search="rays", rays=4000)
    chains, report = found_by(scene, quality)
    monkeypatch.setattr("rfsg.tracer.launch.rounds", lambda count: [slice(0, count, 1)])
    whole, at_once = found_by(scene, quality)
    lost = as_set(whole) - as_set(chains)
    assert at_once.rays == at_once.asked == report.asked
    assert [r.rays for r in at_once.rounds] == [at_once.rays]
    assert report.rays == sum(r.rays for r in report.rounds) <= report.asked
    if report.rays == report.asked:
        assert not lost
    assert len(lost) <= report.once + report.once_curved


def test_a_search_stops_when_a_round_finds_nothing_new():
    chains, report = found_by(room(), Quality(search="rays", rays=40_000, floor_db=-200.0))
    assert report.rays < report.asked == 40_000
    assert report.rounds[-1].found == 0 and all(r.found for r in report.rounds[:-1])
    assert sum(r.found for r in report.rounds) == 4 * 62  # with the direct one 63 paths a link
    assert report.once == 0
    said = report.sentence()
    assert f"{report.rays} of 40000 rays" in said and "may find 0 more" in said
    assert len(chains.tx) == report.candidates


def test_what_further_rays_find_is_what_was_said():
    """Over several lattices: as many rays again find no more new paths than one ray alone met."""
    scene, quality = crowd(8), replace(RAYS, curved=0)
    paths = as_set(found_by(scene, replace(quality, search="enumerate"))[0])
    said, found = 0, 0
    for rays in (301, 402, 503):
        chains, report = found_by(scene, replace(quality, rays=rays))
        more, _ = found_by(scene, replace(quality, rays=2 * rays))
        said += report.once
        found += len((as_set(more) - as_set(chains)) & paths)
    assert 0 < found <= said


def test_sequences_are_numbered_alike_if_they_are_alike():
    generator = torch.Generator().manual_seed(5)
    which, patch = (
        torch.randint(-1, 4, (500, 3), generator=generator),
        torch.randint(0, 3, (500, 3)),
    )
    number = numbered(which, patch)
    rows = [tuple(map(tuple, x)) for x in torch.stack([which, patch], -1).tolist()]
    assert (
        len(set(zip(rows, number.tolist(), strict=True)))
        == len(set(rows))
        == len(set(number.tolist()))
    )
    assert numbered(which[:0], patch[:0]).tolist() == []


def test_few_rays_are_one_round():
    assert len(rounds(400)) == 1 and len(rounds(600)) == 2 and len(rounds(10**6)) == 4


def test_lattice_is_even():
    direction = fibonacci(2000)
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(2000).double())
    assert float(direction.mean(0).norm()) < 1e-3
    nearest = (direction @ direction.T).fill_diagonal_(-1).amax(1).clamp(max=1.0).acos()
    spacing = (4 * torch.pi / 2000) ** 0.5
    assert float(nearest.min()) > 0.6 * spacing and float(nearest.max()) < 1.2 * spacing


def test_doppler_of_moving_radios():
    """A receiver leaving at v sees -f v / c on the line of sight; a transmitter approaching, +f v / c."""
    away = replace(radio("/r", 10.0, 0.0, 0.0), velocity=vector(3.0, 0.0, 0.0))
    result = simulate(Scene((), (radio("/t", 0.0, 0.0, 0.0),), (away,)), 3e9)
    assert float(result.channel.doppler[0]) == pytest.approx(-3e9 * 3.0 / 299_792_458.0, rel=1e-12)
    coming = replace(radio("/t", 0.0, 0.0, 0.0), velocity=vector(3.0, 4.0, 0.0))
    result = simulate(Scene((), (coming,), (radio("/r", 10.0, 0.0, 0.0),)), 3e9)
    assert float(result.channel.doppler[0]) == pytest.approx(3e9 * 3.0 / 299_792_458.0, rel=1e-12)


def test_doppler_of_a_moving_mirror():
    """A wall that approaches at v shortens the echo by 2 v per second at normal incidence."""
    scene = room(receivers=((2.0, 2.0, 1.5),), transmitter=(2.0, 2.0, 1.4))
    nodes = tuple(
        replace(n, velocity=vector(-1.0, 0, 0)) if n.path == "/x1" else n for n in scene.nodes
    )
    result = simulate(replace(scene, nodes=nodes), 2.4e9, Quality(depth=1))
    index = scene.index("/x1")
    p = int(torch.nonzero((result.paths.which == index).any(1))[0])
    u = result.paths.vertices[p, 1] - result.paths.vertices[p, 0]
    cosine = float(u[0] / u.norm())
    assert float(result.channel.doppler[p]) == pytest.approx(
        2 * cosine * 2.4e9 / 299_792_458.0, rel=1e-9
    )


def test_frequency_is_needed_and_quality_is_checked(monkeypatch):
    scene = replace(room(), frequency=None)
    with pytest.raises(SceneError, match="frequency"):
        simulate(scene)
    with pytest.raises(SceneError, match="frequency"):
        simulate(scene, -1.0)
    with pytest.raises(ValueError, match="draft, standard, reference"):
        simulate(scene, 1e9, "best")
    with pytest.raises(ValueError, match="dept"):
        Quality.named("draft", dept=2)
    monkeypatch.setattr("rfsg.tracer.sequences.MOST_PAIRS", 1000)
    with pytest.raises(ValueError, match="enumerate"):
        simulate(furnished(), 1e9, Quality(search="enumerate"))
    assert not simulate(furnished(), 1e9, Quality(depth=1, rays=500)).search.complete
