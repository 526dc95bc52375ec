"""USD <-> Scene: the only door to pxr. Attributes are the truth; the API schemas are a courtesy."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar, Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdUtils, Vt

from rfsg.objects.body import Body
from rfsg.objects.contract import Shape
from rfsg.scene import files
from rfsg.scene.scene import SceneError
from rfsg.scene.weights import MAX_WEIGHTS_BYTES, digest, unpack

NEURAL_API = "RfsgNeuralObjectAPI"


@dataclass(frozen=True)
class AssetRecord:
    """What an asset's USD file says, and the object its weights hold."""

    body: Body
    provenance: dict[str, Any]
    weights: str
    sha256: str


# ---- assets -----------------------------------------------------------------------------------


def asset_layer(
    name: str,
    weights: str,
    sha256: str,
    shape: Shape,
    mesh: Any | None,
    provenance: Mapping[str, Any],
    color: Sequence[float],
) -> str:
    """The text of an asset's USD layer; see ``rfsg.scene.assets.save_asset``."""
    try:
        story = json.dumps(provenance, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SceneError([f"/{name}: the provenance is not JSON: {error}"]) from error
    stage = Usd.Stage.CreateInMemory()
    _stage_conventions(stage)
    name = Tf.MakeValidIdentifier(name)
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    root.AddAppliedSchema(NEURAL_API)
    low, high = shape.bounds().detach().cpu().tolist()
    _author(root, "rfsg:neural:weights", "asset", Sdf.AssetPath(f"./{weights}"))
    _author(root, "rfsg:neural:formatVersion", "int", 1)
    _author(root, "rfsg:neural:sha256", "string", sha256)
    _author(root, "rfsg:neural:boundsMin", "float3", Gf.Vec3f(*low))
    _author(root, "rfsg:neural:boundsMax", "float3", Gf.Vec3f(*high))
    _author(root, "rfsg:neural:lipschitz", "double", float(shape.lipschitz))
    _author(root, "rfsg:neural:provenance", "string", story)
    if mesh is not None:
        _define_mesh(stage, f"/{name}/Surface", mesh, color)
    return stage.GetRootLayer().ExportToString()


def read_asset(path: Path) -> AssetRecord:
    """Read the object of an asset's USD file: its default prim, or the only one with weights."""
    roots = (files.default_root(path),)
    with _quiet():
        stage = _open(path, roots)
        prim = stage.GetDefaultPrim()
        if not prim or not prim.HasAttribute("rfsg:neural:weights"):
            found = [p for p in stage.Traverse() if p.HasAttribute("rfsg:neural:weights")]
            if len(found) != 1:
                raise SceneError([f"{path}: holds {len(found)} neural objects; expected one"])
            prim = found[0]
        weights, sha256, data = _weights_bytes(prim, roots, str(prim.GetPath()))
        story = prim.GetAttribute("rfsg:neural:provenance").Get() or "{}"
    try:
        provenance = json.loads(story)
    except ValueError as error:
        raise SceneError([f"{prim.GetPath()}: rfsg:neural:provenance is not JSON"]) from error
    return AssetRecord(unpack(data, f"{path}: {weights}"), provenance, weights, sha256)


def _define_mesh(stage: Usd.Stage, path: str, mesh: Any, color: Sequence[float]) -> None:
    vertices, faces, normals = (np.asarray(part) for part in mesh)
    fine = (
        np.isfinite(vertices).all()
        and np.isfinite(normals).all()
        and normals.shape == vertices.shape
    )
    if not fine or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError(
            [f"{path}: the mesh has bad indices, normals or numbers that are not finite"]
        )
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices.astype(np.float32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    # faceVarying: Blender's importer takes custom normals from nothing else
    prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals[faces.ravel()].astype(np.float32)))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(
        Vt.Vec3fArray([Gf.Vec3f(*vertices.min(0).tolist()), Gf.Vec3f(*vertices.max(0).tolist())])
    )
    prim.CreateDisplayColorAttr([Gf.Vec3f(*(float(c) for c in color))])


def _weights_bytes(prim: Usd.Prim, roots: Sequence[Path], where: str) -> tuple[str, str, bytes]:
    """Resolved path, sha256, bytes of a prim's weights; read through Ar so that packages work."""
    value = prim.GetAttribute("rfsg:neural:weights").Get()
    # Blender's round trip turns asset paths into strings
    given = value.path if isinstance(value, Sdf.AssetPath) else str(value or "")
    resolved = value.resolvedPath if isinstance(value, Sdf.AssetPath) else ""
    if not given:
        raise SceneError([f"{where}: rfsg:neural:weights is empty"])
    if files.is_url(given):
        raise SceneError([f"{where}: weights {given!r} is a URL; rfsg reads files only"])
    if not resolved:
        raise SceneError([f"{where}: weights {given!r} not found"])
    if reason := files.outside(resolved, roots):
        raise SceneError([f"{where}: weights {given!r} {reason}"])
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
    if not asset:
        raise SceneError([f"{where}: weights {given!r} cannot be opened"])
    if asset.GetSize() > MAX_WEIGHTS_BYTES:
        raise SceneError([f"{where}: weights {given!r} exceed {MAX_WEIGHTS_BYTES} bytes"])
    data = bytes(asset.Read(asset.GetSize(), 0))
    declared, actual = prim.GetAttribute("rfsg:neural:sha256").Get(), digest(data)
    if declared != actual:
        raise SceneError(
            [
                f"{where}: weights {given!r} hash to {actual}, but rfsg:neural:sha256 says "
                f"{declared}; the file was changed or is not the one this asset was saved with"
            ]
        )
    return resolved, actual, data


# ---- opening ----------------------------------------------------------------------------------


@contextmanager
def _quiet() -> Iterator[None]:
    """Hold pxr's diagnostics: what matters is said again as faults, with prim paths."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


def _open(path: Path, roots: Sequence[Path]) -> Usd.Stage:
    """Open a stage whose every layer was first found safe to open."""
    faults: list[str] = []
    layers = _safe_layers(path, roots, faults)
    if faults:
        raise SceneError(faults)
    return Usd.Stage.Open(layers[0])


def _safe_layers(path: Path, roots: Sequence[Path], faults: list[str]) -> list[Sdf.Layer]:
    layers, seen, todo = [], set(), [str(Path(path).absolute())]
    while todo:
        file = todo.pop()
        reason = files.unsafe_layer(file)
        try:
            layer = None if reason else Sdf.Layer.FindOrOpen(file)
        except Tf.ErrorException as error:
            layer, reason = None, _sentence(error)
        if layer is None:
            faults.append(f"{file}: {reason or 'cannot be opened'}")
            continue
        layers.append(layer)
        for given in layer.GetCompositionAssetDependencies():
            if not given:
                continue
            if files.is_url(given):
                faults.append(f"{file}: {given!r} is a URL; rfsg reads files only")
                continue
            found = str(Ar.GetResolver().Resolve(layer.ComputeAbsolutePath(given)))
            if not found or found in seen:
                continue  # what is missing shows among the composition errors, with its prim
            seen.add(found)
            if why := files.outside(found, roots):
                faults.append(f"{file}: {given!r} {why}")
            else:
                todo.append(found)
    return layers


def _sentence(error: Tf.ErrorException) -> str:
    """The message of a pxr exception without the names of its C++ functions."""
    text = str(error).strip()
    return text.split(" : '", 1)[-1].rstrip("'\n ") if " : '" in text else text


# ---- authoring --------------------------------------------------------------------------------


def _stage_conventions(stage: Usd.Stage) -> None:
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)


def _author(prim: Usd.Prim, name: str, kind: str, value: Any) -> None:
    """Every value explicit and custom: other programs lose fallbacks and schema attributes."""
    types = Sdf.ValueTypeNames
    known = {
        "asset": types.Asset, "int": types.Int, "string": types.String, "token": types.Token,
        "double": types.Double, "float3": types.Float3, "double3": types.Double3,
    }  # fmt: skip
    prim.CreateAttribute(name, known[kind], custom=True).Set(value)
