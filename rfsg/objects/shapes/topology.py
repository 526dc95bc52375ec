"""Triangle meshes as numbers: welded corners, who is beside whom, which triangles lie in one plane."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

MAX_TRIANGLES = 100_000  # a shape asks each of its triangles at every point
LEVEL = (
    1e-6  # of the mesh's size: how far corners may lie off the plane of their face (float32 files)
)
EMPTY = 1e-12  # of the mesh's size squared: an area that gives no normal


@dataclass(frozen=True)
class Topology:
    """A closed mesh: triangles wound outward, edges by their ends, and the flat face of each triangle.

    Edge i runs from ends[i, 0] to ends[i, 1] as its first triangle sides[i, 0] is wound.
    """

    vertices: Float[ndarray, "v 3"]
    triangles: Int[ndarray, "t 3"]
    ends: Int[ndarray, "e 2"]
    sides: Int[ndarray, "e 2"]
    face: Int[ndarray, "t"]


def closed_mesh(vertices: ndarray, triangles: ndarray) -> Topology:
    """Welds corners at one place, winds outward, finds edges and flat faces.

    Raises ValueError for a mesh of other arrays, with numbers that are not finite or indices out of
    range, with triangles without area, or that does not close.
    """
    finer = "learn a finer mesh as a neural shape (`rfsg learn-shape`)"
    vertices, triangles = checked(vertices, triangles, 4, finer)
    place, index = np.unique(vertices, axis=0, return_inverse=True)
    corner = index.reshape(-1)[triangles]
    # a triangle with two corners at one place is a line: its neighbours meet there
    corner = corner[(corner != np.roll(corner, 1, 1)).all(1)]
    size = float(np.linalg.norm(np.ptp(place, axis=0)))
    area = facets(place, corner)[1]
    if (area <= EMPTY * size**2).any():
        k = int(area.argmin())
        raise ValueError(
            f"a triangle without area, at {place[corner[k]].tolist()}: clean the mesh first "
            "(merge by distance, dissolve degenerate faces)"
        )
    pairs = _closed(place, corner)
    turned = _volume(place, corner) < 0
    if turned:
        corner = corner[:, ::-1].copy()
        pairs[:, :2] = pairs[:, 1::-1]
    return Topology(
        place, corner, pairs[:, :2], pairs[:, 2:], flat_faces(place, corner, pairs, LEVEL * size)
    )


def checked(
    vertices: ndarray, triangles: ndarray, fewest: int, advice: str
) -> tuple[ndarray, ndarray]:
    """The arrays as float64 and int64. Raises ValueError for what they cannot be."""
    vertices, triangles = np.asarray(vertices, np.float64), np.asarray(triangles)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise ValueError(f"vertices of shape {vertices.shape}: expected finite rows x, y, z [m]")
    whole = triangles.ndim == 2 and triangles.shape[1] == 3 and triangles.dtype.kind in "iu"
    if not whole or not fewest <= len(triangles) <= MAX_TRIANGLES:
        raise ValueError(
            f"triangles of shape {triangles.shape}: expected {fewest} to {MAX_TRIANGLES} rows of three "
            f"vertex numbers; {advice}"
        )
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(f"triangles name vertices outside of 0 to {len(vertices) - 1}")
    return vertices, triangles.astype(np.int64)


def _closed(place: ndarray, corner: ndarray) -> Int[ndarray, "e 4"]:
    """(vertex, vertex, triangle, triangle) of every edge of a mesh without holes."""
    pairs, odd = neighbours(corner)
    if len(odd):
        a, b = place[odd[0, 0]].tolist(), place[odd[0, 1]].tolist()
        raise ValueError(
            f"the mesh is not closed: {len(odd)} edges do not join two triangles, the first from "
            f"{a} to {b}. A sheet needs a thickness, and solids that share an edge are two objects"
        )
    along = [_runs(corner[pairs[:, side]], pairs[:, :2]) for side in (2, 3)]
    if not (along[0] ^ along[1]).all():
        k = int(np.flatnonzero(along[0] == along[1])[0])
        raise ValueError(
            f"two triangles at {place[pairs[k, 0]].tolist()} are wound in different senses: "
            "recalculate the normals outward"
        )
    return pairs


def _runs(corner: ndarray, ends: ndarray) -> ndarray:
    """Whether triangles run along edges in their sense."""
    following = np.roll(corner, -1, 1)
    return ((corner == ends[:, :1]) & (following == ends[:, 1:])).any(1)


def _volume(place: ndarray, corner: ndarray) -> float:
    a, b, c = (place[corner] - place.mean(0)).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6.0)


def flat_faces(
    place: Float[ndarray, "v 3"],
    corner: Int[ndarray, "t 3"],
    pairs: Int[ndarray, "e 4"],
    most: float | Float[ndarray, "t"],
) -> Int[ndarray, "t"]:
    """The flat face of each triangle: those that hang together in one plane, none of whose corners is off
    it by more than ``most`` [m]."""
    most = np.broadcast_to(most, len(corner))
    normal, area = facets(place, corner)
    first, second = pairs[:, 2], pairs[:, 3]
    height = np.abs(
        ((place[corner[second]] - place[corner[first, 0]][:, None]) * normal[first, None]).sum(-1)
    )
    level = (height.max(1) <= most[first]) & ((normal[first] * normal[second]).sum(1) > 0)
    face = components(len(corner), pairs[level, 2:])
    total = np.zeros((int(face.max()) + 1, 3))
    np.add.at(total, face, area[:, None] * normal)
    mean = total[face] / np.maximum(np.linalg.norm(total[face], axis=1), 1e-300)[:, None]
    middle = np.zeros(len(total))
    weight = np.zeros(len(total))
    np.add.at(middle, face, area * (place[corner].mean(1) * mean).sum(1))
    np.add.at(weight, face, area)
    off = np.abs((place[corner] * mean[:, None]).sum(-1) - (middle / weight)[face, None]).max(1)
    # a finely divided round face never leaves a plane much from one triangle to the next
    round_face = np.isin(face, np.unique(face[off > most]))
    face = np.where(round_face, len(total) + np.arange(len(face)), face)
    return np.unique(face, return_inverse=True)[1].reshape(-1)


def facets(
    place: Float[ndarray, "v 3"], corner: Int[ndarray, "t 3"]
) -> tuple[Float[ndarray, "t 3"], Float[ndarray, "t"]]:
    """Unit normals and areas of triangles; 0 for those without area."""
    a, b, c = place[corner].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    return cross / np.where(size > 0, size, 1.0)[:, None], 0.5 * size


def neighbours(corner: Int[ndarray, "t 3"]) -> tuple[Int[ndarray, "e 4"], Int[ndarray, "o 3"]]:
    """Edges of two triangles (vertex, vertex, triangle, triangle), and the sides of edges of one,
    or of three and more (vertex, vertex, triangle)."""
    ends = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    owner = np.tile(np.arange(len(corner)), 3)
    _, which, count = np.unique(np.sort(ends, 1), axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    order = np.argsort(which, kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64)
    double, odd = order[first[count == 2]], np.flatnonzero(count[which] != 2)
    other = order[first[count == 2] + 1]
    pairs = np.concatenate([ends[double], owner[double, None], owner[other, None]], 1)
    return pairs, np.concatenate([ends[odd], owner[odd, None]], 1)


def components(count: int, links: Int[ndarray, "l 2"]) -> Int[ndarray, "n"]:
    """Number of the group of things that links hold together."""
    from scipy.sparse import coo_array  # half a second, which scenes without meshes need not pay
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(links), dtype=bool)
    return connected_components(coo_array((ones, links.T), shape=(count, count)), False)[1]
