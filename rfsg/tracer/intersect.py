"""Where rays first meet a learned shape, in one of four named ways.

certain: Embree on the shell says who misses for sure, Embree on the zero mesh where the others hit,
    nearly; the network is asked there, and one step on the root follows. The root is the first one
    when f falls to it from the shell's value as straight as its slope there says: something else in
    between would bend it. The few rays that fail a check are marched to a sign change.
newton: the zero mesh and the same step, unchecked: what the mesh misses is missed.
mesh: the zero mesh alone.  grid: a march on the baked values alone.
Each but ``certain`` is as wrong as ``benchmarks/intersect.py`` finds it to be.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import Baked, Surface
from rfsg.tracer.banded import bracketed, polished
from rfsg.tracer.plan import INTERSECTIONS
from rfsg.tracer.triangles import Triangles

Answer = tuple["Hits", tuple[Tensor, ...]]
WAYS = INTERSECTIONS
CHUNK = 65_536  # rays at a time: a few MB of state, and a share of a thread's work
LEAST_LATE = 2_048  # rays of a thread's share of the march: fewer cost more in calls than in work
FLOOR = 5e-4  # [m] least step of the march of rays that fail a check
TOLERANCE = 5e-5  # [m]
SHORT_STEP = 1e-3  # [m] longest step from the mesh to the root
BEHIND = 2e-5  # [m] behind a hit of the mesh the next is looked for
LOOK_AGAIN = 1e-5  # [m] a longer step is checked by asking the network a second time
RESIDUAL = 2e-6  # [m] a root: four times the network's rounding in float32
STEEP = 0.15  # least |df/dt| of a root that is not grazing
STRAIGHT = (
    0.3  # share by which the fall of f from entry to hit may differ from its slope at the hit
)
THREADED = 16_384  # rays from which two threads of Embree pay


@dataclass(frozen=True)
class Hits:
    """First roots of f: ``ray`` is a row of what was asked, t along it [m], outward unit normals (those
    of the zero mesh, interpolated, unless asked of the network)."""

    ray: Int[Tensor, "k"]
    t: Float[Tensor, "k"]
    normal: Float[Tensor, "k 3"]


@dataclass(frozen=True)
class Met:
    """Embree's answer: triangle (-1 where none), t [m], weights of corners 1 and 2, and whether the
    triangle is seen from behind."""

    triangle: Int[Tensor, "m"]
    t: Float[Tensor, "m"]
    u: Float[Tensor, "m"]
    v: Float[Tensor, "m"]
    behind: Bool[Tensor, "m"]


class Traced(Triangles):
    """A triangle mesh that Embree traces, and where on its triangles it was met."""

    def __init__(self, surface: Surface):
        super().__init__(surface.vertices[surface.triangles.long()])

    def met(self, origin: Float[Tensor, "m 3"], direction: Float[Tensor, "m 3"]) -> Met:
        """The first triangle on each ray from t = 0."""
        o, d = (x.contiguous().numpy() for x in (origin - self.middle, direction))
        threads = min(torch.get_num_threads(), 1 + len(o) // THREADED)
        if threads > 1:
            parts = zip(np.array_split(o, threads), np.array_split(d, threads), strict=True)
            with ThreadPoolExecutor(threads) as pool:  # embreex lets go of the interpreter's lock
                found = list(pool.map(lambda part: self.shot(*part), parts))
            out = {key: np.concatenate([f[key] for f in found]) for key in found[0]}
        else:
            out = self.shot(o, d)
        facing = (torch.from_numpy(out["Ng"]) * direction).sum(-1)
        triangle = torch.from_numpy(out["primID"].astype(np.int32))
        t, u, v = (torch.from_numpy(out[key]) for key in ("tfar", "u", "v"))
        return Met(triangle, t, u, v, facing > 0)


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

        def one(begin: int) -> Answer:
            piece = slice(begin, begin + CHUNK)
            o, d, end = origin[piece].float(), direction[piece].float(), length[piece].float()
            hits, (ray, *rest) = work(o, d, end)
            return Hits(hits.ray + begin, hits.t, hits.normal), (ray + begin, *rest)

        answers = in_threads(one, range(0, len(length), CHUNK))
        if not answers:
            none = origin.new_zeros(0)
            return Hits(none.long(), none, origin.new_zeros(0, 3))
        # rays that need a march go together: each of its steps costs some calls
        late = [torch.cat(column) for column in zip(*(rest for _, rest in answers), strict=True)]
        shares = max(min(torch.get_num_threads(), len(late[0]) // LEAST_LATE), 1)
        split = zip(*(torch.tensor_split(column, shares) for column in late), strict=True)
        parts = [hits for hits, _ in answers]
        parts += in_threads(lambda share: self._marched(*share), list(split))
        return Hits(*(torch.cat([getattr(h, n) for h in parts]) for n in ("ray", "t", "normal")))

    # the ways

    # each answers with hits, and with the rays (ray, start, direction, entry, left) left to march

    def _mesh(self, o: Tensor, d: Tensor, end: Tensor) -> Answer:
        met = self.zero.met(o, d)
        i = torch.nonzero((met.triangle >= 0) & (met.t <= end)).squeeze(-1)
        return Hits(i, met.t[i], F.normalize(self.gradient(met, i), dim=-1)), _none(o)

    def _newton(self, o: Tensor, d: Tensor, end: Tensor) -> Answer:
        met = self.zero.met(o, d)
        i = torch.nonzero((met.triangle >= 0) & (met.t <= end)).squeeze(-1)
        gradient = self.gradient(met, i)
        t = self.stepped(o[i], d[i], met.t[i], gradient)
        return Hits(i, t, self._normals(o[i], d[i], t, gradient)), _none(o)

    def _grid(self, o: Tensor, d: Tensor, end: Tensor) -> Answer:
        ray, start, direction, entry, left = self._in_shell(o, d, end)
        found = bracketed(self.shape, self.trusting, start, direction, left, FLOOR, 1)
        share = found.fa / (found.fa - found.fb)
        row, t = found.row, torch.lerp(found.a, found.b, share)
        point = torch.addcmul(start[row], t[:, None], direction[row])
        return Hits(ray[row], t + entry[row], self._grid_normals(point)), _none(o)

    def _certain(self, o: Tensor, d: Tensor, end: Tensor) -> Answer:
        ray, start, direction, entry, left = self._in_shell(o, d, end)
        met = self.zero.met(start, direction)
        hit = torch.nonzero((met.triangle >= 0) & (met.t <= left)).squeeze(-1)
        p0, along, gradient = start[hit], direction[hit], self.gradient(met, hit)
        t, sure = self._checked(p0, along, met.t[hit], gradient)
        rest = torch.ones_like(ray, dtype=torch.bool)
        rest[hit[sure]] = False
        rest = torch.nonzero(rest).squeeze(-1)
        t, kept = t[sure], hit[sure]
        normal = self._normals(p0[sure], along[sure], t, gradient[sure])
        left_over = tuple(x[rest] for x in (ray, start, direction, entry, left))
        return Hits(ray[kept], t + entry[kept], normal), left_over

    # their parts

    def stepped(self, o: Tensor, d: Tensor, t: Tensor, gradient: Tensor) -> Float[Tensor, "k"]:
        """Hits of the mesh after one step to the root, no longer than ``SHORT_STEP``."""
        value, slope = self._value(torch.addcmul(o, t[:, None], d)), _dot(gradient, d)
        steep = torch.where(slope.abs() < STEEP, torch.where(slope < 0, -STEEP, STEEP), slope)
        return t - (value / steep).clamp_(-SHORT_STEP, SHORT_STEP)

    def _in_shell(self, o: Tensor, d: Tensor, end: Tensor) -> tuple[Tensor, ...]:
        """(ray, start, direction, entry, left): rays from where they enter the shell, or begin in it,
        and how far they go on in the bounds."""
        met = self.shell.met(o, d)
        near = (met.triangle >= 0) & (met.behind | (met.t < end))
        ray = torch.nonzero(near).squeeze(-1)
        o, d, end, behind = o[ray], d[ray], end[ray], met.behind[ray]
        entry = torch.where(behind, 0.0, met.t[ray])
        safe = torch.where(d == 0, 1e-30, d)
        one, other = (self.low - o) / safe, (self.high - o) / safe
        near, far = torch.minimum(one, other), torch.maximum(one, other)
        entry = torch.maximum(entry, _most(near))
        left = torch.minimum(end, -_most(-far)) - entry
        keep = torch.nonzero(left > 0).squeeze(-1)
        ray, entry, left, d = ray[keep], entry[keep], left[keep], d[keep]
        return ray, torch.addcmul(o[keep], entry[:, None], d), d, entry, left

    def _checked(
        self, p0: Tensor, d: Tensor, t: Tensor, gradient: Tensor
    ) -> tuple[Tensor, Bool[Tensor, "k"]]:
        """Roots near the mesh's hits, and which of them are surely the first."""
        value, slope = self._value(torch.addcmul(p0, t[:, None], d)), _dot(gradient, d)
        before, doubt = self.baked.look(p0)
        sure = (before + slope * t).abs() <= STRAIGHT * (slope * t).abs() + doubt
        sure &= (slope.abs() >= STEEP) & (before * slope < 0)
        step = -value / torch.where(sure, slope, 1.0)
        sure &= step.abs() <= SHORT_STEP
        root = t + step
        again = torch.nonzero(sure & (step.abs() > LOOK_AGAIN)).squeeze(-1)
        if len(again):
            root[again], sure[again] = self._secant(
                *(x[again] for x in (p0, d, t, root, value, slope))
            )
        return root, sure

    def _secant(
        self, p0: Tensor, d: Tensor, t: Tensor, root: Tensor, value: Tensor, slope: Tensor
    ) -> tuple[Tensor, Tensor]:
        after = self._value(torch.addcmul(p0, root[:, None], d))
        secant = (after - value) / (root - t)
        alike = (secant / slope - 1.0).abs() <= STRAIGHT
        small = (after.abs() <= STRAIGHT * value.abs()) | (after.abs() <= RESIDUAL)
        steep = torch.where(alike, secant, slope)
        return root - after / steep, alike & small

    def _value(self, point: Tensor) -> Float[Tensor, "k"]:
        """f, to the tolerance: baked where that is as good, else the network's."""
        value, doubt = self.baked.look(point)
        far = torch.nonzero(doubt > self.tolerance).squeeze(-1)
        if len(far):
            value[far] = self.shape.sdf(point[far])
        return value

    def _marched(self, ray: Tensor, start: Tensor, d: Tensor, entry: Tensor, left: Tensor) -> Hits:
        found = bracketed(self.shape, self.baked, start, d, left, FLOOR, 1)
        row = found.row
        t = polished(self.shape, start[row], d[row], found, 12, RESIDUAL)
        gradient = self.shape.value_and_gradient(torch.addcmul(start[row], t[:, None], d[row]))[1]
        return Hits(ray[row], t + entry[row], F.normalize(gradient, dim=-1))

    def gradient(self, met: Met, i: Tensor) -> Float[Tensor, "k 3"]:
        """Of f at hits of the zero mesh, interpolated between its corners."""
        corner = self.baked.zero.triangles[met.triangle[i]]
        table, u, v = self.baked.gradient, met.u[i, None], met.v[i, None]
        first = table[corner[:, 0]]
        return (
            first.mul(1.0 - u - v).addcmul_(table[corner[:, 1]], u).addcmul_(table[corner[:, 2]], v)
        )

    def _normals(self, o: Tensor, d: Tensor, t: Tensor, gradient: Tensor) -> Tensor:
        if self.network_normals:
            gradient = self.shape.value_and_gradient(torch.addcmul(o, t[:, None], d))[1]
        return F.normalize(gradient, dim=-1)

    def _grid_normals(self, point: Tensor) -> Tensor:
        h = 0.5 * self.baked.step
        sides = [h * e for e in torch.eye(3)]
        slopes = [self.baked.look(point + e)[0] - self.baked.look(point - e)[0] for e in sides]
        return F.normalize(torch.stack(slopes, -1), dim=-1)


def in_threads(work: Callable[[Any], Any], pieces: Sequence[Any]) -> list[Any]:
    """What ``work`` makes of each piece, several at a time, each with one thread of torch: its threads
    meet after each operation, which costs more than operations on a few thousand rays."""
    threads = torch.get_num_threads()
    if min(threads, len(pieces)) < 2:
        return [work(piece) for piece in pieces]
    torch.set_num_threads(1)  # of this thread, and of those begun from now on
    try:
        with ThreadPoolExecutor(min(threads, len(pieces))) as pool:
            return list(pool.map(torch.no_grad()(work), pieces))
    finally:
        torch.set_num_threads(threads)


def _none(o: Tensor) -> tuple[Tensor, ...]:
    scalar, vector = o.new_zeros(0), o.new_zeros(0, 3)
    return scalar.long(), vector, vector, scalar, scalar


def _dot(a: Tensor, b: Tensor) -> Tensor:
    (x, y, z), (u, v, w) = a.unbind(-1), b.unbind(-1)
    return (x * u).addcmul_(y, v).addcmul_(z, w)


def _most(a: Tensor) -> Tensor:
    x, y, z = a.unbind(-1)
    return torch.maximum(torch.maximum(x, y), z)


# all crossings, for the march


@dataclass(frozen=True)
class Roots:
    """Roots of f on rays: t [m] of row ``row``, its ``slot``-th; ``count`` of each ray, and whether it
    begins ``inside``."""

    row: Int[Tensor, "k"]
    slot: Int[Tensor, "k"]
    t: Float[Tensor, "k"]
    count: Int[Tensor, "m"]
    inside: Bool[Tensor, "m"]


@torch.no_grad()
def baked_roots(
    shape: Shape,
    baked: Baked,
    start: Float[Tensor, "m 3"],
    direction: Float[Tensor, "m 3"],
    end: Float[Tensor, "m"],
    way: str,
    floor: float,
    most: int,
    rounds: int,
) -> Roots:
    """The first ``most`` roots on each ray within [0, end] and the bounds, in the rays' precision.

    certain: marched on the baked values and by the network next to the surface, roots by ``rounds``
    rounds of the Illinois method. The other ways as in the module. Raises ValueError for no known way.
    """
    if way not in WAYS:
        raise ValueError(f"intersection {way!r}: expected one of {', '.join(WAYS)}")
    if way in ("mesh", "newton"):
        return _peeled(intersector(shape, baked), start, direction, end, way == "newton", most)
    used = baked if way == "certain" else replace(baked, error=torch.zeros_like(baked.error))
    found = bracketed(shape, used, start, direction, end, floor, most)
    row = found.row
    if way == "certain":
        tolerance = 256 * torch.finfo(start.dtype).eps  # a network's own rounding
        t = polished(shape, start[row], direction[row], found, rounds, tolerance)
    else:
        t = torch.lerp(found.a, found.b, found.fa / (found.fa - found.fb)).to(start.dtype)
    return Roots(row, found.slot, t, found.count, found.inside)


def _peeled(
    traced: "Intersector", start: Tensor, direction: Tensor, end: Tensor, step: bool, most: int
) -> Roots:
    """Hits of the zero mesh one after the other, each search beginning behind the last."""
    o, d, last = start.float(), direction.float(), end.float()
    count = torch.zeros(len(end), dtype=torch.int64)
    inside = torch.zeros(len(end), dtype=torch.bool)
    done, active = torch.zeros_like(last), torch.arange(len(end))
    parts = [(active[:0], count[:0], start.new_zeros(0))]
    for k in range(most):
        begin = torch.addcmul(o[active], done[active, None], d[active])
        met = traced.zero.met(begin, d[active])
        if k == 0:
            inside = (met.triangle >= 0) & met.behind
        i = torch.nonzero((met.triangle >= 0) & (done[active] + met.t <= last[active])).squeeze(-1)
        if not len(i):
            break
        row = active[i]
        t = met.t[i]
        done[row], count[row] = done[row] + t + BEHIND, count[row] + 1
        if step:
            t = traced.stepped(begin[i], d[row], t, traced.gradient(met, i))
        t = (done[row] - BEHIND - met.t[i] + t).clamp(min=0.0)
        parts.append((row, torch.full_like(row, k), torch.minimum(t, last[row]).to(start.dtype)))
        active = row
    row, slot, t = (torch.cat(column) for column in zip(*parts, strict=True))
    return Roots(row, slot, t, count, inside)


_BUILT: dict[str, tuple[Shape, "Intersector"]] = {}
MOST_BUILT = 16


def intersector(shape: Shape, baked: Baked) -> "Intersector":
    """The shape's ``Intersector``, kept by key: building Embree's trees takes a second."""
    kept = _BUILT.get(baked.key)
    if kept is None or kept[0] is not shape:
        if len(_BUILT) >= MOST_BUILT:
            _BUILT.clear()
        kept = _BUILT[baked.key] = (shape, Intersector(shape, baked))
    return kept[1]
