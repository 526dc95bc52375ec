"""How a channel spreads: in delay, angle and Doppler, and over what band and time it stays alike.

Every path weighs |gain|^2; phases play no part. Results are [t r f], one number per transmitter,
receiver and frequency, and differentiable: a gradient is zero, not NaN, where a quantity has none.
A link without paths has mean delay, spreads and K-factor 0, and coherence inf.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.tracer.links import largest, link_of, strongest, summed
from rfsg.tracer.records import Channel

LEAST_RESULTANT = 1e-6  # directions that balance spread without bound: stop at 301 degrees
FARTHEST = 10.0  # [1 / rms spread] correlation is followed this far, 60 times its least reach
LEAST_STEP = 0.01  # of correlation: dips that pass the level by half of it may be stepped over
HALVINGS = 26  # of a step: one Newton step from there is exact to rounding
NO_SPREAD = 1e-13  # an rms below this share of the values themselves is their rounding


class AngularSpreads(NamedTuple):
    """Circular standard deviations [rad], world frame: azimuth and zenith, departure and arrival."""

    asd: Float[Tensor, "t r f"]
    asa: Float[Tensor, "t r f"]
    zsd: Float[Tensor, "t r f"]
    zsa: Float[Tensor, "t r f"]


def mean_delay(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r f"]:
    """Power-weighted mean of the delays [s], from departure (ITU-R P.1407-6 section 2.2.2)."""
    return _moments(channel, channel.delay[:, None], n_tx, n_rx)[0]


def delay_spread(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r f"]:
    """rms delay spread [s]: square root of the second central moment (ITU-R P.1407-6 section 2.2.3)."""
    return _moments(channel, channel.delay[:, None], n_tx, n_rx)[1]


def doppler_spread(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r f"]:
    """rms Doppler spread [Hz], the delay spread's formula over Doppler shifts."""
    return _moments(channel, doppler_shift(channel), n_tx, n_rx)[1]


def doppler_shift(channel: Channel) -> Float[Tensor, "p f"]:
    """Doppler shift of each path at every frequency [Hz]: it grows with the frequency."""
    return channel.doppler[:, None] * (channel.frequency / channel.frequency[:1])


def maximum_excess_delay(
    channel: Channel, n_tx: int, n_rx: int, threshold_db: float = 20.0
) -> Float[Tensor, "t r f"]:
    """From the first to the last path within ``threshold_db`` of the strongest [s].

    ITU-R P.1407-6 section 2.2.5, "delay interval"; T. S. Rappaport, Wireless Communications,
    2nd ed., section 5.4.1, "maximum excess delay (X dB)". Raises ValueError for a negative threshold.
    """
    if not threshold_db >= 0.0:
        raise ValueError(f"threshold_db={threshold_db!r}: expected dB below the strongest, >= 0")
    weight, f = _weight(channel).detach(), len(channel.frequency)
    peak = largest(channel, weight, n_tx, n_rx).reshape(-1, f)[link_of(channel, n_rx)]
    path, k = torch.nonzero(
        (weight > 0) & (weight >= peak * 10.0 ** (-threshold_db / 10.0)), as_tuple=True
    )
    cell = link_of(channel, n_rx)[path] * f + k
    zero = channel.delay.new_zeros(n_tx * n_rx * f)
    ends = [
        zero.scatter_reduce(0, cell, channel.delay[path], which, include_self=False)
        for which in ("amin", "amax")
    ]
    return (ends[1] - ends[0]).reshape(n_tx, n_rx, f)


def k_factor(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r f"]:
    """Rician K: power of the strongest path over that of all others together (linear).

    T. S. Rappaport, Wireless Communications, 2nd ed., section 5.6.2 (Ricean fading); the line of
    sight, where there is one, is nearly always the strongest. inf for a single path, 0 for none.
    """
    weight = _weight(channel)
    chief = strongest(channel, weight.detach(), n_tx, n_rx)
    direct = summed(channel, torch.where(chief, weight, 0.0), n_tx, n_rx)
    rest = summed(channel, torch.where(chief, 0.0, weight), n_tx, n_rx)
    alone = rest == 0
    ratio = direct / torch.where(alone, 1.0, rest)
    return torch.where(alone, torch.where(direct > 0, torch.inf, 0.0), ratio)


def angular_spreads(channel: Channel, n_tx: int, n_rx: int) -> AngularSpreads:
    """sqrt(-2 ln |sum P exp(j phi)| / sum P) of azimuth and zenith (3GPP TR 38.901 Annex A.1;
    3GPP TR 25.996). The vertical has azimuth 0. At most 5.26 rad, where directions balance out."""
    azimuths, zeniths = zip(*map(_phasors, (channel.departure, channel.arrival)), strict=True)
    return AngularSpreads(*(_circular(channel, a, n_tx, n_rx) for a in (*azimuths, *zeniths)))


def coherence_bandwidth(
    channel: Channel, n_tx: int, n_rx: int, level: float = 0.5
) -> Float[Tensor, "t r f"]:
    """Least df [Hz] at which |R(df)| has fallen to ``level``, R(df) = sum P exp(-j 2 pi df tau) / sum P.

    ITU-R P.1407-6 section 5.2.1; usual levels are 0.5 and 0.9. Never below arccos(level) /
    (2 pi rms delay spread) (B. H. Fleury 1996, 'An uncertainty relation for WSS processes and its
    application to WSSUS systems', IEEE Trans. Commun. 44(12)). inf where it does not fall within ten
    over the spread: one path, or one that outweighs all others. Raises ValueError unless 0 < level < 1.
    """
    return _coherence(channel, channel.delay[:, None], n_tx, n_rx, level)


def coherence_time(
    channel: Channel, n_tx: int, n_rx: int, level: float = 0.5
) -> Float[Tensor, "t r f"]:
    """Least dt [s] at which |R(dt)| has fallen to ``level``, R(dt) = sum P exp(j 2 pi nu dt) / sum P.

    ITU-R P.1407-6 section 5.2.2; bound, inf and ValueError as for ``coherence_bandwidth``.
    """
    return _coherence(channel, doppler_shift(channel), n_tx, n_rx, level)


# moments


def _weight(channel: Channel) -> Float[Tensor, "p f"]:
    return channel.gain.real**2 + channel.gain.imag**2


def _moments(
    channel: Channel, value: Float[Tensor, "p #f"], n_tx: int, n_rx: int
) -> tuple[Tensor, Tensor]:
    """Mean and rms deviation over each link, by power."""
    weight = _weight(channel)
    share = (
        weight / _safe(summed(channel, weight, n_tx, n_rx)).flatten(0, 1)[link_of(channel, n_rx)]
    )
    mean = summed(channel, share * value, n_tx, n_rx)
    # about the mean, so that small spreads of long delays keep their digits
    away = value - mean.flatten(0, 1)[link_of(channel, n_rx)]
    return mean, _root(summed(channel, share * away**2, n_tx, n_rx))


def _safe(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, torch.ones_like(x))


def _root(square: Tensor) -> Tensor:
    """Square root with gradient 0 at 0."""
    return torch.where(square > 0, torch.sqrt(_safe(square)), torch.zeros_like(square))


# angles


def _phasors(direction: Float[Tensor, "p 3"]) -> tuple[Tensor, Tensor]:
    """exp(j azimuth) and exp(j zenith) [p]."""
    x, y, z = direction.unbind(-1)
    square = x**2 + y**2
    level = square > 1e-24
    azimuth = torch.complex(
        torch.where(level, x, torch.ones_like(x)), torch.where(level, y, torch.zeros_like(y))
    )
    return torch.sgn(azimuth), torch.complex(z, _root(square))


def _circular(channel: Channel, phasor: Complex[Tensor, "p"], n_tx: int, n_rx: int) -> Tensor:
    """sqrt(-2 ln R), with 1 - R = sum P |c - mean|^2 / 2 / sum P: no digits lost where R is near 1."""
    weight = _weight(channel)
    # R is stationary in the mean direction, so its gradient needs none of it
    mean = torch.sgn(summed(channel, weight * phasor[:, None], n_tx, n_rx).detach())
    mean = torch.where(mean == 0, torch.ones_like(mean), mean)  # any will do where they balance
    apart = phasor[:, None] - mean.flatten(0, 1)[link_of(channel, n_rx)]
    total = _safe(summed(channel, weight, n_tx, n_rx))
    short = summed(channel, weight * (apart.real**2 + apart.imag**2) / 2.0, n_tx, n_rx) / total
    return _root(-2.0 * torch.log1p(-short.clamp(max=1.0 - LEAST_RESULTANT)))


# correlation


def _coherence(
    channel: Channel, value: Float[Tensor, "p #f"], n_tx: int, n_rx: int, level: float
) -> Tensor:
    if not 0.0 < level < 1.0:
        raise ValueError(f"level={level!r}: expected a correlation between 0 and 1")
    weight, link = _weight(channel), link_of(channel, n_rx)
    rms = _moments(channel, value, n_tx, n_rx)[1].detach().flatten(0, 1)
    peak = largest(channel, weight.detach(), n_tx, n_rx).flatten(0, 1)
    total = summed(channel, weight.detach(), n_tx, n_rx).flatten(0, 1)
    size = largest(channel, value.detach().abs().expand_as(weight), n_tx, n_rx).flatten(0, 1)
    # |R| >= 2 peak / total - 1: what one path outweighs so far never falls to the level
    falls = (rms > NO_SPREAD * size) & (peak < 0.5 * (1.0 + level) * total)
    columns = []
    for k in range(weight.shape[1]):
        some = torch.nonzero(falls[:, k]).squeeze(-1)
        number = torch.full_like(falls[:, k], -1, dtype=torch.int64)
        number[some] = torch.arange(len(some), device=some.device)
        mine = torch.nonzero(falls[link, k]).squeeze(-1)
        at = value[mine, k if value.shape[1] > 1 else 0]
        found = _first_fall(weight[mine, k], at, number[link[mine]], rms[some, k], level)
        inf = torch.full_like(rms[:, k], torch.inf)
        columns.append(inf.index_copy(0, some, found))
    return torch.stack(columns, -1).reshape(n_tx, n_rx, weight.shape[1])


def _first_fall(
    weight: Float[Tensor, "m"], value: Tensor, link: Tensor, rms: Float[Tensor, "n"], level: float
) -> Float[Tensor, "n"]:
    """Where |R(x)| first falls to the level, or inf; found by steps that cannot pass it.

    |R| falls no faster than 2 pi rms, and is at least cos(2 pi rms x) (Fleury): so a step of
    (|R| - level) / (2 pi rms) is safe. The last step is halved; one differentiable Newton step ends.
    """
    steepest = 2.0 * math.pi * rms
    low, high = torch.zeros_like(rms), math.acos(level) / steepest
    active = torch.ones_like(rms, dtype=torch.bool)
    fell = torch.zeros_like(active)
    with torch.no_grad():
        while bool(active.any()):
            size, _ = _correlation(weight, value, link, high, active)
            fell |= active & (size <= level)
            active &= (size > level) & (high < FARTHEST / rms)
            step = (size - level).clamp(min=LEAST_STEP) / steepest
            low, high = torch.where(active, high, low), torch.where(active, high + step, high)
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            above = _correlation(weight, value, link, middle, fell)[0] > level
            low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    size, slope = _correlation(weight, value, link, high, fell)
    slope = slope.detach()
    steep = slope.abs() > 1e-6 * steepest  # at the bottom of a dip there is no slope to follow
    moved = high - torch.where(steep, (size - level) / torch.where(steep, slope, 1.0), 0.0)
    return torch.where(fell, moved, torch.inf)


def _correlation(
    weight: Tensor, value: Tensor, link: Tensor, x: Float[Tensor, "n"], active: Tensor
) -> tuple[Tensor, Tensor]:
    """|R| and d|R|/dx of the active links at x; 0 elsewhere."""
    i = torch.nonzero(active[link]).squeeze(-1)
    zero = torch.zeros_like(x)
    total = _safe(zero.index_add(0, link[i], weight[i]))
    share = weight[i] / total[link[i]]
    # about the mean value: |R| is the same, and the phases stay small
    away = value[i] - zero.index_add(0, link[i], share * value[i])[link[i]]
    angle = 2.0 * math.pi * away * x[link[i]]
    wave = torch.polar(share, angle)
    r = torch.zeros_like(x, dtype=wave.dtype).index_add(0, link[i], wave)
    turning = torch.zeros_like(r).index_add(0, link[i], wave * (2j * math.pi * away))
    size = _root(r.real**2 + r.imag**2)
    return size, (r.conj() * turning).real / _safe(size)
