"""Many sheets at once answer as each does alone."""

import numpy as np
import pytest
import torch

from rfsg.objects.shapes.sheet import Sheet
from rfsg.objects.shapes.sheet_soup import Soup, soups
from rfsg.objects.shapes.sheets import Sheets, Table, least

F64 = torch.float64
CPU = torch.device("cpu")
NAMES = ("vertices", "triangles", "face", "ends", "sides", "segments", "triangle_of_segment")


def raw(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles anywhere, wound anyhow, some of which share edges, some of which are given twice."""
    random = np.random.default_rng(seed)
    return random.uniform(0, 1, (9, 3)), random.choice(9, (count, 3))


def folded() -> tuple[np.ndarray, np.ndarray]:
    """Two walls and a roof in squares: faces of several triangles."""
    place = [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [1, 1, 0], [1, 1, 1], [0, 1, 1]]
    corner = [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2], [3, 2, 5], [3, 5, 6]]
    return np.array(place, float), np.array(corner)


MESHES = [raw(1, 5), folded(), raw(2, 30), raw(3, 12), folded()]


def table() -> Table:
    return Table([Sheet(*mesh) for mesh in MESHES], CPU)


def batch(many: int = 200, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points about the sheets, and the sheet that each is asked of."""
    random = torch.Generator().manual_seed(seed)
    point = 3.0 * torch.rand(many, 3, generator=random, dtype=F64) - 1.0
    return point, torch.randint(len(MESHES), (many,), generator=random)


def test_soups_are_made_together_as_alone():
    """Bit for bit, and with what is none among them."""
    line = (np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    astray = (np.zeros((3, 3)), np.array([[0, 1, 9]]))
    together = soups([MESHES[0], line, *MESHES[1:3], astray, *MESHES[3:]])
    why = [str(s) for s in together if isinstance(s, ValueError)]
    assert "an area" in why[0] and "outside of 0 to 2" in why[1]
    made = [s for s in together if isinstance(s, Soup)]
    for soup, mesh in zip(made, MESHES, strict=True):
        (alone,) = soups([mesh])
        for name in NAMES:
            np.testing.assert_array_equal(getattr(soup, name), getattr(alone, name))


def test_none_of_nothing():
    assert soups([]) == []


@pytest.mark.parametrize("pairs", [10, 200_000])
def test_distances_are_those_of_each_sheet(pairs, monkeypatch):
    monkeypatch.setattr("rfsg.objects.shapes.sheets.PAIRS", pairs)
    many = table()
    point, owner = batch()
    rows = Sheets(many, owner)
    value, gradient = rows.value_and_gradient(point)
    jet = rows.jet(point)
    for k, sheet in enumerate(many.sheets):
        i = torch.nonzero(owner == k).squeeze(-1)
        want = sheet.jet(point[i])
        for got, wanted in ((value, want.value), (gradient, want.gradient)):
            torch.testing.assert_close(got[i], wanted, rtol=0, atol=1e-9)
        torch.testing.assert_close(jet.hessian[i], want.hessian, rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(rows.sdf(point)[i], sheet.sdf(point[i]), rtol=0, atol=1e-12)


def test_patches_normals_and_planes_are_those_of_each_sheet():
    many = table()
    point, owner = batch()
    rows = Sheets(many, owner)
    patch, normal = rows.patch(point), rows.normal_at(point)
    plane = rows.plane_of(patch)
    for k, sheet in enumerate(many.sheets):
        i = torch.nonzero(owner == k).squeeze(-1)
        assert patch[i].tolist() == sheet.patch(point[i]).tolist()
        torch.testing.assert_close(normal[i], sheet.normal_at(point[i]), rtol=0, atol=1e-15)
        torch.testing.assert_close(plane[i], sheet.planes()[patch[i]], rtol=0, atol=1e-15)


@pytest.mark.parametrize("pairs", [10, 200_000])
def test_stretches_are_those_of_each_sheet(pairs, monkeypatch):
    monkeypatch.setattr("rfsg.objects.shapes.sheets.PAIRS", pairs)
    many = table()
    origin, owner = batch(seed=1)
    direction = 0.5 - origin
    direction = direction / direction.norm(dim=-1, keepdim=True)
    length = torch.full((len(owner),), 1.7, dtype=F64)
    row, enter, leave = Sheets(many, owner).stretches(origin, direction, length)
    for k, sheet in enumerate(many.sheets):
        i = torch.nonzero(owner == k).squeeze(-1)
        mine = owner[row] == k
        want = sheet.stretches(origin[i], direction[i], length[i])
        assert row[mine].tolist() == i[want[0]].tolist()
        for got, wanted in ((enter, want[1]), (leave, want[2])):
            torch.testing.assert_close(got[mine], wanted, rtol=0, atol=1e-12)
    assert len(row) > 100


def test_no_rows_have_no_answers():
    rows = Sheets(table(), torch.zeros(0, dtype=torch.int64))
    none = torch.zeros(0, 3, dtype=F64)
    assert rows.sdf(none).shape == (0,) and rows.patch(none).shape == (0,)
    assert [len(x) for x in rows.stretches(none, none, none[:, 0])] == [0, 0, 0]


def test_faces_worked_out_together_are_those_of_each_sheet():
    many, alone = table(), [Sheet(*mesh) for mesh in MESHES]
    many.hand_out()
    for sheet, other in zip(many.sheets, alone, strict=True):
        torch.testing.assert_close(sheet.planes(), other.planes(), rtol=0, atol=1e-14)
        for got, want in zip(sheet.rectangles(), other.rectangles(), strict=True):
            torch.testing.assert_close(got, want, rtol=0, atol=1e-14)


def test_what_was_handed_out_goes_with_the_vertices():
    """Whoever moves a vertex has new planes."""
    many = table()
    many.hand_out()
    sheet = many.sheets[1]
    before = sheet.planes().clone()
    with torch.no_grad():
        sheet.vertices.add_(torch.tensor([0.0, 0.0, 2.0], dtype=F64))
    up = 2.0 * before[:, 2]
    torch.testing.assert_close(sheet.planes()[:, 3], before[:, 3] + up, rtol=0, atol=1e-14)


def test_least_of_rows():
    """Of equal values the lowest number has it."""
    row, number = torch.tensor([0, 1, 0, 1, 1]), torch.tensor([7, 3, 5, 9, 2])
    value = torch.tensor([1.0, 4.0, 1.0, 0.5, 0.5])
    most, has = least(row, number, value, 2)
    assert most.tolist() == [1.0, 0.5] and has.tolist() == [5, 2]
