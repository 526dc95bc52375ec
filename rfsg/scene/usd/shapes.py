"""Known shapes: prims of USD's own types with their sizes, and half-spaces."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from rfsg.scene.fields import SHAPE
from rfsg.scene.scene import SceneError
from rfsg.scene.transforms import Placement
from rfsg.scene.usd.attributes import author
from rfsg.scene.usd.meshes import author_mesh

# the prims that are known shapes, with the attributes that size them
SIZES = {
    "Cube": ("size",),
    "Sphere": ("radius",),
    "Cylinder": ("radius", "height"),
    "Capsule": ("radius", "height"),
}
# columns: where a shape's own x, y, z (axis along z) point in a prim with this axis
_AXES = {
    "X": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "Y": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "Z": np.eye(3),
}
# the prim of each shape of the catalogue
PRIM_TYPES = {
    "box": "Cube",
    "sphere": "Sphere",
    "cylinder": "Cylinder",
    "capsule": "Capsule",
    "halfspace": "Xform",
    "mesh": "Mesh",
}


def sizes_of(prim: Usd.Prim, time: Usd.TimeCode) -> dict[str, float]:
    """The attributes that size a known shape, in the prim's own units. Raises SceneError."""
    return {name: _size(prim, name, time) for name in SIZES[str(prim.GetTypeName())]}


def _size(prim: Usd.Prim, name: str, time: Usd.TimeCode) -> float:
    value = prim.GetAttribute(name).Get(time)
    if not isinstance(value, float) or not np.isfinite(value) or value <= 0:
        raise SceneError([f"{prim.GetPath()}: {name} is {value!r}; expected a number > 0"])
    return value


def turned(prim: Usd.Prim, placement: Placement) -> Placement:
    """The placement of a cylinder's or capsule's own frame, whose axis is z whatever the prim's."""
    turn = _AXES[str(prim.GetAttribute("axis").Get())]
    return Placement(placement.rotation @ turn, placement.translation, placement.scales @ turn)


def measure(
    kind: str, sizes: Mapping[str, float], placement: Placement
) -> tuple[str, dict[str, Any]]:
    """Catalogue kind and lengths [m] of a known shape, the placement's scales absorbed.

    Raises ValueError for scales that the shape cannot absorb."""
    if kind == "cube":
        return "box", {"half_size": (sizes["size"] / 2 * placement.scales).tolist()}
    if kind == "cylinder":
        half_height = sizes["height"] / 2 * float(placement.scales[2])
        return kind, {
            "radius": sizes["radius"] * placement.uniform(0, 1),
            "half_height": half_height,
        }
    scale = placement.uniform()
    if kind == "sphere":
        return kind, {"radius": sizes["radius"] * scale}
    if kind == "capsule":
        return kind, {"radius": sizes["radius"] * scale, "half_height": sizes["height"] / 2 * scale}
    return kind, {}


def author_shape(prim: Usd.Prim, shape: Any) -> np.ndarray:
    """Author the sizes of a known shape; returns the stretch that its transform carries (boxes)."""
    lengths = {} if shape.kind == "mesh" else shape.config()
    if shape.kind == "mesh":
        author_mesh(prim, shape)
    if shape.kind == "halfspace":
        author(prim, {SHAPE: "halfspace"})
    if "radius" in lengths:
        prim.GetAttribute("radius").Set(lengths["radius"])
    if "half_height" in lengths:
        prim.GetAttribute("height").Set(2 * lengths["half_height"])
        prim.GetAttribute("axis").Set("Z")
    if shape.kind == "box":
        prim.GetAttribute("size").Set(2.0)
    if prim.IsA(UsdGeom.Boundable):
        boundable = UsdGeom.Boundable(prim)
        time = Usd.TimeCode.Default()
        extent = UsdGeom.Boundable.ComputeExtentFromPlugins(boundable, time)
        boundable.CreateExtentAttr(extent)
    return np.array(lengths.get("half_size", np.ones(3)), dtype=np.float64)
