"""What composition brings to a prim: its opinions, the arcs that carry them, the units they mean."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from pxr import Pcp, Sdf, Usd, UsdGeom

from rfsg.scene.transforms import TOLERANCE

_REFERENCES = (Pcp.ArcTypeReference, Pcp.ArcTypePayload)


def is_prim_path(path: str) -> bool:
    valid = bool(Sdf.Path.IsValidPathString(path))
    return valid and path.startswith("/") and Sdf.Path(path).IsPrimPath()


def spec(prim: Usd.Prim) -> Usd.Prim:
    """The prim that holds the opinions: for what lies in an instance, the prototype's."""
    return prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim


def arcs(prim: Usd.Prim) -> list[Any]:
    """The composition arcs of a prim, strongest first."""
    return Usd.PrimCompositionQuery(spec(prim)).GetCompositionArcs()


def layer_of(node: Any) -> Sdf.Layer | None:
    return node.layerStack.identifier.rootLayer if node else None


def metre_of(layer: Sdf.Layer) -> float | None:
    """metersPerUnit as the layer says it, None where it does not."""
    root = layer.pseudoRoot
    return float(root.GetInfo("metersPerUnit")) if root.HasInfo("metersPerUnit") else None


def up_of(layer: Sdf.Layer) -> str | None:
    root = layer.pseudoRoot
    return str(root.GetInfo("upAxis")) if root.HasInfo("upAxis") else None


def unit_faults(prim: Usd.Prim, time: Usd.TimeCode) -> Iterator[str]:
    """USD converts neither units nor axes across references: refuse, naming what to add."""
    if not (prim.HasAuthoredReferences() or prim.HasAuthoredPayloads()):
        return
    if not any(p.IsA(UsdGeom.Xformable) for p in Usd.PrimRange(prim)):
        return  # a library of materials has no size and no up
    xform = UsdGeom.Xformable(prim)
    local = np.array(xform.GetLocalTransformation(time)).T if xform else np.eye(4)
    for arc in arcs(prim):
        if arc.IsAncestral() or arc.GetArcType() not in _REFERENCES:
            continue
        outer, inner = layer_of(arc.GetIntroducingNode()), layer_of(arc.GetTargetNode())
        if outer is None or inner is None or outer == inner:
            continue
        yield from _same_metre(prim, local, inner, outer)
        yield from _same_up(prim, local, inner, outer)


def _same_metre(prim: Usd.Prim, local: Any, inner: Sdf.Layer, outer: Sdf.Layer) -> Iterator[str]:
    mine, theirs = metre_of(outer), metre_of(inner)
    if mine is None or theirs is None or mine <= 0 or np.isclose(mine, theirs, rtol=TOLERANCE):
        return
    ratio = theirs / mine
    scales = np.linalg.norm(local[:3, :3], axis=0)
    if not np.allclose(scales, ratio, rtol=TOLERANCE):
        yield (
            f"{prim.GetPath()}: references {inner.realPath}, whose metersPerUnit is {theirs:g} "
            f"(here {mine:g}); add the scale {ratio:g} on this prim"
        )


def _same_up(prim: Usd.Prim, local: Any, inner: Sdf.Layer, outer: Sdf.Layer) -> Iterator[str]:
    mine, theirs = up_of(outer), up_of(inner)
    if mine is None or theirs is None or mine == theirs or {mine, theirs} - {"Y", "Z"}:
        return
    axis = {"Y": np.array([0, 1.0, 0]), "Z": np.array([0, 0, 1.0])}
    turned = local[:3, :3] @ axis[theirs]
    length = np.linalg.norm(turned)
    if not np.allclose(turned, length * axis[mine], atol=TOLERANCE * length):
        yield (
            f"{prim.GetPath()}: references {inner.realPath}, whose upAxis is {theirs} (here "
            f"{mine}); add rotateX = {90 if theirs == 'Y' else -90} on this prim"
        )
