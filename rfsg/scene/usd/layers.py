"""Stages and files: a layer is opened after a look at its file, and only what lies in the folders
that a scene may read."""

from collections.abc import Sequence
from pathlib import Path

from pxr import Ar, Sdf, Usd, UsdGeom

from rfsg.scene import files
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.faults import PXR_ERRORS, pxr_words


def open_stage(path: Path, roots: Sequence[Path]) -> Usd.Stage:
    """Open a stage whose every layer was first found safe to open. Raises SceneError."""
    faults: list[str] = []
    layers = _safe_layers(path, roots, faults)
    if faults:
        raise SceneError(faults)
    return Usd.Stage.Open(layers[0], Sdf.Layer.CreateAnonymous("session.usda"))


def _safe_layers(path: Path, roots: Sequence[Path], faults: list[str]) -> list[Sdf.Layer]:
    """Open the layers that composition would open, each after a look at its file."""
    layers: list[Sdf.Layer] = []
    seen: set[str] = set()
    todo = [str(path.absolute())]
    while todo:
        file = todo.pop()
        reason = files.unsafe_layer(file)
        try:
            layer = None if reason else _current(file)
        except PXR_ERRORS as error:
            layer, reason = None, pxr_words(error)
        if layer is None:
            faults.append(f"{file}: {reason or 'cannot be opened'}")
            continue
        layers.append(layer)
        for given in layer.GetCompositionAssetDependencies():
            found, why = (
                _look_up(given, layer.ComputeAbsolutePath(given), roots) if given else ("", "")
            )
            if why:
                faults.append(f"{file}{_users(layer, given)}: {given!r} {why}")
            elif found and found not in seen:  # what is missing is among the composition errors
                todo.append(found)
            seen.add(found)
    return layers


def _current(file: str) -> Sdf.Layer | None:
    """The layer as the file is now: pxr hands out one that is open already, however old. Edits that
    somebody has not saved yet are left alone."""
    layer = Sdf.Layer.FindOrOpen(file)
    if layer and not layer.dirty:
        layer.Reload()
    return layer


def _look_up(given: str, anchored: str, roots: Sequence[Path]) -> tuple[str, str]:
    """(resolved path or "", why it is refused or "") of an asset path."""
    if files.is_url(given):
        return "", "is a URL; rfsg reads files only"
    found = str(Ar.GetResolver().Resolve(anchored))
    return found, (files.outside(found, roots) or "") if found else ""


def _users(layer: Sdf.Layer, given: str) -> str:
    """`` </World/Cabinet>`` when a prim of the layer references or loads the asset path."""
    users: list[str] = []

    def visit(path: Sdf.Path) -> None:
        prim = path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        spec = layer.GetPrimAtPath(path) if prim else None
        if spec:
            arcs = [*spec.referenceList.GetAddedOrExplicitItems()]
            arcs += spec.payloadList.GetAddedOrExplicitItems()
            users.extend(f" <{path}>" for arc in arcs if arc.assetPath == given)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return users[0] if users else ""


def asset_path(prim: Usd.Prim, name: str, roots: Sequence[Path], where: str) -> tuple[str, str]:
    """(resolved path, path as given) of the file that an attribute names, which may be read."""
    value = prim.GetAttribute(name).Get()
    if isinstance(value, Sdf.AssetPath):
        given, anchored = value.path, value.resolvedPath
    else:  # Blender's round trip turns asset paths into strings, without their anchor
        given = str(value or "")
        anchored = prim.GetStage().GetRootLayer().ComputeAbsolutePath(given) if given else ""
    if not given:
        raise SceneError([f"{where}: {name} is empty"])
    resolved, why = _look_up(given, anchored, roots)
    if why or not resolved:
        raise SceneError([f"{where}: {name.split(':')[-1]} {given!r} {why or 'not found'}"])
    return resolved, given


def asset_bytes(resolved: str, what: str, limit: int) -> bytes:
    """A file's bytes, of bounded size; through Ar, so packages work."""
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
    size = asset.GetSize() if asset else 0
    if not asset or size > limit:
        amiss = f"take {size} bytes; the limit is {limit}" if asset else "cannot be opened"
        raise SceneError([f"{what} {amiss}"])
    return bytes(asset.Read(size, 0)) if size else b""


def new_stage() -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    return stage
