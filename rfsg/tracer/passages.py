"""What the segments of exact paths go through, and where: differentiable in all that they lie on."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Crossing
from rfsg.scene.world import FLUSH, World, unit
from rfsg.tracer.apart import traced
from rfsg.tracer.embree import Proxies, brute_spans
from rfsg.tracer.implicit import segments
from rfsg.tracer.march import EVALUATE, TOUCH, crossings
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Crossings, Paths, Rays, Spans, runs_in

OWN_RIPPLE = 0.25  # [wavelengths] along the normal: a path that leaves a learned face may graze it


@dataclass(frozen=True)
class Runs:
    """Stretches of rays inside objects, as ``Crossings`` lists them, where solids of one medium that
    touch or overlap are one stretch: from a face of ``which`` to a face of ``last``."""

    ray: Int[Tensor, "m"]
    which: Int[Tensor, "m"]
    last: Int[Tensor, "m"]
    enter: Float[Tensor, "m"]
    leave: Float[Tensor, "m"]
    normal_enter: Float[Tensor, "m 3"]
    normal_leave: Float[Tensor, "m 3"]

    def take(self, i: Tensor) -> "Runs":
        return Runs(*(getattr(self, n)[i] for n in self.__dataclass_fields__))


@dataclass(frozen=True)
class Passages:
    """What the segments of paths go through: flat, sorted by path segment, then by distance.

    last: where a stretch ends, on ``which`` itself unless several solids of one medium are one
    stretch. crossed: (path, node, segment) of every object, those solids one by one.
    """

    path: Int[Tensor, "m"]
    segment: Int[Tensor, "m"]
    which: Int[Tensor, "m"]
    last: Int[Tensor, "m"]
    crossing: Crossing
    crossed: Int[Tensor, "x 3"]


def passages(
    world: World, proxies: Proxies, paths: Paths, wavelength: float, quality: Quality
) -> Passages:
    """Every crossing of every segment, less the grazing of a segment's own mirrors and the solids in
    which a refracted path runs.

    The search carries no gradient. The crossings found do: they move with the path, and their ends
    slide along it with the surfaces that they lie on.
    """
    with torch.no_grad():
        path, segment, runs, crossed = _found(world, proxies, paths, wavelength, quality)
    crossing = _placed(world, paths, path, segment, runs)
    return Passages(path, segment, runs.which, runs.last, crossing, crossed)


def _found(
    world: World, proxies: Proxies, paths: Paths, wavelength: float, quality: Quality
) -> tuple[Tensor, Tensor, Runs, Tensor]:
    length, u = segments(paths.vertices)
    path, segment = torch.nonzero(length > 0, as_tuple=True)
    rays = Rays(paths.vertices[path, segment], u[path, segment], length[path, segment])
    inside = every_crossing(world, proxies, rays, quality)
    keep = ~_own(world, paths, path, segment, rays, inside, wavelength)
    keep &= ~_medium(world, paths, path, segment, inside)
    inside = Crossings(*(getattr(inside, n)[keep] for n in Crossings.__dataclass_fields__))
    ray = inside.ray
    crossed = torch.stack([path[ray], inside.which, segment[ray]], -1)
    runs = merged(world, inside)
    return path[runs.ray], segment[runs.ray], runs, crossed


def every_crossing(
    world: World,
    proxies: Proxies,
    rays: Rays,
    quality: Quality,
    only: Bool[Tensor, "n"] | None = None,
) -> Crossings:
    """All crossings of rays, a chunk of rays at a time; only: of these nodes."""
    parts = []
    for i in torch.arange(len(rays.limit), device=world.device).split(quality.chunk):
        row, nodes = traced(world, rays.take(i))
        nodes = nodes if only is None else nodes & only
        i = i[row]
        if not len(i) or not bool(nodes.any()):
            continue
        some = rays.take(i)
        found = crossings(world, some, _spans(world, proxies, some, nodes), EVALUATE)
        parts.append([i[found.ray], *(getattr(found, n) for n in _BUT_RAY)])
    if not parts:
        none, zero = rays.limit.new_zeros(0, dtype=torch.int64), rays.limit.new_zeros(0)
        return Crossings(none, none, zero, zero, zero.reshape(0, 3), zero.reshape(0, 3))
    return Crossings(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _spans(world: World, proxies: Proxies, rays: Rays, nodes: Bool[Tensor, "n"]) -> Spans:
    """Spans of rays in some of the nodes; a few are asked one by one, without Embree."""
    some = torch.nonzero(nodes).squeeze(-1)
    if len(some) <= ONE_BY_ONE:
        return brute_spans(world, rays, some)
    spans = proxies.spans(rays)
    if len(some) == len(world):
        return spans
    kept = nodes[spans.which]
    return Spans(*(getattr(spans, n)[kept] for n in Spans.__dataclass_fields__))


ONE_BY_ONE = 4

_BUT_RAY = tuple(Crossings.__dataclass_fields__)[1:]


def merged(world: World, inside: Crossings) -> Runs:
    """Crossings whose solids of one medium, flush or overlapping along a ray, are one stretch."""
    runs = Runs(
        inside.ray,
        inside.which,
        inside.which.clone(),
        inside.enter,
        inside.leave.clone(),
        inside.normal_enter,
        inside.normal_leave.clone(),
    )
    solid = torch.nonzero(world.solid[inside.which]).squeeze(-1)
    if len(solid) < 2:
        return runs
    code = inside.ray[solid] * len(world.media) + world.medium[inside.which[solid]]
    _, group, count = torch.unique(code, return_inverse=True, return_counts=True)
    if int(count.max()) < 2:
        return runs
    order = torch.argsort(group, stable=True)  # by group, then by enter as before
    row, group = solid[order], group[order]
    rank = torch.arange(len(row), device=row.device) - (torch.cumsum(count, 0) - count)[group]
    head = torch.zeros_like(count)  # the run that each group is in
    absorbed = torch.zeros_like(inside.ray, dtype=torch.bool)
    for k in range(int(count.max())):
        j, g = row[rank == k], group[rank == k]
        begins = (runs.enter[j] > runs.leave[head[g]] + FLUSH) | (k == 0)
        head[g[begins]] = j[begins]
        j, h = j[~begins], head[g[~begins]]
        absorbed[j] = True
        further = inside.leave[j] > runs.leave[h]
        j, h = j[further], h[further]
        runs.last[h], runs.leave[h] = inside.which[j], inside.leave[j]
        runs.normal_leave[h] = inside.normal_leave[j]
    return runs.take(~absorbed)


def _medium(
    world: World, paths: Paths, path: Tensor, segment: Tensor, inside: Crossings
) -> Bool[Tensor, "m"]:
    """Crossings of the medium that a refracted segment runs in."""
    if not bool(world.solid.any()):
        return torch.zeros_like(inside.ray, dtype=torch.bool)
    solid = runs_in(paths.which, paths.act)[path, segment][inside.ray]
    same = world.medium[solid.clamp(min=0)] == world.medium[inside.which]
    return (solid >= 0) & same


def _own(
    world: World,
    paths: Paths,
    path: Tensor,
    segment: Tensor,
    rays: Rays,
    inside: Crossings,
    wavelength: float,
) -> Bool[Tensor, "m"]:
    """Crossings of the object that a segment's own end reflects on.

    A reflected ray never crosses the convex object it left. A learned face ripples about the surface
    that the wave sees, so a stretch that touches the vertex and stays within a fraction of a
    wavelength of the face is the mirror itself, not a passage through it.
    """
    ray = inside.ray
    p, s = path[ray], segment[ray]
    depth = paths.which.shape[1]
    own = torch.zeros(len(ray), dtype=torch.bool, device=world.device)
    if not depth:
        return own
    none = torch.full((len(paths.which), 1), -1, dtype=torch.int64, device=world.device)
    reflecting = torch.cat([none, paths.which, none], 1)  # by vertex
    normals = torch.nn.functional.pad(paths.normal, (0, 0, 1, 1))
    length = rays.limit[ray]
    for vertex, near, far in (
        (s, inside.enter, inside.leave),
        (s + 1, length - inside.leave, length - inside.enter),
    ):
        mine = (reflecting[p, vertex] == inside.which) & (inside.which >= 0)
        cosine = (rays.direction[ray] * normals[p, vertex]).sum(-1).abs()
        ripple = torch.where(world.exact[inside.which], TOUCH, OWN_RIPPLE * wavelength)
        shallow, touching = far * cosine <= ripple, near * cosine <= ripple
        own |= mine & (world.convex[inside.which] | (shallow & touching))
    return own


def _placed(world: World, paths: Paths, path: Tensor, segment: Tensor, runs: Runs) -> Crossing:
    """Where stretches begin and end, and the normals there: on the segments as they are."""
    origin, target = paths.vertices[path, segment], paths.vertices[path, segment + 1]
    direction = unit(target - origin)
    normals = [runs.normal_enter, runs.normal_leave]
    points = [origin + t[:, None] * direction for t in (runs.enter, runs.leave)]
    if torch.is_grad_enabled() and len(path):
        for k, (which, end) in enumerate(((runs.which, origin), (runs.last, target))):
            on_boundary = normals[k].abs().sum(-1, keepdim=True) > 0
            point = torch.where(on_boundary, _slid(world, which, points[k], direction), end)
            turning = unit(world.value_and_gradient(which, point)[1])
            # on an edge the slope may be that of the other face
            alike = (turning * normals[k]).sum(-1, keepdim=True) > 0.5
            points[k], normals[k] = point, torch.where(on_boundary & alike, turning, normals[k])
    return Crossing(*points, *normals)


def _slid(world: World, which: Tensor, point: Tensor, direction: Tensor) -> Float[Tensor, "m 3"]:
    """Points of a surface, moved along a direction to where the surface is.

    t' = t - f(p(t)) / (grad f . d): nothing, but for its gradient (implicit function theorem).
    """
    value, gradient = world.value_and_gradient(which, point)
    slope = (gradient * direction).sum(-1).detach()
    steep = slope.abs() >= 1e-3
    move = torch.where(steep, value / torch.where(steep, slope, 1.0), 0.0)
    return point - move[:, None] * direction
