"""The record of a shape's edges."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


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
