"""`rfsg export`, `assets` and `check` from file to file, as people type them."""

import pytest

from rfsg import cli
from rfsg.assets import illustrate
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.assets import load_asset, save_asset
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.weights import same_bits


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    box = Node("/World/Box", Body(Box((0.2, 0.3, 0.4)), Conductor()), Pose.identity())
    ball = Body(Sphere(0.3), StochasticSurface(), (2.4e9, 2.5e9))
    nodes = (box, Node("/World/Ball", ball, Pose.at(3, 0, 0)))
    return Scene(nodes).to_usd(tmp_path_factory.mktemp("scene") / "scene.usda")


def run(*arguments: object) -> int:
    return cli.run([str(a) for a in arguments])


def test_export_then_add_then_list(scene, tmp_path, capsys):
    for path, out in (("/World/Box", "box"), ("/World/Ball", "ball.usdz")):
        assert run("export", scene, path, "-o", tmp_path / out) == 0
    box, package = map(load_asset, capsys.readouterr().out.split())
    read = Scene.from_usd(scene)
    assert same_bits(box.body.shape, read.node("/World/Box").body.shape)
    assert same_bits(package.body.surface, read.node("/World/Ball").body.surface)
    assert (box.picture, package.picture) == (
        str(tmp_path / "box" / "box.png"), f"{tmp_path / 'ball.usdz'}[ball.png]",
    )  # fmt: skip
    library = tmp_path / "lib"
    for asset in (box.path, package.path):
        assert run("assets", "add", asset, "--library", library) == 0
    capsys.readouterr()
    assert run("assets", library, "--html", tmp_path / "lib.html") == 0
    printed = capsys.readouterr().out
    for words in ("2 assets", "2.4 to 2.5 GHz", "box, conductor", "0.4 x 0.6 x 0.8", "ball.usdz["):
        assert words in printed
    assert (tmp_path / "lib.html").read_text().count("<img") == 2
    assert run("assets", library, "--html", tmp_path / "lib.html") == 3
    assert "already exists" in capsys.readouterr().err


def test_add_draws_the_picture_that_is_missing(tmp_path, capsys):
    asset = save_asset(tmp_path / "plain", Body(Box((0.2, 0.3, 0.4)), Conductor()))
    before = asset.read_bytes()
    assert run("assets", "add", asset, "--library", tmp_path / "lib") == 0
    copy = load_asset(capsys.readouterr().out.strip())
    assert copy.picture is not None and asset.read_bytes() == before
    assert copy.sha256 == load_asset(asset).sha256
    assert run("check", copy.path) == 0
    assert run("assets", "add", asset, "--library", tmp_path / "lib") == 3
    asset.with_suffix(".png").write_bytes(b"another thing")
    with pytest.raises(SceneError, match="plain.png: already exists"):
        illustrate(asset)
    assert asset.read_bytes() == before


def test_export_refuses_what_is_not_there_or_is_there_already(scene, tmp_path, capsys):
    assert run("export", scene, "/World/Bax", "-o", tmp_path / "x") == 3
    assert "/World/Box" in capsys.readouterr().err
    assert run("export", tmp_path / "no.usda", "/World/Box", "-o", tmp_path / "x") == 3
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "x.usda").write_text("mine")
    assert run("export", scene, "/World/Box", "-o", tmp_path / "x") == 3
    assert (tmp_path / "x" / "x.usda").read_text() == "mine"


def test_check_explains_a_package_and_finds_what_is_broken(scene, tmp_path, capsys):
    package = Scene.from_usd(scene).export("/World/Ball", tmp_path / "ball.usdz")
    assert run("check", package) == 0
    heard = capsys.readouterr()
    assert "no faults" in heard.out and "by design" in heard.err
    asset = save_asset(tmp_path / "box", Body(Box((0.2, 0.3, 0.4)), Conductor()))
    asset.write_text(asset.read_text().replace("boundsMax = (0.2", "boundsMax = (2.2"))
    assert run("check", asset) == 3
    assert "/box: rfsg:neural:boundsMax" in capsys.readouterr().out


@pytest.mark.parametrize("words", [("assets", "--help"), ("assets", "add", "-h"), ("export", "-h")])
def test_help_answers(words, capsys):
    assert run(*words) == 0
    assert "Usage" in capsys.readouterr().out


def test_a_folder_that_is_not_there(tmp_path, capsys):
    assert run("assets", tmp_path / "nowhere") == 3
    assert "no such folder" in capsys.readouterr().err
