"""What physics leaves of measured power, as a distribution over any physical prediction.

A reading is physics + a level of its place + a Gaussian field + noise. The field has a part over
transmitter places that all gateways share, an offset per gateway and, in the whole model, a part over
both positions (``rfsg.learn.baselines.kriging``). The levels (``rfsg.learn.levels``) and the shared
part are the *common term*: what the transmitter carries with it, the same for every gateway. With one
level the model is kriging of what physics leaves.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from rfsg.learn import levels
from rfsg.learn.baselines.gaussian_process import (
    Covariance,
    Pairs,
    Posterior,
    Trend,
    matern32,
    most_likely,
)
from rfsg.learn.baselines.kriging import (
    EXPONENT_STD,
    FAINTEST,
    INTERCEPT_STD,
    JOINT,
    LONGEST,
    SHORTEST,
    STRONGEST,
    block,
    drawn,
    predicted,
)
from rfsg.learn.baselines.readings import Method, Prediction, Predictor, Readings
from rfsg.learn.levels import Levels, Places
from rfsg.learn.mixture import IntervalPrediction, Mixture

Part = Literal["physics", "common", "whole"]
PARTS: tuple[Part, ...] = ("physics", "common", "whole")

# Prior standard deviations of what the fields add to every reading [dB] and to the exponent of the
# distance: what physics gets wrong as a whole, wide beside what readings leave open.
TREND = Trend(
    torch.zeros(2, dtype=torch.float64), torch.tensor([INTERCEPT_STD, EXPONENT_STD]).double()
)

# Choosing the number of levels: parts the places are split in, at least so many places a level, and
# the least gain in log-likelihood that counts, one for each of the two numbers a level adds (Akaike).
FOLDS = 3
PLACES_PER_LEVEL = 5
LEAST_GAIN = 2.0

# The covariances of the choice are fitted on so many readings in so many steps: every number of levels
# has the same handicap, and the choice takes a second.
CHOICE_MOST, CHOICE_STEPS = 150, 12


def common_field(q: Float[Tensor, "4"], pairs: Pairs) -> Tensor:
    """q = (noise, common std, length, offset std): what all gateways share, and an offset of each."""
    return q[1] ** 2 * matern32(pairs.tx, q[2]) + q[3] ** 2 * pairs.same_gateway


COMMON = Covariance(
    common_field,
    ("noise_db", "common_std_db", "common_length_m", "offset_std_db"),
    start=(3.0, 4.0, 2.0, 1.0),
    least=(FAINTEST, FAINTEST, SHORTEST, FAINTEST),
    most=(STRONGEST, STRONGEST, LONGEST, STRONGEST),
)


@dataclass(frozen=True)
class Residual:
    """Settings: the physics below, and how many levels the common term may have.

    ``counts`` are the numbers of levels to choose from, by the likelihood of training places that were
    held out. ``answer`` names the part that ``predict`` of the fitted model gives; the other parts
    are there too. Covariances are those of the greatest likelihood on at most ``most`` readings, the
    number of levels is chosen on about ``most`` readings at most; predictions use all. ``rounds`` is how
    often the physics is fitted again to readings without their levels (backfitting: T. Hastie,
    R. Tibshirani, J. Friedman, The Elements of Statistical Learning, 2nd ed., section 9.1.1).

    Raises ValueError for a setting that is none.
    """

    physics: Method
    counts: tuple[int, ...] = (1, 2, 3, 4)
    answer: Part = "whole"
    most: int = 600
    rounds: int = 1

    def __post_init__(self) -> None:
        if not self.counts or min(self.counts) < 1:
            raise ValueError(
                f"counts: {self.counts} given; expected whole numbers of levels, each at least 1"
            )
        if self.answer not in PARTS:
            raise ValueError(f"answer: {self.answer!r} given; expected one of {', '.join(PARTS)}")
        if self.most < 1 or self.rounds < 0:
            raise ValueError(
                f"most: {self.most}, rounds: {self.rounds}; expected at least 1 reading to fit "
                "covariances on, and 0 or more rounds"
            )

    def fit(self, readings: Readings, seed: int = 0) -> "ResidualModel":
        """Physics, then what it leaves. ``seed`` is for the physics and for drawing readings.

        Raises what the physics raises, and FloatingPointError when the physics predicts a value that
        is not finite or a covariance matrix of the readings cannot be factorised.
        """
        physics = self.physics.fit(readings, seed)
        rest = left(readings, physics)
        count = chosen(self.counts, rest, self.most, seed)
        refitted, found = physics, levels_of(count, rest)
        for _ in range(self.rounds if count > 1 else 0):
            # Less their mean, which the physics keeps: it may know the power that is sent.
            again = without_levels(readings, found.centred())
            refitted = self.physics.fit(again, seed)
            rest = left(readings, refitted)
            found = levels_of(count, rest)
        model = ResidualModel(physics, refitted, found, rest, self.answer, self.most, seed)
        model.part(self.answer)
        return model


@dataclass(frozen=True)
class Fields:
    """What physics leaves [dB]: a level of the place, a Gaussian field, noise."""

    levels: Levels
    posterior: Posterior

    def mixture(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Mixture:
        """Distribution of what physics leaves of a new reading [dB], noise included."""
        mean, std = predicted(self.posterior, tx_position, rx_position, gateway)
        weight = self.levels.at(tx_position)
        return Mixture(weight, mean[:, None] + self.levels.value, std)


@dataclass(frozen=True)
class Sum:
    """Physics, and the distribution of what it leaves."""

    physics: Predictor
    fields: Fields

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> IntervalPrediction:
        """Median [dBm], standard deviation [dB] and 90 % interval [dBm] of new readings.

        A gateway never heard gets what physics and the fields say of its position. Raises ValueError
        when lengths differ or a position is not finite.
        """
        known = self.physics.predict(tx_position, rx_position, gateway)
        rest = self.fields.mixture(tx_position, rx_position, gateway)
        return replace(rest, mean=rest.mean + known.mean[:, None]).prediction()


@dataclass(frozen=True)
class ResidualModel:
    """A fit: ``physics`` alone, ``common`` (with the common term) and ``whole``.

    ``physics`` saw the readings as they are, ``refitted`` without their levels; the other two parts
    stand on it. Each is fitted when it is first asked for, so that none costs the time of another.
    ``rest`` holds what ``refitted`` leaves of the readings [dB].
    """

    physics: Predictor
    refitted: Predictor
    levels: Levels
    rest: Readings
    answer: Part
    most: int
    seed: int

    @cached_property
    def common(self) -> Sum:
        """Physics and the common term: levels, the field all gateways share, gateway offsets."""
        return Sum(self.refitted, fields_of(self.levels, self.rest, COMMON, self.most, self.seed))

    @cached_property
    def whole(self) -> Sum:
        """Physics, the common term, and a field over both positions."""
        return Sum(self.refitted, fields_of(self.levels, self.rest, JOINT, self.most, self.seed))

    def part(self, name: Part) -> Predictor:
        """A part by name."""
        return getattr(self, name)

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """What the part that the settings name predicts, as ``Sum.predict`` says."""
        return self.part(self.answer).predict(tx_position, rx_position, gateway)


def left(readings: Readings, physics: Predictor) -> Readings:
    """The readings, with what ``physics`` leaves of them [dB] in place of the power.

    Raises FloatingPointError when ``physics`` predicts a value that is not finite.
    """
    said = physics.predict(readings.tx_position, readings.rx_position, readings.gateway)
    bad = int((~np.isfinite(said.mean)).sum())
    if bad:
        raise FloatingPointError(
            f"physics: {bad} of {len(readings)} predictions at the training links are NaN or infinite; "
            "expected finite dBm. Likely cause: a physics without power where something was received"
        )
    return replace(readings, rssi=readings.rssi - said.mean)


def levels_of(count: int, rest: Readings) -> Levels:
    """Levels of what physics leaves."""
    return levels.fitted(count, rest.rssi, rest.tx_position, rest.gateway)


def fields_of(
    found: Levels, rest: Readings, covariance: Covariance, most: int, seed: int
) -> Fields:
    """The Gaussian field of what physics and levels leave, its covariance by maximum likelihood."""
    return given(found, rest, covariance, likeliest(found, rest, covariance, most, seed))


def likeliest(
    found: Levels, rest: Readings, covariance: Covariance, most: int, seed: int, steps: int = 100
) -> Float[Tensor, "q"]:
    """Parameters of the covariance of the greatest likelihood on at most ``most`` readings."""
    few = drawn(without_levels(rest, found), most, np.random.default_rng(seed))
    return most_likely(covariance, TREND, [block(few)], steps)


def given(
    found: Levels, rest: Readings, covariance: Covariance, parameters: Float[Tensor, "q"]
) -> Fields:
    """The field given all of what physics leaves, under known parameters."""
    flat = block(without_levels(rest, found))
    return Fields(found, Posterior.given(covariance, TREND, parameters, flat))


def without_levels(rest: Readings, found: Levels) -> Readings:
    """What physics leaves, without the levels of its places."""
    return replace(rest, rssi=rest.rssi - found.at(rest.tx_position) @ found.value)


def chosen(counts: Sequence[int], rest: Readings, most: int, seed: int) -> int:
    """The number of levels: the least that predicts held-out places about as well as the best.

    Places are split in FOLDS parts, and each part is predicted by physics and common term from the
    others. "About" is one standard error of the difference over the places (Hastie, Tibshirani,
    Friedman, section 7.10) or LEAST_GAIN: more levels than there are do little harm, so they win by
    chance. Physics and covariance parameters are fitted once: what they saw of the held-out places
    helps all alike.
    """
    places = Places.among(rest.tx_position)
    able = [k for k in sorted(set(counts)) if k * PLACES_PER_LEVEL <= len(places.position)]
    if len(able) < 2:
        return min(counts)
    order = fair_order(rest, places)
    rank = np.argsort(order)[places.of]
    # The first places of the order would be the weakest ones: take some of all.
    step = int(np.ceil(len(rest) / most))
    few, rank = rest.only(rank % step == 0), rank[rank % step == 0] // step
    scores = np.stack([held_out(k, few, rank, seed) for k in able])
    lead = scores[scores.sum(1).argmax()] - scores
    error = np.maximum(lead.std(1) * np.sqrt(lead.shape[1]), LEAST_GAIN)
    return able[int(np.flatnonzero(lead.sum(1) <= error)[0])]


def fair_order(rest: Readings, places: Places) -> Int[ndarray, "p"]:
    """Places by strength, then by distance from the receivers: every n-th is a fair sample.

    An order that depends neither on that of the readings nor on the frame.
    """
    apart = np.linalg.norm(rest.tx_position - rest.rx_position, axis=1)
    number = places.sum(np.ones(len(rest)))
    # Rounded, so that the order in which a sum ran decides nothing.
    strength = np.round(places.sum(rest.rssi) / number, 9)
    return np.lexsort((places.sum(apart) / number, strength))


def held_out(count: int, rest: Readings, rank: Int[ndarray, "n"], seed: int) -> Float[ndarray, "p"]:
    """Log-density of the readings of each place, predicted without the places of its part.

    ``rank`` numbers the place of each reading from 0; part is rank modulo FOLDS.
    """
    every = levels_of(count, rest)
    parameters = likeliest(every, rest, COMMON, CHOICE_MOST, seed, CHOICE_STEPS)
    each = np.zeros(len(rest))
    for part in range(FOLDS):
        out = rank % FOLDS == part
        if not out.any() or out.all():
            continue
        known, asked = rest.only(~out), rest.only(out)
        fields = given(levels_of(count, known), known, COMMON, parameters)
        said = fields.mixture(asked.tx_position, asked.rx_position, asked.gateway)
        each[out] = said.log_density(asked.rssi)
    return np.bincount(rank, each)
