"""Measurements: files read to the same numbers, and every fault named, all at once."""

import pytest
import torch

from rfsg.learn import reading
from rfsg.learn.errors import MeasurementError
from rfsg.learn.links import link_up
from rfsg.learn.measurements import ANGLES, Measurements, Quantity
from tests.learn.rooms import room_with, thing

HEAD = "tx,rx,rx_x_m,rx_y_m,rx_z_m,frequency_hz,rssi_dbm,gain_re,gain_im,delay_s,threshold_dbm\n"


def file(tmp_path, text: str):
    path = tmp_path / "readings.csv"
    path.write_text(text)
    return path


def test_a_file_reads_to_its_numbers(tmp_path):
    text = HEAD + (
        "/tx,/rx0,,,,2.4e9,-61.25,,,,\n"
        "tx,,1,2,3,5.8e9,,1e-5,-2e-5,,\n"
        "tx,rx1,,,,2.4e9,,,,1.25e-8,\n"
        "tx,rx1,,,,2.4e9,,,,,-100\n"
    )
    read = Measurements.from_csv(file(tmp_path, text))
    assert read.rx_places == ("/rx0", (1.0, 2.0, 3.0), "rx1") and read.rx.tolist() == [0, 1, 2, 2]
    assert read.quantity.tolist() == [Quantity.RSSI, Quantity.GAIN, Quantity.DELAY, Quantity.RSSI]
    assert read.value.tolist() == [[-61.25, 0], [1e-5, -2e-5], [1.25e-8, 0], [0, 0]]
    assert read.received.tolist() == [True, True, True, False]
    assert read.threshold.tolist() == [-float("inf")] * 3 + [-100.0]
    assert read.frequencies().tolist() == [2.4e9, 5.8e9]


def test_a_table_survives_its_own_file(tmp_path):
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randn(5, 8, generator=generator, dtype=torch.float64)
    angles = {n: [None, *numbers[:4, k].tolist()] for k, n in enumerate(ANGLES)}
    first = Measurements.of(
        tx=["a", "b", "", "a", "a"],
        rx_x_m=numbers[:, 4].tolist(),
        rx_y_m=numbers[:, 5].tolist(),
        rx_z_m=numbers[:, 6].tolist(),
        delay_s=[None, *(1e-8 * numbers[:4, 7].abs()).tolist()],
        frequency_hz=1e9 / 3,
        threshold_dbm=-99.9,
        **angles,
    )
    again = Measurements.from_csv(file(tmp_path, first.csv().decode()))
    for name in vars(first):
        a, b = getattr(first, name), getattr(again, name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b or name == "source"


FAULTS = {
    "/tx,rx,1,2,,2.4e9,-60,,,,": r":2: rx_x_m, rx_y_m, rx_z_m: expected all",
    "/tx,rx,,,,2.4e9,-60,,,1e-9,": r":2: rssi_dbm, delay_s: expected one kind",
    "/tx,rx,,,,2.4e9,,1e-5,,,": r":2: gain_re, gain_im: expected all",
    "/tx,rx,,,,2.4,-60,,,,": r":2: frequency_hz: expected hertz, got 2.4 \(MHz or GHz",
    "/tx,rx,,,,,-60,,,,": r":2: frequency_hz is empty",
    "/tx,rx,,,,2.4e9,nan,,,,": r":2: rssi_dbm: expected a finite number, got 'nan'",
    '/tx,rx,,,,2.4e9,"-60,5",,,,': r"decimal comma",
    "/tx,rx,,,,2.4e9,,,,12.5,": r":2: delay_s: expected seconds > 0, got 12.5 \(nanoseconds",
    "/tx,rx,,,,2.4e9,,,,,": r":2: no quantity, so not received.*threshold_dbm",
    "/tx,rx,1,2,3,2.4e9,-60,,,,": r":2: rx is 'rx' and a position",
    "/tx,rx,,,,2.4e9,,0,0,,": r":2: gain_re, gain_im: a gain of 0",
    "/tx,rx,,,,2.4e9,-60": r":2: 7 cells, expected 11",
}


@pytest.mark.parametrize("line", FAULTS)
def test_a_fault_says_where_what_and_why(tmp_path, line):
    path = file(tmp_path, HEAD + line + "\n")
    with pytest.raises(MeasurementError, match=FAULTS[line]) as caught:
        Measurements.from_csv(path)
    assert len(caught.value.faults) == 1 and str(path) in caught.value.faults[0]


def test_all_faults_come_at_once(tmp_path):
    text = HEAD + "/tx,rx,1,2,,2.4,-60,,,3,\n/tx,rx,,,,2.4e9,x,,,,\n"
    with pytest.raises(MeasurementError) as caught:
        Measurements.from_csv(file(tmp_path, text))
    assert len(caught.value.faults) == 5


@pytest.mark.parametrize(
    ("head", "why"),
    [
        ("tx,rx,rsi_dbm\na,b,1\n", "'rsi_dbm' is unknown"),
        ("tx,rx,rssi_dbm,rssi_dbm\na,b,1,1\n", "stands there twice"),
        ("tx,rx,gain_re\na,b,1\n", "'gain_im' is missing"),
        ("tx,rx\na,b\n", "no column holds a reading"),
        ("rssi_dbm\n", "holds no readings"),
        ("", "no column holds a reading"),
    ],
)
def test_a_head_that_is_no_table_is_refused(tmp_path, head, why):
    with pytest.raises(MeasurementError, match=why):
        Measurements.from_csv(file(tmp_path, head))


def test_files_are_bounded(tmp_path, monkeypatch):
    path = file(tmp_path, HEAD + "/tx,rx,,,,2.4e9,-60,,,,\n" * 3)
    monkeypatch.setattr(reading, "MAX_ROWS", 2)
    with pytest.raises(MeasurementError, match="more than 2 readings"):
        Measurements.from_csv(path)
    monkeypatch.setattr(reading, "MAX_CSV_BYTES", 10)
    with pytest.raises(MeasurementError, match="larger than"):
        Measurements.from_csv(path)
    with pytest.raises(MeasurementError, match="no such file"):
        Measurements.from_csv(tmp_path / "none.csv")


def test_a_split_loses_nothing_and_is_the_same_again():
    whole = Measurements.of(tx=["a"] * 10, rx=["b"] * 10, rssi_dbm=range(10), frequency_hz=1e9)
    rest, held = whole.split(0.3, seed=1)
    assert (len(rest), len(held)) == (7, 3)
    both = sorted(rest.value[:, 0].tolist() + held.value[:, 0].tolist())
    assert both == list(range(10))
    assert torch.equal(held.value, whole.split(0.3, seed=1)[1].value)


def test_names_find_radios_and_say_what_is_near():
    scene = room_with(thing(), count=3)
    good = Measurements.of(
        tx=["tx", "/rx2", ""], rx=["rx0", "tx", "/rx0"], rssi_dbm=[1, 2, 3], frequency_hz=1e9
    )
    links = link_up(scene, good)
    assert [r.path for r in links.transmitters] == ["/tx", "/rx2"]
    assert [r.path for r in links.receivers] == ["/rx0", "/tx"]
    assert links.link_of.tolist() == [0, 1, 0]
    assert links.find(links.tx, links.rx).tolist() == list(range(len(links)))
    covered = sorted((t, r) for ts, rs in links.groups() for t in ts for r in rs)
    assert covered == sorted(zip(links.tx.tolist(), links.rx.tolist(), strict=True))
    bad = Measurements.of(tx=["t", "tx"], rx=["", "rx9"], rssi_dbm=[1, 2], frequency_hz=1e9)
    with pytest.raises(
        MeasurementError, match="(?s)'t' is no radio.*rx is empty.*'rx9' is no radio"
    ):
        link_up(scene, bad)
