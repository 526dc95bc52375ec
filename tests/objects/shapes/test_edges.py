"""Edges of known shapes, meshes and learned objects."""

import math

import pytest
import torch
from torch.autograd import gradcheck

from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.shapes.edges import Edges, box_edges, cylinder_edges, edges_of

F64 = torch.float64


def _along(edges: Edges, t: float) -> torch.Tensor:
    return edges.start + t * (edges.end - edges.start)


def test_a_box_has_twelve_edges_between_its_own_faces():
    box = Box([0.3, 0.5, 0.7])
    edges = edges_of(box)
    assert len(edges) == 12
    lengths = (edges.end - edges.start).norm(dim=-1).sort().values
    torch.testing.assert_close(
        lengths, torch.tensor([0.6, 1.0, 1.4], dtype=F64).repeat_interleave(4)
    )
    assert bool(torch.isinf(edges.radius).all())
    torch.testing.assert_close(edges.opening, torch.full_like(edges.radius, 1.5))
    planes = box.planes()
    for t in (0.0, 0.4, 1.0):
        for patch, normal in ((edges.patch0, edges.normal0), (edges.patch1, edges.normal1)):
            torch.testing.assert_close(normal, planes[patch, :3])
            on = (_along(edges, t) * normal).sum(-1)
            torch.testing.assert_close(on, planes[patch, 3], atol=1e-15, rtol=0)
    pairs = torch.stack([edges.patch0, edges.patch1], 1)
    assert len(torch.unique(pairs.sort(1).values, dim=0)) == 12


def test_edges_are_where_the_shape_turns():
    """A step off the edge within either face stays on the surface; between the normals it leaves."""
    for shape in (Box([0.3, 0.5, 0.7]), Cylinder(0.4, 0.6)):
        edges = edges_of(shape)
        middle = _along(edges, 0.5)
        for own, other in ((edges.normal0, edges.normal1), (edges.normal1, edges.normal0)):
            torch.testing.assert_close(
                shape.sdf(middle + 1e-3 * own), torch.full((len(edges),), 1e-3, dtype=F64)
            )
            inward = middle - 1e-3 * other
            assert bool((shape.sdf(inward).abs() < 2e-15).all())


def test_a_cylinder_has_two_rims():
    cylinder = Cylinder(0.4, 0.6)
    edges = edges_of(cylinder)
    assert len(edges) == 2 and edges.patch0.tolist() == [0, 1] and edges.patch1.tolist() == [2, 2]
    torch.testing.assert_close(edges.opening, torch.full((2,), 1.5, dtype=F64))
    for turn in (0.0, 1.0, 4.0):
        out = math.cos(turn) * edges.normal1 + math.sin(turn) * torch.linalg.cross(
            edges.axis, edges.normal1
        )
        point = edges.centre + edges.radius[:, None] * out
        assert bool((cylinder.sdf(point).abs() < 1e-15).all())
        assert bool((cylinder.sdf(point - 1e-3 * (out + edges.normal0)) < 0).all())
        assert bool((cylinder.sdf(point + 1e-3 * out) > 0).all())


@pytest.mark.parametrize("shape", [Sphere(0.4), Capsule(0.2, 0.5), HalfSpace()])
def test_round_and_unbounded_shapes_have_none(shape):
    edges = edges_of(shape)
    assert len(edges) == 0 and edges.opening.shape == (0,)


def test_sizes_differentiate():
    def box(half):
        edges = box_edges(half)
        return edges.start, edges.end

    def cylinder(radius, height):
        edges = cylinder_edges(radius, height)
        return edges.start, edges.centre, edges.radius

    half = torch.tensor([0.3, 0.5, 0.7], dtype=F64, requires_grad=True)
    assert gradcheck(box, (half,))
    sizes = [torch.tensor(x, dtype=F64, requires_grad=True) for x in (0.4, 0.6)]
    assert gradcheck(cylinder, sizes)
