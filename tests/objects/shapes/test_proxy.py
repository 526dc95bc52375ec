"""Extracted meshes: closed, outward, on the surface, and nothing lost by sampling a narrow band."""

import math

import numpy as np
import pytest
import torch
import trimesh

from rfsg.objects.shapes import proxy
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.shapes.neural import NeuralShape

VOLUMES = [
    (Box([0.2, 0.3, 0.4]), 8 * 0.2 * 0.3 * 0.4),
    (Sphere(0.4), 4 / 3 * math.pi * 0.4**3),
    (Cylinder(0.3, 0.4), math.pi * 0.3**2 * 0.8),
    (Capsule(0.2, 0.4), math.pi * 0.2**2 * 0.8 + 4 / 3 * math.pi * 0.2**3),
]


@pytest.mark.parametrize(("shape", "volume"), VOLUMES, ids=[s.kind for s, _ in VOLUMES])
def test_mesh_is_closed_outward_and_on_the_surface(shape, volume):
    vertices, faces, normals = proxy.extract_mesh(shape)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=0.01)
    point = torch.from_numpy(vertices)
    assert shape.sdf(point).abs().max() < 2e-3
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.allclose(normals, shape.value_and_gradient(point)[1].numpy(), atol=1e-6)


def test_narrow_band_gives_the_mesh_of_the_whole_grid(monkeypatch):
    shape = NeuralShape([[-0.5, -0.4, 0.0], [0.5, 0.4, 1.0]], seed=3)
    banded = proxy.extract_mesh(shape, 0.03)
    monkeypatch.setattr(shape, "lipschitz", 1e9)
    whole = proxy.extract_mesh(shape, 0.03)
    assert len(banded[0]) > 500
    assert all(np.array_equal(a, b) for a, b in zip(banded, whole, strict=True))


def test_narrow_band_asks_less(monkeypatch):
    asked = []
    shape = Sphere(0.5)
    inner = Sphere.sdf
    monkeypatch.setattr(Sphere, "sdf", lambda self, p: asked.append(len(p)) or inner(self, p))
    proxy.extract_mesh(shape, 0.01)
    assert sum(asked) < 0.4 * 104**3


def test_simplified_mesh_is_smaller_and_stays_on_the_surface():
    full = proxy.extract_mesh(Box([0.2, 0.3, 0.4]))
    small = proxy.extract_mesh(Box([0.2, 0.3, 0.4]), simplify=0.003)
    assert len(small[1]) < 0.1 * len(full[1])
    assert Box([0.2, 0.3, 0.4]).sdf(torch.from_numpy(small[0])).abs().max() < 0.006
    assert trimesh.Trimesh(small[0], small[1], process=False).is_watertight


def test_what_has_no_mesh_is_refused():
    with pytest.raises(ValueError, match="unbounded"):
        proxy.extract_mesh(HalfSpace())
    with pytest.raises(ValueError, match="resolution"):
        proxy.extract_mesh(Sphere(1.0), -1.0)
    with pytest.raises(ValueError, match="nodes"):
        proxy.extract_mesh(Sphere(1.0), 1e-4)
    empty = NeuralShape([[0.0] * 3, [1.0] * 3], lipschitz=2.0)
    torch.nn.init.constant_(empty.to_value.bias, 9.0)
    with pytest.raises(ValueError, match="no surface"):
        proxy.extract_mesh(empty)
