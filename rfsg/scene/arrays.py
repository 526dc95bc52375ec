"""Antenna arrays: where the elements of a radio stand in the radio's own frame."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.scene.errors import SceneError
from rfsg.scene.files import open_csv

UNITS = ("wavelength", "m")
MAX_ELEMENTS = 4096
MAX_CSV_BYTES = 2**20


@dataclass(frozen=True, eq=False)
class Array:
    """Equal elements, all turned as the radio is, each with the radio's pattern and polarisation.

    offsets: places of the elements from the radio's position, in its own frame (+x boresight, +z up),
    in metres or in wavelengths: of the radio's own frequency, or of the first that is simulated, so an
    array does not stretch over a band. layout: what ``planar`` was asked for, for files.

    Raises SceneError for none or more than 4096 elements, and for what is no finite place.
    """

    offsets: Float[Tensor, "n 3"]
    unit: str = "wavelength"
    layout: tuple[int, int, float, float] | None = None

    def __post_init__(self) -> None:
        if self.unit not in UNITS:
            raise SceneError([f"array: unit is {self.unit!r}; expected one of {', '.join(UNITS)}"])
        _triples(self.offsets)
        _count(len(self.offsets))
        if not bool(torch.isfinite(self.offsets).all()):
            raise SceneError(["array: offsets hold numbers that are not finite"])

    def __len__(self) -> int:
        return len(self.offsets)

    def __str__(self) -> str:
        if self.layout is None:
            return f"{len(self)} elements"
        rows, columns, vertical, horizontal = self.layout
        return f"{rows} x {columns}, {vertical:g} x {horizontal:g} {self.unit}"

    @staticmethod
    def planar(
        rows: int,
        columns: int,
        spacing_v: float = 0.5,
        spacing_h: float = 0.5,
        unit: str = "wavelength",
    ) -> "Array":
        """Rows and columns in the radio's y-z plane, centred on its position (3GPP TR 38.901 7.3).

        Elements go column by column from +y's far end, each from the bottom up: the row index runs
        fastest and the column grows with y, as in figure 7.3-1 and in the codebooks of TS 38.214.
        """
        whole = all(isinstance(n, int) and n > 0 for n in (rows, columns))
        if not whole or not all(math.isfinite(s) and s > 0 for s in (spacing_v, spacing_h)):
            raise SceneError(
                [f"array: {rows} rows and {columns} columns with spacings {spacing_v} and {spacing_h}; "
                 "expected whole numbers and spacings > 0"]
            )  # fmt: skip
        _count(rows * columns)
        z = (torch.arange(rows, dtype=torch.float64) - (rows - 1) / 2) * spacing_v
        y = (torch.arange(columns, dtype=torch.float64) - (columns - 1) / 2) * spacing_h
        y, z = (g.reshape(-1) for g in torch.meshgrid(y, z, indexing="ij"))
        offsets = torch.stack([torch.zeros_like(y), y, z], -1)
        return Array(offsets, unit, (rows, columns, float(spacing_v), float(spacing_h)))

    @staticmethod
    def of(offsets: Sequence[Sequence[float]], unit: str = "wavelength") -> "Array":
        """Elements at any places (x, y, z). SceneError for what is not triples of numbers."""
        try:
            places = torch.tensor(offsets, dtype=torch.float64)
        except (TypeError, ValueError) as error:
            raise SceneError([f"array: expected triples of numbers: {error}"]) from error
        _triples(places)
        return Array(places, unit)

    @staticmethod
    def from_csv(path: str | Path, unit: str = "wavelength") -> "Array":
        """Elements from a CSV file with the columns x, y and z.

        Raises SceneError listing every fault with file and line."""
        path = Path(path)
        with open_csv(path, MAX_CSV_BYTES) as file:
            lines = csv.reader(file, skipinitialspace=True)
            if [c.strip() for c in next(lines, [])] != ["x", "y", "z"]:
                raise SceneError([f"{path}:1: expected the columns x, y, z"])
            rows = [(lines.line_num, row) for row in lines if row]
        places = [_place(row) for _, row in rows]
        faults = [
            f"{path}:{line}: expected three finite numbers, got {', '.join(row)[:60]!r}"
            for (line, row), place in zip(rows, places, strict=True)
            if place is None
        ]
        if faults:
            raise SceneError(faults)
        try:
            return Array.of([place for place in places if place is not None], unit)
        except SceneError as error:
            raise SceneError([f"{path}: {fault}" for fault in error.faults]) from error

    def metres(self, wavelength: float) -> Float[Tensor, "n 3"]:
        """The offsets in metres, for the wavelength [m] that the unit refers to."""
        return self.offsets * wavelength if self.unit == "wavelength" else self.offsets


def _triples(places: Tensor) -> None:
    if places.ndim != 2 or places.shape[1] != 3:
        shape = tuple(places.shape)
        raise SceneError([f"array: offsets have shape {shape}; expected (elements, 3)"])


def _count(elements: int) -> None:
    if not 1 <= elements <= MAX_ELEMENTS:
        raise SceneError([f"array: {elements} elements; expected 1 to {MAX_ELEMENTS}"])


def _place(row: list[str]) -> list[float] | None:
    try:
        place = [float(cell) for cell in row]
    except ValueError:
        return None
    return place if len(place) == 3 and all(map(math.isfinite, place)) else None
