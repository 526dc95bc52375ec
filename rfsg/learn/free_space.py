"""The scene without objects: free space between radios, its one level by a law that outliers do not move.

What a scene needs least. Where readings have a level per place (``rfsg.learn.levels``) the mean lies
between the levels and is wrong everywhere; Student's law finds the level that most places share.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.learn.baselines.readings import Prediction, Readings, check_links, distance
from rfsg.learn.losses import FREEDOM, student
from rfsg.learn.regions import friis_db

CANDIDATES = 64  # quantiles to climb from: more than a distribution of readings has peaks
STEPS, TOLERANCE = 200, 1e-9  # of the climb, [dB]


@dataclass(frozen=True)
class FreeSpace:
    """Direct paths in an empty scene, all readings alike: a ``Method`` (``rfsg.learn.baselines``).

    noise_db: where Student's law turns from the square of an error to its logarithm.
    """

    frequency_hz: float = 2.44e9
    noise_db: float = 3.0

    def fit(self, readings: Readings, seed: int = 0) -> "FreeSpacePhysics":
        """The most likely level. Nothing is random: ``seed`` is not used."""
        gain = gain_db(readings.tx_position, readings.rx_position, self.frequency_hz)
        left = readings.rssi - gain
        level = location(left, self.noise_db)
        std = float(np.sqrt(np.mean((left - level) ** 2)))
        return FreeSpacePhysics(level, std, self.frequency_hz)


@dataclass(frozen=True)
class FreeSpacePhysics:
    """``level`` [dBm] of what all transmitters send, ``std`` [dB] of the training readings about it."""

    level: float
    std: float
    frequency_hz: float

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """Mean [dBm] and standard deviation [dB] of links between positions in metres.

        Raises ValueError when lengths differ or a position is not finite.
        """
        check_links(tx_position, rx_position, gateway)
        mean = self.level + gain_db(tx_position, rx_position, self.frequency_hz)
        return Prediction(mean, np.full(len(mean), self.std))


def gain_db(
    tx_position: Float[ndarray, "n 3"], rx_position: Float[ndarray, "n 3"], frequency_hz: float
) -> Float[ndarray, "n"]:
    """Path gain [dB] of direct paths between isotropic antennas (``friis_db``)."""
    apart = torch.from_numpy(distance(tx_position, rx_position))
    return friis_db(apart, torch.full_like(apart, frequency_hz)).numpy()


def location(values: Float[ndarray, "n"], scale: float) -> float:
    """The value of the least Student cost: of several peaks the highest.

    Climbed from quantiles by weighted means, each no worse than the last (iteratively reweighted least
    squares: K. L. Lange, R. J. A. Little, J. M. G. Taylor, J. Am. Stat. Assoc. 84, 1989, 881).
    """
    at = np.quantile(values, (np.arange(CANDIDATES) + 0.5) / CANDIDATES)
    for _ in range(STEPS):
        square = ((values - at[:, None]) / scale) ** 2
        weight = 1.0 / (1.0 + square / FREEDOM)
        moved = (weight @ values) / weight.sum(1)
        still = np.abs(moved - at).max() < TOLERANCE
        at = moved
        if still:
            break
    cost = student(torch.from_numpy(((values - at[:, None]) / scale) ** 2)).sum(1)
    return float(at[int(cost.argmin())])
