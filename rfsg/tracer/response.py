"""What a channel does to a signal: impulse response, frequency response, taps, and their course in time.

All follow from one thing: the delay of a path at time t, tau(t) = tau - (nu / f_0) t with nu its
Doppler shift at the first frequency f_0. A wave of frequency f then carries exp(-j 2 pi f tau(t)),
which is exp(+j 2 pi nu t) at f_0. Gains and directions are those of t = 0: right for as long as
radios and objects move little against their distances.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.tracer.links import link_of, summed
from rfsg.tracer.records import Channel
from rfsg.tracer.spreads import doppler_shift

MOST_VALUES = 1 << 27  # complex numbers in one response: 2 GiB; more is a mistyped size
AT_ONCE = 1 << 22  # path shares in memory at a time
SIDE_TAPS = 6  # taps before the first and after the last path; a sinc is below 6 % there


@dataclass(frozen=True)
class ImpulseResponse:
    """h(t, tau) = sum_l gain_l(t) delta(tau - delay_l), per link, earliest path first.

    gain holds the phase of the carrier; delay [s] is that of t = 0. Padded with zeros.
    """

    time: Float[Tensor, "s"]
    delay: Float[Tensor, "t r l"]
    gain: Complex[Tensor, "t r l f s"]


@dataclass(frozen=True)
class Taps:
    """Taps of the sampled baseband channel: gain[..., i] is tap ``first`` + i, at (first + i) / bandwidth."""

    bandwidth: float
    first: int
    gain: Complex[Tensor, "t r s l"]


def subcarriers(carrier: float, bandwidth: float, count: int) -> Float[Tensor, "k"]:
    """``count`` frequencies [Hz] spaced bandwidth / count, the carrier at number count // 2.

    Raises ValueError for a band that is empty or reaches below 0 Hz.
    """
    if not (count >= 1 and 0.0 < bandwidth < math.inf and carrier > 0.5 * bandwidth):
        raise ValueError(
            f"band of {count} sub-carriers over {bandwidth!r} Hz about {carrier!r} Hz: expected "
            "at least one, a bandwidth above 0, and half of it below the carrier"
        )
    number = torch.arange(count, dtype=torch.float64) - count // 2
    return carrier + number * (bandwidth / count)


def at_carrier(channel: Channel, k: int) -> Channel:
    """The channel at its k-th frequency alone."""
    jones = None if channel.jones is None else channel.jones[:, k : k + 1]
    return replace(
        channel,
        frequency=channel.frequency[k : k + 1],
        gain=channel.gain[:, k : k + 1],
        doppler=doppler_shift(channel)[:, k],
        jones=jones,
    )


def impulse_response(
    channel: Channel, n_tx: int, n_rx: int, time: Float[Tensor, "s"] | None = None
) -> ImpulseResponse:
    """Delays and complex gains of the paths of every link, at ``time`` [s] (by default t = 0)."""
    time = _time(channel, time)
    link = link_of(channel, n_rx)
    by_delay = torch.argsort(channel.delay.detach(), stable=True)
    order = by_delay[torch.argsort(link[by_delay], stable=True)]
    count = torch.bincount(link, minlength=n_tx * n_rx)
    most = int(count.max()) if len(count) else 0
    _refuse_large(len(count) * most, len(channel.frequency) * len(time))
    begin = torch.cumsum(count, 0) - count
    slot = torch.arange(len(link), device=link.device) - begin[link[order]]
    gain = channel.gain[..., None] * _wave(channel, channel.frequency, time)
    place = (link[order], slot)
    delays = channel.delay.new_zeros(len(count), most).index_put(place, channel.delay[order])
    gains = gain.new_zeros(len(count), most, *gain.shape[1:]).index_put(place, gain[order])
    return ImpulseResponse(
        time,
        delays.reshape(n_tx, n_rx, most),
        gains.reshape(n_tx, n_rx, most, *gain.shape[1:]),
    )


def frequency_response(
    channel: Channel,
    n_tx: int,
    n_rx: int,
    frequency: Float[Tensor, "k"],
    time: Float[Tensor, "s"] | None = None,
) -> Complex[Tensor, "t r s k"]:
    """h(f, t) = sum of gain(f) exp(-j 2 pi f tau(t)) at any frequencies [Hz] and times [s].

    Phases of delays are exact. Gains follow lambda / 4 pi exactly; what objects and antennas add is
    that of the carrier, or interpolated (complex, linear) between the frequencies of a channel that
    has several, and held beyond them. Where materials turn within the band, simulate at
    ``frequency`` itself instead: then nothing is interpolated. Raises ValueError for frequencies
    that are not positive and for a response too large.
    """
    time = _time(channel, time)
    wide = len(time) * len(frequency)
    _refuse_large(n_tx * n_rx, wide)
    frequency = frequency.to(channel.frequency)
    if not bool((torch.isfinite(frequency) & (frequency > 0)).all()):
        raise ValueError("frequency: expected positive finite hertz at every sub-carrier")
    total = channel.gain.new_zeros(n_tx, n_rx, len(time), len(frequency))
    for i in _portions(channel, wide):
        some = _some(channel, i)
        share = _gain_at(some, frequency)[..., None] * _wave(some, frequency, time)
        total = total + summed(some, share.transpose(1, 2), n_tx, n_rx)
    return total


def taps(
    channel: Channel,
    n_tx: int,
    n_rx: int,
    bandwidth: float,
    n_taps: int | None = None,
    first: int | None = None,
    time: Float[Tensor, "s"] | None = None,
) -> Taps:
    """Taps of the channel at its first frequency, sampled at ``bandwidth`` W [Hz].

    h_l(t) = sum of gain exp(-j 2 pi f_0 tau(t)) sinc(l - W tau(t)): D. Tse and P. Viswanath,
    Fundamentals of Wireless Communication, Eqs. 2.34 and 2.35. The sinc is not causal: without
    ``first`` and ``n_taps`` they reach six taps before the earliest and after the latest path.
    Gains are the carrier's over the whole band. Raises ValueError for sizes that make no response.
    """
    if not (0.0 < bandwidth < math.inf):
        raise ValueError(f"bandwidth={bandwidth!r}: expected positive finite hertz")
    time = _time(channel, time)
    reach = _delay_at(channel, time).detach() * bandwidth
    earliest, latest = (
        (math.floor(float(reach.min())), math.ceil(float(reach.max()))) if len(reach) else (0, 0)
    )
    first = earliest - SIDE_TAPS if first is None else first
    n_taps = max(1, latest + SIDE_TAPS - first + 1) if n_taps is None else n_taps
    if n_taps < 1:
        raise ValueError(f"n_taps={n_taps!r}: expected at least one")
    _refuse_large(n_tx * n_rx, len(time) * n_taps)
    number = torch.arange(first, first + n_taps, dtype=torch.float64, device=time.device)
    carrier = at_carrier(channel, 0)
    total = carrier.gain.new_zeros(n_tx, n_rx, len(time), n_taps)
    for i in _portions(carrier, len(time) * n_taps):
        some = _some(carrier, i)
        share = some.gain * _wave(some, some.frequency, time)[:, 0]
        pulse = torch.sinc(number - bandwidth * _delay_at(some, time)[..., None])
        total = total + summed(some, share[..., None] * pulse, n_tx, n_rx)
    return Taps(bandwidth, first, total)


def _time(channel: Channel, time: Tensor | None) -> Float[Tensor, "s"]:
    given = torch.zeros(1) if time is None else time
    given = given.to(channel.delay).reshape(-1)
    if not len(given) or not bool(torch.isfinite(given).all()):
        raise ValueError(f"time: expected finite seconds, one or more, got {time!r}")
    return given


def _delay_at(channel: Channel, time: Float[Tensor, "s"]) -> Float[Tensor, "p s"]:
    """Delay of each path at each time [s]."""
    drift = channel.doppler / channel.frequency[0]
    return channel.delay[:, None] - drift[:, None] * time


def _wave(
    channel: Channel, frequency: Float[Tensor, "k"], time: Float[Tensor, "s"]
) -> Complex[Tensor, "p k s"]:
    """exp(-j 2 pi f tau(t)); the phase is reduced in float64 turns."""
    turns = frequency[:, None] * _delay_at(channel, time)[:, None]
    angle = -2.0 * math.pi * (turns - torch.floor(turns.detach()))
    return torch.polar(torch.ones_like(angle), angle)


def _gain_at(channel: Channel, frequency: Float[Tensor, "k"]) -> Complex[Tensor, "p k"]:
    """gain(f), with its factor lambda / 4 pi exact and the rest between the channel's frequencies."""
    known, order = torch.sort(channel.frequency)
    rest = channel.gain[:, order] * known
    above = torch.searchsorted(known, frequency).clamp(max=len(known) - 1)
    below = (above - 1).clamp(min=0)
    gap = known[above] - known[below]
    part = (frequency - known[below]) / torch.where(gap > 0, gap, torch.ones_like(gap))
    part = torch.where(gap > 0, part.clamp(0.0, 1.0), torch.zeros_like(part))
    return (rest[:, below] * (1.0 - part) + rest[:, above] * part) / frequency


def _portions(channel: Channel, wide: int) -> tuple[Tensor, ...]:
    every = torch.arange(len(channel.tx), device=channel.tx.device)
    return every.split(max(1, AT_ONCE // max(1, wide)))


def _some(channel: Channel, i: Tensor) -> Channel:
    """Some of the paths, without what a response does not ask for."""
    names = ("tx", "rx", "delay", "gain", "doppler", "departure", "arrival", "blocked")
    return replace(channel, jones=None, **{n: getattr(channel, n)[i] for n in names})


def _refuse_large(links: int, wide: int) -> None:
    if links * wide > MOST_VALUES:
        raise ValueError(
            f"response of {links} x {wide} values: expected at most {MOST_VALUES}; "
            "take fewer times, frequencies or taps"
        )
