"""The scenes that come with rfsg: they load, and nothing stands in anything else."""

import shutil
from pathlib import Path

import pytest
import torch
import trimesh
from pxr import Usd, UsdGeom

from rfsg.objects.body import Body
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene import usd
from rfsg.scene.assets import save_asset
from rfsg.scene.scene import Scene

ASSETS = Path(__file__).parents[2] / "assets"
SIZES = {  # depth, width, height [m], for what is not trained yet
    "cabinet": (0.45, 0.9, 1.4),
    "desk": (0.7, 1.4, 0.74),
    "chair": (0.5, 0.5, 0.9),
    "person": (0.3, 0.5, 1.75),
}
CLEARANCE = 0.02  # [m] between objects, and to walls


def stand_in(folder: Path, name: str) -> None:
    depth, width, height = SIZES[name]
    box = [[-depth / 2, -width / 2, 0.0], [depth / 2, width / 2, height]]
    shape = NeuralShape(box, width=4, depth=3, skip=1, frequencies=1, features=2, lipschitz=2.0)
    hull = trimesh.creation.box(bounds=box)
    mesh = (hull.vertices, hull.faces, hull.vertex_normals)
    folder.mkdir(parents=True)
    save_asset(folder / f"{name}.usda", Body(shape, Conductor()), mesh=mesh)


@pytest.fixture(scope="module")
def lab(tmp_path_factory) -> Scene:
    root = tmp_path_factory.mktemp("lab")
    shutil.copytree(ASSETS / "scenes", root / "scenes")
    shutil.copy(ASSETS / "rfsg-assets.toml", root)
    for name in SIZES:
        if (ASSETS / "objects" / name / f"{name}.usda").is_file():
            shutil.copytree(ASSETS / "objects" / name, root / "objects" / name)
        else:
            stand_in(root / "objects" / name, name)
    return Scene.from_usd(root / "scenes" / "lab.usda")


def extents(scene: Scene, kind: str) -> dict[str, torch.Tensor]:
    """World boxes [2 3] around the nodes of one kind."""
    found = {}
    for node in scene.nodes:
        if node.body.shape.kind == kind:
            low, high = node.body.shape.bounds() if node.asset is None else surface(node.asset)
            corners = torch.cartesian_prod(*torch.stack([low, high], -1))
            world = node.pose.point_world(corners)
            found[node.path] = torch.stack([world.amin(0), world.amax(0)]).detach()
    return found


def surface(asset: str) -> torch.Tensor:
    """Lowest and highest corner of the extracted mesh: a network's bounds are wider."""
    stage = Usd.Stage.Open(asset)
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("Surface"))
    return torch.tensor([list(corner) for corner in mesh.GetExtentAttr().Get()]).double()


def gap(a: torch.Tensor, b: torch.Tensor) -> float:
    """Distance between two boxes along the axis that parts them best; negative for an overlap."""
    return float(torch.maximum(a[0] - b[1], b[0] - a[1]).max())


def test_lab_has_what_it_should(lab):
    assert lab.frequency == 2.44e9 and lab.warnings == ()
    (ap,) = lab.transmitters
    assert (ap.path, ap.power_dbm, float(ap.position[2])) == ("/World/Radios/AP", 20.0, 2.7)
    assert [r.path for r in lab.receivers] == [f"/World/Radios/rx_{i:02d}" for i in range(24)]
    chairs = [lab.node(f"/World/Chairs/Chair_{i}") for i in (0, 1)]
    assert chairs[0].body is chairs[1].body
    materials = {n.path.split("/")[2]: n.body.surface for n in lab.nodes}
    assert materials["Shell"].config()["itu"] == "concrete"
    assert materials["Window"].config()["itu"] == "glass"
    assert materials["Partition"].config()["itu"] == "plasterboard"
    assert materials["Door"].config()["itu"] == "wood"


@pytest.mark.parametrize("move", [(0.0, 0.0, 0.0), (1.2, 0.0, 0.0)])
def test_lab_objects_stand_clear_of_walls_and_of_each_other(lab, move):
    scene = lab.moved("/World/Cabinet", move)
    walls, things = extents(scene, "box"), extents(scene, "neural")
    assert len(things) == 5 and len(walls) == 9 + 1 + 3 + 1
    names = list(things)
    for i, name in enumerate(names):
        assert abs(float(things[name][0, 2])) < 0.02  # on the floor
        others = [things[n] for n in names[i + 1 :]]
        others += [w for n, w in walls.items() if n != "/World/Shell/Floor"]
        assert min(gap(things[name], other) for other in others) >= CLEARANCE


def test_lab_walls_touch_and_do_not_overlap(lab):
    walls = list(extents(lab, "box").values())
    gaps = [gap(a, b) for i, a in enumerate(walls) for b in walls[i + 1 :]]
    assert min(gaps) > -1e-12


def test_lab_radios_are_in_the_room_and_in_nothing(lab):
    solid = {**extents(lab, "box"), **extents(lab, "neural")}
    moved = extents(lab.moved("/World/Cabinet", (1.2, 0, 0)), "neural")["/World/Cabinet"]
    for radio in (*lab.transmitters, *lab.receivers):
        point = radio.position.expand(2, 3)
        assert bool((radio.position > 0).all())
        assert bool((radio.position < torch.tensor([8.0, 6.0, 3.0])).all())
        assert all(gap(point, box) >= 0.05 for box in (*solid.values(), moved)), radio.path


def test_room_is_closed_and_empty():
    scene = Scene.from_usd(ASSETS / "scenes" / "room.usda")
    assert len(scene.nodes) == 6 and len(scene.transmitters) == 1 and len(scene.receivers) == 3
    inside = torch.stack([torch.zeros(3), torch.tensor([5.0, 4.0, 3.0])]).to(torch.float64)
    gaps = [gap(inside, box) for box in extents(scene, "box").values()]
    assert max(abs(g) for g in gaps) < 1e-12  # each wall touches the inside, none reaches into it


@pytest.mark.parametrize("name", ["room", "materials", "tetam_lab"])
def test_scenes_are_in_order(name):
    assert usd.check(ASSETS / "scenes" / f"{name}.usda") == []
