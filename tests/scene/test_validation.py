"""What `rfsg check` finds beside reading: our own checks, OpenUSD's, and what is so by design."""

import pytest
from pxr import Sdf

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.shown import hull_of, shown_mesh
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene import usd
from rfsg.scene.assets import load_asset, save_asset
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.packaging import write_package
from rfsg.scene.usd.validation import findings
from tests.scene.scene_text import cube

PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)


@pytest.fixture
def asset(tmp_path):
    """A box as an asset with all that an asset may have."""
    body = Body(Box((0.2, 0.3, 0.4)), StochasticSurface(), band=(2.4e9, 2.5e9))
    mesh = shown_mesh(body.shape)
    return save_asset(
        tmp_path / "box",
        body,
        mesh=mesh,
        hull=hull_of(mesh[0]),
        picture=PNG,
        provenance={"seed": 1},
    )


def changed(asset, old: str, new: str) -> list[str]:
    """Findings after a change of the layer's text; the change must be one."""
    text = asset.read_text()
    assert old in text
    asset.write_text(text.replace(old, new, 1))
    return usd.check(asset)


def test_an_asset_with_everything_has_no_findings(asset):
    assert findings(asset).faults == () and findings(asset).notes == ()


@pytest.mark.parametrize(
    "old, new, where, words",
    [
        ("boundsMax = (0.2", "boundsMax = (0.7", "/box", "the weights say"),
        ("boundsMin = (-0.2", "boundsMin = (-0.1", "/box", "the weights say"),
        ("lipschitz = 1", "lipschitz = 3", "/box", "lipschitz is 3.0; the weights say 1.0"),
        ("'{\"seed\": 1}'", "'{\"seed\": '", "/box", "not JSON"),
        ("'{\"seed\": 1}'", "'[1]'", "/box", "not a JSON object"),
        ("./box.png", "./other.png", "/box", "picture './other.png' not found"),
        ("./box.png", "./box.usda", "/box", "neither PNG nor JPEG"),
        ("band:minHz = 2400000000", "band:minHz = 2600000000", "/box", "the lower first"),
        ("band:minHz = 2400000000", "band:minHz = -1", "/box", "finite number > 0"),
        ("faceVertexIndices = [", "faceVertexIndices = [9999, ", "/box/", "the mesh is broken"),
        ("normals = [(", "normals = [(0, 0, 1), (", "/box/Surface", "normals, faceVarying; expected"),
        ("points = [(", "points = [(nan, 0, 0), (", "/box/", "not finite"),
    ],
)  # fmt: skip
def test_what_is_amiss_is_found_with_its_prim(asset, old, new, where, words):
    found = changed(asset, old, new)
    assert any(f.startswith(where) and words in f for f in found), found


def test_half_a_band_is_refused(asset):
    text = asset.read_text()
    lines = [line for line in text.splitlines(True) if "band:maxHz" not in line]
    asset.write_text("".join(lines))
    with pytest.raises(SceneError, match="expected both, the lower first"):
        load_asset(asset)
    assert len(usd.check(asset)) == 1


def test_a_picture_elsewhere_is_not_read(asset, tmp_path):
    """Nothing outside the folders that a scene may read is opened, not even for a picture."""
    outside = tmp_path.parent / f"{tmp_path.name}.png"
    outside.write_bytes(PNG)
    asset.write_text(asset.read_text().replace("./box.png", f"../{outside.name}"))
    assert any("lies outside the folders" in f for f in usd.check(asset))
    assert load_asset(asset).picture is None


@pytest.mark.parametrize(
    "api, wanted",
    [
        ("RfsgNeuralObjectAPI", "rfsg:neural:weights"),
        ("RfsgMaterialAPI", "rfsg:material:model"),
        ("RfsgRadioAPI", "rfsg:radio:role"),
    ],
)
def test_an_api_without_what_makes_it_one(scene_file, api, wanted):
    path = scene_file(cube() + f'def Xform "Odd" (prepend apiSchemas = ["{api}"]) {{ }}')
    assert usd.check(path) == [f"/World/Odd: {api} is applied, but {wanted} is not given"]


def test_drawn_meshes_that_waves_do_not_see_are_looked_at_too(scene_file):
    mesh = """
    def Mesh "Decor"
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 7]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        float3[] extent = [(0, 0, 0), (1, 1, 0)]
        uniform token subdivisionScheme = "none"
    }
    """
    (found,) = usd.check(scene_file(cube() + mesh))
    assert found.startswith("/World/Decor: the mesh is broken") and "index 7" in found


def test_findings_stand_prim_by_prim(scene_file):
    odd = 'def Xform "{}" (prepend apiSchemas = ["RfsgRadioAPI", "RfsgMaterialAPI"]) {{ }}\n'
    found = usd.check(scene_file(odd.format("B") + odd.format("A")))
    assert [f.split(":")[0] for f in found] == ["/World/B", "/World/B", "/World/A", "/World/A"]


def test_the_package_note_hides_nothing_else(asset, tmp_path):
    """Weights in a package are by design; another strange file in it is a finding."""
    files = {f.name: f.read_bytes() for f in load_asset(asset).parts[::-1]}
    clean, odd = tmp_path / "clean.usdz", tmp_path / "odd.usdz"
    write_package(clean, files, False)
    assert findings(clean).faults == () and len(findings(clean).notes) == 1
    write_package(odd, {"notes.txt": b"hello"} | files, False)
    (fault,) = findings(odd).faults
    assert "txt" in fault and len(findings(odd).notes) == 1


def test_a_lost_texture_is_one_finding(scene_file):
    """OpenUSD's word for what reading says with its prim is not repeated."""
    body = cube() + 'def Xform "Gone" (prepend references = @./gone.usda@) { }'
    found = usd.check(scene_file(body))
    assert len(found) == 1 and "gone.usda" in found[0] and "OpenUSD" not in found[0]


def test_nothing_of_it_changes_the_file(asset):
    before = asset.read_bytes()
    findings(asset)
    assert asset.read_bytes() == before and not Sdf.Layer.FindOrOpen(str(asset)).dirty
