"""Meshes that are shown: sharp where the shape is, on the shape, and within their hull."""

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.shown import SHOWN_TOLERANCE, corner_normals, hull_of, shown_mesh
from tests.laws.catalogue import angle_iron

SHAPES = [Box((0.2, 0.3, 0.4)), Sphere(0.3), Cylinder(0.2, 0.6), Capsule(0.1, 0.5), angle_iron()]


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)
def test_the_mesh_lies_on_the_shape_and_looks_outward(shape):
    vertices, faces, normals = shown_mesh(shape)
    off = shape.sdf(torch.from_numpy(vertices)).abs()
    assert float(off.max()) < (1e-9 if shape.kind in ("box", "mesh") else SHOWN_TOLERANCE)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert volume(vertices, faces) > 0


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)
def test_the_hull_holds_the_mesh_and_is_convex(shape):
    vertices, faces, _ = shown_mesh(shape)
    corner, hull = hull_of(vertices)
    a, b, c = (corner[hull[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    above = ((vertices[None] - a[:, None]) * outward[:, None]).sum(-1)
    assert above.max() < 1e-9
    assert volume(corner, hull) >= volume(vertices, faces) - 1e-9
    assert set(np.unique(hull)) == set(range(len(corner)))
    assert (Delaunay(corner).find_simplex(corner.mean(0)) >= 0).all()


def test_a_box_is_shown_exactly():
    vertices, faces, _ = shown_mesh(Box((0.2, 0.3, 0.4)))
    assert len(faces) == 12 and volume(vertices, faces) == pytest.approx(8 * 0.2 * 0.3 * 0.4)


def test_corners_take_the_vertex_normal_but_on_edges_the_faces_own():
    """On a cube whose corner normals are mixed of three faces, each face keeps its own."""
    corner, faces = hull_of(
        np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1.0)])
    )
    mixed = corner / np.linalg.norm(corner, axis=1, keepdims=True)
    flat = corner_normals(corner, faces, mixed)
    assert np.allclose(np.abs(flat).max(-1), 1.0)
    ball, faces, normals = shown_mesh(Sphere(0.3))
    assert np.allclose(corner_normals(ball, faces, normals), normals[faces])


def test_what_has_no_surface_to_show_is_refused():
    with pytest.raises(ValueError, match="unbounded"):
        shown_mesh(HalfSpace())
    assert isinstance(angle_iron(), Mesh)
