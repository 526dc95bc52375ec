"""The shapes that Mitsuba draws by name, as triangles in their own frame."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

Drawn = tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"]]
AROUND = 32  # sides of a cylinder or a disk
Number = Callable[[ET.Element, str, float], float]


def rectangle() -> Drawn:
    """|x|, |y| <= 1 at z = 0, looking along +z."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def cube() -> Drawn:
    """|x|, |y|, |z| <= 1."""
    corners = np.array([[x, y, z] for z in (-1.0, 1) for y in (-1, 1) for x in (-1, 1)])
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    return corners, np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])


def disk() -> Drawn:
    """The unit circle at z = 0, as a polygon."""
    turn = np.arange(AROUND) * 2 * math.pi / AROUND
    corners = np.stack([np.cos(turn), np.sin(turn), np.zeros(AROUND)], 1)
    fan = [[0, i, i + 1] for i in range(1, AROUND - 1)]
    return corners, np.array(fan)


def cylinder(element: ET.Element, number: Number) -> Drawn:
    """The side of a cylinder from point p0 to p1, without caps, as a polygon's."""
    p0, p1 = _point(element, "p0", (0, 0, 0)), _point(element, "p1", (0, 0, 1))
    radius, along = number(element, "radius", 1.0), p1 - p0
    length = float(np.linalg.norm(along))
    if not (length > 0 and radius > 0):
        raise ValueError("a cylinder without length or radius")
    first = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    first = first / np.linalg.norm(first)
    second = np.cross(along / length, first)
    turn = np.arange(AROUND) * 2 * math.pi / AROUND
    ring = radius * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    following = (np.arange(AROUND) + 1) % AROUND
    low, high = np.arange(AROUND), np.arange(AROUND) + AROUND
    faces = [
        np.stack(t, 1) for t in ((low, following, high[following]), (low, high[following], high))
    ]
    return np.concatenate([p0 + ring, p1 + ring]), np.concatenate(faces)


def ball(
    element: ET.Element, number: Number, place: Float[ndarray, "4 4"]
) -> tuple[tuple[float, float, float], float]:
    """Centre and radius in the world. Raises ValueError for a transform that stretches it."""
    centre, radius = _point(element, "center", (0, 0, 0)), number(element, "radius", 1.0)
    scales = np.linalg.svd(place[:3, :3])[1]
    if not (radius > 0 and np.ptp(scales) <= 1e-6 * scales.max()):
        raise ValueError("a sphere without radius, or stretched by its transform")
    x, y, z = place[:3, :3] @ centre + place[:3, 3]
    return (float(x), float(y), float(z)), radius * float(scales.mean())


def _point(element: ET.Element, name: str, fallback: tuple[float, float, float]) -> ndarray:
    found = element.find(f"point[@name='{name}']")
    if found is None:
        return np.array(fallback, dtype=np.float64)
    given = found.get("value")
    words = given.replace(",", " ").split() if given else [found.get(a, "0") for a in "xyz"]
    point = np.array([float(w) for w in words])
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{name} is not a point: {' '.join(words)}")
    return point
