"""Model only what a scene requires: the richer of two methods only where held-out places ask for it.

Required(FreeSpace(), RegionPhysics())          # regions, or the empty scene
Required(physics, Residual(physics))            # what physics leaves, or physics alone
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.learn.baselines.readings import Method, Predictor, Readings
from rfsg.learn.levels import Places
from rfsg.learn.losses import student
from rfsg.learn.mixture import INTERVAL, IntervalPrediction
from rfsg.learn.residual import fair_order

EVERY = 5  # one place in so many is held out for the choice


@dataclass(frozen=True)
class Required:
    """Settings: two methods, and the scale [dB] of the Student cost by which they are compared."""

    plain: Method
    rich: Method
    noise_db: float = 3.0

    def fit(self, readings: Readings, seed: int = 0) -> "RequiredModel":
        """Fit both without a fifth of the places, and the better one again on all readings.

        Better is less cost at the places held out, for ``rich`` by more than one standard error over
        places (Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, section 7.10). With
        fewer than EVERY places there is nothing to choose by: ``plain``.

        Raises what the two raise.
        """
        places = Places.among(readings.tx_position)
        out = (np.argsort(fair_order(readings, places)) % EVERY == EVERY // 2)[places.of]
        if not out.any() or out.all():
            found = self.plain.fit(readings, seed)
            return RequiredModel(found, False, off(found, readings))
        known, asked = readings.only(~out), readings.only(out)
        missed = [off(m.fit(known, seed), asked) for m in (self.plain, self.rich)]
        needed = better(*(self._cost(m, places.of[out]) for m in missed))
        method = self.rich if needed else self.plain
        return RequiredModel(method.fit(readings, seed), needed, missed[int(needed)])

    def _cost(self, missed: Float[ndarray, "n"], place: Int[ndarray, "n"]) -> Float[ndarray, "p"]:
        """Student's cost of what was missed [dB] at each place that was held out."""
        cost = student(torch.from_numpy(missed / self.noise_db) ** 2).numpy()
        of = np.unique(place, return_inverse=True)[1]
        return np.bincount(of, cost)


@dataclass(frozen=True)
class RequiredModel:
    """The method that was needed, whether it is the ``rich`` one, and what it missed [dB].

    ``missed`` is of readings that it had not seen, where there were enough places for that.
    """

    physics: Predictor
    rich: bool
    missed: Float[ndarray, "n"]

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> IntervalPrediction:
        """What the physics says [dBm], with its own 90 % interval, or that of ``missed`` about it.

        The latter is split-conformal, 5 % on either side (V. Vovk, A. Gammerman, G. Shafer,
        Algorithmic Learning in a Random World, Springer 2005). Raises ValueError when lengths differ
        or a position is not finite.
        """
        said = self.physics.predict(tx_position, rx_position, gateway)
        if isinstance(said, IntervalPrediction):
            return said
        low, high = bounds(self.missed)
        std = np.full(len(said.mean), np.sqrt(np.mean(self.missed**2)))
        return IntervalPrediction(said.mean, std, said.mean + low, said.mean + high)


def off(physics: Predictor, asked: Readings) -> Float[ndarray, "n"]:
    """Readings less predictions [dB]."""
    return asked.rssi - physics.predict(asked.tx_position, asked.rx_position, asked.gateway).mean


def better(plain: Float[ndarray, "p"], rich: Float[ndarray, "p"]) -> bool:
    """Whether ``rich`` costs less by more than one standard error of the difference over places."""
    gain = plain - rich
    return bool(gain.sum() > gain.std() * np.sqrt(len(gain)))


def bounds(missed: Float[ndarray, "n"]) -> tuple[float, float]:
    """What a new value lies between with a chance of 90 %, if it is drawn as these were.

    The r-th least and the r-th greatest of n with r = floor((n + 1) / 20); the ends where n is below 19,
    and then the chance is less.
    """
    ordered, tail = np.sort(missed), (1.0 - INTERVAL) / 2.0
    # The added share undoes the rounding of 0.05 (n + 1) just below a whole number.
    rank = max(int(np.floor((len(missed) + 1) * tail + 1e-9)), 1)
    return float(ordered[rank - 1]), float(ordered[-rank])
