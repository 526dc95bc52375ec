"""``rfsg tradeoff``, and ``rfsg simulate`` with --accuracy and --budget."""

import csv
import json

import pytest
import typer

from rfsg import cli
from rfsg.cli import parse
from tests.test_cli import SCENE


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "scene.usda"
    file.write_text(SCENE)
    return file


def test_a_tradeoff_leaves_a_table_a_report_and_a_picture(scene_file, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["tradeoff", str(scene_file), "--out", str(out), "--budget", "6s"]
    assert cli.run([*command, "--set", "depth=2", "--accuracy", "2 dB"]) == 0
    with open(out / "tradeoff.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    told = json.loads((out / "tradeoff.json").read_text())
    assert [row["setting"] for row in rows] == [s["setting"] for s in told["settings"]]
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds) and (out / "tradeoff.png").stat().st_size > 1000
    (truth,) = (row for row in rows if row["setting"] == told["reference"])
    assert float(truth["gain_most_db"]) == 0.0 and float(truth["missed"]) == 0.0
    assert told["accuracy_db"] == 2.0 and told["budget_s"] == 6.0 and told["base"]["depth"] == 2
    printed = capsys.readouterr()
    assert told["sentence"] in printed.out and str(out / "tradeoff.csv") in printed.out
    assert cli.run(command) == 2  # the output is in the way


@pytest.mark.parametrize("asked", [["--accuracy", "1dB"], ["--budget", "30s"]])
def test_simulate_at_a_chosen_setting(scene_file, tmp_path, capsys, asked):
    """The report says what was chosen, why, and what was tried."""
    out = tmp_path / "out"
    assert cli.run(["simulate", str(scene_file), "--out", str(out), *asked]) == 0
    told = json.loads((out / "report.json").read_text())
    dial = told["dial"]
    assert dial["rung"] in [trial["rung"] for trial in dial["tried"]]
    assert told["quality"]["depth"] == dial["quality"]["depth"]
    assert any("estimated error" in sentence for sentence in told["modelled"])
    assert "estimated error" in capsys.readouterr().out


def test_a_quality_beside_the_dial_is_refused(scene_file, tmp_path, capsys):
    command = ["simulate", str(scene_file), "--out", str(tmp_path / "out"), "--accuracy", "1dB"]
    for also in (["--quality", "draft"], ["--set", "depth=2"]):
        assert cli.run([*command, *also]) == 2
        assert "choose the quality" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "value"), [("1dB", 1.0), ("0.5 db", 0.5), ("3", 3.0), ("1e-1dB", 0.1)]
)
def test_accuracies(text, value):
    assert parse.parse_decibel(text) == value


@pytest.mark.parametrize("text", ["0dB", "-1dB", "1 m", "", "infdB", "nan"])
def test_what_is_no_accuracy(text):
    with pytest.raises(typer.BadParameter, match="1dB"):
        parse.parse_decibel(text)


@pytest.mark.parametrize(("text", "seconds"), [("5min", 300.0), ("1.5h", 5400.0), ("2s", 2.0)])
def test_budgets(text, seconds):
    assert parse.parse_budget(text) == seconds


@pytest.mark.parametrize("text", ["0s", "-1min", "1dB", "", "infs"])
def test_what_is_no_budget(text):
    with pytest.raises(typer.BadParameter, match="5min"):
        parse.parse_budget(text)
