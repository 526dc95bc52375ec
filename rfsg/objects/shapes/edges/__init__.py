"""The convex edges of shapes, where waves diffract; in the object's own frame.

An edge is a straight segment or the circular rim of a cylinder, with the outward normals of the two
faces that meet there. Sizes of shapes known exactly stay differentiable.
"""

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.analytic import Box, Cylinder
from rfsg.objects.shapes.edges.known import BLUNT_DEG, box_edges, cylinder_edges, mesh_edges
from rfsg.objects.shapes.edges.learned import learned_edges
from rfsg.objects.shapes.edges.record import Edges, no_edges, straight_edges
from rfsg.objects.shapes.mesh import Mesh

__all__ = [
    "BLUNT_DEG",
    "Edges",
    "box_edges",
    "cylinder_edges",
    "edges_of",
    "learned_edges",
    "mesh_edges",
    "no_edges",
    "straight_edges",
]


def edges_of(shape: Shape) -> Edges:
    """The edges of a shape; none of spheres, capsules and half-spaces."""
    if isinstance(shape, Box):
        return box_edges(shape.half_size)
    if isinstance(shape, Cylinder):
        return cylinder_edges(shape.radius, shape.half_height)
    if isinstance(shape, Mesh):
        return mesh_edges(shape)
    if not shape.exact:
        return learned_edges(shape)
    return no_edges(shape.bounds().device)
