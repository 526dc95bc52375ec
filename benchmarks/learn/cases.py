"""One evaluation: what a method may learn from, and what it is asked."""

import csv
from dataclasses import dataclass
from pathlib import Path

from rfsg.learn.baselines import Readings


class DataError(Exception):
    """A data folder is not what the benchmark expects."""


@dataclass(frozen=True)
class Case:
    """``train`` and ``test`` of one run of a data set; ``test.rssi`` is only for the score.

    ``density`` in training readings a square foot of the crop, 0 where a data set has none.
    """

    data_set: str
    crop: str
    split: str
    density: float
    seed: int
    train: Readings
    test: Readings

    @property
    def name(self) -> str:
        return f"{self.crop}-{self.split}-{self.density:g}-{self.seed}".replace(" ", "_")


def table(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """Rows of a CSV file. Raises DataError when it is missing or lacks one of ``columns``."""
    if not path.is_file():
        raise DataError(f"{path}: not found; --data expects the folder of a data set")
    with open(path, newline="") as file:
        reader = csv.DictReader(file)
        lacking = [c for c in columns if c not in (reader.fieldnames or [])]
        if lacking:
            raise DataError(
                f"{path}: columns {', '.join(lacking)} missing, found "
                f"{', '.join(reader.fieldnames or ['none'])}; the README of the data names them"
            )
        return list(reader)


def number(path: Path, line: int, row: dict[str, str], column: str) -> float:
    """A cell as a number. Raises DataError with file, line and column when it is none."""
    try:
        return float(row[column])
    except (TypeError, ValueError):
        raise DataError(
            f"{path}: line {line}, column {column}: {row[column]!r}; expected a number"
        ) from None
