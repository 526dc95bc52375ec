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
    """Every run of splits.json, or those of some crops. Raises DataError for an unknown crop."""
    data = read(folder)
    path = folder / "splits.json"
    if not path.is_file():
        raise DataError(f"{path}: not found; --data expects the folder of a data set")
    known = json.loads(path.read_text())["crops"]
    unknown = sorted(set(crops) - set(known))
    if unknown:
        raise DataError(
            f"{path}: no crop {', '.join(unknown)}; --crops expects some of {', '.join(known)}"
        )
    number_of = {name: i for i, name in enumerate(data.gateways)}
    for crop in crops or known:
        for run in known[crop]["runs"]:
            asked = [run["test_gateway"]] if "test_gateway" in run else known[crop]["gateways"]
            train = [(row, number_of[gateway]) for row, gateway in run["train"]]
            test = [(row, number_of[g]) for row in run["test_rows"] for g in asked]
            yield Case(
                NAME,
                crop,
                run["split"],
                run["density"],
                run["seed"],
                data.readings(train),
                data.readings(test),
            )
