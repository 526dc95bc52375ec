"""Every baseline recovers what it must; predictions do not depend on order or frame."""

import numpy as np
import pytest
import torch

from rfsg.learn import protocol
from rfsg.learn.baselines import (
    GatewayKriging,
    JointKriging,
    LogDistance,
    Mri,
    NearestNeighbours,
    Nerf2,
    Readings,
    UnheardGatewayError,
)
from rfsg.learn.baselines.gaussian_process import (
    Block,
    Pairs,
    Posterior,
    Trend,
    most_likely,
    negative_log_likelihood,
)
from rfsg.learn.baselines.kriging import JOINT, PER_GATEWAY, sites
from rfsg.learn.baselines.readings import LEAST_DISTANCE

GATEWAYS = np.array([[0.0, 0, 2], [9, 0, 2], [0, 7, 2], [9, 7, 2], [4, 3, 2]])
LEVEL, EXPONENT = -42.0, 2.3

SMALL_NERF2 = Nerf2(
    steps=60, batch=16, rate=1e-2, width=16, layers=3, octaves=3, directions=12, samples=6
)
METHODS = {
    "log-distance": LogDistance(),
    "1-NN": NearestNeighbours((1,)),
    "k-NN": NearestNeighbours(),
    "MRI": Mri(),
    "kriging": GatewayKriging(),
    "joint kriging": JointKriging(),
}


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def random(seed=0):
    return np.random.default_rng(seed)


def links(places, seed=0, gateways=(0, 1, 2, 3, 4)):
    """(transmitter, receiver, gateway) of every gateway at random places."""
    tx = random(seed).uniform([0.5, 0.5, 1.0], [8.5, 6.5, 1.5], (places, 3))
    gateway = np.tile(np.array(gateways), places)
    return np.repeat(tx, len(gateways), axis=0), GATEWAYS[gateway], gateway


def law(tx, rx, gateway, offset=(0.0,) * 5):
    decades = np.log10(np.linalg.norm(tx - rx, axis=1))
    return LEVEL - 10.0 * EXPONENT * decades + np.array(offset)[gateway]


def shared_field(tx):
    """Two regions with their own level, as a tag in a pocket or out of it would give [dB]."""
    return np.where(tx[:, 0] + 0.3 * tx[:, 1] > 5.0, 9.0, -6.0)


def noisy(places=12, seed=0, std=1.0):
    where = links(places, seed)
    return Readings(*where, law(*where) + std * random(seed + 1).standard_normal(5 * places))


# Log-distance


def test_log_distance_recovers_exponent_and_offsets_exactly():
    offset = np.array([3.0, -1.0, 0.5, -2.0, -0.5])
    where = links(12)
    found = LogDistance().fit(Readings(*where, law(*where, offset)))
    assert found.exponent == pytest.approx(EXPONENT, abs=1e-10)
    assert found.intercept == pytest.approx(LEVEL, abs=1e-9)
    np.testing.assert_allclose(found.offset, offset, atol=1e-9)
    asked = links(7, seed=5)
    np.testing.assert_allclose(found.predict(*asked).mean, law(*asked, offset), atol=1e-9)


def test_log_distance_gives_an_unheard_gateway_the_mean_offset():
    where = links(12, gateways=range(4))
    found = LogDistance().fit(Readings(*where, law(*where, (2.0, -2.0, 1.0, -1.0, 0.0))))
    asked = links(3, gateways=[4])
    np.testing.assert_allclose(found.predict(*asked).mean, law(*asked), atol=1e-9)


def test_log_distance_of_one_reading_is_that_reading():
    one = noisy().only(np.array([3]))
    found = LogDistance().fit(one).predict(one.tx_position, one.rx_position, one.gateway)
    assert found.mean == pytest.approx(one.rssi, abs=1e-12)


def test_standard_deviation_of_the_law_is_that_of_the_noise():
    assert LogDistance().fit(noisy(400, std=2.0)).std == pytest.approx(2.0, rel=0.08)


def test_a_receiver_inside_the_least_distance_counts_as_there():
    where = links(12)
    found = LogDistance().fit(Readings(*where, law(*where)))
    at = GATEWAYS[:1]
    near = found.predict(at, at, np.array([0])).mean
    assert near == pytest.approx(LEVEL - 10 * EXPONENT * np.log10(LEAST_DISTANCE), abs=1e-9)


# Neighbours and MRI


def test_one_nearest_neighbour_is_the_nearest_reading():
    known, asked = noisy(30), links(20, seed=3)
    said = NearestNeighbours((1,)).fit(known).predict(*asked).mean
    for tx, gateway, value in zip(asked[0], asked[2], said, strict=True):
        mine = known.only(known.gateway == gateway)
        apart = np.linalg.norm(mine.tx_position - tx, axis=1)
        assert value == mine.rssi[apart.argmin()]


def test_number_of_neighbours_follows_the_noise():
    """A flat field with noise asks for many, a field without noise for one."""
    where = links(60)
    flat = np.full(300, -60.0) + 3.0 * random(2).standard_normal(300)
    assert NearestNeighbours().fit(Readings(*where, flat)).k >= 10
    step = np.round(where[0][:, 0]) * 7.0
    assert NearestNeighbours().fit(Readings(*where, step)).k <= 2


def test_neighbours_of_repeated_places_do_not_count_themselves():
    """With every place read twice, the nearest other reading is the twin."""
    tx, rx, gateway = links(20)
    rssi = 10.0 * random(4).standard_normal(100)
    twice = Readings(*(np.concatenate([a, a]) for a in (tx, rx, gateway, rssi)))
    assert NearestNeighbours((1, 5)).fit(twice).k == 1


def test_fewer_readings_than_neighbours():
    few = noisy(2)
    found = NearestNeighbours((10,)).fit(few)
    said = found.predict(few.tx_position, few.rx_position, few.gateway).mean
    expected = [few.rssi[few.gateway == g].mean() for g in few.gateway]
    np.testing.assert_allclose(said, expected)


def test_mri_passes_through_its_readings_and_is_the_law_without_residuals():
    known = noisy()
    said = Mri().fit(known).predict(known.tx_position, known.rx_position, known.gateway).mean
    np.testing.assert_allclose(said, known.rssi, atol=1e-3)
    where, asked = links(12), links(9, seed=8)
    exact = Mri().fit(Readings(*where, law(*where))).predict(*asked).mean
    np.testing.assert_allclose(exact, law(*asked), atol=1e-9)


@pytest.mark.parametrize("name", ["1-NN", "k-NN", "MRI", "kriging"])
def test_an_unheard_gateway_is_refused(name):
    known = noisy()
    fit = METHODS[name].fit(known.only(known.gateway != 4))
    with pytest.raises(UnheardGatewayError, match=r"gateway 4: no training reading"):
        fit.predict(*links(3))


# Kriging


def posterior(covariance, parameters, where, values, trend):
    q = torch.tensor(parameters, dtype=torch.float64)
    return Posterior.given(covariance, trend, q, Block(*sites(*where), torch.as_tensor(values)))


def known_trend(std=(0.0, 0.0)):
    """The true law as prior, known exactly unless ``std`` says otherwise."""
    return Trend(
        torch.tensor([LEVEL, EXPONENT], dtype=torch.float64),
        torch.tensor(std, dtype=torch.float64),
    )


EXACT = {  # parameters without noise, and the variance of the field
    "per gateway": (PER_GATEWAY, (0.0, 4.0, 2.0), 16.0),
    "joint": (JOINT, (0.0, 4.0, 2.0, 3.0, 2.0, 3.0, 1.0), 26.0),
}


@pytest.mark.parametrize("name", EXACT)
def test_kriging_without_noise_passes_through_its_readings(name):
    covariance, q, variance = EXACT[name]
    where = links(20)
    values = law(*where) + shared_field(where[0])
    found = posterior(covariance, q, where, values, known_trend())
    mean, rest = found.at(*sites(*where))
    np.testing.assert_allclose(mean.numpy(), values, atol=1e-5)
    assert float(rest.max()) < 1e-6
    far = (where[0] + [1e4, 0, 0], where[1] + [1e5, 0, 0], where[2] + 100)
    mean, rest = found.at(*sites(*far))
    np.testing.assert_allclose(mean.numpy(), law(far[0], far[1], where[2]), atol=1e-6)
    np.testing.assert_allclose(rest.numpy(), variance, rtol=1e-9)


def test_uncertain_trend_adds_its_variance_far_away():
    covariance, q, variance = EXACT["per gateway"]
    found = posterior(covariance, q, links(1), law(*links(1)), known_trend((3.0, 0.0)))
    away = links(1, seed=9, gateways=[4])
    far = (away[0] + [1e4, 0, 0], away[1], away[2] + 1)
    assert float(found.at(*sites(*far))[1]) == pytest.approx(variance + 9.0, rel=0.4)
    assert float(found.at(*sites(*far))[1]) < variance + 9.0


def draw(covariance, parameters, where, seed):
    """Readings drawn from the model itself: trend, field, noise."""
    q = torch.tensor(parameters, dtype=torch.float64)
    place, basis = sites(*where)
    matrix = covariance.of(q, Pairs.between(place, place)).numpy()
    n = len(matrix)
    root = np.linalg.cholesky(matrix + 1e-9 * np.eye(n))
    field = root @ random(seed).standard_normal(n)
    return law(*where) + field + parameters[0] * random(seed + 1).standard_normal(n)


@pytest.mark.parametrize(
    "method, covariance, parameters",
    [
        (GatewayKriging(), PER_GATEWAY, (1.5, 5.0, 3.0)),
        (JointKriging(most=200), JOINT, (1.5, 5.0, 2.0, 2.0, 2.0, 4.0, 1.0)),
    ],
    ids=["per gateway", "joint"],
)
def test_intervals_cover_draws_from_the_model(method, covariance, parameters):
    shares = []
    for seed in range(2):
        where = links(100, seed=10 + seed)
        drawn = Readings(*where, draw(covariance, parameters, where, 20 + 2 * seed))
        train = np.arange(len(drawn)) // 5 < 40
        fit = method.fit(drawn.only(train), seed)
        test = drawn.only(~train)
        said = fit.predict(test.tx_position, test.rx_position, test.gateway)
        shares.append(protocol.coverage(test.rssi, said.mean, said.std))
    assert 0.85 <= np.mean(shares) <= 0.95, shares


def test_joint_kriging_carries_the_shared_field_to_an_unheard_gateway():
    where = links(60)
    rssi = law(*where) + shared_field(where[0]) + 1.5 * random(3).standard_normal(300)
    known = Readings(*where, rssi)
    known = known.only(known.gateway != 4)
    asked = links(60, seed=7, gateways=[4])
    truth = law(*asked) + shared_field(asked[0])
    off = {
        method: protocol.score(truth, method.fit(known).predict(*asked).mean).median_db
        for method in (LogDistance(), JointKriging(most=200))
    }
    law_off, joint_off = off.values()
    assert joint_off < 0.4 * law_off, off


@pytest.mark.parametrize("covariance", [PER_GATEWAY, JOINT], ids=["per gateway", "joint"])
def test_gradient_of_the_likelihood(covariance):
    """Against central differences in float64."""
    where = links(8)
    values = torch.as_tensor(law(*where) + shared_field(where[0]))
    block = Block(*sites(*where), values)
    trend = known_trend((5.0, 0.5))
    log = torch.tensor(covariance.start, dtype=torch.float64).log()
    value, gradient = negative_log_likelihood(covariance, trend, block, log.exp())
    step = 1e-5
    for i in range(len(log)):
        ends = []
        for sign in (1.0, -1.0):
            moved = log.clone()
            moved[i] += sign * step
            ends.append(negative_log_likelihood(covariance, trend, block, moved.exp())[0])
        assert float(gradient[i]) == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-6)
    reference = torch.distributions.MultivariateNormal(
        block.basis @ trend.mean,
        covariance.of(log.exp(), Pairs.between(block.sites, block.sites))
        + (block.basis * trend.std**2) @ block.basis.T
        + log.exp()[0] ** 2 * torch.eye(len(values), dtype=torch.float64),
    )
    assert value == pytest.approx(-float(reference.log_prob(values)), rel=1e-9)


def test_most_likely_parameters_are_near_those_of_the_draw():
    parameters = (1.0, 5.0, 2.0)
    blocks = []
    for seed in range(4):
        where = links(120, seed=30 + seed, gateways=[seed])
        values = draw(PER_GATEWAY, parameters, where, 40 + 2 * seed)
        blocks.append(Block(*sites(*where), torch.as_tensor(values)))
    found = most_likely(PER_GATEWAY, known_trend(), blocks).numpy()
    np.testing.assert_allclose(found, parameters, rtol=0.3)


# What holds for all


def predictions(method, readings, asked):
    said = method.fit(readings, seed=1).predict(*asked)
    return said.mean if said.std is None else np.concatenate([said.mean, said.std])


@pytest.mark.parametrize("name", METHODS)
def test_neither_order_nor_frame_matters(name):
    """The readings shuffled, and everything turned, mirrored and shifted."""
    where, (tx, rx, gateway) = links(15), links(10, seed=6)
    rssi = law(*where) + shared_field(where[0]) + random(1).standard_normal(75)
    known = Readings(*where, rssi)
    turn = np.linalg.qr(random(5).standard_normal((3, 3)))[0]

    def moved(points):
        return points @ turn.T + [3.0, -20.0, 1.0]

    mixed = random(1).permutation(75)
    there = Readings(moved(known.tx_position), moved(known.rx_position), known.gateway, rssi)
    ours = predictions(METHODS[name], known, (tx, rx, gateway))
    shuffled = predictions(METHODS[name], known.only(mixed), (tx, rx, gateway))
    elsewhere = predictions(METHODS[name], there, (moved(tx), moved(rx), gateway))
    # Rounding moves the end of the climb of a likelihood by what its tolerance leaves open.
    np.testing.assert_allclose(shuffled, ours, rtol=1e-4)
    np.testing.assert_allclose(elsewhere, ours, rtol=1e-4)


def test_the_same_seed_gives_the_same_nerf2():
    known, asked = noisy(), links(10, seed=6)
    first, second = (predictions(SMALL_NERF2, known, asked) for _ in range(2))
    np.testing.assert_array_equal(first, second)


# NeRF2


def test_nerf2_learns():
    known = noisy(12)
    field = SMALL_NERF2.fit(known)
    begin, end = np.mean(field.history[:5]), np.mean(field.history[-5:])
    assert end < 0.6 * begin, (begin, end)
    said = field.predict(known.tx_position, known.rx_position, known.gateway)
    assert said.std is None and np.isfinite(said.mean).all()


def test_nerf2_gradient():
    """Every weight's derivative against central differences, on a tiny network in float64."""
    known = noisy(3)
    settings = Nerf2(0, 4, 1e-3, 4, 3, 2, 5, 3, dtype=torch.float64)
    field = settings.fit(known)
    tx, rx = torch.as_tensor(known.tx_position), torch.as_tensor(known.rx_position)
    weights = list(field.parameters())
    outside = torch.linspace(-1.0, 1.0, len(tx), dtype=torch.float64)
    gradients = torch.autograd.grad((field(tx, rx) * outside).sum(), weights)
    step = 1e-6
    for weight, gradient in zip(weights, gradients, strict=True):
        direction = torch.randn_like(weight)
        ends = []
        with torch.no_grad():
            for sign in (1.0, -2.0):  # there, and to the other side of where it was
                weight += sign * step * direction
                ends.append(float((field(tx, rx) * outside).sum()))
            weight += step * direction
        slope = (ends[0] - ends[1]) / (2.0 * step)
        assert float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-4, abs=1e-5)


def test_nerf2_leaves_the_random_state_alone():
    before = torch.random.get_rng_state()
    Nerf2(1, 4, 1e-3, 4, 3, 2, 5, 3).fit(noisy(3))
    assert torch.equal(before, torch.random.get_rng_state())


def test_nerf2_predicts_in_chunks_as_at_once():
    known = noisy(30)
    field = Nerf2(0, 4, 1e-3, 8, 3, 2, 5, 3, dtype=torch.float64).fit(known)
    tx, rx = torch.as_tensor(known.tx_position), torch.as_tensor(known.rx_position)
    said = field.predict(known.tx_position, known.rx_position, known.gateway).mean
    np.testing.assert_allclose(said, field(tx, rx).detach().numpy(), atol=1e-9)


# Input


def test_no_readings():
    with pytest.raises(ValueError, match=r"readings: none given; expected at least one"):
        noisy().only(np.zeros(60, dtype=bool))


@pytest.mark.parametrize("field", ["tx_position", "rx_position", "rssi"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(field, value):
    known = noisy()
    parts = {n: getattr(known, n).copy() for n in ("tx_position", "rx_position", "gateway", "rssi")}
    parts[field].flat[7] = value
    with pytest.raises(ValueError, match=rf"{field}: 1 of \d+ values are NaN or infinite"):
        Readings(**parts)


@pytest.mark.parametrize("name", [*METHODS, "NeRF2"])
def test_positions_asked_for_must_be_finite(name):
    fit = METHODS.get(name, Nerf2(0, 4, 1e-3, 4, 3, 2, 5, 3)).fit(noisy(5))
    tx, rx, gateway = links(2)
    tx[0, 0] = np.nan
    with pytest.raises(ValueError, match=r"tx_position: 1 of 30 values are NaN"):
        fit.predict(tx, rx, gateway)


def test_no_neighbours():
    with pytest.raises(ValueError, match=r"k: \(0, 1\) given; expected whole numbers"):
        NearestNeighbours((0, 1))


# Scores


def test_scores_in_closed_form():
    measured, mean = np.arange(11.0), np.zeros(11)
    found = protocol.score(measured, mean, np.full(11, 2.0))
    assert (found.readings, found.median_db, found.p90_db) == (11, 5.0, 9.0)
    assert found.coverage == pytest.approx(4 / 11)  # within 1.645 standard deviations: 0, 1, 2, 3
    assert protocol.score(measured, mean).coverage is None
    np.testing.assert_allclose(
        protocol.error_cdf(measured, [-1.0, 0.0, 4.5, 20.0]), [0, 1 / 11, 5 / 11, 1]
    )


def test_a_missing_prediction_is_not_left_out_of_the_score():
    with pytest.raises(ValueError, match=r"errors: 2 readings, 1 of them NaN"):
        protocol.score(np.zeros(2), np.array([0.0, np.nan]))
    with pytest.raises(ValueError, match=r"errors: 0 readings"):
        protocol.score(np.zeros(0), np.zeros(0))
