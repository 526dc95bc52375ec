"""Mirrors of trained and rippled metal plates against physical optics."""

import numpy as np

from accuracy.table import Row, Table, decibels
from tests.truths.plates import AMPLITUDES, PATCHES, Compared, trained, with_ripple

# dB: of the mean, of the mean magnitude, of the greatest
TRAINED = {2.4e9: (0.1, 0.1, 0.1), 28e9: (0.2, 0.2, 0.2), 140e9: (0.5, 0.5, 0.5)}
RIPPLED = {2.4e9: (0.5, 0.5, 0.6), 28e9: (0.5, 0.5, 1.5), 140e9: (0.5, 0.5, 0.5)}


def plates() -> Table:
    rows = [_row("trained cabinet", f, trained(f), TRAINED[f]) for f in PATCHES]
    rows += [
        _row(f"ripple of {1e3 * height:g} mm", f, with_ripple(f), RIPPLED[f])
        for f, height in AMPLITUDES.items()
    ]
    return Table(
        "Learned faces: mirrors of metal plates",
        "|h| of the one reflected path over a Kirchhoff integral of the same face (Balanis, Advanced "
        "Engineering Electromagnetics, 2012, section 7.9; `tests/truths/plates.py`), over several "
        "receivers. Trained: the broad face of the cabinet of assets/, as metal, beside a flat one, by "
        "both. Rippled: a plate with a ripple 20 cm long, in the plane of incidence.",
        ("mean", "mean magnitude", "greatest magnitude"),
        tuple(rows),
    )


def _row(case: str, f: float, found: Compared, bounds: tuple[float, ...]) -> Row:
    for receivers in found.mirrors:
        if receivers != list(range(len(found.errors))):
            raise RuntimeError(f"{case}: expected one path per receiver, got {receivers}")
    size = np.abs(found.errors)
    figures = decibels((found.errors.mean(), size.mean(), size.max()), bounds)
    return Row(f"{case}, {f / 1e9:g} GHz", figures)


TABLES = (plates,)
