"""Meshes in USD: polygons become the triangles of a ``Mesh``, and back.

A mesh is a closed solid, unless its customData say that it is a sheet: ``rfsg = { bool sheet = true }``.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy import ndarray
from pxr import Usd, UsdGeom, UsdShade, Vt

from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.polygons import triangles_of
from rfsg.objects.shapes.sheet import Sheet
from rfsg.objects.shapes.sheet_soup import soups
from rfsg.objects.shapes.topology import MAX_TRIANGLES
from rfsg.scene.fields import MESH_POINTS
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import author, values_of
from rfsg.scene.usd.kept import Kept


@dataclass(frozen=True)
class MeshRead:
    """The arrays of a mesh prim, from which its shape is made; and the key under which it is kept."""

    where: str
    point: ndarray  # [v 3] in the prim's units, of which ``scales`` [3] make metres
    count: ndarray
    index: ndarray
    scales: ndarray
    sheet: bool
    key: str

    def arrays(self) -> tuple[ndarray, ndarray]:
        """Vertices [v 3] m and triangles [t 3]. Raises ValueError."""
        return self.point * self.scales, triangles_of(self.point, self.count, self.index)


def read_mesh(prim: Usd.Prim, time: Usd.TimeCode, scales: ndarray, shared: str) -> MeshRead:
    """What a mesh prim says; equal arrays under one ``shared`` have one key. Raises SceneError for arrays
    that are no mesh."""
    where = str(prim.GetPath())
    point, count, index = (_array(prim, name, time) for name in NAMES)
    if faults := _amiss(point, count, index):
        raise SceneError([f"{where}: {fault}" for fault in faults])
    _refuse_subsets(prim)
    exact = values_of(prim, time, MESH_POINTS)[MESH_POINTS.name]
    # what another program moved since is where that program put it
    if exact is not None and np.array_equal(exact.astype(np.float32), point.astype(np.float32)):
        point = exact
    sheet = is_sheet(prim)
    key = ("mesh", shared, str(sheet), *(a.tobytes() for a in (scales, point, count, index)))
    return MeshRead(where, point, count, index, scales, sheet, digest_of(key))


def shapes_of(meshes: Sequence[MeshRead], kept: Kept) -> dict[str, Mesh | SceneError]:
    """The shape of each mesh by its key, or why there is none. Sheets are made all at once: a city is
    thousands, of a few triangles each."""
    made: dict[str, Mesh | SceneError] = {}
    sheets: dict[str, tuple[ndarray, ndarray]] = {}
    each = {mesh.key: mesh for mesh in meshes}
    for mesh in each.values():
        try:
            if mesh.sheet and not kept.holds(mesh.key):
                sheets[mesh.key] = mesh.arrays()
            else:
                made[mesh.key] = kept.of(mesh.key, partial(_solid, mesh))
        except ValueError as error:
            made[mesh.key] = _no_solid(mesh, error)
    for key, soup in zip(sheets, soups(list(sheets.values())), strict=True):
        if isinstance(soup, ValueError):
            made[key] = _no_solid(each[key], soup)
        else:
            made[key] = kept.of(key, partial(Sheet.of, soup))
    return made


def _solid(mesh: MeshRead) -> Mesh:
    return Mesh(*mesh.arrays(), sheet=mesh.sheet)


def _no_solid(mesh: MeshRead, why: ValueError) -> SceneError:
    return SceneError(
        [f"{mesh.where}: no solid for waves: {why}. A shape that is not closed can be repaired and "
         "learned with `rfsg learn-shape`, or be a sheet: customData rfsg:sheet = true"]
    )  # fmt: skip


SHEET = {"rfsg": {"sheet": True}}  # customData of a mesh without an inside


def is_sheet(prim: Usd.Prim) -> bool:
    """Whether a mesh prim says that it is a surface without an inside."""
    return prim.GetCustomDataByKey("rfsg:sheet") is True


def digest_of(key: tuple[str | bytes, ...]) -> str:
    """A short key in place of one that holds arrays."""
    parts = (part.encode() if isinstance(part, str) else part for part in key)
    return hashlib.sha256(b"".join(len(p).to_bytes(8, "little") + p for p in parts)).hexdigest()


NAMES = ("points", "faceVertexCounts", "faceVertexIndices")


def smoothed(prim: Usd.Prim) -> bool:
    """Whether a mesh is the cage of a subdivision surface, which is read as it stands."""
    scheme = UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr()
    return scheme.HasAuthoredValue() and scheme.Get() != UsdGeom.Tokens.none


def _array(prim: Usd.Prim, name: str, time: Usd.TimeCode) -> ndarray:
    value = prim.GetAttribute(name).Get(time)
    empty = np.zeros((0, 3)) if name == "points" else np.zeros(0, dtype=np.int64)
    return empty if value is None else np.array(value).astype(empty.dtype)


def _amiss(point: ndarray, count: ndarray, index: ndarray) -> list[str]:
    """What is wrong with the arrays, before anything is made of them."""
    if not len(count):
        return ["a mesh without faces; a mesh of waves is closed"]
    if count.min() < 3 or int(count.sum()) != len(index):
        return [
            f"faceVertexCounts name {int(count.sum())} corners, at least {int(count.min())} a face; "
            f"expected the {len(index)} of faceVertexIndices, 3 or more a face"
        ]
    if index.min() < 0 or index.max() >= len(point):
        return [
            f"faceVertexIndices go from {index.min()} to {index.max()}; there are {len(point)} points"
        ]
    if not np.isfinite(point).all():
        return ["points hold numbers that are not finite"]
    triangles = int((count - 2).sum())
    if triangles > MAX_TRIANGLES:
        return [
            f"{triangles} triangles; expected {MAX_TRIANGLES} at most. Divide the mesh into objects, "
            "or learn it as a neural object with `rfsg learn-shape`"
        ]
    return []


def _refuse_subsets(prim: Usd.Prim) -> None:
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        binding = UsdShade.MaterialBindingAPI(subset)
        own = binding.GetDirectBinding("radio").GetMaterial()
        own = own or binding.GetDirectBinding().GetMaterial()
        if own and own.GetPrim().GetAttribute("rfsg:material:model").HasAuthoredValue():
            raise SceneError(
                [f"{subset.GetPath()}: a radio material on a part of a mesh; an object has one. "
                 "Divide the mesh by material"]
            )  # fmt: skip


def author_mesh(prim: Usd.Prim, shape: Mesh) -> None:
    """Points in single precision, as USD meshes hold them, and beside them as they are if that is
    not the same."""
    point = shape.vertices.detach().cpu().to(torch.float64).numpy()
    triangles = shape.triangles.cpu().numpy()
    if isinstance(shape, Sheet):
        triangles = triangles[: len(triangles) // 2]  # both sides of each are its own business
        prim.SetCustomDataByKey("rfsg:sheet", True)
    author_triangles(UsdGeom.Mesh(prim), point, triangles)
    if not np.array_equal(point.astype(np.float32).astype(np.float64), point):
        author(prim, {MESH_POINTS: Vt.Vec3dArray.FromNumpy(point)})


def author_triangles(mesh: UsdGeom.Mesh, point: ndarray, triangles: ndarray) -> None:
    """Points and triangles of a mesh that is not to be subdivided."""
    mesh.CreatePointsAttr(vectors(point))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.astype(np.int32).ravel()))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)


def vectors(values: ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))
