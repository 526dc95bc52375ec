"""Maps by rays refine round by round: unbiased, the same whatever comes after, as exact as they say."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer.cells import grid_on
from rfsg.tracer.montecarlo import COPIES, estimate_power
from rfsg.tracer.plan import Quality
from rfsg.tracer.radiomap import RadioMap, radio_map
from rfsg.tracer.rounds import Rounds
from rfsg.tracer.tally import Tally, in_db
from tests.scenes import radio, room, room_nodes

QUALITY = Quality(depth=1, map_rays=8_000, floor_db=-100.0)
OPTIONS = dict(bounds=(0.0, 0.0, 6.0, 4.0), cell=1.0, quality=QUALITY)


def test_the_tally_is_mean_and_scatter_of_all_rounds_at_once():
    """The plain twin: all rounds kept, then summed up."""
    draw = torch.Generator().manual_seed(3)
    owner = torch.tensor([0, 0, 1, 1, 1, 2])
    area = torch.rand(6, dtype=torch.float64, generator=draw) + 0.1
    collected = torch.rand(7, 6, dtype=torch.float64, generator=draw)
    collected[:, 5] = 0.0
    tally = Tally(area, owner, 3)
    for one in collected:
        tally.add(one)
    whole = torch.zeros(3).double().index_add(0, owner, area)

    def over_cells(value):
        return torch.zeros(3).double().index_add(0, owner, value * area) / whole

    density, n = collected / area, len(collected)
    means = torch.stack([over_cells(d) for d in density])
    assert torch.allclose(tally.mean, means.mean(0), rtol=1e-14)
    assert torch.allclose(tally.standard_error(), means.std(0) / n**0.5, rtol=1e-12)
    noise = over_cells(density.var(0) / n)
    spread = over_cells((density.mean(0) - means.mean(0)[owner]) ** 2) - noise
    expected = torch.sqrt(means.var(0) / n + spread.clamp(min=0.0))
    assert torch.allclose(tally.deviation(), expected, rtol=1e-12)
    assert in_db(tally.deviation(), tally.mean)[2] == torch.inf


def watched(**options) -> tuple[RadioMap, list[RadioMap]]:
    seen: list[RadioMap] = []
    return radio_map(room(), 2.4e9, progress=seen.append, **OPTIONS | options), seen


def test_a_map_after_n_rounds_is_the_mean_of_n_turned_lattices(monkeypatch):
    monkeypatch.setattr("rfsg.tracer.radiomap.MOST_ROUNDS", 11)
    found, seen = watched(error_db=1e-9)
    # nobody is told of a first round, which has no error
    assert len(seen) == 10 and "in 11 turned lattices" in found.modelled[0]
    assert "1e-09 dB asked for" in found.warnings[-1]
    assert torch.equal(found.path_gain, seen[-1].path_gain)
    plain = radio_map(room(), 2.4e9, **OPTIONS)
    assert torch.equal(plain.path_gain, seen[COPIES - 2].path_gain)
    assert torch.equal(plain.error_db, seen[COPIES - 2].error_db)
    # what each round adds to n times the mean is a power
    totals = torch.stack([(k + 2) * m.path_gain for k, m in enumerate(seen)])
    assert float((totals[1:] - totals[:-1]).min() / totals[0].max()) > -1e-12


def test_rounds_agree_with_reception_spheres_of_as_many_rays():
    """Both shoot the same lattices; a cell's mean holds the sphere in its middle."""
    scene = room(receivers=((3.5, 1.5, 1.2),))
    quality = Quality(depth=1, map_rays=60_000, floor_db=-100.0)
    power, error = estimate_power(scene, 2.4e9, quality, radius=0.4, branching="enumerate")
    found = radio_map(scene, 2.4e9, **OPTIONS | {"quality": quality})
    cell = found.path_gain[0, 1, 3]
    deviation = float(cell) * (10 ** (float(found.error_db[0, 1, 3]) / 10) - 1)
    assert abs(float(cell - power[0, 0])) < 3 * (deviation + float(error[0, 0]))


def test_an_error_asked_for_is_reached_with_more_rounds():
    plain = radio_map(room(), 2.4e9, **OPTIONS)
    goal = 0.6 * plain.current_error_db()
    found, seen = watched(error_db=goal)
    assert found.current_error_db() <= goal < seen[-2].current_error_db()
    assert len(seen) + 1 > COPIES
    easy, seen = watched(error_db=50.0)
    assert len(seen) + 1 == COPIES and torch.equal(easy.path_gain, plain.path_gain)


def test_a_spent_budget_still_leaves_an_error():
    found, seen = watched(budget_s=1e-9)
    assert len(seen) == 1 and "in 2 turned lattices" in found.modelled[0]
    assert 0.0 < found.current_error_db() < torch.inf


def test_where_nothing_arrives_nothing_scatters():
    nobody = radio_map(Scene(()), 2.4e9, **OPTIONS)
    assert nobody.path_gain.shape == (0, 4, 6) and nobody.current_error_db() == 0.0
    exact = radio_map(room(), 2.4e9, method="paths", **OPTIONS)
    assert exact.scatter_db is None and exact.current_error_db() == 0.0


@pytest.mark.parametrize("wrong", [{"budget_s": 0.0}, {"error_db": -1.0}, {"budget_s": torch.inf}])
def test_wrong_ends_are_refused(wrong):
    with pytest.raises(SceneError, match=next(iter(wrong))):
        radio_map(room(), 2.4e9, **OPTIONS, **wrong)
    with pytest.raises(SceneError, match="goes with method 'rays'"):
        radio_map(room(), 2.4e9, **OPTIONS, method="paths", budget_s=1.0)


@pytest.mark.slow
def test_a_map_of_many_cells_does_not_depend_on_the_portions(monkeypatch):
    options = dict(bounds=(0.0, 0.0, 6.0, 4.0), cell=0.05, quality=Quality(depth=1))
    maps = []
    for portion in (4096, 1111):
        monkeypatch.setattr("rfsg.tracer.radiomap.RECEIVERS_AT_ONCE", portion)
        maps.append(radio_map(room(), 2.4e9, method="paths", **options).path_gain)
    assert torch.allclose(*maps, rtol=1e-12, atol=0.0)
    images = radio_map(room(), 2.4e9, method="images", **options).path_gain
    assert torch.allclose(images, maps[0], rtol=1e-10, atol=0.0)


@torch.no_grad()
def test_lattices_that_fly_together_are_those_that_fly_alone():
    """Two transmitters and a rough slab, so that dice are thrown: company changes nothing."""
    slab = Slab(0.2, eps_r=5.24, sigma=0.05, scattering=Scattering(0.6))
    rough = Node("/rough", Body(Box((1.0, 0.1, 1.0)), slab), Pose.at(3.0, 3.0, 1.0))
    senders = (radio("/tx0", 1.3, 2.1, 1.7), radio("/tx1", 4.6, 1.2, 1.1))
    scene = Scene((*room_nodes(), rough), senders, (), 2.4e9)
    quality = Quality(depth=2, diffuse=1, map_rays=4_000, floor_db=-100.0)
    world, frequency = World(scene), torch.tensor([2.4e9], dtype=torch.float64)
    cells = grid_on(Pose.at(0.0, 0.0, 1.2), (0.0, 0.0, 6.0, 4.0), 1.0)
    alone, together = (Rounds(world, frequency, quality, 7, cells) for _ in range(2))
    for _ in range(5):
        alone.add()
    together.add(2)
    together.add(3)
    assert together.count == alone.count == 5
    for one, other in zip(alone.summary(), together.summary(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=0)
    assert not torch.equal(*together.summary()[0])
