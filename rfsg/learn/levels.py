"""A field of levels over places: every place has one of K values, near places more often the same.

What a transmitter carries with it (a body, a tag turned away, its height) acts on all gateways alike
and may be there or not, so it takes few values rather than a smooth range. The values and shares are
those of a mixture, by expectation and maximisation (C. M. Bishop, Pattern Recognition and Machine
Learning, Springer 2006, section 9.2); a component is drawn for each place, not for each reading.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from rfsg.learn.mixture import log_total

# Transmitter positions nearer than this [m] are one place: rounding apart, not moved.
SAME_PLACE = 1e-3

# The noise [dB] is not fitted below this: a level with one reading could make it 0 and the
# likelihood infinite (Bishop 2006, section 9.2.1).
LEAST_NOISE = 0.1

# Prior standard deviation [dB] of what a gateway adds to all levels: physics fitted on readings of
# several levels gets gateways wrong by the mix of levels that each happened to hear.
OFFSET_STD = 3.0

STEPS, TOLERANCE = 300, 1e-7  # of the climb: most steps, least gain in log-likelihood a reading

# What the prior near known places is chosen from: reach [m], and weight of the shares of the whole
# area in numbers of places. The last weight lets a hundred neighbours not matter.
LENGTHS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
WEIGHTS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 1000.0)


@dataclass(frozen=True)
class Places:
    """Distinct places: positions [m], and the number of the place of each reading."""

    position: Float[ndarray, "p 3"]
    of: Int[ndarray, "n"]

    @staticmethod
    def among(tx_position: Float[ndarray, "n 3"]) -> "Places":
        """Positions within SAME_PLACE of each other, or of a chain of such, are one place."""
        n = len(tx_position)
        near = KDTree(tx_position).query_pairs(SAME_PLACE, output_type="ndarray")
        linked = scipy.sparse.coo_matrix((np.ones(len(near)), near.T), shape=(n, n))
        of = connected_components(linked, directed=False)[1].astype(np.int64)
        first = np.unique(of, return_index=True)[1]
        return Places(tx_position[first], of)

    def sum(self, values: Float[ndarray, "n"]) -> Float[ndarray, "p"]:
        """Of one value a reading, the sum at each place."""
        return np.bincount(self.of, values, minlength=len(self.position))


@dataclass(frozen=True)
class Mix:
    """Levels without their places: values [dB] ascending, shares, noise [dB], log-likelihood.

    ``offset`` [dB] is what each gateway adds, in the order of the numbers given to ``climbed``.
    """

    value: Float[ndarray, "k"]
    share: Float[ndarray, "k"]
    noise: float
    offset: Float[ndarray, "g"]
    log_likelihood: float

    def evidence(
        self, rest: Float[ndarray, "n"], places: Places, gateway: Int[ndarray, "n"]
    ) -> Float[ndarray, "p k"]:
        """log p(readings of a place | its level), from what physics leaves, ``rest`` [dB]."""
        off = (rest - self.offset[gateway])[:, None] - self.value
        each = -0.5 * (off / self.noise) ** 2 - np.log(self.noise * np.sqrt(2.0 * np.pi))
        return np.stack([places.sum(column) for column in each.T], axis=1)


@dataclass(frozen=True)
class Levels:
    """Fitted levels: values [dB] ascending, shares, noise [dB]; what is known of each training place.

    ``own`` is the probability of each level at a place by its own readings and the shares, ``known``
    by its neighbours too. A place's prior is the mean of ``own`` at the other places, weighted by
    exp(-distance / ``length``), and of ``share`` with ``weight``.
    """

    value: Float[ndarray, "k"]
    share: Float[ndarray, "k"]
    noise: float
    position: Float[ndarray, "p 3"]
    own: Float[ndarray, "p k"]
    known: Float[ndarray, "p k"]
    length: float
    weight: float

    def centred(self) -> "Levels":
        """The same, with values [dB] about their mean."""
        return replace(self, value=self.value - self.share @ self.value)

    def at(self, position: Float[ndarray, "m 3"]) -> Float[ndarray, "m k"]:
        """Probability of each level at places [m]: of a training place, what is known of it."""
        apart = cdist(position, self.position)
        found = prior(np.exp(-apart / self.length), self.own, self.share, self.weight)
        nearest = apart.argmin(1)
        same = apart[np.arange(len(apart)), nearest] < SAME_PLACE
        found[same] = self.known[nearest[same]]
        return found


def fitted(
    count: int,
    rest: Float[ndarray, "n"],
    tx_position: Float[ndarray, "n 3"],
    gateway: Int[ndarray, "n"],
) -> Levels:
    """``count`` levels of what physics leaves, ``rest`` [dB], from one transmitter place each [m].

    The greatest likelihood of several starts; reach and weight of the neighbours by the likelihood of
    each place given all others. Nothing is random.
    """
    places = Places.among(tx_position)
    heard = np.unique(gateway, return_inverse=True)[1]
    climbs = [climbed(start, rest, places, heard) for start in starts(count, rest, places)]
    mix = max(climbs, key=lambda c: c.log_likelihood)
    evidence = mix.evidence(rest, places, heard)
    own = normalised(np.log(mix.share) + evidence)
    length, weight = smoothed(evidence, own, mix.share, places)
    near = prior(between(places, length), own, mix.share, weight)
    known = normalised(np.log(near) + evidence)
    return Levels(mix.value, mix.share, mix.noise, places.position, own, known, length, weight)


def starts(count: int, rest: Float[ndarray, "n"], places: Places) -> list[Float[ndarray, "k"]]:
    """Values [dB] to start from: quantiles of the places' means, and even steps between the ends.

    Quantiles find levels with equal shares, even steps a level that few places have.
    """
    mean = places.sum(rest) / places.sum(np.ones(len(rest)))
    middle = (np.arange(count) + 0.5) / count
    low, high = np.quantile(mean, [0.02, 0.98])
    return [np.quantile(mean, middle), low + middle * (high - low)]


def climbed(
    start: Float[ndarray, "k"],
    rest: Float[ndarray, "n"],
    places: Places,
    gateway: Int[ndarray, "n"],
) -> Mix:
    """Expectation and maximisation from ``start`` [dB] until the likelihood stands still.

    Bishop 2006, equations 9.23 to 9.27, with one noise for all levels. The gateways' offsets have a
    normal prior and are maximised after the values (its section 9.4, a partial M step).
    """
    n, share = len(rest), np.full(len(start), 1.0 / len(start))
    number = places.sum(np.ones(n))
    heard = np.bincount(gateway)
    mix = Mix(start, share, max(float(rest.std()) / len(start), LEAST_NOISE), heard * 0.0, -np.inf)
    for _ in range(STEPS):
        joint = np.log(mix.share) + mix.evidence(rest, places, gateway)
        reached = float(log_total(joint).sum())
        if reached - mix.log_likelihood < TOLERANCE * n:
            break
        told = normalised(joint)
        # A level that no place has keeps its value: 0 / 0 otherwise.
        held = number @ told
        corrected = rest - mix.offset[gateway]
        tiny = np.finfo(float).tiny
        value = (places.sum(corrected) @ told) / np.maximum(held, tiny)
        value = np.where(held > tiny, value, mix.value)
        share = np.maximum(told.mean(0), tiny)
        off = corrected[:, None] - value
        noise = max(float(np.sqrt((told[places.of] * off**2).sum() / n)), LEAST_NOISE)
        left = rest - (told @ value)[places.of]
        offset = np.bincount(gateway, left) / (heard + (noise / OFFSET_STD) ** 2)
        mix = Mix(value, share / share.sum(), noise, offset, reached)
    order = np.argsort(mix.value)
    return Mix(mix.value[order], mix.share[order], mix.noise, mix.offset, mix.log_likelihood)


def smoothed(
    evidence: Float[ndarray, "p k"],
    own: Float[ndarray, "p k"],
    share: Float[ndarray, "k"],
    places: Places,
) -> tuple[float, float]:
    """Reach [m] and weight of the shares that make each place most likely given all the others."""
    best = (-np.inf, LENGTHS[0], WEIGHTS[-1])
    for length in LENGTHS:
        near = between(places, length)
        for weight in WEIGHTS:
            joint = np.log(prior(near, own, share, weight)) + evidence
            reached = float(log_total(joint).sum())
            # Where nothing depends on the choice (one level), rounding must not make it.
            if reached > best[0] + TOLERANCE * len(evidence):
                best = (reached, length, weight)
    return best[1], best[2]


def between(places: Places, length: float) -> Float[ndarray, "p p"]:
    """exp(-distance / length) between places, and nothing from a place to itself."""
    near = np.exp(-cdist(places.position, places.position) / length)
    np.fill_diagonal(near, 0.0)
    return near


def prior(
    near: Float[ndarray, "m p"],
    own: Float[ndarray, "p k"],
    share: Float[ndarray, "k"],
    weight: float,
) -> Float[ndarray, "m k"]:
    """Probabilities of levels by neighbours alone: (near own + weight share) / (near 1 + weight).

    The kernel estimate of a share (E. A. Nadaraya, Theory Prob. Appl. 9, 1964, 141) with ``weight``
    places of the shares of the whole area added, as a Dirichlet prior adds them (Bishop 2006, 2.41).
    """
    return (near @ own + weight * share) / (near.sum(1, keepdims=True) + weight)


def normalised(log: Float[ndarray, "p k"]) -> Float[ndarray, "p k"]:
    """Probabilities from their logarithms up to a constant of each row."""
    return np.exp(log - log_total(log)[:, None])
