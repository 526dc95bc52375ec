"""Electrical properties of materials: Recommendation ITU-R P.2040-4 (09/2025), section 3, Table 3.

    eps_r = a f^b,   sigma = c f^d [S/m],   f in GHz,   eps_c = eps_r - j sigma / (2 pi f eps_0)

(Eqs. 57-59; time convention exp(+j 2 pi f t)). The Recommendation itself was not at hand: the rows
come from two public transcriptions of its Table 3 that agree in all they share. Rows up to 100 GHz
are those of edition 3 (08/2023); those above 100 GHz for wood, plywood, marble and floorboard, and
the last for ceiling board, stand in one of the two only. Where a second measured range overlaps the
first (glass at 250 GHz, say), the row that stands first here is used. Band edges belong to bands.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor

VACUUM_PERMITTIVITY = 8.8541878188e-12  # [F/m], CODATA 2022


class Row(NamedTuple):
    """One line of Table 3: valid from ``low`` to ``high`` [GHz], edges included."""

    low: float
    high: float
    a: float
    b: float
    c: float
    d: float


MATERIALS: dict[str, tuple[Row, ...]] = {
    "vacuum": (Row(0.001, 100, 1.0, 0, 0, 0),),
    "concrete": (Row(1, 100, 5.24, 0, 0.0462, 0.7822), Row(110, 330, 5.17, 0, 0.0145, 1.09)),
    "brick": (Row(1, 40, 3.91, 0, 0.0238, 0.16), Row(110, 330, 4.15, 0, 0.0006, 1.5712)),
    "plasterboard": (
        Row(1, 100, 2.73, 0, 0.0085, 0.9395),
        Row(110, 330, 2.56, 0, 0.0001, 1.7799),
        Row(100, 400, 2.65, 0, 0.0002, 1.598),
    ),
    "wood": (
        Row(0.001, 100, 1.99, 0, 0.0047, 1.0718),
        Row(110, 330, 1.82, 0, 0.0040, 1.0761),
        Row(100, 400, 2.1183, 0, 0.0055, 1.1113),
    ),
    "glass": (
        Row(0.1, 100, 6.31, 0, 0.0036, 1.3394),
        Row(220, 450, 5.79, 0, 0.0004, 1.658),
        Row(100, 400, 6.5767, 0, 0.0012, 1.4697),
    ),
    "clear_acrylic": (Row(110, 330, 2.58, 0, 0.0001, 1.6524),),
    "ceiling_board": (
        Row(1, 100, 1.48, 0, 0.0011, 1.0750),
        Row(220, 450, 1.52, 0, 0.0029, 1.029),
        Row(100, 400, 1.2567, 0, 0.00013, 1.454),
    ),
    "chipboard": (Row(1, 100, 2.58, 0, 0.0217, 0.78), Row(100, 200, 2.16, 0, 0.0023, 1.359)),
    "plywood": (
        Row(1, 40, 2.71, 0, 0.33, 0),
        Row(110, 330, 1.94, 0, 0.0067, 0.9982),
        Row(100, 400, 2.17, 0, 0.0063, 1.045),
    ),
    "marble": (
        Row(1, 60, 7.074, 0, 0.0055, 0.9262),
        Row(110, 330, 7.94, 0, 0.0001, 1.7330),
        Row(100, 400, 8.62, 0, 0.0027, 1.15),
    ),
    "floorboard": (
        Row(50, 100, 3.66, 0, 0.0044, 1.3515),
        Row(220, 300, 5.27, 0, 2.22e-17, 7.3413),
        Row(300, 400, 5.27, 0, 0.0003, 2.0298),
        Row(400, 450, 5.27, 0, 49.8726, 0),
        Row(100, 400, 3.1575, 0, 0.001675, 1.32775),
    ),
    "vinyl_tile": (Row(1, 40, 3.62, 0, 0.0051, 0.8422),),
    "carpet_tile": (Row(1, 40, 2.08, 0, 0.0009, 0.82),),
    "asphalt_concrete": (Row(1, 40, 4.83, 0, 0.0108, 1.3969),),
    "metal": (Row(1, 100, 1.0, 0, 1e7, 0),),
    "very_dry_ground": (Row(1, 10, 3.0, 0, 0.00015, 2.52),),
    "medium_dry_ground": (Row(1, 10, 15.0, -0.1, 0.035, 1.63),),
    "wet_ground": (Row(1, 10, 30.0, -0.4, 0.15, 1.30),),
}


def complex_permittivity(
    name: str, frequency_hz: Float[Tensor, "*f"] | float, extrapolate: bool = False
) -> Complex[Tensor, "*f"]:
    """Relative complex permittivity eps_c of an ITU material, differentiable in frequency [Hz].

    Raises ValueError for an unknown name, and outside the material's bands unless ``extrapolate``:
    then the formula of the nearest band (in octaves) is used beyond its edge.
    """
    frequency = torch.as_tensor(frequency_hz, dtype=torch.float64)
    a, b, c, d = _coefficients(name, frequency.detach(), extrapolate)
    ghz = frequency * 1e-9
    return from_constants(a * ghz**b, c * ghz**d, frequency)


def bands(name: str) -> str:
    """Where the Recommendation gives a material, in words; ValueError for an unknown name."""
    ranges = ", ".join(f"{row.low:g}-{row.high:g} GHz" for row in _rows(name))
    return f"ITU-R P.2040-4 gives it for {ranges}"


def outside(name: str, frequency_hz: Float[Tensor, "f"]) -> list[float]:
    """The frequencies [Hz] among these for which the Recommendation does not give a material."""
    rows = _rows(name)
    return [hz for hz in frequency_hz.reshape(-1).tolist() if not _inside(rows, hz)]


def permittivity_slope(
    name: str, frequency_hz: Float[Tensor, "*f"], extrapolate: bool = False
) -> Complex[Tensor, "*f"]:
    """d eps_c / df [1/Hz] of an ITU material, for group delays; same errors as above."""
    frequency = frequency_hz.to(torch.float64)
    _, b, _, d = _coefficients(name, frequency.detach(), extrapolate)
    eps = complex_permittivity(name, frequency, extrapolate)
    return torch.complex(b * eps.real, (d - 1) * eps.imag) / frequency


def from_constants(
    eps_r: Float[Tensor, "*#f"], sigma: Float[Tensor, "*#f"], frequency: Float[Tensor, "*#f"]
) -> Complex[Tensor, "*f"]:
    """eps_c = eps_r - j sigma / (2 pi f eps_0) (Eq. 59), sigma in S/m, frequency in Hz."""
    loss = sigma / (2 * math.pi * VACUUM_PERMITTIVITY * frequency)
    eps_r, loss = torch.broadcast_tensors(eps_r, loss)
    return torch.complex(eps_r, -loss)


def _rows(name: str) -> tuple[Row, ...]:
    if name not in MATERIALS:
        raise ValueError(
            f"ITU material: got {name!r}, expected one of {', '.join(MATERIALS)}; for any other "
            "material give eps_r and sigma"
        )
    return MATERIALS[name]


def _coefficients(name: str, frequency: Tensor, extrapolate: bool) -> tuple[Tensor, ...]:
    """a, b, c, d for each frequency, shaped like it."""
    rows = _rows(name)
    chosen = [_row(name, rows, hz, extrapolate)[2:] for hz in frequency.reshape(-1).tolist()]
    table = torch.tensor(chosen, dtype=torch.float64, device=frequency.device).reshape(-1, 4)
    return table.reshape(*frequency.shape, 4).unbind(-1)


def _row(name: str, rows: Sequence[Row], hz: float, extrapolate: bool) -> Row:
    if not (hz > 0 and math.isfinite(hz)):
        raise ValueError(f"frequency: expected a positive number of hertz, got {hz!r}")
    if found := _inside(rows, hz):
        return found[0]
    if not extrapolate:
        raise ValueError(
            f"{name}: {bands(name)}, not for {hz / 1e9:g} GHz; pass "
            "extrapolate=True to use the nearest band's formula, or give eps_r and sigma"
        )
    return min(rows, key=lambda row: _octaves_away(row, hz))


def _inside(rows: Sequence[Row], hz: float) -> list[Row]:
    """The rows that hold; edges are compared in hertz, where each is a whole number."""
    return [row for row in rows if _edge(row.low) <= hz <= _edge(row.high)]


def _edge(ghz: int | float) -> int:
    return round(ghz * 1e9)


def _octaves_away(row: Row, hz: float) -> float:
    return max(math.log2(_edge(row.low) / hz), math.log2(hz / _edge(row.high)))
