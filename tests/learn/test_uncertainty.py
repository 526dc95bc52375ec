"""The transport model as a distribution: means, closed forms, a plain twin, coverage."""

import math

import pytest
import torch

from rfsg.learn.depths import depths
from rfsg.learn.kept import Kept
from rfsg.learn.links import link_up
from rfsg.learn.uncertainty import (
    DRAWS,
    OPACITIES,
    LinkPaths,
    Table,
    Uncertainty,
    crossed_coverage,
    most_likely,
    widened,
    widening,
)
from tests.learn.rooms import QUALITY, learned, readings, room_with, thing

SEEDS = range(40)


def paths(*links, coherent=False) -> LinkPaths:
    """Links of (amplitude, depth) pairs at one frequency."""
    count = torch.tensor([len(link) for link in links])
    begin = torch.cat([torch.zeros(1, dtype=torch.int64), count.cumsum(0)])
    flat = [path for link in links for path in link]
    value = torch.tensor([[a] for a, _ in flat], dtype=torch.complex128)
    depth = torch.tensor([[d] for _, d in flat], dtype=torch.float64)
    return LinkPaths.ranked(begin, value, depth, coherent)


def zeros(n: int) -> torch.Tensor:
    return torch.zeros(n, dtype=torch.int64)


def drawn(of: LinkPaths, opacity: float, link: int = 0) -> torch.Tensor:
    """Drawn over predicted power of one link, over many seeds."""
    one = torch.tensor([link])
    parts = [of.drawn_db(one, zeros(1), opacity, seed)[0] for seed in SEEDS]
    return 10.0 ** (torch.cat(parts) / 10.0)


MIXED = [(1.0 + 0.2j, 0.0), (-0.5j, 1.0), (0.4, 2.5), (0.2 - 0.1j, 0.3)]


# the law


@pytest.mark.parametrize("opacity", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_the_mean_power_is_the_sum_over_paths(opacity):
    """E[P] = sum T_i g_i (the module's own identity, from the Poisson generating function)."""
    ratio = drawn(paths(MIXED), opacity)
    error = ratio.std() / math.sqrt(len(ratio))
    assert abs(float(ratio.mean()) - 1.0) < 4.0 * float(error)
    total = sum(abs(a) ** 2 for a, _ in MIXED)
    assert float(paths(MIXED).power(zeros(1), zeros(1))[0]) == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("opacity", [0.2, 0.9])
def test_the_mean_coherent_power_is_that_of_the_mean_field_and_its_variance(opacity):
    """E[sqrt(F)] = exp(-(t / q)(1 - sqrt(1 - q))), E[F] = exp(-t) (Poisson generating function)."""
    of = paths(MIXED, coherent=True)
    field, spread = 0.0, 0.0
    for a, t in MIXED:
        mean = math.exp(0.5 * t - t / opacity * (1.0 - math.sqrt(1.0 - opacity)))
        field, spread = field + a * mean, spread + abs(a) ** 2 * (1.0 - mean**2)
    expected = (abs(field) ** 2 + spread) / abs(sum(a for a, _ in MIXED)) ** 2
    ratio = drawn(of, opacity)
    error = float(ratio.std()) / math.sqrt(len(ratio))
    assert abs(float(ratio.mean()) - expected) < 4.0 * error


def test_an_opaque_obstacle_lets_all_or_nothing_on():
    """The paper's own: a path survives with probability T = exp(-t) (Eq. 8)."""
    ratio = drawn(paths([(1.0, 1.2)]), 1.0)
    there = ratio > 1e-6
    torch.testing.assert_close(ratio[there], torch.full_like(ratio[there], math.exp(1.2)))
    share, survival = float(there.double().mean()), math.exp(-1.2)
    assert abs(share - survival) < 4.0 * math.sqrt(survival * (1.0 - survival) / len(ratio))


def test_many_equal_paths_fade_as_rayleigh_has_it():
    """With random phases the power of many paths is exponential: P(power < x) = 1 - exp(-x)."""
    ratio = drawn(paths([(1.0, 0.0)] * 40), 0.0)
    for x in (0.1, 0.7, 2.0):
        share, expected = float((ratio < x).double().mean()), 1.0 - math.exp(-x)
        band = 4.0 * math.sqrt(expected * (1.0 - expected) / len(ratio))
        assert abs(share - expected) < band + 1.0 / 40  # of order 1 / paths from the limit


def test_what_is_known_and_coherent_does_not_vary():
    of = paths([(1.0, 0.0), (0.5j, 0.0)], coherent=True)
    assert bool((of.drawn_db(zeros(1), zeros(1), 0.5) == 0.0).all())


def plain(link, opacity, draws, generator) -> torch.Tensor:
    """The same law without tables: power of one link over its mean, by torch's own Poisson."""
    a = torch.tensor([abs(x) for x, _ in link], dtype=torch.float64)
    t = torch.tensor([d for _, d in link], dtype=torch.float64)
    met = torch.poisson((t / opacity).expand(draws, -1), generator=generator)
    root = (0.5 * (met * math.log1p(-opacity) + t)).exp()
    phase = 2.0 * math.pi * torch.rand(draws, len(link), generator=generator, dtype=torch.float64)
    field = (a * root * torch.polar(torch.ones_like(phase), phase)).sum(-1)
    return field.abs() ** 2 / (a**2).sum()


def test_the_tables_draw_what_a_plain_monte_carlo_draws():
    """Two empirical distributions: Kolmogorov and Smirnov's distance at a level of 1e-4."""
    one = drawn(paths(MIXED), 0.5).sort().values
    two = plain(MIXED, 0.5, len(one), torch.Generator().manual_seed(7)).sort().values
    at = torch.cat([one, two])
    apart = torch.searchsorted(one, at, right=True) - torch.searchsorted(two, at, right=True)
    bound = math.sqrt(-0.5 * math.log(0.5e-4)) * math.sqrt(2.0 / len(one))
    assert float(apart.abs().max()) / len(one) < bound


def test_paths_beyond_the_strongest_keep_their_power():
    many = [(0.1 * (k % 7 + 1), 0.1) for k in range(90)]
    for coherent in (False, True):
        of = paths(many, [(1.0, 0.0)], coherent=coherent)
        total = sum(a for a, _ in many) ** 2 if coherent else sum(a**2 for a, _ in many)
        assert float(of.power(zeros(1), zeros(1))[0]) == pytest.approx(total, rel=1e-12)
    ratio = drawn(paths(many), 0.5)
    assert abs(float(ratio.mean()) - 1.0) < 4.0 * float(ratio.std()) / math.sqrt(len(ratio))


def test_a_links_draws_depend_on_nothing_but_the_seed():
    of = paths(MIXED, [(0.3, 0.7)], [], [(2.0, 0.0), (1.0, 3.0)])
    together = of.drawn_db(torch.tensor([0, 1, 2, 3] * 40), zeros(160), 0.2, seed=3)
    alone = of.drawn_db(torch.tensor([3]), zeros(1), 0.2, seed=3)
    assert torch.equal(together[3::4], alone.expand(40, DRAWS))
    assert not torch.equal(alone, of.drawn_db(torch.tensor([3]), zeros(1), 0.2, seed=4))
    assert bool((together[2] == 0.0).all())  # a link without a path


def test_an_opacity_out_of_range_is_refused():
    with pytest.raises(ValueError, match="opacity: 1.5"):
        Table.of(2, 1.5, 0)


# depths


def test_depths_are_the_losses_of_what_is_learned():
    """exp(-depth) is the power of a path over its power without the learned coefficients."""
    scene = room_with(thing(learned(0, m=0.3, sharpness=15.0)), count=10)
    kept = Kept(scene, link_up(scene, readings(scene)), QUALITY, [], [])
    flags = kept.world.learned_surface
    bare = kept._channel(kept.world, kept.proxies, kept.paths, kept.through, flags)
    full = kept._channel(kept.world, kept.proxies, kept.paths, kept.through)
    there = bare.gain.abs() > 0
    share = (full.gain.abs()[there] / bare.gain.abs()[there]) ** 2
    found = torch.exp(-depths(kept))[there]
    torch.testing.assert_close(found.clamp(min=1e-29), share.clamp(min=1e-29), rtol=1e-6, atol=0.0)
    mirrored = (flags[kept.paths.which.clamp(min=0)] & (kept.paths.which >= 0)).any(1)
    crossed = torch.zeros_like(mirrored)
    crossed[kept.through.path[flags[kept.through.which]]] = True
    assert bool(mirrored.any()) and bool(crossed.any())
    assert bool((depths(kept)[~mirrored & ~crossed] == 0.0).all())


# what readings say of it


def world_of(count: int, seed: int) -> tuple[LinkPaths, list]:
    """Links as a furnished room has them: a few known paths and a few that were obstructed."""
    g = torch.Generator().manual_seed(seed)
    links = []
    for _ in range(count):
        k = int(torch.randint(1, 5, (1,), generator=g))
        size = torch.rand(k, generator=g) ** 2 + 0.01
        deep = 5.0 * torch.rand(k, generator=g) * (torch.rand(k, generator=g) < 0.7)
        links.append(list(zip(size.tolist(), deep.tolist(), strict=True)))
    return paths(*links), links


def readings_of(links, opacity, noise, offset, seed) -> torch.Tensor:
    """Readings less predictions [dB], one a link, by the plain twin."""
    g = torch.Generator().manual_seed(seed)
    power = torch.cat([plain(link, opacity, 1, g) for link in links])
    return (
        10.0 * torch.log10(power) + offset + noise * torch.randn(len(links), generator=g).double()
    )


def test_the_interval_of_the_true_law_covers_nine_tenths():
    of, links = world_of(1500, 1)
    off = readings_of(links, 0.5, 2.0, 1.0, 2)
    each = torch.arange(len(links))
    low, high = Uncertainty(0.5, 2.0, 1.0).interval(off.new_zeros(len(off)), of, each, zeros(1500))
    share = float(((low <= off) & (off <= high)).double().mean())
    # of 256 draws, the quantiles of a link are off by as much as a share of 256 readings is
    band = 4.0 * math.sqrt(0.09 / 1500) + math.sqrt(0.9 * 0.1 / DRAWS)
    assert abs(share - 0.9) < band
    # wider where more was learned to be in the way
    deep = of.depth[:, 0].amax(-1)
    assert (high - low)[deep > 3.0].mean() > (high - low)[deep == 0.0].mean() + 3.0


def test_noise_offset_and_opacity_come_back_and_new_readings_are_covered():
    of, links = world_of(1600, 3)
    off = readings_of(links, 0.5, 2.0, 1.0, 4)
    train, check, test = torch.arange(500), torch.arange(500, 900), torch.arange(900, 1600)
    sure = most_likely(off[train], of, train, zeros(500))
    assert sure.opacity == 0.5 and sure.opacity in OPACITIES
    assert sure.noise_db == pytest.approx(2.0, abs=0.4)
    assert sure.offset_db == pytest.approx(1.0, abs=0.6)
    none = off.new_zeros(1600)
    low, high = sure.interval(none, of, torch.arange(1600), zeros(1600))
    by = widening(off[check], low[check], high[check])
    a, b = widened(low[test], high[test], by)
    share = float(((a <= off[test]) & (off[test] <= b)).double().mean())
    # coverage given the calibrating readings is Beta distributed (Angelopoulos and Bates 2021, 3.2)
    assert abs(share - 0.9) < 4.0 * math.sqrt(0.09 / 400 + 0.09 / 700)


def test_of_what_does_not_vary_the_noise_is_the_standard_deviation():
    of = paths(*[[(1.0, 0.0)]] * 50, coherent=True)
    off = torch.randn(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sure = most_likely(off, of, torch.arange(50), zeros(50))
    assert sure.opacity == 0.0
    assert sure.offset_db == pytest.approx(float(off.mean()), abs=1e-9)
    assert sure.noise_db == pytest.approx(float(off.std(correction=0)), rel=1e-9)
    low, high = sure.interval(off.new_zeros(50), of, torch.arange(50), zeros(50))
    half = 1.6448536269514722 * sure.noise_db  # the 95 % point of the normal law
    torch.testing.assert_close(high - low, torch.full_like(low, 2.0 * half), rtol=1e-6, atol=0.0)


# calibration


def test_widening_is_the_rank_that_split_conformal_asks_for():
    y = torch.arange(1.0, 20.0, dtype=torch.float64)  # 19 readings: the 18th smallest score
    zero = torch.zeros_like(y)
    assert widening(y, zero, zero) == 18.0
    assert widening(y[:5], zero[:5], zero[:5]) == 5.0
    assert widening(y, zero - 50.0, zero + 50.0) == -32.0
    with pytest.raises(ValueError, match="no reading"):
        widening(y[:0], zero[:0], zero[:0])


def test_an_interval_never_turns_inside_out():
    low, high = torch.tensor([0.0, 0.0]).double(), torch.tensor([1.0, 9.0]).double()
    a, b = widened(low, high, -2.0)
    assert a.tolist() == [0.5, 2.0] and b.tolist() == [0.5, 7.0]


def test_halves_calibrate_each_other():
    g = torch.Generator().manual_seed(5)
    y = torch.randn(2000, generator=g, dtype=torch.float64)
    share = crossed_coverage(y, torch.full_like(y, -0.1), torch.full_like(y, 0.1))
    assert abs(share - 0.9) < 4.0 * math.sqrt(0.09 / 1000 + 0.09 / 2000)
    assert crossed_coverage(y[:1], y[:1], y[:1]) is None
