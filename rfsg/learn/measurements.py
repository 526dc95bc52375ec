"""Measurements: what was read between two places, as one frozen table; read from and written to CSV.

Columns, in any order; unknown ones are refused. One line is one reading.

| column | |
|---|---|
| ``tx``, ``rx`` | prim path or name of a radio of the scene; empty where the scene has only one |
| ``tx_x_m, tx_y_m, tx_z_m``, ``rx_...`` | place [m, world] of what is no radio of the scene, instead |
| ``frequency_hz`` | [Hz]; may be left out where it is given for the whole file |
| ``rssi_dbm`` | received power: transmit power + path gain + offsets |
| ``path_gain_db`` | 10 log10 of the path gain, antennas included |
| ``gain_re``, ``gain_im`` | h(f), complex |
| ``delay_s`` | of the strongest path, with any of ``aoa_azimuth_deg``, ``aoa_zenith_deg`` (towards where |
| | the wave comes from), ``aod_azimuth_deg``, ``aod_zenith_deg`` (in which it leaves), world |
| ``threshold_dbm`` | weakest rssi that the receiver would have heard |

A line holds one kind of quantity, and only that. A line without any was **not received**: its rssi
was below the threshold, which must be given in the line or for the whole file.
"""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.learn.errors import MeasurementError
from rfsg.learn.reading import ANGLES, COLUMNS, VALUES, Place, built, cell, read, refuse_names
from rfsg.learn.reading import Quantity as Quantity
from rfsg.scene.weights import write_beside


@dataclass(frozen=True)
class Measurements:
    """n readings. ``tx`` and ``rx`` number ``tx_places`` and ``rx_places``.

    value: rssi [dBm], path gain [dB] or delay [s] in the first column; real and imaginary part of a
    gain in both; 0 where nothing is given. angle: of ANGLES [degrees], 0 where ``has_angle`` is
    False. threshold [dBm]: -inf where none is given.
    """

    tx_places: tuple[Place, ...]
    rx_places: tuple[Place, ...]
    tx: Int[Tensor, "n"]
    rx: Int[Tensor, "n"]
    frequency: Float[Tensor, "n"]
    quantity: Int[Tensor, "n"]
    value: Float[Tensor, "n 2"]
    angle: Float[Tensor, "n 4"]
    has_angle: Bool[Tensor, "n 4"]
    received: Bool[Tensor, "n"]
    threshold: Float[Tensor, "n"]
    source: str = ""

    def __len__(self) -> int:
        return len(self.tx)

    @staticmethod
    def from_csv(
        path: str | Path,
        *,
        frequency_hz: float | None = None,
        threshold_dbm: float | None = None,
    ) -> "Measurements":
        """Read a file; frequency_hz and threshold_dbm stand in where a line leaves them empty.

        Raises MeasurementError with every fault: file, line, column, what was given and expected.
        """
        cells, lines = read(Path(path))
        where = str(path)
        return Measurements(
            **built(cells, lambda i: f"{where}:{lines[i]}", where, frequency_hz, threshold_dbm)
        )

    @staticmethod
    def of(
        *,
        frequency_hz: float | None = None,
        threshold_dbm: float | None = None,
        **columns: Sequence[Any],
    ) -> "Measurements":
        """From columns of equal length, named as in a file; None for an empty cell.

        Raises MeasurementError as ``from_csv`` does, naming rows from 0.
        """
        cells = {name: [cell(v) for v in column] for name, column in columns.items()}
        if len({len(column) for column in cells.values()}) > 1:
            lengths = ", ".join(f"{n} {len(c)}" for n, c in cells.items())
            raise MeasurementError([f"measurements: columns differ in length: {lengths}"])
        refuse_names(list(cells), "measurements")
        return Measurements(**built(cells, lambda i: f"row {i}", "", frequency_hz, threshold_dbm))

    def take(self, i: Int[Tensor, "m"] | Bool[Tensor, "n"]) -> "Measurements":
        """Some of the readings; the places stay as they are numbered."""
        return replace(self, **{name: getattr(self, name)[i] for name in _PER_ROW})

    def split(self, share: float, seed: int = 0) -> tuple["Measurements", "Measurements"]:
        """(the rest, a random ``share`` in [0, 1) of the readings), both in order."""
        if not 0 <= share < 1:
            raise MeasurementError([f"share={share!r}: expected a number in [0, 1)"])
        order = torch.randperm(len(self), generator=torch.Generator().manual_seed(seed))
        held = torch.zeros(len(self), dtype=torch.bool)
        held[order[: round(share * len(self))]] = True
        return self.take(~held), self.take(held)

    def frequencies(self) -> Float[Tensor, "f"]:
        """Every frequency that occurs [Hz], ascending."""
        return torch.unique(self.frequency)

    def csv(self) -> bytes:
        """The table as a CSV file that reads back to the same numbers."""
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(self._cells(i) for i in range(len(self)))
        return file.getvalue().encode()

    def to_csv(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write ``csv`` to a file. Raises SceneError where it is there and not to be replaced."""
        write_beside(Path(path), self.csv(), overwrite)
        return Path(path)

    def _cells(self, i: int) -> list[str]:
        row: dict[str, Any] = {"frequency_hz": self.frequency[i]}
        for end, place in (
            ("tx", self.tx_places[int(self.tx[i])]),
            ("rx", self.rx_places[int(self.rx[i])]),
        ):
            if isinstance(place, str):
                row[end] = place
            else:
                row |= {f"{end}_{axis}_m": x for axis, x in zip("xyz", place, strict=True)}
        if bool(self.received[i]):
            names = VALUES[Quantity(int(self.quantity[i]))]
            row |= dict(zip(names, self.value[i].tolist(), strict=False))
        row |= {n: self.angle[i, k] for k, n in enumerate(ANGLES) if bool(self.has_angle[i, k])}
        if math.isfinite(float(self.threshold[i])):
            row["threshold_dbm"] = self.threshold[i]
        return [cell(row.get(name)) for name in COLUMNS]


_PER_ROW = [
    f.name for f in fields(Measurements) if f.name not in ("tx_places", "rx_places", "source")
]
