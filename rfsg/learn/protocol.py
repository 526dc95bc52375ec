"""Scores of predicted readings: sizes of errors, their distribution, coverage of intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.stats import norm


@dataclass(frozen=True)
class Score:
    """Absolute errors of received readings [dB], and the share of readings inside an interval.

    ``coverage`` is None for a method without standard deviations or intervals.
    """

    readings: int
    median_db: float
    p90_db: float
    coverage: float | None


def score(
    measured: Float[ndarray, "n"],
    mean: Float[ndarray, "n"],
    std: Float[ndarray, "n"] | None = None,
    level: float = 0.9,
    interval: tuple[Float[ndarray, "n"], Float[ndarray, "n"]] | None = None,
) -> Score:
    """Median and 90th percentile of |measured - mean|; coverage of the central ``level`` interval.

    The interval is that of a normal distribution with ``std``, unless its bounds are given.

    Raises ValueError when there is no reading or a value is not finite: a missing prediction must not
    leave the reading out of the score.
    """
    off = absolute_error(measured, mean)
    if interval is not None:
        covered = share_inside(measured, *interval)
    else:
        covered = None if std is None else coverage(measured, mean, std, level)
    return Score(len(off), float(np.median(off)), float(np.percentile(off, 90)), covered)


def absolute_error(measured: Float[ndarray, "n"], mean: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """|measured - mean| [dB]. Raises ValueError when empty or not finite."""
    off = np.abs(measured - mean)
    bad = int((~np.isfinite(off)).sum())
    if len(off) == 0 or bad:
        raise ValueError(
            f"errors: {len(off)} readings, {bad} of them NaN or infinite; expected finite readings "
            "and predictions, one of each at least. Likely cause: a reading that was not received, "
            "or a method without a value there"
        )
    return off


def error_cdf(
    error: Float[ndarray, "n"], at: Sequence[float] | Float[ndarray, "m"]
) -> Float[ndarray, "m"]:
    """Share of absolute errors [dB] that are at most each value of ``at``."""
    return np.searchsorted(np.sort(np.abs(error)), np.asarray(at), side="right") / len(error)


def coverage(
    measured: Float[ndarray, "n"],
    mean: Float[ndarray, "n"],
    std: Float[ndarray, "n"],
    level: float = 0.9,
) -> float:
    """Share of readings inside the central ``level`` interval of a normal distribution."""
    half = float(norm.ppf(0.5 + level / 2.0)) * std
    return float((np.abs(measured - mean) <= half).mean())


def share_inside(
    measured: Float[ndarray, "n"], low: Float[ndarray, "n"], high: Float[ndarray, "n"]
) -> float:
    """Share of readings from ``low`` to ``high``, both included."""
    return float(((low <= measured) & (measured <= high)).mean())
