"""Edge diffraction of conductors against exact fields of a line source."""

import math

from accuracy.table import Row, Table, decibels, percents
from tests.objects.physics.wedges import PI, WIDTH, in_line, screen_errors, wedge_error

WEDGES = {1.25: "135 deg", 1.5: "90 deg", 1.75: "45 deg", 2.0: "half plane"}  # n, the solid's angle
SERIES = (
    "the eigenfunction series of a line source by a conducting wedge (Balanis, Advanced Engineering "
    "Electromagnetics, 2012, section 14.5; `tests/objects/physics/wedges.py`)"
)
NEAR = (0.05, 0.1, 0.5)  # wavelengths
NEAR_BOUNDS = {1.25: (9, 6, 2), 1.5: (8, 5, 1), 1.75: (4, 3, 1), 2.0: (0.1, 0.1, 0.1)}
FAR = (10.0, 40.0, 160.0)  # k rho
FAR_BOUNDS = (0.7, 0.17, 0.04)


def near() -> Table:
    rows = []
    for n, solid in WEDGES.items():
        errors = [_worst(2 * PI, 5.0, away, n) for away in NEAR]
        rows.append(Row(solid, percents(errors, NEAR_BOUNDS[n])))
    return Table(
        "Edges: close to one",
        "The field about a conducting wedge by rays (direct, mirrored, diffracted), a line source 5 "
        "wavelengths from the edge and the receiver at a part of one: the worst error all about the "
        f"wedge, soft and hard, in free fields at the whole way, against {SERIES}. Of rfsg these are the "
        "terms of `rfsg/objects/physics/utd.py`, weighed as the articles write it "
        "(`wedge_twin.py` beside it), and `tests/tracer/test_diffraction.py` holds the tracer to that.",
        tuple(f"{away:g} wavelengths" for away in NEAR),
        tuple(rows),
    )


def far() -> Table:
    rows = []
    for n, solid in WEDGES.items():
        errors = [_worst(k, 1.0, 1.3, n) for k in FAR]
        rows.append(Row(solid, percents(errors, FAR_BOUNDS)))
    return Table(
        "Edges: far from one",
        "The same with the source at rho and the receiver at 1.3 rho.",
        tuple(f"rho {k / (2 * PI):.2g} wavelengths" for k in FAR),
        tuple(rows),
    )


def _worst(k: float, rho_in: float, rho_out: float, n: float) -> float:
    return max(wedge_error(k, rho_in, rho_out, n, hard) for hard in (0, 1))


def screen() -> Table:
    rows = []
    for k, free, shadow in ((2 * PI, (0.6, 2.0), (16, 8)), (8 * PI, (0.15, 0.5), (16, 8))):
        found = zip(*(screen_errors(k, hard) for hard in (0, 1)), strict=True)
        thick = f"{k * WIDTH / (2 * PI):.1f} wavelengths thick"
        words = ("in free fields", "in its shadow, in fields there", "the boundary integral itself")
        bounds = (free, shadow, (0.03, 0.03))
        rows += [
            Row(f"{thick}, {case}", percents(errors, bound))
            for case, errors, bound in zip(words, found, bounds, strict=True)
        ]
    low = [20 * math.log10(abs(ours / exact)) for ours, exact in map(in_line, (0, 1))]
    thin = f"{WIDTH:.1f} wavelengths thick"
    rows.append(Row(f"{thin}, radios and face in one plane", decibels(low, (3.0, 3.0))))
    return Table(
        "Edges: two, of a thick screen",
        "The field behind a thick conducting screen by rays over one and two edges, against a boundary "
        "integral (Colton and Kress, Inverse Acoustic and Electromagnetic Scattering Theory, chapter 3; "
        "`tests/objects/physics/boundary_integral.py`), worst of eight receivers, five of them in the "
        "shadow. The integral's own error is the field that it leaves within the screen. Where source, "
        "both edges and receiver lie in one plane the second edge stands in the transition zone of the "
        "first: the last row is the rays' field over the exact one.",
        ("soft", "hard"),
        tuple(rows),
    )


TABLES = (near, far, screen)
