"""Mesh files with a material table: obj, ply, glb, gltf, stl. The only door to trimesh in scenes."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from numpy import ndarray
from trimesh.resolvers import Resolver

from rfsg.scene import files
from rfsg.scene.errors import SceneError
from rfsg.scene.importers.obj import Group, read_obj
from rfsg.scene.importers.parts import MAX_TRIANGLES, Imported, Part, divided, is_closed
from rfsg.scene.importers.ply import MAX_BYTES, read_ply
from rfsg.scene.importers.table import EXAMPLE, Table, read_table

MESHES = (".obj", ".ply", ".glb", ".gltf", ".stl")
SAID = (".glb", ".gltf")  # metres and y up, by the format's own rules
Z_FROM_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_meshes(
    path: Path, materials: Path | None, metre: float | None = None, up: str | None = None
) -> Imported:
    """A mesh file's objects, with the materials that a table gives their names.

    metre, up: metres per unit and "y" or "z"; where neither they, nor the table, nor the format say
    them, SceneError asks. It lists every object without a row in the table, too.
    """
    if materials is None:
        raise SceneError(
            [f"{path}: a mesh file says nothing of radio waves; give a material table, with rows "
             f"such as {EXAMPLE}"]
        )  # fmt: skip
    table = read_table(materials)
    metre, up = _frame(path, table, metre, up)
    turn = np.eye(3) if up == "z" else Z_FROM_Y
    parts, faults, used = [], [], {}
    for group in _groups(path):
        row = table.row(group.name, group.material)
        if row is None:
            of = f" (material {group.material!r})" if group.material else ""
            faults.append(f"{materials}: no row for {group.name!r}{of} of {path}")
            continue
        if not len(group.triangles):
            continue
        vertices = metre * group.vertices @ turn.T
        solid = row.material.model in ("solid", "stochastic")
        closed = is_closed(vertices, group.triangles)
        if solid and not closed:
            faults.append(f"{path}: {group.name!r} is not closed; a {row.material.model} must be")
        sheet = not closed if row.sheet is None else row.sheet
        used[row.pattern] = row.material
        parts += divided(Part(group.name, vertices, group.triangles, row.pattern, sheet))
    if not parts and not faults:
        faults.append(f"{path}: holds no triangles")
    if faults:
        raise SceneError(faults)
    return Imported(tuple(parts), used, (), str(path))


def _frame(path: Path, table: Table, metre: float | None, up: str | None) -> tuple[float, str]:
    """Metres per unit and the upward axis: as asked, else as the table or the format says."""
    said = path.suffix.lower() in SAID
    metre = metre or table.metre or (1.0 if said else None)
    up = up or table.up or ("y" if said else None)
    faults = []
    if metre is None:
        faults.append(f"{path}: {path.suffix} has no unit; say how many metres one is (metre)")
    elif not 0 < metre < 1e6:
        faults.append(f"{path}: metre is {metre}; expected metres per unit, a number > 0")
    if up is None:
        faults.append(f"{path}: {path.suffix} does not say what points up; give up, y or z")
    elif up not in ("y", "z"):
        faults.append(f'{path}: up is {up!r}; expected "y" or "z"')
    if faults or metre is None or up is None:
        raise SceneError(faults)
    return metre, up


def _groups(path: Path) -> Iterator[Group]:
    ending = path.suffix.lower()
    if ending == ".obj":
        yield from read_obj(path)
    elif ending == ".ply":
        yield Group(path.stem, "", *read_ply(path))
    else:
        yield from _by_trimesh(path)


class _Folder(Resolver):
    """What a glTF file names beside itself (buffers): only in its own folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def get(self, name: str) -> bytes:
        file = self.folder / name
        if files.is_url(name) or files.outside(str(file), [self.folder]):
            raise ValueError(f"{name!r} lies outside the file's folder")
        if file.stat().st_size > MAX_BYTES:
            raise ValueError(f"{name!r} is larger than {MAX_BYTES} bytes")
        return file.read_bytes()

    def namespaced(self, namespace: str) -> "_Folder":
        return _Folder(self.folder / namespace)

    def keys(self) -> list[str]:
        return []

    def write(self, name: str, data: bytes) -> None:
        raise ValueError("nothing is written")


def _by_trimesh(path: Path) -> Iterator[Group]:
    if path.stat().st_size > MAX_BYTES:
        raise SceneError([f"{path}: larger than {MAX_BYTES} bytes"])
    try:
        if path.suffix.lower() in SAID:
            _refuse_counts(path)
        with path.open("rb") as file:
            scene = trimesh.load_scene(
                file,
                file_type=path.suffix[1:].lower(),
                resolver=_Folder(path.parent),
                process=False,
                skip_materials=False,
            )
    except Exception as error:  # the readers raise whatever the format's own library raises
        raise SceneError([f"{path}: cannot be read as meshes: {error}"]) from error
    total = 0
    for node in sorted(scene.graph.nodes_geometry):
        try:
            place, name = scene.graph[node]
            mesh = scene.geometry[name]
            if not isinstance(mesh, trimesh.Trimesh):
                continue
            total += len(mesh.faces)
            if total > MAX_TRIANGLES:
                raise ValueError(f"more than {MAX_TRIANGLES} triangles")
            group = Group(str(node), _material(mesh), *_placed(mesh, np.asarray(place, np.float64)))
        except Exception as error:  # places are put together when they are asked for
            raise SceneError([f"{path}: {node!r:.60} is no mesh: {error}"]) from error
        yield group


def _refuse_counts(path: Path) -> None:
    """glTF makes arrays as long as an accessor says, with or without bytes for them. ValueError."""
    data = path.read_bytes()
    if data[:4] == b"glTF":  # binary: a header of 12 bytes, then the JSON with its length
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    accessors = json.loads(data).get("accessors", [])
    counts = [accessor.get("count", 0) for accessor in accessors]
    most = 3 * MAX_TRIANGLES
    for n in counts:
        if not isinstance(n, int) or not 0 <= n <= most:
            raise ValueError(f"it declares {n!r:.40} rows; expected {most} at most")


def _placed(mesh: trimesh.Trimesh, place: ndarray) -> tuple[ndarray, ndarray]:
    vertices = np.asarray(mesh.vertices, np.float64) @ place[:3, :3].T + place[:3, 3]
    triangles = np.asarray(mesh.faces, np.int64)
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ValueError(f"corners up to {triangles.max()}; there are {len(vertices)} vertices")
    if not np.isfinite(vertices).all():
        raise ValueError("vertices that are not finite")
    mirrored = np.linalg.det(place[:3, :3]) < 0
    return vertices, triangles[:, ::-1] if mirrored else triangles


def _material(mesh: trimesh.Trimesh) -> str:
    material = getattr(mesh.visual, "material", None)
    return str(getattr(material, "name", "") or "")
