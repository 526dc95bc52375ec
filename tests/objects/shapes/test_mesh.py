"""Closed meshes against the box, against plain twins, and what is refused."""

import itertools

import numpy as np
import pytest
import torch
import trimesh
from torch.autograd import gradcheck

from rfsg.objects.shapes import topology
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.mesh import Mesh, extruded
from rfsg.objects.shapes.polygons import triangles_of
from tests.laws.catalogue import angle_iron, prism

F64 = torch.float64
HALF = [0.3, 0.5, 0.7]


def boxed(pieces: int = 0) -> Mesh:
    mesh = trimesh.creation.box(extents=[2 * h for h in HALF])
    for _ in range(pieces):
        mesh = mesh.subdivide()
    return Mesh(mesh.vertices, mesh.faces)


def ring() -> Mesh:
    """A square ring: not convex, with a hole through it."""
    outer, inner = trimesh.creation.box([1.0, 1.0, 0.4]), trimesh.creation.box([0.5, 0.4, 0.6])
    made = trimesh.boolean.difference([outer, inner], engine="manifold")
    return Mesh(made.vertices, made.faces)


def cloud(count: int, size: float = 1.0, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return size * (2.0 * torch.rand(count, 3, generator=generator, dtype=F64) - 1.0)


@pytest.mark.parametrize("pieces", [0, 2])
def test_a_box_of_triangles_is_the_box(pieces):
    mesh, box = boxed(pieces), Box(HALF)
    assert mesh.convex and len(mesh.planes()) == 6
    p = cloud(5_000)
    ours, theirs = mesh.jet(p), box.jet(p)
    torch.testing.assert_close(ours.value, theirs.value, rtol=0, atol=1e-15)
    clear = (ours.gradient - theirs.gradient).norm(dim=-1) < 1e-9  # on a ridge either may be chosen
    assert float(clear.double().mean()) > 0.999
    torch.testing.assert_close(ours.hessian[clear], theirs.hessian[clear], rtol=1e-9, atol=1e-9)
    origin, direction = cloud(5_000, 2.0, 1), torch.nn.functional.normalize(cloud(5_000, 1.0, 2))
    for a, b in zip(mesh.interval(origin, direction), box.interval(origin, direction), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-13)
    row, enter, leave = mesh.stretches(origin, direction, torch.full((5_000,), 9.0, dtype=F64))
    first, last = box.interval(origin, direction)
    first, last = first.clamp(min=0.0), last.clamp(max=9.0)
    assert torch.equal(row, torch.nonzero(last - first > 1e-8).squeeze(-1))
    torch.testing.assert_close(enter, first[row], rtol=0, atol=1e-13)
    torch.testing.assert_close(leave, last[row], rtol=0, atol=1e-13)


def test_rectangles_hold_their_faces():
    for mesh in (boxed(1), angle_iron(), prism(), ring()):
        centre, edges, half = mesh.rectangles()
        planes, corner = mesh.planes(), mesh.vertices[mesh.triangles]
        frame = torch.cat([edges, planes[:, None, :3]], 1)
        torch.testing.assert_close(
            frame @ frame.mT, torch.eye(3, dtype=F64).expand_as(frame), rtol=0, atol=1e-14
        )
        torch.testing.assert_close(
            (centre * planes[:, :3]).sum(-1), planes[:, 3], rtol=0, atol=1e-14
        )
        local = torch.einsum("tcj,tij->tci", corner - centre[mesh.face, None], edges[mesh.face])
        over = (local.abs() - half[mesh.face, None]).amax(1)
        assert float(over.max()) <= 1e-14
        touched = over.new_full((len(planes), 2), -torch.inf)
        touched = touched.scatter_reduce(0, mesh.face[:, None].expand(-1, 2), over, "amax")
        assert float(touched.min()) >= -1e-14  # and not by more than they need
    areas = boxed(2).rectangles()[2].prod(-1).sort().values
    torch.testing.assert_close(areas, torch.tensor([0.15] * 2 + [0.21] * 2 + [0.35] * 2, dtype=F64))


def winding(mesh: Mesh, point: torch.Tensor) -> torch.Tensor:
    """Solid angle of the mesh over 4 pi: 1 inside, 0 outside (Van Oosterom and Strackee 1983)."""
    corner = mesh.vertices[mesh.triangles][None] - point[:, None, None]
    a, b, c = corner.unbind(2)
    na, nb, nc = (x.norm(dim=-1) for x in (a, b, c))
    volume = (a * torch.linalg.cross(b, c)).sum(-1)
    below = na * nb * nc + (a * b).sum(-1) * nc + (b * c).sum(-1) * na + (c * a).sum(-1) * nb
    return (2.0 * torch.atan2(volume, below)).sum(1) / (4.0 * torch.pi)


def from_triangle(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Distance of a point from one triangle: the foot if it lies within, else the nearest side."""
    normal = np.cross(b - a, c - a)
    foot = p - normal * ((p - a) @ normal) / (normal @ normal)
    sides = [(a, b), (b, c), (c, a)]
    if all(np.cross(y - x, foot - x) @ normal >= 0 for x, y in sides):
        return float(np.linalg.norm(p - foot))
    best = np.inf
    for x, y in sides:
        share = np.clip((p - x) @ (y - x) / ((y - x) @ (y - x)), 0, 1)
        best = min(best, float(np.linalg.norm(p - x - share * (y - x))))
    return best


@pytest.mark.parametrize("make", [angle_iron, prism, ring])
def test_distance_and_sign_against_plain_twins(make):
    mesh = make()
    p = cloud(400, 0.8, 3)
    value = mesh.sdf(p)
    around = winding(mesh, p)
    assert bool(((around - around.round()).abs() < 1e-9).all())
    assert torch.equal(around.round() == 1.0, value < 0) and bool((value < 0).any())
    corners = mesh.vertices[mesh.triangles].detach().numpy()
    plain = [min(from_triangle(x, *t) for t in corners) for x in p.numpy()]
    torch.testing.assert_close(value.abs(), torch.tensor(plain, dtype=F64), rtol=0, atol=1e-14)


def test_no_line_slips_through_a_seam():
    """Aimed at diagonals, edges and corners of the triangles, and along faces."""
    mesh = angle_iron()
    corner = mesh.vertices[mesh.triangles]
    weights = torch.tensor(
        [[1, 0, 0], [0, 1, 0], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.3, 0, 0.7], [0.2, 0.3, 0.5]],
        dtype=F64,
    )
    target = torch.einsum("wc,tcj->twj", weights, corner).reshape(-1, 3)
    for direction in list(itertools.product((-1.0, 0.0, 1.0), repeat=3))[14:]:
        d = torch.tensor(direction, dtype=F64).expand_as(target)
        length = torch.full((len(target),), 4.0, dtype=F64)
        row, enter, leave = mesh.stretches(target - 2.0 * d, d, length)
        t = torch.linspace(1.0, 3.0, 301, dtype=F64) + 1.234e-4
        deep = mesh.sdf(target[:, None] + (t - 2.0)[:, None] * d[:, None]) < -1e-6
        inside = torch.zeros_like(deep)
        for k in range(len(row)):
            inside[row[k]] |= (t >= enter[k]) & (t <= leave[k])
        assert not bool((deep & ~inside).any())


def test_many_points_are_asked_in_pieces(monkeypatch):
    mesh, p = angle_iron(), cloud(500)
    whole, chords = mesh.sdf(p), mesh.stretches(p, p, torch.ones(500, dtype=F64))
    monkeypatch.setattr("rfsg.objects.shapes.mesh.CHUNK", 100)
    assert torch.equal(mesh.sdf(p), whole)
    again = mesh.stretches(p, p, torch.ones(500, dtype=F64))
    assert all(torch.equal(a, b) for a, b in zip(chords, again, strict=True))
    none = mesh.stretches(p[:0], p[:0], whole[:0])
    assert [len(x) for x in none] == [0, 0, 0] and mesh.sdf(p[:0]).shape == (0,)


def test_derivatives():
    """Value and gradient by point and by vertex, nearest to faces, edges and corners."""
    mesh = angle_iron()
    p = cloud(12, 0.7, 5)
    assert gradcheck(mesh.value_and_gradient, (p.clone().requires_grad_(True),))

    def by_vertex(vertices):
        mesh._parameters["vertices"] = vertices
        return (*mesh.value_and_gradient(p), mesh.planes())

    assert gradcheck(by_vertex, (mesh.vertices.detach().clone().requires_grad_(True),))


def test_gradients_of_crossings_of_a_convex_one():
    mesh = prism()
    origin = cloud(60, 2.0, 6)
    direction = torch.nn.functional.normalize(0.1 * cloud(60, 1.0, 7) - origin)
    hit = torch.isfinite(mesh.interval(origin, direction)[0])
    assert int(hit.sum()) > 30
    origin, direction = origin[hit][:8], direction[hit][:8]

    def ends(vertices):
        mesh._parameters["vertices"] = vertices
        return mesh.interval(origin, direction)

    assert gradcheck(ends, (mesh.vertices.detach().clone().requires_grad_(True),))


def test_a_mesh_inside_out_is_turned_and_loose_corners_are_welded():
    right = angle_iron()
    corner = right.vertices[right.triangles].detach().numpy()
    loose = corner[:, ::-1].reshape(-1, 3)
    mesh = Mesh(loose, np.arange(len(loose)).reshape(-1, 3))
    assert len(mesh.vertices) == len(right.vertices) == 12
    p = cloud(300)
    torch.testing.assert_close(mesh.sdf(p), right.sdf(p), rtol=0, atol=1e-15)


def test_faces_in_single_precision_are_flat():
    """A large one, turned: its corners leave their planes by rounding, its faces stay eight."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).to(F64))[0]
    mesh = angle_iron()
    rounded = (200.0 * mesh.vertices @ turn).float().double()
    assert len(Mesh(rounded, mesh.triangles).planes()) == 8


def test_what_is_no_solid_is_refused(monkeypatch):
    box = trimesh.creation.box()
    v, f = np.array(box.vertices), np.array(box.faces)
    with pytest.raises(ValueError, match="not closed: 3 edges do not join two.*first from"):
        Mesh(v, f[1:])
    flipped = f.copy()
    flipped[3] = flipped[3, ::-1]
    with pytest.raises(ValueError, match="wound in different senses: recalculate"):
        Mesh(v, flipped)
    with pytest.raises(ValueError, match="triangle without area"):
        sliver = np.concatenate([v, [0.5 * (v[f[0, 0]] + v[f[0, 1]])]])
        # the first triangle cut at a point of one side, and the gap filled by a line
        a, b, c = f[0]
        Mesh(sliver, np.concatenate([f[1:], [[a, 8, c], [8, b, c], [a, b, 8]]]))
    with pytest.raises(ValueError, match="outline of 2 corners"):
        extruded([(0.0, 0.0), (1.0, 0.0)], 1.0)
    with pytest.raises(ValueError, match="finite rows"):
        Mesh(v * np.nan, f)
    with pytest.raises(ValueError, match="outside of 0 to 7"):
        Mesh(v, f + 1)
    with pytest.raises(ValueError, match="rows of three"):
        Mesh(v, f[:, :2])
    monkeypatch.setattr(topology, "MAX_TRIANGLES", 11)
    with pytest.raises(ValueError, match="4 to 11"):
        Mesh(v, f)
    monkeypatch.undo()
    two = np.concatenate([v, v + [0.0, 0.0, 3.0]]), np.concatenate([f, f + 8])
    assert not Mesh(*two).convex
    with pytest.raises(NotImplementedError):
        Mesh(*two).interval(cloud(1), cloud(1))


def test_polygons_keep_their_area_whatever_their_outline():
    """A comb with corners in a row, in a plane that lies askew; quads with an inward corner too."""
    comb = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2), (0, 1)]
    dart = [(5, 0), (7, 1), (5, 2), (6, 1)]
    flat = np.array([[x, y, 0.0] for x, y in comb + dart], dtype=np.float64)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn = turn * np.sign(np.linalg.det(turn))
    count, index = np.array([len(comb), len(dart)]), np.arange(len(flat))
    triangles = triangles_of(flat @ turn.T, count, index)
    assert len(triangles) == len(flat) - 4
    a, b, c = flat[triangles].transpose(1, 0, 2)
    area = 0.5 * np.cross(b - a, c - a)[:, 2]
    assert area.min() > 0 and area.sum() == pytest.approx(5.0 + 1.0)
    assert len(extruded([(float(x), float(y)) for x, y in comb], 0.5).planes()) == 2 + 8
