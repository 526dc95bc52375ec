"""Assets: the same bits back, a mesh that others can show, provenance, nothing overwritten."""

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene import usd
from rfsg.scene.assets import load_asset, save_asset
from rfsg.scene.fields import BAND, NEURAL
from rfsg.scene.scene import SceneError
from rfsg.scene.weights import pack, same_bits


@pytest.mark.parametrize("surface", [Conductor(), Slab(0.01, itu="glass"), StochasticSurface()])
def test_same_bits_back(small_asset, tmp_path, surface):
    body = Body(small_asset[0].shape, surface)
    story = {"mesh": "cabinet.obj", "seed": 3, "report": {"mean_mm": 1.25, "steps": [1, 2]}}
    loaded = load_asset(save_asset(tmp_path / "net", body, provenance=story))
    assert same_bits(loaded.body.shape, body.shape) and same_bits(loaded.body.surface, surface)
    assert loaded.provenance == story
    assert loaded.path == tmp_path / "net.usda"
    assert loaded.weights == tmp_path / "net.safetensors"
    x = torch.rand(5, 3, dtype=torch.float64)
    assert torch.equal(loaded.body.shape.sdf(x), body.shape.sdf(x))


def test_double_precision_weights_keep_their_bits(small_asset, tmp_path):
    body = Body(load_asset(small_asset[1]).body.shape.double(), Conductor())
    assert same_bits(load_asset(save_asset(tmp_path / "d.usda", body)).body.shape, body.shape)


def test_equal_bodies_give_equal_bytes(small_asset):
    assert pack(small_asset[0]) == pack(load_asset(small_asset[1]).body)


def test_any_body_may_be_an_asset(tmp_path):
    body = Body(Box((0.1, 0.2, 0.3)), StochasticSurface())
    assert same_bits(load_asset(save_asset(tmp_path / "b.usda", body)).body.shape, body.shape)


def test_the_usd_file_is_what_other_programs_expect(small_asset):
    from pxr import Usd, UsdGeom

    body, path = small_asset
    stage = Usd.Stage.Open(str(path))
    root = stage.GetDefaultPrim()
    assert (root.GetName(), Usd.ModelAPI(root).GetKind()) == ("cabinet", "component")
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    attributes = root.GetAuthoredPropertiesInNamespace("rfsg")
    assert {a.GetName() for a in attributes} == {f.name for f in NEURAL if f not in BAND}
    spec = stage.GetRootLayer().GetPrimAtPath(root.GetPath())
    assert all(a.custom for a in spec.attributes)
    mesh = UsdGeom.Mesh(root.GetChild("Surface"))
    assert mesh.ComputePurpose() == "default"
    assert mesh.GetNormalsInterpolation() == "faceVarying"
    assert len(mesh.GetNormalsAttr().Get()) == len(mesh.GetFaceVertexIndicesAttr().Get())
    assert np.allclose(mesh.GetExtentAttr().Get(), [[0, 0, 0], [0.3, 0.2, 1]])
    assert UsdGeom.Mesh.ValidateTopology(
        mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), 4
    )
    assert usd.check(path) == []


def test_nothing_is_overwritten_unless_asked(small_asset, tmp_path):
    body, _ = small_asset
    path = save_asset(tmp_path / "a.usda", body)
    before = path.read_bytes()
    with pytest.raises(SceneError) as error:
        save_asset(path, Body(body.shape, Slab(0.01, itu="glass")))
    assert len(error.value.faults) == 2 and path.read_bytes() == before
    save_asset(path, Body(body.shape, Slab(0.01, itu="glass")), overwrite=True)
    assert load_asset(path).body.surface.kind == "slab"
    assert sorted(f.name for f in tmp_path.iterdir()) == ["a.safetensors", "a.usda"]


def test_what_cannot_be_written_leaves_nothing_behind(small_asset, tmp_path):
    body, _ = small_asset
    bad = np.full((3, 3), np.nan), np.array([[0, 1, 2]]), np.zeros((3, 3))
    for arguments in ({"mesh": bad}, {"provenance": {"x": float("nan")}}):
        with pytest.raises(SceneError):
            save_asset(tmp_path / "a.usda", body, **arguments)
    with pytest.raises(SceneError, match="does not exist"):
        save_asset(tmp_path / "no" / "a.usda", body)
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_no_prim_can_have_is_made_one(small_asset, tmp_path):
    path = save_asset(tmp_path / "3 drawer-cabinet.usda", small_asset[0])
    assert 'defaultPrim = "__drawer_cabinet"' in path.read_text()
    assert load_asset(path).path == path
