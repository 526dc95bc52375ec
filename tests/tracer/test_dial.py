"""The dial: what it estimates, what it chooses with a clock of our own, and whether it keeps its word."""

import importlib.util
import math
import sys
from pathlib import Path

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Cylinder
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.tracer import dial, ladder, representation
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.plan import PRESETS, Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, radio, room
from tests.tracer.shapes import Field, ball

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
LEVELS = [Quality(depth=d, diffraction=e) for d, e in ((1, 0), (2, 0), (3, 0), (3, 1), (5, 2))]


@pytest.fixture(scope="module")
def benchmark():
    """benchmarks/dial.py under a name of its own; its neighbour as it imports it itself."""
    sys.path.insert(0, str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("dial_benchmark", BENCHMARKS / "dial.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    sys.path.remove(str(BENCHMARKS))
    del sys.modules["random_scenes"]


def heard(*gains, links=1):
    """Responses that are the same at every link and in every draw."""
    return [torch.full((1, links, ladder.DRAWS), g, dtype=torch.complex128) for g in gains]


def db(ratio):
    return abs(20 * math.log10(ratio))


# the estimate


def test_difference_of_silence():
    """Nothing against nothing is no error; something against nothing an infinite one."""
    one, other = (torch.tensor(x, dtype=torch.complex128) for x in ([0, 0, 1, 10j], [0, 1, 0, 1]))
    assert ladder.difference_db(one, other).tolist() == [0.0, math.inf, math.inf, 20.0]


def test_an_error_at_nine_links_of_ten():
    """The higher of two neighbours: of ten links the ninth counts, of six all do."""
    error = torch.arange(10.0)[None, :, None]
    assert float(ladder.at_links(error)) == 8.0
    assert float(ladder.at_links(error[:, :6])) == 5.0


def test_nothing_remains_above_the_top():
    found = ladder.estimate(heard(1.0, 1.2, 1.1, 1.15, 1.16), LEVELS, complete=True)
    assert found[-1] == 0.0
    assert found == pytest.approx([db(g / 1.16) for g in (1.0, 1.2, 1.1, 1.15, 1.16)])


def test_unknown_before_a_step_of_each_kind():
    """Without a step round an edge nobody knows what edges do."""
    for count in (1, 2, 3):
        assert math.isinf(min(ladder.estimate(heard(*[1.0] * count), LEVELS, complete=False)))
    assert ladder.estimate(heard(1.0, 1.0, 1.0, 1.0), LEVELS, complete=False) == [0.0] * 4


@pytest.mark.parametrize("shrinks", [0.3, 0.4, 0.5])
def test_a_geometric_series_is_extrapolated_to_its_end(shrinks):
    """Steps of s, s r, s r^2, ... dB from depth to depth: what remains is the rest of the series."""
    steps = [4.0 * shrinks**k for k in range(30)]
    gains = [10 ** (sum(steps[:k]) / 20) for k in range(3)] + [10 ** (sum(steps[:2]) / 20)]
    found = ladder.estimate(heard(*gains), LEVELS, complete=False)
    ends = sum(steps)
    assert found[0] == pytest.approx(ends)
    assert found[2] == pytest.approx(ends - sum(steps[:2]))


def test_a_link_that_a_higher_rung_alone_hears_is_an_infinite_error():
    silent, loud = heard(0.0, 1.0)
    found = ladder.estimate([silent, loud, loud, loud, loud], LEVELS, complete=True)
    assert found == [math.inf, 0.0, 0.0, 0.0, 0.0]


# the ladder


def test_planes_alone_are_not_searched_by_rays():
    """Two curved reflections are none where nothing is curved, and the search may be complete."""
    asked = ladder.effective(PRESETS["reference"], room())
    assert asked.curved == 1 and asked.depth == 5 and asked.diffraction == 2
    assert simulate(room(), None, ladder.effective(Quality(curved=2), room())).search.complete


def test_what_has_no_effect_is_none():
    """The setting in effect gives the very channel of the setting asked for."""
    scene = room(receivers=((3.31, 0.71, 1.93),))
    asked = Quality(depth=2, zone_rings=5, crossing_samples=3, refraction=False, curved_depth=7)
    one, other = (simulate(scene, None, q) for q in (asked, ladder.effective(asked, scene)))
    assert torch.equal(one.channel.gain, other.channel.gain)


def test_the_ladder_of_a_scene_has_each_setting_once_and_ends_at_reference():
    round_thing = Node("/c", Body(Cylinder(0.2, 0.5), Conductor()), Pose.at(2.0, 2.0, 1.0))
    flat, curved = room(), Scene((*room().nodes, round_thing), frequency=2.4e9)
    for scene in (flat, curved):
        rungs = ladder.ladder(scene)
        assert len({r.quality for r in rungs}) == len(rungs)
        assert rungs[-1].name == "reference"
        assert rungs[-1].quality == ladder.effective(PRESETS["reference"], scene)
    assert len(ladder.ladder(flat)) < len(ladder.ladder(curved))


def test_pilots_are_spread_and_the_same_for_a_seed():
    """On a line of receivers the two ends are among them; few receivers are all taken."""
    line = room(receivers=tuple((0.1 * k + 0.2, 1.0, 1.0) for k in range(40)))
    chosen = dial.pilots(line, 6, seed=3)
    assert chosen == dial.pilots(line, 6, seed=3) and len(set(chosen)) == 6
    assert {0, 39} <= set(chosen)
    assert dial.pilots(room(), 6) == [0, 1, 2, 3]


# the choice, with a clock of our own


class Clock:
    """Time passes only while something is simulated: so many seconds per receiver and rung."""

    def __init__(self, cost):
        self.now, self.cost, self.asked = 0.0, cost, []

    def perf_counter(self):
        return self.now

    def run(self, scene, frequency, quality, **options):
        k = (quality.depth, quality.diffraction)
        self.now += self.cost[k] * len(scene.receivers)
        self.asked.append((k, len(scene.receivers)))
        return simulate(scene, frequency, Quality(depth=min(k[0], 2)))


COST = {(1, 0): 1.0, (2, 0): 2.0, (3, 0): 3.0, (3, 1): 10.0, (5, 1): 15.0, (5, 2): 60.0}


@pytest.fixture
def clock(monkeypatch):
    found = Clock(COST)
    monkeypatch.setattr(dial, "time", found)
    return found


def wall_scene(receivers):
    """Two walls that face each other, receivers between them."""
    walls = tuple(box_node(f"/wall{y}", (0.0, y, 0.0), (5.0, 0.1, 5.0)) for y in (-3.0, 3.0))
    rx = tuple(radio(f"/rx{k}", 0.2 * k - 2.0, 1.0, 0.1) for k in range(receivers))
    return Scene(walls, (radio("/tx", 0.3, -1.0, 0.2),), rx, 2.4e9)


@pytest.mark.parametrize("receivers", [2, 20])
@pytest.mark.parametrize("budget", [1e-3, 10.0, 60.0, 200.0, 1e4])
def test_a_budget_is_kept_wherever_the_first_rung_fits(clock, receivers, budget):
    """There is always a result of all receivers, and what was left out is said."""
    result, choice = dial.within(wall_scene(receivers), budget_s=budget, run=clock.run)
    assert len(result.scene.receivers) == receivers
    assert clock.now <= max(budget, COST[1, 0] * receivers + COST[1, 0] * dial.TIMED)
    names = [rung.name for rung in ladder.ladder(result.scene)]
    left = names[names.index(choice.rung) + 1 :]
    assert [sentence.split(":")[0] for sentence in choice.left_out] == left
    assert set(choice.left_out) <= set(result.plan.left_out)
    assert choice.sentence() in result.plan.modelled


def test_time_enough_buys_reference(clock):
    _, choice = dial.within(wall_scene(20), budget_s=1e5, run=clock.run)
    assert choice.rung == "reference" and choice.error_db == 0.0 and not choice.left_out


def test_accuracy_takes_the_cheapest_rung_that_meets_it(clock):
    """The made-up channel is the same from depth 2 on, so that draft is as good as reference."""
    result, choice = dial.within(wall_scene(20), accuracy_db=0.1, run=clock.run)
    assert choice.rung == "draft" and choice.met and len(result.scene.receivers) == 20
    assert clock.asked[-1] == ((2, 0), 20)
    assert {count for _, count in clock.asked[:-1]} == {dial.PILOTS}


def test_learned_objects_are_met_in_a_way_that_the_accuracy_allows(clock):
    """Its share of the error is counted; the report has a line for every object."""
    scene, said = wall_scene(2), {}
    thing = Node(
        "/thing", Body(Field(ball(0.2), (0.3, 0.3, 0.3)), Conductor()), Pose.at(9.0, 0.0, 0.0)
    )
    scene = Scene((*scene.nodes, thing), scene.transmitters, scene.receivers, scene.frequency)

    def run(scene, frequency, quality, **options):
        said["way"] = quality.intersection
        return clock.run(wall_scene(2), frequency, quality, **options)

    result, choice = dial.within(scene, accuracy_db=0.1, run=run)
    assert said["way"] == representation.strictest(scene.nodes, SPEED_OF_LIGHT / 2.4e9, 0.025)
    assert said["way"] != "mesh" and choice.error_db >= 0.025
    assert sum(sentence.startswith("/thing: learned") for sentence in result.plan.modelled) == 1
    dial.within(scene, budget_s=100.0, run=run)
    assert said["way"] == "certain"


def test_where_all_receivers_are_pilots_nothing_is_run_twice(clock):
    """The highest rung tried is in hand: no cheaper one takes its place."""
    _, choice = dial.within(wall_scene(3), accuracy_db=0.1, run=clock.run)
    assert choice.rung == choice.tried[-1].rung
    assert len(clock.asked) == len(set(clock.asked)) == len(choice.tried)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({}, "give accuracy_db"),
        ({"accuracy_db": 0.0}, "accuracy_db=0.0"),
        ({"budget_s": math.inf}, "budget_s=inf"),
        ({"accuracy_db": 1.0, "chains": ()}, "chains of one"),
    ],
)
def test_what_makes_no_sense_is_refused(asked, words):
    with pytest.raises(ValueError, match=words):
        dial.simulate_within(room(), **asked)


def test_no_receivers_is_a_fault_of_the_scene():
    with pytest.raises(SceneError, match="a transmitter and a receiver"):
        dial.simulate_within(room(receivers=()), accuracy_db=1.0)


def test_gradients_reach_the_chosen_result():
    scene = wall_scene(2)
    place = scene.receivers[0].position.requires_grad_(True)
    result = dial.simulate_within(scene, accuracy_db=1.0, gradients=True)
    result.path_gain().sum().backward()
    assert place.grad is not None and bool((place.grad != 0).any())


# the promise


def kept(benchmark, seeds, receivers, kind=None, most_things=3):
    """Of some random scenes, how many have 90 % of links within 1 dB of reference."""
    rows = [
        benchmark.against_reference(benchmark.random_scene(seed, receivers, kind, most_things), 1.0)
        for seed in seeds
    ]
    return sum(row["true_db"] <= 1.0 for row in rows)


def test_the_promise_is_kept_on_some_scenes(benchmark):
    """A smaller one of the test below; scenes that no constant was chosen on."""
    assert kept(benchmark, range(2000, 2008), receivers=1, most_things=1) == 8


@pytest.mark.slow
def test_the_promise_is_kept_on_19_of_20_scenes(benchmark):
    """50 scenes, by turns with pilots and climbed as a whole."""
    found = kept(benchmark, range(1000, 1050, 2), 14) + kept(benchmark, range(1001, 1050, 2), 6)
    assert found >= 0.95 * 50


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cylinder", "learned"])
def test_the_promise_is_kept_beside_something_round(benchmark, kind):
    assert kept(benchmark, [1000], 3, kind) == 1
