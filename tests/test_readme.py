"""README.md: every block of Python and every command in it runs as it stands, beside a copy of assets/."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rfsg import cli
from tests.scene.importing import write_mitsuba

REPOSITORY = Path(__file__).parents[1]
README = (REPOSITORY / "README.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
COMMANDS = re.findall(r"^    (rfsg .+)$", README, re.MULTILINE)
QUICK = ("edit", "export", "assets", "check", "info", "import")  # the others simulate or learn
READINGS = 24


def marked(line: str):
    slow = () if line.split()[1] in QUICK else (pytest.mark.slow,)
    return pytest.param(line, marks=slow, id=line.split()[1])


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """A working folder with assets/, and with the files that README expects somebody to have."""
    shutil.copytree(REPOSITORY / "assets", tmp_path / "assets")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def have(name: str, folder: Path) -> None:
    """Make the file of somebody's own that a line of README names."""
    if name == "cabinet.obj":
        trimesh.creation.box((0.8, 0.5, 1.6)).export(folder / name)
    elif name == "munich.xml":
        write_mitsuba(folder).rename(folder / name)
    elif name == "readings.csv":
        scene = (folder / "assets" / "scenes" / "lab.usda").read_text()
        receivers = re.findall(r'def \w+ "(rx_\d+)"', scene)[:READINGS]
        power = np.random.default_rng(0).uniform(-75.0, -45.0, len(receivers))
        rows = [f"AP,{rx},{dbm:.1f},2.44e9" for rx, dbm in zip(receivers, power, strict=True)]
        (folder / name).write_text("\n".join(["tx,rx,rssi_dbm,frequency_hz", *rows]) + "\n")


def test_there_is_something_to_run():
    assert len(BLOCKS) >= 1
    assert {line.split()[1] for line in COMMANDS} >= {*QUICK, "simulate", "map", "view", "fit"}


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_a_block_of_python_runs(here, block):
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "dBm" in done.stdout and (here / "edits.usda").exists()


@pytest.mark.parametrize("line", [marked(x) for x in COMMANDS if x.split()[1] != "view"])
def test_a_command_runs(here, line, capsys):
    words = shlex.split(line)[1:]
    for word in words:
        have(word, here)
    assert cli.run(words) == 0, capsys.readouterr().err
    for option, name in zip(words, words[1:], strict=False):
        if option in ("--out", "-o", "--save"):
            assert (here / name).exists()


@pytest.mark.slow
@pytest.mark.parametrize("line", [x for x in COMMANDS if x.split()[1] == "view"])
def test_the_viewer_answers(here, line):
    """Started as it stands, on a free port and with no browser to open; ended as by Ctrl-C."""
    program = [sys.executable, "-c", "import sys; from rfsg.cli import main; sys.exit(main())"]
    words = [*shlex.split(line)[1:], "--port", "0", "--no-open"]
    clean = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen([*program, *words], stdout=subprocess.PIPE, text=True, env=clean) as run:
        try:
            assert run.stdout is not None
            found = (re.search(r"http://127\.0\.0\.1:\d+", said) for said in run.stdout)
            url = next(match for match in found if match).group()
            with urllib.request.urlopen(url, timeout=60.0) as answer:
                assert answer.status == 200 and b"<html" in answer.read()
            run.send_signal(signal.SIGINT)
            assert run.wait(60.0) in (0, 130)
        finally:
            run.kill()
