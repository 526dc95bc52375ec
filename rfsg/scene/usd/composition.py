"""What composition brings to a prim: its opinions, the arcs that carry them, the units they mean."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from pxr import Pcp, Sdf, Usd, UsdGeom

from rfsg.scene.scene import SceneError
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


def refuse_foreign_units(file: str) -> None:
    """An object is put into a scene by the numbers of its weights, which count in its layer's units and
    axes. Raises SceneError for others than metres, z up."""
    layer = Sdf.Layer.FindOrOpen(file)
    unit, up = metre_of(layer), up_of(layer)
    if (unit, up) != (1.0, "Z"):
        raise SceneError(
            [f"{file}: metersPerUnit is {unit} and upAxis {up}; expected 1 and Z of an asset that is "
             "put into a scene. Reference it in USD, with the scale and the turn that it needs"]
        )  # fmt: skip


def unit_faults(prim: Usd.Prim, time: Usd.TimeCode) -> Iterator[str]:
    """USD converts neither units nor axes across references: refuse, naming what to add.

    What converts is the prim's own transform as a whole, or ops of their own whose names end in
    ``:unitsResolve``, as Omniverse names them."""
    if not (prim.HasAuthoredReferences() or prim.HasAuthoredPayloads()):
        return
    if not any(p.IsA(UsdGeom.Xformable) for p in Usd.PrimRange(prim)):
        return  # a library of materials has no size and no up
    local = _local(prim, time)
    for inner, outer in _joints(prim):
        ratio, turn = ratio_of(inner, outer), turn_of(inner, outer)
        if ratio != 1.0 and not (_scaled(local, ratio) or _resolved(prim, "scale", ratio, time)):
            yield (
                f"{prim.GetPath()}: references {inner.realPath}, whose metersPerUnit is "
                f"{metre_of(inner):g} (here {metre_of(outer):g}); add the scale {ratio:g} on this prim"
            )
        if turn != 0.0 and not (
            _turned(local, inner, outer) or _resolved(prim, "rotateX", turn, time)
        ):
            yield (
                f"{prim.GetPath()}: references {inner.realPath}, whose upAxis is {up_of(inner)} (here "
                f"{up_of(outer)}); add rotateX = {turn:g} on this prim"
            )


def sublayer_warnings(stage: Usd.Stage) -> Iterator[str]:
    """Sublayers that count otherwise than the root, whose word alone holds. No fault: many say units
    and have nothing in them that has a size."""
    root = stage.GetRootLayer()
    for layer in stage.GetLayerStack(includeSessionLayers=False)[1:]:
        if ratio_of(layer, root) != 1.0:
            yield (
                f"{layer.realPath}: a sublayer whose metersPerUnit is {metre_of(layer):g} (here "
                f"{metre_of(root):g}); USD converts nothing, and it is read by the latter"
            )
        if turn_of(layer, root) != 0.0:
            yield (
                f"{layer.realPath}: a sublayer whose upAxis is {up_of(layer)} (here {up_of(root)}); USD "
                "converts nothing, and it is read by the latter"
            )


def conversion(prim: Usd.Prim) -> tuple[float, float]:
    """(scale, turn about x [degrees]) that a prim owes to the units and axes of what it references."""
    pairs = [(ratio_of(*joint), turn_of(*joint)) for joint in _joints(prim)]
    return next((pair for pair in pairs if pair != (1.0, 0.0)), (1.0, 0.0))


def _joints(prim: Usd.Prim) -> Iterator[tuple[Sdf.Layer, Sdf.Layer]]:
    """(inner, outer) layers of each reference and payload of a prim that is not an ancestor's."""
    for arc in arcs(prim):
        if arc.IsAncestral() or arc.GetArcType() not in _REFERENCES:
            continue
        outer, inner = layer_of(arc.GetIntroducingNode()), layer_of(arc.GetTargetNode())
        if outer is not None and inner is not None and outer != inner:
            yield inner, outer


def ratio_of(inner: Sdf.Layer, outer: Sdf.Layer) -> float:
    """Units of the outer layer in one of the inner; 1 where they agree or do not say."""
    mine, theirs = metre_of(outer), metre_of(inner)
    if mine is None or theirs is None or mine <= 0 or np.isclose(mine, theirs, rtol=TOLERANCE):
        return 1.0
    return theirs / mine


def turn_of(inner: Sdf.Layer, outer: Sdf.Layer) -> float:
    """Degrees about x that turn the inner layer's up into the outer's; 0 where they agree."""
    mine, theirs = up_of(outer), up_of(inner)
    if mine is None or theirs is None or mine == theirs or {mine, theirs} - {"Y", "Z"}:
        return 0.0
    return 90.0 if theirs == "Y" else -90.0


def _local(prim: Usd.Prim, time: Usd.TimeCode) -> Any:
    xform = UsdGeom.Xformable(prim)
    return np.array(xform.GetLocalTransformation(time)).T if xform else np.eye(4)


def _scaled(local: Any, ratio: float) -> bool:
    return bool(np.allclose(np.linalg.norm(local[:3, :3], axis=0), ratio, rtol=TOLERANCE))


def _turned(local: Any, inner: Sdf.Layer, outer: Sdf.Layer) -> bool:
    axis = {"Y": np.array([0, 1.0, 0]), "Z": np.array([0, 0, 1.0])}
    turned = local[:3, :3] @ axis[up_of(inner) or "Z"]
    length = np.linalg.norm(turned)
    return bool(np.allclose(turned, length * axis[up_of(outer) or "Z"], atol=TOLERANCE * length))


def _resolved(prim: Usd.Prim, kind: str, wanted: float, time: Usd.TimeCode) -> bool:
    """Whether the prim's op ``xformOp:KIND:unitsResolve`` has the value that is wanted."""
    xform = UsdGeom.Xformable(prim)
    ops = xform.GetOrderedXformOps() if xform else []
    values = [op.Get(time) for op in ops if op.GetOpName() == f"xformOp:{kind}:unitsResolve"]
    return bool(values) and bool(np.allclose(np.array(values[0]), wanted, rtol=TOLERANCE))
