"""Objects in asset files: one trained object and its record, read, written, and found in a scene."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom

from rfsg.objects.body import Body
from rfsg.objects.contract import Shape
from rfsg.scene import files
from rfsg.scene.fields import NEURAL
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import NEURAL_API, author
from rfsg.scene.usd.composition import arcs, layer_of, metre_of, up_of
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.layers import asset_bytes, asset_path, new_stage, open_stage
from rfsg.scene.usd.meshes import author_triangles, vectors
from rfsg.scene.weights import (
    FORMAT_VERSION,
    MAX_WEIGHTS_BYTES,
    digest,
    pack,
    refuse_overwrite,
    unpack,
    write_beside,
)

WEIGHTS = NEURAL[0].name


@dataclass(frozen=True)
class AssetRecord:
    """What an asset's USD file says, and the object its weights hold.

    referable: a scene in metres, z up, may reference the file as it is. portable: the two files
    are the whole asset, side by side."""

    body: Body
    provenance: dict[str, Any]
    weights: str
    sha256: str
    referable: bool
    portable: bool


def read_asset(path: Path) -> AssetRecord:
    """Read the object of an asset's USD file: its default prim, or the only one with weights.

    Raises SceneError listing every fault."""
    roots = (files.default_root(path),)
    with quiet(path):
        stage = open_stage(path, roots)
        root = stage.GetDefaultPrim()
        found = [p for p in stage.Traverse() if p.GetAttribute(WEIGHTS).HasAuthoredValue()]
        if root not in found and len(found) != 1:
            raise SceneError([f"{path}: holds {len(found)} neural objects; expected one"])
        prim = root if root in found else found[0]
        where = str(prim.GetPath())
        resolved, given = asset_path(prim, WEIGHTS, roots, where)
        data = weights_bytes(prim, resolved, given, where)
        story = prim.GetAttribute("rfsg:neural:provenance").Get() or "{}"
        layer = stage.GetRootLayer()
        referable = prim == root and (metre_of(layer), up_of(layer)) == (1.0, "Z")
    try:
        provenance = json.loads(story)
    except (ValueError, RecursionError) as error:
        raise SceneError([f"{where}: rfsg:neural:provenance is not JSON: {error}"]) from error
    beside = Path(resolved).parent == Path(os.path.realpath(path)).parent
    portable = beside and not any(layer.GetCompositionAssetDependencies())
    body = unpack(data, f"{path}: {given}", resolved)
    return AssetRecord(body, provenance, resolved, digest(data), referable, portable)


def weights_bytes(prim: Usd.Prim, resolved: str, given: str, where: str) -> bytes:
    """The weights' bytes, of bounded size and the right hash."""
    data = asset_bytes(resolved, f"{where}: weights {given!r}", MAX_WEIGHTS_BYTES)
    said, actual = prim.GetAttribute("rfsg:neural:sha256").Get(), digest(data)
    if said != actual:
        raise SceneError(
            [f"{where}: weights {given!r} hash to {actual}, but rfsg:neural:sha256 says {said!r}; "
             "the file was changed, or is not the one this asset was saved with"]
        )  # fmt: skip
    return data


def asset_metre(prim: Usd.Prim) -> float:
    """metersPerUnit of the layer that brought a prim's weights in. Raises SceneError."""
    layer, _ = _home(prim)
    metre = metre_of(layer)
    if metre is None or not (np.isfinite(metre) and metre > 0):
        raise SceneError(
            [f"{prim.GetPath()}: {layer.identifier} says metersPerUnit {metre}; expected > 0"]
        )
    return metre


def asset_file(prim: Usd.Prim) -> str | None:
    """The asset's USD file, when a reference to that file alone gives the object."""
    layer, path = _home(prim)
    whole = path == Sdf.Path(f"/{layer.defaultPrim}") and layer != prim.GetStage().GetRootLayer()
    return layer.realPath if whole and layer.realPath else None


def _home(prim: Usd.Prim) -> tuple[Sdf.Layer, Sdf.Path]:
    """Root layer and path of the weakest opinion on the weights: where the object came in."""
    home = (prim.GetStage().GetRootLayer(), prim.GetPath())
    for arc in arcs(prim):
        node = arc.GetTargetNode()
        at = node.path.AppendProperty(WEIGHTS)
        if any(layer.GetAttributeAtPath(at) for layer in node.layerStack.layers):
            home = (layer_of(node) or home[0], node.path)
    return home


def write_asset(
    usda: Path,
    body: Body,
    name: str,
    mesh: Any | None,
    provenance: Mapping[str, Any],
    color: Sequence[float],
    overwrite: bool,
) -> None:
    """Write an asset's two files; see ``rfsg.scene.assets.save_asset``."""
    weights = usda.with_suffix(".safetensors")
    refuse_overwrite([usda, weights], overwrite)
    data = pack(body)
    layer = _asset_layer(name, weights.name, digest(data), body.shape, mesh, provenance, color)
    # weights first: an interruption in between leaves a hash that does not match, no mix
    write_beside(weights, data, overwrite)
    write_beside(usda, layer.encode(), overwrite)


def _asset_layer(
    name: str,
    weights: str,
    sha256: str,
    shape: Shape,
    mesh: Any | None,
    provenance: Mapping[str, Any],
    color: Sequence[float],
) -> str:
    name = Tf.MakeValidIdentifier(name)
    try:
        story = json.dumps(provenance, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SceneError([f"/{name}: the provenance is not JSON: {error}"]) from error
    stage = new_stage()
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    low, high = shape.bounds().detach().cpu().tolist()
    values = (
        Sdf.AssetPath(f"./{weights}"),
        FORMAT_VERSION,
        sha256,
        Gf.Vec3f(*low),
        Gf.Vec3f(*high),
        float(shape.lipschitz),
        story,
    )
    author(root, dict(zip(NEURAL, values, strict=True)), NEURAL_API)
    if mesh is not None:
        _define_mesh(stage, f"/{name}/Surface", mesh, color)
    return stage.GetRootLayer().ExportToString()


def _define_mesh(stage: Usd.Stage, path: str, mesh: Any, color: Sequence[float]) -> None:
    vertices, faces, normals = (np.asarray(part) for part in mesh)
    finite = np.isfinite(vertices).all() and np.isfinite(normals).all()
    inside = len(faces) > 0 and faces.min() >= 0 and faces.max() < len(vertices)
    if not (finite and inside and normals.shape == vertices.shape):
        raise SceneError([f"{path}: the mesh has bad indices, or normals or numbers amiss"])
    prim = UsdGeom.Mesh.Define(stage, path)
    author_triangles(prim, vertices, faces)
    # faceVarying: Blender's importer takes custom normals from nothing else
    prim.CreateNormalsAttr(vectors(normals[faces.ravel()]))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    prim.CreateExtentAttr(vectors(np.stack([vertices.min(0), vertices.max(0)])))
    prim.CreateDisplayColorAttr([Gf.Vec3f(*(float(c) for c in color))])
