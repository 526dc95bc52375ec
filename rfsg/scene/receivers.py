"""Receivers that are not prims: a level grid, or the lines of a CSV file."""

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path

from rfsg.scene.antennas import PATTERNS, POLARIZATIONS
from rfsg.scene.files import open_csv
from rfsg.scene.radios import Radio
from rfsg.scene.scene import SceneError

MAX_RECEIVERS = 100_000  # one Python object each; a radio map takes a plane instead
MAX_CSV_BYTES = 32 * 2**20
NUMBERS = ("x", "y", "z", "yaw_deg")  # [m], [m], [m], [deg]
TOKENS = {"pattern": tuple(PATTERNS), "polarization": tuple(POLARIZATIONS)}


def grid(
    origin: Sequence[float],
    size: Sequence[float],
    spacing: float,
    height: float = 1.5,
    *,
    parent: str = "/World/Grid",
    pattern: str = "isotropic",
    polarization: str = "none",
) -> list[Radio]:
    """Receivers on a level grid, row by row: x fastest, first at ``origin``, ends included.

    origin, size: (x, y) [m]; spacing and height above the world's z = 0 [m]. Named rx_ROW_COLUMN.
    Raises SceneError for numbers that make no grid or more than 100,000 receivers.
    """
    numbers = (*origin, *size, spacing, height)
    if len(origin) != 2 or len(size) != 2 or not all(map(math.isfinite, numbers)):
        raise SceneError([f"grid: expected finite (x, y) origin and size, got {origin}, {size}"])
    if spacing <= 0 or min(size) < 0:
        raise SceneError([f"grid: expected spacing > 0 and size >= 0, got {spacing}, {size}"])
    # a size that is a multiple of the spacing up to rounding keeps its last row
    columns, rows = (math.floor(s / spacing * (1 + 1e-12)) + 1 for s in size)
    if columns * rows > MAX_RECEIVERS:
        raise SceneError([f"grid: {columns} x {rows} receivers; the limit is {MAX_RECEIVERS}"])
    return [
        Radio.at(
            f"{parent}/rx_{row}_{column}",
            origin[0] + column * spacing,
            origin[1] + row * spacing,
            height,
            pattern=pattern,
            polarization=polarization,
        )
        for row in range(rows)
        for column in range(columns)
    ]


def from_csv(path: str | Path, *, parent: str = "/World/Receivers") -> list[Radio]:
    """Receivers from a CSV file with the columns name, x, y, z [m, world] and, where wanted,
    yaw_deg, pattern and polarization. Characters that no prim name may hold become underscores.

    Raises SceneError listing every fault with file, line and column.
    """
    path = Path(path)
    with open_csv(path, MAX_CSV_BYTES) as file:
        return _rows(csv.DictReader(file, skipinitialspace=True), path, parent)


def _rows(reader: csv.DictReader, path: Path, parent: str) -> list[Radio]:
    columns = [c.strip() for c in reader.fieldnames or []]
    reader.fieldnames = columns
    known = ("name", *NUMBERS, *TOKENS)
    faults = [f"{path}:1: column {c!r} is missing" for c in known[:4] if c not in columns]
    faults += [f"{path}:1: column {c!r} is unknown ({known})" for c in columns if c not in known]
    faults += [f"{path}:1: column {c!r} stands twice" for c in known if columns.count(c) > 1]
    if faults:
        raise SceneError(faults)
    radios: dict[str, Radio] = {}
    for row in reader:
        where = f"{path}:{reader.line_num}"
        if len(radios) >= MAX_RECEIVERS:
            raise SceneError([*faults, f"{where}: more than {MAX_RECEIVERS} receivers"])
        if None in row or None in row.values():
            faults.append(f"{where}: expected {len(columns)} cells, one for each column")
            continue
        radio = _radio({k: v.strip() for k, v in row.items()}, where, parent, faults)
        if radio.path in radios:
            faults.append(f"{where}: name: {row['name']!r} stands twice")
        radios[radio.path] = radio
    if faults:
        raise SceneError(faults)
    return list(radios.values())


def _radio(row: dict[str, str], where: str, parent: str, faults: list[str]) -> Radio:
    name = re.sub(r"\W", "_", row["name"], flags=re.ASCII)
    if not name:
        faults.append(f"{where}: name: is empty")
    x, y, z, yaw = (_number(row.get(c, "0"), f"{where}: {c}", faults) for c in NUMBERS)
    tokens = {c: row[c] or TOKENS[c][0] for c in TOKENS if c in row}
    faults += [
        f"{where}: {c}: expected one of {', '.join(TOKENS[c])}, got {given!r}"
        for c, given in tokens.items()
        if given not in TOKENS[c]
    ]
    known = {c: given for c, given in tokens.items() if given in TOKENS[c]}
    return Radio.at(f"{parent}/{'_' * name[:1].isdigit()}{name}", x, y, z, yaw, **known)


def _number(text: str, where: str, faults: list[str]) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        faults.append(f"{where}: expected a finite number, got {text!r}")
        return 0.0
    return number
