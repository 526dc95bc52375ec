"""Objects in asset files: one trained object and its record, read, and found in a scene."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdMedia

from rfsg.objects.body import Body
from rfsg.scene import files
from rfsg.scene.fields import BAND, NEURAL
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import values_of
from rfsg.scene.usd.composition import arcs, layer_of, metre_of, up_of
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.layers import asset_bytes, asset_path, gathered, open_stage
from rfsg.scene.weights import MAX_WEIGHTS_BYTES, digest, same_bits, unpack

WEIGHTS = NEURAL[0].name


@dataclass(frozen=True)
class AssetRecord:
    """What an asset's USD file says, and the object its weights hold.

    prim: path of the object in the file. picture: the resolved path of its thumbnail, if there is
    one that may be read. extent: of the surface that other programs show [m], lowest and highest
    corner. referable: a scene in metres, z up, may reference the file as it is. parts: all files of
    the asset, when they lie in its own folder; none otherwise."""

    prim: str
    body: Body
    provenance: dict[str, Any]
    weights: str
    sha256: str
    picture: str | None
    extent: np.ndarray | None
    referable: bool
    parts: tuple[Path, ...]

    def holds(self, body: Body, otherwise_bound: bool) -> tuple[bool, bool]:
        """(whether the asset has the body's surface and band too, whether it can stand for the body): it
        has the same shape, and the surface or one that is ``otherwise_bound`` where it is referenced."""
        own = same_bits(body.surface, self.body.surface) and body.band == self.body.band
        return own, same_bits(body.shape, self.body.shape) and (own or otherwise_bound)


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
        band = band_of(where, values_of(prim, Usd.TimeCode.EarliestTime(), *BAND))
        picture, extent, parts = _picture(prim, roots), _extent(prim), _parts(path, roots)
        layer = stage.GetRootLayer()
        referable = prim == root and (metre_of(layer), up_of(layer)) == (1.0, "Z")
    try:
        provenance = json.loads(story)
    except (ValueError, RecursionError) as error:
        raise SceneError([f"{where}: rfsg:neural:provenance is not JSON: {error}"]) from error
    body = unpack(data, f"{path}: {given}", resolved)
    body.band = band
    sha256 = digest(data)
    return AssetRecord(where, body, provenance, resolved, sha256, picture, extent, referable, parts)


def band_of(where: str, said: Mapping[str, Any]) -> tuple[float, float] | None:
    """Lowest and highest frequency [Hz] that an object was learned at, None where nothing is said.

    Raises SceneError for half a band, or one upside down."""
    low, high = (said[item.name] for item in BAND)
    if low is None and high is None:
        return None
    if low is None or high is None or high < low:
        names = " and ".join(item.name for item in BAND)
        raise SceneError([f"{where}: {names} are {low} and {high}; expected both, the lower first"])
    return low, high


def _picture(prim: Usd.Prim, roots: tuple[Path, ...]) -> str | None:
    shown = UsdMedia.AssetPreviewsAPI(prim).GetDefaultThumbnails()
    found = str(shown.defaultImage.resolvedPath) if shown else ""
    return found if found and not files.outside(found, roots) else None


def _extent(prim: Usd.Prim) -> np.ndarray | None:
    """What the surface drawn of an object says that it spans [2 3], None where it says nothing."""
    for child in prim.GetChildren():
        drawn = child.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(child).ComputePurpose() == "default"
        extent = np.array(UsdGeom.Mesh(child).GetExtentAttr().Get() or ()) if drawn else None
        if extent is not None and extent.shape == (2, 3) and np.isfinite(extent).all():
            return extent.astype(np.float64)
    return None


def _parts(path: Path, roots: tuple[Path, ...]) -> tuple[Path, ...]:
    """The files that an asset consists of, the given one first; none when one of them is missing or
    lies outside its folder."""
    found, refused = gathered(path, roots)
    first = Path(os.path.realpath(path))
    whole = not refused and all(f.is_relative_to(first.parent) for f in found)
    return (first, *sorted(found - {first})) if whole else ()


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
