"""Predictions that are mixtures of normal distributions: quantiles, densities, scores of intervals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.special import ndtr

from rfsg.learn.baselines.readings import Prediction

# Of the interval in an IntervalPrediction.
INTERVAL = 0.9

# Every quantile asked for lies within so many standard deviations of some component: beyond it is a
# share of 1e-15. Halving that range this often leaves less than a nano-dB.
REACH, HALVINGS = 8.0, 45


@dataclass(frozen=True)
class IntervalPrediction(Prediction):
    """A prediction that is not normal: ``mean`` holds the median, and it brings its own interval.

    ``low`` and ``high`` [dBm] bound the central 90 % interval of a new reading: 5 % lie below the
    first, 5 % above the second. ``std`` [dB] is that of the distribution. The median is the point
    prediction because it has the least expected absolute error (Bishop 2006, section 1.5.5).
    """

    low: Float[ndarray, "n"] | None = None
    high: Float[ndarray, "n"] | None = None


@dataclass(frozen=True)
class Mixture:
    """n mixtures of k normal distributions: weights that sum to 1, means [dBm], std [dB].

    C. M. Bishop, Pattern Recognition and Machine Learning, Springer 2006, equation 2.188. Every
    component of a mixture has the same standard deviation.
    """

    weight: Float[ndarray, "n k"]
    mean: Float[ndarray, "n k"]
    std: Float[ndarray, "n"]

    def below(self, value: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
        """Probability of a reading below ``value`` [dBm]."""
        return (self.weight * ndtr((value[:, None] - self.mean) / self.std[:, None])).sum(1)

    def quantile(self, share: float) -> Float[ndarray, "n"]:
        """The value [dBm] with ``share`` of the probability below it, by bisection."""
        low = (self.mean - REACH * self.std[:, None]).min(1)
        high = (self.mean + REACH * self.std[:, None]).max(1)
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            under = self.below(middle) < share
            low, high = np.where(under, middle, low), np.where(under, high, middle)
        return 0.5 * (low + high)

    def log_density(self, value: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
        """log p(value) [log 1/dB]."""
        off = (value[:, None] - self.mean) / self.std[:, None]
        shape = -0.5 * off**2 - np.log(self.std[:, None] * np.sqrt(2.0 * np.pi))
        # The least positive number for a weight of 0, whose logarithm is not finite.
        weight = np.maximum(self.weight, np.finfo(float).tiny)
        return log_total(np.log(weight) + shape)

    def prediction(self) -> IntervalPrediction:
        """Median, standard deviation and 90 % interval."""
        mean = (self.weight * self.mean).sum(1)
        spread = (self.weight * (self.mean - mean[:, None]) ** 2).sum(1)
        tail = (1.0 - INTERVAL) / 2.0
        return IntervalPrediction(
            self.quantile(0.5),
            np.sqrt(spread + self.std**2),
            self.quantile(tail),
            self.quantile(1.0 - tail),
        )


def interval_of(said: Prediction) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]] | None:
    """The bounds [dBm] of the 90 % interval that a prediction brings, None when it brings none."""
    if isinstance(said, IntervalPrediction) and said.low is not None and said.high is not None:
        return said.low, said.high
    return None


def log_total(log: Float[ndarray, "p k"]) -> Float[ndarray, "p"]:
    """log of the sum of exp over each row, several times faster than scipy's on few columns."""
    most = log.max(1)
    return most + np.log(np.exp(log - most[:, None]).sum(1))
