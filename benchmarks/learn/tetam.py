"""tetam-ble: one beacon at measured places in one laboratory, heard by twelve fixed sensors.

F. S. Danis et al., Pervasive and Mobile Computing 81, 2022 (docs/tetam.md). Learned from the places of
set_1, or from some of them, and asked at those of set_2, nine months later, or along nine walks, five
months later; or learned from a share of the walks and asked at the rest. Nothing is refitted there.

The walks' packets from a square of CELL are one reading a sensor, their mean [dBm], at the mean position
of all packets from that square, whoever heard them and on whichever walk. Squares are drawn by the seed,
scattered over the area: no test reading comes from a square that was learned from.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from learn.cases import Case, DataError, number, table
from rfsg.learn.baselines import Readings

NAME = "tetam-ble"
FILES = ("fingerprints_mean.csv", "sensors.csv", "tracks.csv")
AXES = ("x_m", "y_m", "z_m")
FEW = 20  # training positions of the small runs
CELL = 0.25  # [m]
SHARES = (0.05, 0.1, 0.2)  # of the walks' squares
SEEDS = (0, 1, 2)


def cases(folder: Path) -> Iterator[Case]:
    """Every case of the data set, fingerprints first. Raises DataError for a bad folder."""
    known, walked = readings(folder, "set_1"), walks(folder)
    for crop, asked in (("set_2", readings(folder, "set_2")), ("walks", walked)):
        yield Case(NAME, f"set_1 to {crop}", "all positions", 0.0, 0, known, asked)
        for seed in SEEDS:
            few, _ = split(known, FEW, seed)
            yield Case(NAME, f"set_1 to {crop}", f"{FEW} positions", 0.0, seed, few, asked)
    squares = len(np.unique(walked.tx_position, axis=0))
    for share in SHARES:
        for seed in SEEDS:
            few, rest = split(walked, round(share * squares), seed)
            yield Case(NAME, "walks", f"{share:.0%} of the places", 0.0, seed, few, rest)


def split(readings: Readings, count: int, seed: int) -> tuple[Readings, Readings]:
    """Readings of ``count`` transmitter places drawn by the seed, and of all others."""
    places, place = np.unique(readings.tx_position, axis=0, return_inverse=True)
    chosen = np.random.default_rng(seed).permutation(len(places))[:count]
    drawn = np.isin(place, chosen)
    return readings.only(drawn), readings.only(~drawn)


def sensors(folder: Path) -> dict[str, list[float]]:
    """Position [m] of each sensor by name; their order numbers them."""
    path = folder / "sensors.csv"
    rows = enumerate(table(path, ("sensor", *AXES)), 2)
    return {row["sensor"]: [number(path, i, row, c) for c in AXES] for i, row in rows}


def readings(folder: Path, group: str) -> Readings:
    """Mean over the packets [dBm] of each place of a set at each sensor."""
    path = folder / "fingerprints_mean.csv"
    rows = enumerate(table(path, ("set", "sensor", "mean_dbm", *AXES)), 2)
    mine = [(i, row) for i, row in rows if row["set"] == group]
    if not mine:
        raise DataError(f"{path}: column set: no line of {group}; expected the whole data set")
    heard = sensors(folder)
    gateway = gateways(path, mine, heard)
    return Readings(
        np.array([[number(path, i, row, c) for c in AXES] for i, row in mine]),
        np.array(list(heard.values()))[gateway],
        gateway,
        np.array([number(path, i, row, "mean_dbm") for i, row in mine]),
    )


def walks(folder: Path) -> Readings:
    """Mean over the packets [dBm] of each sensor from each square of CELL, over all walks."""
    path = folder / "tracks.csv"
    rows = list(enumerate(table(path, ("sensor", "rssi_dbm", *AXES)), 2))
    if not rows:
        raise DataError(f"{path}: no line; expected the packets of the walks")
    heard = sensors(folder)
    gateway = gateways(path, rows, heard)
    position = np.array([[number(path, i, row, c) for c in AXES] for i, row in rows])
    rssi = np.array([number(path, i, row, "rssi_dbm") for i, row in rows])
    square = np.floor(position[:, :2] / CELL)
    of = np.unique(square, axis=0, return_inverse=True)[1].ravel()
    place = np.stack([mean_by(of, axis) for axis in position.T], axis=1)
    pairs, pair = np.unique(np.column_stack([of, gateway]), axis=0, return_inverse=True)
    return Readings(
        place[pairs[:, 0]],
        np.array(list(heard.values()))[pairs[:, 1]],
        pairs[:, 1].copy(),
        mean_by(pair.ravel(), rssi),
    )


def gateways(
    path: Path, rows: list[tuple[int, dict[str, str]]], known: dict[str, list[float]]
) -> Int[ndarray, "n"]:
    """Number of each line's sensor. Raises DataError for one that sensors.csv does not name."""
    number_of = {name: i for i, name in enumerate(known)}
    for i, row in rows:
        if row["sensor"] not in number_of:
            raise DataError(
                f"{path}: line {i}, column sensor: {row['sensor']!r}; expected a sensor of "
                f"sensors.csv: {', '.join(known)}"
            )
    return np.array([number_of[row["sensor"]] for _, row in rows])


def mean_by(group: Int[ndarray, "n"], value: Float[ndarray, "n"]) -> Float[ndarray, "g"]:
    """Mean of the values of each group, the groups numbered from 0."""
    return np.bincount(group, value) / np.bincount(group)
