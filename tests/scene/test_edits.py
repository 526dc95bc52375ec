"""Edits: new scenes that share what did not change, kept as a layer over a source that stays."""

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.assets import load_asset, save_asset
from rfsg.scene.materials import material_of
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError, merged
from rfsg.scene.usd.kept import alike
from rfsg.scene.weights import same_bits
from tests.scene.scene_text import cube

RADIOS = """
    def Xform "Radios"
    {
        custom double3 rfsg:velocity = (0, 0, 0)
        def Xform "AP"
        {
            custom token rfsg:radio:role = "tx"
            custom double rfsg:radio:powerDbm = 20
            double3 xformOp:translate = (-3, -2, 1)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
        def Xform "rx"
        {
            custom token rfsg:radio:role = "rx"
            double3 xformOp:translate = (3, -2, 1)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
    }
"""


def reference(name, ops="", order="", extra="", inside=""):
    return f"""
    def Xform "{name}" (
        prepend references = @./cabinet.usda@
        {extra}
    )
    {{
        {ops}
        uniform token[] xformOpOrder = [{order}]
        {inside}
    }}
"""


WALL = cube(
    ops="double3 xformOp:translate = (0, 2, 1)\n        double3 xformOp:scale = (3, 0.1, 1.5)",
    order='"xformOp:translate", "xformOp:scale"',
)


@pytest.fixture
def lab(scene_file, asset_here):
    """A wall, two cabinets (one an instance with a phone on it), a transmitter and a receiver."""
    phone = """
        def Xform "Phone"
        {
            custom token rfsg:radio:role = "rx"
            double3 xformOp:translate = (0, 0, 1.1)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }"""
    at = "double3 xformOp:translate = (1, 0, 0)\n double xformOp:rotateZ = 30"
    body = WALL + reference("A", at, '"xformOp:translate", "xformOp:rotateZ"', inside=phone)
    return scene_file(body + reference("B", extra="instanceable = true") + RADIOS)


def assert_equal(read: Scene, meant: Scene, atol: float = 1e-12) -> None:
    """The same things, whatever their order: poses to 1e-12, weights and materials to the bit."""
    things = [{t.path: t for t in (*s.nodes, *s.transmitters, *s.receivers)} for s in (read, meant)]
    assert things[0].keys() == things[1].keys()
    assert read.frequency == meant.frequency
    for path, one in things[0].items():
        other = things[1][path]
        pairs = [(one.velocity, other.velocity)]
        if isinstance(one, Node):
            pairs += [(getattr(one.pose, k), getattr(other.pose, k)) for k in vars(one.pose)]
            assert same_material(one.body.surface, other.body.surface), path
            if one.body.shape.kind == "neural":
                assert same_bits(one.body.shape, other.body.shape), path
            left, right = one.body.shape.parameters(), other.body.shape.parameters()
            pairs += list(zip(left, right, strict=True))
        else:
            pairs += [(one.position, other.position), (one.rotation, other.rotation)]
        for a, b in pairs:
            torch.testing.assert_close(a, b, rtol=0, atol=atol, msg=path)


def same_material(one, other) -> bool:
    """To the bit; but a wall is as thick as its side, which a turn may round."""
    left, right = material_of(one), material_of(other)
    if left is None or right is None or left.thickness is None:
        return same_bits(one, other)
    assert left.thickness == pytest.approx(right.thickness, rel=1e-12)
    return replace(left, thickness=right.thickness) == right


def digests(folder: Path) -> dict[str, str]:
    """sha256 of every file."""
    files = (f for f in folder.rglob("*") if f.is_file())
    return {str(f): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


# values


def test_what_stands_below_a_path_goes_where_it_goes(lab):
    scene = Scene.from_usd(lab)
    cabinet, phone = scene.node("/World/A").pose, scene.receivers[0]
    assert phone.path == "/World/A/Phone"
    moved = scene.moved("/World/A", (1, 2, 0), yaw_deg=90)
    seen = [pose.point_object(place) for pose, place in (
        (cabinet, phone.position), (moved.node("/World/A").pose, moved.receivers[0].position)
    )]  # fmt: skip
    torch.testing.assert_close(seen[0], seen[1], rtol=0, atol=1e-14)
    assert moved.node("/World/Wall") is scene.node("/World/Wall")
    gone = scene.without("/World/A")
    assert [n.path for n in gone.nodes] == ["/World/Wall", "/World/B"]
    assert [r.path for r in gone.receivers] == ["/World/Radios/rx"]


def test_radios_and_groups_move_and_go_too(lab):
    scene = Scene.from_usd(lab)
    moved = scene.moved("/World/Radios", (0, 0, 0.5)).moved("/World/Radios/AP", to=(0, 0, 2))
    assert moved.transmitters[0].position.tolist() == [0, 0, 2]
    assert moved.receivers[1].position.tolist() == [3, -2, 1.5]
    assert scene.without("/World/Radios").transmitters == ()
    with pytest.raises(SceneError, match="/World/Radios: a group has no place of its own"):
        scene.moved("/World/Radios", yaw_deg=10)


@pytest.mark.parametrize("path", ["/World/Wal", "/World/A/", "World/A", "/World/A/Pho", ""])
def test_a_path_with_nothing_is_told_with_what_there_is(lab, path):
    scene = Scene.from_usd(lab)
    with pytest.raises(
        SceneError, match=f"^{path}: nothing at this path; the scene has .*/World/A"
    ):
        scene.moved(path, (1, 0, 0))
    with pytest.raises(
        SceneError, match=f"^{path}: nothing at this path; the scene has .*/World/A"
    ):
        scene.without(path)
    with pytest.raises(
        SceneError, match=f"^{path}: no object at this path; the scene has .*/World/A"
    ):
        scene.replaced(path, Body(Sphere(1.0), Conductor()))


def test_added_objects_share_the_body_of_their_asset(lab, asset_here, small_asset):
    scene = Scene.from_usd(lab)
    two = scene.added(asset_here, "/World/C", at=(1, 2, 3), yaw_deg=90)
    two = two.added(load_asset(asset_here), "/World/New/D", pose=Pose.at(4, 5, 6))
    assert two.node("/World/C").body is two.node("/World/New/D").body is scene.node("/World/A").body
    assert two.node("/World/C").pose.point_world(torch.tensor([1.0, 0, 0]).double()).tolist() == (
        pytest.approx([1, 3, 3])
    )
    with pytest.raises(SceneError, match="/World/A: is taken"):
        scene.added(asset_here, "/World/A")
    for wrong in ("World/C", "/World/no good", "/World//C", "/World/1", ""):
        with pytest.raises(SceneError, match="no path of a prim"):
            scene.added(asset_here, wrong)
    with pytest.raises(SceneError, match="place: expected three finite numbers"):
        scene.added(asset_here, "/World/C", at=(1, 2))


@pytest.mark.parametrize("said, wrong", [("= 1\n", "= 0.01\n"), ('"Z"', '"Y"')])
def test_an_asset_of_other_units_or_axes_is_not_put_into_a_scene(lab, asset_here, said, wrong):
    scene, far = Scene.from_usd(lab), asset_here.with_name("far.usda")
    far.write_text(asset_here.read_text().replace(said, wrong, 1))
    with pytest.raises(SceneError, match="far.usda: metersPerUnit is .* expected 1 and Z"):
        scene.replaced("/World/A", far)
    with pytest.raises(SceneError, match="far.usda: metersPerUnit is .* expected 1 and Z"):
        scene.added(load_asset(far), "/World/New")


def test_merging_is_as_a_stronger_layer_lies_over_a_weaker():
    def node(path, x=0.0, body=None):
        return Node(path, body or ball, Pose.at(x, 0, 0))

    ball, box = Body(Sphere(1.0), Conductor()), Body(Box((1.0, 1.0, 1.0)), Conductor())
    old = Scene((node("/a"), node("/b"), node("/c"), node("/d")), frequency=1e9)
    mine = old.moved("/a", (1, 0, 0)).without("/b").replaced("/c", box).added(ball, "/mine")
    moved_b = [node("/a", 7, box), node("/b", 7), node("/c", 7), node("/e")]
    new = Scene(tuple(moved_b), frequency=2e9)
    found = merged(mine, old, new)
    assert [n.path for n in found.nodes] == ["/a", "/c", "/e", "/mine"]
    a, c = found.node("/a"), found.node("/c")
    assert (a.pose, a.body) == (mine.node("/a").pose, box)  # my place, its new body
    assert (float(c.pose.translation[0]), c.body) == (7.0, box)  # its new place, my body
    assert found.frequency == 2e9
    assert merged(old, old, new) == new


def test_variants_are_chosen_and_edits_stay(scene_file, asset_here):
    door = """
    def Xform "Door" (
        variants = { string state = "away" }
        prepend variantSets = "state"
    )
    {
        variantSet "state" = {
            "away" {
            }
            "here" (prepend payload = @./cabinet.usda@) {
            }
        }
    }"""
    path = scene_file(WALL + door + reference("B") + RADIOS)
    before = digests(path.parent)
    scene = Scene.from_usd(path).moved("/World/Wall", (0, 1, 0))
    here = scene.with_variant("/World/Door", "state", "here")
    assert [n.path for n in here.nodes] == ["/World/Wall", "/World/Door", "/World/B"]
    assert here.node("/World/Wall") == scene.node("/World/Wall")  # moved, and the same body
    assert (
        here.node("/World/Door").body is here.node("/World/B").body is scene.node("/World/B").body
    )
    away = here.with_variant("/World/Door", "state", "away")
    assert [n.path for n in away.nodes] == [n.path for n in scene.nodes]
    saved = here.save_edits(path.with_name("edits.usda"))
    assert_equal(Scene.from_usd(saved), here)
    saved.unlink()
    assert digests(path.parent) == before
    with pytest.raises(SceneError, match="/World/Door: no variant state=gone; it has .*'here'"):
        scene.with_variant("/World/Door", "state", "gone")
    with pytest.raises(SceneError, match="/World/Nowhere: no prim"):
        scene.with_variant("/World/Nowhere", "state", "here")
    with pytest.raises(SceneError, match="state=here: this scene was made in Python"):
        Scene().with_variant("/World/Door", "state", "here")


# the layer


def everything(scene: Scene, asset: Path) -> Scene:
    """One edit of each kind."""
    tx = scene.transmitters[0]
    scene = scene.moved("/World/Wall", (0.25, 0, 0), yaw_deg=20).moved("/World/A", (0.3, 0, 0))
    scene = scene.without("/World/B").added(asset, "/World/New/C", at=(-1, 0.5, 0), yaw_deg=-45)
    scene = scene.added(Body(Sphere(0.2), Conductor()), "/World/Ball", at=(0, -1, 1))
    scene = scene.moved("/World/Radios/AP", (0, 0, 0.5))
    loud = Radio(tx.path, tx.position + 0.5, tx.rotation, tx.velocity, 30.0, None, "tr38901", "V")
    return scene.with_transmitters([loud]).with_receivers(
        [*scene.receivers, Radio.at("/World/Radios/rx_2", 1, -2, 1.5, yaw_deg=30)]
    )


def test_edits_are_read_back_and_sources_stay(lab, asset_here):
    before = digests(lab.parent)
    scene = everything(Scene.from_usd(lab), asset_here)
    saved = scene.save_edits(lab.with_name("edits.usda"))
    assert saved == lab.with_name("edits.usda")
    after = digests(lab.parent)
    assert {name: after[name] for name in before} == before
    assert_equal(Scene.from_usd(saved), scene)
    text = saved.read_text()
    assert "@./scene.usda@" in text and "active = false" in text and str(lab.parent) not in text
    assert "metersPerUnit = 1" in text and 'upAxis = "Z"' in text


def test_edits_of_edits_lie_over_edits(lab, asset_here):
    first = everything(Scene.from_usd(lab), asset_here).save_edits(lab.with_name("first.usda"))
    before = digests(lab.parent)
    scene = Scene.from_usd(first).moved("/World/New/C", (1, 0, 0)).without("/World/Ball")
    scene = scene.moved("/World/Wall", (0, 0, 0.1))
    second = scene.save_edits(lab.with_name("second.usda"))
    assert_equal(Scene.from_usd(second), scene)
    after = digests(lab.parent)
    assert {name: after[name] for name in before} == before


def test_the_channel_of_the_edits_is_that_of_the_scene(lab, asset_here):
    from rfsg.tracer.plan import Quality
    from rfsg.tracer.simulate import simulate

    scene = Scene.from_usd(lab).without("/World/A").without("/World/B")
    scene = scene.moved("/World/Wall", (0.25, 0, 0), yaw_deg=20)
    scene = scene.added(Body(Sphere(0.2), Conductor()), "/World/Ball", at=(0, -1, 1))
    read = Scene.from_usd(scene.save_edits(lab.with_name("edits.usda")))
    one, other = (
        simulate(s, torch.tensor([2.4e9], dtype=torch.float64), Quality.named("draft"))
        for s in (scene, read)
    )
    assert len(one.channel.gain) > 1
    torch.testing.assert_close(one.channel.gain, other.channel.gain, rtol=1e-9, atol=0)
    torch.testing.assert_close(one.channel.delay, other.channel.delay, rtol=1e-12, atol=0)


def swap_for_asset(scene, path, asset):
    return scene.replaced(path, asset)


def swap_for_box(scene, path, asset):
    return scene.replaced(path, Body(Box((0.3, 0.2, 0.1)), Conductor()))


def cover(scene, path, asset):
    return scene.replaced(path, Body(scene.node(path).body.shape, Slab(0.03, itu="wood")))


def forget_the_material(scene, path, asset):
    return scene.replaced(path, Body(scene.node(path).body.shape, StochasticSurface()))


OWN = 'custom token rfsg:material:model = "slab"\n custom token rfsg:material:itu = "glass"'
OWN += "\n custom double rfsg:material:thickness = 0.01"
SHEET = """
    def Mesh "It" (
        customData = {
            dictionary rfsg = {
                bool sheet = true
            }
        }
    )
    {
        custom token rfsg:material:model = "conductor"
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
    }"""
STANDING = {
    "sheet": (SHEET, ""),
    "cube": (cube("It", "double3 xformOp:translate = (1, 2, 3)", '"xformOp:translate"'), ""),
    "cube with attributes": (f'def Cube "It" {{\n {OWN}\n double size = 0.5\n}}\n', ""),
    "cube bound for radio": (cube("It", extra="rel material:binding:radio = </World/Metal>"), ""),
    "reference": (reference("It"), ""),
    "instance": (reference("It", extra="instanceable = true"), ""),
    "covered reference": (
        reference("It", extra='prepend apiSchemas = ["MaterialBindingAPI"]',
                  inside="rel material:binding = </World/Metal>"), ""),
    "payload": (reference("It").replace("references", "payload"), ""),
    "in a variant": ("""
    def Xform "It" (
        variants = { string set = "one" }
        prepend variantSets = "set"
    )
    {
        variantSet "set" = {
            "one" (prepend references = @./cabinet.usda@) {
            }
        }
    }""", ""),
    "below a bound ancestor": (f"""
    def Xform "Group" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        rel material:binding = </World/Concrete>
        {cube("It")}
    }}""", "/Group"),
    "inside an instance": ("""
    def Xform "Group" (
        prepend references = @./group.usda@
        instanceable = true
    )
    {
    }
    def Xform "Other" (
        prepend references = @./group.usda@
        instanceable = true
    )
    {
    }""", "/Group"),
}  # fmt: skip
GROUP = """#usda 1.0
(
    defaultPrim = "Group"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "Group"
{
    def Sphere "It"
    {
        custom token rfsg:material:model = "conductor"
        double radius = 0.25
    }
}
"""


@pytest.mark.parametrize("swap", [swap_for_asset, swap_for_box, cover, forget_the_material])
@pytest.mark.parametrize("standing", STANDING)
def test_whatever_stood_there_is_swapped_whole(scene_file, asset_here, standing, swap):
    (asset_here.parent / "group.usda").write_text(GROUP)
    changed = load_asset(asset_here).body
    with torch.no_grad():
        next(changed.shape.parameters()).add_(0.1)
    other = save_asset(asset_here.with_name("other.usda"), changed)
    body, group = STANDING[standing]
    path = scene_file(body)
    before = digests(path.parent)
    scene = swap(Scene.from_usd(path), f"/World{group}/It", other)
    read = Scene.from_usd(scene.save_edits(path.with_name("edits.usda")))
    assert_equal(read, scene)
    after = digests(path.parent)
    assert {name: after[name] for name in before} == before


def test_packages_are_sources_and_assets_like_files(lab, asset_here, tmp_path):
    from pxr import UsdUtils

    scene, cabinet = tmp_path / "packed" / "scene.usdz", tmp_path / "packed" / "cabinet.usdz"
    scene.parent.mkdir()
    for file, package in ((lab, scene), (asset_here, cabinet)):
        assert UsdUtils.CreateNewUsdzPackage(str(file), str(package))
    screen = Body(Box((0.5, 0.1, 1.0)), Conductor())
    before = digests(scene.parent)
    edited = (
        Scene.from_usd(scene)
        .replaced("/World/B", screen)
        .replaced("/World/Wall", cabinet)
        .moved("/World/A", (1, 0, 0))
    )
    edited = edited.added(cabinet, "/World/C", at=(0, -2, 0)).without("/World/Radios/rx")
    saved = edited.save_edits(scene.with_name("edits.usda"))
    assert "@./scene.usdz@" in saved.read_text() and "@./cabinet.usdz@" in saved.read_text()
    assert_equal(Scene.from_usd(saved), edited)
    after = digests(scene.parent)
    assert {name: after[name] for name in before} == before


def test_one_new_material_is_one_surface_for_all_it_covers(lab):
    scene, wood = Scene.from_usd(lab), Slab(0.03, itu="wood")
    for path in ("/World/Wall", "/World/A"):
        scene = scene.replaced(path, Body(scene.node(path).body.shape, wood))
    read = Scene.from_usd(scene.save_edits(lab.with_name("edits.usda")))
    assert read.node("/World/Wall").body.surface is read.node("/World/A").body.surface
    assert not list(lab.parent.glob("edits_assets/*"))


@pytest.mark.parametrize("metre, up", [(0.01, "Z"), (1, "Y"), (0.01, "Y"), (0.0254, "Z")])
def test_edits_in_a_stage_of_other_units_and_axes(scene_file, asset_here, metre, up):
    turn = f"double xformOp:rotateX = {-90 if up == 'Y' else 0}"
    ops = f"{turn}\n double3 xformOp:scale = ({1 / metre}, {1 / metre}, {1 / metre})"
    order = '"xformOp:rotateX", "xformOp:scale"'
    path = scene_file(WALL + reference("A", ops, order) + RADIOS, metre=metre, up=up)
    scene = Scene.from_usd(path)
    tilted, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
    lying = Pose(tilted, torch.tensor([1.0, 2, 3]).double(), torch.tensor(0.5).double())
    scene = scene.moved("/World/A", pose=lying).added(asset_here, "/World/C", at=(1, 2, 3))
    scene = scene.moved("/World/Wall", (1, 2, 3), yaw_deg=10).moved("/World/Radios/AP", (0, 0, 1))
    scene = scene.added(asset_here, "/World/Wall/Shelf", pose=lying)
    saved = scene.save_edits(path.with_name("edits.usda"))
    assert_equal(Scene.from_usd(saved), scene)
    assert scene.node("/World/C").pose.translation.tolist() == [1, 2, 3]


def test_what_moves_keeps_its_velocity_and_its_start(scene_file):
    cart = """
    def Xform "Cart"
    {
        double3 xformOp:translate.timeSamples = {
            10: (0, 0, 0),
            20: (0, 1, 0)
        }
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def Xform "Phone"
        {
            custom token rfsg:radio:role = "rx"
        }
    }"""
    path = scene_file(cart, up="Y")
    path.write_text(path.read_text().replace('upAxis = "Y"', 'upAxis = "Y"\n    startTimeCode = 15'
                                             "\n    endTimeCode = 20\n    timeCodesPerSecond = 10"))  # fmt: skip
    scene = Scene.from_usd(path).moved("/World/Cart/Phone", (3, 0, 0))
    assert scene.receivers[0].velocity.tolist() == [0, 0, 1]  # 1 m in 10 codes is 1 m/s, up
    assert scene.receivers[0].position.tolist() == [3, 0, 0.5]
    assert_equal(Scene.from_usd(scene.save_edits(path.with_name("edits.usda"))), scene)


def random_edit(scene: Scene, asset: Path) -> Scene:
    """Any edit of anything, to any place, size and hand."""
    frame, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
    scale = 0.5 + torch.rand((), dtype=torch.float64)
    pose = Pose(frame, torch.randn(3, dtype=torch.float64), scale)
    paths = [n.path for n in scene.nodes]
    path = paths[int(torch.randint(len(paths), ()))]
    name = f"/World/Some/New_{int(torch.randint(10_000, ()))}"
    box = Body(Box((0.3, 0.2, 0.1)), Slab(0.02, itu="wood"))
    match int(torch.randint(7, ())):
        case 0:
            return scene.moved(path, pose=pose)
        case 1:
            return scene.moved("/World/Radios", torch.randn(3, dtype=torch.float64))
        case 2:
            return scene.added(asset, name, pose=pose)
        case 3:
            return scene.added(box, name, pose=pose)
        case 4:
            return scene.replaced(path, asset)
        case 5:
            return scene.replaced(path, Body(scene.node(path).body.shape, Conductor()))
        case _:
            return scene.without(path) if len(paths) > 2 else scene


@pytest.mark.parametrize("metre, up", [(1, "Z"), (0.01, "Y"), (0.3048, "Z"), (1, "Y")])
def test_any_edits_are_read_back(scene_file, asset_here, metre, up):
    resolve = f"""double xformOp:rotateX:unitsResolve = {-90 if up == "Y" else 0}
        double3 xformOp:scale:unitsResolve = ({1 / metre}, {1 / metre}, {1 / metre})"""
    order = '"xformOp:rotateX:unitsResolve", "xformOp:scale:unitsResolve"'
    tetra = """
    def Mesh "Tetra"
    {
        custom token rfsg:material:model = "conductor"
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3]
    }"""
    body = WALL + tetra + reference("A", resolve, order)
    path = scene_file(body + reference("B", resolve, order) + RADIOS, metre=metre, up=up)
    scene = Scene.from_usd(path)
    for _ in range(8):
        scene = random_edit(scene, asset_here)
    read = Scene.from_usd(scene.save_edits(path.with_name("edits.usda")))
    things = [{t.path: t for t in s.nodes} for s in (read, scene)]
    assert things[0].keys() == things[1].keys()
    point = torch.randn(100, 3, dtype=torch.float64)
    for name, one in things[0].items():
        other = things[1][name]
        left, right = (
            n.body.shape.sdf(n.pose.point_object(point)).detach() * n.pose.scale
            for n in (one, other)
        )
        torch.testing.assert_close(left, right, rtol=0, atol=1e-11, msg=name)
        assert one.body.surface.kind == other.body.surface.kind


def test_a_fit_in_place_is_an_edit(lab):
    scene = Scene.from_usd(lab)
    with torch.no_grad():
        next(scene.node("/World/A").body.shape.parameters()).add_(0.25)
    before = digests(lab.parent)
    read = Scene.from_usd(scene.save_edits(lab.with_name("edits.usda")))
    assert_equal(read, scene)
    assert not same_bits(Scene.from_usd(lab).node("/World/A").body.shape, read.nodes[1].body.shape)
    after = digests(lab.parent)
    assert {name: after[name] for name in before} == before


def test_from_another_folder_readers_are_told_what_they_need(lab, tmp_path):
    scene = Scene.from_usd(lab).moved("/World/A", (1, 0, 0))
    far = tmp_path / "far" / "edits.usda"
    far.parent.mkdir()
    with pytest.warns(UserWarning, match=f"must be given asset_roots {lab.parent}"):
        scene.save_edits(far)
    assert "@../scene.usda@" in far.read_text()
    with pytest.raises(SceneError, match="lies outside the folders"):
        Scene.from_usd(far)
    assert_equal(Scene.from_usd(far, asset_roots=[lab.parent]), scene)


def test_nothing_is_overwritten_unasked_and_the_source_never(lab):
    scene = Scene.from_usd(lab).moved("/World/A", (1, 0, 0))
    saved = scene.save_edits(lab.with_name("edits.usda"))
    before = digests(lab.parent)
    with pytest.raises(SceneError, match="already exists; pass overwrite=True"):
        scene.moved("/World/A", (1, 0, 0)).save_edits(saved)
    for file, read in ((lab, scene), (saved, Scene.from_usd(saved)), (lab, Scene.from_usd(saved))):
        with pytest.raises(SceneError, match="the scene is read from this file"):
            read.save_edits(file, overwrite=True)
    with pytest.raises(SceneError, match="expected the ending .usda"):
        scene.save_edits(lab.with_suffix(".usdc"))
    with pytest.raises(SceneError, match="does not exist; make it first"):
        scene.save_edits(lab.parent / "nowhere" / "edits.usda")
    with pytest.raises(SceneError, match="made in Python"):
        Scene().save_edits(lab.with_name("new.usda"))
    assert digests(lab.parent) == before
    moved = scene.moved("/World/A", (1, 0, 0))
    assert_equal(Scene.from_usd(moved.save_edits(saved, overwrite=True)), moved)


def test_what_usd_cannot_say_is_refused_and_leaves_nothing(lab):
    scene = Scene.from_usd(lab)
    before = digests(lab.parent)
    kept = scene.without("/World/A").with_receivers(scene.receivers)  # a phone on what is gone
    with pytest.raises(SceneError, match="/World/A: cannot be taken out while /World/A/Phone"):
        kept.added(Body(Sphere(0.1), Conductor()), "/World/X").save_edits(lab.with_name("e.usda"))
    with pytest.raises(SceneError, match="/World/Metal: a prim that is no object stands here"):
        scene.added(Body(Sphere(0.1), Conductor()), "/World/Metal").save_edits(
            lab.with_name("e.usda")
        )
    below = Body(Box((0.1, 0.1, 0.1)), Conductor())
    hidden = scene.added(below, "/World/A/Surface").added(below, "/World/Y")  # the asset's own mesh
    with pytest.raises(SceneError, match="/World/A/Surface"):
        hidden.save_edits(lab.with_name("e.usda"))
    assert digests(lab.parent) == before


def test_alike_is_told_by_numbers():
    one, other = Radio.at("/r", 1, 2, 3), Radio.at("/r", 1, 2, 3)
    assert alike(one, other) and not alike(one, Radio.at("/r", 1, 2, 3.5))
    assert not alike(one, Radio.at("/r", 1, 2, 3, power_dbm=1.0)) and not alike(one, None)
