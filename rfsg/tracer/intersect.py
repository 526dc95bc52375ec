"""Where rays first meet a learned shape, in one of four named ways.

certain: Embree on the shell says who misses for sure, and where the others come near; Embree on the
    zero mesh where they hit, nearly; the network is asked there, and one step on the root follows. The
    root is the first one when f cannot have turned since the shell (Taylor's theorem, with ``turn`` for
    the bound of the second derivative), or when it has fallen since as straight as its slope at the
    root says. The few rays that fail both are marched to a sign change, to where they leave the shell;
    what comes out of it begins anew.
newton: the zero mesh and the same step, unchecked: what the mesh misses is missed.
mesh: the zero mesh alone.  grid: a march on the baked values alone.
How wrong each is of a shape comes with the baked shape (``offs``), how wrong of rays
``benchmarks/intersect.py`` finds.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import LEAST_TURN, WAYS, Baked
from rfsg.objects.shapes.offs import RESIDUAL, SHORT_STEP, STEEP, TOLERANCE, step_to_root
from rfsg.tracer.banded import bracketed, polished
from rfsg.tracer.traced import Met, Traced, in_threads

CHUNK = 65_536  # rays at a time: a few MB of state, and a share of a thread's work
LEAST_LATE = 2_048  # rays of a thread's share of the march: fewer cost more in calls than in work
FLOOR = 5e-4  # [m] least step of the march of rays that fail a check
BEHIND = 2e-5  # [m] behind a hit of a mesh the next is looked for
LOOK_AGAIN = 1e-5  # [m] a longer step is checked by asking the network a second time
ASLANT = 0.25  # share of ``turn`` that a slope interpolated on the mesh may be wrong by
STRAIGHT = 0.3  # share by which the fall of f since the shell may differ from its slope at the hit
FEW_AHEAD = 8  # steps looked ahead at once in later passes, of few rays
AGAIN = 6  # passes through the shell after the first, before a ray is marched to its end


@dataclass(frozen=True)
class Hits:
    """First roots of f: ``ray`` is a row of what was asked, t along it [m], outward unit normals (those
    of the zero mesh, interpolated, unless asked of the network)."""

    ray: Int[Tensor, "k"]
    t: Float[Tensor, "k"]
    normal: Float[Tensor, "k 3"]


class Rest(NamedTuple):
    """What is left of rays: row, where they go on, which way, how far along that is, and how far they
    may go from there [m]."""

    ray: Int[Tensor, "m"]
    start: Float[Tensor, "m 3"]
    direction: Float[Tensor, "m 3"]
    gone: Float[Tensor, "m"]
    left: Float[Tensor, "m"]

    def take(self, i: Int[Tensor, "k"]) -> "Rest":
        return Rest(*(x.index_select(0, i) for x in self))

    def after(self, t: Float[Tensor, "m"]) -> "Rest":
        """From t [m] further on; those that have nothing left are left out."""
        left = self.left - t
        start = torch.addcmul(self.start, t[:, None], self.direction)
        moved = Rest(self.ray, start, self.direction, self.gone + t, left)
        return moved.take(torch.nonzero(left > 0).squeeze(-1))

    def split(self, pieces: int) -> list["Rest"]:
        columns = (torch.tensor_split(x, pieces) for x in self)
        return [Rest(*column) for column in zip(*columns, strict=True)]


Answer = tuple[Hits, Rest]


class Intersector:
    """A baked shape ready for rays.

    tolerance: how exactly f must be known at a hit [m]; where the baked values are as good they
    stand for the network. network_normals: ask it for normals too.
    """

    def __init__(
        self,
        shape: Shape,
        baked: Baked,
        tolerance: float = TOLERANCE,
        network_normals: bool = False,
    ):
        self.shape, self.baked = shape, baked
        self.tolerance, self.network_normals = tolerance, network_normals
        self.zero, self.shell = Traced(baked.zero), Traced(baked.shell)
        self.trusting = replace(baked, error=torch.zeros_like(baked.error))
        self.low, self.high = shape.bounds().float().cpu()

    @torch.no_grad()
    def first_hits(
        self,
        origin: Float[Tensor, "m 3"],
        direction: Float[Tensor, "m 3"],
        length: Float[Tensor, "m"],
        way: str = "certain",
    ) -> Hits:
        """The first root of f on each ray that has one within [0, length] and the shape's bounds.

        All in the object's frame; directions are unit vectors. Works in float32: t is as good as that
        over its own length. Raises ValueError for a way that is none of ``WAYS``.
        """
        if way not in WAYS:
            raise ValueError(f"intersection {way!r}: expected one of {', '.join(WAYS)}")
        work = getattr(self, "_" + way)
        o, d, end = origin.float(), direction.float(), length.float()
        rest = Rest(torch.arange(len(end)), o, d, torch.zeros_like(end), end)
        parts = [Hits(rest.ray[:0], end[:0], o[:0])]
        for march in (self._pass, *[self._next_pass] * AGAIN, self._to_the_end):
            rest = _gather(work, rest, math.ceil(len(rest.ray) / CHUNK), parts)
            if not len(rest.ray):
                break
            # rays that need a march go together: each of its steps costs some calls
            shares = min(torch.get_num_threads(), len(rest.ray) // LEAST_LATE)
            rest = _gather(march, rest, shares, parts)
        return Hits(*(torch.cat([getattr(h, n) for h in parts]) for n in ("ray", "t", "normal")))

    # the ways, each of which answers with hits and with what is left to march

    def _mesh(self, rays: Rest) -> Answer:
        met = self.zero.met(rays.start, rays.direction)
        i = torch.nonzero((met.triangle >= 0) & (met.t <= rays.left)).squeeze(-1)
        normal = F.normalize(self.gradient(met, i), dim=-1)
        return Hits(rays.ray[i], rays.gone[i] + met.t[i], normal), _none(rays)

    def _newton(self, rays: Rest) -> Answer:
        met = self.zero.met(rays.start, rays.direction)
        i = torch.nonzero((met.triangle >= 0) & (met.t <= rays.left)).squeeze(-1)
        gradient, hit = self.gradient(met, i), rays.take(i)
        t = self.stepped(hit.start, hit.direction, met.t[i], gradient)
        return self._hits(hit, t, gradient), _none(rays)

    def _grid(self, rays: Rest) -> Answer:
        near = self._in_shell(rays)
        args = (near.start, near.direction, near.left, FLOOR, 1)
        found = bracketed(self.shape, self.trusting, *args)
        t = torch.lerp(found.a, found.b, found.fa / (found.fa - found.fb))
        hit = near.take(found.row)
        normal = self._grid_normals(torch.addcmul(hit.start, t[:, None], hit.direction))
        return Hits(hit.ray, hit.gone + t, normal), _none(rays)

    def _certain(self, rays: Rest) -> Answer:
        near = self._in_shell(rays)
        met = self.zero.met(near.start, near.direction)
        i = torch.nonzero((met.triangle >= 0) & (met.t <= near.left)).squeeze(-1)
        hit, gradient = near.take(i), self.gradient(met, i)
        t, sure = self._checked(hit.start, hit.direction, met.t[i], gradient)
        late = torch.ones_like(near.ray, dtype=torch.bool)
        late[i[sure]] = False
        kept = torch.nonzero(sure).squeeze(-1)
        hits = self._hits(hit.take(kept), t[kept], gradient[kept])
        return hits, near.take(torch.nonzero(late).squeeze(-1))

    # their parts

    def stepped(self, o: Tensor, d: Tensor, t: Tensor, gradient: Tensor) -> Float[Tensor, "k"]:
        """Hits of the mesh after one step to the root."""
        point = torch.addcmul(o, t[:, None], d)
        value, doubt = self.baked.look(point)
        self._ask(point, value, doubt > self.tolerance)
        return t + step_to_root(value, _dot(gradient, d))

    def _in_shell(self, rays: Rest) -> Rest:
        """Rays from where they enter the shell, or begin in it, in the bounds."""
        met = self.shell.met(rays.start, rays.direction)
        near = (met.triangle >= 0) & (met.behind | (met.t < rays.left))
        i = torch.nonzero(near).squeeze(-1)
        rays, entry = rays.take(i), torch.where(met.behind[i], 0.0, met.t[i])
        safe = torch.where(rays.direction == 0, 1e-30, rays.direction)
        one, other = (self.low - rays.start) / safe, (self.high - rays.start) / safe
        entry = torch.maximum(entry, _most(torch.minimum(one, other)))
        left = torch.minimum(rays.left, -_most(-torch.maximum(one, other)))
        return rays._replace(left=left).after(entry)

    def _checked(
        self, p0: Tensor, d: Tensor, t: Tensor, gradient: Tensor
    ) -> tuple[Float[Tensor, "k"], Bool[Tensor, "k"]]:
        """Roots near the mesh's hits, and which of them are surely the first since the shell."""
        point, slope = torch.addcmul(p0, t[:, None], d), _dot(gradient, d)
        value, doubt, turn = self.baked.look_about(point)
        steep, far = slope.abs() >= STEEP, t * (1.0 / self.baked.step)
        # f falls all the way from the shell: its slope cannot have turned so much
        sure = (-slope >= turn * (far.clamp(min=LEAST_TURN) + ASLANT)) & (far <= 1.0)
        self._ask(point, value, (doubt > self.tolerance) | (sure & ~steep))
        open_ = torch.nonzero(steep & ~sure).squeeze(-1)
        sure[open_] = self._straight(p0[open_], (slope * t)[open_])
        step = -value / torch.where(sure, slope, 1.0)
        sure &= step.abs() <= SHORT_STEP
        root = t + step
        again = torch.nonzero(sure & (step.abs() > LOOK_AGAIN)).squeeze(-1)
        if len(again):
            root[again], sure[again] = self._secant(
                *(x[again] for x in (p0, d, t, root, value, slope))
            )
        return root, sure

    def _straight(self, p0: Tensor, fall: Tensor) -> Bool[Tensor, "k"]:
        """Whether f falls from the shell to the hit by what its slope there says: something in between
        would bend it."""
        before, doubt = self.baked.look(p0)
        allowed = STRAIGHT * fall.abs()
        ask = doubt > 0.5 * allowed
        self._ask(p0, before, ask)
        doubt = torch.where(ask, RESIDUAL, doubt)
        return (before * fall < 0) & ((before + fall).abs() + doubt <= allowed + self.tolerance)

    def _secant(
        self, p0: Tensor, d: Tensor, t: Tensor, root: Tensor, value: Tensor, slope: Tensor
    ) -> tuple[Tensor, Tensor]:
        point = torch.addcmul(p0, root[:, None], d)
        after, doubt = self.baked.look(point)
        self._ask(point, after, (doubt > self.tolerance) | (slope.abs() < STEEP))
        secant = (after - value) / (root - t)
        alike = (secant / slope - 1.0).abs() <= STRAIGHT
        small = (after.abs() <= STRAIGHT * value.abs()) | (after.abs() <= RESIDUAL)
        return root - after / torch.where(alike, secant, slope), alike & small

    def _ask(self, point: Tensor, value: Tensor, which: Bool[Tensor, "k"]) -> None:
        """Put the network's values in the place of baked ones."""
        i = torch.nonzero(which).squeeze(-1)
        if len(i):
            value[i] = self.shape.sdf(point[i])

    def _pass(self, rays: Rest, ahead: int = 1) -> Answer:
        """What rays meet before they leave the shell, and those that meet nothing from there on."""
        inner = torch.addcmul(rays.start, rays.direction, rays.left.new_tensor(BEHIND))
        met = self.shell.met(inner, rays.direction)
        way_out = torch.where(met.triangle >= 0, met.t + 2.0 * BEHIND, torch.inf)
        return self._marched(rays, torch.minimum(way_out, rays.left), ahead)

    def _next_pass(self, rays: Rest) -> Answer:
        return self._pass(rays, FEW_AHEAD)

    def _to_the_end(self, rays: Rest) -> Answer:
        return self._marched(rays, rays.left, FEW_AHEAD)

    def _marched(self, rays: Rest, end: Float[Tensor, "m"], ahead: int) -> Answer:
        found = bracketed(self.shape, self.baked, rays.start, rays.direction, end, FLOOR, 1, ahead)
        hit = rays.take(found.row)
        t = polished(self.shape, hit.start, hit.direction, found, 12, RESIDUAL)
        point = torch.addcmul(hit.start, t[:, None], hit.direction)
        normal = F.normalize(self.shape.value_and_gradient(point)[1], dim=-1)
        left = torch.nonzero(found.count == 0).squeeze(-1)
        return Hits(hit.ray, hit.gone + t, normal), rays.take(left).after(end[left])

    def gradient(self, met: Met, i: Tensor) -> Float[Tensor, "k 3"]:
        """Of f at hits of the zero mesh, interpolated between its corners."""
        corner = self.baked.zero.triangles[met.triangle[i]]
        table, u, v = self.baked.gradient, met.u[i, None], met.v[i, None]
        first = table[corner[:, 0]]
        return (
            first.mul(1.0 - u - v).addcmul_(table[corner[:, 1]], u).addcmul_(table[corner[:, 2]], v)
        )

    def _hits(self, rays: Rest, t: Tensor, gradient: Tensor) -> Hits:
        if self.network_normals:
            point = torch.addcmul(rays.start, t[:, None], rays.direction)
            gradient = self.shape.value_and_gradient(point)[1]
        return Hits(rays.ray, rays.gone + t, F.normalize(gradient, dim=-1))

    def _grid_normals(self, point: Tensor) -> Tensor:
        h = 0.5 * self.baked.step
        sides = [h * e for e in torch.eye(3)]
        slopes = [self.baked.look(point + e)[0] - self.baked.look(point - e)[0] for e in sides]
        return F.normalize(torch.stack(slopes, -1), dim=-1)


def _gather(work: Callable[[Rest], Answer], rays: Rest, pieces: int, parts: list[Hits]) -> Rest:
    """What is left after ``work`` on so many shares of rays; its hits join the others."""
    answers = in_threads(work, rays.split(max(pieces, 1)))
    parts += [hits for hits, _ in answers]
    return Rest(*(torch.cat(column) for column in zip(*(r for _, r in answers), strict=True)))


def _none(rays: Rest) -> Rest:
    return Rest(*(x[:0] for x in rays))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    (x, y, z), (u, v, w) = a.unbind(-1), b.unbind(-1)
    return (x * u).addcmul_(y, v).addcmul_(z, w)


def _most(a: Tensor) -> Tensor:
    x, y, z = a.unbind(-1)
    return torch.maximum(torch.maximum(x, y), z)
