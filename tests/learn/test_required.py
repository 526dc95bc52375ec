"""The empty scene, its level where most readings are, and more only where held-out places ask for it."""

import numpy as np
import pytest
import torch

import rfsg
from rfsg.learn.baselines import Prediction, Readings
from rfsg.learn.free_space import FreeSpace, gain_db, location
from rfsg.learn.levels import Places
from rfsg.learn.losses import student
from rfsg.learn.mixture import IntervalPrediction
from rfsg.learn.required import EVERY, Required, better, bounds
from rfsg.scene.scene import Scene

GATEWAYS = np.array([[0.0, 0, 2], [12, 0, 2], [0, 9, 2]])


def links(count, seed=0):
    """Readings without values of ``count`` places at three gateways."""
    tx = np.random.default_rng(seed).uniform([1, 1, 1], [11, 8, 1.5], (count, 3))
    gateway = np.tile(np.arange(3), count)
    return Readings(tx.repeat(3, 0), GATEWAYS[gateway], gateway, np.zeros(3 * count))


def valued(links, rssi):
    return Readings(links.tx_position, links.rx_position, links.gateway, rssi)


def test_free_space_is_the_scene_without_objects():
    few = links(2)
    radios = [
        [rfsg.Radio.at(f"/World/{kind}{i}", *map(float, p)) for i, p in enumerate(places)]
        for kind, places in (("t", few.tx_position[::3]), ("r", GATEWAYS))
    ]
    scene = Scene((), tuple(radios[0]), tuple(radios[1]))
    gain = rfsg.simulate(scene, frequency=2.44e9, quality="draft").path_gain()[:, :, 0].flatten()
    ours = gain_db(few.tx_position, few.rx_position, 2.44e9)
    torch.testing.assert_close(torch.from_numpy(ours), 10 * torch.log10(gain), rtol=0, atol=1e-9)


def test_the_level_is_that_of_most_readings_and_the_mean_is_not():
    where, random = links(400), np.random.default_rng(1)
    high = random.random(400) < 0.3
    rest = np.repeat(np.where(high, 24.0, 0.0), 3) + 3.0 * random.standard_normal(1200)
    rssi = gain_db(where.tx_position, where.rx_position, 2.44e9) - 5.0 + rest
    found = FreeSpace().fit(valued(where, rssi))
    # 0.3 of the readings pull with 24 / (1 + 8^2 / 4) dB each, the others hold with about half a dB
    # each: (0.3 * 1.4) / (0.7 * 0.5) = 1.2, and a standard error of 0.2. The mean is 7 dB off.
    assert abs(found.level + 5.0) < 1.6
    assert rest.mean() > 5.0


def test_the_location_is_the_least_cost_anywhere():
    """Against every value of a fine grid."""
    random = np.random.default_rng(2)
    values = np.concatenate([random.normal(-7, 3, 60), random.normal(9, 2, 50)])
    grid = np.linspace(-20, 20, 40_001)
    cost = student(torch.from_numpy(((values - grid[:, None]) / 3.0) ** 2)).sum(1)
    assert location(values, 3.0) == pytest.approx(grid[int(cost.argmin())], abs=1e-3)


def test_one_reading_and_equal_readings_are_their_own_level():
    assert location(np.array([-61.5]), 3.0) == pytest.approx(-61.5, abs=1e-9)
    assert location(np.full(9, 4.0), 3.0) == pytest.approx(4.0, abs=1e-9)


class Shifted:
    """A method that says ``true`` + shift, whatever it is given, and remembers what it saw."""

    def __init__(self, true, shift):
        self.true, self.shift, self.seen = true, shift, []

    def fit(self, readings, seed=0):
        self.seen.append(readings)
        return self

    def predict(self, tx_position, rx_position, gateway):
        return Prediction(self.true(tx_position) + self.shift)


def slope(tx):
    return -50.0 - 2.0 * tx[:, 0]


def fit(plain, rich, noise=1.0, count=100):
    where = links(count)
    rssi = slope(where.tx_position) + noise * np.random.default_rng(3).standard_normal(3 * count)
    methods = Shifted(slope, plain), Shifted(slope, rich)
    return Required(*methods).fit(valued(where, rssi)), methods


def test_the_richer_is_taken_where_held_out_places_ask_for_it():
    found, (plain, rich) = fit(4.0, 0.0)
    assert found.rich and len(plain.seen) == 1 and len(rich.seen) == 2


@pytest.mark.parametrize("rich", [0.0, 4.0])
def test_the_plainer_is_taken_where_the_richer_is_no_better(rich):
    found, _ = fit(0.0, rich)
    assert not found.rich


def test_no_reading_of_a_place_held_out_is_seen():
    found, (plain, rich) = fit(0.0, 0.0)
    seen = plain.seen[0]
    assert rich.seen[0] is seen
    whole = plain.seen[1]
    assert len(whole) - len(seen) == len(found.missed) == 3 * len(whole) / 3 / EVERY
    kept = Places.among(seen.tx_position)
    counts = np.bincount(kept.of)
    assert (counts == 3).all()  # a place is held out with all its readings or not at all


def test_the_interval_covers_nine_tenths():
    found, _ = fit(0.0, 0.0, noise=3.0, count=1500)
    asked = links(1000, seed=9)
    truth = slope(asked.tx_position) + 3.0 * np.random.default_rng(4).standard_normal(3000)
    said = found.predict(asked.tx_position, asked.rx_position, asked.gateway)
    inside = ((said.low <= truth) & (truth <= said.high)).mean()
    # 900 calibrating readings: three standard errors of theirs and of the 3000 asked
    assert inside == pytest.approx(0.9, abs=0.035)


def test_a_method_that_knows_its_interval_keeps_it():
    class Sure(Shifted):
        def predict(self, tx_position, rx_position, gateway):
            mean = slope(tx_position)
            return IntervalPrediction(mean, None, mean - 7.0, mean + 9.0)

    where = links(60)
    valued_there = valued(where, slope(where.tx_position))
    found = Required(Shifted(slope, 5.0), Sure(slope, 0.0)).fit(valued_there)
    said = found.predict(where.tx_position, where.rx_position, where.gateway)
    assert (
        found.rich and (said.low == said.mean - 7.0).all() and (said.high == said.mean + 9.0).all()
    )


def test_bounds_are_order_statistics():
    assert bounds(np.arange(1.0, 20.0)) == (1.0, 19.0)  # floor(20 / 20) = 1
    assert bounds(np.arange(1.0, 40.0)) == (2.0, 38.0)
    assert bounds(np.array([3.0])) == (3.0, 3.0)


def test_better_is_by_more_than_a_standard_error():
    same = np.ones(50)
    assert not better(same, same)
    assert better(same + 1.0, same)
    noisy = np.random.default_rng(0).standard_normal(50) * 10.0
    assert not better(same, same + noisy - noisy.mean() - 0.1)


def test_too_few_places_stay_plain():
    where = links(2)
    plain, rich = Shifted(slope, 0.0), Shifted(slope, 0.0)
    found = Required(plain, rich).fit(valued(where, slope(where.tx_position)))
    assert not found.rich and not rich.seen
