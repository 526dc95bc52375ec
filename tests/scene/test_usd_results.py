"""Results as USD over a scene: where they were, coloured, and no part of what waves see."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom

from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.usd.placements import world_from_stage
from rfsg.scene.usd.results import write_map, write_paths
from rfsg.scene.usd.validation import check
from tests.scene.test_edits import RADIOS, WALL, assert_equal

STAGES = {"metres, Z up": (1, "Z"), "cm, Y up": (0.01, "Y"), "inches, Z up": (0.0254, "Z")}
POINTS = [
    np.array([[-3.0, -2.0, 1.0], [3.0, -2.0, 1.0]]),
    np.array([[-3.0, -2.0, 1.0], [0.1, 1.9, 1.0], [3.0, -2.0, 1.0]]),
]
GAIN_DB, DELAY_S = np.array([-60.0, -71.5]), np.array([2e-8, 3.25e-8])
VERTICES = np.array(
    [[0.0, 0, 1.2], [1, 0, 1.2], [2, 0, 1.2], [0, 1, 1.2], [1, 1, 1.2], [2, 1, 1.2]]
)
FACES = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])


@pytest.fixture(params=STAGES.values(), ids=STAGES)
def lab(request, scene_file):
    metre, up = request.param
    return scene_file(WALL + RADIOS, metre, up)


@pytest.fixture
def metric(scene_file):
    return scene_file(WALL + RADIOS)


def to_paths(scene, path, **options):
    return write_paths(scene, path, POINTS, GAIN_DB, DELAY_S, **options)


def in_world(file, prim):
    """Points of a prim in the world [m], with all that pxr and the stage put on them."""
    stage = Usd.Stage.Open(str(file))
    shape = UsdGeom.PointBased(stage.GetPrimAtPath(prim))
    own = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(shape.GetPrim())).T
    matrix = world_from_stage(stage, file, []) @ own
    points = np.asarray(shape.GetPointsAttr().Get(), np.float64)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def primvar(file, prim, name):
    stage = Usd.Stage.Open(str(file))
    found = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(prim)).GetPrimvar(name)
    assert found.GetInterpolation() == UsdGeom.Tokens.uniform
    return np.asarray(found.Get())


def test_paths_come_back_where_they_were(lab, tmp_path):
    file = to_paths(Scene.from_usd(lab), tmp_path / "paths.usda")
    assert np.abs(in_world(file, "/RadioPaths") - np.concatenate(POINTS)).max() < 1e-6
    stage = Usd.Stage.Open(str(file))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/RadioPaths"))
    assert list(curves.GetCurveVertexCountsAttr().Get()) == [2, 3]
    assert curves.GetTypeAttr().Get() == UsdGeom.Tokens.linear
    assert (primvar(file, "/RadioPaths", "gain_db") == GAIN_DB).all()
    assert (primvar(file, "/RadioPaths", "delay_s") == DELAY_S).all()
    strong, weak = primvar(file, "/RadioPaths", "displayColor")
    assert strong @ (0.2126, 0.7152, 0.0722) > weak @ (0.2126, 0.7152, 0.0722)  # luminance


def test_a_map_comes_back_where_it_was(lab, tmp_path):
    rss = np.array([-40.0, -80.0])
    file = write_map(Scene.from_usd(lab), tmp_path / "map.usda", VERTICES, FACES, rss)
    stage = Usd.Stage.Open(str(file))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/RadioMap"))
    index = np.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(2, 4)
    assert np.abs(in_world(file, "/RadioMap")[index] - VERTICES[FACES]).max() < 1e-6
    assert (primvar(file, "/RadioMap", "rss_dbm") == rss).all()
    assert len(primvar(file, "/RadioMap", "displayColor")) == 2
    assert mesh.GetSubdivisionSchemeAttr().Get() == UsdGeom.Tokens.none


def test_far_from_the_origin_a_map_is_as_exact(metric, tmp_path):
    far = VERTICES + (3.1e5, 5.2e6, 400.0)  # as a survey has it
    scene = Scene.from_usd(metric)
    file = write_map(scene, tmp_path / "map.usda", far, FACES, np.array([-40.0, -80.0]))
    assert np.abs(in_world(file, "/RadioMap") - far).max() < 1e-6


def test_faces_where_nothing_arrives_are_left_out(metric, tmp_path):
    scene = Scene.from_usd(metric)
    file = write_map(scene, tmp_path / "map.usda", VERTICES, FACES, np.array([-np.inf, -80.0]))
    stage = Usd.Stage.Open(str(file))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/RadioMap"))
    index = np.asarray(mesh.GetFaceVertexIndicesAttr().Get())
    assert np.abs(in_world(file, "/RadioMap")[index] - VERTICES[FACES[1]]).max() < 1e-6
    assert (primvar(file, "/RadioMap", "rss_dbm") == [-80.0]).all()


def test_validators_find_nothing(lab, tmp_path):
    scene = Scene.from_usd(lab)
    rss = np.array([-40.0, -80.0])
    nothing = np.full(2, -np.inf)
    written = [
        to_paths(scene, tmp_path / "paths.usda"),
        write_paths(scene, tmp_path / "none.usda", [], np.zeros(0), np.zeros(0)),
        write_map(scene, tmp_path / "map.usda", VERTICES, FACES, rss),
        write_map(scene, tmp_path / "silent.usda", VERTICES, FACES, nothing),
    ]
    assert [fault for file in (lab, *written) for fault in check(file)] == []


def test_the_scene_is_the_same_and_its_source_untouched(lab, tmp_path):
    before, scene = lab.read_bytes(), Scene.from_usd(lab)
    paths = to_paths(scene, tmp_path / "paths.usda")
    over = write_map(Scene.from_usd(paths), tmp_path / "map.usda", VERTICES, FACES, np.zeros(2))
    for file in (paths, over):
        assert_equal(Scene.from_usd(file), scene)
    assert lab.read_bytes() == before
    stage = Usd.Stage.Open(str(over))
    assert stage.GetPrimAtPath("/RadioPaths") and stage.GetPrimAtPath("/RadioMap")


def test_an_edited_scene_is_shown_as_it_was_simulated(lab, tmp_path):
    scene = Scene.from_usd(lab).moved("/World/Wall", (0.5, 0.0, 0.0)).without("/World/Radios/rx")
    read = Scene.from_usd(to_paths(scene, tmp_path / "paths.usda"))
    assert_equal(read, scene)


def test_later_results_take_the_place_of_earlier_ones(metric, tmp_path):
    first = to_paths(Scene.from_usd(metric), tmp_path / "paths.usda")
    again = tmp_path / "again.usda"
    write_paths(Scene.from_usd(first), again, POINTS[1:], GAIN_DB[1:], DELAY_S[1:])
    assert np.abs(in_world(again, "/RadioPaths") - POINTS[1]).max() < 1e-6


def test_nothing_is_overwritten_unasked(metric, tmp_path):
    scene, file = Scene.from_usd(metric), tmp_path / "paths.usda"
    file.write_text("mine")
    with pytest.raises(SceneError, match="already exists"):
        to_paths(scene, file)
    assert file.read_text() == "mine"
    to_paths(scene, file, overwrite=True)
    with pytest.raises(SceneError, match="is read from this file"):
        to_paths(scene, metric, overwrite=True)
    with pytest.raises(SceneError, match="is read from this file"):
        to_paths(Scene.from_usd(file), file, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["paths.usda", "scene.usda"]


def test_a_prim_of_the_scene_is_not_taken_for_a_result(metric, tmp_path):
    metric.write_text(metric.read_text() + '\ndef Xform "RadioPaths"\n{\n}\n')
    with pytest.raises(SceneError, match="^/RadioPaths: the scene has a prim here"):
        to_paths(Scene.from_usd(metric), tmp_path / "paths.usda")
    assert not (tmp_path / "paths.usda").exists()


def test_a_scene_without_a_file_is_refused(metric, tmp_path):
    scene = replace(Scene.from_usd(metric), source=None)
    with pytest.raises(SceneError, match="made in Python"):
        to_paths(scene, tmp_path / "paths.usda")


def test_results_write_themselves(metric, tmp_path):
    """A simulation and a map of two cells, by their own methods."""
    from rfsg.tracer.radiomap import radio_map
    from rfsg.tracer.simulate import simulate

    scene = Scene.from_usd(metric)
    result = simulate(scene, 2.4e9, "draft")
    file = result.to_usd(tmp_path / "paths.usda")
    gain_db = 20 * torch.log10(result.channel.gain[:, 0].abs())
    assert np.allclose(sorted(primvar(file, "/RadioPaths", "gain_db")), sorted(gain_db.tolist()))
    delay = sorted(result.channel.delay.tolist())
    assert np.allclose(sorted(primvar(file, "/RadioPaths", "delay_s")), delay, rtol=1e-12, atol=0)
    found = radio_map(scene, 2.4e9, bounds=(-1.0, -1.5, 1.0, -0.5), cell=1.0, method="images")
    file = found.to_usd(tmp_path / "map.usda")
    rss = primvar(file, "/RadioMap", "rss_dbm")
    assert np.allclose(rss, found.best_dbm().reshape(-1).numpy(), rtol=1e-12, atol=0)


def test_results_are_passed_over_without_a_word(metric, tmp_path):
    """What shows results is meant to have no material; other scenery is still told of."""
    read = Scene.from_usd(metric)
    paths = Scene.from_usd(to_paths(read, tmp_path / "paths.usda"))
    both = write_map(paths, tmp_path / "map.usda", VERTICES, FACES, np.array([-50.0, -60.0]))
    assert Scene.from_usd(both).warnings == paths.warnings == read.warnings
    other = both.read_text().replace("RadioMap", "Carpet").replace("bool results = 1", "")
    carpet = tmp_path / "carpet.usda"
    carpet.write_text(other)
    (warning,) = set(Scene.from_usd(carpet).warnings) - set(read.warnings)
    assert "/Carpet" in warning and "without radio material" in warning
