"""How far power may lie from what a scene says: the transport model read as a distribution.

In the paper's exponential transport (Eqs. 5 to 9) the geometry behind a learned surface is random, and
what gets through is a mean: a path of optical depth t is met by a Poisson number of obstacles, and
T = exp(-t) is the probability of none (Theorem 1: the distance to the first is exponential). A wave is
wider than a ray, so an obstacle here takes a share q of the power, the *opacity*:

    F = (1 - q)^N,   N ~ Poisson(t / q),   E[F] = exp(-t) = T.

q = 1 is the paper's own: a path survives with probability T or is lost. q -> 0 is a medium without
grains. The power of a link with paths of amplitude a_i (as the scene says, T in it) is

    P = | sum_i a_i sqrt(F_i / T_i) exp(j phi_i) |^2,

where the phases are those of the paths if powers are coherent, and independent and uniform if not, for
then geometry below a wavelength leaves them open. What is not learned has t = 0 and F = 1. Incoherent,
E[P] = sum_i |a_i|^2 = sum_i T_i g_i, the power that the scene predicts.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from numpy import ndarray
from torch import Tensor

from rfsg.learn.depths import depths
from rfsg.learn.kept import Kept
from rfsg.learn.mixture import INTERVAL, Mixture
from rfsg.scene.scene import Scene

MOST_PATHS = 48  # the strongest of a link are drawn; what the others bring is added as it is
DRAWS = 256  # of a link's power; noise is in closed form about each
DEEPEST = 20.0  # optical depth (87 dB) beyond which a path counts as this: nobody hears it
OPACITIES = (0.0, 0.1, 0.2, 0.5, 0.9)  # that a fit chooses from; 0.9 is 10 dB for one obstacle
AT_ONCE = 64  # links drawn together: bounds memory
MOST_READINGS = 1000  # two numbers and an opacity are known from these well enough
LEAST_NOISE_DB = 0.1  # or readings that fit exactly make the likelihood infinite
ROUNDS = 40  # of expectation and maximisation
WEAKEST = 1e-30  # of the power predicted; paths that cancel leave no less


@dataclass(frozen=True)
class LinkPaths:
    """The strongest k paths of l links at f frequencies, padded with zeros.

    amplitude: shares of h(f). depth: optical depth of what is learned, at most DEEPEST. others: what
    the paths beyond k bring, a sum of amplitudes if coherent, else the root of a sum of powers.
    """

    amplitude: Complex[Tensor, "l f k"]
    depth: Float[Tensor, "l f k"]
    others: Complex[Tensor, "l f"]
    coherent: bool

    @staticmethod
    @torch.no_grad()
    def of(kept: Kept, scene: Scene, coherent: bool) -> "LinkPaths":
        """Of all kept links, with the parameters as they are now."""
        return LinkPaths.ranked(kept.begin, kept.values(scene), depths(kept), coherent)

    @staticmethod
    def ranked(
        begin: Int[Tensor, "l1"],
        value: Complex[Tensor, "p f"],
        depth: Float[Tensor, "p f"],
        coherent: bool,
    ) -> "LinkPaths":
        """From paths in order of link; ``begin`` says where each link's paths begin and the last end."""
        links, (paths, frequencies) = len(begin) - 1, value.shape
        count = begin[1:] - begin[:-1]
        link = torch.repeat_interleave(torch.arange(links), count)
        most = min(MOST_PATHS, int(count.max())) if paths else 0
        amplitude = value.new_zeros(links, frequencies, most)
        deep, others = depth.new_zeros(amplitude.shape), value.new_zeros(links, frequencies)
        for f in range(frequencies):
            size = value[:, f].abs()
            order = torch.argsort(size, descending=True, stable=True)
            order = order[torch.argsort(link[order], stable=True)]
            rank = torch.arange(paths) - begin[:-1][link]  # in each link, as ``link`` is in order
            near, rest = rank < most, order[rank >= most]
            amplitude[link[near], f, rank[near]] = value[order[near], f]
            deep[link[near], f, rank[near]] = depth[order[near], f]
            weak = value[rest, f] if coherent else (size[rest] ** 2).to(value.dtype)
            total = others[:, f].index_add(0, link[rank >= most], weak)
            others[:, f] = total if coherent else total.sqrt()
        return LinkPaths(amplitude, deep.clamp(min=0.0, max=DEEPEST), others, coherent)

    def power(self, link: Int[Tensor, "n"], frequency: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Path gain of links as the scene predicts it."""
        a, others = self.amplitude[link, frequency], self.others[link, frequency]
        if self.coherent:
            return (a.sum(-1) + others).abs() ** 2
        return (a.abs() ** 2).sum(-1) + others.abs() ** 2

    def drawn_db(
        self, link: Int[Tensor, "n"], frequency: Int[Tensor, "n"], opacity: float, seed: int = 0
    ) -> Float[Tensor, "n s"]:
        """Drawn power over predicted power [dB], DRAWS times. Rows of links without power are 0.

        The draws of a path depend on the seed and on its rank in its link, on nothing else: a link's
        row is the same whatever it is asked together with.
        """
        table = Table.of(self.amplitude.shape[-1], opacity, seed)
        parts = [torch.zeros(0, DRAWS, dtype=torch.float64)]
        for i in torch.arange(len(link)).split(AT_ONCE):
            drawn = self._power(link[i], frequency[i], table)
            mean = self.power(link[i], frequency[i])
            silent = mean <= 0
            ratio = (drawn / torch.where(silent, 1.0, mean)[:, None]).clamp(min=WEAKEST)
            parts.append(torch.where(silent[:, None], 0.0, 10.0 * torch.log10(ratio)))
        return torch.cat(parts)

    def _power(self, link: Tensor, frequency: Tensor, table: "Table") -> Float[Tensor, "b s"]:
        a, others = self.amplitude[link, frequency], self.others[link, frequency]
        root = table.factor(self.depth[link, frequency]).sqrt()
        if self.coherent:
            field = (a[..., None] * root).sum(1) + others[:, None]
            return field.abs() ** 2
        field = (a.abs()[..., None] * root * table.phasor).sum(1)
        return field.abs() ** 2 + others.abs()[:, None] ** 2


@dataclass(frozen=True)
class Table:
    """Draws for the k-th strongest paths of links: phases, and where along a path obstacles stand.

    arrival: optical depths, over the opacity, at which a Poisson process of rate 1 has its points: up
    to a depth t lie N ~ Poisson(t / q) of them.
    """

    phasor: Complex[Tensor, "k s"]
    arrival: Float[Tensor, "k s m"]
    opacity: float

    @staticmethod
    def of(paths: int, opacity: float, seed: int) -> "Table":
        """Raises ValueError for an opacity outside [0, 1]."""
        if not 0.0 <= opacity <= 1.0:
            raise ValueError(f"opacity: {opacity!r} given; expected a share of the power in [0, 1]")
        most = 0
        if opacity > 0.0:  # so many that none of a thousand billion processes has more
            mean = DEEPEST / opacity
            most = math.ceil(mean + 8.0 * math.sqrt(mean) + 10.0)
        phases, arrivals = [], []
        for k in range(paths):
            generator = torch.Generator().manual_seed(seed * 1_000_003 + k)
            phase = torch.rand(DRAWS, generator=generator, dtype=torch.float64)
            uniform = torch.rand(DRAWS, most, generator=generator, dtype=torch.float64)
            phases.append(torch.polar(torch.ones_like(phase), 2.0 * math.pi * phase))
            arrivals.append(torch.cumsum(-torch.log1p(-uniform), -1))
        if not paths:
            none = torch.zeros(0, DRAWS, dtype=torch.complex128)
            return Table(none, none.real[..., None].expand(-1, -1, most), opacity)
        return Table(torch.stack(phases), torch.stack(arrivals), opacity)

    def factor(self, depth: Float[Tensor, "b k"]) -> Float[Tensor, "b k s"]:
        """F / T: what is let on, over its mean."""
        b, (k, s) = len(depth), self.phasor.shape
        if self.opacity == 0.0 or not bool(depth.any()):
            return torch.ones(b, k, s, dtype=torch.float64)
        asked = (depth / self.opacity).T[:, None].expand(k, s, b).contiguous()
        met = torch.searchsorted(self.arrival, asked, right=True).permute(2, 0, 1)
        if self.opacity == 1.0:
            return torch.where(met == 0, depth[..., None].exp(), 0.0)
        return (met * math.log1p(-self.opacity) + depth[..., None]).exp()


@dataclass(frozen=True)
class Uncertainty:
    """What a predictive distribution adds to a scene.

    opacity: of obstacles. noise_db, offset_db: of readings about the power drawn, normal in dB; the
    offset is there because a fit meets the middle of its readings in dB, and the mean of a power lies
    above it. widened_db: by how much both ends of the 90 % interval move outward, so that it covers.
    """

    opacity: float
    noise_db: float
    offset_db: float
    widened_db: float = 0.0
    seed: int = 0

    def interval(
        self,
        predicted: Float[Tensor, "n"],
        paths: LinkPaths,
        link: Int[Tensor, "n"],
        frequency: Int[Tensor, "n"],
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """5 % and 95 % bounds of new readings about predicted powers [dB or dBm]."""
        drawn = paths.drawn_db(link, frequency, self.opacity, self.seed)
        ends = [bounds(drawn[i].numpy(), self.noise_db) for i in _parts(len(drawn))]
        low, high = (torch.from_numpy(np.concatenate(e)) for e in zip(*ends, strict=True))
        return widened(predicted + self.offset_db + low, predicted + self.offset_db + high, self)


def bounds(
    drawn_db: Float[ndarray, "n s"], noise_db: float
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """5 % and 95 % quantiles [dB] of equally likely draws with normal noise about each."""
    n, s = drawn_db.shape
    mixture = Mixture(np.full((n, s), 1.0 / s), drawn_db, np.full(n, noise_db))
    tail = 0.5 * (1.0 - INTERVAL)
    return mixture.quantile(tail), mixture.quantile(1.0 - tail)


def most_likely(
    off_db: Float[Tensor, "n"],
    paths: LinkPaths,
    link: Int[Tensor, "n"],
    frequency: Int[Tensor, "n"],
    seed: int = 0,
) -> Uncertainty:
    """Opacity, noise and offset of the greatest likelihood of readings less predictions [dB].

    On at most MOST_READINGS of them, evenly taken. Raises ValueError when there is none.
    """
    if not len(off_db):
        raise ValueError("uncertainty: no reading of power; expected at least one")
    i = torch.arange(0, len(off_db), max(1, math.ceil(len(off_db) / MOST_READINGS)))
    best: tuple[float, Uncertainty] | None = None
    for opacity in OPACITIES if bool(paths.depth.any()) else OPACITIES[:1]:
        rest = off_db[i, None] - paths.drawn_db(link[i], frequency[i], opacity, seed)
        likelihood, noise, offset = _climbed(rest)
        if best is None or likelihood > best[0]:
            best = likelihood, Uncertainty(opacity, noise, offset, seed=seed)
    assert best is not None
    return best[1]


def _climbed(rest: Float[Tensor, "n s"]) -> tuple[float, float, float]:
    """(log-likelihood, noise [dB], offset [dB]) of readings less draws: a normal law about each draw,
    by expectation and maximisation (Bishop 2006, section 9.2)."""
    offset, noise = float(rest.mean()), max(float(rest.std(correction=0)), LEAST_NOISE_DB)
    for _ in range(ROUNDS):
        weight = torch.softmax(-0.5 * ((rest - offset) / noise) ** 2, -1)
        offset = float((weight * rest).sum() / len(rest))
        spread = float((weight * (rest - offset) ** 2).sum() / len(rest))
        noise = max(math.sqrt(spread), LEAST_NOISE_DB)
    log = torch.logsumexp(-0.5 * ((rest - offset) / noise) ** 2, -1)
    log = log - math.log(noise * math.sqrt(2.0 * math.pi) * rest.shape[1])
    return float(log.sum()), noise, offset


# calibration


def widening(
    measured: Float[Tensor, "n"], low: Float[Tensor, "n"], high: Float[Tensor, "n"]
) -> float:
    """By how much [dB] both ends must move outward (inward if negative) to cover 90 % of new readings.

    Split-conformal (Vovk, Gammerman, Shafer, Algorithmic Learning in a Random World, 2005, section
    4.1) with the score of conformalised quantiles, max(low - y, y - high) (Romano, Patterson, Candes
    2019; Angelopoulos and Bates 2021, section 2.2): the ceil(0.9 (n + 1))-th smallest of n scores. Of
    fewer than 9 readings that would be the (n + 1)-th; the greatest is taken, which covers n / (n + 1).
    Raises ValueError when there is no reading.
    """
    if not len(measured):
        raise ValueError("widening: no reading; expected at least one")
    score = torch.maximum(low - measured, measured - high).sort().values
    return float(score[min(math.ceil(INTERVAL * (len(score) + 1)), len(score)) - 1])


def widened(
    low: Float[Tensor, "n"], high: Float[Tensor, "n"], by: "Uncertainty | float"
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Both ends moved outward [dB]; inward no further than to the middle."""
    outward = by.widened_db if isinstance(by, Uncertainty) else by
    least = torch.maximum(-0.5 * (high - low), torch.full_like(low, outward))
    return low - least, high + least


def crossed_coverage(
    measured: Float[Tensor, "n"], low: Float[Tensor, "n"], high: Float[Tensor, "n"], seed: int = 0
) -> float | None:
    """Share of readings covered when each half of them calibrates the interval of the other half.

    An honest figure from the readings that calibrate; None of fewer than two.
    """
    n, inside = len(measured), 0
    if n < 2:
        return None
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    halves = order[: n // 2], order[n // 2 :]
    for known, asked in (halves, halves[::-1]):
        by = widening(measured[known], low[known], high[known])
        a, b = widened(low[asked], high[asked], by)
        inside += int(((a <= measured[asked]) & (measured[asked] <= b)).sum())
    return inside / n


def _parts(n: int) -> list[slice]:
    """Slices of a thousand or so: bounds memory. One at least."""
    return [slice(i, i + 1024) for i in range(0, max(n, 1), 1024)]
