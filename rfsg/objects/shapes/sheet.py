"""A surface without an inside as a shape: walls, roofs, terrain drawn as bare triangles, open or closed.

Other programs draw a wall as one sheet of triangles and say its thickness with its material. Here the
sheet is all that lies within ``HALF`` of the triangles: thin enough that no wave minds, thick enough
that a line crosses it once and both of its sides are mirrors. So any triangles will do: holes, seams of
three walls, windings that disagree, a closed box in which radios stand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor, nn

from rfsg.objects.contract import Jet
from rfsg.objects.shapes.mesh import CHUNK, INSIDE, Mesh, beside_segments
from rfsg.objects.shapes.sheet_soup import Soup, soups

HALF = 1e-5  # [m] half of what a sheet is drawn with: a path is off by a five-hundredth of 1 cm at most
LEVEL_LINE = 1e-12  # sine between a line and a plane that it never meets
RIM = 1e-9  # of a triangle's sides: neighbours overlap by so much, and no line slips between


@dataclass(frozen=True)
class Drawn:
    """Of every triangle, seen from its front, the plane, and four linear forms of a point: its height
    over the plane, and its shares of the three corners, all >= 0 above the triangle. Of every segment:
    where it starts and how far it runs."""

    plane: Float[Tensor, "t 4"]
    weight: Float[Tensor, "t4 3"]
    offset: Float[Tensor, "t4"]
    start: Float[Tensor, "s 3"]
    along: Float[Tensor, "s 3"]

    def forms(self, point: Float[Tensor, "m 3"]) -> Float[Tensor, "m 4 t"]:
        form = torch.addmm(self.offset.to(point), point, self.weight.to(point).T)
        return form.reshape(len(point), 4, len(self.plane))

    def rates(self, direction: Float[Tensor, "m 3"]) -> Float[Tensor, "m 4 t"]:
        """How the forms change along directions."""
        rate = direction @ self.weight.to(direction).T
        return rate.reshape(len(direction), 4, len(self.plane))


class Sheet(Mesh):
    """Both sides of ``triangles`` [t 3] over ``vertices`` [v 3] in metres; patches are flat faces of one
    side. The material's thickness is the material's: the sheet itself is drawn 2 ``HALF`` thick.

    ``triangles`` holds every triangle twice, as given and then turned over, and ``sides`` the two that
    look into each wedge about an edge. Triangles without area and repeated ones are left out. Edges where
    a sheet ends do not diffract. Raises ValueError for arrays of another shape, numbers that are not
    finite, indices out of range, and where no triangle is left.
    """

    segments: Tensor
    triangle_of_segment: Tensor

    def __init__(
        self,
        vertices: Sequence[Sequence[float]] | ndarray | Tensor,
        triangles: Sequence[Sequence[int]] | ndarray | Tensor,
        sheet: bool = True,
    ):
        (soup,) = soups([(np.asarray(vertices), np.asarray(triangles))])
        if isinstance(soup, ValueError):
            raise soup
        self._take(soup)

    @classmethod
    def of(cls, soup: Soup) -> "Sheet":
        """The sheet of a soup; of many sheets those are made at once (``sheet_soup.soups``)."""
        sheet = object.__new__(cls)
        sheet._take(soup)
        return sheet

    def _take(self, soup: Soup) -> None:
        nn.Module.__init__(self)
        self._tables = {}
        self.vertices = nn.Parameter(torch.from_numpy(soup.vertices), requires_grad=False)
        for name in ("triangles", "face", "ends", "sides", "segments", "triangle_of_segment"):
            tensor = torch.from_numpy(np.ascontiguousarray(getattr(soup, name)))
            self.register_buffer(name, tensor, persistent=False)
        self.convex = False
        self._count = len(soup.triangles) // 2

    def config(self) -> dict[str, object]:
        """Constructor arguments, ready for JSON: those of ``Mesh``, which makes a sheet of them."""
        one = self.triangles[: self._count]
        return {"vertices": self.vertices.tolist(), "triangles": one.tolist(), "sheet": True}

    def bounds(self) -> Float[Tensor, "2 3"]:
        return super().bounds() + HALF * torch.tensor([[-1.0], [1.0]]).to(self.vertices)

    def planes(self) -> Float[Tensor, "k 4"]:
        """The mean plane of each face, on its side of the triangles."""
        return self._kept("sides", self._lifted)

    def _lifted(self) -> Float[Tensor, "k 4"]:
        middle = Mesh.planes(self)
        return torch.cat([middle[:, :3], middle[:, 3:] + HALF], 1)

    @property
    def _drawn(self) -> "Drawn":
        return self._kept("drawn", self._made_drawn)

    def _made_drawn(self) -> "Drawn":
        t = self._count
        plane = Mesh.planes(self)[self.face[:t]]
        a, u, v = (x[:t] for x in self._frames())
        first, second = (a * u).sum(-1), (a * v).sum(-1)
        weight = torch.cat([plane[:, :3], u, v, -u - v])
        offset = torch.cat([-plane[:, 3], -first, -second, 1.0 + first + second])
        start, stop = self.vertices[self.segments].unbind(1)
        return Drawn(plane, weight, offset, start, stop - start)

    # distances

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient [1]; on the triangles themselves that of one side."""
        flat = point.reshape(-1, 3)
        value, gradient, _, _ = self._off(flat)
        return value.reshape(point.shape[:-1]), gradient.reshape(point.shape)

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        flat = point.reshape(-1, 3)
        value, gradient, across, on_face = self._off(flat)
        round_it = across - gradient[:, :, None] * gradient[:, None, :]
        away = value + HALF
        flat_here = on_face | (away <= 0)
        bend = round_it / torch.where(flat_here, 1.0, away)[:, None, None]
        bend = torch.where(flat_here[:, None, None], 0.0, bend)
        shape = point.shape
        return Jet(value.reshape(shape[:-1]), gradient.reshape(shape), bend.reshape(*shape, 3))

    def _off(self, point: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Signed distance, gradient, the projector across the nearest feature (a face, an edge or a
        vertex), and whether it is a face; differentiable in points and vertices."""
        feature, share = self._search(point)
        on_face = feature < self._count
        drawn, segment = self._drawn, (feature - self._count).clamp(min=0)
        plane = drawn.plane[feature.clamp(max=self._count - 1)]
        normal = plane[:, :3]
        start, along = drawn.start[segment], drawn.along[segment]
        stop = start + along
        along = along / along.norm(dim=-1, keepdim=True)
        eye = torch.eye(3).to(start).expand(len(point), 3, 3)
        at_end = ((share <= 0) | (share >= 1))[:, None, None]
        across = torch.where(at_end, eye, eye - along[:, :, None] * along[:, None, :])
        face = on_face[:, None, None]
        across = torch.where(face, normal[:, :, None] * normal[:, None, :], across)
        anchor = torch.where((share >= 1)[:, None], stop, start)
        anchor = torch.where(on_face[:, None], plane[:, 3:] * normal, anchor)
        across, anchor, normal = (x.to(point) for x in (across, anchor, normal))
        offset = torch.einsum("mij,mj->mi", across, point - anchor)
        square = (offset * offset).sum(-1)
        apart = square > 0
        away = torch.where(apart, torch.where(apart, square, 1.0).sqrt(), 0.0)
        slope = offset / torch.where(apart, away, 1.0)[:, None]
        return away - HALF, torch.where(apart[:, None], slope, normal), across, on_face

    @torch.no_grad()
    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        flat = point.reshape(-1, 3)
        square, triangle = self._nearest_above(flat)
        # what lies on the sheet lies on a triangle; only beside one are segments looked at
        i = torch.nonzero(square > (2.0 * HALF) ** 2).squeeze(-1)
        if len(i):
            feature, _ = self._rows(i)._search(flat[i])
            beside = self.triangle_of_segment[(feature - self._count).clamp(min=0)]
            triangle[i] = torch.where(feature < self._count, feature, beside)
        plane = self._drawn.plane[triangle].to(flat)
        below = (flat * plane[:, :3]).sum(-1) < plane[:, 3]
        return self.face[triangle + self._count * below].reshape(point.shape[:-1])

    def _rows(self, rows: Int[Tensor, "k"]) -> Mesh:
        """What some rows of a batch ask: of one sheet, all of them the same."""
        return self

    def _nearest_above(self, point: Float[Tensor, "m 3"]) -> tuple[Tensor, Tensor]:
        """Square of the distance to, and number of, the nearest triangle that points stand above or below;
        inf where there is none."""
        square, triangle = self._above_them(point).min(1)
        return square, triangle

    def _above_them(self, point: Float[Tensor, "m 3"]) -> Float[Tensor, "m t"]:
        """Square of the distance to triangles that points stand above or below; else inf."""
        forms = self._drawn.forms(point)
        within = forms[:, 1:].amin(1) >= -INSIDE
        return torch.where(within, forms[:, 0] ** 2, torch.inf)

    @torch.no_grad()
    def _search(self, point: Tensor) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
        """Number of the nearest triangle, or t + that of the nearest segment; and where along it."""
        t, drawn = self._count, self._drawn
        start, along = drawn.start.to(point), drawn.along.to(point)
        parts = [(torch.zeros(0, dtype=torch.int64, device=point.device), point[:0, 0].detach())]
        for some in point.detach().split(max(1, CHUNK // (t + len(start)))):
            away, share = beside_segments(some, start, along)
            feature = torch.cat([self._above_them(some), away], 1).argmin(1)
            segment = (feature - t).clamp(min=0)
            parts.append((feature, share.gather(1, segment[:, None]).squeeze(1)))
        feature, share = (torch.cat(column) for column in zip(*parts, strict=True))
        return feature, share

    # lines

    @torch.no_grad()
    def stretches(
        self,
        origin: Float[Tensor, "m 3"],
        direction: Float[Tensor, "m 3"],
        length: Float[Tensor, "m"],
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"], Float[Tensor, "k"]]:
        """(row, enter, leave) where lines are in the sheet, along origin + t direction, 0 <= t <= length.

        Over each triangle the sheet is a prism, and a line is in a prism in one stretch; those that
        touch are one.
        """
        parts = []
        for i in torch.arange(len(length), device=length.device).split(
            max(1, CHUNK // self._count)
        ):
            forms = self._drawn.forms(origin[i].double()), self._drawn.rates(direction[i].double())
            row, enter, leave = in_prisms(*forms)
            enter, leave = enter.clamp(min=0.0), torch.minimum(leave, length[i[row]].double())
            through = leave > enter
            parts.append((i[row[through]], enter[through], leave[through]))
        if not parts:
            none = length.new_zeros(0, dtype=torch.float64)
            return none.long(), none, none
        return united(*(torch.cat(column) for column in zip(*parts, strict=True)))


def in_prisms(
    value: Float[Tensor, "m 4 t"], rate: Float[Tensor, "m 4 t"]
) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"], Float[Tensor, "k"]]:
    """(row, enter, leave) of lines in the prisms over single triangles, by the triangles' forms at their
    origins and how they change along them: where the height is within a half and no share is negative."""
    least = value.new_tensor([-HALF, -RIM, -RIM, -RIM])[:, None]
    most = value.new_tensor([HALF, torch.inf, torch.inf, torch.inf])[:, None]
    still = rate.abs() < LEVEL_LINE
    safe = torch.where(still, 1.0, rate)
    ends = (least - value) / safe, (most - value) / safe
    always = torch.where((value >= least) & (value <= most), torch.inf, -torch.inf)
    since = torch.where(still, -always, torch.minimum(*ends)).amax(1)
    until = torch.where(still, always, torch.maximum(*ends)).amin(1)
    row, k = torch.nonzero(until > since, as_tuple=True)
    return row, since[row, k], until[row, k]


def united(row: Tensor, enter: Tensor, leave: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Stretches of rows, those that overlap or lie within a sheet's thickness of each other as one."""
    order = torch.argsort(enter, stable=True)
    order = order[torch.argsort(row[order], stable=True)]
    row, enter, leave = row[order], enter[order], leave[order]
    # rows one behind the other on one line, so that a running maximum never reaches into the next
    span = (leave.max() - enter.min() + 1.0) if len(row) else 1.0
    reach = torch.cummax(leave + row * span, 0).values if len(row) else leave
    begins = torch.ones_like(row, dtype=torch.bool)
    begins[1:] = (enter[1:] + row[1:] * span > reach[:-1] + 2.0 * HALF) | (row[1:] != row[:-1])
    group = torch.cumsum(begins, 0) - 1
    last = leave.new_full((int(begins.sum()),), -torch.inf)
    return row[begins], enter[begins], last.scatter_reduce(0, group, leave, "amax")
