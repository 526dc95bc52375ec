"""A wall's plane-wave layer against the exact field of a point source behind it."""

import math

from accuracy.table import Row, Table, percents
from tests.truths.layers import WALLS, second_term, seen_at, sommerfeld, through

ANGLES = (0.0, 40.0, 65.0)  # [deg]
THICKNESS, AWAY = 0.1, 6.0  # [m]
# percent, of T alone and of T with the second term, at each angle
BOUNDS = {
    2.4e9: ((0.5, 0.5, 0.7), (0.01, 0.01, 0.01)),
    5.8e9: ((0.5, 0.8, 1.2), (0.01, 0.01, 0.01)),
    28e9: ((0.5, 3.5, 6.0), (0.01, 0.1, 0.2)),
}
OWN_ERROR = 1e-7  # percent: what the integral makes of no wall at all


def point_source() -> Table:
    rows = []
    for f, bounds in BOUNDS.items():
        found = zip(*(_errors(f, angle) for angle in ANGLES), strict=True)
        cases = (f"{f / 1e9:g} GHz, T", f"{f / 1e9:g} GHz, T and the second term")
        rows += [Row(*row) for row in zip(cases, map(percents, found, bounds), strict=True)]
    own = [abs(sommerfeld(28e9, 0.0, *seen_at(a, AWAY)[:2]) - 1.0) for a in ANGLES]
    rows.append(Row("28 GHz, the integral itself", percents(own, [OWN_ERROR] * len(ANGLES))))
    return Table(
        "Solids: a point source behind a wall",
        "T of a wall of 10 cm, eps_r 5.24 and 0.15 S/m, TE, radios 6 m before and behind it, drawn as a "
        "slab and as a solid (the worse of the two), against the Sommerfeld integral of a point source "
        "through the layer (Chew, Waves and Fields in Inhomogeneous Media, Eq. 2.2.30; "
        "`tests/truths/layers.py`), by Gauss-Legendre quadrature. T is for plane waves, the first term "
        "of that field; the second is j / (2 k r) times T's Laplacian over directions, and rfsg leaves "
        "it out. The last row is the integral without a wall, against free space.",
        tuple(f"{a:g} deg" for a in ANGLES),
        tuple(rows),
    )


def _errors(f: float, angle: float) -> tuple[float, float]:
    """Relative errors of T, without and with the second term."""
    rho, height, r = seen_at(angle, AWAY)
    exact = sommerfeld(f, THICKNESS, rho, height)
    second = second_term(math.radians(angle), f, THICKNESS, r)
    found = [through(make(THICKNESS), angle, f, THICKNESS, AWAY) for make in WALLS.values()]
    alone, both = (max(abs(t + more - exact) / abs(exact) for t in found) for more in (0.0, second))
    return alone, both


TABLES = (point_source,)
