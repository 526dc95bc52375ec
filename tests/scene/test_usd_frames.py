"""Units, axes, scales, mirrors and instances: the same thing, said otherwise, is the same thing."""

import numpy as np
import pytest
import torch

from rfsg.scene.scene import Node, Scene, SceneError
from tests.scene.scene_text import cube, known

FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))
TETRA = np.array([(0.0, 0, 0), (1, 0, 0), (0, 0.5, 0), (0, 0, 2)])


def real(*values):
    return torch.tensor(values, dtype=torch.float64)


def sdf_world(node: Node, point: torch.Tensor) -> torch.Tensor:
    """Distances [m] of world points: what a node is, however its frame was chosen."""
    return node.body.shape.sdf(node.pose.point_object(point)).detach() * node.pose.scale


def assert_same_things(one: Scene, other: Scene, atol: float = 1e-9) -> None:
    point = 4 * torch.rand(500, 3, dtype=torch.float64) - 1
    assert [n.path for n in one.nodes] == [n.path for n in other.nodes]
    for a, b in zip(one.nodes, other.nodes, strict=True):
        left, right = sdf_world(a, point), sdf_world(b, point)
        torch.testing.assert_close(left, right, rtol=0, atol=atol, msg=a.path)
        torch.testing.assert_close(a.velocity, b.velocity, rtol=0, atol=1e-12)
    for a, b in zip(one.receivers, other.receivers, strict=True):
        torch.testing.assert_close(a.position, b.position, rtol=0, atol=1e-12)
        torch.testing.assert_close(a.velocity, b.velocity, rtol=0, atol=1e-12)
        ahead = [r.rotation @ real(1, 0, 0) for r in (a, b)]
        torch.testing.assert_close(*ahead, rtol=0, atol=1e-12)


def said(metre: float, up: str) -> str:
    """One of each thing at the same places in the world, in a stage of these units and axes."""

    def stage(x: float, y: float, z: float) -> str:
        turned = (x, y, z) if up == "Z" else (x, z, -y)
        return str(tuple(v / metre for v in turned))

    def sides(x: float, y: float, z: float) -> str:
        return str((x, y, z) if up == "Z" else (x, z, y))

    def at(*place: float) -> str:
        return f"double3 xformOp:translate = {stage(*place)}"

    turn = f"double xformOp:rotateX = {0 if up == 'Z' else -90}"
    order = 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]'
    ops = ("translate", "rotateX:unitsResolve", "scale:unitsResolve")
    resolve = ", ".join(f'"xformOp:{op}"' for op in ops)
    metal = 'custom token rfsg:material:model = "conductor"'
    return f"""
    def Cube "Box"
    {{
        {metal}
        double size = {2 / metre}
        {at(1, 2, 0.5)}
        double3 xformOp:scale = {sides(0.5, 0.25, 1)}
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }}
    def Sphere "Ball"
    {{
        {metal}
        double radius = {0.3 / metre}
        {at(0, 1, 2)}
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Cylinder "Post"
    {{
        {metal}
        double radius = {0.2 / metre}
        double height = {1.5 / metre}
        uniform token axis = "{up}"
        {at(2, 0, 1)}
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Capsule "Pill"
    {{
        {metal}
        double radius = {0.2 / metre}
        double height = {1.5 / metre}
        uniform token axis = "X"
        {at(2, 2, 2)}
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Mesh "Tetra"
    {{
        {metal}
        point3f[] points = [{", ".join(stage(*p) for p in TETRA.tolist())}]
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = {[i for face in FACES for i in face]}
        {at(0.5, 0, 0)}
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Xform "Ground"
    {{
        custom token rfsg:shape = "halfspace"
        {metal}
        {at(0, 0, -0.5)}
        {turn}
        {order}
    }}
    def Xform "Cabinet" (
        prepend references = @./cabinet.usda@
    )
    {{
        custom double3 rfsg:velocity = {(1, 2, 3) if up == "Z" else (1, 3, -2)}
        {at(1.5, 0.5, 0)}
        double xformOp:rotateX:unitsResolve = {0 if up == "Z" else -90}
        double3 xformOp:scale:unitsResolve = ({1 / metre}, {1 / metre}, {1 / metre})
        uniform token[] xformOpOrder = [{resolve}]
    }}
    def Xform "Phone"
    {{
        custom token rfsg:radio:role = "rx"
        custom double3 rfsg:velocity = {(1, 2, 3) if up == "Z" else (1, 3, -2)}
        {at(1, 1, 1)}
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
"""


@pytest.mark.parametrize("metre", [0.01, 0.0254, 1000.0])
def test_units_do_not_change_what_is_said(scene_file, asset_here, metre):
    one = Scene.from_usd(scene_file(said(1.0, "Z")))
    other = Scene.from_usd(scene_file(said(metre, "Z"), metre=metre, name="other.usda"))
    assert_same_things(one, other, atol=1e-6)  # a mesh's points are single precision
    assert all(float(n.pose.scale) == pytest.approx(1.0, abs=1e-12) for n in other.nodes)


def test_axes_do_not_change_what_is_said(scene_file, asset_here):
    one = Scene.from_usd(scene_file(said(1.0, "Z")))
    other = Scene.from_usd(scene_file(said(1.0, "Y"), up="Y", name="other.usda"))
    assert_same_things(one, other, atol=1e-12)


def test_units_and_axes_together(scene_file, asset_here):
    one = Scene.from_usd(scene_file(said(1.0, "Z")))
    other = Scene.from_usd(scene_file(said(0.01, "Y"), 0.01, "Y", "other.usda"))
    assert_same_things(one, other, atol=1e-6)


# across references


def place(ops: dict[str, object], how: str = "references") -> str:
    kinds = {"scale": "double3", "rotateX": "double", "rotateY": "double", "translate": "double3"}
    lines = "\n".join(f"{kinds[k.split(':')[0]]} xformOp:{k} = {v}" for k, v in ops.items())
    order = ", ".join(f'"xformOp:{k}"' for k in ops)
    return f"""
    def Xform "A" (
        prepend {how} = @./cabinet.usda@
    )
    {{
        {lines}
        uniform token[] xformOpOrder = [{order}]
    }}"""


@pytest.mark.parametrize("how", ["references", "payload"])
def test_units_of_what_is_brought_in_are_compared(scene_file, asset_here, how):
    path = scene_file(place({"scale": (1, 1, 1)}, how), metre=0.01)
    with pytest.raises(SceneError, match="/World/A: .*metersPerUnit is 1 .*add the scale 100 "):
        Scene.from_usd(path)


def test_ops_that_resolve_units_leave_the_scale_to_the_object(scene_file, asset_here):
    """What converts is told from what scales, which a single scale of 50 could not be."""
    ops = {"scale": (0.5, 0.5, 0.5), "scale:unitsResolve": (100, 100, 100)}
    pose = Scene.from_usd(scene_file(place(ops), metre=0.01)).node("/World/A").pose
    assert float(pose.scale) == pytest.approx(0.5, abs=1e-15)
    wrong = {"scale": (0.5, 0.5, 0.5), "scale:unitsResolve": (10, 10, 10)}
    with pytest.raises(SceneError, match="add the scale 100"):
        Scene.from_usd(scene_file(place(wrong), metre=0.01))


def test_ops_that_resolve_axes_leave_the_turn_to_the_object(scene_file, asset_here):
    """A cabinet that lies on its side in a y-up scene: its up is not the scene's, and need not be."""
    ops = {"rotateX": 90, "rotateX:unitsResolve": -90}
    pose = Scene.from_usd(scene_file(place(ops), up="Y")).node("/World/A").pose
    # z of the object is turned back from the stage's y to its z, which points to -y in the world
    torch.testing.assert_close(pose.direction_world(real(0, 0, 1)), real(0.0, -1, 0))
    with pytest.raises(SceneError, match="add rotateX = -90"):
        Scene.from_usd(scene_file(place({"rotateX": 0}), up="Y"))
    with pytest.raises(SceneError, match="add rotateX = -90"):
        Scene.from_usd(scene_file(place(ops | {"rotateX:unitsResolve": 90}), up="Y"))


def test_a_sublayer_of_other_units_or_axes_is_a_warning(scene_file, tmp_path):
    walls = scene_file(cube(), metre=0.01, up="Y", name="walls.usda")
    top = tmp_path / "top.usda"
    head = 'metersPerUnit = 1\n upAxis = "Z"\n defaultPrim = "World"'
    top.write_text(f"#usda 1.0\n(\n {head}\n subLayers = [@./{walls.name}@]\n)\n")
    warnings = Scene.from_usd(top).warnings
    assert any("metersPerUnit is 0.01 (here 1)" in w and "walls.usda" in w for w in warnings)
    assert any("upAxis is Y (here Z)" in w for w in warnings)
    walls.write_text(
        walls.read_text().replace("metersPerUnit = 0.01", "").replace('upAxis = "Y"', "")
    )
    assert Scene.from_usd(top).warnings == ()


# scales


def test_a_mesh_absorbs_an_uneven_scale(scene_file):
    text = f"""
    def Mesh "Tetra"
    {{
        custom token rfsg:material:model = "conductor"
        point3f[] points = {[tuple(p) for p in TETRA.tolist()]}
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = {[i for face in FACES for i in face]}
        double xformOp:rotateZ = 40
        double3 xformOp:scale = (2, 3, 0.5)
        uniform token[] xformOpOrder = ["xformOp:rotateZ", "xformOp:scale"]
    }}"""
    node = Scene.from_usd(scene_file(text)).node("/World/Tetra")
    assert float(node.pose.scale) == 1.0
    turn = np.radians(40)
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    expected = torch.from_numpy((TETRA * [2, 3, 0.5]) @ rotation.T)
    corners = node.pose.point_world(node.body.shape.vertices)
    apart = torch.cdist(corners.detach(), expected)  # in whatever order
    assert float(apart.amin(0).max()) < 1e-12 and float(apart.amin(1).max()) < 1e-12
    torch.testing.assert_close(
        sdf_world(node, expected), torch.zeros(4).double(), atol=1e-12, rtol=0
    )


def test_a_neural_object_is_stretched_by_an_uneven_scale_with_one_warning(
    scene_file, asset_here, small_asset
):
    scene = Scene.from_usd(scene_file(place({"scale": (1, 2, -4)})))
    (said,) = [w for w in scene.warnings if "scaled unevenly" in w]
    assert "/World/A by 1, 2, 4" in said
    node = scene.node("/World/A")
    point = torch.rand(50, 3, dtype=torch.float64)
    expected = small_asset[0].shape.sdf(point).detach()  # the least scale is 1
    stretch = real(1, 2, -4)
    torch.testing.assert_close(sdf_world(node, stretch * point), expected, rtol=0, atol=1e-12)


def test_a_stretched_object_is_written_and_edited_as_what_it_is(scene_file, asset_here, tmp_path):
    scene = Scene.from_usd(scene_file(place({"scale": (1, 2, 4)})))
    scene.to_usd(tmp_path / "again.usda")
    again = Scene.from_usd(tmp_path / "again.usda")
    assert_same_things(scene, again)
    assert again.node("/World/A").body.shape.kind == "stretched"
    moved = scene.moved("/World/A", (0.5, 0.0, 0.0), yaw_deg=30)
    moved.save_edits(tmp_path / "edits.usda")
    assert_same_things(moved, Scene.from_usd(tmp_path / "edits.usda"))
    file = scene.export("/World/A", tmp_path / "alone")
    alone = Scene.from_usd(
        scene_file(f"""def "B" (references = @{file.relative_to(tmp_path)}@) {{}}""")
    )
    assert alone.node("/World/B").body.shape.kind == "neural"  # in its own frame, as it was learned


def test_a_neural_object_keeps_its_distances_under_an_even_scale(
    scene_file, asset_here, small_asset
):
    node = Scene.from_usd(scene_file(place({"scale": (3, 3, 3)}))).node("/World/A")
    point = torch.rand(50, 3, dtype=torch.float64)
    expected = 3 * small_asset[0].shape.sdf(point).detach()
    torch.testing.assert_close(sdf_world(node, 3 * point), expected, rtol=0, atol=1e-12)


def test_a_half_space_is_the_same_at_any_scale(scene_file):
    text = """
    def Xform "Ground"
    {
        custom token rfsg:shape = "halfspace"
        custom token rfsg:material:model = "conductor"
        double xformOp:rotateX = 30
        double3 xformOp:scale = (2, 2, 2)
        uniform token[] xformOpOrder = ["xformOp:rotateX", "xformOp:scale"]
    }"""
    scaled = Scene.from_usd(scene_file(text)).node("/World/Ground")
    plain = Scene.from_usd(scene_file(text.replace("(2, 2, 2)", "(1, 1, 1)"))).node("/World/Ground")
    point = torch.rand(50, 3, dtype=torch.float64)
    torch.testing.assert_close(sdf_world(scaled, point), sdf_world(plain, point))


@pytest.mark.parametrize("kind", ["Sphere", "Cylinder", "Capsule", "Cube"])
def test_a_scale_of_nothing_is_refused(scene_file, kind):
    path = scene_file(known(kind, "double3 xformOp:scale = (1, 0, 1)", '"xformOp:scale"'))
    with pytest.raises(SceneError, match="/World/Thing: the transform is singular"):
        Scene.from_usd(path)


# mirrors


@pytest.mark.parametrize("axes", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1), (-1, -1, 1)])
def test_a_mirrored_neural_object_is_its_mirror_image(scene_file, asset_here, small_asset, axes):
    node = Scene.from_usd(scene_file(place({"scale": axes}))).node("/World/A")
    assert float(torch.det(node.pose.rotation)) == pytest.approx(float(np.prod(axes)))
    assert float(node.pose.scale) == 1.0
    point = torch.rand(50, 3, dtype=torch.float64)
    expected = small_asset[0].shape.sdf(point).detach()
    torch.testing.assert_close(sdf_world(node, point * real(*axes)), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["Cube", "Cylinder", "Capsule", "Sphere"])
def test_a_known_shape_is_its_own_mirror_image_about_its_middle(scene_file, kind):
    sizes = "" if kind == "Cube" else "double radius = 0.5"
    ops = '"xformOp:translate", "xformOp:scale"'
    text = f"{sizes}\n double3 xformOp:translate = (1, 1, 1)\n double3 xformOp:scale = (-1, 1, 1)"
    mirrored = Scene.from_usd(scene_file(known(kind, text, ops))).node("/World/Thing")
    text = text.replace("(-1, 1, 1)", "(1, 1, 1)")
    plain = Scene.from_usd(scene_file(known(kind, text, ops))).node("/World/Thing")
    assert float(torch.det(mirrored.pose.rotation)) == pytest.approx(-1.0)
    point = 3 * torch.rand(100, 3, dtype=torch.float64)
    torch.testing.assert_close(sdf_world(mirrored, point), sdf_world(plain, point))


def test_normals_of_a_mirrored_object_point_outward(scene_file, asset_here):
    from rfsg.scene.world import World

    scene = Scene.from_usd(scene_file(place({"scale": (-2, 2, 2)})))
    world, which = World(scene), torch.zeros(40, dtype=torch.int64)
    point = torch.rand(40, 3, dtype=torch.float64) * real(-0.6, 0.4, 2)
    normal = world.normal(which, point)
    step = 1e-6
    rise = (world.sdf(which, point + step * normal) - world.sdf(which, point)).detach()
    slope = world.value_and_gradient(which, point)[1].norm(dim=-1).detach()
    torch.testing.assert_close(rise / step, slope, rtol=1e-3, atol=1e-6)
    assert bool((rise > 0).all())


# instances

ROOM = """#usda 1.0
(
    defaultPrim = "Room"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "Room"
{
    def Xform "Left" (
        prepend references = @./cabinet.usda@
        instanceable = true
    )
    {
        double3 xformOp:translate = (0, 1, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Sphere "Lamp"
    {
        custom token rfsg:material:model = "conductor"
        double radius = 0.25
        double3 xformOp:translate = (0, 0, 2)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Xform "Phone"
    {
        custom token rfsg:radio:role = "rx"
        double3 xformOp:translate = (0, 0, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""


def rooms(text: str = "") -> str:
    room = """
    def Xform "{name}" (
        prepend references = @./room.usda@
        instanceable = true
    )
    {{
        double3 xformOp:translate = ({x}, 0, 0)
        double3 xformOp:scale = ({mirror}, 1, 1)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        {text}
    }}"""
    first = room.format(name="First", x=1, mirror=1, text="")
    return first + room.format(name="Second", x=5, mirror=-1, text=text)


@pytest.fixture
def room_here(asset_here):
    (asset_here.parent / "room.usda").write_text(ROOM)


def test_instances_within_instances_share_bodies_and_have_their_own_places(scene_file, room_here):
    scene = Scene.from_usd(scene_file(rooms()))
    assert [n.path for n in scene.nodes] == [
        f"/World/{room}/{name}" for room in ("First", "Second") for name in ("Left", "Lamp")
    ]
    for name in ("Left", "Lamp"):
        one, other = scene.node(f"/World/First/{name}"), scene.node(f"/World/Second/{name}")
        assert one.body is other.body
        torch.testing.assert_close(
            other.pose.translation - one.pose.translation, real(4, 0, 0), rtol=0, atol=1e-15
        )
    assert float(torch.det(scene.node("/World/Second/Left").pose.rotation)) == pytest.approx(-1)
    assert [r.path for r in scene.receivers] == ["/World/First/Phone", "/World/Second/Phone"]
    assert [float(r.position[0]) for r in scene.receivers] == [1.0, 5.0]


def test_the_root_of_an_instance_may_say_more_and_still_shares_the_shape(scene_file, asset_here):
    body = "".join(
        f"""
    def Xform "{name}" (
        prepend references = @./cabinet.usda@
        instanceable = true
    )
    {{
        {extra}
    }}"""
        for name, extra in (
            ("A", ""),
            ("B", "custom double3 rfsg:velocity = (1, 0, 0)"),
            ("C", 'custom token rfsg:material:model = "conductor"'),
        )
    )
    a, b, c = Scene.from_usd(scene_file(body)).nodes
    assert a.body is b.body and b.velocity.tolist() == [1, 0, 0]
    assert c.body.shape is a.body.shape and c.body is not a.body


def test_what_lies_in_an_instance_is_edited_alone(scene_file, room_here):
    path = scene_file(rooms())
    scene = Scene.from_usd(path).moved("/World/Second/Lamp", (0, 0, -1))
    scene = scene.without("/World/First/Left").moved("/World/Second/Phone", (0, 0, 1))
    read = Scene.from_usd(scene.save_edits(path.with_name("edits.usda")))
    assert {n.path for n in read.nodes} == {n.path for n in scene.nodes}
    for node in read.nodes:
        expected = scene.node(node.path).pose
        torch.testing.assert_close(node.pose.translation, expected.translation, rtol=0, atol=1e-12)
        torch.testing.assert_close(node.pose.rotation, expected.rotation, rtol=0, atol=1e-12)
    assert [float(r.position[2]) for r in read.receivers] == [1.0, 2.0]
