"""What a person asks about a fit: errors before and after, counts, settings, ready for JSON."""

from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from rfsg.learn.losses import Predicted, residual_db
from rfsg.learn.measurements import Measurements, Quantity
from rfsg.learn.training import Training

if TYPE_CHECKING:
    from rfsg.learn.fit import Fitted


def report_of(training: Training, fitted: "Fitted") -> dict[str, Any]:
    """What ``report.json`` holds."""
    measured, held = fitted.measured, training.held
    kept = training.kept
    assert kept is not None
    speaking, power = training.speaking(kept), training.selection.power
    seconds = np.array(training.seconds or [0.0])
    uncertainty, residual = fitted.spread.told() if fitted.spread else (None, None)
    return {
        "train": _stages(fitted, ~held),
        "validation": _stages(fitted, held),
        "uncertainty": uncertainty,
        "residual": residual,
        "selected": training.selection.rows(),
        "offsets": {
            "gains_db": fitted.gains_db,
            "power_db": None if power is None else float(power.detach()),
        },
        "readings": {
            "all": len(measured),
            "train": int((~held).sum()),
            "say_something": int((speaking & ~held).sum()),
            "not_received": int((~measured.received).sum()),
            "received_without_a_path": int((measured.received & ~fitted.after.arrives).sum()),
        },
        "frequency_hz": training.links.frequency.tolist(),
        "paths": {
            "all": len(kept.link),
            "meet_what_is_learned": int(kept.live.sum()),
            "solved_again_each_step": int(kept.traced.sum()),
            "held_between_searches": kept.held(),
        },
        "statuses": dict(sorted(kept.counts.items())),
        "searches": training.searches,
        "steps": training.done,
        "refused_steps": dict(training.refused),
        "seconds_per_step": {
            "median": float(np.median(seconds)),
            "p90": float(np.percentile(seconds, 90)),
        },
        "settings": training.settings.told(),
        "source": measured.source,
    }


def _stages(fitted: "Fitted", where: Tensor) -> dict[str, Any]:
    """Errors of some readings before the fit, after it, and with what the scene leaves."""
    measured, spread = fitted.measured, fitted.spread
    stages = {"before": _errors(fitted.before, measured, where)}
    stages["after"] = _errors(fitted.after, measured, where)
    if spread is not None and spread.left is not None:
        off = residual_db(fitted.after, measured) + spread.left
        off = off[where & spread.of & measured.received].abs().numpy()
        size = {"median_db": _quantile(off, 50), "p90_db": _quantile(off, 90)}
        stages["with_residual"] = {"readings": len(off), **size}
    return stages


def _errors(predicted: Predicted, measured: Measurements, where: Tensor) -> dict[str, Any]:
    """Median and 90th percentile of |error| [dB] of received powers and gains; delays apart.

    not_received_but_predicted: readings below their threshold that are predicted above it.
    """
    power = measured.quantity != int(Quantity.DELAY)
    use = where & measured.received & predicted.arrives
    off = residual_db(predicted, measured)[use & power].abs().numpy()
    late = (predicted.delay - measured.value[:, 0])[use & ~power].abs().numpy()
    silent = where & ~measured.received
    loud = silent & predicted.arrives & (predicted.rssi_dbm() > measured.threshold)
    return {
        "readings": len(off),
        "median_db": _quantile(off, 50),
        "p90_db": _quantile(off, 90),
        "median_delay_s": _quantile(late, 50),
        "not_received": int(silent.sum()),
        "not_received_but_predicted": int(loud.sum()),
    }


def _quantile(values: np.ndarray, percent: float) -> float | None:
    return float(np.percentile(values, percent)) if len(values) else None
