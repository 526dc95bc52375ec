"""Stages and files: a layer is opened after a look at its file, and only what lies in the folders
that a scene may read."""

import os
from collections.abc import Sequence
from pathlib import Path

from pxr import Ar, Sdf, Usd, UsdGeom, UsdUtils

from rfsg.scene import files
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.faults import PXR_ERRORS, pxr_words


def open_stage(path: Path, roots: Sequence[Path]) -> Usd.Stage:
    """Open a stage whose every layer was first found safe to open. Raises SceneError."""
    faults: list[str] = []
    layers = _safe_layers([str(path.absolute())], roots, faults)
    if faults:
        raise SceneError(faults)
    return Usd.Stage.Open(layers[0], Sdf.Layer.CreateAnonymous("session.usda"))


def reload(layers: Sequence[Sdf.Layer], roots: Sequence[Path]) -> None:
    """Take over files that changed on disk, each after a look at it and at what it now names: a
    layer that is part of a stage composes the moment it is reloaded. Raises SceneError, and then
    nothing was taken over."""
    faults: list[str] = []
    named: list[str] = []
    for layer in layers:
        file = layer.realPath
        reason = files.unsafe_layer(file)
        try:
            fresh = None if reason else Sdf.Layer.OpenAsAnonymous(file)
        except PXR_ERRORS as error:
            fresh, reason = None, pxr_words(error)
        if fresh is None:
            faults.append(f"{file}: {reason or 'cannot be opened'}")
            continue
        named += _named(fresh, layer, roots, faults)
    _held = _safe_layers(named, roots, faults)  # held until they are part of the stage
    if faults:
        raise SceneError(faults)
    with Sdf.ChangeBlock():
        for layer in layers:
            layer.Reload(force=True)


def composed_again(stage: Usd.Stage, roots: Sequence[Path]) -> Usd.Stage:
    """The same layers in a new stage: a file that was missing when a stage was composed stays missing
    in it, though it is there by now. Raises SceneError for files that may not be opened."""
    faults: list[str] = []
    used = [layer.realPath for layer in stage.GetUsedLayers() if layer.realPath]
    _held = _safe_layers(used, roots, faults)
    if faults:
        raise SceneError(faults)
    return Usd.Stage.Open(stage.GetRootLayer(), stage.GetSessionLayer())


def _safe_layers(named: Sequence[str], roots: Sequence[Path], faults: list[str]) -> list[Sdf.Layer]:
    """Open the layers that composition would open, each after a look at its file."""
    layers: list[Sdf.Layer] = []
    seen: set[str] = set(named)
    todo = list(named)
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
        found = [file for file in _named(layer, layer, roots, faults) if file not in seen]
        todo += found
        seen.update(found)
    return layers


def _named(
    layer: Sdf.Layer, anchor: Sdf.Layer, roots: Sequence[Path], faults: list[str]
) -> list[str]:
    """The files that a layer composes with, as seen from another; those refused join the faults.
    What is missing is among the composition errors later."""
    named: list[str] = []
    composing = layer.GetCompositionAssetDependencies()
    if external(layer) - set(composing):  # clips name files, and looking for them takes its time
        clips = "value clips, files that OpenUSD opens while values are read: not read; stitch them into one"
        faults += [f"{anchor.realPath} <{path}>: {clips}" for path in _clipped(layer)]
    for given in filter(None, composing):
        found, why = _look_up(given, anchor.ComputeAbsolutePath(given), roots)
        if why:
            faults.append(f"{anchor.realPath}{_users(layer, given)}: {given!r} {why}")
        elif found:
            named.append(found)
    return named


def external(layer: Sdf.Layer) -> set[str]:
    """Every path of a file that a layer names, in arcs, attributes and metadata; opens none of them."""
    return set().union(*UsdUtils.ExtractExternalReferences(layer.identifier)) - {""}


def gathered(path: Path, roots: Sequence[Path]) -> tuple[set[Path], dict[str, str]]:
    """(files on disc, {path as given: why it is refused or missing}) of all that a layer names, and what
    the layers among it name. OpenUSD's own search opens whatever it finds; this looks first."""
    found: set[Path] = set()
    refused: dict[str, str] = {}
    seen, todo = {str(path.absolute())}, [str(path.absolute())]
    while todo:
        file = todo.pop()
        found.add(Path(os.path.realpath(files.outer_file(file))))
        if not is_layer(file):
            continue
        reason = files.unsafe_layer(file)
        try:
            layer = None if reason else Sdf.Layer.FindOrOpen(file)
        except PXR_ERRORS as error:
            layer, reason = None, pxr_words(error)
        if layer is None:
            refused[file] = reason or "cannot be opened"
            continue
        for given in external(layer):
            resolved, why = _look_up(given, layer.ComputeAbsolutePath(given), roots)
            if why or not resolved:
                refused[given] = why or "not found"
            elif resolved not in seen:
                seen.add(resolved)
                todo.append(resolved)
    return found, refused


def is_layer(file: str) -> bool:
    """Whether OpenUSD would take a file for a layer, by its ending."""
    return Sdf.FileFormat.FindByExtension(file) is not None


def _clipped(layer: Sdf.Layer) -> list[Sdf.Path]:
    """The prims of a layer that take values from clips."""
    found: list[Sdf.Path] = []

    def visit(path: Sdf.Path) -> None:
        prim = path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        if prim and layer.GetPrimAtPath(path).HasInfo("clips"):
            found.append(path)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return found


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
