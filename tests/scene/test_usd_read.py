"""What a USD scene means: units, axes, shapes, materials, instances, radios, time."""

import math
import subprocess
import sys

import pytest
import torch

from rfsg.scene import fields, usd
from rfsg.scene.scene import Scene, SceneError
from tests.scene.scene_text import cube, known


def real(*values):
    return torch.tensor(values, dtype=torch.float64)


def reference(name, extra="", ops="", order=""):
    return f"""
    def Xform "{name}" (
        prepend references = @./cabinet.usda@
        {extra}
    )
    {{
        {ops}
        uniform token[] xformOpOrder = [{order}]
    }}
"""


# places and sizes


def test_a_stretched_cube_is_a_box_with_its_sizes_in_metres(scene_file):
    wall = cube(
        ops="""double3 xformOp:translate = (100, 200, 300)
        double xformOp:rotateZ = 90
        double3 xformOp:scale = (10, 20, 30)""",
        order='"xformOp:translate", "xformOp:rotateZ", "xformOp:scale"',
    )
    node = Scene.from_usd(scene_file(wall, metre=0.01)).node("/World/Wall")
    torch.testing.assert_close(node.body.shape.half_size.detach(), real(0.1, 0.2, 0.3))
    torch.testing.assert_close(node.pose.translation, real(1.0, 2.0, 3.0))
    assert float(node.pose.scale) == 1.0
    # the local x axis, 0.1 m half wide, points along world y
    torch.testing.assert_close(node.pose.point_world(real(0.1, 0.0, 0.0)), real(1.0, 2.1, 3.0))


def test_y_up_becomes_z_up(scene_file):
    wall = cube(
        ops="double3 xformOp:translate = (1, 2, 3)\n        double3 xformOp:scale = (1, 5, 1)",
        order='"xformOp:translate", "xformOp:scale"',
    )
    node = Scene.from_usd(scene_file(wall, up="Y")).node("/World/Wall")
    torch.testing.assert_close(node.pose.translation, real(1.0, -3.0, 2.0))
    tip = node.pose.point_world(node.body.shape.half_size.detach() * real(0, 1, 0))
    torch.testing.assert_close(tip, real(1.0, -3.0, 7.0))


@pytest.mark.parametrize("axis, tip", [("X", (4, 0, 0)), ("Y", (0, 4, 0)), ("Z", (0, 0, 4))])
@pytest.mark.parametrize("kind", ["Cylinder", "Capsule"])
def test_the_axis_attribute_turns_cylinders_and_capsules(scene_file, kind, axis, tip):
    body = known(kind, f'double radius = 0.5\n double height = 8\n uniform token axis = "{axis}"')
    node = Scene.from_usd(scene_file(body)).node("/World/Thing")
    shape = node.body.shape
    assert shape.kind == kind.lower()
    assert (float(shape.radius), float(shape.half_height)) == (0.5, 4.0)
    torch.testing.assert_close(node.pose.point_world(real(0, 0, 4.0)), real(*tip))
    assert float(torch.det(node.pose.rotation)) == pytest.approx(1.0)


def test_a_cylinder_absorbs_a_scale_along_its_axis(scene_file):
    body = known(
        "Cylinder",
        """double radius = 1
        double height = 2
        uniform token axis = "X"
        double3 xformOp:scale = (3, 0.5, 0.5)""",
        '"xformOp:scale"',
    )
    shape = Scene.from_usd(scene_file(body)).node("/World/Thing").body.shape
    assert (float(shape.radius), float(shape.half_height)) == (0.5, 3.0)


@pytest.mark.parametrize("kind", ["Sphere", "Capsule"])
def test_a_round_shape_refuses_an_uneven_scale(scene_file, kind):
    body = known(kind, "double3 xformOp:scale = (1, 2, 1)", '"xformOp:scale"')
    with pytest.raises(SceneError, match="/World/Thing: a .* cannot be scaled differently"):
        Scene.from_usd(scene_file(body))


def test_shear_is_refused_where_it_arises(scene_file):
    child = cube(ops="double xformOp:rotateZ = 30", order='"xformOp:rotateZ"')
    body = f"""
    def Xform "Uneven"
    {{
        double3 xformOp:scale = (1, 2, 1)
        uniform token[] xformOpOrder = ["xformOp:scale"]
        {child}
    }}"""
    with pytest.raises(SceneError, match="^/World/Uneven/Wall: the transform is sheared"):
        Scene.from_usd(scene_file(body))


def test_a_mirror_is_a_pose_with_determinant_minus_one(scene_file, asset_here):
    body = reference("M", ops="double3 xformOp:scale = (-2, 2, 2)", order='"xformOp:scale"')
    pose = Scene.from_usd(scene_file(body)).node("/World/M").pose
    assert float(pose.scale) == 2.0
    torch.testing.assert_close(pose.point_world(real(1, 0, 0)), real(-2.0, 0, 0))


def test_half_space_points_along_local_z(scene_file):
    body = """
    def Xform "Ground"
    {
        custom token rfsg:shape = "halfspace"
        custom token rfsg:material:model = "halfspace"
        custom double rfsg:material:epsR = 15
        custom double rfsg:material:sigma = 0.035
        double xformOp:rotateX = 90
        uniform token[] xformOpOrder = ["xformOp:rotateX"]
    }"""
    node = Scene.from_usd(scene_file(body)).node("/World/Ground")
    assert (node.body.shape.kind, node.body.surface.kind) == ("halfspace", "halfspace")
    torch.testing.assert_close(node.pose.direction_world(real(0, 0, 1)), real(0.0, -1, 0))


# materials


def test_slab_takes_the_smallest_side_of_its_cube_unless_told(scene_file):
    thin = cube("A", "double3 xformOp:scale = (2, 0.05, 1)", '"xformOp:scale"')
    told = """
    def Cube "B"
    {
        custom token rfsg:material:model = "slab"
        custom token rfsg:material:itu = "glass"
        custom double rfsg:material:thickness = 0.008
    }"""
    scene = Scene.from_usd(scene_file(thin + told, metre=1))
    assert scene.node("/World/A").body.surface.thickness_m == pytest.approx(0.1)
    assert scene.node("/World/B").body.surface.thickness_m == 0.008


def test_the_radio_binding_is_stronger_than_the_visual_one(scene_file):
    wall = cube(extra="rel material:binding:radio = </World/Metal>")
    assert Scene.from_usd(scene_file(wall)).node("/World/Wall").body.surface.kind == "conductor"


def test_prims_of_one_material_share_one_surface(scene_file):
    scene = Scene.from_usd(scene_file(cube("A") + cube("B")))
    a, b = scene.nodes
    assert a.body is not b.body and a.body.surface is b.body.surface


def test_decor_is_ignored_with_one_warning(scene_file):
    scene = Scene.from_usd(scene_file('def Sphere "Lamp" {}\n def Cone "Hat" {}\n' + cube()))
    assert [n.path for n in scene.nodes] == ["/World/Wall"]
    (warning,) = scene.warnings
    assert "/World/Lamp" in warning and "/World/Hat" in warning


def test_guide_and_proxy_are_not_there(scene_file):
    hidden = cube("A", extra='uniform token purpose = "guide"')
    hidden += cube("B", extra='uniform token purpose = "proxy"')
    assert Scene.from_usd(scene_file(hidden)).nodes == ()


def test_a_mesh_with_a_radio_material_is_refused_with_advice(scene_file):
    with pytest.raises(SceneError, match="/World/Thing: a Cone with a radio material.*learn-shape"):
        Scene.from_usd(scene_file(known("Cone", "")))


def test_a_slip_in_an_attribute_is_a_warning_with_the_likely_name(scene_file):
    body = cube(extra="custom double rfsg:velocty = 1")
    (warning,) = Scene.from_usd(scene_file(body)).warnings
    assert warning.startswith("/World/Wall: ") and "rfsg:velocity" in warning


# neural objects


def test_instances_share_one_body(scene_file, asset_here, small_asset):
    body = reference("A", "instanceable = true") + reference("B", "instanceable = true")
    scene = Scene.from_usd(scene_file(body + reference("C")))
    a, b, c = scene.nodes
    assert a.body is b.body is c.body
    assert a.asset == str(asset_here.resolve())
    saved = small_asset[0].state_dict()
    assert all(torch.equal(saved[k], v) for k, v in a.body.state_dict().items())
    assert scene.warnings == ()  # the extracted mesh belongs to the object: not decor


def test_known_shapes_in_instances_share_a_body_too(scene_file, tmp_path):
    (tmp_path / "post.usda").write_text("""#usda 1.0
(
    defaultPrim = "Post"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "Post"
{
    def Cylinder "Pole"
    {
        custom token rfsg:material:model = "conductor"
    }
}
""")
    body = "".join(
        f'def Xform "{n}" (\n prepend references = @./post.usda@\n instanceable = true\n) {{}}\n'
        for n in "AB"
    )
    a, b = Scene.from_usd(scene_file(body)).nodes
    assert (a.path, b.path) == ("/World/A/Pole", "/World/B/Pole")
    assert a.body is b.body


def test_a_bound_material_overrides_the_surface_and_keeps_the_shape(scene_file, asset_here):
    bind = 'prepend apiSchemas = ["MaterialBindingAPI"]'
    override = reference("B", bind, "rel material:binding = </World/Glass>")
    glass = """
    def Material "Glass"
    {
        custom token rfsg:material:model = "slab"
        custom token rfsg:material:itu = "glass"
        custom double rfsg:material:thickness = 0.01
    }"""
    a, b = Scene.from_usd(scene_file(glass + reference("A") + override)).nodes
    assert (a.body.surface.kind, b.body.surface.kind) == ("conductor", "slab")
    assert a.body.shape is b.body.shape


def test_a_centimetre_scene_needs_the_scale_that_the_fault_names(scene_file, asset_here):
    with pytest.raises(SceneError, match="/World/A: .*metersPerUnit is 1 .*add the scale 100 "):
        Scene.from_usd(scene_file(reference("A"), metre=0.01))
    scaled = reference(
        "A",
        ops="double3 xformOp:translate = (150, 0, 0)\n double3 xformOp:scale = (100, 100, 100)",
        order='"xformOp:translate", "xformOp:scale"',
    )
    pose = Scene.from_usd(scene_file(scaled, metre=0.01)).node("/World/A").pose
    assert float(pose.scale) == pytest.approx(1.0, abs=1e-15)
    torch.testing.assert_close(pose.translation, real(1.5, 0, 0))


@pytest.mark.parametrize("kind", ["Scope", "Xform"])
def test_a_material_library_has_no_units(scene_file, tmp_path, kind):
    (tmp_path / "looks.usda").write_text(f"""#usda 1.0
(
    defaultPrim = "Looks"
    metersPerUnit = 1
    upAxis = "Z"
)
def Scope "Looks"
{{
    def {kind} "Inside"
    {{
    }}
}}
""")
    body = 'def "Looks" (\n        prepend references = @./looks.usda@\n    )\n    {\n    }\n'
    path = scene_file(body, metre=0.01, up="Y")
    if kind == "Scope":
        assert Scene.from_usd(path).nodes == ()
    else:
        with pytest.raises(SceneError) as error:
            Scene.from_usd(path)
        assert [f.split(":")[0] for f in error.value.faults] == ["/World/Looks"] * 2


def test_a_y_up_scene_needs_the_turn_that_the_fault_names(scene_file, asset_here):
    with pytest.raises(SceneError, match="/World/A: .*upAxis is Z .*add rotateX = -90"):
        Scene.from_usd(scene_file(reference("A"), up="Y"))
    turned = reference("A", ops="double xformOp:rotateX = -90", order='"xformOp:rotateX"')
    pose = Scene.from_usd(scene_file(turned, up="Y")).node("/World/A").pose
    torch.testing.assert_close(pose.rotation, torch.eye(3, dtype=torch.float64))


def test_variants_and_payloads(scene_file, asset_here):
    body = """
    def Xform "Cabinet" (
        variants = { string set = "away" }
        prepend variantSets = "set"
    )
    {
        variantSet "set" = {
            "away" {
            }
            "here" (prepend payload = @./cabinet.usda@) {
            }
        }
    }"""
    path = scene_file(body)
    before = path.read_bytes()
    assert Scene.from_usd(path).nodes == ()
    scene = Scene.from_usd(path, variants={"/World/Cabinet": {"set": "here"}})
    assert [n.path for n in scene.nodes] == ["/World/Cabinet"]
    assert path.read_bytes() == before
    with pytest.raises(SceneError, match="/World/Cabinet: no variant set=gone"):
        Scene.from_usd(path, variants={"/World/Cabinet": {"set": "gone"}})
    with pytest.raises(SceneError, match="/World/None: no prim"):
        Scene.from_usd(path, variants={"/World/None": {"set": "here"}})


# radios and time


def test_radios(scene_file):
    body = """
    def Xform "AP"
    {
        custom token rfsg:radio:role = "tx"
        custom double rfsg:radio:powerDbm = 20
        custom double rfsg:radio:frequencyHz = 5.8e9
        custom token rfsg:radio:pattern = "tr38901"
        custom token rfsg:radio:polarization = "V"
        custom double3 rfsg:velocity = (0, 1.5, 0)
        double3 xformOp:translate = (100, 0, 250)
        double xformOp:rotateZ = 90
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
    }
    def Xform "Phone"
    {
        custom token rfsg:radio:role = "rx"
    }"""
    scene = Scene.from_usd(scene_file(body, metre=0.01))
    (tx,), (rx,) = scene.transmitters, scene.receivers
    assert (tx.power_dbm, tx.frequency, tx.pattern, tx.polarization) == (20, 5.8e9, "tr38901", "V")
    torch.testing.assert_close(tx.position, real(1.0, 0, 2.5))
    torch.testing.assert_close(tx.rotation @ real(1, 0, 0), real(0.0, 1, 0))
    torch.testing.assert_close(tx.velocity, real(0, 1.5, 0))  # m/s, whatever metersPerUnit
    assert (rx.path, rx.frequency, rx.pattern, rx.polarization) == (
        "/World/Phone", None, "isotropic", "none",
    )  # fmt: skip


def test_stage_frequency(scene_file):
    path = scene_file("custom double rfsg:frequencyHz = 2.44e9")
    assert Scene.from_usd(path).frequency == 2.44e9


MOVING = """
    def Xform "Cart"
    {
        double3 xformOp:translate.timeSamples = {
            0: (0, 0, 0),
            10: (0, 100, 0),
            20: (0, 400, 0)
        }
        uniform token[] xformOpOrder = ["xformOp:translate"]

        def Xform "Phone"
        {
            custom token rfsg:radio:role = "rx"
        }
    }"""


# 24 codes a second by default: 1 m in 10 codes is 2.4 m/s, 3 m in 10 codes 7.2 m/s
@pytest.mark.parametrize(
    "time, y, speed", [(None, 0.0, 2.4), (5, 0.5, 2.4), (10, 1.0, 4.8), (20, 4.0, 7.2), (30, 4, 0)]
)
def test_time_samples_give_place_and_velocity(scene_file, time, y, speed):
    (rx,) = Scene.from_usd(scene_file(MOVING, metre=0.01), time=time).receivers
    torch.testing.assert_close(rx.position, real(0, float(y), 0))
    torch.testing.assert_close(rx.velocity, real(0, float(speed), 0))


# the schema


def test_schema_is_registered_and_says_what_the_table_says():
    from pxr import Usd

    registry = Usd.SchemaRegistry()
    tables = {"NeuralObject": fields.NEURAL, "Material": fields.MATERIAL, "Radio": fields.RADIO}
    for name, table in tables.items():
        definition = registry.FindAppliedAPIPrimDefinition(f"Rfsg{name}API")
        assert set(definition.GetPropertyNames()) == {f.name for f in table}
        for item in table:
            attribute = definition.GetAttributeDefinition(item.name)
            assert attribute.GetTypeName() == usd.attributes.USD_TYPES[item.kind]
            assert attribute.GetFallbackValue() == item.fallback
            assert tuple(attribute.GetMetadata("allowedTokens") or ()) == item.tokens


def test_a_late_registration_is_said_once_and_scenes_are_read_all_the_same(scene_file):
    path = scene_file(cube())
    script = f"""
import warnings
from pxr import Usd
Usd.SchemaRegistry()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    from rfsg.scene.scene import Scene
    scene = Scene.from_usd({str(path)!r})
print(len(scene.nodes), [str(w.message)[:36] for w in caught])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == '1 ["rfsg\'s USD schema came too late: pxr"]', done.stderr
    assert done.stderr == ""


def test_a_package_is_read_like_files(scene_file, asset_here, tmp_path):
    from pxr import UsdUtils

    path = scene_file(reference("A", "instanceable = true") + reference("B"))
    package = tmp_path / "packed" / "scene.usdz"
    package.parent.mkdir()
    assert UsdUtils.CreateNewUsdzPackage(str(path), str(package))
    a, b = Scene.from_usd(package).nodes
    assert a.body is b.body and a.body.shape.kind == "neural"


def test_a_file_that_changed_is_read_as_it_is_now(scene_file):
    path = scene_file(cube())
    with pytest.raises(SceneError) as kept:  # holds the frames of the first read
        Scene.from_usd(scene_file('def PointInstancer "P" {}'))
    assert len(Scene.from_usd(scene_file(cube("A") + cube("B"))).nodes) == 2
    assert kept.value.faults and path.exists()


def test_device_is_followed(scene_file):
    scene = Scene.from_usd(scene_file(cube() + MOVING), device="cpu")
    tensors = [scene.nodes[0].pose.rotation, scene.receivers[0].position]
    assert all(t.device.type == "cpu" and t.dtype == torch.float64 for t in tensors)
    assert math.isfinite(float(scene.nodes[0].body.shape.half_size.sum()))
