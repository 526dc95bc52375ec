"""Polygons into triangles."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

HOLLOW = 1e-9  # relative: corners that turn inward by less are straight


def triangles_of(
    point: Float[ndarray, "n 3"], count: Int[ndarray, "p"], index: Int[ndarray, "i"]
) -> Int[ndarray, "t 3"]:
    """Triangles of polygons with ``count`` corners each, listed one after the other in ``index``.

    Triangles stay as they are, plane quads without an inward corner are cut in two, and everything
    else is triangulated by manifold3d in its mean plane. Corners in a row on one line are allowed.
    """
    if (count == 3).all():
        return index.reshape(-1, 3)
    first = np.cumsum(count) - count
    three = index[first[count == 3, None] + np.arange(3)]
    quad = index[first[count == 4, None] + np.arange(4)]
    plain = _turns(point[quad]).min(1, initial=np.inf) > HOLLOW
    halves = [quad[plain][:, corner] for corner in ([0, 1, 2], [0, 2, 3])]
    rest = [*quad[~plain], *(index[a : a + n] for a, n in zip(first, count, strict=True) if n > 4)]
    return np.concatenate([three, *halves, *(_cut(point, polygon) for polygon in rest)])


def _turns(corner: Float[ndarray, "q k 3"]) -> Float[ndarray, "q k"]:
    """Sine of the turn at each corner, positive where it turns as the polygon does."""
    before, after = corner - np.roll(corner, 1, 1), np.roll(corner, -1, 1) - corner
    cross = np.cross(before, after)
    normal = cross.sum(1, keepdims=True)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300)
    size = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    return (cross * normal).sum(-1) / np.maximum(size, 1e-300)


def _cut(point: Float[ndarray, "n 3"], polygon: Int[ndarray, "k"]) -> Int[ndarray, "t 3"]:
    from manifold3d import triangulate  # loaded where a polygon needs it

    corner = point[polygon] - point[polygon].mean(0)
    normal = np.cross(corner, np.roll(corner, -1, 0)).sum(0)
    # two directions in the mean plane, right-handed with its normal (Newell)
    first = np.linalg.svd(corner, full_matrices=False)[2][0]
    length = np.linalg.norm(normal)
    if not length > 0:
        return polygon[:0, None].repeat(3, 1)  # a line: it has no inside
    second = np.cross(normal / length, first)
    flat = np.ascontiguousarray(corner @ np.stack([first, second], 1))
    return polygon[
        np.asarray(triangulate([flat], allow_convex=False), dtype=np.int64).reshape(-1, 3)
    ]
