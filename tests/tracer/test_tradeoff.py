"""Settings compared: the differences against closed forms, the front, the time, and a run on a room."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rfsg import plot
from rfsg.objects.shapes.band import WAYS
from rfsg.objects.shapes.kept import BAKE_AFTER
from rfsg.plot_tradeoff import LEAST_ERROR_DB, drawn_error_db, tradeoff_figure
from rfsg.tracer import tradeoff as measuring
from rfsg.tracer.compared import Difference, difference, first_arrival, missed, see
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from rfsg.tracer.tradeoff import Outcome, recommend, settings, tradeoff, with_front
from tests.scenes import room


@pytest.fixture(scope="module")
def thorough():
    return simulate(room(), None, Quality(depth=2))


def without(result, drop):
    """The result as if some of its paths had not been found."""
    keep = torch.nonzero(~drop).squeeze(-1)
    channel = result.channel
    names = ("tx", "rx", "delay", "gain", "doppler", "departure", "arrival", "blocked")
    kept = {name: getattr(channel, name)[keep] for name in names}
    none = channel.crossed[:0]
    return replace(
        result, paths=result.paths.take(keep), channel=replace(channel, crossed=none, **kept)
    )


def test_a_simulation_does_not_differ_from_itself(thorough):
    assert difference(see(thorough), see(thorough)) == Difference(0, 0, 0, 0, 0, 0)


def test_the_missed_share_is_that_of_the_paths_left_out(thorough):
    """Without the second reflections: the mean over links of their share of the power."""
    second = (thorough.paths.which >= 0).sum(1) == 2
    power = thorough.channel.gain[:, 0].abs() ** 2
    shares = [
        float(
            power[second & (thorough.channel.rx == r)].sum() / power[thorough.channel.rx == r].sum()
        )
        for r in range(4)
    ]
    found = difference(see(without(thorough, second)), see(thorough))
    assert found.missed == pytest.approx(np.mean(shares))
    assert missed(see(thorough), see(without(thorough, second))) == 0.0


def test_a_shallower_search_is_the_same_paths_less_the_deeper(thorough):
    """Depth 1 is depth 2 without its second reflections, by every measure."""
    second = (thorough.paths.which >= 0).sum(1) == 2
    cut, shallow = without(thorough, second), simulate(room(), None, Quality(depth=1))
    one, other = (difference(see(r), see(thorough)) for r in (cut, shallow))
    assert vars(one) == pytest.approx(vars(other), rel=1e-9)


def test_the_first_arrival_is_the_straight_line(thorough):
    """In an empty room nothing is in the way: distance over c."""
    tx = thorough.scene.transmitters[0].position
    far = torch.stack([r.position for r in thorough.scene.receivers])
    expected = (far - tx).norm(dim=-1) / 299_792_458.0
    assert torch.allclose(first_arrival(thorough.channel, 1, 4)[0], expected, rtol=1e-12)


def test_a_link_that_hears_nothing(thorough):
    """Infinite error of path gain, no error of delays: there is nothing to compare."""
    deaf = without(thorough, thorough.channel.rx == 2)
    found = difference(see(deaf), see(thorough))
    assert found.gain_most_db == math.inf and found.gain_db == 0.0
    assert found.missed == pytest.approx(0.25) and found.arrival_ns == 0.0
    assert see(deaf).arrival[0, 2] == math.inf


# the front


def outcome(name, seconds, error_db, peak=100.0):
    difference = Difference(error_db, error_db, error_db, 0.1, 1.0, 1.0)
    return Outcome(name, {}, seconds, 1, peak, 5, True, difference, 0.0)


def test_nothing_beats_what_is_on_the_front():
    draw = np.random.default_rng(0)
    found = with_front([outcome(str(k), *draw.random(2).tolist()) for k in range(50)])
    assert [o.seconds for o in found] == sorted(o.seconds for o in found)
    for one in found:
        beaten = any(
            o.seconds <= one.seconds and o.error.gain_90_db <= one.error.gain_90_db
            for o in found
            if o is not one
        )
        assert one.front is not beaten


def test_the_quickest_that_is_accurate_enough_is_recommended():
    found = [outcome("quick", 1.0, 3.0), outcome("right", 2.0, 0.9), outcome("slow", 9.0, 0.1)]
    assert recommend(found, 1.0) == "right"
    assert recommend(found, 5.0) == "quick"
    assert recommend(found, 0.01) is None


def test_settings_change_one_field_and_never_repeat_the_base():
    base = Quality(depth=2)
    small, full = (dict(settings(base, grid)) for grid in ("small", "full"))
    assert small["base"] == base and all(q != base for n, q in small.items() if n != "base")
    assert set(small) < set(full)
    assert small["depth 4"] == replace(base, depth=4) and "depth 2" not in small


def test_the_ways_to_meet_a_shape_are_asked_where_one_is_learned():
    """All by as many rays, so that only the way differs; the march on the network by one fewer."""
    base = Quality()
    learned, planar = (dict(settings(base, "small", learned)) for learned in (True, False))
    extra = [learned[name] for name in learned if name not in planar]
    assert {q.intersection for q in extra} == set(WAYS)
    assert {q.rays for q in extra} == {BAKE_AFTER - 1, BAKE_AFTER}
    assert all(q.search == "rays" for q in extra)


@pytest.mark.parametrize("base", [Quality(), Quality.named("draft"), Quality(search="rays")])
def test_what_is_expected_to_be_quick_comes_first(base):
    (name, first), *rest = settings(base, "full")
    assert name == "base" and first == base and measuring.times(base, base) == 1.0
    expected = [measuring.times(quality, base) for _, quality in rest]
    assert expected == sorted(expected)


def test_more_of_a_field_that_costs_is_expected_to_take_longer():
    base = Quality(diffraction=1)
    for name in measuring.DEARER:
        more = replace(base, **{name: getattr(base, name) + 1})
        assert measuring.times(more, base) == pytest.approx(measuring.DEARER[name])
        assert measuring.times(base, more) == pytest.approx(1.0 / measuring.DEARER[name])
    assert measuring.times(replace(base, search="rays", rays=measuring.RAYS_ALIKE), base) == 2.0


# a run


def test_a_room_within_its_time():
    """The reference has no error; equal settings are run once; the recommended one is accurate."""
    scene = room(receivers=((3.31, 0.71, 1.93),))
    found = tradeoff(scene, base=Quality(depth=2), budget_s=8.0)
    by_name = {o.setting: o for o in found.outcomes}
    truth = by_name[found.reference]
    assert vars(truth.error) == {name: 0.0 for name in vars(truth.error)}
    assert by_name["base"].moved_db == 0.0 if "base" in by_name else found.left_out
    assert any("crossing_samples 4: the same as" in sentence for sentence in found.left_out)
    if found.recommended is not None:
        assert by_name[found.recommended].error.gain_90_db <= found.accuracy_db
    assert found.reference in found.sentence()


class Clock:
    """Every stage of every simulation takes a second."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now

    def run(self, scene, frequency, quality, **options):
        for stage in ("search", "solve", "field"):
            options["progress"](stage)
            self.now += 1.0
        return simulate(scene, frequency, Quality(depth=1))


def test_what_would_take_too_long_is_left_out_alone(monkeypatch):
    """A setting that does not fit keeps none of those after it from being run."""
    clock = Clock()
    monkeypatch.setattr(measuring, "time", clock)
    dear = Quality(depth=2, diffraction=2)
    offered = [
        ("base", Quality(depth=2)),
        ("dear", dear),
        ("cheap", Quality(depth=2, floor_db=-30.0)),
    ]
    monkeypatch.setattr(measuring, "settings", lambda *_: offered)
    scene = room(receivers=((3.31, 0.71, 1.93),))
    found = tradeoff(scene, base=Quality(depth=2), budget_s=60.0, run=clock.run)
    assert {"base", "cheap"} <= {o.setting for o in found.outcomes}
    assert any(s.startswith("dear: would take some 2.4e+02 s") for s in found.left_out)


@pytest.mark.parametrize("budget", [20.0, 40.0])
def test_no_time_is_spent_beyond_the_budget(monkeypatch, budget):
    """A setting under way is left at its next stage; what was not run is named."""
    clock = Clock()
    monkeypatch.setattr(measuring, "time", clock)
    found = tradeoff(room(receivers=((3.31, 0.71, 1.93),)), budget_s=budget, run=clock.run)
    assert clock.now <= budget + 1.0
    assert all(o.runs == 1 and o.seconds == 3.0 for o in found.outcomes)
    assert any("time" in sentence for sentence in found.left_out)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"grid": "huge"}, "expected small or full"), ({"budget_s": 0.0}, "budget_s=0")],
)
def test_what_makes_no_sense_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        tradeoff(room(), **options)


def test_too_little_time_for_anything(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(measuring, "time", clock)
    with pytest.raises(ValueError, match="not even the cheapest"):
        tradeoff(room(), budget_s=1e-3, run=clock.run)


def test_the_picture_names_the_recommended_setting(tmp_path):
    outcomes = with_front(
        [outcome("a", 1.0, 3.0), outcome("b", 2.0, 0.0, None), outcome("c", 1.5, math.inf)]
    )
    found = measuring.Tradeoff(room(), 1e9, 4, "b", True, 1.0, outcomes, (), "a")
    figure = tradeoff_figure(found, "a title")
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert "a" in texts and "b" in texts
    assert plot.save(figure, tmp_path / "t.png").stat().st_size > 1000
    assert drawn_error_db(outcomes[-1], 6.0) == LEAST_ERROR_DB
    assert drawn_error_db(outcome("d", 1.0, math.inf), 6.0) == 6.0
