"""Readers of the benchmark's data sets: values as written, errors that name file, line and column."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from learn import nerf2, tetam
from learn.cases import DataError

SENSORS = "sensor,x_m,y_m,z_m\nlow,1,2,1.2\nhigh,5,2,2.3\n"
# Two places in set_1, one in set_2; the sensor of the first line is the second one of sensors.csv.
MEANS = """set,x_m,y_m,z_m,sensor,mean_dbm
set_1,0.5,0.5,1.85,high,-70.5
set_1,0.5,0.5,1.85,low,-60.25
set_1,3,0.5,1.85,low,-65
set_2,2,2,1.9,high,-71
"""
# Three packets of one square of 0.25 m, one of them of another sensor, and one next door.
TRACKS = """track,t_s,sensor,rssi_dbm,x_m,y_m,z_m
a,0.0,low,-60,0.10,0.10,1.8
a,0.5,low,-66,0.20,0.10,1.8
b,9.0,high,-80,0.15,0.22,1.9
b,9.5,high,-70,0.30,0.10,1.8
"""
TIDY = "x_m,y_m,z_m,g1,g2\n0,0,1,-50,-60\n1,0,1,,-61\n2,0,1,-52,-62\n"
POSITIONS = "g1: [0.0, 5.0, 2.0]\n\ng2: [4.0, 5.0, 2.0]\n"


def splits() -> dict:
    """Crop W: a run over both gateways, and one with a gateway never heard."""
    run = {
        "split": "random",
        "density": 0.175,
        "seed": 0,
        "train": [[0, "g1"], [1, "g1"], [0, "g2"]],
        "test_rows": [1, 2],
    }
    unheard = {**run, "split": "unseen-gateway", "density": 3, "test_gateway": "g1"}
    return {"crops": {"W": {"gateways": ["g1", "g2"], "runs": [run, unheard]}}}


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    return written(
        tmp_path,
        {"sensors.csv": SENSORS, "fingerprints_mean.csv": MEANS, "tracks.csv": TRACKS},
    )


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    files = {"tidy.csv": TIDY, "gateway_position.yml": POSITIONS}
    return written(tmp_path, files | {"splits.json": json.dumps(splits())})


def written(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def refused(found, *words: str) -> None:
    """``found`` (a reader to be called) raises DataError with all the words."""
    with pytest.raises(DataError) as fault:
        found()
    for word in words:
        assert word in str(fault.value)


# tetam-ble


def test_tetam_places_of_a_set(lab):
    found = tetam.readings(lab, "set_1")
    assert found.gateway.tolist() == [1, 0, 0]
    assert found.rssi.tolist() == [-70.5, -60.25, -65.0]
    assert found.tx_position.tolist() == [[0.5, 0.5, 1.85], [0.5, 0.5, 1.85], [3.0, 0.5, 1.85]]
    assert found.rx_position.tolist() == [[5.0, 2.0, 2.3], [1.0, 2.0, 1.2], [1.0, 2.0, 1.2]]


def test_tetam_walks_are_means_of_squares(lab):
    """A mean of dBm a sensor; the place is that of all packets of the square, on whichever walk."""
    found = tetam.walks(lab)
    assert found.gateway.tolist() == [0, 1, 1]
    assert found.rssi.tolist() == [-63.0, -80.0, -70.0]
    shared = [0.15, 0.14, 5.5 / 3]
    expected = [shared, shared, [0.30, 0.10, 1.8]]
    np.testing.assert_allclose(found.tx_position, expected, rtol=0, atol=1e-12)
    assert found.rx_position.tolist() == [[1.0, 2.0, 1.2], [5.0, 2.0, 2.3], [5.0, 2.0, 2.3]]


def test_a_split_by_place_is_a_partition(lab):
    """Readings of one place stay together; the seed decides which; every reading is on one side."""
    known = tetam.readings(lab, "set_1")
    sides = set()
    for seed in range(20):
        few, rest = tetam.split(known, 1, seed)
        assert len(few) + len(rest) == len(known)
        places = [{tuple(p) for p in side.tx_position} for side in (few, rest)]
        assert len(places[0]) == 1 and not places[0] & places[1]
        sides.add(places[0].pop())
    assert len(sides) == 2


def test_tetam_cases_never_ask_what_they_learn_from(lab, monkeypatch):
    monkeypatch.setattr(tetam, "FEW", 1)
    monkeypatch.setattr(tetam, "SHARES", (0.5,))
    found = list(tetam.cases(lab))
    assert len({case.name for case in found}) == len(found) == 2 * (1 + 3) + 3
    for case in found:
        both = [{tuple(p) for p in r.tx_position} for r in (case.train, case.test)]
        assert not both[0] & both[1]


@pytest.mark.parametrize(
    ("name", "old", "new", "line", "column"),
    [
        ("fingerprints_mean.csv", "-60.25", "loud", "line 3", "mean_dbm"),
        ("fingerprints_mean.csv", "0.5,1.85,high", "0.5,1.85,none", "line 2", "sensor"),
        ("tracks.csv", "b,9.0,high,-80", "b,9.0,high,", "line 4", "rssi_dbm"),
        ("tracks.csv", "b,9.5,high", "b,9.5,lost", "line 5", "sensor"),
        ("sensors.csv", "5,2,2.3", "5,2,up", "line 3", "z_m"),
    ],
)
def test_tetam_names_the_cell(lab, name, old, new, line, column):
    path = lab / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    refused(lambda: list(tetam.cases(lab)), str(path), line, column)


@pytest.mark.parametrize("name", tetam.FILES)
def test_tetam_names_what_is_missing(lab, name):
    path = lab / name
    head, rest = path.read_text().split("\n", 1)
    path.write_text(head.replace("sensor", "receiver") + "\n" + rest)
    refused(lambda: list(tetam.cases(lab)), str(path), "sensor", "receiver")
    path.unlink()
    refused(lambda: list(tetam.cases(lab)), str(path), "not found")


def test_tetam_without_a_set(lab):
    refused(lambda: tetam.readings(lab, "set_3"), "fingerprints_mean.csv", "set_3")


# nerf2-ble


def test_nerf2_cases(hall):
    """What was not received (row 1 at g1) is in neither side; a test gateway is asked alone."""
    both, unheard = nerf2.cases(hall)
    assert (both.crop, both.split, both.density, both.seed) == ("W", "random", 0.175, 0)
    assert both.train.rssi.tolist() == [-50.0, -60.0]
    assert both.train.gateway.tolist() == [0, 1]
    assert both.train.rx_position.tolist() == [[0.0, 5.0, 2.0], [4.0, 5.0, 2.0]]
    assert both.test.rssi.tolist() == [-61.0, -52.0, -62.0]
    assert both.test.tx_position.tolist() == [[1.0, 0.0, 1.0], [2.0, 0.0, 1.0], [2.0, 0.0, 1.0]]
    assert unheard.test.rssi.tolist() == [-52.0]
    assert unheard.test.gateway.tolist() == [0]


def test_nerf2_unknown_crop(hall):
    refused(lambda: list(nerf2.cases(hall, ["X"])), "splits.json", "X", "W")


def at(content: dict, *keys):
    """What stands in nested objects and lists."""
    for key in keys:
        content = content[key]
    return content


RUN = ("crops", "W", "runs", 0)


@pytest.mark.parametrize(
    ("where", "key", "value", "words"),
    [
        ((), "crops", None, ("crops", "expected an object")),
        (("crops", "W"), "gateways", None, ("crops.W.gateways", "expected a list")),
        (("crops", "W"), "runs", None, ("crops.W.runs", "expected a list")),
        (("crops", "W"), "runs", "all", ("crops.W.runs", "'all'", "expected a list")),
        (RUN, "train", None, ("crops.W.runs[0].train", "expected a list")),
        (RUN, "test_rows", None, ("crops.W.runs[0].test_rows", "expected a list")),
        (RUN, "split", None, ("crops.W.runs[0].split", "expected text")),
        (RUN, "density", "high", ("crops.W.runs[0].density", "'high'", "expected a number")),
        (RUN, "seed", None, ("crops.W.runs[0].seed", "expected a whole number")),
        (RUN, "train", [[0, "g1", 2]], ("crops.W.runs[0].train", "a pair")),
        (RUN, "train", [[0, "g9"]], ("crops.W.runs[0].train", "g9", "g1, g2")),
        (RUN, "train", [[3, "g1"]], ("crops.W.runs[0].train", "3", "0 to 2")),
        (RUN, "test_rows", [-1], ("crops.W.runs[0].test_rows", "-1", "0 to 2")),
        (RUN, "test_gateway", 1, ("crops.W.runs[0].test_gateway", "1", "expected text")),
    ],
)
def test_nerf2_names_the_key_of_splits(hall, where, key, value, words):
    """A key that is gone (None) or holds something else."""
    content = splits()
    holder = at(content, *where)
    if value is None:
        del holder[key]
    else:
        holder[key] = value
    (hall / "splits.json").write_text(json.dumps(content))
    refused(lambda: list(nerf2.cases(hall)), "splits.json", *words)


def test_nerf2_splits_that_are_no_json(hall):
    (hall / "splits.json").write_text('{"crops":\n nothing}')
    refused(lambda: list(nerf2.cases(hall)), "splits.json", "line 2")


def test_nerf2_names_the_cell(hall):
    (hall / "tidy.csv").write_text(TIDY.replace("-61", "weak"))
    refused(lambda: nerf2.read(hall), "tidy.csv", "line 3", "g2", "weak")


def test_nerf2_names_the_line_of_a_gateway(hall):
    (hall / "gateway_position.yml").write_text(POSITIONS.replace("4.0, ", ""))
    refused(lambda: nerf2.read(hall), "gateway_position.yml", "line 3", "g2")


@pytest.mark.parametrize("name", nerf2.FILES)
def test_nerf2_names_what_is_missing(hall, name):
    (hall / name).unlink()
    refused(lambda: list(nerf2.cases(hall)), name, "not found")
