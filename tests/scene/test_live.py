"""A stage that is followed: what changed is seen, and nothing else is read again."""

import os
import shutil
import subprocess
import sys
from collections import Counter

import pytest
import torch
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.usd import LiveScene
from rfsg.scene.usd import reading as read_module
from rfsg.scene.usd.kept import alike
from tests.scene.scene_text import cube
from tests.scene.test_edits import RADIOS, WALL, assert_equal, reference

TRIANGLES = "int[] faceVertexCounts = [3, 3, 3, 3]\n int[] faceVertexIndices = "
MESH = f"""
    def Mesh "Tetra"
    {{
        custom token rfsg:material:model = "conductor"
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        {TRIANGLES} [0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3]
        double3 xformOp:translate = (0, 5, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
"""
MOVABLE = "double3 xformOp:translate = (1, 0, 0)\n double xformOp:rotateZ = 30"
ORDER = '"xformOp:translate", "xformOp:rotateZ"'


@pytest.fixture
def other(asset_here):
    """A second asset beside the first, with the same weights in a file of its own."""
    path = asset_here.with_name("other.usda")
    shutil.copy(asset_here.with_suffix(".safetensors"), path.with_suffix(".safetensors"))
    path.write_text(asset_here.read_text().replace("./cabinet.", "./other."))
    return path


@pytest.fixture
def lab(scene_file, asset_here):
    body = cube("Wall", "double3 xformOp:translate = (0, 2, 1)", '"xformOp:translate"')
    group = f'def Xform "Group" {{\n {reference("A", MOVABLE, ORDER)}\n {reference("B")}\n }}\n'
    return scene_file(body + group + MESH + RADIOS)


@pytest.fixture
def reads(monkeypatch):
    """Counts what is expensive: weights unpacked, meshes made, prims looked at."""
    count = Counter()

    def counted(name, what):
        def call(*arguments, **options):
            count[name] += 1
            return what(*arguments, **options)

        return call

    monkeypatch.setattr(read_module, "unpack", counted("weights", read_module.unpack))
    thing = read_module.Reader._thing
    monkeypatch.setattr(read_module.Reader, "_thing", counted("prims", thing))
    from rfsg.scene.usd import meshes

    monkeypatch.setattr(meshes, "triangles_of", counted("meshes", meshes.triangles_of))
    return count


def translate(stage, path, *metres):
    op = UsdGeom.Xformable(stage.GetPrimAtPath(path)).GetOrderedXformOps()[0]
    op.Set(Gf.Vec3d(*metres))


def elsewhere(text: str) -> None:
    """Run a program of its own."""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_while_nothing_changes_nothing_is_read(lab, reads):
    live = LiveScene(lab)
    scene = live.scene
    assert reads["weights"] == 1 and reads["meshes"] == 1
    assert_equal(scene, Scene.from_usd(lab))
    reads.clear()
    assert live.scene is scene and live.scene is scene
    assert not reads


def test_a_transform_set_by_pxr_is_seen_and_only_its_prim_looked_at(lab, reads):
    live = LiveScene(lab)
    before = live.scene
    reads.clear()
    translate(live.stage, "/World/Group/A", 3, 0, 0)
    after = live.scene
    assert after.node("/World/Group/A").pose.translation.tolist() == [3, 0, 0]
    assert after.node("/World/Group/A").body is before.node("/World/Group/A").body
    assert all(after.node(n.path) is n for n in before.nodes if n.path != "/World/Group/A")
    assert after.transmitters[0] is before.transmitters[0]
    assert reads["weights"] == 0 and reads["meshes"] == 0 and reads["prims"] == 2  # and its Surface
    assert_equal(after, Scene.from_usd(live.stage))
    # a new op on a group, one on the mesh and one on a radio
    UsdGeom.Xformable(live.stage.GetPrimAtPath("/World/Group")).AddTranslateOp().Set((0, 1, 0))
    translate(live.stage, "/World/Tetra", 9, 9, 9)
    translate(live.stage, "/World/Radios/AP", 1, 2, 3)
    assert_equal(live.scene, Scene.from_usd(live.stage))
    assert live.scene.node("/World/Group/B").pose.translation.tolist() == [0, 1, 0]
    assert live.scene.node("/World/Tetra").body is before.node("/World/Tetra").body
    assert live.scene.transmitters[0].position.tolist() == [1, 2, 3]


def test_a_reference_swapped_by_pxr_reads_the_new_weights_once(lab, other, reads):
    live = LiveScene(lab)
    before = live.scene
    reads.clear()
    prim = live.stage.GetPrimAtPath("/World/Group/B")
    prim.GetReferences().SetReferences([Sdf.Reference("./other.usda")])
    after = live.scene
    assert after.node("/World/Group/B").asset == str(other.resolve())
    assert reads["weights"] == 1 and reads["meshes"] == 0
    assert all(after.node(n.path) is n for n in before.nodes if n.path != "/World/Group/B")
    prim.GetReferences().SetReferences([Sdf.Reference("./cabinet.usda")])
    assert live.scene.node("/World/Group/B").body is before.node("/World/Group/A").body
    assert reads["weights"] == 1


def test_a_file_written_by_another_process_is_seen(lab, reads):
    live = LiveScene(lab)
    before = live.scene
    reads.clear()
    elsewhere(f"""
from pxr import Usd, UsdGeom
stage = Usd.Stage.Open({str(lab)!r})
UsdGeom.Xformable(stage.GetPrimAtPath("/World/Wall")).GetOrderedXformOps()[0].Set((0, 7, 1))
stage.DefinePrim("/World/Group/C", "Xform").GetReferences().AddReference("./cabinet.usda")
stage.GetPrimAtPath("/World/Radios/rx").SetActive(False)
stage.Save()
""")
    after = live.scene
    assert after.node("/World/Wall").pose.translation.tolist() == [0, 7, 1]
    assert after.node("/World/Group/C").body is before.node("/World/Group/A").body
    assert after.receivers == ()
    kept = [n for n in before.nodes if n.path != "/World/Wall"]
    assert all(after.node(n.path) is n for n in kept)
    assert reads["weights"] == 0 and reads["meshes"] == 0
    assert live.scene is after
    # rewritten whole, as an editor does: beside, then renamed
    beside = lab.with_suffix(".tmp")
    beside.write_text(lab.read_text().replace("(0, 7, 1)", "(0, 8, 1)"))
    os.replace(beside, lab)
    assert live.scene.node("/World/Wall").pose.translation.tolist() == [0, 8, 1]
    assert_equal(live.scene, Scene.from_usd(lab))


def test_weights_written_by_another_process_are_seen(lab, asset_here, reads):
    from rfsg.scene.assets import load_asset, save_asset

    live = LiveScene(lab)
    before = live.scene
    body = load_asset(asset_here).body
    with torch.no_grad():
        next(body.shape.parameters()).add_(0.25)
    reads.clear()
    save_asset(asset_here, body, overwrite=True)
    after = live.scene
    assert reads["weights"] == 1 and reads["meshes"] == 0
    one = next(after.node("/World/Group/A").body.shape.parameters())
    torch.testing.assert_close(one, next(body.shape.parameters()), rtol=0, atol=0)
    assert after.node("/World/Group/A").body is after.node("/World/Group/B").body
    assert after.node("/World/Tetra") is before.node("/World/Tetra")


def test_what_is_not_a_transform_is_seen_too(lab, reads):
    live = LiveScene(lab)
    before = live.scene
    stage = live.stage
    stage.GetPrimAtPath("/World/Radios/AP").GetAttribute("rfsg:radio:powerDbm").Set(7.0)
    assert live.scene.transmitters[0].power_dbm == 7.0
    stage.GetPrimAtPath("/World/Concrete").GetAttribute("rfsg:material:itu").Set("wood")
    assert live.scene.node("/World/Wall").body.surface.config()["itu"] == "wood"
    UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/World/Wall")).Bind(
        UsdShade.Material(stage.GetPrimAtPath("/World/Metal"))
    )
    assert live.scene.node("/World/Wall").body.surface.kind == "conductor"
    points = stage.GetPrimAtPath("/World/Tetra").GetAttribute("points")
    points.Set([(0, 0, 0), (2, 0, 0), (0, 1, 0), (0, 0, 1)])
    assert float(live.scene.node("/World/Tetra").body.shape.bounds()[1, 0]) == 2.0
    stage.RemovePrim("/World/Group/B")
    assert "/World/Group/B" not in [n.path for n in live.scene.nodes]
    a = live.scene.node("/World/Group/A")
    assert a is before.node("/World/Group/A")
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/Wall")).AddScaleOp().Set((2, 1, 1))
    assert live.scene.node("/World/Wall").body.shape.half_size.tolist() == [2, 1, 1]
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    with pytest.raises(SceneError, match="/World/Group/A: .*add the scale 100"):
        live.scene  # noqa: B018
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    assert_equal(live.scene, Scene.from_usd(stage))


def test_any_edits_give_what_a_new_reading_gives(lab, other):
    """The short plain twin: read everything again."""
    live = LiveScene(lab)
    stage = live.stage
    paths = ["/World/Group", "/World/Group/A", "/World/Wall", "/World/Tetra", "/World/Radios"]
    for _ in range(20):
        path = paths[int(torch.randint(len(paths), ()))]
        prim = stage.GetPrimAtPath(path)
        match int(torch.randint(4, ())):
            case 0:
                xform = UsdGeom.Xformable(prim)
                matrix = Gf.Matrix4d().SetTranslate(Gf.Vec3d(*torch.randn(3).double().tolist()))
                xform.MakeMatrixXform().Set(matrix)
            case 1:
                prim.SetActive(not prim.IsActive())
            case 2:
                name = ("./other.usda", "./cabinet.usda")[int(torch.randint(2, ()))]
                one = stage.GetPrimAtPath("/World/Group/B")
                if one:
                    one.GetReferences().SetReferences([Sdf.Reference(name)])
            case _:
                turn = UsdGeom.Xformable(prim)
                turn.MakeMatrixXform().Set(Gf.Matrix4d().SetRotate(Gf.Rotation((0, 0, 1), 33)))
        found, plain = live.scene, Scene.from_usd(stage)
        assert [n.path for n in found.nodes] == [n.path for n in plain.nodes]
        assert_equal(found, plain, atol=0)
        base = found.source.base
        assert (base.nodes, base.transmitters) == (found.nodes, found.transmitters)


def test_the_next_simulation_is_of_the_stage_as_it_is(scene_file):
    """One mirror, by its image: 6 m apart and h before the wall, the bounce is sqrt(36 + 4 h^2) long."""
    from rfsg.tracer.plan import Quality
    from rfsg.tracer.simulate import simulate

    def bounce(live) -> float:
        hertz = torch.tensor([2.4e9], dtype=torch.float64)
        delays = simulate(live.scene, hertz, Quality.named("draft")).channel.delay
        assert len(delays) == 2
        return float(delays.max()) * 299_792_458.0

    def length(face: float) -> float:
        return (36 + 4 * (face + 2) ** 2) ** 0.5

    wall = WALL.replace("/World/Concrete", "/World/Metal")
    path = scene_file(wall + RADIOS)
    live = LiveScene(path)
    assert bounce(live) == pytest.approx(length(1.9), rel=1e-12)
    translate(live.stage, "/World/Wall", 0, 3, 1)
    assert bounce(live) == pytest.approx(length(2.9), rel=1e-12)
    live.stage.GetRootLayer().Reload()  # as it is on disk
    assert bounce(live) == pytest.approx(length(1.9), rel=1e-12)
    elsewhere(f"""
from pxr import Usd, UsdGeom
stage = Usd.Stage.Open({str(path)!r})
UsdGeom.Xformable(stage.GetPrimAtPath("/World/Wall")).GetOrderedXformOps()[0].Set((0, 4, 1))
stage.Save()
""")
    assert bounce(live) == pytest.approx(length(3.9), rel=1e-12)


def test_a_moved_instance_stays_an_instance(scene_file, asset_here, reads):
    body = reference("A", MOVABLE, ORDER, "instanceable = true")
    path = scene_file(body + reference("B", MOVABLE, ORDER, "instanceable = true"))
    live = LiveScene(path)
    a, b = live.scene.nodes
    assert a.body is b.body
    translate(live.stage, "/World/B", 5, 0, 0)
    moved = live.scene
    assert moved.node("/World/A") is a and moved.node("/World/B").body is a.body
    assert moved.node("/World/B").pose.translation.tolist() == [5, 0, 0]
    assert reads["weights"] == 1


# stages of others


def test_an_open_stage_is_read_with_what_is_not_saved(lab):
    stage = Usd.Stage.Open(str(lab))
    translate(stage, "/World/Wall", 0, 3, 1)
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        translate(stage, "/World/Group/A", 4, 0, 0)
    before = lab.read_bytes()
    scene = Scene.from_usd(stage)
    assert scene.node("/World/Wall").pose.translation.tolist() == [0, 3, 1]
    assert scene.node("/World/Group/A").pose.translation.tolist() == [4, 0, 0]
    live = LiveScene(stage)
    translate(stage, "/World/Wall", 0, 4, 1)
    assert live.scene.node("/World/Wall").pose.translation.tolist() == [0, 4, 1]
    assert live.stage is stage and stage.GetRootLayer().dirty and lab.read_bytes() == before
    # what another program writes meanwhile does not take the edits away that are not saved
    lab.write_text(lab.read_text().replace("(0, 5, 0)", "(0, 6, 0)"))
    assert live.scene.node("/World/Wall").pose.translation.tolist() == [0, 4, 1]
    assert live.scene.node("/World/Tetra").pose.translation.tolist() == [0, 5, 0]


def test_variants_are_chosen_beside_an_open_stage(scene_file, asset_here):
    body = """
    def Xform "Door" (
        variants = { string state = "away" }
        prepend variantSets = "state"
    )
    {
        variantSet "state" = {
            "away" {
            }
            "here" (prepend references = @./cabinet.usda@) {
            }
        }
    }"""
    stage = Usd.Stage.Open(str(scene_file(body)))
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddTranslateOp().Set((0, 0, 1))
    assert Scene.from_usd(stage).nodes == ()
    live = LiveScene(stage, variants={"/World/Door": {"state": "here"}})
    (door,) = live.scene.nodes
    assert door.pose.translation.tolist() == [0, 0, 1]
    assert stage.GetPrimAtPath("/World/Door").GetVariantSet("state").GetVariantSelection() == "away"
    UsdGeom.Xformable(stage.GetPrimAtPath("/World")).GetOrderedXformOps()[0].Set((0, 0, 2))
    assert (
        Scene.from_usd(stage).with_variant("/World/Door", "state", "here").nodes[0].path
        == door.path
    )


def test_a_stage_in_memory_has_no_folder_of_its_own(asset_here):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    prim = UsdGeom.Xform.Define(stage, "/A").GetPrim()
    prim.GetReferences().AddReference(str(asset_here))
    with pytest.raises(SceneError, match="lies outside the folders this scene may read"):
        Scene.from_usd(stage)
    scene = Scene.from_usd(stage, asset_roots=[asset_here.parent])
    assert [n.path for n in scene.nodes] == ["/A"]
    with pytest.raises(SceneError, match="has no file .*save it first"):
        scene.moved("/A", (1, 0, 0)).save_edits(asset_here.with_name("edits.usda"))


# faults


def test_a_fault_is_told_until_it_is_mended(lab, other):
    live = LiveScene(lab)
    good = lab.read_text()
    lab.write_text(good.replace("@./cabinet.usda@", "@./gone.usda@", 1))
    for _ in range(2):
        with pytest.raises(SceneError, match="gone.usda"):
            live.scene  # noqa: B018
    os.replace(other, lab.with_name("gone.usda"))  # what was missing comes
    assert live.scene.node("/World/Group/A").asset == str(lab.with_name("gone.usda").resolve())
    lab.write_text("#usda 1.0\n(")
    for _ in range(2):
        with pytest.raises(SceneError, match="scene.usda"):
            live.scene  # noqa: B018
    lab.write_text(good)
    assert_equal(live.scene, Scene.from_usd(lab))


def test_what_a_changed_file_names_is_looked_at_before_it_is_opened(lab, tmp_path_factory):
    live = LiveScene(lab)
    before = live.scene
    outside = tmp_path_factory.mktemp("outside") / "secret.usda"
    outside.write_text("#usda 1.0\n")
    good = lab.read_text()
    lab.write_text(good.replace("@./cabinet.usda@", f"@{outside}@", 1))
    with pytest.raises(SceneError, match="lies outside the folders"):
        live.scene  # noqa: B018
    assert Sdf.Layer.Find(str(outside)) is None
    deep = "".join(f'def "P{i}" {{\n' for i in range(2500)) + "}\n" * 2500
    lab.write_text(f"#usda 1.0\n{deep}")
    with pytest.raises(SceneError, match="nest more than"):
        live.scene  # noqa: B018
    lab.write_text(good)
    assert all(alike(a, b) for a, b in zip(live.scene.nodes, before.nodes, strict=True))


def test_weights_that_do_not_match_any_more_are_a_fault(lab, asset_here):
    live = LiveScene(lab)
    weights = asset_here.with_suffix(".safetensors")
    good = weights.read_bytes()
    weights.write_bytes(good + b" ")
    with pytest.raises(SceneError, match="the file was changed"):
        live.scene  # noqa: B018
    weights.write_bytes(good)
    assert_equal(live.scene, Scene.from_usd(lab))
