"""What physics leaves: levels come back, intervals cover, places near and far get what they should."""

import numpy as np
import pytest
import torch

from rfsg.learn import levels, protocol
from rfsg.learn.baselines import LogDistance, Method, Prediction, Readings
from rfsg.learn.mixture import INTERVAL, IntervalPrediction, Mixture, interval_of
from rfsg.learn.residual import Residual

GATEWAYS = np.array([[0.0, 0, 2], [20, 0, 2], [0, 20, 2], [20, 20, 2], [10, 9, 2]])
VALUES, SHARES, NOISE = np.array([-24.0, -12.0, 0.0]), np.array([0.2, 0.25, 0.55]), 3.0
ROOM = 20.0  # side [m]


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def random(seed=0):
    return np.random.default_rng(seed)


def links(tx, gateways=(0, 1, 2, 3, 4)):
    """(transmitter, receiver, gateway) from every place to every gateway."""
    gateway = np.tile(np.array(gateways), len(tx))
    return np.repeat(tx, len(gateways), axis=0), GATEWAYS[gateway], gateway


def places(count, seed):
    return random(seed).uniform([0, 0, 1.0], [ROOM, ROOM, 1.5], (count, 3))


def law(tx, rx):
    return -42.0 - 23.0 * np.log10(np.linalg.norm(tx - rx, axis=1))


def patches(tx, side=4.0, seed=7):
    """The number of the level of each place: squares of ``side`` metres, each with one level."""
    cells = int(np.ceil(ROOM / side))
    drawn = random(seed).choice(len(SHARES), size=(cells, cells), p=SHARES)
    # Each level is somewhere, whatever was drawn.
    drawn.flat[: len(SHARES)] = np.arange(len(SHARES))
    at = np.minimum((tx[:, :2] / side).astype(int), cells - 1)
    return drawn[at[:, 0], at[:, 1]]


def readings(tx, level_db, seed, std=NOISE, gateways=(0, 1, 2, 3, 4)):
    """Readings of a level a place [dB] on the law, with noise."""
    where = links(tx, gateways)
    common = np.repeat(level_db, len(gateways))
    noise = std * random(seed).standard_normal(len(common))
    return Readings(*where, law(where[0], where[1]) + common + noise)


def known_room(count=70, seed=1):
    tx = places(count, seed)
    return readings(tx, VALUES[patches(tx)], seed + 100)


def asked(tx, gateways=(0, 1, 2, 3, 4)):
    return links(tx, gateways)


class Law:
    """A physics that knows the law and learns nothing."""

    def fit(self, readings, seed=0):
        return self

    def predict(self, tx_position, rx_position, gateway):
        return Prediction(law(tx_position, rx_position))


# Mixtures


def two_normals():
    return Mixture(
        np.array([[1.0, 0.0], [0.5, 0.5]]), np.array([[2.0, 9.0], [-4.0, 4.0]]), np.array([2.0, 1])
    )


def test_quantiles_in_closed_form():
    found = two_normals().prediction()
    np.testing.assert_allclose(found.mean, [2.0, 0.0], atol=1e-9)
    # 1.6449 is the 95 % quantile of a normal distribution, 1.2816 its 90 % quantile: of the second
    # mixture each half keeps a tenth outside.
    np.testing.assert_allclose(found.low, [2.0 - 2 * 1.644854, -4 - 1.281552], atol=1e-5)
    np.testing.assert_allclose(found.high, [2.0 + 2 * 1.644854, 4 + 1.281552], atol=1e-5)
    np.testing.assert_allclose(found.std, [2.0, np.sqrt(17.0)])


def test_density_integrates_to_one_and_to_the_distribution():
    at = np.linspace(-20.0, 30.0, 5001)
    for i in range(2):
        m = two_normals()
        one = Mixture(
            *(np.repeat(a[i : i + 1], len(at), axis=0) for a in (m.weight, m.mean, m.std))
        )
        density = np.exp(one.log_density(at))
        assert np.trapezoid(density, at) == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(np.gradient(one.below(at), at), density, atol=1e-4)


def test_scores_use_the_interval_that_a_prediction_brings():
    said = IntervalPrediction(np.zeros(4), np.ones(4), np.full(4, -9.0), np.full(4, 1.0))
    measured = np.array([-8.0, 0.5, 1.0, 2.0])
    found = protocol.score(measured, said.mean, said.std, interval=interval_of(said))
    assert found.coverage == 0.75
    assert interval_of(Prediction(np.zeros(4), np.ones(4))) is None
    assert protocol.score(measured, said.mean, said.std).coverage == 0.5


# Levels


@pytest.mark.parametrize("gateways", [(0, 1, 2, 3, 4), (0, 3)], ids=["five a place", "two a place"])
def test_levels_values_and_shares_come_back(gateways):
    tx = places(300, 1)
    level = random(2).choice(3, 300, p=SHARES)
    known = readings(tx, VALUES[level], 3, gateways=gateways)
    found = levels.fitted(
        3, known.rssi - law(known.tx_position, known.rx_position), known.tx_position, known.gateway
    )
    np.testing.assert_allclose(found.value, VALUES, atol=1.0)
    np.testing.assert_allclose(found.share, np.bincount(level) / 300, atol=0.03)
    assert found.noise == pytest.approx(NOISE, rel=0.1)
    assert (
        found.known.argmax(1)[np.argsort(found.position[:, 0])] == level[np.argsort(tx[:, 0])]
    ).mean() > 0.9


def test_gateway_offsets_do_not_blur_the_levels():
    tx = places(200, 4)
    level = random(5).choice(3, 200, p=SHARES)
    known = readings(tx, VALUES[level], 6)
    offset = np.array([3.0, -3.0, 2.0, -2.0, 0.0])[known.gateway]
    rest = known.rssi - law(known.tx_position, known.rx_position) + offset
    found = levels.fitted(3, rest, known.tx_position, known.gateway)
    assert found.noise == pytest.approx(NOISE, rel=0.1)
    np.testing.assert_allclose(np.diff(found.value), [12.0, 12.0], atol=1.0)


def test_a_near_place_gets_its_neighbours_level_and_a_far_place_the_shares():
    tx = places(200, 1)
    known = readings(tx, VALUES[patches(tx)], 8)
    rest = known.rssi - law(known.tx_position, known.rx_position)
    found = levels.fitted(3, rest, known.tx_position, known.gateway)
    centre = (np.floor(tx[:, :2] / 4.0) + 0.5) * 4.0
    inside = tx[np.abs(tx[:, :2] - centre).max(1) < 1.0]
    said = found.at(inside + [0.02, 0.0, 0.0])
    right = said[np.arange(len(inside)), patches(inside)]
    assert np.median(right) > 0.95
    np.testing.assert_allclose(found.at(np.array([[1e4, 0.0, 1.0]])), found.share[None], atol=1e-12)


def test_levels_without_pattern_are_not_carried_to_neighbours():
    tx = places(200, 1)
    known = readings(tx, VALUES[random(9).choice(3, 200, p=SHARES)], 10)
    rest = known.rssi - law(known.tx_position, known.rx_position)
    found = levels.fitted(3, rest, known.tx_position, known.gateway)
    said = found.at(places(100, 11))
    assert np.abs(said - found.share).mean() < 0.1


def test_the_climb_never_goes_down():
    """The property that proves an EM step right (Bishop 2006, section 9.4)."""
    known = known_room()
    rest = known.rssi - law(known.tx_position, known.rx_position)
    where = levels.Places.among(known.tx_position)
    reached = []
    for steps in range(2, 12):
        levels_steps, levels.STEPS = levels.STEPS, steps
        try:
            start = np.array([-20.0, -5.0, 5.0])
            reached.append(levels.climbed(start, rest, where, known.gateway).log_likelihood)
        finally:
            levels.STEPS = levels_steps
    assert (np.diff(reached) > -1e-6).all() and reached[-1] > reached[0] + 1.0, reached


def test_positions_that_differ_by_rounding_are_one_place():
    tx = np.repeat(places(20, 1), 3, axis=0)
    shaken = tx + 1e-12 * random(1).standard_normal(tx.shape)
    found = levels.Places.among(shaken)
    assert len(found.position) == 20
    np.testing.assert_array_equal(found.sum(np.ones(60)), 3.0)


# The number of levels


def test_the_number_of_levels_is_found():
    assert len(Residual(Law(), answer="common").fit(known_room(90)).levels.value) == 3


@pytest.mark.parametrize("kind", ["noise alone", "smooth field"])
def test_one_level_where_there_are_none(kind):
    tx = places(60, 3)
    smooth = 6.0 * np.sin(tx[:, 0] / 3.0) if kind == "smooth field" else np.zeros(len(tx))
    model = Residual(Law(), (1, 3), "common").fit(readings(tx, smooth, 4))
    assert len(model.levels.value) == 1


def test_few_places_have_one_level():
    few = known_room(4)
    assert len(Residual(LogDistance()).fit(few).levels.value) == 1
    one = few.only(np.array([3]))
    said = Residual(LogDistance()).fit(one).predict(one.tx_position, one.rx_position, one.gateway)
    np.testing.assert_allclose(said.mean, one.rssi, atol=1.0)


# The whole


@pytest.mark.parametrize("answer", ["common", "whole"])
def test_intervals_cover_fresh_draws(answer):
    shares = []
    for seed in (20, 30):
        model = Residual(LogDistance(offsets=False), (3,), answer).fit(known_room(60, seed))
        tx = places(150, seed + 5)
        fresh = readings(tx, VALUES[patches(tx)], seed + 6)
        said = model.predict(fresh.tx_position, fresh.rx_position, fresh.gateway)
        shares.append(protocol.share_inside(fresh.rssi, said.low, said.high))
    assert INTERVAL - 0.05 <= np.mean(shares) <= INTERVAL + 0.05, shares


def test_a_gateway_never_heard_is_predicted_through_the_common_term():
    known = known_room(100)
    model = Residual(LogDistance(offsets=False), (3,)).fit(known.only(known.gateway != 4))
    tx = places(100, 12)
    fresh = readings(tx, VALUES[patches(tx)], 13, gateways=(4,))
    where = (fresh.tx_position, fresh.rx_position, fresh.gateway)
    off = {
        part: protocol.score(fresh.rssi, model.part(part).predict(*where).mean).median_db
        for part in ("physics", "common", "whole")
    }
    assert off["common"] < 0.5 * off["physics"] and off["whole"] < 0.5 * off["physics"], off


def test_physics_alone_is_what_the_physics_says():
    known = known_room(20)
    model = Residual(LogDistance(), (2,), "common").fit(known)
    where = asked(places(9, 14))
    ours, alone = model.physics.predict(*where), LogDistance().fit(known).predict(*where)
    np.testing.assert_array_equal(ours.mean, alone.mean)


def test_physics_is_fitted_again_without_the_levels():
    """The exponent comes back although weak places are more often far from the receiver."""
    tx = places(200, 15)
    far = np.linalg.norm(tx - GATEWAYS[4], axis=1) > 7.0
    weak = random(19).uniform(size=200) < np.where(far, 0.6, 0.2)
    known = readings(tx, np.where(weak, -15.0, 0.0), 16, gateways=(4,))
    model = Residual(LogDistance(), (2,), "common", rounds=3).fit(known)
    first, again = (abs(law.exponent - 2.3) for law in (model.physics, model.refitted))
    assert again < 0.5 * first, (first, again)


def test_neither_order_nor_frame_matters():
    known, where = known_room(30), asked(places(10, 17))
    turn = np.linalg.qr(random(5).standard_normal((3, 3)))[0]

    def moved(points):
        return points @ turn.T + [3.0, -20.0, 1.0]

    mixed = known.only(random(1).permutation(len(known)))
    there = Readings(moved(known.tx_position), moved(known.rx_position), known.gateway, known.rssi)
    elsewhere = (moved(where[0]), moved(where[1]), where[2])
    said = []
    for data, links_asked in ((known, where), (mixed, where), (there, elsewhere)):
        model = Residual(LogDistance(offsets=False), (1, 3), "common").fit(data, seed=1)
        found = model.predict(*links_asked)
        said.append(np.concatenate([found.mean, found.std, found.low, found.high]))
    # Rounding moves the end of the climb of a likelihood by what its tolerance leaves open.
    np.testing.assert_allclose(said[1], said[0], rtol=1e-3)
    np.testing.assert_allclose(said[2], said[0], rtol=1e-3)


# Input


@pytest.mark.parametrize(
    "wrong, said",
    [
        ({"counts": ()}, r"counts: \(\) given; expected whole numbers of levels"),
        ({"counts": (0, 2)}, r"counts: \(0, 2\) given; expected"),
        ({"most": 0}, r"most: 0, rounds: 1; expected at least 1 reading"),
        ({"rounds": -1}, r"most: 600, rounds: -1; expected"),
    ],
)
def test_settings_that_are_none(wrong, said):
    with pytest.raises(ValueError, match=said):
        Residual(LogDistance(), **wrong)


def test_positions_asked_for_must_be_finite():
    model = Residual(LogDistance(), (1,)).fit(known_room(6))
    tx, rx, gateway = asked(places(2, 18))
    tx[0, 0] = np.nan
    with pytest.raises(ValueError, match=r"tx_position: 1 of 30 values are NaN"):
        model.predict(tx, rx, gateway)


def test_physics_without_power_somewhere():
    class Silent(Law):
        def predict(self, tx_position, rx_position, gateway):
            power = law(tx_position, rx_position)
            return Prediction(np.where(gateway == 2, -np.inf, power))

    with pytest.raises(
        FloatingPointError, match=r"physics: 6 of 30 predictions .* NaN or infinite"
    ):
        Residual(Silent()).fit(known_room(6))


def test_it_is_a_method():
    assert isinstance(Residual(LogDistance()), Method)
