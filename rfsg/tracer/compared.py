"""What two simulations of one scene differ in: path gain, missed paths, delays."""

import math
from collections import defaultdict
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.tracer.channel import power
from rfsg.tracer.ladder import difference_db
from rfsg.tracer.records import Channel
from rfsg.tracer.response import at_carrier
from rfsg.tracer.simulate import Result
from rfsg.tracer.spreads import delay_spread

Key = tuple[int, ...]  # transmitter, receiver, then act, object and face or edge of every vertex


@dataclass(frozen=True)
class Seen:
    """What is kept of a simulation, at its first frequency, to be compared. Delays in seconds.

    arrival: of the first path; inf where nothing arrives. paths: power of the paths of each kind.
    """

    transfer: Complex[Tensor, "t r"]
    power: Float[Tensor, "t r"]
    spread: Float[Tensor, "t r"]
    arrival: Float[Tensor, "t r"]
    paths: dict[Key, list[float]]
    complete: bool

    @property
    def count(self) -> int:
        return sum(map(len, self.paths.values()))


@dataclass(frozen=True)
class Difference:
    """One simulation against another; dB are of path gain.

    gain_db, gain_90_db, gain_most_db: median, 90 % and largest over links; inf where only one of the
    two hears a link. missed: share of the other's power in paths that the one lacks, mean over links.
    spread_ns, arrival_ns: delay spread and first arrival, at 90 % of the links that both hear.
    """

    gain_db: float
    gain_90_db: float
    gain_most_db: float
    missed: float
    spread_ns: float
    arrival_ns: float


def see(result: Result) -> Seen:
    """What is kept of a simulation; see ``Seen``."""
    channel, size = at_carrier(result.channel, 0), result.size()
    return Seen(
        result.transfer()[..., 0].detach(),
        power(channel, *size)[..., 0].detach(),
        delay_spread(channel, *size)[..., 0].detach(),
        first_arrival(channel, *size),
        _kinds(result, channel),
        result.search.complete,
    )


def difference(one: Seen, other: Seen) -> Difference:
    """``one`` against ``other``, which counts as the truth."""
    gain = difference_db(one.transfer, other.transfer).reshape(-1)
    both = torch.isfinite(one.arrival) & torch.isfinite(other.arrival)
    return Difference(
        _at(gain, 0.5),
        _at(gain, 0.9),
        _at(gain, 1.0),
        missed(one, other),
        1e9 * _at((one.spread - other.spread).abs()[both], 0.9),
        1e9 * _at((one.arrival - other.arrival).abs()[both], 0.9),
    )


def missed(one: Seen, other: Seen) -> float:
    """Share of a link's power, phases left aside, in paths of ``other`` that ``one`` lacks: the mean
    over the links that ``other`` hears, 0 where there are none.

    Paths are the same that do the same at the same faces, in order. Where several are (two glints of
    one curved face), the strongest are taken to be found first.
    """
    lost = torch.zeros_like(other.power)
    for key, powers in other.paths.items():
        found = len(one.paths.get(key, ()))
        lost[key[0], key[1]] += sum(sorted(powers, reverse=True)[found:])
    heard = other.power > 0
    return float((lost[heard] / other.power[heard]).mean()) if bool(heard.any()) else 0.0


def first_arrival(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r"]:
    """Delay of the earliest path that carries power [s]; inf where there is none."""
    carries = (channel.gain[:, 0].abs() > 0) & ~channel.blocked
    link = (channel.tx * n_rx + channel.rx)[carries]
    never = channel.delay.new_full((n_tx * n_rx,), math.inf)
    delay = channel.delay.detach()[carries]
    return never.scatter_reduce(0, link, delay, "amin").reshape(n_tx, n_rx)


def _kinds(result: Result, channel: Channel) -> dict[Key, list[float]]:
    """Power of each path that arrives, by what it does."""
    paths = result.paths
    vertex = torch.stack([paths.act, paths.which, paths.item], -1)  # [p, d, 3]
    order = (paths.which >= 0).sum(1).tolist()
    ends = torch.stack([channel.tx, channel.rx], -1).tolist()
    strength = (channel.gain[:, 0].abs() ** 2).detach().tolist()
    kinds: dict[Key, list[float]] = defaultdict(list)
    for end, row, n, p in zip(ends, vertex.tolist(), order, strength, strict=True):
        if p > 0.0:
            kinds[(*end, *(x for corner in row[:n] for x in corner))].append(p)
    return dict(kinds)


def _at(value: Float[Tensor, "n"], share: float) -> float:
    """The value that a share of them does not exceed, the higher of two neighbours; 0 for none."""
    if not len(value):
        return 0.0
    return float(value.sort().values[max(0, math.ceil(share * len(value)) - 1)])
