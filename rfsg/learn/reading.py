"""Reading measurements: a CSV file, or columns, becomes the fields of ``Measurements``.

Every fault is found at once; each names file, line, column, what was given, what was expected.
"""

import csv
import io
import math
from collections.abc import Callable, Mapping
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rfsg.learn.errors import MeasurementError

MAX_CSV_BYTES = 128 * 2**20
MAX_ROWS = 1_000_000
FASTEST = 1.0  # [s] a delay above this is given in another unit than seconds
Place = str | tuple[float, float, float]  # name of a radio ("" for the only one), or [m, world]


class Quantity(IntEnum):
    """What a reading is of."""

    RSSI = 0  # [dBm]; also readings that were not received
    PATH_GAIN = 1  # [dB]
    GAIN = 2  # complex h(f)
    DELAY = 3  # [s], of the strongest path


ANGLES = ("aoa_azimuth_deg", "aoa_zenith_deg", "aod_azimuth_deg", "aod_zenith_deg")
VALUES = {
    Quantity.RSSI: ("rssi_dbm",),
    Quantity.PATH_GAIN: ("path_gain_db",),
    Quantity.GAIN: ("gain_re", "gain_im"),
    Quantity.DELAY: ("delay_s",),
}
_PLACES = tuple(f"{end}_{axis}_m" for end in ("tx", "rx") for axis in "xyz")
COLUMNS = (
    *("tx", "rx", *_PLACES, "frequency_hz"),
    *(name for names in VALUES.values() for name in names),
    *(*ANGLES, "threshold_dbm"),
)
GROUPS = (_PLACES[:3], _PLACES[3:], VALUES[Quantity.GAIN])  # columns that go together


def read(path: Path) -> tuple[dict[str, list[str]], list[int]]:
    """(cells by column, the line of each row) of a file. Raises MeasurementError."""
    if not path.is_file():
        raise MeasurementError([f"{path}: no such file"])
    if path.stat().st_size > MAX_CSV_BYTES:
        raise MeasurementError([f"{path}: larger than {MAX_CSV_BYTES // 2**20} MB; split it"])
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise MeasurementError(
            [f"{path}: not UTF-8 text ({error.reason} at byte {error.start})"]
        ) from error
    names, rows, lines = _table(text, str(path))
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}, lines


def _table(text: str, where: str) -> tuple[list[str], list[list[str]], list[int]]:
    """(names, rows, their lines); MeasurementError for what is no table of known columns."""
    reader = csv.reader(io.StringIO(text))
    try:
        names = [name.strip() for name in next(reader, [])]
        refuse_names(names, f"{where}:1")
        rows, lines, faults = [], [], []
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue  # an empty line at the end of a file
            if len(row) != len(names):
                faults.append(
                    f"{where}:{reader.line_num}: {len(row)} cells, expected {len(names)} as in the "
                    "first line (a decimal comma, or a comma in a name without quotes?)"
                )
            rows.append([cell.strip() for cell in row])
            lines.append(reader.line_num)
            if len(rows) > MAX_ROWS:
                raise MeasurementError(
                    [f"{where}: more than {MAX_ROWS:,} readings; split the file"]
                )
    except csv.Error as error:
        raise MeasurementError([f"{where}:{reader.line_num}: not CSV: {error}"]) from error
    if faults:
        raise MeasurementError(faults)
    return names, rows, lines


def refuse_names(names: list[str], where: str) -> None:
    faults = [
        f"{where}: column {name!r} stands there twice"
        for name in set(names)
        if names.count(name) > 1
    ]
    faults += [
        f"{where}: column {name!r} is unknown; expected some of {', '.join(COLUMNS)}"
        for name in names
        if name not in COLUMNS
    ]
    faults += [
        f"{where}: column {missing!r} is missing beside {given!r}"
        for group in GROUPS
        for given in group[:1]
        if any(n in names for n in group)
        for missing in group
        if missing not in names
    ]
    if not faults and not any(n in names for group in VALUES.values() for n in group):
        faults.append(f"{where}: no column holds a reading: expected rssi_dbm or another quantity")
    if faults:
        raise MeasurementError(sorted(faults))


def built(
    cells: Mapping[str, list[str]],
    where: Callable[[int], str],
    source: str,
    frequency_hz: float | None,
    threshold_dbm: float | None,
) -> dict[str, Any]:
    """Columns of text as the fields of ``Measurements``: every number once, all faults together."""
    n = len(next(iter(cells.values()), []))
    if not n:
        raise MeasurementError([f"{source or 'measurements'}: holds no readings"])
    faults: list[str] = []
    number = {
        name: _numbers(cells[name], name, where, faults)
        for name in COLUMNS
        if name in cells and name not in ("tx", "rx")
    }
    given = {name: ~np.isnan(column) for name, column in number.items()}
    none, empty = np.zeros(n, dtype=bool), np.full(n, np.nan)

    def has(name: str) -> np.ndarray:
        return given.get(name, none)

    for group in GROUPS:
        some, every = (f([has(name) for name in group], axis=0) for f in (np.any, np.all))
        faults += [
            f"{where(i)}: {', '.join(group)}: expected all of them or none"
            for i in _rows(some & ~every)
        ]
    kinds = np.stack([np.any([has(name) for name in names], axis=0) for names in VALUES.values()])
    for i in _rows(kinds.sum(0) > 1):
        named = [name for k, names in VALUES.items() if kinds[k, i] for name in names]
        faults.append(f"{where(i)}: {', '.join(named)}: expected one kind of quantity in a line")
    angles = np.stack([has(name) for name in ANGLES])
    for i in _rows(angles.any(0) & ~kinds[Quantity.DELAY]):
        faults.append(f"{where(i)}: angles without delay_s: expected the delay of the same path")
    received = kinds.any(0)
    threshold = _filled(number.get("threshold_dbm", empty), threshold_dbm)
    for i in _rows(~received & np.isnan(threshold)):
        faults.append(
            f"{where(i)}: no quantity, so not received, but below which power? expected "
            "threshold_dbm in the line, or for the whole file"
        )
    frequency = _filled(number.get("frequency_hz", empty), frequency_hz)
    for i in _rows(np.isnan(frequency)):
        faults.append(f"{where(i)}: frequency_hz is empty: expected hertz here or for the file")
    faults += _implausible(number, frequency, where)
    places = [_places(cells, number, end, where, faults) for end in ("tx", "rx")]
    if faults:
        raise MeasurementError(faults)
    value = np.zeros((n, 2))
    for names in VALUES.values():
        for column, name in enumerate(names):
            value[has(name), column] = number.get(name, empty)[has(name)]
    angle = np.stack([np.nan_to_num(number.get(name, empty)) for name in ANGLES], -1)
    return {
        "tx_places": places[0][0],
        "rx_places": places[1][0],
        "tx": places[0][1],
        "rx": places[1][1],
        "frequency": torch.from_numpy(frequency),
        "quantity": torch.from_numpy(np.where(received, kinds.argmax(0), int(Quantity.RSSI))),
        "value": torch.from_numpy(value),
        "angle": torch.from_numpy(angle),
        "has_angle": torch.from_numpy(angles.T.copy()),
        "received": torch.from_numpy(received),
        "threshold": torch.from_numpy(np.where(np.isnan(threshold), -np.inf, threshold)),
        "source": source,
    }


def _numbers(
    column: list[str], name: str, where: Callable[[int], str], faults: list[str]
) -> np.ndarray:
    """Cells as float64, NaN where empty: a mark inside this file only."""
    out = np.full(len(column), np.nan)
    for i, given in enumerate(column):
        if not given:
            continue
        try:
            value = float(given)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            value = math.inf  # something stands there; the fault is said once
            cause = "; a decimal comma?" if "," in given else ""
            faults.append(
                f"{where(i)}: {name}: expected a finite number, got {given!r} "
                f"(leave a cell empty where nothing was received){cause}"
            )
        out[i] = value
    return out


def _rows(where: np.ndarray) -> list[int]:
    return np.flatnonzero(where).tolist()


def _filled(column: np.ndarray, default: float | None) -> np.ndarray:
    return column if default is None else np.where(np.isnan(column), float(default), column)


def _implausible(
    number: Mapping[str, np.ndarray], frequency: np.ndarray, where: Callable[[int], str]
) -> list[str]:
    """Numbers that are no such quantity, with what they probably are."""
    faults = [
        f"{where(i)}: frequency_hz: expected hertz > 0, got {frequency[i]:g}"
        for i in _rows(frequency <= 0)
    ]
    faults += [
        f"{where(i)}: frequency_hz: expected hertz, got {frequency[i]:g} (MHz or GHz?)"
        for i in _rows((frequency > 0) & (frequency < 1e5))
    ]
    delay = number.get("delay_s", np.zeros(0))
    faults += [
        f"{where(i)}: delay_s: expected seconds > 0, got {delay[i]:g} (nanoseconds?)"
        for i in _rows((delay <= 0) | ((delay > FASTEST) & np.isfinite(delay)))
    ]
    if "gain_re" in number and "gain_im" in number:
        silent = (number["gain_re"] == 0) & (number["gain_im"] == 0)
        faults += [
            f"{where(i)}: gain_re, gain_im: a gain of 0; leave both empty where nothing was received"
            for i in _rows(silent)
        ]
    return faults


def _places(
    cells: Mapping[str, list[str]],
    number: Mapping[str, np.ndarray],
    end: str,
    where: Callable[[int], str],
    faults: list[str],
) -> tuple[tuple[Place, ...], Tensor]:
    """Distinct places of one end, in order of appearance, and which of them each line has."""
    names = cells.get(end)
    axes = [number.get(f"{end}_{axis}_m") for axis in "xyz"]
    known: dict[Place, int] = {}
    index = []
    for i in range(len(next(iter(cells.values())))):
        place: Place = names[i] if names else ""
        point = [math.nan if a is None else float(a[i]) for a in axes]
        if not any(map(math.isnan, point)):
            if place:
                faults.append(
                    f"{where(i)}: {end} is {place!r} and a position is given too: expected one"
                )
            place = (point[0], point[1], point[2])
        index.append(known.setdefault(place, len(known)))
    return tuple(known), torch.tensor(index, dtype=torch.int64)


def cell(value: Any) -> str:
    """A cell: shortest text that reads back to the same number."""
    if value is None:
        return ""
    return value if isinstance(value, str) else repr(float(value))
