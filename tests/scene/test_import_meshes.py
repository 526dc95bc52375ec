"""Mesh files with a material table: units, axes, names, and what is refused."""

import json

import numpy as np
import pytest
import trimesh

from rfsg.scene.importers import import_scene
from rfsg.scene.importers.meshes import read_meshes
from rfsg.scene.importers.table import read_table
from rfsg.scene.materials import Material
from rfsg.scene.scene import Scene, SceneError
from tests.scene.importing import WALL, write_ply

TABLE = """metre = 0.01
up = "z"

[materials]
"*glass*" = { itu = "glass", thickness = 0.006 }
"wall*" = { itu = "concrete", thickness = 0.2 }
"crate" = { itu = "metal" }
"block" = { model = "solid", epsR = 4.0, sigma = 0.01 }
"""
OBJ = """mtllib /etc/passwd
v 0 -100 0
v 0 100 0
v 0 100 200
v 0 -100 200
o wall_1
usemtl paint
f 1/1/1 2/2/1 3/3/1 4/4/1
o front
usemtl Clear_Glass
f -4 -3 -2
"""


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "materials.toml"
    path.write_text(TABLE)
    return path


def test_names_of_objects_and_materials_find_their_rows(tmp_path, table):
    """In centimetres by the table; the file that the mesh names is never opened."""
    (tmp_path / "house.obj").write_text(OBJ)
    read = read_meshes(tmp_path / "house.obj", table)
    assert [(p.name, p.material, p.sheet) for p in read.parts] == [
        ("wall_1", "wall*", True), ("front", "*glass*", True)
    ]  # fmt: skip
    assert read.materials["*glass*"] == Material("slab", itu="glass", thickness=0.006)
    np.testing.assert_allclose(read.parts[0].vertices, WALL, atol=1e-12)


def test_units_and_axes_are_asked_for_where_nothing_says_them(tmp_path, table):
    table.write_text(TABLE.replace('metre = 0.01\nup = "z"\n', ""))
    (tmp_path / "house.obj").write_text(OBJ)
    with pytest.raises(SceneError) as error:
        read_meshes(tmp_path / "house.obj", table)
    assert [f.split("; ")[0].split(": ")[1] for f in error.value.faults] == [
        ".obj has no unit", ".obj does not say what points up"
    ]  # fmt: skip
    read = read_meshes(tmp_path / "house.obj", table, metre=1.0, up="y")
    # what was along z lies along -y
    assert read.parts[0].vertices[:, 1].min() == pytest.approx(-200.0)


@pytest.mark.parametrize("ending", ["glb", "stl", "ply"])
def test_boxes_of_every_format_are_closed_and_stand_where_they_did(tmp_path, table, ending):
    """A crate of 1 x 2 x 3 units, 5 along x; glTF is y up and in metres, by its own rules."""
    made = trimesh.creation.box(extents=(1.0, 2.0, 3.0))
    made.apply_translation((5.0, 0.0, 0.0))
    path = tmp_path / f"crate.{ending}"
    if ending == "ply":
        write_ply(path, made.vertices, made.faces)
    else:
        trimesh.Scene({"crate": made}).export(path)
    table.write_text(TABLE.replace('"crate"', '"*"').replace('metre = 0.01\nup = "z"\n', ""))
    table.write_text(table.read_text().replace('"*glass*"', '"glass"'))
    said = ending == "glb"
    given = {} if said else {"metre": 1.0, "up": "z"}
    (part,) = read_meshes(path, table, **given).parts
    sides = np.ptp(part.vertices, axis=0)
    np.testing.assert_allclose(sides, (1, 3, 2) if said else (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(part.vertices.mean(0)[0], 5.0, atol=1e-6)
    assert not part.sheet


def test_a_closed_mesh_is_a_solid_and_an_open_one_a_sheet(tmp_path, table):
    made = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    made.export(tmp_path / "block.obj")
    text = (tmp_path / "block.obj").read_text()
    (tmp_path / "block.obj").write_text("o block\n" + text)
    out = tmp_path / "block.usda"
    import_scene(tmp_path / "block.obj", out, materials=table, metre=1.0, up="z")
    (node,) = Scene.from_usd(out).nodes
    assert node.body.surface.kind == "solid" and node.body.shape.convex
    # less one face it encloses nothing for a solid to fill
    lines = (tmp_path / "block.obj").read_text().splitlines()
    lines.remove(next(line for line in lines if line.startswith("f ")))
    (tmp_path / "block.obj").write_text("\n".join(lines))
    with pytest.raises(SceneError, match="'block' is not closed; a solid must be"):
        read_meshes(tmp_path / "block.obj", table, metre=1.0, up="z")


def test_every_object_without_a_row_is_named(tmp_path, table):
    (tmp_path / "house.obj").write_text(OBJ.replace("wall_1", "roof").replace("Clear_Glass", "oak"))
    with pytest.raises(SceneError) as error:
        read_meshes(tmp_path / "house.obj", table)
    assert ["'roof' (material 'paint')" in f or "'front' (material 'oak')" in f
            for f in error.value.faults] == [True, True]  # fmt: skip


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ('"a" = { itu = "cheese", thickness = 1 }', "ITU material 'cheese'; expected one of"),
        ('"a" = { itu = "brick" }', "a slab needs a thickness"),
        ('"a" = { itu = "brick", thickness = -1.0 }', "thickness in metres > 0"),
        ('"a" = { itu = "brick", thickness = 0.1, colour = "red" }', "'colour' is unknown"),
        ('"a" = "brick"', "expected a row such as"),
        ('"a" = { itu = "brick", thickness = 0.1, sheet = "yes" }', "sheet is 'yes'"),
        ('"a" = { model = "solid" }', "needs itu, or epsR"),
    ],
)
def test_rows_that_make_no_material_are_refused(table, row, message):
    table.write_text(f"[materials]\n{row}\n")
    with pytest.raises(SceneError, match=f"materials.a: .*{message}"):
        read_table(table)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("x.obj", b"v 0 0 0\nf 1 2 3\n", "line 2: a face names corner 2; there are 1"),
        ("x.obj", b"v 0 0 zero\n", "line 1: could not convert"),
        ("x.obj", b"v 0 0 0\nv 0 0\n", "line 2: not enough values"),
        ("x.obj", b"v 0 0 0\n", "holds no faces"),
        ("x.glb", b"glTF\x02\x00\x00\x00", "cannot be read as meshes"),
        ("x.stl", b"\x00" * 10, "holds no triangles"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, table, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SceneError, match=rf"{name}: {message}"):
        read_meshes(tmp_path / name, table, metre=1.0, up="z")


def test_a_gltf_may_not_name_files_outside_its_folder(tmp_path, table):
    made = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    inner = tmp_path / "inner"
    inner.mkdir()
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene({"crate": made}))
    for name, data in files.items():
        (inner / name).write_bytes(data)
    table.write_text(TABLE.replace('metre = 0.01\nup = "z"\n', ""))
    assert len(read_meshes(inner / "model.gltf", table).parts) == 1
    buffer = next(name for name in files if name.endswith(".bin"))
    (inner / buffer).rename(tmp_path / buffer)
    text = (inner / "model.gltf").read_text()
    (inner / "model.gltf").write_text(text.replace(buffer, f"../{buffer}"))
    with pytest.raises(SceneError, match="outside the file's folder"):
        read_meshes(inner / "model.gltf", table)


def test_without_a_table_nothing_is_guessed(tmp_path):
    (tmp_path / "house.obj").write_text(OBJ)
    with pytest.raises(SceneError, match="says nothing of radio waves; give a material table"):
        import_scene(tmp_path / "house.obj", tmp_path / "house.usda")


@pytest.mark.parametrize("change, expected", [
    (lambda told: told["accessors"][0].update(count=10**12), "it declares 1000000000000 rows"),
    (lambda told: told["nodes"][-1].update(matrix=[1, 2, [3]] + [0] * 13), "is no mesh|cannot be read"),
])  # fmt: skip
def test_a_gltf_that_declares_what_it_should_not(tmp_path, table, change, expected):
    for name, data in trimesh.exchange.gltf.export_gltf(
        trimesh.Scene(trimesh.creation.box())
    ).items():
        (tmp_path / name).write_bytes(data)
    told = json.loads((tmp_path / "model.gltf").read_text())
    change(told)
    (tmp_path / "model.gltf").write_text(json.dumps(told))
    with pytest.raises(SceneError, match=expected):
        read_meshes(tmp_path / "model.gltf", table)
