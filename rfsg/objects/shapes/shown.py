"""What other programs and pictures show of a shape: its surface as triangles, and their convex hull."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import ConvexHull

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.proxy import extract_mesh

CREASE_DEG = 20.0  # a corner whose normal is farther off its triangle's lies on an edge
SHOWN_TOLERANCE = 0.002  # [m] by which a mesh that is only shown may differ from the zero set
EXACT = 2 * SHOWN_TOLERANCE  # [m] a triangle lower than this may look anywhere

Shown = tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"], Float[ndarray, "v 3"]]


def shown_mesh(shape: Shape) -> Shown:
    """Vertices [m], triangles (outward) and unit vertex normals of a shape's surface.

    Of boxes and meshes the very faces, with corners of their own so that edges stay sharp; of others
    the zero set, to ``SHOWN_TOLERANCE``. Raises ValueError as ``extract_mesh`` does.
    """
    if shape.kind == "box":
        half = shape.bounds().detach().cpu().double().numpy()[1]
        corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        return _flat(*hull_of(corner))
    if shape.kind == "mesh":
        given = shape.config()
        return _flat(np.array(given["vertices"], np.float64), np.array(given["triangles"]))
    with torch.no_grad():
        return extract_mesh(shape, simplify=SHOWN_TOLERANCE)


def corner_normals(
    vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "t 3"], normals: Float[ndarray, "v 3"]
) -> Float[ndarray, "t 3 3"]:
    """A unit normal for each corner of each triangle: the vertex's, but on an edge the triangle's own.

    The vertices of a simplified mesh lie on its edges, and what is mixed of their normals would bend
    flat faces. A triangle lower than its corners are exact knows no normal of its own.
    """
    corner = vertices[faces]
    flat, mixed = _normal(corner)[:, None], normals[faces]
    side = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=-1).max(-1)
    low = _twice_area(corner) < EXACT * side
    bent = (flat * mixed).sum(-1) < np.cos(np.radians(CREASE_DEG))
    return np.where((bent & ~low[:, None])[..., None], flat, mixed)


def hull_of(
    vertices: Float[ndarray, "v 3"],
) -> tuple[Float[ndarray, "w 3"], Int[ndarray, "t 3"]]:
    """The convex hull of points [m]: its corners, and triangles wound outward."""
    hull = ConvexHull(vertices)
    inward = (_normal(vertices[hull.simplices]) * hull.equations[:, :3]).sum(-1) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(faces.shape).astype(np.int64)


def _flat(vertices: ndarray, faces: ndarray) -> Shown:
    """Each triangle with corners and a normal of its own."""
    corner = vertices[faces]
    own = np.arange(3 * len(faces)).reshape(-1, 3)
    return corner.reshape(-1, 3), own, _normal(corner).repeat(3, axis=0)


def _normal(corner: Float[ndarray, "t 3 3"]) -> Float[ndarray, "t 3"]:
    """Unit normals of triangles; zero where there is no area."""
    area = _twice_area(corner)[:, None]
    return _cross(corner) / np.where(area > 0, area, 1.0)


def _twice_area(corner: Float[ndarray, "t 3 3"]) -> Float[ndarray, "t"]:
    return np.linalg.norm(_cross(corner), axis=-1)


def _cross(corner: Float[ndarray, "t 3 3"]) -> Float[ndarray, "t 3"]:
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
