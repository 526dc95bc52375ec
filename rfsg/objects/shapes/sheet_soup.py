"""Soups of triangles as numbers, many at once: cleaned, their segments, the wedges of air about those,
and their flat faces.

A city is thousands of sheets of a dozen triangles each; numpy asked of each alone costs more in calls than
in arithmetic. So corners and triangles of all stand one behind the other, those of each together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from rfsg.objects.shapes import topology

SINGLE = 4.0 * 2.0**-23  # relative: what single precision leaves of a coordinate, a few times over
SLIVER = 1e-6  # area over longest side squared


@dataclass(frozen=True)
class Soup:
    """A sheet as numbers. ``triangles`` are those given, then the same turned over; ``sides`` are the two
    of them that look into each wedge, whose edge has ``ends``; ``face`` is the flat face of each."""

    vertices: Float[ndarray, "v 3"]
    triangles: Int[ndarray, "t2 3"]
    face: Int[ndarray, "t2"]
    ends: Int[ndarray, "w 2"]
    sides: Int[ndarray, "w 2"]
    segments: Int[ndarray, "s 2"]
    triangle_of_segment: Int[ndarray, "s"]


def soups(meshes: Sequence[tuple[ndarray, ndarray]]) -> list[Soup | ValueError]:
    """The soup of every mesh of (vertices [v 3] m, triangles [t 3]); where one can be no sheet, the
    ValueError that says why."""
    out: dict[int, Soup | ValueError] = {}
    good: dict[int, tuple[ndarray, ndarray]] = {}
    for k, (vertices, triangles) in enumerate(meshes):
        try:
            good[k] = topology.checked(vertices, triangles, 1, "divide a larger sheet into pieces")
        except ValueError as error:
            out[k] = error
    together = _together(list(good.values())) if good else []
    for k, soup in zip(good, together, strict=True):
        out[k] = soup or ValueError("a sheet without a triangle that has an area")
    return [out[k] for k in range(len(meshes))]


def _together(meshes: Sequence[tuple[ndarray, ndarray]]) -> list[Soup | None]:
    """The soups of meshes that were checked, None for those without a triangle that has an area."""
    count = len(meshes)
    sizes = np.array([len(vertices) for vertices, _ in meshes])
    start = np.cumsum(sizes) - sizes
    corners = np.concatenate([t + a for (_, t), a in zip(meshes, start, strict=True)])
    owner = np.repeat(np.arange(count), sizes)
    vertices = np.concatenate([v for v, _ in meshes])
    place, corner, owner = _cleaned(vertices, corners, owner, count)
    if not len(corner):
        return [None] * count
    mine = owner[corner[:, 0]]  # the mesh of each triangle
    t = np.bincount(mine, minlength=count)
    first = np.cumsum(t) - t
    front = np.arange(len(corner)) + first[mine]
    back = front + t[mine]
    both = np.empty((2 * len(corner), 3), dtype=np.int64)
    both[front], both[back] = corner, corner[:, ::-1]
    segments, lone, wedges = wedges_of(place, corner, front, back)
    side_of = np.repeat(np.arange(count), 2 * t)
    size, farthest = _extents(place, owner, count)
    level = np.maximum(topology.LEVEL * size, SINGLE * farthest)
    face = distinct(side_of, topology.flat_faces(place, both, wedges, level[side_of]))[1]
    whole = Soup(place, both, face, wedges[:, :2], wedges[:, 2:], segments, lone)
    v, s, w = (_ends(owner[ends], count) for ends in (slice(None), segments[:, 0], wedges[:, 0]))
    return _apart(whole, v, s, w, np.append(first, len(corner)))


def _apart(whole: Soup, v: ndarray, s: ndarray, w: ndarray, t: ndarray) -> list[Soup | None]:
    """Many soups in one, each on its own again: where the vertices, segments, wedges and triangles of each
    begin, and the last end. What they number begins at 0 again."""
    out: list[Soup | None] = []
    for k in range(len(t) - 1):
        vertex, segment, wedge, side = (slice(x[k], x[k + 1]) for x in (v, s, w, 2 * t))
        face = whole.face[side]
        soup = Soup(
            whole.vertices[vertex],
            whole.triangles[side] - v[k],
            face - face.min(initial=len(whole.face)),
            whole.ends[wedge] - v[k],
            whole.sides[wedge] - 2 * t[k],
            whole.segments[segment] - v[k],
            whole.triangle_of_segment[segment] - t[k],
        )
        out.append(soup if len(face) else None)
    return out


def _ends(owner: Int[ndarray, "n"], count: int) -> Int[ndarray, "c1"]:
    """Where the rows of each owner begin, and where the last end; rows stand in the order of owners."""
    return np.searchsorted(owner, np.arange(count + 1))


def _cleaned(
    vertices: Float[ndarray, "n 3"],
    corner: Int[ndarray, "m 3"],
    owner: Int[ndarray, "n"],
    count: int,
) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"], Int[ndarray, "v"]]:
    """Corners of one mesh at one place welded; triangles that have an area, each once; and the mesh of
    each vertex."""
    first, index = distinct(owner, *vertices.T)
    place, owner, corner = vertices[first], owner[first], index[corner]
    size, _ = _extents(place, owner, count)
    longest = np.linalg.norm(place[corner] - place[np.roll(corner, 1, 1)], axis=-1).max(1)
    area = topology.facets(place, corner)[1]
    # a needle's normal is rounding: its height over its longest side must be more than that
    plain = area > topology.EMPTY * size[owner[corner[:, 0]]] ** 2
    corner = corner[plain & (area > SLIVER * longest**2)]
    first, _ = distinct(*np.sort(corner, 1).T)
    corner = corner[np.sort(first)]
    used, corner = np.unique(corner, return_inverse=True)
    return place[used], corner.reshape(-1, 3), owner[used]


def _extents(
    place: Float[ndarray, "v 3"], owner: Int[ndarray, "v"], count: int
) -> tuple[Float[ndarray, "c"], Float[ndarray, "c"]]:
    """Of each mesh the diagonal of its bounds and its largest coordinate [m]; 0 without a corner."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, owner, place)
    np.maximum.at(high, owner, place)
    low, high = (np.where(np.isfinite(x), x, 0.0) for x in (low, high))
    return np.linalg.norm(high - low, axis=1), np.maximum(np.abs(low), np.abs(high)).max(1)


def distinct(*columns: ndarray) -> tuple[Int[ndarray, "k"], Int[ndarray, "n"]]:
    """The first of each set of equal rows, in the order of the columns, and the number of every row's."""
    order = np.lexsort(columns[::-1])
    new = np.ones(len(order), dtype=bool)
    new[1:] = _differ([column[order] for column in columns])
    index = np.empty(len(order), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    return order[new], index  # a stable sort: of equal rows the first comes first


def _differ(columns: Sequence[ndarray]) -> Bool[ndarray, "n1"]:
    return np.any([column[1:] != column[:-1] for column in columns], axis=0)


def wedges_of(
    place: Float[ndarray, "v 3"],
    corner: Int[ndarray, "t 3"],
    front: Int[ndarray, "t"],
    back: Int[ndarray, "t"],
) -> tuple[Int[ndarray, "s 2"], Int[ndarray, "s"], Int[ndarray, "w 4"]]:
    """Segments [s 2] of a soup of triangles with a triangle of each, and the wedges of air about them:
    (vertex, vertex, side, side) as ``topology`` lists edges; ``front`` and ``back`` number the sides.

    About a segment e the triangles stand at angles; from one to the next, counter-clockwise, is a wedge.
    It begins at the side whose normal is e x w, w pointing away from e in the triangle, and ends at the
    side of the next whose normal is opposite. A lone triangle's two sides look into one wedge.
    """
    ends = np.concatenate([np.roll(corner, -k, 1)[:, :2] for k in range(3)])
    third = np.concatenate([np.roll(corner, -k, 1)[:, 2] for k in range(3)])
    triangle = np.tile(np.arange(len(corner)), 3)
    ordered = np.sort(ends, 1)
    first, which = distinct(*ordered.T)
    segments = ordered[first]
    along = place[segments[:, 1]] - place[segments[:, 0]]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    axis = np.eye(3)[np.abs(along).argmin(1)]
    right = np.cross(along, axis)
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(along, right)
    away = place[third] - place[segments[which, 0]]
    angle = np.arctan2((away * up[which]).sum(1), (away * right[which]).sum(1))
    order = np.lexsort((angle, which))
    begin = np.searchsorted(which[order], np.arange(len(segments) + 1))
    following = np.arange(len(order)) + 1
    following[begin[1:] - 1] = begin[:-1]
    # wound along the segment, a triangle as given has the normal e x w
    wound = ends[:, 0] == segments[which, 0]
    start = np.where(wound, front[triangle], back[triangle])[order]
    stop = np.where(wound, back[triangle], front[triangle])[order][following]
    pairs = np.concatenate([segments[which[order]], start[:, None], stop[:, None]], 1)
    return segments, triangle[first], pairs
