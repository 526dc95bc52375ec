"""``rfsg fit`` from files to files, and what it says when it cannot."""

import json
import math

import pytest
import torch

from rfsg import cli
from rfsg.cli.fit import risen
from rfsg.learn.measurements import Measurements
from rfsg.learn.model import load
from rfsg.scene.scene import Scene
from tests.learn.rooms import halfspace, readings, room_with, thing


@pytest.fixture
def files(tmp_path):
    """A scene with a thing of known material, and what it gives."""
    scene = room_with(thing(halfspace(4.0, 0.1)), count=16)
    readings(scene, "rssi").to_csv(tmp_path / "readings.csv")
    return str(scene.to_usd(tmp_path / "room.usda")), str(tmp_path / "readings.csv"), tmp_path


def run(files, *options: str) -> int:
    scene, csv, folder = files
    standard = ["--out", str(folder / "out"), "--set", "depth=1", "--steps", "4"]
    return cli.run(["fit", scene, csv, *standard, *options])


def test_files_become_files(files, capsys):
    select = ["--select", "/thing.surface", "--select", "power", "--unknown", "/thing"]
    assert run(files, *select, "--residual") == 0
    said = capsys.readouterr().out
    assert "/thing" in said and "validation, after, with residual" in said and "covers" in said
    out = files[2] / "out"
    names = (
        "scene.usda history.csv predictions.csv measurements.csv report.json residual.safetensors "
        "loss.png errors.png error_map.png cdf.png"
    )
    assert all((out / name).stat().st_size > 0 for name in names.split())
    assert all(str(out / name) in said for name in names.split())
    assert json.loads((out / "report.json").read_text())["steps"] == 4
    assert Scene.from_usd(out / "scene.usda").node("/thing").body.surface.kind == "stochastic"
    assert run(files, *select) != 0
    assert "already exists" in capsys.readouterr().err
    assert run(files, *select, "--resume", "--steps", "6") == 0
    assert "with residual" not in capsys.readouterr().out
    assert not (out / "residual.safetensors").exists()


def test_a_fit_that_made_it_worse_says_so():
    def report(before, after):
        return {"train": {"before": {"median_db": before}, "after": {"median_db": after}}}

    assert "rose from 2.00 to 3.50 dB" in risen(report(2.0, 3.5))
    assert not risen(report(3.5, 2.0)) and not risen(report(None, None))


def test_what_cannot_be_learned_is_said(files, capsys):
    assert run(files, "--select", "/thin") == 3
    assert "near it: /thing" in capsys.readouterr().err
    most = ["--validation", "0.5", "--residual"]
    assert run(files, "--select", "power", *most) == 4
    assert "8 training readings of power" in capsys.readouterr().err
    assert run(files, "--select", "/thing", "--unknown", "/nothing") == 3
    assert "names no object" in capsys.readouterr().err
    (files[2] / "readings.csv").write_text("tx,rx,rssi_dbm\n/tx,/rx0,loud\n")
    assert run(files, "--select", "/thing") == 3
    assert "readings.csv:2: rssi_dbm: expected a finite number" in capsys.readouterr().err


def test_regions_need_no_scene(tmp_path, capsys):
    """From a file of places to a scene that predicts, level and all; resumed it stays what it was."""
    random = torch.Generator().manual_seed(0)
    lines = ["tx_x_m,tx_y_m,tx_z_m,rx_x_m,rx_y_m,rx_z_m,frequency_hz,rssi_dbm"]
    for x, y in (8.0 * torch.rand(30, 2, generator=random)).tolist():
        apart = math.dist((x, y, 1.0), (0.0, 0.0, 2.0))
        lines.append(f"{x},{y},1,0,0,2,2.44e9,{-20 - 20 * math.log10(apart) - 40.2}")
    csv, out = tmp_path / "readings.csv", tmp_path / "out"
    csv.write_text("\n".join(lines) + "\n")
    asked = ["fit-regions", str(csv), "--out", str(out), "--cell", "9", "--steps", "3"]
    assert cli.run([*asked, "--residual"]) == 0
    said = capsys.readouterr().out
    assert "with residual" in said and "covers" in said
    report = json.loads((out / "report.json").read_text())
    assert report["offsets"]["power_db"] == pytest.approx(-20.0, abs=0.5)
    model = load(out)
    told = model.predict(Measurements.from_csv(csv)).rssi_dbm()
    measured = Measurements.from_csv(csv).value[:, 0]
    assert (told - measured).abs().max() < 1.0  # an offset of the receiver that is not the scene's
    assert cli.run(asked) != 0
    assert "already exists" in capsys.readouterr().err
    assert cli.run([*asked, "--residual", "--resume"]) == 0
    again = json.loads((out / "report.json").read_text())
    assert again["validation"] == report["validation"] and again["offsets"] == report["offsets"]
    csv.write_text("tx,rx,frequency_hz,rssi_dbm\n/a,/b,2.44e9,-50\n")
    assert cli.run([*asked, "--overwrite"]) == 4
    assert "'/a' is given by name" in capsys.readouterr().err
