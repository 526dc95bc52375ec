"""Round trips: a scene written and read back is the same scene."""

from dataclasses import fields, replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene import usd
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.weights import same_bits
from tests.scene.scene_text import cube


def tilted(x, y, z, mirror=False) -> Pose:
    frame, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
    frame = frame * torch.sign(torch.det(frame)) * (-1 if mirror else 1)
    return replace(Pose.at(x, y, z), rotation=frame)


def assert_same(read: Scene, written: Scene) -> None:
    """Same paths in the same order, poses to 1e-12, bodies and radios bit by bit."""
    assert [n.path for n in read.nodes] == [n.path for n in written.nodes]
    assert read.frequency == written.frequency
    for a, b in zip(read.nodes, written.nodes, strict=True):
        for part in ("rotation", "translation", "scale"):
            torch.testing.assert_close(
                getattr(a.pose, part), getattr(b.pose, part), rtol=0, atol=1e-12
            )
        torch.testing.assert_close(a.velocity, b.velocity, rtol=0, atol=0)
        assert same_bits(a.body.surface, b.body.surface)
        if a.body.shape.kind == "neural":
            assert same_bits(a.body.shape, b.body.shape)
        else:
            assert a.body.shape.kind == b.body.shape.kind
            for p, q in zip(a.body.shape.parameters(), b.body.shape.parameters(), strict=True):
                torch.testing.assert_close(p, q, rtol=1e-12, atol=0)
    for ours, theirs in (
        (read.transmitters, written.transmitters),
        (read.receivers, written.receivers),
    ):
        assert len(ours) == len(theirs)
        for a, b in zip(ours, theirs, strict=True):
            for item in fields(Radio):
                left, right = getattr(a, item.name), getattr(b, item.name)
                if isinstance(left, torch.Tensor):
                    torch.testing.assert_close(left, right, rtol=0, atol=1e-12)
                else:
                    assert left == right


@pytest.fixture
def everything(small_asset) -> Scene:
    """One of each shape and surface, a mirrored and a fitted object, moving and aimed radios."""
    body, path = small_asset
    concrete, glass = Slab(0.2, itu="concrete"), Slab(0.008, eps_r=6.3, sigma=0.01)
    ground = DielectricHalfSpace(eps_r=15.0, sigma=0.035)
    velocity = torch.tensor([0.5, -1.0, 0.25], dtype=torch.float64)
    half = Pose.at(1, 2, 3, scale=0.5)
    nodes = (
        Node("/World/Ground", Body(HalfSpace(), ground), Pose.identity()),
        Node("/World/Shell/Wall", Body(Box((4.0, 0.1, 1.5)), concrete), Pose.at(0.3, 0.1, 1.5)),
        Node("/World/Shell/Leaning", Body(Box((1.0, 0.1, 0.7)), concrete), tilted(1, 2, 3)),
        Node("/World/Pane", Body(Box((0.5, 0.004, 0.7)), glass), Pose.at(0, 0, 0, yaw_deg=30)),
        Node("/World/Ball", Body(Sphere(0.3), Conductor()), tilted(4, 4, 4), velocity),
        Node("/World/Post", Body(Cylinder(0.1, 0.9), Conductor()), tilted(5, 4, 4, mirror=True)),
        Node("/World/Pill", Body(Capsule(0.1, 0.9), concrete), tilted(6, 4, 4)),
        Node("/World/Cabinet", body, half, asset=str(path)),
        Node("/World/Cabinet_2", body, tilted(7, 4, 4, mirror=True), asset=str(path)),
        Node("/World/Glazed", Body(body.shape, glass), Pose.at(9, 9, 0), asset=str(path)),
        Node("/World/Fitted", Body(Box((0.2, 0.3, 0.4)), StochasticSurface()), tilted(8, 4, 4)),
    )
    aimed = tilted(1, 1, 2)
    tx = Radio("/World/Radios/AP", aimed.translation, aimed.rotation, velocity, 20.0, 2.4e9,
               "half_wave_dipole", "V")  # fmt: skip
    rx = (Radio.at("/World/Cabinet/rx_1", 1, 2, 3.9), Radio.at("/World/Radios/rx_0", 3, 3, 1.2))
    return Scene(nodes, (tx,), rx, 2.44e9)


def test_round_trip(everything, tmp_path, capfd):
    path = everything.to_usd(tmp_path / "out.usda")
    read = Scene.from_usd(path)
    assert_same(read, everything)
    assert read.warnings == ()
    assert usd.check(path) == []
    assert read.node("/World/Cabinet").body is read.node("/World/Cabinet_2").body
    wall, leaning = read.node("/World/Shell/Wall"), read.node("/World/Shell/Leaning")
    assert wall.body.surface is leaning.body.surface
    # and once more, from what was read: the text settles
    again = read.to_usd(tmp_path / "again.usda")
    assert_same(Scene.from_usd(again), everything)
    assert capfd.readouterr() == ("", "")


def test_text_holds_every_value_custom_and_metres_z_up(everything, tmp_path):
    text = everything.to_usd(tmp_path / "out.usda").read_text()
    assert text.startswith("#usda 1.0") and "metersPerUnit = 1" in text and 'upAxis = "Z"' in text
    assert 'custom token rfsg:radio:pattern = "isotropic"' in text
    assert str(tmp_path) not in text  # relative paths only


def test_assets_are_referenced_where_they_lie_and_copied_from_elsewhere(
    scene_file, asset_here, tmp_path
):
    body = 'def Xform "A" (\n        prepend references = @./cabinet.usda@\n    )\n    {\n    }\n'
    scene = Scene.from_usd(scene_file(body + cube()))
    near = scene.to_usd(tmp_path / "near.usda")
    assert "@./cabinet.usda@" in near.read_text()
    (tmp_path / "far").mkdir()
    far = scene.to_usd(tmp_path / "far" / "far.usda")
    copy = tmp_path / "far" / "far_assets" / "cabinet.usda"
    assert "@./far_assets/cabinet.usda@" in far.read_text()
    assert copy.read_bytes() == asset_here.read_bytes()  # the extracted mesh goes with it
    assert_same(Scene.from_usd(far), scene)


def test_an_asset_of_several_files_is_saved_anew_elsewhere(scene_file, asset_here, tmp_path):
    """A copy of two files would be torn: the layer below names its weights in another folder."""
    (tmp_path / "deep").mkdir()
    asset_here.rename(tmp_path / "deep" / "cabinet.usda")
    text = (tmp_path / "deep" / "cabinet.usda").read_text()
    (tmp_path / "deep" / "cabinet.usda").write_text(text.replace("@./", "@../"))
    # the file above its folder is outside what the asset alone may read: a marker lets it
    (tmp_path / "rfsg-assets.toml").touch()
    body = (
        'def Xform "A" (\n        prepend references = @./deep/cabinet.usda@\n    )\n    {\n    }\n'
    )
    scene = Scene.from_usd(scene_file(body))
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "rfsg-assets.toml").touch()
    far = scene.to_usd(tmp_path / "far" / "far.usda")
    assert_same(Scene.from_usd(far), scene)


def test_a_fit_is_saved_beside_and_the_asset_stays(scene_file, asset_here, tmp_path):
    body = 'def Xform "A" (\n        prepend references = @./cabinet.usda@\n    )\n    {\n    }\n'
    scene = Scene.from_usd(scene_file(body))
    before = asset_here.with_suffix(".safetensors").read_bytes()
    with torch.no_grad():
        next(scene.nodes[0].body.shape.parameters()).add_(0.25)
    read = Scene.from_usd(scene.to_usd(tmp_path / "fitted.usda"))
    assert same_bits(read.nodes[0].body.shape, scene.nodes[0].body.shape)
    assert not same_bits(load_asset(asset_here).body.shape, scene.nodes[0].body.shape)
    assert asset_here.with_suffix(".safetensors").read_bytes() == before


def test_moved_replaced_without_then_written(everything, tmp_path, small_asset):
    scene = everything.moved("/World/Cabinet", (1.2, 0, 0)).without("/World/Ball")
    scene = scene.replaced("/World/Post", small_asset[1])
    read = Scene.from_usd(scene.to_usd(tmp_path / "out.usda"))
    assert_same(read, scene)
    assert read.node("/World/Cabinet").pose.translation.tolist() == [2.2, 2.0, 3.0]


def test_refuses_to_overwrite_unless_asked(everything, tmp_path):
    path = everything.to_usd(tmp_path / "out.usda")
    before = path.read_bytes()
    with pytest.raises(SceneError, match="already exists; pass overwrite=True"):
        Scene().to_usd(path)
    assert path.read_bytes() == before
    everything.to_usd(path, overwrite=True)
    assert not [f for f in tmp_path.rglob("*.part")]


def test_refuses_paths_that_no_prim_can_have(tmp_path):
    twice = (Radio.at("/World/rx", 0, 0, 0), Radio.at("/World/rx", 1, 0, 0))
    odd = (Radio.at("/World/rx 1", 0, 0, 0), Radio.at("rx", 1, 0, 0))
    with pytest.raises(SceneError) as error:
        Scene(receivers=twice + odd).to_usd(tmp_path / "out.usda")
    assert len(error.value.faults) == 3
    assert list(tmp_path.iterdir()) == []


def test_an_empty_scene(tmp_path):
    read = Scene.from_usd(Scene(frequency=1e9).to_usd(tmp_path / "out.usda"))
    assert replace(read, source=None) == Scene(frequency=1e9)
