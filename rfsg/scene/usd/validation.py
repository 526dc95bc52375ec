"""What is amiss with a scene or an asset, by prim: what reading refuses, what the validators that come
with OpenUSD find, and what neither of them looks at."""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdMedia, UsdValidation

from rfsg.objects.body import Body
from rfsg.scene import files
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.usd.attributes import MATERIAL_API, NEURAL_API, RADIO_API
from rfsg.scene.usd.faults import one_line
from rfsg.scene.usd.layers import asset_bytes, gathered, is_layer
from rfsg.scene.usd.objects import WEIGHTS
from rfsg.scene.usd.reading import examine

NEEDS = {  # an API that says what a prim is, and the attribute without which it is nothing
    NEURAL_API: WEIGHTS,
    MATERIAL_API: "rfsg:material:model",
    RADIO_API: "rfsg:radio:role",
}
PICTURES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")  # how PNG and JPEG begin
MAX_PICTURE_BYTES = 2**24
FLOAT32 = 1e-6  # bounds are single precision in USD: how far they may lie off, of their size
PACKAGED_WEIGHTS = (
    "weights lie in the package as .safetensors, an ending that strict readers of .usdz do not know: "
    "by design, for weights keep their bits and their hash. rfsg and USD itself read it; for a program "
    "that refuses it, unpack it or export a folder"
)


@dataclass(frozen=True)
class Findings:
    """``faults``, one line each that begins with its prim or file, prim by prim; ``notes``: what a
    validator finds and rfsg means to be so, with the reason."""

    faults: tuple[str, ...]
    notes: tuple[str, ...]


def check(path: str | Path, **options: Any) -> list[str]:
    """Every fault of a scene or an asset, one line each: what ``read`` (same options) refuses, what
    the validators of OpenUSD find, and our own checks. An empty list is a file in order."""
    return list(findings(path, **options).faults)


def findings(path: str | Path, **options: Any) -> Findings:
    """As ``check``, with what is a finding by design apart."""
    notes: list[str] = []

    def look(stage: Usd.Stage, scene: Scene, roots: Sequence[Path]) -> Iterator[str]:
        bodies = {node.path: node.body for node in scene.nodes}
        for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
            for fault in _amiss(prim, bodies, roots):
                yield f"{prim.GetPath()}: {fault}"
        _, refused = gathered(Path(path), roots)
        unsafe = {g: why for g, why in refused.items() if is_layer(g) and why != "not found"}
        for given, why in unsafe.items():
            yield f"{path}: {given!r} {why}; OpenUSD's validators would open it, and were not asked"
        for error in () if unsafe else _validated(stage):
            if _is_packaged_weights(error):
                notes.append(f"{path}: {PACKAGED_WEIGHTS}")
            else:
                yield _line(error, str(path))

    faults = examine(path, look, **options)
    ours = [f for f in faults if "(OpenUSD " not in f]
    kept = [f for f in faults if not _repeats(f, ours)]
    return Findings(tuple(_by_prim(kept)), tuple(dict.fromkeys(notes)))


def _by_prim(faults: Sequence[str]) -> list[str]:
    """In the order in which prims and files come up first."""
    order: dict[str, list[str]] = {}
    for fault in faults:
        order.setdefault(fault.split(": ", 1)[0], []).append(fault)
    return [fault for group in order.values() for fault in group]


# OpenUSD


def _validated(stage: Usd.Stage) -> list[Any]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return UsdValidation.ValidationContext(validators).Validate(stage)


def _line(error: Any, file: str) -> str:
    prims = [str(s.GetPrim().GetPath()) for s in error.GetSites() if s.GetPrim()]
    where = prims[0] if prims else file
    return f"{where}: {one_line(error.GetMessage())} (OpenUSD {error.GetName()})"


def _repeats(line: str, ours: Sequence[str]) -> bool:
    """Whether a validator's line says what ours say with the prim: what does not compose, or resolve."""
    if line.endswith("(OpenUSD CompositionError)"):
        return bool(ours)
    if not line.endswith("(OpenUSD UnresolvableDependency)"):
        return False
    named = re.findall(r"'([^']+)'", line)
    return any(Path(name).name in fault for name in named for fault in ours)


def _is_packaged_weights(error: Any) -> bool:
    return "extension" in error.GetMessage() and "'safetensors'" in error.GetMessage()


# our own


def _amiss(prim: Usd.Prim, bodies: dict[str, Body], roots: Sequence[Path]) -> Iterator[str]:
    for api in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
        wanted = NEEDS.get(str(api))
        if wanted and not prim.GetAttribute(wanted).HasAuthoredValue():
            yield f"{api} is applied, but {wanted} is not given"
    if prim.IsA(UsdGeom.Mesh):
        yield from _mesh(UsdGeom.Mesh(prim))
    if prim.GetAttribute(WEIGHTS).HasAuthoredValue():
        yield from _story(prim)
        if (body := bodies.get(str(prim.GetPath()))) is not None:
            yield from _bounds(prim, body)
    yield from _picture(prim, roots)


def _mesh(mesh: UsdGeom.Mesh) -> Iterator[str]:
    """Topology, and one normal for each of what they belong to: drawn meshes that waves do not see
    included."""
    time = Usd.TimeCode.EarliestTime()
    points = mesh.GetPointsAttr().Get(time) or ()
    index, count = (
        a.Get(time) or () for a in (mesh.GetFaceVertexIndicesAttr(), mesh.GetFaceVertexCountsAttr())
    )
    drawn = len(index) or len(count)
    fine, why = UsdGeom.Mesh.ValidateTopology(index, count, len(points)) if drawn else (True, "")
    if not fine:
        yield f"the mesh is broken: {one_line(why)}"
    if len(points) and not np.isfinite(np.asarray(points)).all():
        yield "points hold numbers that are not finite"
    normals, kind = mesh.GetNormalsAttr().Get(time), mesh.GetNormalsInterpolation()
    wanted = {"faceVarying": len(index), "vertex": len(points), "varying": len(points)}.get(kind)
    if normals is not None and wanted is not None and len(normals) != wanted:
        yield f"{len(normals)} normals, {kind}; expected {wanted}"


def _story(prim: Usd.Prim) -> Iterator[str]:
    story = prim.GetAttribute("rfsg:neural:provenance").Get()
    try:
        told = json.loads(story) if story else {}
        if not isinstance(told, dict):
            yield "rfsg:neural:provenance is not a JSON object"
    except (ValueError, RecursionError) as error:
        yield f"rfsg:neural:provenance is not JSON: {error}"


def _bounds(prim: Usd.Prim, body: Body) -> Iterator[str]:
    """What the layer says of the object's size and slope, beside what the weights say."""
    actual = body.shape.bounds().detach().cpu().double().numpy()
    size = max(1.0, float(np.abs(actual).max()))
    for name, row in zip(("boundsMin", "boundsMax"), actual, strict=True):
        said = prim.GetAttribute(f"rfsg:neural:{name}").Get()
        if said is not None and np.abs(np.asarray(said) - row).max() > FLOAT32 * size:
            yield f"rfsg:neural:{name} is {tuple(said)}; the weights say {tuple(row.round(4).tolist())}"
    said, slope = prim.GetAttribute("rfsg:neural:lipschitz").Get(), float(body.shape.lipschitz)
    if said is not None and abs(said - slope) > FLOAT32 * slope:
        yield f"rfsg:neural:lipschitz is {said}; the weights say {slope}"


def _picture(prim: Usd.Prim, roots: Sequence[Path]) -> Iterator[str]:
    """The thumbnail that a prim names: there, readable, a picture."""
    shown = UsdMedia.AssetPreviewsAPI(prim).GetDefaultThumbnails()
    asset = shown.defaultImage if shown else Sdf.AssetPath()
    if not asset.path:
        return
    found = str(asset.resolvedPath)
    if not found:
        yield f"picture {asset.path!r} not found"
    elif why := files.outside(found, roots):
        yield f"picture {asset.path!r} {why}"
    else:
        try:
            data = asset_bytes(found, f"picture {asset.path!r}", MAX_PICTURE_BYTES)
        except SceneError as error:
            yield error.faults[0]
            return
        if not data.startswith(PICTURES):
            yield f"picture {asset.path!r} is neither PNG nor JPEG"
