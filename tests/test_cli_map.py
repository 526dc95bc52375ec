"""``rfsg map`` that refines: stops when told, and says how exact it is."""

import json

import numpy as np
import pytest

from rfsg import cli
from tests.test_cli import SCENE


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "scene.usda"
    file.write_text(SCENE)
    return file


def test_a_map_with_an_error_in_mind_reports_the_one_it_has(scene_file, tmp_path, capsys):
    out = tmp_path / "map"
    command = ["map", str(scene_file), "--cell", "2", "--quality", "draft", "--out", str(out)]
    command += ["--set", "map_rays=2000", "--set", "depth=1"]
    assert cli.run([*command, "--error", "20dB", "--budget", "10min"]) == 0
    report = json.loads((out / "report.json").read_text())
    assert (report["budget_s"], report["asked_error_db"]) == (600.0, 20.0)
    assert 0.0 < report["current_error_db"] <= 20.0
    assert cli.run([*command, "--error", "0.001dB", "--budget", "1ms", "--overwrite"]) == 0
    assert "not the 0.001 dB asked for" in capsys.readouterr().err
    assert cli.run([*command, "--method", "paths", "--budget", "1s", "--overwrite"]) == 3
    assert "goes with method 'rays'" in capsys.readouterr().err


def test_by_images_is_by_paths(scene_file, tmp_path):
    command = ["map", str(scene_file), "--cell", "2", "--quality", "draft"]
    gains = []
    for method in ("images", "paths"):
        out = tmp_path / method
        assert cli.run([*command, "--method", method, "--out", str(out)]) == 0
        with np.load(out / "map.npz", allow_pickle=False) as stored:
            gains.append(stored["path_gain"])
    assert np.allclose(*gains, rtol=1e-10, atol=0.0) and gains[0].max() > 0
