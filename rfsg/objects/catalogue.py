"""Kind token -> class, for reading assets: the one table of shapes and surfaces.

Classes are named, not imported, so that reading a box does not load a network. A new kind is one
line here and one module.
"""

from importlib import import_module

SHAPES = {
    "box": "rfsg.objects.shapes.analytic:Box",
    "sphere": "rfsg.objects.shapes.analytic:Sphere",
    "cylinder": "rfsg.objects.shapes.analytic:Cylinder",
    "capsule": "rfsg.objects.shapes.analytic:Capsule",
    "halfspace": "rfsg.objects.shapes.analytic:HalfSpace",
    "mesh": "rfsg.objects.shapes.mesh:Mesh",
    "neural": "rfsg.objects.shapes.neural:NeuralShape",
}
SURFACES = {
    "conductor": "rfsg.objects.surfaces.interface:Conductor",
    "halfspace": "rfsg.objects.surfaces.interface:DielectricHalfSpace",
    "slab": "rfsg.objects.surfaces.slab:Slab",
    "solid": "rfsg.objects.surfaces.solid:Solid",
    "stochastic": "rfsg.objects.surfaces.stochastic:StochasticSurface",
}


def shape_class(kind: str) -> type:
    """The shape class of a kind token; ValueError naming the known kinds otherwise."""
    return _load(SHAPES, kind, "shape")


def surface_class(kind: str) -> type:
    """The surface class of a kind token; ValueError naming the known kinds otherwise."""
    return _load(SURFACES, kind, "surface")


def _load(table: dict[str, str], kind: str, what: str) -> type:
    if kind not in table:
        raise ValueError(
            f"{what} kind: got {kind!r}, expected one of {', '.join(table)}; "
            "a file written by a newer rfsg may name kinds this one does not have"
        )
    module, name = table[kind].split(":")
    return getattr(import_module(module), name)
