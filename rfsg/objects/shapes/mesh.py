"""A closed triangle mesh as a shape: flat faces, known exactly.

Triangles in one plane are one face, and a face is its plane: triangles only say how far it reaches.
The signed distance is that to the nearest face or edge, its sign that of the normals there (an edge
has the sum of its two faces' normals, a vertex the sum weighted by angle; Baerentzen and Aanaes 2005,
"Signed distance computation using the angle weighted pseudonormal"). Which face or edge is nearest
is searched without gradients; the distance to it is a closed form that carries them.

Facets of a round thing are mirrors of their own: learn it (`rfsg learn-shape`), or draw it as one of
the round shapes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rfsg.objects.contract import Jet
from rfsg.objects.shapes.polygons import triangles_of
from rfsg.objects.shapes.topology import LEVEL, closed_mesh

CHUNK = 1_000_000  # pairs of a point and a triangle or an edge at a time: some 100 MB in all
INSIDE = 1e-12  # of a triangle's sides: a point above the very rim is above the triangle
BRIEF = 1e-9  # [m] two crossings nearer than this are one; nothing deeper is missed
Made = TypeVar("Made")
SHALLOW = 2.5e-9  # [m] a line no deeper than this runs in a face, not inside


@dataclass(frozen=True)
class Nearest:
    """What is nearest to points: an anchor, and the projector ``across`` onto what is not along the
    feature: n n on a face (then ``face`` >= 0), I - e e beside an edge, I about a vertex."""

    face: Int[Tensor, "m"]
    anchor: Float[Tensor, "m 3"]
    across: Float[Tensor, "m 3 3"]
    outward: Float[Tensor, "m 3"]  # normal or pseudonormal


class Mesh(nn.Module):
    """Polyhedron of ``vertices`` [v 3] in metres and ``triangles`` [t 3]; patches are its flat faces.

    Corners at one place are one corner, and a mesh that is inside out is turned. ``vertices`` are
    float64 and ask for no gradient until told to; planes, edges and distances follow them as long as
    faces stay flat. ``sheet``: both sides of a surface without an inside instead, which need not be
    closed (``sheet.Sheet``). Raises ValueError for a mesh that is not closed, not wound in one sense, or
    has triangles without area.
    """

    kind = "mesh"
    lipschitz = 1.0
    faceted = True
    exact = True
    triangles: Tensor
    face: Tensor
    ends: Tensor
    sides: Tensor
    _triangle_of_face: Tensor

    def __new__(cls, vertices: Any = (), triangles: Any = (), sheet: bool = False) -> "Mesh":
        if sheet and cls is Mesh:  # files know both as meshes
            from rfsg.objects.shapes.sheet import Sheet

            return object.__new__(Sheet)
        return super().__new__(cls)

    def __init__(
        self,
        vertices: Sequence[Sequence[float]] | np.ndarray | Tensor,
        triangles: Sequence[Sequence[int]] | np.ndarray | Tensor,
        sheet: bool = False,
    ):
        super().__init__()
        self._tables: dict[str, Any] = {}
        made = closed_mesh(np.asarray(vertices), np.asarray(triangles))
        self.vertices = nn.Parameter(torch.from_numpy(made.vertices), requires_grad=False)
        for name in ("triangles", "face", "ends", "sides"):
            array = torch.from_numpy(np.ascontiguousarray(getattr(made, name)))
            self.register_buffer(name, array, persistent=False)
        number = torch.arange(len(self.triangles))
        first = torch.zeros(self._faces, dtype=torch.int64).index_copy(0, self.face, number)
        self.register_buffer("_triangle_of_face", first, persistent=False)  # any one
        self.convex = self._is_convex()

    def config(self) -> dict[str, object]:
        """Constructor arguments, ready for JSON."""
        return {"vertices": self.vertices.tolist(), "triangles": self.triangles.tolist()}

    def bounds(self) -> Float[Tensor, "2 3"]:
        return torch.stack([self.vertices.amin(0), self.vertices.amax(0)])

    def planes(self) -> Float[Tensor, "k 4"]:
        """The mean plane of each face, weighted by area."""
        return self._kept("planes", self._mean_planes)

    def _kept(self, name: str, make: Callable[[], Made]) -> Made:
        """What follows from the vertices alone, made once while they stay and nobody fits them."""
        if self.vertices.requires_grad:
            return make()
        at = (self.vertices.data_ptr(), self.vertices._version)
        if self._tables.get("at") != at:
            self._tables = {"at": at}
        if name not in self._tables:
            self._tables[name] = make()
        return self._tables[name]

    def _mean_planes(self) -> Float[Tensor, "k 4"]:
        a, b, c = self.vertices[self.triangles].unbind(1)
        cross = torch.linalg.cross(b - a, c - a)
        total = cross.new_zeros(self._faces, 3).index_add(0, self.face, cross)
        normal = total / total.norm(dim=-1, keepdim=True)
        weight = cross.norm(dim=-1)
        height = ((a + b + c) / 3.0 * normal[self.face]).sum(-1)
        offset = weight.new_zeros(self._faces).index_add(0, self.face, weight * height)
        area = weight.new_zeros(self._faces).index_add(0, self.face, weight)
        return torch.cat([normal, (offset / area)[:, None]], 1)

    def rectangles(self) -> tuple[Tensor, Tensor, Tensor]:
        """For each face the centre [k 3], unit edges [k 2 3] and half sides [k 2] of a rectangle in
        its plane that holds it, one side along the face's longest edge: where to look for it."""
        return self._kept("rectangles", self._about_faces)

    @torch.no_grad()
    def _about_faces(self) -> tuple[Tensor, Tensor, Tensor]:
        planes = self.planes()
        normal = planes[:, :3]
        start, along = self.vertices[self.ends].unbind(1)
        along = along - start
        pair = self.face[self.sides]
        owner = pair.reshape(-1)
        # the outline of a face: not the seams of its triangles
        length = torch.where(pair[:, 0] != pair[:, 1], along.norm(dim=-1), -1.0)
        length = length.repeat_interleave(2)
        most = length.new_full((self._faces,), -torch.inf).scatter_reduce(0, owner, length, "amax")
        number = torch.where(length == most[owner], torch.arange(len(owner)).to(owner), len(owner))
        longest = torch.full_like(owner[: self._faces], len(owner))
        longest = longest.scatter_reduce(0, owner, number, "amin")
        first = along[torch.div(longest, 2, rounding_mode="floor")]
        first = first - (first * normal).sum(-1, keepdim=True) * normal
        first = first / first.norm(dim=-1, keepdim=True)
        edges = torch.stack([first, torch.linalg.cross(normal, first)], 1)
        corner = self.vertices[self.triangles]  # [t 3 3]
        uv = torch.einsum("tcj,tij->tci", corner, edges[self.face])
        inf = torch.full((self._faces, 2), torch.inf, dtype=uv.dtype, device=uv.device)
        owner = self.face[:, None].expand(-1, 2)
        low = inf.scatter_reduce(0, owner, uv.amin(1), "amin")
        high = (-inf).scatter_reduce(0, owner, uv.amax(1), "amax")
        middle = 0.5 * (low + high)
        centre = planes[:, 3:] * normal + torch.einsum("ki,kij->kj", middle, edges)
        return centre, edges, 0.5 * (high - low)

    # distances

    def sdf(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance [m]."""
        return self.value_and_gradient(point)[0]

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient [1]."""
        flat = point.reshape(-1, 3)
        value, gradient, _ = self._distance(self._nearest(flat), flat)
        return value.reshape(point.shape[:-1]), gradient.reshape(point.shape)

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        flat = point.reshape(-1, 3)
        near = self._nearest(flat)
        value, gradient, away = self._distance(near, flat)
        round_it = near.across - gradient[:, :, None] * gradient[:, None, :]
        off = (near.face < 0) & (away > 0)
        signed = torch.where(off, torch.where(value < 0, -away, away), torch.ones_like(away))
        bend = torch.where(off[:, None, None], round_it / signed[:, None, None], 0.0)
        shape = point.shape
        return Jet(value.reshape(shape[:-1]), gradient.reshape(shape), bend.reshape(*shape, 3))

    @staticmethod
    def _distance(near: Nearest, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Signed distance, its gradient, and the distance without a sign beside edges."""
        offset = torch.einsum("mij,mj->mi", near.across, point - near.anchor)
        height = (offset * near.outward).sum(-1)
        square = (offset * offset).sum(-1)
        apart = (near.face < 0) & (square > 0)
        away = torch.where(apart, torch.where(apart, square, torch.ones_like(square)).sqrt(), 0.0)
        sign = torch.where(height < 0, -1.0, 1.0).to(point)
        slope = sign[:, None] * offset / torch.where(apart, away, torch.ones_like(away))[:, None]
        value = torch.where(near.face >= 0, height, sign * away)
        return value, torch.where(apart[:, None], slope, near.outward), away

    def normal_at(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Normal of the face that a surface point belongs to, also on edges."""
        return self.planes().to(point)[self.patch(point), :3]

    @torch.no_grad()
    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        flat = point.reshape(-1, 3)
        if self.convex:
            return self._heights(flat).argmax(-1).reshape(point.shape[:-1])
        feature, _ = self._search(flat)
        t, planes = len(self.triangles), self.planes().to(flat)
        edge = (feature - t).clamp(min=0)
        pair = self.face[self.sides[edge]]
        height = torch.einsum("mij,mj->mi", planes[pair, :3], flat) - planes[pair, 3]
        beside = pair.gather(1, height.argmax(1, keepdim=True)).squeeze(1)
        own = self.face[feature.clamp(max=t - 1)]
        return torch.where(feature < t, own, beside).reshape(point.shape[:-1])

    # lines

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Where a line is below all planes; of a convex mesh only."""
        if not self.convex:
            raise NotImplementedError("a mesh with hollows is met in several stretches")
        slope = direction @ self.planes()[:, :3].T.to(direction)
        height = -self._heights(origin)
        level = slope.abs() < torch.finfo(slope.dtype).tiny ** 0.25
        t = height / torch.where(level, torch.ones_like(slope), slope)
        inf = torch.full_like(t, torch.inf)
        never = level & (height <= 0)
        enter = torch.where(~level & (slope < 0), t, torch.where(never, inf, -inf)).amax(-1)
        leave = torch.where(~level & (slope > 0), t, torch.where(never, -inf, inf)).amin(-1)
        hit = enter < leave
        far = torch.full_like(enter, torch.inf)
        return torch.where(hit, enter, far), torch.where(hit, leave, -far)

    @torch.no_grad()
    def stretches(
        self,
        origin: Float[Tensor, "m 3"],
        direction: Float[Tensor, "m 3"],
        length: Float[Tensor, "m"],
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"], Float[Tensor, "k"]]:
        """(row, enter, leave) where f < 0 along origin + t direction, 0 <= t <= length [m].

        Every triangle's crossing is a place where something may change; what lies between two of
        them is inside or not as its middle is. So no crossing counts twice, or is lost, at an edge.
        """
        parts = []
        step = max(1, CHUNK // len(self.triangles))
        for i in torch.arange(len(length), device=length.device).split(step):
            row, *ends = self._some_stretches(origin[i].double(), direction[i].double(), length[i])
            parts.append((i[row], *ends))
        if not parts:
            none = length.new_zeros(0, dtype=torch.float64)
            return none.long(), none, none
        row, enter, leave = (torch.cat(column) for column in zip(*parts, strict=True))
        return row, enter, leave

    def _some_stretches(
        self, origin: Tensor, direction: Tensor, length: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        length = length.double()[:, None]
        t = self._crossings(origin, direction, length)
        t = torch.cat([torch.zeros_like(length), t, length], 1)
        same = torch.zeros_like(t, dtype=torch.bool)
        same[:, 1:-1] = (t[:, 1:-1] - t[:, :-2] < BRIEF) | (length - t[:, 1:-1] < BRIEF)
        t = torch.where(same, length, t).sort(1).values
        before, after = t[:, :-1], t[:, 1:]
        inside = after > before
        row, k = torch.nonzero(inside, as_tuple=True)
        middle = origin[row] + (0.5 * (before + after))[row, k, None] * direction[row]
        inside[row, k] = self.sdf(middle) < -SHALLOW
        none = torch.zeros_like(inside[:, :1])
        begins = inside & ~torch.cat([none, inside[:, :-1]], 1)
        ends = inside & ~torch.cat([inside[:, 1:], none], 1)
        row, first = torch.nonzero(begins, as_tuple=True)
        return row, before[row, first], after[ends]

    def _crossings(self, origin: Tensor, direction: Tensor, length: Tensor) -> Tensor:
        """Distances at which lines cross triangles, in order; the length where there are no more."""
        planes, (a, u, v) = self.planes()[self.face], self._frames()
        slope = direction @ planes[:, :3].T
        level = slope.abs() < 1e-12
        t = (planes[:, 3] - origin @ planes[:, :3].T) / torch.where(level, 1.0, slope)
        # (o + t d - a) . u, without a point for every pair
        along = [origin @ w.T + t * (direction @ w.T) - (a * w).sum(-1) for w in (u, v)]
        on = torch.minimum(torch.minimum(*along), 1.0 - along[0] - along[1]) >= -1e-9
        t = torch.where(on & ~level & (t > 0), t, torch.inf)
        most = int(torch.isfinite(t).sum(1).max()) if len(t) else 0
        if not most:
            return length[:, :0]
        return torch.minimum(t.topk(most, dim=1, largest=False, sorted=True).values, length)

    # what is nearest

    def _nearest(self, point: Tensor) -> Nearest:
        """The nearest feature of each point, differentiable in the vertices."""
        feature, share = self._search(point)
        t = len(self.triangles)
        planes, vertices = self.planes(), self.vertices
        face = torch.where(feature < t, self.face[feature.clamp(max=t - 1)], -1)
        edge = (feature - t).clamp(min=0)
        end = self.ends[edge]
        start, stop = vertices[end].unbind(1)
        along = stop - start
        along = along / along.norm(dim=-1, keepdim=True)
        at_end = (share <= 0) | (share >= 1)
        normal = planes[face.clamp(min=0), :3]
        eye = torch.eye(3, dtype=vertices.dtype, device=vertices.device).expand(len(point), 3, 3)
        beside = eye - along[:, :, None] * along[:, None, :]
        across = torch.where(at_end[:, None, None], eye, beside)
        across = torch.where(
            (face >= 0)[:, None, None], normal[:, :, None] * normal[:, None, :], across
        )
        anchor = torch.where((share >= 1)[:, None], stop, start)
        anchor = torch.where((face >= 0)[:, None], planes[face.clamp(min=0), 3:] * normal, anchor)
        corner = torch.where(share >= 1, end[:, 1], end[:, 0])
        with torch.no_grad():
            of_edge = planes[self.face[self.sides[edge]], :3].sum(1)
            pseudo = torch.where(at_end[:, None], self._corner_normals(planes)[corner], of_edge)
            pseudo = pseudo / pseudo.norm(dim=-1, keepdim=True).clamp(min=1e-300)
        outward = torch.where((face >= 0)[:, None], normal, pseudo)
        return Nearest(face, anchor.to(point), across.to(point), outward.to(point))

    def _corner_normals(self, planes: Tensor) -> Float[Tensor, "v 3"]:
        """Sums of faces' normals, weighted by their angle at each vertex."""
        corner = self.vertices[self.triangles]
        total = torch.zeros_like(self.vertices)
        for k in range(3):
            a, b = (corner[:, (k + j) % 3] - corner[:, k] for j in (1, 2))
            angle = torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))
            total.index_add_(0, self.triangles[:, k], angle[:, None] * planes[self.face, :3])
        return total

    def _heights(self, point: Tensor) -> Float[Tensor, "m k"]:
        """How far points stand above the plane of each face [m]."""
        planes = self.planes().to(point)
        return point @ planes[:, :3].T - planes[:, 3]

    @torch.no_grad()
    def _search(self, point: Tensor) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
        """``_look_over``, less what needs no look: inside a convex mesh the highest plane is nearest."""
        if not self.convex:
            return self._look_over(point)
        height, face = self._heights(point).max(-1)
        feature, share = self._triangle_of_face[face], torch.zeros_like(height)
        i = torch.nonzero(height > 0).squeeze(-1)
        feature[i], share[i] = self._look_over(point[i])
        return feature, share

    def _look_over(self, point: Tensor) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
        """Number of the nearest triangle, or t + that of the nearest edge; and where along the edge,
        0 to 1."""
        count = len(self.triangles) + len(self.ends)
        planes, frames = self.planes()[self.face].to(point), self._frames()
        start, stop = self.vertices[self.ends].unbind(1)
        parts = []
        for some in point.detach().split(max(1, CHUNK // count)):
            above = self._above(some, planes, frames)
            away, share = beside_segments(some, start.to(some), (stop - start).to(some))
            feature = torch.cat([above, away], 1).argmin(1)
            edge = (feature - above.shape[1]).clamp(min=0)
            parts.append((feature, share.gather(1, edge[:, None]).squeeze(1)))
        if not parts:
            return torch.zeros(0, dtype=torch.int64, device=point.device), point[:, 0].detach()
        feature, share = (torch.cat(column) for column in zip(*parts, strict=True))
        return feature, share

    @staticmethod
    def _above(point: Tensor, planes: Tensor, frames: tuple[Tensor, ...]) -> Float[Tensor, "m t"]:
        """Square of the distance to triangles that points stand above or below; else inf."""
        a, u, v = (x.to(point) for x in frames)
        away = point[:, None] - a
        first, second = (away * u).sum(-1), (away * v).sum(-1)
        within = torch.minimum(torch.minimum(first, second), 1.0 - first - second) >= -INSIDE
        height = point @ planes[:, :3].T - planes[:, 3]
        return torch.where(within, height * height, torch.inf)

    def _frames(self) -> tuple[Tensor, Tensor, Tensor]:
        """First corner of every triangle, and two vectors that give a point's shares of its sides."""
        return self._kept("frames", self._made_frames)

    def _made_frames(self) -> tuple[Tensor, Tensor, Tensor]:
        a, b, c = self.vertices[self.triangles].unbind(1)
        first, second = b - a, c - a
        aa, ab, bb = (
            (x * y).sum(-1) for x, y in ((first, first), (first, second), (second, second))
        )
        det = (aa * bb - ab * ab)[:, None]
        u = (bb[:, None] * first - ab[:, None] * second) / det
        v = (aa[:, None] * second - ab[:, None] * first) / det
        return a, u, v

    @property
    def _faces(self) -> int:
        return self._kept("faces", lambda: int(self.face.max()) + 1)

    @torch.no_grad()
    def _is_convex(self) -> bool:
        """No vertex above any face, and one piece."""
        size = float((self.bounds()[1] - self.bounds()[0]).norm())
        step = max(1, CHUNK // self._faces)
        return all(
            float(self._heights(some).max()) <= 2.0 * LEVEL * size
            for some in self.vertices.split(step)
        )


def extruded(outline: Sequence[tuple[float, float]], half_height: float) -> Mesh:
    """The prism over a simple polygon of (x, y), in either sense, for |z| <= half_height [m].

    Raises ValueError for an outline of fewer than three corners, and as ``Mesh`` does.
    """
    return Mesh(*prism_of(outline, -half_height, half_height))


def prism_of(
    outline: Sequence[tuple[float, float]], low: float, high: float
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Vertices and triangles of the prism over a simple polygon for low <= z <= high [m].

    Raises ValueError for an outline of fewer than three corners."""
    n = len(outline)
    if n < 3:
        raise ValueError(f"an outline of {n} corners: expected 3 or more")
    ring = np.array([[x, y, z] for z in (low, high) for x, y in outline], dtype=np.float64)
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    faces = [list(range(n))[::-1], list(range(n, 2 * n)), *sides]
    count, index = np.array([len(f) for f in faces]), np.concatenate(faces)
    return ring, triangles_of(ring, count, index)


def beside_segments(point: Tensor, start: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Square of the distance to segments, and where along them, 0 to 1."""
    away = point[:, None] - start
    share = ((away * along).sum(-1) / (along * along).sum(-1)).clamp(0.0, 1.0)
    off = away - share[..., None] * along
    return (off * off).sum(-1), share
