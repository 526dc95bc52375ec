"""Edges of shapes known exactly, differentiable in their sizes."""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from rfsg.objects.shapes.edges.record import Edges, no_edges, straight_edges
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.topology import components


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


STRAIGHT = 1e-3  # sine of the angle between pieces of one straight edge


BLUNT_DEG = 20.0  # what turns less is a facet of something round


def mesh_edges(shape: Mesh, angle_deg: float = BLUNT_DEG) -> Edges:
    """The convex edges where a mesh turns by more than ``angle_deg``; pieces of one are joined.

    Patches are the mesh's own faces. Raises ValueError for an angle outside (0, 180).
    """
    if not 0 < angle_deg < 180:
        raise ValueError(f"angle_deg={angle_deg!r}: expected an angle between 0 and 180 degrees")
    planes, pair = shape.planes(), shape.face[shape.sides]
    with torch.no_grad():
        normal0, normal1 = planes[pair, :3].unbind(1)
        start, end = shape.vertices[shape.ends].unbind(1)
        # an edge runs as its first triangle is wound: the second's normal turns right-handed about
        # it where the mesh is convex
        turn = (torch.linalg.cross(normal0, normal1) * (end - start)).sum(-1)
        sharp = (normal0 * normal1).sum(-1) < math.cos(math.radians(angle_deg))
        i = torch.nonzero(sharp & (turn > 0)).squeeze(-1)
    if not len(i):
        return no_edges(planes.device)
    low, high, piece = _joined(
        *(x.detach().cpu().numpy() for x in (shape.vertices, shape.ends[i], pair[i]))
    )
    low, high, piece = (torch.from_numpy(x).to(planes.device) for x in (low, high, piece))
    patch0, patch1 = pair[i[piece]].unbind(1)
    ends = shape.vertices[low], shape.vertices[high]
    return straight_edges(*ends, planes[patch0, :3], planes[patch1, :3], patch0, patch1)


def _joined(
    place: Float[ndarray, "v 3"], ends: Int[ndarray, "e 2"], faces: Int[ndarray, "e 2"]
) -> tuple[ndarray, ndarray, ndarray]:
    """Maximal straight edges: numbers of their first and last vertex, and of one of their pieces."""
    along = place[ends[:, 1]] - place[ends[:, 0]]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    faces = np.sort(faces, 1)
    visits = np.concatenate([np.stack([ends[:, c], *faces.T], 1) for c in (0, 1)])
    owner = np.tile(np.arange(len(ends)), 2)
    order = np.lexsort(visits.T)
    same = (visits[order[1:]] == visits[order[:-1]]).all(1)
    link = np.stack([owner[order[:-1]], owner[order[1:]]], 1)[same]
    sine = np.linalg.norm(np.cross(along[link[:, 0]], along[link[:, 1]]), axis=1)
    group = components(len(ends), link[sine < STRAIGHT])
    _, piece = np.unique(group, return_index=True)
    axis = along[piece][group]
    reach = (place[ends] * axis[:, None]).sum(-1)
    order = np.lexsort((reach.min(1), group))
    low = ends[order, reach[order].argmin(1)][np.searchsorted(group[order], np.arange(len(piece)))]
    order = np.lexsort((-reach.max(1), group))
    high = ends[order, reach[order].argmax(1)][np.searchsorted(group[order], np.arange(len(piece)))]
    return low, high, piece
