"""Objects exported from scenes: the same bits and the same channel back, whole or not at all."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom

import rfsg
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.sheet import Sheet
from rfsg.objects.shapes.shown import shown_mesh
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.plot_thumbnail import thumbnail
from rfsg.scene import usd
from rfsg.scene.assets import load_asset
from rfsg.scene.export import export, surface_of
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.usd import packaging
from rfsg.scene.usd.validation import Findings, findings
from rfsg.scene.weights import pack, same_bits, unpack

LAB = Path(__file__).resolve().parents[2] / "assets" / "scenes" / "lab.usda"
PATH = "/World/Cabinet"
QUALITY = rfsg.Quality(depth=1)


@pytest.fixture(scope="module")
def lab() -> Scene:
    """The lab's shell and cabinet, with radios before its front (+x)."""
    scene = Scene.from_usd(LAB)
    nodes = tuple(n for n in scene.nodes if n.body.shape.exact or n.path == PATH)
    front = scene.node(PATH).pose.point_world
    tx, rx = (front(torch.tensor([1.2, y, 0.8], dtype=torch.float64)) for y in (-0.3, 0.3))
    radios = Radio.at("/World/tx", *tx.tolist()), Radio.at("/World/rx", *rx.tolist())
    return replace(scene, nodes=nodes, transmitters=radios[:1], receivers=radios[1:])


@pytest.fixture(scope="module")
def result(lab):
    return rfsg.simulate(lab, quality=QUALITY)


@pytest.fixture(scope="module")
def exported(lab, tmp_path_factory) -> dict[str, Path]:
    """The lab's cabinet, as a folder and as a package."""
    out = tmp_path_factory.mktemp("exported") / "cabinet"
    mesh = surface_of(lab.node(PATH))
    shown: dict[str, Any] = {"mesh": mesh, "picture": thumbnail(*mesh, side=32)}
    package = out.with_suffix(".usdz")
    return {
        "folder": lab.export(PATH, out, **shown),
        "package": lab.export(PATH, package, **shown),
    }


def one(body: Body, path: str = "/World/It") -> Scene:
    return Scene((Node(path, body, Pose.at(1.0, 2.0, 0.5, yaw_deg=20.0)),))


def icosphere(rings: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh of many corners: a ball of rings."""
    turn = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    tilt = np.linspace(0, np.pi, rings + 1)[1:-1]
    ring = [[np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] for t in tilt for p in turn]
    vertices, n = np.array([*ring, [0, 0, 1], [0, 0, -1]]), len(turn)
    top, bottom = len(ring), len(ring) + 1
    faces = []
    for k in range(n):
        j = (k + 1) % n
        faces += [[top, k, j], [bottom, top - n + j, top - n + k]]
        for r in range(len(tilt) - 1):
            a, b, c, d = r * n + k, r * n + j, (r + 1) * n + k, (r + 1) * n + j
            faces += [[a, c, b], [b, c, d]]
    return vertices, np.array(faces)


@pytest.mark.parametrize("kind", ["folder", "package"])
def test_the_same_bits_come_back(lab, exported, kind):
    body, loaded = lab.node(PATH).body, load_asset(exported[kind])
    assert same_bits(loaded.body.shape, body.shape)
    assert same_bits(loaded.body.surface, body.surface)
    assert loaded.sha256 == load_asset(lab.node(PATH).asset).sha256


@pytest.mark.parametrize("kind", ["folder", "package"])
def test_the_same_channel_comes_back(lab, exported, result, kind):
    """In place of the object it was exported from: every path, to the bit."""
    after = rfsg.simulate(lab.replaced(PATH, exported[kind]), quality=QUALITY)
    assert bool((result.paths.which == lab.index(PATH)).any())
    assert torch.equal(result.channel.gain, after.channel.gain)
    assert torch.equal(result.channel.delay, after.channel.delay)


@pytest.mark.parametrize("kind", ["folder", "package"])
def test_a_scene_that_references_it_reads_the_same(lab, exported, kind, tmp_path):
    """Copied beside a scene that could not read it where it lies."""
    scene = lab.replaced(PATH, exported[kind])
    read = Scene.from_usd(scene.to_usd(tmp_path / "scene.usda"))
    assert same_bits(read.node(PATH).body.shape, lab.node(PATH).body.shape)
    assert torch.equal(read.node(PATH).pose.translation, lab.node(PATH).pose.translation)
    assert usd.check(tmp_path / "scene.usda") == []
    copied = {f.suffix for f in (tmp_path / "scene_assets").iterdir() if f.stem == "cabinet"}
    expected = {"folder": {".usda", ".safetensors", ".png"}, "package": {".usdz"}}
    assert copied == expected[kind]


def test_two_assets_of_one_name_do_not_mix_when_copied(lab, tmp_path):
    for name, body in (("a", Body(Sphere(0.3), StochasticSurface())), ("b", lab.node(PATH).body)):
        (tmp_path / name).mkdir()
        export(
            one(body),
            "/World/It",
            tmp_path / name / "thing.usda",
            mesh=shown_mesh(Box((1.0, 1.0, 1.0))),
        )
    scene = Scene(
        tuple(Node(f"/World/{n}", Body(Sphere(1.0), Conductor()), Pose.identity()) for n in "ab")
    )
    for name in "ab":
        scene = scene.replaced(f"/World/{name}", tmp_path / name / "thing.usda")
    (tmp_path / "far").mkdir()
    read = Scene.from_usd(scene.to_usd(tmp_path / "far" / "far.usda"))
    for name in "ab":
        mine, theirs = (s.node(f"/World/{name}").body for s in (scene, read))
        assert same_bits(mine.shape, theirs.shape) and same_bits(mine.surface, theirs.surface)


def test_what_other_programs_see(lab, exported):
    stage = Usd.Stage.Open(str(exported["folder"]))
    root = stage.GetDefaultPrim()
    surface, hull = (UsdGeom.Mesh(root.GetChild(n)) for n in ("Surface", "Hull"))
    assert (surface.ComputePurpose(), hull.ComputePurpose()) == ("default", "guide")
    assert surface.GetNormalsInterpolation() == "faceVarying"
    normals = np.array(surface.GetNormalsAttr().Get())
    assert len(normals) == len(surface.GetFaceVertexIndicesAttr().Get())
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    bounds = lab.node(PATH).body.shape.bounds()
    for name, row in zip(("Min", "Max"), bounds, strict=True):
        assert root.GetAttribute(f"rfsg:neural:bounds{name}").Get() == pytest.approx(row.tolist())
    picture = exported["folder"].with_suffix(".png").read_bytes()
    assert picture.startswith(b"\x89PNG") and picture[16:24] == b"\0\0\0\x20" * 2
    assert load_asset(exported["folder"]).picture == str(exported["folder"].with_suffix(".png"))


def test_neither_has_findings_but_the_one_by_design(exported):
    assert findings(exported["folder"]) == Findings((), ())
    package = findings(exported["package"])
    assert package.faults == () and len(package.notes) == 1
    assert "safetensors" in package.notes[0] and "by design" in package.notes[0]


def test_a_package_begins_with_its_layer_and_is_stored_on_multiples_of_64_bytes(exported):
    data = exported["package"].read_bytes()
    with zipfile.ZipFile(exported["package"]) as package:
        items = package.infolist()
        assert [i.filename for i in items] == ["cabinet.usda", "cabinet.png", "cabinet.safetensors"]
        for item in items:
            assert item.compress_type == zipfile.ZIP_STORED
            name, extra = (
                int.from_bytes(data[item.header_offset + k :][:2], "little") for k in (26, 28)
            )
            assert (item.header_offset + 30 + name + extra) % 64 == 0


def test_provenance_is_kept_and_says_where_from(lab, exported):
    told = load_asset(exported["folder"]).provenance
    original = load_asset(lab.node(PATH).asset).provenance
    assert original.items() <= told.items() and original["report"]["steps"] == 6000
    assert told["exported"] == {"object": PATH, "scene": "lab.usda"}


def test_no_file_names_the_machine(exported, tmp_path):
    here = str(exported["package"].parent).encode()
    for file in (exported["package"], *exported["folder"].parent.iterdir()):
        assert here not in file.read_bytes() and str(LAB.parent).encode() not in file.read_bytes()


def test_overrides_and_weights_of_the_instance_are_kept(lab, tmp_path):
    """A material that the scene gives the object, and weights that were changed since."""
    node = lab.node(PATH)
    glass = Slab(0.008, itu="glass")
    over = replace(lab, nodes=(replace(node, body=Body(node.body.shape, glass)),))
    drawn = shown_mesh(Box((1.0, 1.0, 1.0)))  # a picture only, and the real one takes a second
    loaded = load_asset(export(over, PATH, tmp_path / "over", mesh=drawn))
    assert same_bits(loaded.body.surface, glass) and same_bits(loaded.body.shape, node.body.shape)
    assert loaded.provenance["changed"] == ["surface"]
    assert loaded.provenance["origin"]["file"] == "cabinet.usda"

    changed = unpack(pack(node.body), "a copy")
    with torch.no_grad():
        next(changed.shape.parameters()).mul_(1.0 + 2.0**-10)
    own = replace(lab, nodes=(replace(node, body=changed),))
    loaded = load_asset(export(own, PATH, tmp_path / "own", mesh=drawn))
    assert same_bits(loaded.body.shape, changed.shape)
    assert not same_bits(loaded.body.shape, node.body.shape)
    assert loaded.provenance["changed"] == ["shape"]


def test_a_material_override_in_the_scene_file_is_kept(lab, tmp_path):
    """A USD override on the instance, stronger than the asset."""
    package = export(lab, PATH, tmp_path / "cabinet.usdz", mesh=shown_mesh(Box((1.0, 1.0, 1.0))))
    text = """#usda 1.0
    (
        defaultPrim = "World"
        metersPerUnit = 1
        upAxis = "Z"
    )
    def Xform "World"
    {
        def Xform "C" (
            prepend references = @./%s@
        )
        {
            custom token rfsg:material:model = "slab"
            custom token rfsg:material:itu = "wood"
            custom double rfsg:material:thickness = 0.02
        }
    }
    """
    (tmp_path / "scene.usda").write_text(text % package.name)
    scene = Scene.from_usd(tmp_path / "scene.usda")
    loaded = load_asset(scene.export("/World/C", tmp_path / "wooden.usdz"))
    assert same_bits(loaded.body.surface, Slab(0.02, itu="wood"))
    assert same_bits(loaded.body.shape, lab.node(PATH).body.shape)


BALL = icosphere()


@pytest.mark.parametrize(
    "shape, surface",
    [
        (Box((0.2, 0.3, 0.4)), Conductor()),
        (Sphere(0.3), Slab(0.1, itu="brick")),
        (Cylinder(0.1, 0.9), StochasticSurface()),
        (Capsule(0.1, 0.5), Conductor()),
        (Mesh(*BALL), Conductor()),
        (Mesh(*BALL), StochasticSurface()),
        (Sheet(BALL[0], BALL[1][:50]), Slab(0.1, itu="wood")),
    ],
    ids=lambda part: type(part).__name__,
)
def test_known_shapes_and_meshes_are_exported_too(shape, surface, tmp_path):
    path = export(one(Body(shape, surface)), "/World/It", tmp_path / "it")
    loaded = load_asset(path)
    assert same_bits(loaded.body.shape, shape) and same_bits(loaded.body.surface, surface)
    assert usd.check(path) == []
    point = torch.rand(20, 3, dtype=torch.float64) * 2 - 1
    assert torch.equal(loaded.body.shape.sdf(point), shape.sdf(point))


def test_a_layer_with_its_files_beside_it(tmp_path):
    path = export(one(Body(Box((0.2, 0.3, 0.4)), Conductor())), "/World/It", tmp_path / "box.usda")
    assert path == tmp_path / "box.usda"
    assert sorted(f.name for f in tmp_path.iterdir()) == ["box.safetensors", "box.usda"]


def test_a_band_goes_out_and_comes_back(tmp_path):
    body = Body(Box((0.2, 0.3, 0.4)), StochasticSurface(), band=(2.4e9, 2.5e9))
    for out in ("it", "it.usdz"):
        path = export(one(body), "/World/It", tmp_path / out)
        assert load_asset(path).body.band == (2.4e9, 2.5e9)
        assert Scene.from_usd(path).nodes[0].body.band == (2.4e9, 2.5e9)
    written = one(body).to_usd(tmp_path / "scene.usda")
    assert Scene.from_usd(written).nodes[0].body.band == (2.4e9, 2.5e9)


def test_what_cannot_be_exported_says_why_and_leaves_nothing(lab, tmp_path):
    ground = one(Body(HalfSpace(), Conductor()))
    box = one(Body(Box((0.2, 0.3, 0.4)), Conductor()))
    cases = (
        (ground, "/World/It", "ground", {}, "unbounded"),
        (lab, "/World/Nothing", "no", {}, "no object at this path"),
        (box, "/World/It", "no/where/at", {}, "does not exist"),
        (box, "/World/It", "..", {}, "expected a folder"),
        (box, "/World/It", "story.usdz", {"provenance": {"x": float("nan")}}, "not JSON"),
        (box, "/World/It", "story", {"provenance": {"x": {1, 2}}}, "not JSON"),
    )
    for scene, path, out, options, words in cases:
        with pytest.raises(SceneError, match=words):
            export(scene, path, tmp_path / out, **options)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_unless_asked(tmp_path):
    first, second = (one(Body(Box((s, s, s)), Conductor())) for s in (0.5, 1.0))
    for out in ("it", "it.usdz", "beside.usda"):
        path = export(first, "/World/It", tmp_path / out)
        before = path.read_bytes()
        with pytest.raises(SceneError, match="already exists; pass overwrite=True"):
            export(second, "/World/It", tmp_path / out)
        assert path.read_bytes() == before
        export(second, "/World/It", tmp_path / out, overwrite=True)
        assert load_asset(path).body.shape.half_size.tolist() == [1.0, 1.0, 1.0]
    assert not list(tmp_path.rglob("*.part"))


def test_a_folder_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    """The disk is full after the first file."""
    write, calls = packaging.write_beside, []

    def failing(path: Path, data: bytes, overwrite: bool) -> None:
        calls.append(path.name)
        if len(calls) > 1:
            raise OSError(28, "No space left on device")
        write(path, data, overwrite)

    monkeypatch.setattr(packaging, "write_beside", failing)
    with pytest.raises(OSError, match="No space left"):
        export(one(Body(Box((1.0, 1.0, 1.0)), Conductor())), "/World/It", tmp_path / "it")
    assert calls == ["it.safetensors", "it.usda"] and list(tmp_path.iterdir()) == []


def test_equal_objects_give_equal_packages(tmp_path):
    scene = one(Body(Box((0.2, 0.3, 0.4)), StochasticSurface()))
    a, b = (export(scene, "/World/It", tmp_path / n / "it.usdz") for n in _folders(tmp_path, "ab"))
    assert a.read_bytes() == b.read_bytes()


def _folders(where: Path, names: str) -> list[str]:
    for name in names:
        (where / name).mkdir()
    return list(names)


def test_the_tensors_of_a_mesh_are_checked_before_it_is_built():
    from safetensors.torch import load, save

    body = Body(Mesh(*icosphere(6)), Conductor())
    data = pack(body)
    size = int.from_bytes(data[:8], "little")
    head = {"rfsg": json.loads(data[8 : 8 + size])["__metadata__"]["rfsg"]}
    assert same_bits(unpack(data, "it").shape, body.shape)
    good = load(data)
    bad = {
        "is missing": {"surface": torch.zeros(1)},
        r"\[n, 3\]": good | {"shape.triangles": torch.zeros(5, 2, dtype=torch.int64)},
        "expected torch.int64": good | {"shape.triangles": good["shape.triangles"].int()},
        "the limit is": good | {"shape.vertices": torch.zeros(300_001, 3, dtype=torch.float64)},
        "cannot be built": good | {"shape.triangles": good["shape.triangles"] + 10**6},
        "finite": good | {"shape.vertices": good["shape.vertices"] * float("nan")},
    }
    for words, tensors in bad.items():
        with pytest.raises(SceneError, match=words):
            unpack(save(tensors, metadata=head), "it")
