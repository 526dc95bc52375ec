"""Figures with the bounds that they are held to, and the tables that they stand in."""

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """What was measured, and the magnitude that the page promises it stays within; a percent is 0.01."""

    value: float
    bound: float
    unit: str = "%"

    def __post_init__(self) -> None:
        if not (self.bound > 0 and math.isfinite(self.bound) and self.unit in ("%", "dB")):
            raise ValueError(f"{self}: expected a bound above 0, in % or dB")

    @property
    def holds(self) -> bool:
        return abs(self.value) <= self.bound  # False for NaN

    def __str__(self) -> str:
        if self.unit == "dB":
            return f"{self.value:.2f} dB ({self.bound:g})"
        return f"{100.0 * self.value:.2g} % ({100.0 * self.bound:g})"


@dataclass(frozen=True)
class Row:
    case: str
    figures: tuple[Figure, ...]


@dataclass(frozen=True)
class Table:
    """told: what is compared with what, and where the truth is from. columns: one per figure."""

    title: str
    told: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]

    def __post_init__(self) -> None:
        wrong = [row.case for row in self.rows if len(row.figures) != len(self.columns)]
        if wrong or not self.rows:
            raise ValueError(f"{self.title}: expected one figure per column in {wrong or 'a row'}")

    def broken(self) -> list[str]:
        """Every figure beyond its bound, in words."""
        return [
            f"{self.title}: {row.case}, {column}: {figure}"
            for row in self.rows
            for column, figure in zip(self.columns, row.figures, strict=True)
            if not figure.holds
        ]


def percents(values: Iterable[float], bounds: Iterable[float]) -> tuple[Figure, ...]:
    """Relative errors; their bounds in percent."""
    return tuple(Figure(float(v), b / 100.0) for v, b in zip(values, bounds, strict=True))


def decibels(values: Iterable[float], bounds: Iterable[float]) -> tuple[Figure, ...]:
    return tuple(Figure(float(v), b, "dB") for v, b in zip(values, bounds, strict=True))


def markdown(tables: Iterable[Table]) -> str:
    return "\n".join(_table(t) for t in tables)


def _table(table: Table) -> str:
    rows = [(row.case, *map(str, row.figures)) for row in table.rows]
    lines = [("", *table.columns), ("---",) * (1 + len(table.columns)), *rows]
    cells = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([f"## {table.title}", "", table.told, "", *cells, ""])
