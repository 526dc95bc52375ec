"""A mesh object of an imported scene becomes a neural object: its material and place kept."""

from types import SimpleNamespace

import pytest
import torch

from rfsg.cli import run
from rfsg.learn.geometry import MeshError
from rfsg.learn.neuralised import neuralise_object
from rfsg.scene.assets import load_asset
from rfsg.scene.importers.parts import Imported, Part
from rfsg.scene.importers.primitives import cube, rectangle
from rfsg.scene.materials import Material
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.usd.importing import write_imported

STEPS = 250  # at 150 a box of 2 m does not close yet


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """A closed box of 2 x 2 x 2 m drawn as a sheet, wound anyhow, and a bare wall."""
    vertices, triangles = cube()
    triangles = triangles.copy()
    triangles[::3] = triangles[::3, ::-1]
    wall = rectangle()
    parts = (
        Part("box", vertices + [5.0, 1.0, 1.0], triangles, "brick"),
        Part("wall", *wall, "brick"),
    )
    path = tmp_path_factory.mktemp("imported") / "scene.usda"
    brick = Material("slab", itu="brick", thickness=0.1)
    return write_imported(Imported(parts, {"brick": brick}), path)


def test_in_its_place_stands_what_was_learned(imported):
    scene = Scene.from_usd(imported)
    folder = imported.parent
    asset, layer = folder / "box.usda", folder / "learned.usda"
    before = imported.read_bytes()
    report = neuralise_object(scene, "/World/box", asset, layer=layer, steps=STEPS)
    assert report.steps == STEPS and imported.read_bytes() == before
    old, new = scene.node("/World/box"), Scene.from_usd(layer).node("/World/box")
    assert new.body.shape.kind == "neural"
    assert new.body.surface.config() == old.body.surface.config()
    torch.testing.assert_close(new.pose.translation, old.pose.translation)
    # the middle is inside, a metre off a face is outside: in the object's own frame
    points = torch.tensor([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]], dtype=torch.float64)
    inside, outside = new.body.shape.sdf(points).tolist()
    assert inside < 0 < outside
    provenance = load_asset(asset).provenance
    assert provenance["prim"] == "/World/box" and "report" in provenance
    assert Scene.from_usd(layer).node("/World/wall").body.shape.kind == "mesh"


def test_an_open_mesh_is_refused_with_the_reason(imported, tmp_path):
    scene = Scene.from_usd(imported)
    with pytest.raises(MeshError, match="/World/wall: .*open edges.*close the mesh"):
        neuralise_object(scene, "/World/wall", tmp_path / "wall.usda", steps=STEPS)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_mesh_is_refused(tmp_path):
    ball = Part("ball", cube()[0][:0], cube()[1][:0], "m", False, ((0.0, 0.0, 0.0), 1.0))
    path = write_imported(Imported((ball,), {"m": Material("conductor")}), tmp_path / "s.usda")
    with pytest.raises(SceneError, match="/World/ball: a sphere; expected a mesh"):
        neuralise_object(Scene.from_usd(path), "/World/ball", tmp_path / "a.usda")
    with pytest.raises(SceneError, match="no object at this path"):
        neuralise_object(Scene.from_usd(path), "/World/none", tmp_path / "a.usda")


def test_the_command_passes_its_options_on(imported, tmp_path, monkeypatch, capsys):
    asked = {}

    def fake(scene, path, asset, **options):
        asked.update(options, path=path, asset=asset, nodes=len(scene.nodes))
        return SimpleNamespace(surface_mean_mm=0.5)

    monkeypatch.setattr("rfsg.learn.neuralised.neuralise_object", fake)
    words = ["neuralise", str(imported), "/World/box", "-o", str(tmp_path / "box.usda")]
    more = ["--steps", "7", "--seed", "3", "--in-place", str(tmp_path / "layer.usda")]
    assert run([*words, *more]) == 0 and "surface_mean_mm" in capsys.readouterr().out
    assert (asked["path"], asked["steps"], asked["seed"]) == ("/World/box", 7, 3)
    assert asked["layer"] == tmp_path / "layer.usda" and asked["nodes"] == 2
