"""Many sheets at once, one per point, as ``analytic.Boxes`` are many boxes.

A city is thousands of sheets of a dozen triangles each, and asking each alone costs more in calls than in
arithmetic. Their triangles stand in one table, those of a sheet together; a row asks those of its own
sheet, a pair of a row and a triangle at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.sheet import INSIDE, Drawn, Sheet, in_prisms, united

PAIRS = 200_000  # of a row and a triangle at a time: some 50 MB


@dataclass(frozen=True)
class Ranges:
    """Rows of a table that belong together: those of owner i are begin[i] to begin[i] + count[i]."""

    begin: Int[Tensor, "s"]
    count: Int[Tensor, "s"]

    @classmethod
    def of(cls, counts: Sequence[int], device: torch.device) -> "Ranges":
        count = torch.tensor(counts, dtype=torch.int64, device=device)
        return cls(torch.cumsum(count, 0) - count, count)

    def pairs(self, owner: Int[Tensor, "m"]) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
        """(row, number in the table) for every row and all that its owner has."""
        count = self.count[owner]
        row = torch.repeat_interleave(torch.arange(len(owner), device=owner.device), count)
        ahead = (torch.cumsum(count, 0) - count) - self.begin[owner]
        return row, torch.arange(len(row), device=owner.device) - ahead[row]


class Table:
    """The sheets of a scene in one table: ``whole`` is one sheet of all their triangles.

    Made of vertices as they are; a sheet whose vertices are being fitted must not be in it."""

    def __init__(self, sheets: Sequence[Sheet], device: torch.device):
        self.sheets = sheets
        self.triangle = Ranges.of([s._count for s in sheets], device)
        self.segment = Ranges.of([len(s.segments) for s in sheets], device)
        self.face = Ranges.of([s._faces for s in sheets], device)
        self.whole = self._joined(Ranges.of([len(s.vertices) for s in sheets], device))
        # weights and offsets of a triangle's four forms side by side
        drawn, t = self.whole._drawn, self.whole._count
        self.weight = drawn.weight.reshape(4, t, 3).transpose(0, 1).contiguous()
        self.offset = drawn.offset.reshape(4, t).T.contiguous()

    def _joined(self, vertex: Ranges) -> Sheet:
        sheets, whole = self.sheets, object.__new__(Sheet)
        nn.Module.__init__(whole)
        whole._tables, whole.convex = {}, False
        whole._count = int(self.triangle.count.sum())
        whole.vertices = nn.Parameter(torch.cat([s.vertices for s in sheets]), requires_grad=False)
        sides = [s.triangles.split(s._count) for s in sheets]
        faces = [s.face.split(s._count) for s in sheets]
        first, of_face = vertex.begin.tolist(), self.face.begin.tolist()
        fronts = self.triangle.begin.tolist()
        backs = [whole._count + f for f in fronts]
        both = [s[k] + v for k in (0, 1) for s, v in zip(sides, first, strict=True)]
        face = [f[k] + b for k in (0, 1) for f, b in zip(faces, of_face, strict=True)]
        pairs = [
            torch.where(s.sides < s._count, s.sides + i, s.sides + (j - s._count))
            for s, i, j in zip(sheets, fronts, backs, strict=True)
        ]
        columns = {
            "triangles": both,
            "face": face,
            "ends": [s.ends + v for s, v in zip(sheets, first, strict=True)],
            "sides": pairs,
            "segments": [s.segments + v for s, v in zip(sheets, first, strict=True)],
            "triangle_of_segment": [
                s.triangle_of_segment + i for s, i in zip(sheets, fronts, strict=True)
            ],
        }
        for name, column in columns.items():
            whole.register_buffer(name, torch.cat(column), persistent=False)
        return whole

    def hand_out(self) -> None:
        """Gives each sheet the planes and rectangles of its faces, worked out for all at once."""
        whole, counts = self.whole, self.face.count.tolist()
        tables = (Mesh.planes(whole), whole.planes(), *whole.rectangles())
        rows = zip(self.sheets, *(x.split(counts) for x in tables), strict=True)
        for sheet, middle, lifted, *rectangles in rows:
            sheet._kept("planes", lambda: middle)  # noqa: B023, asked at once
            sheet._kept("sides", lambda: lifted)  # noqa: B023
            sheet._kept("rectangles", lambda: tuple(rectangles))  # noqa: B023


class Sheets(Sheet):
    """Row i of every batch asks sheet ``sheet[i]`` of a table; batches are flat [m 3]."""

    def __init__(self, table: Table, sheet: Int[Tensor, "m"]):
        nn.Module.__init__(self)
        self.table, self.sheet = table, sheet
        self._tables, self.convex, self._count = {}, False, table.whole._count
        self.vertices, self.face = table.whole.vertices, table.whole.face
        self.triangle_of_segment = table.whole.triangle_of_segment

    @property
    def _drawn(self) -> Drawn:
        return self.table.whole._drawn

    def plane_of(self, patch: Int[Tensor, "m"]) -> Float[Tensor, "m 4"]:
        """Row ``patch`` of each sheet's ``planes``."""
        return self.table.whole.planes()[self.table.face.begin[self.sheet] + patch]

    def normal_at(self, point: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        return self.plane_of(self.patch(point)).to(point)[:, :3]

    @torch.no_grad()
    def patch(self, point: Float[Tensor, "m 3"]) -> Int[Tensor, "m"]:
        return super().patch(point) - self.table.face.begin[self.sheet]

    def _blocks(self) -> Sequence[slice]:
        """Rows at a time, so that no more than ``PAIRS`` pairs are at hand."""
        owner = self.sheet
        count = self.table.triangle.count[owner] + self.table.segment.count[owner]
        block = torch.div(torch.cumsum(count, 0), PAIRS, rounding_mode="floor")
        ends = torch.searchsorted(block, torch.unique(block), right=True).tolist()
        return [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def _above(self, point: Float[Tensor, "m 3"], rows: slice) -> tuple[Tensor, Tensor, Tensor]:
        """(row of the block, triangle, square of the distance to it from above or below, else inf)."""
        row, triangle = self.table.triangle.pairs(self.sheet[rows])
        forms = self._forms(triangle, point[rows][row], self.table.offset)
        within = forms[:, 1:].amin(1) >= -INSIDE
        return row, triangle, torch.where(within, forms[:, 0] ** 2, torch.inf)

    def _forms(self, triangle: Tensor, vector: Tensor, offset: Tensor | None) -> Tensor:
        weight = self.table.weight.to(vector)[triangle]
        form = (weight * vector[:, None]).sum(-1)
        return form if offset is None else form + offset.to(vector)[triangle]

    def _rows(self, rows: Int[Tensor, "k"]) -> Mesh:
        return Sheets(self.table, self.sheet[rows])

    def _nearest_above(self, point: Float[Tensor, "m 3"]) -> tuple[Tensor, Tensor]:
        found = [(point[:0, 0], self.sheet[:0])]
        for rows in self._blocks():
            row, triangle, square = self._above(point, rows)
            found.append(least(row, triangle, square, len(point[rows])))
        square, triangle = (torch.cat(column) for column in zip(*found, strict=True))
        return square, triangle

    @torch.no_grad()
    def _search(self, point: Tensor) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
        point = point.detach()
        found = [(self.sheet[:0], point[:0, 0])]
        for rows in self._blocks():
            row, triangle, above = self._above(point, rows)
            of, segment = self.table.segment.pairs(self.sheet[rows])
            start, along = (x.to(point)[segment] for x in (self._drawn.start, self._drawn.along))
            away = point[rows][of] - start
            share = ((away * along).sum(-1) / (along * along).sum(-1)).clamp(0.0, 1.0)
            off = away - share[:, None] * along
            square = torch.cat([above, (off * off).sum(-1)])
            pair = torch.arange(len(square), device=square.device)
            best = least(torch.cat([row, of]), pair, square, len(point[rows]))[1]
            number = torch.cat([triangle, self._count + segment])
            found.append((number[best], torch.cat([torch.zeros_like(above), share])[best]))
        feature, share = (torch.cat(column) for column in zip(*found, strict=True))
        return feature, share

    @torch.no_grad()
    def stretches(
        self,
        origin: Float[Tensor, "m 3"],
        direction: Float[Tensor, "m 3"],
        length: Float[Tensor, "m"],
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"], Float[Tensor, "k"]]:
        """(row, enter, leave) where lines are in the sheets, as ``Sheet.stretches`` says it of one."""
        none = length.new_zeros(0, dtype=torch.float64)
        parts = [(none.long(), none, none)]
        for rows in self._blocks():
            row, triangle = self.table.triangle.pairs(self.sheet[rows])
            value = self._forms(triangle, origin[rows].double()[row], self.table.offset)
            rate = self._forms(triangle, direction[rows].double()[row], None)
            pair, enter, leave = in_prisms(value[..., None], rate[..., None])
            line = row[pair] + rows.start
            enter, leave = enter.clamp(min=0.0), torch.minimum(leave, length[line].double())
            through = leave > enter
            parts.append((line[through], enter[through], leave[through]))
        return united(*(torch.cat(column) for column in zip(*parts, strict=True)))


def least(
    row: Int[Tensor, "p"], number: Int[Tensor, "p"], value: Float[Tensor, "p"], rows: int
) -> tuple[Float[Tensor, "m"], Int[Tensor, "m"]]:
    """Of every row the least value, and the number that has it; of equal ones the lowest."""
    most = value.new_full((rows,), torch.inf).scatter_reduce(0, row, value, "amin")
    has = value == most[row]
    last = number.new_full((rows,), torch.iinfo(torch.int64).max)
    return most, last.scatter_reduce(0, row[has], number[has], "amin")
