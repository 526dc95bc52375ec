"""The last step of a fit: how far readings lie from the scene, with and without what it leaves.

Noise and opacity come from training readings. Intervals are widened by one number each, from readings
held for validation where there are any; where there are none, from the training readings, of which
those with the residual are cross-validated and those of physics alone are not.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rfsg.learn.losses import Predicted, residual_db
from rfsg.learn.measurements import Quantity
from rfsg.learn.mixture import INTERVAL
from rfsg.learn.model import Interval, bounds_of
from rfsg.learn.over_scene import MOST, Ends, ResidualSettings, SceneResidual, refuse_few
from rfsg.learn.training import Training
from rfsg.learn.uncertainty import (
    LinkPaths,
    Uncertainty,
    crossed_coverage,
    most_likely,
    widened,
    widening,
)


@dataclass(frozen=True)
class Spread:
    """Of the n readings of a fit, about the scene's predictions [dB]; 0 where ``of`` is False.

    of: readings of power that a path reaches. interval: 90 % of new readings by physics alone.
    left, left_interval: median and interval with the residual, or None; of training readings as told
    by the others. readings: those that calibrate, ``held`` for validation or not. coverage, left_coverage:
    shares of them inside, half of them calibrating the other; None where none were held.
    """

    of: Bool[Tensor, "n"]
    uncertainty: Uncertainty
    interval: Interval
    residual: SceneResidual | None
    left: Float[Tensor, "n"] | None
    left_interval: Interval | None
    left_widened_db: float
    readings: int
    held: bool
    coverage: float | None
    left_coverage: float | None

    def told(self) -> tuple[dict[str, Any], dict[str, Any] | None]:
        """(uncertainty, residual) for the report."""
        calibrated = {
            "calibrated_on": "validation" if self.held else "train",
            "calibrating_readings": self.readings,
        }
        sure = {"interval": INTERVAL, "law": asdict(self.uncertainty)}
        sure |= {**calibrated, "median_width_db": self._width(self.interval)}
        sure["coverage"] = self.coverage
        if self.residual is None or self.left_interval is None:
            return sure, None
        left = {
            "widened_db": self.left_widened_db,
            "median_width_db": self._width(self.left_interval),
            "coverage": self.left_coverage,
        }
        return sure, {**self.residual.told(), **left}

    def _width(self, interval: Interval) -> float:
        low, high = interval
        return float((high - low)[self.of].median())


def spread_of(
    training: Training, after: Predicted, settings: ResidualSettings | None
) -> Spread | None:
    """None where no training reading of power was received and is reached by a path.

    Deterministic: the seed is the fit's. Raises LearnError where a residual is asked for and there are
    too few readings.
    """
    measured, seed = training.measured, training.settings.seed
    of, teach, check = _readings(training, after)
    off = torch.where(teach | check, -residual_db(after, measured), 0.0)
    left = None if settings is None else _Left.of(training, off, teach, of, settings)
    if not bool(teach.any()):
        return None
    is_held = bool(check.any())
    calibrating = check if is_held else teach
    sure, interval = _physics(training, off, teach, of)
    by, coverage = _calibrated(interval, off, calibrating, seed)
    said: dict[str, Any] = {"residual": None, "left": None, "left_interval": None}
    left_by, left_coverage = 0.0, None
    if left is not None:
        left_by, left_coverage = _calibrated(left.interval, off, calibrating, seed)
        outward = widened(*left.interval, left_by)
        said = {"residual": left.residual, "left": left.median, "left_interval": outward}
    return Spread(
        of,
        replace(sure, widened_db=by),
        widened(*interval, by),
        **said,
        left_widened_db=left_by,
        readings=int(calibrating.sum()),
        held=is_held,
        coverage=coverage if is_held else None,
        left_coverage=left_coverage if is_held else None,
    )


def refuse_early(training: Training, before: Predicted) -> None:
    """Raises LearnError where there are too few readings for a residual, before a long fit."""
    refuse_few(int(_readings(training, before)[1].sum()))


def _readings(training: Training, said: Predicted) -> tuple[Tensor, Tensor, Tensor]:
    """Readings of power that a path reaches; of them, those received to teach, and those to check by."""
    measured, held = training.measured, training.held
    of = said.arrives & (measured.quantity != int(Quantity.DELAY))
    heard = of & measured.received
    return of, heard & ~held, heard & held


@torch.no_grad()
def _physics(
    training: Training, off: Tensor, teach: Tensor, of: Tensor
) -> tuple[Uncertainty, Interval]:
    """Noise and opacity of training readings; the interval of all readings before calibration."""
    kept, links = training.kept, training.links
    assert kept is not None
    paths = LinkPaths.of(kept, training.scene(), training.settings.losses.coherent)
    link, frequency, seed = links.link_of, links.frequency_of, training.settings.seed
    sure = most_likely(off[teach], paths, link[teach], frequency[teach], seed)
    ends = sure.interval(torch.zeros_like(off[of]), paths, link[of], frequency[of])
    low, high = (torch.zeros_like(off).masked_scatter(of, end) for end in ends)
    return sure, (low, high)


def _calibrated(
    interval: Interval, off: Tensor, which: Tensor, seed: int
) -> tuple[float, float | None]:
    """(by how much to widen [dB], coverage of halves by each other)."""
    low, high = (end[which] for end in interval)
    return widening(off[which], low, high), crossed_coverage(off[which], low, high, seed)


@dataclass(frozen=True)
class _Left:
    """A residual, and what it says of all readings of a fit, those it stands on cross-validated."""

    residual: SceneResidual
    median: Float[Tensor, "n"]
    interval: Interval

    @staticmethod
    def of(
        training: Training, off: Tensor, teach: Tensor, of: Tensor, settings: ResidualSettings
    ) -> "_Left":
        ends, seed = Ends.of(training.links), training.settings.seed
        rows = torch.nonzero(teach).squeeze(-1)
        if len(rows) > MOST:
            generator = torch.Generator().manual_seed(seed)
            rows = rows[torch.randperm(len(rows), generator=generator)[:MOST].sort().values]
        residual = SceneResidual.fit(ends.only(rows.numpy()), off[rows], settings, seed)
        others = of.clone()
        others[rows] = False
        others = torch.nonzero(others).squeeze(-1)
        columns = [torch.zeros_like(off) for _ in range(3)]
        told = [(rows, residual.held_out())]
        if len(others):
            told.append((others, residual.at(ends.only(others.numpy()))))
        for i, mixture in told:
            values = torch.from_numpy(mixture.quantile(0.5)), *bounds_of(mixture)
            for column, value in zip(columns, values, strict=True):
                column[i] = value
        return _Left(residual, columns[0], (columns[1], columns[2]))
