"""nerf2-ble: RSSI of one transmitter at 6000 places, at 7 gateways in each of three areas.

The BLE set of X. Zhao, Z. An, Q. Pan, L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", ACM
MobiCom 2023, as tidy.csv, gateway_position.yml and the fixed runs of splits.json. An empty cell of
tidy.csv is a reading that was not received; it is neither learned from nor scored.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from learn.cases import Case, DataError, number, table
from rfsg.learn.baselines import Readings

NAME = "nerf2-ble"
FILES = ("tidy.csv", "gateway_position.yml", "splits.json")


@dataclass(frozen=True)
class Nerf2Ble:
    """Places [m], gateways by name with their positions [m], and readings [dBm], NaN where none."""

    place: Float[ndarray, "n 3"]
    gateways: tuple[str, ...]
    gateway_position: Float[ndarray, "g 3"]
    rssi: Float[ndarray, "n g"]

    def readings(self, pairs: Sequence[tuple[int, int]]) -> Readings:
        """The received ones of some (row, gateway number) pairs."""
        row, gateway = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        got = np.isfinite(self.rssi[row, gateway])
        row, gateway = row[got], gateway[got]
        return Readings(
            self.place[row], self.gateway_position[gateway], gateway, self.rssi[row, gateway]
        )


def read(folder: Path) -> Nerf2Ble:
    """Raises DataError, naming file, line and column, when something is not as expected."""
    gateways = gateway_positions(folder / "gateway_position.yml")
    path = folder / "tidy.csv"
    axes = ("x_m", "y_m", "z_m")
    rows = table(path, (*axes, *gateways))
    place = [[number(path, i, row, c) for c in axes] for i, row in enumerate(rows, 2)]
    rssi = [
        [number(path, i, row, g) if row[g] else np.nan for g in gateways]
        for i, row in enumerate(rows, 2)
    ]
    position = np.array(list(gateways.values()))
    return Nerf2Ble(np.array(place), tuple(gateways), position, np.array(rssi))


def gateway_positions(path: Path) -> dict[str, list[float]]:
    """Lines ``name: [x, y, z]`` [m]."""
    if not path.is_file():
        raise DataError(f"{path}: not found; --data expects the folder of a data set")
    found = {}
    for i, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip():
            continue
        match = re.fullmatch(r"\s*(\w+):\s*\[([^\]]*)\]\s*", line)
        cells = match.group(2).split(",") if match else []
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            values = []
        if match is None or len(values) != 3:
            raise DataError(f"{path}: line {i}: {line!r}; expected `name: [x, y, z]` in metres")
        found[match.group(1)] = values
    return found


def cases(folder: Path, crops: Sequence[str] = ()) -> Iterator[Case]:
    """Every run of splits.json, or those of some crops.

    Raises DataError for an unknown crop, and for what is not as expected in the files.
    """
    data = read(folder)
    path = folder / "splits.json"
    known = under(path, "", read_json(path), "crops", dict)
    unknown = sorted(set(crops) - set(known))
    if unknown:
        raise DataError(
            f"{path}: no crop {', '.join(unknown)}; --crops expects some of {', '.join(known)}"
        )
    for crop in crops or known:
        where = f"crops.{crop}"
        of_crop = under(path, "crops", known, crop, dict)
        gateways = under(path, where, of_crop, "gateways", list)
        for i, run in enumerate(under(path, where, of_crop, "runs", list)):
            yield case(data, crop, gateways, Run(path, f"{where}.runs[{i}]", run))


@dataclass(frozen=True)
class Run:
    """One run of splits.json: the file, where it stands in it, and what is there."""

    path: Path
    where: str
    content: object

    def get(self, key: str, kind: type | tuple[type, ...]) -> Any:
        return under(self.path, self.where, self.content, key, kind)

    def fault(self, key: str, given: object, expected: str) -> DataError:
        return DataError(f"{self.path}: {self.where}.{key}: {given!r}; expected {expected}")

    def pair(self, key: str, pair: object, data: Nerf2Ble) -> tuple[int, int]:
        """[row of tidy.csv, name of a gateway] as numbers."""
        if not isinstance(pair, list) or len(pair) != 2:
            raise self.fault(key, pair, "a pair [row, gateway]")
        row, gateway = pair
        if type(row) is not int or not 0 <= row < len(data.place):
            raise self.fault(key, row, f"a row of tidy.csv, 0 to {len(data.place) - 1}")
        if gateway not in data.gateways:
            raise self.fault(key, gateway, f"a gateway: {', '.join(data.gateways)}")
        return row, data.gateways.index(gateway)


def case(data: Nerf2Ble, crop: str, gateways: list[str], run: Run) -> Case:
    """The case of a run; ``gateways`` are asked where it names no test gateway."""
    named = isinstance(run.content, dict) and "test_gateway" in run.content
    asked = [run.get("test_gateway", str)] if named else gateways
    rows = run.get("test_rows", list)
    return Case(
        NAME,
        crop,
        run.get("split", str),
        run.get("density", (int, float)),
        run.get("seed", int),
        data.readings([run.pair("train", pair, data) for pair in run.get("train", list)]),
        data.readings([run.pair("test_rows", [row, g], data) for row in rows for g in asked]),
    )


def read_json(path: Path) -> object:
    """Raises DataError, naming the line, for what is no JSON."""
    if not path.is_file():
        raise DataError(f"{path}: not found; --data expects the folder of a data set")
    try:
        return json.loads(path.read_text())
    except json.JSONDecodeError as fault:
        raise DataError(f"{path}: line {fault.lineno}: {fault.msg}; expected JSON") from None


WORDS = {dict: "an object", list: "a list", str: "text", int: "a whole number"}


def under(path: Path, where: str, content: object, key: str, kind: type | tuple[type, ...]) -> Any:
    """What an object of a JSON file has at a key. Raises DataError when it has none, or another kind."""
    expected = WORDS.get(kind, "a number") if isinstance(kind, type) else "a number"
    place = f"{path}: {where}.{key}" if where else f"{path}: {key}"
    if not isinstance(content, dict) or key not in content:
        raise DataError(f"{place}: not there; expected {expected}")
    if not isinstance(content[key], kind):
        raise DataError(f"{place}: {content[key]!r:.60}; expected {expected}")
    return content[key]
