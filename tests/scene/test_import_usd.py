"""USD scenes with Aerial's and SimReady's materials: a layer over them, the source untouched."""

import hashlib

import pytest
from pxr import Usd, UsdShade

from rfsg.objects.physics.media import MATERIALS
from rfsg.scene import usd
from rfsg.scene.importers import aerial, import_scene, simready
from rfsg.scene.materials import Material
from rfsg.scene.scene import Scene, SceneError

BOX = """
        point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 3), (2, 0, 3), (2, 2, 3), (0, 2, 3)]
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [3, 2, 1, 0, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7]
        uniform token subdivisionScheme = "none"
"""
LID = """
        point3f[] points = [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        uniform token subdivisionScheme = "none"
"""
HEAD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = {metre}
    upAxis = "{up}"
)
"""
AERIAL = (
    HEAD
    + """
def Xform "World"
{
    def Mesh "house"
    {"""
    + BOX
    + """        custom token asim:material = "brick_like"
        custom bool AerialRFMesh = 1
    }
    def Mesh "ground"
    {"""
    + LID
    + """        custom token asim:material = "mixture"
    }
    def Mesh "sign"
    {"""
    + LID
    + """        custom token asim:material = "mixture"
        custom bool AerialRFMesh = 0
    }
}
def Scope "Materials"
{
    def Scope "standard"
    {
        def "brick_like"
        {
            custom float a = 3.91
            custom float b = 0
            custom float c = 0.0238
            custom float d = 0.16
            custom float thickness = 0.3
        }
        def "mixture"
        {
            custom float a = 5
            custom float b = -0.1
            custom float c = 0.02
            custom float d = 0.5
            custom float scattering_coeff = 0.3
            custom float k_xpol = 0.1
            custom float exponent_alpha_r = 4
        }
    }
}
"""
)
SIMREADY = (
    HEAD
    + """
def Xform "World"
{
    def Mesh "pane" (prepend apiSchemas = ["MaterialBindingAPI"])
    {"""
    + LID
    + """        rel material:binding = </World/Looks/Glass>
    }
    def Mesh "seat" (prepend apiSchemas = ["MaterialBindingAPI"])
    {"""
    + BOX
    + """        rel material:binding = </World/Looks/Leather>
    }
    def Scope "Looks"
    {
        def Material "Glass"
        {
            token omni:simready:nonvisual:base = "clear_glass"
            token omni:simready:nonvisual:coating = "none"
        }
        def Material "Leather"
        {
            token omni:simready:nonvisual:base = "leather"
        }
    }
}
"""
)


@pytest.fixture
def stage(tmp_path):
    def write(text: str, metre: float = 1.0, up: str = "Z"):
        path = tmp_path / "source.usda"
        path.write_text(text.replace("{metre}", str(metre)).replace("{up}", up))
        return path

    return write


def test_aerials_materials_by_name_and_by_formula(stage, tmp_path):
    """Coefficients of P.2040's brick are brick; others are a f^b and c f^d at the frequency."""
    source, out = stage(AERIAL), tmp_path / "over.usda"
    before = hashlib.sha256(source.read_bytes()).digest()
    report = import_scene(source, out, frequency=2e9, tx=[(0, 0, 9)])
    assert hashlib.sha256(source.read_bytes()).digest() == before
    assert (report.objects, report.triangles) == (2, 14)
    scene = Scene.from_usd(out)
    assert [n.path for n in scene.nodes] == ["/World/house", "/World/ground"]
    house, ground = (n.body.surface for n in scene.nodes)
    assert house.config() == Material("slab", itu="brick", thickness=0.3).surface().config()
    config = ground.config()
    assert config["eps_r"] == pytest.approx(5 * 2**-0.1)
    assert config["sigma"] == pytest.approx(0.02 * 2**0.5)
    assert config["thickness_m"] == 0.1
    assert config["scattering"]["coefficient"] == pytest.approx(0.3)
    # a house is closed; the ground encloses nothing
    assert scene.nodes[0].body.shape.convex and not scene.nodes[1].body.shape.convex
    assert scene.frequency == 2e9 and len(scene.transmitters) == 1


def test_a_formula_asks_for_the_frequency(stage, tmp_path):
    with pytest.raises(SceneError, match="'mixture': .*give the frequency"):
        import_scene(stage(AERIAL), tmp_path / "over.usda")


def test_a_material_that_is_nowhere_is_named(stage, tmp_path):
    text = AERIAL.replace('def "mixture"', 'def "mixtures"')
    with pytest.raises(
        SceneError, match="'mixture': there is no prim of this name under /Materials"
    ):
        import_scene(stage(text), tmp_path / "over.usda", frequency=2e9)


@pytest.mark.parametrize(("metre", "up"), [(1.0, "Z"), (0.01, "Y")])
def test_simreadys_materials_are_dressed_where_they_are(stage, tmp_path, metre, up):
    """Units and axes of the source hold in the layer; what P.2040 does not know is said."""
    out = tmp_path / "over.usda"
    report = import_scene(stage(SIMREADY, metre, up), out, rx=[(1, 2, 3)])
    assert any("leather" in w for w in report.warnings)
    assert any("no thickness" in w for w in report.warnings)
    scene = Scene.from_usd(out)
    (pane,) = scene.nodes
    assert pane.body.surface.config()["itu"] == "glass"
    size = pane.body.shape.bounds()[1] - pane.body.shape.bounds()[0]
    assert float(size.amax()) == pytest.approx(18 * metre, abs=1e-4)
    assert scene.receivers[0].position.tolist() == pytest.approx([1, 2, 3])
    assert usd.check(out) == []
    stage_over = Usd.Stage.Open(str(out))
    seat = UsdShade.MaterialBindingAPI(stage_over.GetPrimAtPath("/World/seat"))
    assert seat.ComputeBoundMaterial()[0].GetPath() == "/World/Looks/Leather"
    del stage_over


def test_a_scene_that_says_nothing_of_waves_is_refused(stage, tmp_path):
    text = SIMREADY.replace("clear_glass", "velvet")
    with pytest.raises(SceneError, match="no material of Aerial .* or SimReady"):
        import_scene(stage(text), tmp_path / "over.usda")


def test_the_layer_must_be_able_to_read_its_source(stage, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    with pytest.raises(SceneError, match="lies outside the folders"):
        import_scene(stage(SIMREADY), tmp_path / "elsewhere" / "over.usda")


def test_every_row_of_the_tables_is_a_material():
    for base in (*simready.METALS, *simready.WALLS):
        material = simready.radio_of(base)
        assert material is not None and material.surface() is not None
    for name, rows in MATERIALS.items():
        if name not in ("vacuum", "metal"):
            said = dict(zip(aerial.FORMULA, rows[0][2:], strict=True))
            assert aerial.radio_of(said, None).itu == name
