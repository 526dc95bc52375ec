"""``--usd``: results as a layer over the scene, from the command line."""

import pytest

from rfsg import cli
from rfsg.scene.scene import Scene
from tests.test_cli import SCENE


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "scene.usda"
    file.write_text(SCENE)
    return file


MAP = ["--cell", "2", "--method", "images"]


@pytest.mark.parametrize(
    ("command", "name", "options"), [("simulate", "paths", []), ("map", "map", MAP)]
)
def test_results_lie_over_the_edited_scene(scene_file, tmp_path, capsys, command, name, options):
    out = tmp_path / "out"
    edit = ["--move", "/World/Cabinet=0.5,0,0", "--quality", "draft"]
    assert cli.run([command, str(scene_file), *edit, *options, "--usd", "--out", str(out)]) == 0
    layer = out / f"{name}.usda"
    assert str(layer) in capsys.readouterr().out
    read = Scene.from_usd(layer, asset_roots=[tmp_path])
    assert read.node("/World/Cabinet").pose.translation[0].item() == pytest.approx(2.5)
    # over itself: refused, and the layer is as it was
    before = layer.read_bytes()
    again = [command, str(layer), *options, "--asset-root", str(tmp_path), "--quality", "draft"]
    assert cli.run([*again, "--usd", "--out", str(out), "--overwrite"]) == 3
    assert "is read from this file" in capsys.readouterr().err
    assert layer.read_bytes() == before


@pytest.mark.parametrize("command", ["simulate", "map"])
def test_a_layer_over_a_strangers_file_is_refused(scene_file, tmp_path, capsys, command):
    out = tmp_path / "out"
    wanted = [command, str(scene_file), "--usd", "--untrusted", "--out", str(out)]
    assert cli.run(wanted) == 2
    assert "--untrusted" in capsys.readouterr().err and not out.exists()
