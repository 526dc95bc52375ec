"""Assets on their way to disk: the files of one object, side by side or in one package.

NAME.safetensors holds the object, NAME.png its picture; NAME.usda says where they are and what they
hash to, and carries the meshes that other programs show: the surface (purpose default) and its convex
hull (purpose guide). ``NAME.usdz`` is the same files in one, stored, each on a multiple of 64 bytes.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdMedia

from rfsg.objects.body import Body
from rfsg.objects.contract import Shape
from rfsg.objects.shapes.shown import corner_normals
from rfsg.scene.fields import NEURAL
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import NEURAL_API, author
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.layers import new_stage
from rfsg.scene.usd.meshes import author_triangles, vectors
from rfsg.scene.weights import FORMAT_VERSION, digest, pack, refuse_overwrite, write_beside

PACKAGE = ".usdz"
EPOCH = 946_684_800  # 2000-01-01: files in packages carry one time, so that equal ones are equal


def asset_files(
    stem: str,
    body: Body,
    *,
    name: str,
    mesh: Any | None = None,
    hull: Any | None = None,
    picture: bytes | None = None,
    provenance: Mapping[str, Any] | None = None,
    color: Sequence[float] = (),
) -> dict[str, bytes]:
    """The files of an asset by name, the USD layer last; see ``rfsg.scene.assets.save_asset``."""
    files = {f"{stem}.safetensors": pack(body)}
    if picture is not None:
        files[f"{stem}.png"] = picture
    stage = new_stage()
    root = UsdGeom.Xform.Define(stage, f"/{Tf.MakeValidIdentifier(name)}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    values = _neural_values(root, stem, files[f"{stem}.safetensors"], body, provenance or {})
    author(root, dict(zip(NEURAL, values, strict=True)), NEURAL_API)
    if picture is not None:
        _show(root, f"./{stem}.png")
    if mesh is not None:
        _define_surface(stage, f"{root.GetPath()}/Surface", mesh, color)
    if hull is not None:
        _define_hull(stage, f"{root.GetPath()}/Hull", *hull)
    files[f"{stem}.usda"] = stage.GetRootLayer().ExportToString().encode()
    return files


def write_asset(usda: Path, body: Body, *, name: str, overwrite: bool, **options: Any) -> None:
    """Write an asset's files beside one another; see ``rfsg.scene.assets.save_asset``."""
    refuse_overwrite([usda, usda.with_suffix(".safetensors")], overwrite)
    write_files(usda.parent, asset_files(usda.stem, body, name=name, **options), overwrite)


def write_files(folder: Path, files: Mapping[str, bytes], overwrite: bool) -> None:
    """Write files into a folder that is there, in the order given: with the layer last, what an
    interruption leaves is refused by its hash."""
    refuse_overwrite([folder / name for name in files], overwrite)
    for name, data in files.items():
        write_beside(folder / name, data, overwrite)


def write_folder(folder: Path, files: Mapping[str, bytes], overwrite: bool) -> None:
    """Write files into a folder. One that is not there appears whole or not at all."""
    if folder.exists():
        return write_files(folder, files, overwrite)
    if not folder.parent.is_dir():
        raise SceneError([f"{folder}: the folder {folder.parent} does not exist; make it first"])
    beside = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        beside.mkdir()
        write_files(beside, files, False)
        os.rename(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_package(usdz: Path, files: Mapping[str, bytes], overwrite: bool) -> None:
    """Write files as one package whose root layer is the last of them. Equal files give equal bytes."""
    refuse_overwrite([usdz], overwrite)
    with tempfile.TemporaryDirectory(prefix="rfsg-") as folder, quiet(usdz):
        package = os.path.join(folder, "package.usdz")
        writer = Sdf.ZipFileWriter.CreateNew(package)
        for name in reversed(list(files)):  # the root layer is what a package begins with
            file = os.path.join(folder, name)
            Path(file).write_bytes(files[name])
            os.utime(file, (EPOCH, EPOCH))
            writer.AddFile(file, name)
        if not writer.Save():
            raise SceneError([f"{usdz}: OpenUSD could not write the package"])
        write_beside(usdz, Path(package).read_bytes(), overwrite)


def add_shown(usda: Path, picture: bytes, hull: Any) -> None:
    """Give an asset that has none its picture, NAME.png beside it and named in its layer, and its hull.

    Raises SceneError for a layer without a default prim."""
    with quiet(usda):
        layer = Sdf.Layer.OpenAsAnonymous(str(usda))
        stage = Usd.Stage.Open(layer)
        root = stage.GetDefaultPrim()
        if not root:
            raise SceneError([f"{usda}: has no default prim, so no scene could reference it"])
        _show(root, f"./{usda.stem}.png")
        if not root.GetChild("Hull"):
            _define_hull(stage, f"{root.GetPath()}/Hull", *hull)
        text = layer.ExportToString()
        del root, stage, layer
    write_beside(usda.with_suffix(".png"), picture, True)
    write_beside(usda, text.encode(), True)


def _neural_values(
    root: Usd.Prim, stem: str, weights: bytes, body: Body, provenance: Mapping[str, Any]
) -> tuple[Any, ...]:
    """The values of ``NEURAL``. Raises SceneError for what no asset can say."""
    try:
        story = json.dumps(provenance, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SceneError([f"{root.GetPath()}: the provenance is not JSON: {error}"]) from error
    low, high = _bounds(body.shape)
    path = Sdf.AssetPath(f"./{stem}.safetensors")
    slope, band = float(body.shape.lipschitz), body.band or (None, None)
    return path, FORMAT_VERSION, digest(weights), low, high, slope, story, *band


def _bounds(shape: Shape) -> list[Gf.Vec3f]:
    """The corners of what it may take up; those of a half-space are infinite."""
    return [Gf.Vec3f(*row) for row in shape.bounds().detach().cpu().tolist()]


def _show(root: Usd.Prim, picture: str) -> None:
    api = UsdMedia.AssetPreviewsAPI.Apply(root)
    shown = UsdMedia.AssetPreviewsAPI.Thumbnails(defaultImage=Sdf.AssetPath(picture))
    api.SetDefaultThumbnails(shown)


def _define_surface(stage: Usd.Stage, path: str, mesh: Any, color: Sequence[float]) -> None:
    vertices, faces, normals = (np.asarray(part) for part in mesh)
    finite = np.isfinite(vertices).all() and np.isfinite(normals).all()
    inside = len(faces) > 0 and faces.min() >= 0 and faces.max() < len(vertices)
    if not (finite and inside and normals.shape == vertices.shape):
        raise SceneError([f"{path}: the mesh has bad indices, or normals or numbers amiss"])
    prim = UsdGeom.Mesh.Define(stage, path)
    author_triangles(prim, vertices, faces)
    # faceVarying: Blender's importer takes custom normals from nothing else
    prim.CreateNormalsAttr(vectors(corner_normals(vertices, faces, normals).reshape(-1, 3)))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    prim.CreateExtentAttr(vectors(np.stack([vertices.min(0), vertices.max(0)])))
    prim.CreateDisplayColorAttr([Gf.Vec3f(*(float(c) for c in color))])


def _define_hull(stage: Usd.Stage, path: str, vertices: ndarray, faces: ndarray) -> None:
    prim = UsdGeom.Mesh.Define(stage, path)
    author_triangles(prim, vertices, faces)
    prim.CreateExtentAttr(vectors(np.stack([vertices.min(0), vertices.max(0)])))
    prim.CreatePurposeAttr(UsdGeom.Tokens.guide)
