"""What is read off a channel, against closed forms and plain sums; channels made by hand."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate

from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene
from rfsg.tracer import spreads
from rfsg.tracer.channel import coefficients, line_of_sight, power, thermal_noise_dbm, transfer
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Channel
from rfsg.tracer.response import (
    at_carrier,
    frequency_response,
    impulse_response,
    subcarriers,
    taps,
)
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, room

CARRIER = 2.4e9
EAST, NORTH, WEST, UP = (1.0, 0, 0), (0.0, 1, 0), (-1.0, 0, 0), (0.0, 0, 1)


def real(values):
    return torch.as_tensor(values, dtype=torch.float64)


def channel(delay, gain, *, doppler=0.0, frequency=(CARRIER,), rx=0, departure=EAST, arrival=EAST):
    """Paths of transmitter 0; gain is [p] or [p f], everything else one number or one per path."""
    delay = real(delay)
    p, frequency = len(delay), real(frequency)
    gain = torch.as_tensor(gain, dtype=torch.complex128)
    gain = gain[:, None].expand(p, len(frequency)) if gain.ndim == 1 else gain
    fill = [real(x).expand(p, 3).clone() for x in (departure, arrival)]
    whole = torch.as_tensor(rx).expand(p).clone()
    none = torch.zeros(0, 3, dtype=torch.int64)
    clear = torch.zeros(p, dtype=torch.bool)
    doppler = real(doppler).expand(p).clone()
    return Channel(
        torch.zeros_like(whole), whole, frequency, delay, gain, doppler, *fill, none, clear
    )


def many(seed=0, paths=40, links=3, spread=50e-9, f=1):
    """Random paths over several links, one of which stays empty."""
    rng = np.random.default_rng(seed)
    directions = [rng.normal(size=(paths, 3)) for _ in range(2)]
    directions = [d / np.linalg.norm(d, axis=1, keepdims=True) for d in directions]
    gain = rng.normal(size=(paths, f)) + 1j * rng.normal(size=(paths, f))
    return channel(
        1e-7 + rng.exponential(spread, paths),
        torch.from_numpy(gain),
        doppler=rng.uniform(-100, 100, paths),
        frequency=CARRIER + 10e6 * np.arange(f),
        rx=torch.from_numpy(rng.integers(0, links - 1, paths)),
        departure=directions[0],
        arrival=directions[1],
    )


def one(value):
    assert value.shape == (1, 1, 1)
    return float(value)


# spreads


def test_delay_spread_of_two_paths():
    """Two of equal power: half their separation. Shares p and 1-p: sqrt(p (1-p)) of it."""
    assert one(spreads.delay_spread(channel([1e-6, 1.1e-6], [1, 1j]), 1, 1)) == pytest.approx(
        50e-9, rel=1e-12
    )
    uneven = channel([1e-6, 1.1e-6], [3**0.5, 1])
    assert one(spreads.delay_spread(uneven, 1, 1)) == pytest.approx(100e-9 * 3**0.5 / 4, rel=1e-9)
    assert one(spreads.mean_delay(uneven, 1, 1)) == pytest.approx(1.025e-6, rel=1e-12)


def test_small_spread_of_a_long_delay_keeps_its_digits():
    far = channel([1e-3, 1e-3 + 1e-12], [1, 1])
    step = float(far.delay[1] - far.delay[0])  # what float64 holds of a picosecond there
    assert one(spreads.delay_spread(far, 1, 1)) == pytest.approx(step / 2, rel=1e-6)


def test_doppler_spread_and_its_growth_with_frequency():
    moving = channel([1e-6, 1e-6], [1, 1], doppler=[-30.0, 50.0], frequency=[1e9, 4e9])
    spread = spreads.doppler_spread(moving, 1, 1).flatten()
    assert spread.tolist() == pytest.approx([40.0, 160.0], rel=1e-12)
    assert at_carrier(moving, 1).doppler.tolist() == pytest.approx([-120.0, 200.0])


def test_excess_delay_counts_what_the_threshold_lets_in():
    """-10, 0, -20 and -40 dB at 0, 1, 3 and 9 us."""
    c = channel([0.0, 1e-6, 3e-6, 9e-6], [10**-0.5, 1, 0.1, 0.01])
    for threshold, span in ((0.0, 0.0), (15.0, 1e-6), (20.001, 3e-6), (50.0, 9e-6)):
        found = spreads.maximum_excess_delay(c, 1, 1, threshold)
        assert one(found) == pytest.approx(span, abs=1e-15)
    with pytest.raises(ValueError, match="threshold_db"):
        spreads.maximum_excess_delay(c, 1, 1, -1.0)


def test_k_factor_is_the_strongest_over_the_rest():
    assert one(spreads.k_factor(channel([0.0, 1.0, 2.0], [2, 1, 1j]), 1, 1)) == pytest.approx(2.0)
    assert one(spreads.k_factor(channel([0.0, 1.0], [1, -1]), 1, 1)) == pytest.approx(1.0)
    assert one(spreads.k_factor(channel([0.0], [1e-9]), 1, 1)) == math.inf
    faint = channel([0.0, 1.0], [1.0, 1e-9])  # lost if the rest were the total less the strongest
    assert one(spreads.k_factor(faint, 1, 1)) == pytest.approx(1e18, rel=1e-12)


@pytest.mark.parametrize("half", [1e-6, 0.1, 1.0, 1.5])
def test_angular_spread_of_two_directions(half):
    """Two of equal power, 2 half apart: R = cos(half), AS = sqrt(-2 ln R) (TR 38.901 A.1)."""
    turned = [[math.cos(a), math.sin(a), 0] for a in (2.0 - half, 2.0 + half)]
    lifted = [[math.sin(a), 0, math.cos(a)] for a in (1.571 - half, 1.571 + half)]
    c = channel([0.0, 0.0], [1, 1], departure=turned, arrival=lifted)
    asd, asa, zsd, zsa = (one(x) for x in spreads.angular_spreads(c, 1, 1))
    expected = math.sqrt(-2.0 * math.log1p(-2.0 * math.sin(half / 2) ** 2))
    assert asd == pytest.approx(expected, rel=1e-9) and zsd < 1e-12
    assert zsa == pytest.approx(expected, rel=1e-9) and asa < 1e-12


def test_angular_spreads_are_their_plain_formula():
    c = many(links=2)
    weight = (c.gain[:, 0].abs() ** 2).numpy()
    found = spreads.angular_spreads(c, 1, 1)
    for direction, azimuth, zenith in (
        (c.departure.numpy(), found.asd, found.zsd),
        (c.arrival.numpy(), found.asa, found.zsa),
    ):
        angles = np.arctan2(direction[:, 1], direction[:, 0]), np.arccos(direction[:, 2])
        for angle, spread in zip(angles, (azimuth, zenith), strict=True):
            r = abs((weight * np.exp(1j * angle)).sum()) / weight.sum()
            assert one(spread) == pytest.approx(math.sqrt(-2 * math.log(r)), rel=1e-9)


def test_opposite_directions_spread_to_the_stated_cap():
    found = spreads.angular_spreads(channel([0.0, 0.0], [1, 1], departure=[EAST, WEST]), 1, 1)
    cap = math.sqrt(-2.0 * math.log(spreads.LEAST_RESULTANT))
    assert one(found.asd) == pytest.approx(cap, rel=1e-6)


@pytest.mark.parametrize("level", [0.9, 0.5, 0.2])
def test_coherence_bandwidth_of_two_paths(level):
    """|R| = |cos(pi df s)| for equal paths s apart: it falls to c at arccos(c) / (pi s).

    With shares p and 1-p, |R|^2 = 1 - 4 p (1-p) sin^2(pi df s).
    """
    s = 80e-9
    equal = spreads.coherence_bandwidth(channel([1e-6, 1e-6 + s], [1, 1]), 1, 1, level)
    assert one(equal) == pytest.approx(math.acos(level) / (math.pi * s), rel=1e-9)
    p = 0.55
    uneven = channel([1e-6, 1e-6 + s], [p**0.5, (1 - p) ** 0.5])
    expected = math.asin(math.sqrt((1 - level**2) / (4 * p * (1 - p)))) / (math.pi * s)
    found = one(spreads.coherence_bandwidth(uneven, 1, 1, level))
    assert found == pytest.approx(expected, rel=1e-9)


def test_coherence_never_ends_where_one_path_outweighs_the_rest():
    """|R| >= (P_1 - P_rest) / P: with 80 % in one path it stays above 0.6."""
    c = channel([0.0, 1e-7, 3e-7], [0.8**0.5, 0.1**0.5, 0.1**0.5])
    assert one(spreads.coherence_bandwidth(c, 1, 1, 0.5)) == math.inf
    assert math.isfinite(one(spreads.coherence_bandwidth(c, 1, 1, 0.9)))
    for level in (0.0, 1.0, float("nan")):
        with pytest.raises(ValueError, match="level"):
            spreads.coherence_bandwidth(c, 1, 1, level)


def test_coherence_time_of_two_dopplers():
    """Shifts of +-nu beat as |cos(2 pi nu dt)|: half after 1 / (6 nu); faster at a higher f."""
    c = channel([1e-7, 2e-7], [1, 1], doppler=[-25.0, 25.0], frequency=[1e9, 2e9])
    found = spreads.coherence_time(c, 1, 1).flatten()
    assert found.tolist() == pytest.approx([1 / 150, 1 / 300], rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_coherence_bandwidth_is_the_first_fall_and_keeps_fleurys_bound(seed):
    """Against a fine scan; never below arccos(c) / (2 pi rms) (Fleury 1996)."""
    c = many(seed, paths=12, links=2)
    found = one(spreads.coherence_bandwidth(c, 1, 1))
    rms = one(spreads.delay_spread(c, 1, 1))
    weight, delay = (c.gain[:, 0].abs() ** 2).numpy(), c.delay.numpy()
    df = np.linspace(0.0, 10.0 / rms, 40_001)
    r = np.abs(np.exp(-2j * np.pi * df[:, None] * delay) @ weight) / weight.sum()
    below = np.nonzero(r <= 0.5)[0]
    assert found >= math.acos(0.5) / (2 * math.pi * rms) * (1 - 1e-9)
    if len(below):
        assert df[below[0] - 1] <= found <= df[below[0]]
    else:
        assert found == math.inf


def test_no_paths_have_the_documented_values():
    c = many(links=3)
    rms = spreads.delay_spread(c, 1, 3)
    assert float(rms[0, 2]) == 0.0 and bool((rms[0, :2] > 0).all())
    zero = [spreads.mean_delay, spreads.k_factor, spreads.maximum_excess_delay]
    zero += [spreads.doppler_spread]
    assert all(float(q(c, 1, 3)[0, 2]) == 0.0 for q in zero)
    assert all(float(x[0, 2]) == 0.0 for x in spreads.angular_spreads(c, 1, 3))
    for q in (spreads.coherence_bandwidth, spreads.coherence_time):
        assert float(q(c, 1, 3)[0, 2]) == math.inf
    empty = channel([], [])
    assert impulse_response(empty, 2, 3).gain.shape == (2, 3, 0, 1, 1)
    assert not frequency_response(empty, 1, 1, real([1e9])).any()
    assert not taps(empty, 1, 1, 1e7).gain.any()


# responses


def test_frequency_response_is_the_plain_sum():
    c = many(f=1)
    f = subcarriers(CARRIER, 20e6, 16)
    t = real([0.0, 3e-3])
    found = frequency_response(c, 1, 3, f, t)
    expected = np.zeros((3, 2, 16), dtype=complex)
    for rx, gain, tau, nu in zip(c.rx, c.gain[:, 0], c.delay, c.doppler, strict=True):
        for s in range(2):
            late = float(tau) - float(nu) / CARRIER * float(t[s])
            turns = np.exp(-2j * np.pi * f.numpy() * late)
            expected[int(rx), s] += complex(gain) * CARRIER / f.numpy() * turns
    assert found[0].numpy() == pytest.approx(expected, rel=1e-7, abs=1e-7)
    assert torch.allclose(
        frequency_response(c, 1, 3, real([CARRIER]))[:, :, 0], transfer(c, 1, 3), rtol=1e-12
    )


def test_portions_do_not_change_the_response(monkeypatch):
    c, f = many(), subcarriers(CARRIER, 20e6, 8)
    whole, sampled = frequency_response(c, 1, 3, f), taps(c, 1, 3, 20e6).gain
    monkeypatch.setattr("rfsg.tracer.response.AT_ONCE", 24)
    assert torch.allclose(frequency_response(c, 1, 3, f), whole, rtol=1e-12, atol=1e-14)
    assert torch.allclose(taps(c, 1, 3, 20e6).gain, sampled, rtol=1e-12, atol=1e-14)


def test_a_result_answers_for_its_own_channel():
    result = simulate(room(), real([CARRIER, 5e9]), Quality(depth=0))
    f, t = real([CARRIER, 5e9]), real([0.0, 1e-3])
    h = result.frequency_response(f, t)
    assert torch.allclose(h[:, :, 0], result.transfer(), rtol=1e-9)
    assert torch.allclose(result.impulse_response(t).gain.sum(2)[..., 0], result.transfer())
    own = taps(result.channel, 1, 4, 20e6)
    assert torch.equal(result.taps(20e6).gain, own.gain) and result.size() == (1, 4)


def test_one_carrier_gives_the_whole_band_where_materials_do_not_turn():
    """Between metal walls gains go as the wavelength: 20 % of band from the carrier alone."""
    metal = [box_node(n.path, n.pose.translation.tolist(), n.body.shape.half_size.tolist(),
                      Conductor()) for n in room().nodes]  # fmt: skip
    scene = Scene(tuple(metal), room().transmitters, room().receivers)
    quality, f = Quality(depth=1), subcarriers(CARRIER, 0.2 * CARRIER, 9)
    carrier = simulate(scene, CARRIER, quality).channel
    band = simulate(scene, f, quality)
    found = frequency_response(carrier, 1, 4, f)[:, :, 0]
    assert torch.allclose(found, band.transfer(), rtol=1e-9, atol=1e-15)


def test_gains_are_interpolated_between_frequencies_and_held_beyond():
    """Without lambda, the gain here is 1, 1+1j, 3+1j at 2.5, 2, 3 GHz."""
    known = [2.5e9, 2.0e9, 3.0e9]
    rest = torch.tensor([1.0, 1 + 1j, 3 + 1j], dtype=torch.complex128)
    c = channel([0.0], (rest / real(known))[None], frequency=known)
    f = real([1.0e9, 2.0e9, 2.25e9, 2.5e9, 2.75e9, 9.0e9])
    found = frequency_response(c, 1, 1, f).flatten() * f
    expected = [1 + 1j, 1 + 1j, 1 + 0.5j, 1, 2 + 0.5j, 3 + 1j]
    assert found.numpy() == pytest.approx(np.array(expected), rel=1e-12)


def test_impulse_response_is_the_paths_in_order_and_sums_to_the_transfer():
    c = many(f=2)
    t = real([0.0, 1e-3, 7e-3])
    cir = impulse_response(c, 1, 3, t)
    assert cir.delay.shape == cir.gain.shape[:3]
    assert torch.allclose(cir.gain.sum(2)[..., 0], transfer(c, 1, 3), rtol=1e-12)
    count = torch.bincount(c.rx, minlength=3)
    for j in range(3):
        own = cir.delay[0, j, : count[j]]
        assert torch.equal(own, torch.sort(c.delay[c.rx == j]).values)
        assert not cir.gain[0, j, count[j] :].any() and not cir.delay[0, j, count[j] :].any()
    for s in range(3):
        h = frequency_response(c, 1, 3, c.frequency, t[s : s + 1])[:, :, 0]
        assert torch.allclose(cir.gain.sum(2)[..., s], h, rtol=1e-10, atol=1e-12)


def test_time_turns_a_path_by_its_doppler():
    """exp(+j 2 pi nu t) at the carrier, and in proportion at other frequencies."""
    c = channel([1e-6], torch.ones(1, 2), doppler=40.0, frequency=[1e9, 3e9])
    t = real([0.0, 2e-3, 5e-3])
    gain = impulse_response(c, 1, 1, t).gain.reshape(2, 3)
    for k, nu in enumerate((40.0, 120.0)):
        turned = gain[k] / gain[k, 0]
        expected = np.exp(2j * np.pi * nu * t.numpy())
        assert turned.numpy() == pytest.approx(expected, rel=1e-6)


def test_motion_and_doppler_agree():
    """h(t) from Doppler at t = 0 is h of the scene moved on by v t."""
    still = room()
    metres = real([3.0, -2.0, 0.5])
    start = still.receivers[0]
    fast = Radio(start.path, start.position, start.rotation, metres)
    f, t, quality = 28e9, 1e-5, Quality(depth=1)
    now = simulate(still.with_receivers([fast]), f, quality)
    later = Radio(start.path, start.position + t * metres, start.rotation, metres)
    then = simulate(still.with_receivers([later]), f, quality).transfer()
    predicted = frequency_response(now.channel, 1, 1, real([f]), real([t]))[:, :, 0]
    before = now.transfer()
    assert float((then - before).abs()) > 1e-3 * float(before.abs())  # it did move on
    assert float((predicted - then).abs()) < 1e-2 * float((then - before).abs())


def test_taps_of_a_delay_on_the_grid_are_one_tap():
    w = 20e6
    found = taps(channel([7 / w], [0.5j]), 1, 1, w)
    assert (found.first, found.gain.shape) == (1, (1, 1, 1, 13))
    phase = np.exp(-2j * np.pi * CARRIER * 7 / w)
    assert complex(found.gain[0, 0, 0, 6]) == pytest.approx(0.5j * phase, rel=1e-9)
    rest = torch.cat([found.gain[0, 0, 0, :6], found.gain[0, 0, 0, 7:]])
    assert float(rest.abs().max()) < 1e-14


def test_taps_are_the_bands_fourier_coefficients():
    """h_l = integral over -1/2..1/2 of H(f_0 + u W) exp(j 2 pi u l) du, by quadrature."""
    w = 20e6
    c = many(paths=8, links=2)
    # gains flat over the band (without their lambda), as taps have them
    flat = torch.cat([c.gain, c.gain, c.gain], 1)
    wide = channel(c.delay, flat, frequency=[CARRIER, CARRIER - w, CARRIER + w])
    found = taps(c, 1, 1, w, n_taps=9, first=-2).gain[0, 0, 0]
    node, weight = np.polynomial.legendre.leggauss(60)
    f = real(CARRIER + 0.5 * node * w)
    h = frequency_response(wide, 1, 1, f)[0, 0, 0].numpy()
    for number, tap in zip(range(-2, 7), found, strict=True):
        integral = (0.5 * weight * h * np.exp(1j * np.pi * node * number)).sum()
        assert complex(tap) == pytest.approx(integral, rel=1e-8, abs=1e-8)


def test_taps_hold_the_power_of_the_band():
    """Parseval: sum |h_l|^2 = mean of |H|^2 over the band, to the tail that n taps leave out."""
    w, n = 20e6, 4000
    c = many(paths=8, links=2)
    flat = torch.cat([c.gain, c.gain, c.gain], 1)
    wide = channel(c.delay, flat, frequency=[CARRIER, CARRIER - w, CARRIER + w])
    sampled = taps(c, 1, 1, w, n_taps=n, first=-n // 2).gain.abs().pow(2).sum()
    density = lambda u: float(frequency_response(wide, 1, 1, real([CARRIER + u * w])).abs() ** 2)  # noqa: E731, E501
    mean, _ = integrate.quad(density, -0.5, 0.5, limit=200)
    # |sinc(l)| <= 1 / (pi |l|): what lies beyond n / 2 holds no more than this
    tail = float(c.gain.abs().sum()) ** 2 * 2 / (math.pi**2 * (n / 2 - 20))
    assert 0.0 <= mean - float(sampled) <= tail < 0.03 * mean


def test_taps_and_subcarriers_are_a_discrete_fourier_pair_on_the_grid():
    """Delays on the grid: H(f_0 + k W / n) is the DFT of the taps, to rounding."""
    w, n = 20e6, 16
    delay = real([3.0, 5.0, 11.0]) / w
    c = channel(delay, [1, 0.5j, -0.25])
    f = subcarriers(CARRIER, w, n)
    h = frequency_response(c, 1, 1, f)[0, 0, 0] * f / CARRIER  # taps have the carrier's lambda
    sampled = taps(c, 1, 1, w, n_taps=n, first=0).gain[0, 0, 0]
    expected = torch.fft.fftshift(torch.fft.fft(sampled))
    assert torch.allclose(h, expected, rtol=1e-9, atol=1e-9)


def test_what_makes_no_response_is_refused():
    c = channel([1e-7], [1])
    for wrong in (real([0.0]), real([-1e9]), real([math.inf])):
        with pytest.raises(ValueError, match="frequency"):
            frequency_response(c, 1, 1, wrong)
    with pytest.raises(ValueError, match="values"):
        frequency_response(c, 1, 1, real([1e9]).expand(1 << 28))
    with pytest.raises(ValueError, match="values"):
        taps(c, 1, 1, 20e6, n_taps=1 << 28)
    with pytest.raises(ValueError, match="n_taps"):
        taps(c, 1, 1, 20e6, n_taps=0)
    with pytest.raises(ValueError, match="bandwidth"):
        taps(c, 1, 1, -1.0)
    with pytest.raises(ValueError, match="time"):
        impulse_response(c, 1, 1, real([math.nan]))
    for count, width in ((0, 1e6), (4, 0.0), (4, 5e9)):
        with pytest.raises(ValueError, match="band"):
            subcarriers(CARRIER, width, count)
    assert subcarriers(1e9, 4.0, 4).tolist() == [1e9 - 2, 1e9 - 1, 1e9, 1e9 + 1]
    assert subcarriers(1e9, 3.0, 3).tolist() == [1e9 - 1, 1e9, 1e9 + 1]


# noise and gradients


def test_thermal_noise():
    """k T B: -173.98 dBm in a hertz at 290 K; 20 MHz add 73.01 dB."""
    assert thermal_noise_dbm(1.0) == pytest.approx(-173.975, abs=1e-3)
    assert thermal_noise_dbm(20e6, 7.0) == pytest.approx(-173.975 + 73.0103 + 7.0, abs=1e-3)
    assert thermal_noise_dbm(1.0, temperature_k=580.0) == pytest.approx(-170.965, abs=1e-3)
    for wrong in ((0.0, 0.0, 290.0), (1.0, math.nan, 290.0), (1.0, 0.0, -1.0)):
        with pytest.raises(ValueError, match="noise"):
            thermal_noise_dbm(*wrong)


QUANTITIES = {
    "mean": lambda c: spreads.mean_delay(c, 1, 2),
    "rms": lambda c: spreads.delay_spread(c, 1, 2),
    "excess": lambda c: spreads.maximum_excess_delay(c, 1, 2),
    "k": lambda c: spreads.k_factor(c, 1, 2),
    "doppler": lambda c: spreads.doppler_spread(c, 1, 2),
    "angles": lambda c: torch.stack(spreads.angular_spreads(c, 1, 2)),
    "band": lambda c: spreads.coherence_bandwidth(c, 1, 2, 0.8),
    "time": lambda c: spreads.coherence_time(c, 1, 2, 0.8),
    "power": lambda c: power(c, 1, 2),
    "cfr": lambda c: frequency_response(c, 1, 2, real([9.0, 11.0]), real([0.0, 0.1])),
    "cir": lambda c: impulse_response(c, 1, 2, real([0.0, 0.1])).gain,
    "taps": lambda c: taps(c, 1, 2, 4.0, n_taps=5, first=-1, time=real([0.0, 0.1])).gain,
}


@pytest.mark.parametrize("name", QUANTITIES)
def test_gradients_are_those_of_differences(name):
    """With respect to gain, delay, Doppler and directions, in units of order one."""
    c = many(3, paths=9, links=3)
    start = [c.gain.real, c.gain.imag, c.delay * 1e7, c.doppler / 50.0, c.departure, c.arrival]
    start = [x.clone().requires_grad_() for x in start]

    def quantity(re, im, delay, doppler, departure, arrival):
        away = [d / d.norm(dim=-1, keepdim=True) for d in (departure, arrival)]
        made = Channel(c.tx, c.rx, real([10.0]), delay, torch.complex(re, im), doppler, *away,
                       c.crossed, c.blocked)  # fmt: skip
        found = QUANTITIES[name](made)
        return torch.view_as_real(found) if found.is_complex() else found

    assert torch.isfinite(quantity(*start)).all()
    assert torch.autograd.gradcheck(quantity, start, eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("name", QUANTITIES)
def test_gradients_stay_finite_where_a_quantity_has_none(name):
    """One path straight up; two equal ones; opposite ones; none at all on the second link."""
    for directions, delays in (([UP], [1.0]), ([EAST, EAST], [1.0, 1.0]), ([EAST, WEST], [1.0, 2])):
        p = len(directions)
        parts = [
            torch.ones(p, 1),
            torch.zeros(p, 1),
            real(delays),
            torch.zeros(p),
            real(directions),
        ]
        parts = [x.double().clone().requires_grad_() for x in parts]
        re, im, delay, doppler, away = parts
        plain = channel(delays, torch.ones(p))
        made = Channel(plain.tx, plain.rx, real([10.0]), delay, torch.complex(re, im), doppler, away,
                       away, plain.crossed, plain.blocked)  # fmt: skip
        found = QUANTITIES[name](made)
        found = torch.view_as_real(found) if found.is_complex() else found
        assert not torch.isnan(found).any()
        total = torch.where(torch.isfinite(found), found, 0.0).sum()
        for gradient in torch.autograd.grad(
            total, parts, allow_unused=True, materialize_grads=True
        ):
            assert torch.isfinite(gradient).all()


def test_line_of_sight_of_a_simulation():
    result = simulate(room(), CARRIER, Quality(depth=1))
    assert line_of_sight(result.paths, result.channel, 1, 4).tolist() == [[1, 1, 1, 1]]
    wall = box_node("/wall", (1.17, 1.66, 1.4), (0.3, 0.02, 0.4))  # between the radios of link 0
    hidden = Scene((*room().nodes, wall), room().transmitters, room().receivers)
    result = simulate(hidden, CARRIER, Quality(depth=1))
    assert line_of_sight(result.paths, result.channel, 1, 4).tolist() == [[0, 1, 1, 1]]
    rows = result.links()
    assert [row["los"] for row in rows] == [False, True, True, True]
    for row in rows:
        assert not any(isinstance(v, float) and math.isnan(v) for v in row.values())
    h = coefficients(result.channel)[:, 0]
    best = rows[1]
    mine = result.channel.rx == 1
    assert best["path_gain_db"] == pytest.approx(20 * math.log10(abs(complex(h[mine].sum()))))
    assert best["n_paths"] == int(mine.sum())
