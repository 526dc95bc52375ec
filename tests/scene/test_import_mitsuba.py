"""Mitsuba XML as Sionna RT writes it: shapes, transforms, materials, and what is refused."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from rfsg.cli import run
from rfsg.objects.physics.fresnel import slab
from rfsg.objects.physics.media import complex_permittivity
from rfsg.objects.shapes.sheet import Sheet
from rfsg.scene import usd
from rfsg.scene.importers import import_scene
from rfsg.scene.importers.mitsuba import read_mitsuba
from rfsg.scene.importers.parts import Part, divided
from rfsg.scene.materials import Material
from rfsg.scene.scene import Scene, SceneError
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scene.importing import SHAPES, WALL, drawn, write_mitsuba, write_ply

SIONNA = "RFSG_SIONNA_SCENES"  # the folder sionna/rt/scenes of an installed sionna-rt
BUNDLED = {
    "box": (1, 12), "box_knife": (2, 20), "box_one_screen": (2, 14), "box_two_screens": (3, 16),
    "double_reflector": (2, 4), "etoile": (565, 13098), "floor_wall": (2, 4),
    "florence": (2639, 35373), "munich": (2367, 38936), "san_francisco": (4735, 268041),
    "simple_reflector": (1, 2), "simple_street_canyon": (7, 74),
    "simple_street_canyon_with_cars": (15, 234), "simple_wedge": (1, 4), "triple_reflector": (3, 6),
}  # fmt: skip


def test_materials_are_read_by_sionnas_rules(tmp_path):
    """An id that begins itu_ says it all; else the type; metal lets nothing through."""
    kinds = ("mat-itu_brick", "pane", "sheet metal", "own")
    shapes = "".join(drawn("rectangle", m, name=f"r{k}") for k, m in enumerate(kinds))
    read = read_mitsuba(write_mitsuba(tmp_path, shapes))
    assert read.materials == {
        "mat-itu_brick": Material("slab", itu="brick", thickness=0.1),
        "pane": Material("slab", itu="glass", thickness=0.012),
        "sheet metal": Material("conductor"),
        "own": Material("slab", eps_r=3.5, sigma=0.02, thickness=0.3, scattering=0.25, cross_share=0.1),
    }  # fmt: skip


def test_transforms_act_in_the_order_that_they_are_written_in(tmp_path):
    """A unit square, stretched, turned about z, moved: where trigonometry puts its corners."""
    steps = """<transform name="to_world">
            <scale x="3" y="2"/><rotate z="1" angle="90"/><translate value="1, 10, 5"/>
        </transform>"""
    (part,) = read_mitsuba(write_mitsuba(tmp_path, drawn("rectangle", extra=steps))).parts
    corners = [[1 - y, 10 + x, 5] for x, y in ((-3, -2), (3, -2), (3, 2), (-3, 2))]
    np.testing.assert_allclose(part.vertices, corners, atol=1e-12)
    matrix = (
        '<transform name="to_world"><matrix value="0 -2 0 1 3 0 0 10 0 0 1 5 0 0 0 1"/></transform>'
    )
    (same,) = read_mitsuba(write_mitsuba(tmp_path, drawn("rectangle", extra=matrix))).parts
    np.testing.assert_allclose(same.vertices, corners, atol=1e-12)


def test_drawn_shapes_enclose_what_they_should(tmp_path):
    """Volumes by the divergence theorem: of a cube 2^3; a ball stays a ball."""
    move = '<transform name="to_world"><scale value="2"/><translate x="7"/></transform>'
    ball = '<point name="center" x="1" y="0" z="0"/><float name="radius" value="0.5"/>' + move
    shapes = drawn("cube", name="cube") + drawn("sphere", extra=ball, name="ball")
    cube, ball = read_mitsuba(write_mitsuba(tmp_path, shapes)).parts
    a, b, c = cube.vertices[cube.triangles].transpose(1, 0, 2)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(8.0)
    assert ball.ball == ((9.0, 0.0, 0.0), 1.0)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_meshes_are_read_whatever_their_bytes(tmp_path, kind):
    """Triangles and a quad in one file, and what nobody asked for."""
    path = write_mitsuba(tmp_path)
    faces = [[0, 1, 2, 3], [0, 1, 2]]
    write_ply(tmp_path / "meshes" / "wall.ply", WALL, faces, kind)
    (part,) = read_mitsuba(path).parts
    np.testing.assert_array_equal(part.vertices, WALL)
    a, b, c = part.vertices[part.triangles].transpose(1, 0, 2)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(4.0 + 2.0)


def test_an_imported_wall_is_a_slab(tmp_path):
    """Through it the single layer of ITU-R P.2040-4 section 2.2.2; off it the image path, from
    either side."""
    scene = tmp_path / "wall.usda"
    tx, rx = (-3.0, 0.0, 1.0), ((2.0, 0.0, 1.0), (-3.0, 0.5, 1.0))
    source = write_mitsuba(tmp_path)
    report = import_scene(source, scene, tx=[tx], rx=rx, frequency=3.5e9)
    assert (report.objects, report.triangles) == (1, 2)
    read = Scene.from_usd(scene)
    assert read.frequency == 3.5e9 and read.warnings == ()
    result = simulate(read, quality=Quality(depth=1))
    frequency = torch.tensor([3.5e9], dtype=torch.float64)
    eps = complex_permittivity("brick", frequency)
    _, t = slab(torch.ones(1, 1, dtype=torch.float64), eps, 0.1, frequency)
    through, back = (result.paths.rx == k for k in (0, 1))
    wavelength = 299792458.0 / 3.5e9
    free = wavelength / (4 * np.pi * 5.0)
    assert float(result.channel.gain[through].abs().squeeze()) == pytest.approx(
        float(t[..., 0].abs().squeeze()) * free, rel=1e-6
    )
    lengths = sorted(result.paths.length[back].tolist())
    assert lengths == pytest.approx([0.5, np.hypot(6.0, 0.5)], abs=5e-5)


def test_a_sheet_is_written_and_read_back_as_one(tmp_path):
    """The same vertices to the bit, once each side's triangles; and nothing amiss in either file."""
    first, second = tmp_path / "wall.usda", tmp_path / "again.usda"
    import_scene(write_mitsuba(tmp_path), first)
    scene = Scene.from_usd(first)
    scene.to_usd(second)
    again = Scene.from_usd(second)
    for a, b in zip(scene.nodes, again.nodes, strict=True):
        assert isinstance(b.body.shape, Sheet)
        assert torch.equal(a.body.shape.vertices, b.body.shape.vertices)
        assert torch.equal(a.body.shape.triangles, b.body.shape.triangles)
    assert usd.check(first) == usd.check(second) == []


def test_a_sheet_has_no_inside_to_fill(tmp_path):
    path = tmp_path / "wall.usda"
    import_scene(write_mitsuba(tmp_path), path)
    solid = path.read_text().replace('model = "slab"', 'model = "solid"')
    thickness = "custom double rfsg:material:thickness = 0.1"
    assert thickness in solid
    path.write_text(solid.replace(thickness, ""))
    with pytest.raises(SceneError, match="/World/wall: a sheet has no inside for model solid"):
        Scene.from_usd(path)


def test_a_large_sheet_is_divided_and_nothing_is_lost():
    """Terrain of 2 x 40 x 40 triangles in pieces that lie together: the same area, fewer each."""
    x, y = np.meshgrid(np.arange(41.0), np.arange(41.0), indexing="ij")
    points = np.stack([x, y, np.sin(x) + np.cos(y)], -1).reshape(-1, 3)
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    triangles = np.concatenate([corner[:, None] + [0, 41, 42], corner[:, None] + [0, 42, 1]])
    pieces = divided(Part("land", points, triangles, "m"), most=100)
    assert all(len(p.triangles) <= 100 for p in pieces) and len(pieces) >= 32

    def areas(part):
        a, b, c = part.vertices[part.triangles].transpose(1, 0, 2)
        return np.sort(np.linalg.norm(np.cross(b - a, c - a), axis=1))

    together = np.sort(np.concatenate([areas(p) for p in pieces]))
    np.testing.assert_array_equal(together, areas(Part("land", points, triangles, "m")))
    assert max(np.ptp(p.vertices[:, 0]) * np.ptp(p.vertices[:, 1]) for p in pieces) < 160


def test_the_command_says_what_it_wrote_and_lists_faults(tmp_path, capsys):
    source, out = write_mitsuba(tmp_path), tmp_path / "wall.usda"
    words = ["import", str(source), "-o", str(out), "--tx", "-3,0,1", "--rx", "2,0,1"]
    assert run([*words, "--frequency", "3.5GHz"]) == 0
    assert "1 objects, 2 triangles; mat-itu_brick" in capsys.readouterr().out
    read = Scene.from_usd(out)
    assert [r.path for r in (*read.transmitters, *read.receivers)] == ["/World/Tx1", "/World/Rx1"]
    assert run(words) == 3 and "already exists" in capsys.readouterr().err
    bad = write_mitsuba(tmp_path, drawn("hair") + drawn("fog"))
    assert run(["import", str(bad), "-o", str(tmp_path / "bad.usda")]) == 3
    said = capsys.readouterr().err
    assert "a hair" in said and "a fog" in said and not (tmp_path / "bad.usda").exists()


LAUGHS = """<?xml version="1.0"?><!DOCTYPE scene [<!ENTITY a "haha"><!ENTITY b "&a;&a;&a;&a;">]>
<scene version="2.1.0"><shape type="rectangle" id="&b;"/></scene>"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAUGHS, "declares a document type"),
        ("<scene", "not XML that can be read"),
        ("<stage/>", "<stage> at the top"),
        ("<scene/>", "without shapes"),
        ("<scene><include filename='/etc/passwd'/></scene>", "<include> is not read"),
    ],
)
def test_what_is_no_scene_is_refused(tmp_path, text, message):
    path = tmp_path / "scene.xml"
    path.write_text(text)
    with pytest.raises(SceneError, match=message):
        read_mitsuba(path)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (SHAPES.replace("meshes/wall.ply", "../../wall.ply"), "lies outside the folders"),
        (SHAPES.replace("meshes/wall.ply", "/etc/passwd"), "lies outside the folders"),
        (SHAPES.replace("meshes/wall.ply", "meshes/none.ply"), "cannot be read"),
        (SHAPES.replace("mat-itu_brick", "marzipan"), "refers to .'marzipan'."),
        (drawn("hair"), "a hair; read are ply, obj"),
        (drawn("rectangle", extra="<transform><scale value='0'/></transform>"), "singular"),
        (drawn("rectangle", extra="<transform><scale value='nan'/></transform>"), "not finite"),
        (drawn("rectangle", extra="<transform><spin/></transform>"), "<spin> in a transform"),
        ("<bsdf type='plastic' id='toy'/>" + drawn("cube", "toy"), "'toy': a plastic, which says nothing"),
        ("<bsdf type='itu-radio-material' id='x'><string name='type' value='cheese'/></bsdf>", "'cheese'"),
    ],
)  # fmt: skip
def test_every_fault_names_its_shape_or_material(tmp_path, shapes, message):
    with pytest.raises(SceneError, match=message):
        read_mitsuba(write_mitsuba(tmp_path, shapes + drawn("cube", name="fine")))


def test_a_link_out_of_the_folder_is_not_followed(tmp_path):
    inner = tmp_path / "inner"
    path = write_mitsuba(inner)
    write_ply(tmp_path / "elsewhere.ply")
    (inner / "meshes" / "wall.ply").unlink()
    (inner / "meshes" / "wall.ply").symlink_to(tmp_path / "elsewhere.ply")
    with pytest.raises(SceneError, match="lies outside the folders"):
        read_mitsuba(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[:-3], "ends before its last row"),
        (
            lambda d: d.replace(b"element vertex 4", b"element vertex 4000000000"),
            "declares 4000000000",
        ),
        (lambda d: d.replace(b"element vertex 4", b"element vertex -4"), "declares -4"),
        (lambda d: d.replace(b"format binary_little", b"format quinary_little"), "format 'quinary"),
        (lambda d: b"PK" + d, "no PLY header"),
        (lambda d: d.replace(b"vertex_indices", b"vertex_indexes"), "faces without"),
        (lambda d: d.replace(b"property float z", b"property float w"), "z"),
    ],
)
def test_a_damaged_mesh_is_refused_by_name(tmp_path, change, message):
    path = write_mitsuba(tmp_path)
    file = tmp_path / "meshes" / "wall.ply"
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(SceneError, match=rf"wall.ply: .*{message}"):
        read_mitsuba(path)


def test_random_damage_ends_in_a_scene_or_a_scene_error(tmp_path):
    """Bytes of the mesh changed at random: read, or refused as any file is."""
    path = write_mitsuba(tmp_path)
    file = tmp_path / "meshes" / "wall.ply"
    whole, random = file.read_bytes(), np.random.default_rng(0)
    outcomes = set()
    for _ in range(200):
        damaged = bytearray(whole)
        for place in random.integers(0, len(whole), 3):
            damaged[place] = int(random.integers(0, 256))
        file.write_bytes(bytes(damaged))
        try:
            read_mitsuba(path)
            outcomes.add("read")
        except SceneError:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


@pytest.mark.slow
@pytest.mark.parametrize("name", BUNDLED)
def test_every_scene_bundled_with_sionna_loads(tmp_path, name):
    folder = os.environ.get(SIONNA)
    if folder is None:
        pytest.skip(f"{SIONNA} names no folder of sionna-rt's scenes")
    out = tmp_path / f"{name}.usdc"
    report = import_scene(Path(folder) / name / f"{name}.xml", out)
    objects, triangles = BUNDLED[name]
    assert report.triangles == triangles and report.objects >= objects
    read = Scene.from_usd(out)
    assert len(read.nodes) == report.objects and read.warnings == ()
