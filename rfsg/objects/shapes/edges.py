"""The convex edges of shapes, where waves diffract; in the object's own frame.

An edge is a straight segment or the circular rim of a cylinder, with the outward normals of the two
faces that meet there. Sizes of closed-form shapes stay differentiable.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.analytic import Box, Cylinder


@dataclass(frozen=True)
class Edges:
    """Convex edges: straight segments from ``start`` to ``end``, and whole circles [m].

    normal0, normal1: outward unit normals of the two faces at ``start`` (on a straight edge they are
    the same everywhere). patch0, patch1: the faces' numbers: patches of a closed-form shape, else
    those of the flat pieces that were found. Straight edges have radius inf, and centre and axis 0.
    A circle starts and ends at one point, runs about ``axis`` from there (right-handed), and its face
    0 is flat with normal0 = +-axis, its face 1 round with normal1 away from ``centre``.
    """

    start: Float[Tensor, "e 3"]
    end: Float[Tensor, "e 3"]
    normal0: Float[Tensor, "e 3"]
    normal1: Float[Tensor, "e 3"]
    patch0: Int[Tensor, "e"]
    patch1: Int[Tensor, "e"]
    centre: Float[Tensor, "e 3"]
    radius: Float[Tensor, "e"]
    axis: Float[Tensor, "e 3"]

    def __len__(self) -> int:
        return len(self.patch0)

    @property
    def opening(self) -> Float[Tensor, "e"]:
        """n: the exterior angle of the wedge over pi, 1 (flat) to 2 (a half plane)."""
        cosine = (self.normal0 * self.normal1).sum(-1)
        sine = torch.linalg.cross(self.normal0, self.normal1).norm(dim=-1)
        return 1.0 + torch.atan2(sine, cosine) / math.pi


def edges_of(shape: Shape) -> Edges:
    """The edges of a shape; none of spheres, capsules and half-spaces."""
    if isinstance(shape, Box):
        return box_edges(shape.half_size)
    if isinstance(shape, Cylinder):
        return cylinder_edges(shape.radius, shape.half_height)
    return no_edges(shape.bounds().device)


def no_edges(device: torch.device | None = None) -> Edges:
    """A record of length 0."""
    point = torch.zeros(0, 3, dtype=torch.float64, device=device)
    patch = torch.zeros(0, dtype=torch.int64, device=device)
    return straight_edges(point, point, point, point, patch, patch)


def straight_edges(
    start: Float[Tensor, "e 3"],
    end: Float[Tensor, "e 3"],
    normal0: Float[Tensor, "e 3"],
    normal1: Float[Tensor, "e 3"],
    patch0: Int[Tensor, "e"],
    patch1: Int[Tensor, "e"],
) -> Edges:
    """Edges without arcs."""
    zero = torch.zeros_like(start)
    radius = torch.full_like(start[:, 0], torch.inf)
    return Edges(start, end, normal0, normal1, patch0, patch1, zero, radius, zero)


def box_edges(half_size: Float[Tensor, "3"]) -> Edges:
    """The 12 edges of |x| <= half_size [m]: four along each axis; n = 3/2."""
    eye = torch.eye(3, dtype=half_size.dtype, device=half_size.device)
    rows, patches = [], []
    for axis in range(3):
        first, second = (a for a in range(3) if a != axis)
        for i in (0, 1):
            for j in (0, 1):
                normal0, normal1 = (2 * i - 1) * eye[first], (2 * j - 1) * eye[second]
                middle = half_size * (normal0 + normal1)
                along = half_size * eye[axis]
                rows.append(torch.stack([middle - along, middle + along, normal0, normal1]))
                patches.append((2 * first + i, 2 * second + j))
    start, end, normal0, normal1 = torch.stack(rows, 1)
    patch0, patch1 = torch.tensor(patches, device=half_size.device).unbind(1)
    return straight_edges(start, end, normal0, normal1, patch0, patch1)


def cylinder_edges(radius: Float[Tensor, ""], half_height: Float[Tensor, ""]) -> Edges:
    """The two rims |z| = half_height of a cylinder about z [m]: cap (patch 0, 1) and side (2)."""
    eye = torch.eye(3, dtype=radius.dtype, device=radius.device)
    normal0 = torch.stack([-eye[2], eye[2]])
    normal1 = eye[0].expand(2, 3)
    centre = half_height * normal0
    start = centre + radius * normal1
    patch0 = torch.arange(2, device=radius.device)
    return Edges(
        start,
        start,
        normal0,
        normal1,
        patch0,
        torch.full_like(patch0, 2),
        centre,
        radius.expand(2),
        eye[2].expand(2, 3),
    )
