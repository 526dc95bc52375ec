"""tetam-ble: one beacon at measured places in one laboratory, heard by twelve fixed sensors.

F. S. Danis et al., Pervasive and Mobile Computing 81, 2022 (docs/tetam.md). Learned from the places of
set_1, or from some of them, and asked at those of set_2, nine months later. Nothing is refitted there.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from learn.cases import Case, number, table
from rfsg.learn.baselines import Readings

NAME = "tetam-ble"
FILES = ("fingerprints_mean.csv", "sensors.csv")
AXES = ("x_m", "y_m", "z_m")
FEW = 20  # training positions of the small runs
SEEDS = (0, 1, 2)


def cases(folder: Path) -> Iterator[Case]:
    """All places of set_1, and FEW of them by each seed. Raises DataError for a bad folder."""
    known = readings(folder, "set_1")
    asked = readings(folder, "set_2")
    yield Case(NAME, "set_1 to set_2", "all positions", 0.0, 0, known, asked)
    places, place = np.unique(known.tx_position, axis=0, return_inverse=True)
    for seed in SEEDS:
        chosen = np.random.default_rng(seed).permutation(len(places))[:FEW]
        few = known.only(np.isin(place, chosen))
        yield Case(NAME, "set_1 to set_2", f"{FEW} positions", 0.0, seed, few, asked)


def readings(folder: Path, group: str) -> Readings:
    """Mean over the packets [dBm] of each place of a set at each sensor."""
    path = folder / "sensors.csv"
    sensors = {
        row["sensor"]: [number(path, i, row, c) for c in AXES]
        for i, row in enumerate(table(path, ("sensor", *AXES)), 2)
    }
    names = list(sensors)
    path = folder / "fingerprints_mean.csv"
    rows = enumerate(table(path, ("set", "sensor", "mean_dbm", *AXES)), 2)
    mine = [(i, row) for i, row in rows if row["set"] == group]
    gateway = np.array([names.index(row["sensor"]) for _, row in mine])
    return Readings(
        np.array([[number(path, i, row, c) for c in AXES] for i, row in mine]),
        np.array(list(sensors.values()))[gateway],
        gateway,
        np.array([number(path, i, row, "mean_dbm") for i, row in mine]),
    )
