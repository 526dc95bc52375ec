"""Sheets: surfaces without an inside, of any triangles."""

import math

import numpy as np
import pytest
import torch

from rfsg.objects.catalogue import shape_class
from rfsg.objects.shapes.edges import edges_of
from rfsg.objects.shapes.mesh import Mesh, extruded
from rfsg.objects.shapes.sheet import HALF, Sheet
from rfsg.objects.shapes.sheet_soup import wedges_of

F64 = torch.float64
SQUARE = ([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])


def cloud(count: int = 400, seed: int = 0) -> torch.Tensor:
    return (
        3.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=F64) - 1.0
    )


def soup(count: int = 12, seed: int = 3) -> Sheet:
    """Triangles anywhere, wound anyhow, some of which share edges."""
    random = np.random.default_rng(seed)
    return Sheet(random.uniform(0, 1, (9, 3)), random.choice(9, (count, 3)))


def plain_distance(shape: Sheet, point: torch.Tensor) -> torch.Tensor:
    """The plain twin: to the closest of many samples of every triangle."""
    steps = torch.linspace(0, 1, 80, dtype=F64)
    b, c = torch.meshgrid(steps, steps, indexing="ij")
    inside = b + c <= 1
    share = torch.stack([1 - b[inside] - c[inside], b[inside], c[inside]], -1)
    corner = shape.vertices[shape.triangles[: shape._count]]
    samples = torch.einsum("sk,tkj->tsj", share, corner).reshape(-1, 3)
    return torch.cdist(point, samples).amin(1)


def test_the_distance_is_that_to_the_triangles():
    """Less half of what the sheet is drawn with; against samples 1/79 of a side apart."""
    shape, point = soup(), cloud(200)
    got = shape.sdf(point) + HALF
    want = plain_distance(shape, point)
    assert bool((got <= want + 1e-12).all())
    assert bool((want <= (got**2 + (math.sqrt(3) / 79) ** 2).sqrt() + 1e-12).all())


def test_a_closed_sheet_is_as_far_away_as_the_solid():
    solid = extruded([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 0.5)
    sheet = Mesh(solid.vertices, solid.triangles, sheet=True)
    torch.testing.assert_close(
        sheet.sdf(cloud()) + HALF, solid.sdf(cloud()).abs(), rtol=0, atol=1e-14
    )
    assert len(sheet.planes()) == 2 * len(solid.planes())


def test_gradients_point_away_from_the_sheet():
    shape, point = soup(), cloud(50).requires_grad_()
    value, gradient = shape.value_and_gradient(point)
    (slope,) = torch.autograd.grad(value.sum(), point)
    torch.testing.assert_close(gradient, slope, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(50, dtype=F64))


def test_jets_by_differences():
    shape, point = soup(), cloud(40)
    jet, step = shape.jet(point), 1e-6
    for axis in range(3):
        move = step * torch.eye(3, dtype=F64)[axis]
        up, down = (shape.value_and_gradient(point + s * move)[1] for s in (1, -1))
        torch.testing.assert_close(
            jet.hessian[:, axis], (up - down) / (2 * step), rtol=1e-4, atol=1e-4
        )


def test_gradcheck_in_points_and_vertices():
    shape, point = Sheet(*SQUARE), torch.tensor([[0.3, 0.4, 0.7], [1.6, 0.5, 0.2]], dtype=F64)

    def value(x, z):
        moved = Sheet(*SQUARE)
        moved.vertices.requires_grad_(True)
        tilted = torch.cat([shape.vertices[:, :2], z[:, None]], 1)
        parameters = {"vertices": tilted}
        return torch.func.functional_call(moved, parameters, (x,))

    Sheet.forward = Sheet.sdf  # type: ignore[attr-defined]
    try:
        z = torch.zeros(4, dtype=F64)
        flat = torch.tensor([0.2, 0.2, 0.2, 0.2], dtype=F64)  # faces stay flat along this way
        f = lambda x, s: value(x, z + s * flat)  # noqa: E731
        s = torch.zeros((), dtype=F64, requires_grad=True)
        assert torch.autograd.gradcheck(f, (point.clone().requires_grad_(), s))
    finally:
        del Sheet.forward  # type: ignore[attr-defined]


def test_a_line_crosses_a_sheet_once_for_each_time_it_meets_it():
    """Through a closed box twice, through a square once, beside it never; as deep as the cosine says."""
    shape = Sheet(*SQUARE)
    origin = torch.tensor([[0.3, 0.2, 1.0], [0.5, 0.5, 1.0], [3.0, 3.0, 1.0]], dtype=F64)
    down = torch.tensor([0.0, 0.6, -0.8], dtype=F64).expand(3, 3)
    row, enter, leave = shape.stretches(origin, down, torch.full((3,), 9.0, dtype=F64))
    assert row.tolist() == [0]  # the second leaves the square on its way down
    torch.testing.assert_close(enter, torch.tensor([(1.0 - HALF) / 0.8], dtype=F64))
    torch.testing.assert_close(leave, torch.tensor([(1.0 + HALF) / 0.8], dtype=F64))
    box = extruded([(0, 0), (1, 0), (1, 1), (0, 1)], 0.5)
    hollow = Mesh(box.vertices, box.triangles, sheet=True)
    row, enter, _ = hollow.stretches(
        torch.tensor([[-1.0, 0.31, 0.12]], dtype=F64),
        torch.tensor([[1.0, 0.0, 0.0]], dtype=F64),
        torch.tensor([9.0], dtype=F64),
    )
    assert row.tolist() == [0, 0]
    torch.testing.assert_close(enter, torch.tensor([1.0 - HALF, 2.0 - HALF], dtype=F64))


def test_no_line_slips_through_a_seam():
    """Through the diagonal and the corners of a square of two triangles, and along its fold."""
    shape = Sheet(*SQUARE)
    share = torch.linspace(0.0, 1.0, 101, dtype=F64)
    origin = torch.stack([share, share, torch.ones_like(share)], 1)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=F64).expand(101, 3)
    row, _, _ = shape.stretches(origin, down, torch.full((101,), 5.0, dtype=F64))
    assert row.tolist() == list(range(101))


def crossings_one_by_one(
    shape: Sheet, origin: torch.Tensor, direction: torch.Tensor
) -> list[float]:
    """The plain twin: every triangle alone, o + t d = a + x (b - a) + y (c - a)."""
    found = []
    for a, b, c in shape.vertices[shape.triangles[: shape._count]].detach().numpy():
        matrix = np.stack([b - a, c - a, -direction.numpy()], 1)
        x, y, t = np.linalg.solve(matrix, origin.numpy() - a)
        if min(x, y, 1 - x - y) > 0 and t > 0:
            found.append(float(t))
    return sorted(found)


def test_stretches_are_where_lines_meet_triangles():
    """Lines through a soup: one stretch about each crossing, the field negative within."""
    shape, many = soup(30), 60
    origin = cloud(many, seed=1)
    direction = torch.rand(many, 3, generator=torch.Generator().manual_seed(2), dtype=F64) - origin
    direction = direction / direction.norm(dim=-1, keepdim=True)
    row, enter, leave = shape.stretches(origin, direction, torch.full((many,), 9.0, dtype=F64))
    for line in range(many):
        mine = row == line
        middle = (0.5 * (enter + leave))[mine]
        want = crossings_one_by_one(shape, origin[line], direction[line])
        torch.testing.assert_close(middle, torch.tensor(want, dtype=F64), rtol=0, atol=1e-9)
    assert len(row) >= 50
    middle = origin[row] + (0.5 * (enter + leave))[:, None] * direction[row]
    assert bool((shape.sdf(middle) < 0).all())


def test_wedges_about_a_seam_of_three_walls():
    """A T of three half-planes at 0, 90 and 180 degrees: two right angles, and one flat side."""
    shape = Sheet(
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 1, 2], [0, 1, 3], [0, 1, 4]],
    )
    # below, the floor is one face; above, the wall parts it
    normal = shape.planes()[:, :3]
    assert len(normal) == 5
    assert int((normal[:, 2] < -0.5).sum()) == 1 and int((normal[:, 2] > 0.5).sum()) == 2


def test_windings_do_not_matter():
    """Every triangle turned over, or half of them: the same faces, edges and distances."""
    box = extruded([(0, 0), (2, 0), (2, 1), (0, 1)], 0.5)
    vertices, triangles = box.vertices.detach().numpy(), box.triangles.numpy().copy()
    shapes = [Sheet(vertices, triangles)]
    triangles[::2] = triangles[::2, ::-1]
    shapes.append(Sheet(vertices, triangles))
    a, b = (torch.unique(s.planes().round(decimals=9), dim=0) for s in shapes)
    torch.testing.assert_close(a, b)
    assert [len(edges_of(s).start) for s in shapes] == [len(edges_of(box).start)] * 2
    torch.testing.assert_close(shapes[0].sdf(cloud()), shapes[1].sdf(cloud()))


def test_every_side_looks_into_one_wedge_of_each_of_its_edges():
    shape = soup()
    one = shape.triangles[: shape._count].numpy()
    side = np.arange(2 * len(one)).reshape(2, -1)
    _, _, pairs = wedges_of(shape.vertices.detach().numpy(), one, *side)
    assert np.bincount(pairs[:, 2:].ravel(), minlength=2 * len(one)).tolist() == [3] * 2 * len(one)


def test_what_is_no_triangle_is_left_out():
    vertices, triangles = SQUARE
    again = [*triangles, [2, 1, 0], [0, 0, 1], [0, 1, 1]]
    assert Sheet(vertices, again)._count == 2


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        ([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], "without a triangle that has an area"),
        ([[0.0, 0, float("nan")]] * 3, [[0, 1, 2]], "expected finite"),
        (SQUARE[0], [[0, 1, 4]], "outside of 0 to 3"),
        (SQUARE[0], np.array([[0.0, 1, 2]]), "expected 1 to"),
        (SQUARE[0], np.zeros((0, 3), int), "expected 1 to"),
    ],
)
def test_what_is_no_sheet_is_refused(vertices, triangles, message):
    with pytest.raises(ValueError, match=message):
        Sheet(vertices, triangles)


def test_files_know_a_sheet_as_a_mesh():
    shape = soup()
    again = shape_class(shape.kind)(**shape.config())
    assert isinstance(again, Sheet)
    torch.testing.assert_close(again.sdf(cloud()), shape.sdf(cloud()), rtol=0, atol=0)
