"""Chains become exact paths: every vertex on its surface and on the stationary path, in float64.

Planar faces alone: the image method, their closed form. Any curved or learned surface: Newton on the
Lagrangian (``implicit``), seeded by the launched ray; learned surfaces are measured at the wave's own
scale (``zone``) and measured again where the vertex has moved to, until it stands still.

The search for the stationary point carries no gradient; one Newton step at the answer does (implicit
function theorem), so paths are differentiable in poses, shapes, radios and network weights.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Jet
from rfsg.scene.world import World, unit
from rfsg.tracer import zone
from rfsg.tracer.implicit import (
    kkt,
    multipliers,
    segments,
    solve_regular,
    spreading,
)
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Chains, Paths, Status
from rfsg.tracer.zone import Facets

ON_SURFACE = 1e-7  # of the object's size: a polished vertex is orders closer, an edge passed is not
SETTLED = 1e-9  # [m] a vertex moves less than this between rounds: phase to 1e-6 rad at 30 GHz
NEWTON_SETTLED = 1e-11  # of the path's length: the last Newton step of a converged chain
GRAZING = 1e-9  # cosine below which a path runs along a face and is not reflected by it


@dataclass
class Batch:
    """Chains of one depth on their way to paths; every field has the chain axis first."""

    index: Int[Tensor, "c"]
    tx: Float[Tensor, "c 3"]
    rx: Float[Tensor, "c 3"]
    which: Int[Tensor, "c d"]
    patch: Int[Tensor, "c d"]
    x: Float[Tensor, "c d 3"]

    def take(self, i: Tensor) -> "Batch":
        return Batch(*(getattr(self, n)[i] for n in self.__dataclass_fields__))

    def polyline(self, x: Tensor | None = None) -> Float[Tensor, "c v 3"]:
        x = self.x if x is None else x
        return torch.cat([self.tx[:, None], x, self.rx[:, None]], 1)


@dataclass(frozen=True)
class Solved:
    """Exact vertices, normals, spreading [1/m] and status of a batch."""

    vertices: Float[Tensor, "c k 3"]
    normal: Float[Tensor, "c d 3"]
    spread: Float[Tensor, "c"]
    status: Int[Tensor, "c"]


def solve(
    world: World,
    chains: Chains,
    tx_position: Float[Tensor, "t 3"],
    rx_position: Float[Tensor, "r 3"],
    wavelength: float,
    quality: Quality,
    *,
    keep_failed: bool = False,
) -> tuple[Paths, dict[Status, int]]:
    """Exact paths of candidate chains, and how many candidates ended in each status.

    Gradients flow to poses, shapes and positions when grad mode is on. Rejected candidates are
    dropped unless ``keep_failed``.
    """
    depth_of = (chains.which >= 0).sum(1)
    most = chains.which.shape[1]
    parts: list[tuple[Tensor, Solved]] = []
    for depth in torch.unique(depth_of).tolist():
        for i in torch.nonzero(depth_of == depth).squeeze(-1).split(quality.chunk):
            batch = Batch(
                i,
                tx_position[chains.tx[i]],
                rx_position[chains.rx[i]],
                chains.which[i, :depth],
                chains.patch[i, :depth],
                chains.seed[i, :depth],
            )
            parts.append((i, _pad(_solve_depth(world, batch, wavelength, quality), most)))
    return _gather(world, chains, parts, most, wavelength, keep_failed)


def _solve_depth(world: World, batch: Batch, wavelength: float, quality: Quality) -> Solved:
    c, depth = batch.which.shape
    if depth == 0:
        return _direct(batch, wavelength)
    flat_which, flat_patch = batch.which.reshape(-1), batch.patch.reshape(-1)
    planar = world.plane(flat_which, flat_patch)[2].reshape(c, depth)
    mirrors = planar.all(1)
    if bool(mirrors.all()):
        return _images(world, batch)
    curved = ~mirrors
    result = _merge(
        c,
        [
            (torch.nonzero(mirrors).squeeze(-1), lambda b: _images(world, b)),
            (
                torch.nonzero(curved).squeeze(-1),
                lambda b: _stationary(world, b, wavelength, quality),
            ),
        ],
        batch,
    )
    return result


def _merge(
    c: int, jobs: list[tuple[Tensor, Callable[[Batch], Solved]]], batch: Batch
) -> Solved:
    done = [(i, job(batch.take(i))) for i, job in jobs if len(i)]
    order = torch.argsort(torch.cat([i for i, _ in done]))
    assert len(order) == c
    return Solved(
        *(
            torch.cat([getattr(s, name) for _, s in done])[order]
            for name in Solved.__dataclass_fields__
        )
    )


def _direct(batch: Batch, wavelength: float) -> Solved:
    vertices = batch.polyline()
    length, _ = segments(vertices)
    good = length[:, 0] > 0
    spread, capped = _capped_inverse(length[:, 0], wavelength)
    status = torch.where(capped, int(Status.CAUSTIC_CAPPED), int(Status.OK))
    status = torch.where(good, status, int(Status.DEGENERATE))
    return Solved(vertices, batch.x, spread, status)


def _capped_inverse(length: Tensor, wavelength: float) -> tuple[Tensor, Tensor]:
    """1/length, held at 1/wavelength only where the antennas coincide (see ``spreading``)."""
    zero = length <= 0
    safe = torch.where(zero, torch.full_like(length, wavelength), length)
    return 1.0 / safe, zero


# planar mirrors: the image method


def _images(world: World, batch: Batch) -> Solved:
    c, depth = batch.which.shape
    planes = [world.plane(batch.which[:, i], batch.patch[:, i])[:2] for i in range(depth)]
    images = [batch.tx]
    for normal, offset in planes:
        height = (images[-1] * normal).sum(-1) - offset
        images.append(images[-1] - 2.0 * height[:, None] * normal)
    target, vertices = batch.rx, []
    for i in range(depth - 1, -1, -1):
        normal, offset = planes[i]
        ray = target - images[i + 1]
        slope = (ray * normal).sum(-1)
        parallel = slope == 0
        t = (offset - (images[i + 1] * normal).sum(-1)) / torch.where(parallel, 1.0, slope)
        target = images[i + 1] + t[:, None] * ray
        vertices.insert(0, target)
    x = torch.stack(vertices, 1)
    normal = torch.stack([n for n, _ in planes], 1)
    line = batch.rx - images[-1]
    square = (line * line).sum(-1)
    length = torch.sqrt(torch.where(square == 0, torch.ones_like(square), square))
    batch.x = x
    status = _validate(world, batch, batch.polyline(x), normal, None)
    status = torch.where(square == 0, int(Status.DEGENERATE), status)
    return Solved(batch.polyline(x), normal, 1.0 / length, status)


# anything else: Newton on the Lagrangian


@dataclass(frozen=True)
class Surfaces:
    """The local models of a batch's vertices: planes, exact shapes, or measured facets (flat [c d])."""

    world: World
    which: Int[Tensor, "m"]
    planar: Bool[Tensor, "m"]
    plane_normal: Float[Tensor, "m 3"]
    plane_offset: Float[Tensor, "m"]
    learned: Bool[Tensor, "m"]
    facets: Facets | None

    def jet(self, x: Float[Tensor, "c d 3"]) -> Jet:
        flat = x.reshape(-1, 3)
        value = (flat * self.plane_normal).sum(-1) - self.plane_offset
        gradient, hessian = self.plane_normal, flat.new_zeros(len(flat), 3, 3)
        i = torch.nonzero(~self.planar & ~self.learned).squeeze(-1)
        if len(i):
            j = self.world.jet(self.which[i], flat[i])
            value, gradient = value.index_copy(0, i, j.value), gradient.index_copy(0, i, j.gradient)
            hessian = hessian.index_copy(0, i, j.hessian)
        if self.facets is not None:
            i = torch.nonzero(self.learned).squeeze(-1)
            j = self.facets.jet(flat[i])
            value, gradient = value.index_copy(0, i, j.value), gradient.index_copy(0, i, j.gradient)
            hessian = hessian.index_copy(0, i, j.hessian)
        c, d = x.shape[:2]
        return Jet(value.reshape(c, d), gradient.reshape(c, d, 3), hessian.reshape(c, d, 3, 3))


def _surfaces(world: World, batch: Batch, facets: Facets | None) -> Surfaces:
    which, patch = batch.which.reshape(-1), batch.patch.reshape(-1)
    normal, offset, planar = world.plane(which, patch)
    return Surfaces(world, which, planar, normal, offset, ~world.exact[which], facets)


def _stationary(world: World, batch: Batch, wavelength: float, quality: Quality) -> Solved:
    with torch.no_grad():
        detached = Batch(
            batch.index,
            batch.tx.detach(),
            batch.rx.detach(),
            batch.which,
            batch.patch,
            batch.x.detach(),
        )
        x, status, charts = _search(world, detached, wavelength, quality)
        batch.x = x
    learned = ~world.exact[batch.which.reshape(-1)]
    facets = None
    if bool(learned.any()):
        # measured once more where the vertex came to rest, this time with gradients if wanted
        i = torch.nonzero(learned).squeeze(-1)
        facets = zone.measure(
            world,
            batch.which.reshape(-1)[i],
            charts.centre.reshape(-1, 3)[i],
            charts.normal.reshape(-1, 3)[i],
            charts.radius.reshape(-1)[i],
            wavelength,
            quality.zone_rings,
        )
    surfaces = _surfaces(world, batch, facets)
    x = _implicit_step(batch, surfaces)
    vertices = batch.polyline(x)
    jet = surfaces.jet(x)
    cap = torch.tensor(1.0 / wavelength, dtype=x.dtype, device=x.device)
    lam = multipliers(segments(vertices)[1], jet.gradient)
    spread, capped, regular = spreading(vertices, jet, lam, cap)
    normal = unit(jet.gradient)
    with torch.no_grad():
        valid = _validate(world, batch, vertices, normal, facets, wavelength)
        status = torch.where(status == int(Status.OK), valid, status)
        good = status == int(Status.OK)
        status = torch.where(good & ~regular, int(Status.DEGENERATE), status)
        status = torch.where(good & regular & capped, int(Status.CAUSTIC_CAPPED), status)
        status = _duplicates(batch, vertices, charts.radius, status)
    return Solved(vertices, normal, spread, status)


def _implicit_step(batch: Batch, surfaces: Surfaces) -> Tensor:
    """x - K^-1 residual, with K held fixed: the same point, now carrying gradients."""
    vertices = batch.polyline()
    jet = surfaces.jet(batch.x)
    with torch.no_grad():
        lam = multipliers(segments(vertices)[1], jet.gradient)
        matrix = kkt(vertices, jet, lam).matrix
    residual = kkt(vertices, jet, lam).residual
    step, _ = solve_regular(matrix, residual[..., None])
    depth = batch.which.shape[1]
    return batch.x - step[:, : 3 * depth, 0].reshape(-1, depth, 3)


@dataclass(frozen=True)
class Charts:
    """Where each vertex's surface was measured: centre, normal and zone radius."""

    centre: Float[Tensor, "c d 3"]
    normal: Float[Tensor, "c d 3"]
    radius: Float[Tensor, "c d"]


def _search(
    world: World, batch: Batch, wavelength: float, quality: Quality
) -> tuple[Tensor, Tensor, Charts]:
    """Vertices [c d 3] at rest, status [c] and the charts they rest on (no gradients)."""
    c, depth = batch.which.shape
    x = batch.x.clone()
    status = torch.full((c,), int(Status.NOT_CONVERGED), device=x.device)
    learned = ~world.exact[batch.which]
    flat = batch.which.reshape(-1)
    normal = world.normal(flat, x.reshape(-1, 3)).reshape(c, depth, 3)
    charts = Charts(x.clone(), normal, torch.zeros_like(x[..., 0]))
    exact = torch.nonzero(~learned.any(1)).squeeze(-1)
    if len(exact):
        part = batch.take(exact)
        x[exact], settled = _newton(part, _surfaces(world, part, None), 3 * quality.newton)
        status[exact] = torch.where(settled, int(Status.OK), int(Status.NOT_CONVERGED))
    rest = torch.nonzero(learned.any(1)).squeeze(-1)
    curvature = torch.zeros_like(charts.radius)
    for round_ in range(quality.refits):
        if not len(rest):
            break
        precise = round_ >= 2
        part = batch.take(rest)
        part.x = x[rest]
        facets, radius = _measure(
            world, part, charts.normal[rest], curvature[rest], learned[rest], wavelength, quality,
            torch.float64 if precise else torch.float32,
        )  # fmt: skip
        charts.centre[rest], charts.radius[rest] = part.x, radius
        surfaces = _surfaces(world, part, facets)
        moved, settled = _newton(part, surfaces, quality.newton)
        step = (moved - part.x).norm(dim=-1).amax(-1)
        gradient = surfaces.jet(moved).gradient
        bend = torch.zeros_like(radius).reshape(-1)
        bend[learned[rest].reshape(-1)] = facets.curvature()
        # the charts that decide this round stay as they are; the next round's begin where it ended
        at_rest = precise & settled & (step < SETTLED)
        lost = _lost(world, part, moved, facets, learned[rest], settled, precise, wavelength)
        status[rest[at_rest]] = int(Status.OK)
        status[rest[lost > 0]] = lost[lost > 0]
        x[rest] = moved
        go = ~at_rest & (lost == 0)
        curvature[rest] = bend.reshape(radius.shape)
        keep = rest[go]
        charts.normal[keep] = unit(gradient[go])
        rest = keep
    return x, status, charts


def _measure(
    world: World,
    batch: Batch,
    normal: Tensor,
    curvature: Tensor,
    learned: Tensor,
    wavelength: float,
    quality: Quality,
    dtype: torch.dtype,
) -> tuple[Facets, Tensor]:
    """Facets of the learned vertices (flat) and every vertex's zone radius [c d]."""
    length, u = segments(batch.polyline())
    before = torch.cumsum(length, 1)[:, :-1]
    after = length.sum(1, keepdim=True) - before
    cosine = (u[:, :-1] * normal).sum(-1).abs()
    radius = zone.zone_radius(before, after, cosine, curvature, wavelength)
    i = torch.nonzero(learned.reshape(-1)).squeeze(-1)
    facets = zone.measure(
        world,
        batch.which.reshape(-1)[i],
        batch.x.reshape(-1, 3)[i],
        normal.reshape(-1, 3)[i],
        radius.reshape(-1)[i],
        wavelength,
        quality.zone_rings,
        dtype,
    )
    return facets, radius


def _lost(
    world: World,
    batch: Batch,
    moved: Tensor,
    facets: Facets,
    learned: Tensor,
    settled: Tensor,
    precise: bool,
    wavelength: float,
) -> Tensor:
    """Why a chain is given up early (a Status), 0 while there is hope: most candidates end here."""
    c, depth = batch.which.shape
    hopeless = torch.zeros(c, dtype=torch.int64, device=moved.device)
    unresolved = torch.zeros_like(learned.reshape(-1))
    unresolved[learned.reshape(-1)] = ~facets.resolved(wavelength)
    if precise:
        hopeless[unresolved.reshape(c, depth).any(1)] = int(Status.UNRESOLVED)
        hopeless[~settled] = int(Status.NOT_CONVERGED)
    which = batch.which.reshape(-1)
    f = world.sdf(which, moved.reshape(-1, 3), torch.float32).abs().reshape(c, depth)
    # a stationary point off the object by a tenth of its size is another object's business
    slack = 0.1 * world.size[batch.which] if not precise else 2.0 * _tolerance(world, batch, wavelength)
    off = (f > slack) & learned
    hopeless[off.any(1) | ~torch.isfinite(moved).all(-1).all(-1)] = int(Status.OFF_SURFACE)
    return hopeless


def _tolerance(world: World, batch: Batch, wavelength: float) -> Tensor:
    """How far a vertex may lie from f = 0 [m], per vertex."""
    exact = ON_SURFACE * torch.clamp(world.size[batch.which], min=1.0)
    relief = torch.full_like(exact, zone.RELIEF * wavelength)
    return torch.where(world.exact[batch.which], exact, torch.minimum(relief, 0.05 * world.size[batch.which]))


def _newton(batch: Batch, surfaces: Surfaces, rounds: int) -> tuple[Tensor, Tensor]:
    """Newton on the Lagrangian from batch.x, steps held to half the shortest neighbouring segment."""
    x = batch.x
    c, depth = batch.which.shape
    settled = torch.zeros(c, dtype=torch.bool, device=x.device)
    for _ in range(rounds):
        vertices = batch.polyline(x)
        length, u = segments(vertices)
        jet = surfaces.jet(x)
        system = kkt(vertices, jet, multipliers(u, jet.gradient))
        step, regular = solve_regular(system.matrix, system.residual[..., None])
        dx = -step[:, : 3 * depth, 0].reshape(c, depth, 3)
        # no further than half a segment, nor than half a radius of curvature: Newton's model ends there
        bend = jet.hessian.flatten(2).norm(dim=-1).clamp(min=1e-300)
        reach = 0.5 * torch.minimum(torch.minimum(length[:, :-1], length[:, 1:]), 1.0 / bend)
        size = dx.norm(dim=-1)
        shrink = torch.where(size > reach, reach / size.clamp(min=1e-300), 1.0).amin(1)
        x = x + shrink[:, None, None] * dx
        settled = regular & (size.amax(1) <= NEWTON_SETTLED * length.sum(1))
        if bool(settled.all()):
            break
    return x, settled


# what makes a stationary point a path


def _validate(
    world: World,
    batch: Batch,
    vertices: Tensor,
    normal: Tensor,
    facets: Facets | None,
    wavelength: float = 0.0,
) -> Tensor:
    with torch.no_grad():
        c, depth = batch.which.shape
        length, u = segments(vertices)
        which, x = batch.which.reshape(-1), vertices[:, 1:-1].reshape(-1, 3)
        finite = torch.isfinite(vertices).all(-1).all(-1)
        x = torch.where(torch.isfinite(x), x, torch.zeros_like(x))
        front = ((u[:, :-1] * normal).sum(-1) < -GRAZING) & ((u[:, 1:] * normal).sum(-1) > GRAZING)
        f = world.sdf(which, x).abs().reshape(c, depth)
        on = f <= _tolerance(world, batch, wavelength)
        exact = world.exact[which]
        # a planar face is itself alone; a curved surface may be sought from another of its pieces
        patch = world.patch(which, x)
        planar = world.plane(which, batch.patch.reshape(-1))[2]
        curved = ~planar & ~world.plane(which, patch)[2]
        same = (patch == batch.patch.reshape(-1)) | curved
        on = on & (same | ~exact).reshape(c, depth)
        status = torch.full((c,), int(Status.OK), device=x.device)
        if facets is not None:
            resolved = torch.ones_like(exact)
            resolved[~exact] = facets.resolved(wavelength)
            status[~resolved.reshape(c, depth).all(1)] = int(Status.UNRESOLVED)
        status[~front.all(1)] = int(Status.WRONG_SIDE)
        status[~on.all(1)] = int(Status.OFF_SURFACE)
        status[~(length > 0).all(1) | ~finite] = int(Status.DEGENERATE)
        return status


def _duplicates(batch: Batch, vertices: Tensor, radius: Tensor, status: Tensor) -> Tensor:
    """Solutions of one sequence of objects closer than a zone (or, on exact surfaces, closer than
    rounding) are one path: the shortest stays."""
    good = (status == int(Status.OK)) | (status == int(Status.CAUSTIC_CAPPED))
    i = torch.nonzero(good).squeeze(-1)
    if len(i) < 2:
        return status
    ends = torch.cat([batch.tx[i], batch.rx[i]], 1)
    _, end_id = torch.unique(ends, dim=0, return_inverse=True)
    _, key = torch.unique(
        torch.cat([end_id[:, None], batch.which[i]], 1), dim=0, return_inverse=True
    )
    length = segments(vertices[i])[0].sum(1)
    order = torch.argsort(length, stable=True)
    order = order[torch.argsort(key[order], stable=True)]
    i, key = i[order], key[order]
    x, reach = vertices[i, 1:-1], radius[i].clamp(min=1e-6)
    dropped = torch.zeros(len(i), dtype=torch.bool, device=status.device)
    most = int(torch.bincount(key).max())
    for shift in range(1, most):
        near = ((x[shift:] - x[:-shift]).norm(dim=-1) <= reach[:-shift]).all(1)
        same = key[shift:] == key[:-shift]
        dropped[shift:] |= near & same & ~dropped[:-shift]
    status = status.clone()
    status[i[dropped]] = int(Status.DUPLICATE)
    return status


# records


def _pad(solved: Solved, most: int) -> Solved:
    """Repeat the receiver so that every path has the same number of vertices."""
    missing = most - solved.normal.shape[1]
    if not missing:
        return solved
    c = len(solved.status)
    tail = solved.vertices[:, -1:].expand(c, missing, 3)
    normal = solved.normal.new_zeros(c, missing, 3)
    return Solved(
        torch.cat([solved.vertices, tail], 1),
        torch.cat([solved.normal, normal], 1),
        solved.spread,
        solved.status,
    )


def _gather(
    world: World,
    chains: Chains,
    parts: list[tuple[Tensor, Solved]],
    most: int,
    wavelength: float,
    keep_failed: bool,
) -> tuple[Paths, dict[Status, int]]:
    device = chains.tx.device
    if not parts:
        empty = torch.zeros(0, dtype=torch.float64, device=device)
        blank = Solved(
            empty.reshape(0, most + 2, 3), empty.reshape(0, most, 3), empty, chains.tx.clone()
        )
        parts = [(chains.tx, blank)]
    index = torch.cat([i for i, _ in parts])
    order = torch.argsort(index)
    whole = Solved(
        *(torch.cat([getattr(s, n) for _, s in parts])[order] for n in Solved.__dataclass_fields__)
    )
    numbers = torch.bincount(whole.status, minlength=len(Status)).tolist()
    counts = {s: numbers[s] for s in Status if numbers[s]}
    good = (whole.status == int(Status.OK)) | (whole.status == int(Status.CAUSTIC_CAPPED))
    keep = torch.nonzero(good | keep_failed).squeeze(-1)
    vertices = whole.vertices[keep]
    return (
        Paths(
            chains.tx[keep],
            chains.rx[keep],
            chains.which[keep],
            vertices,
            whole.normal[keep],
            segments(vertices)[0].sum(1),
            whole.spread[keep],
            whole.status[keep],
        ),
        counts,
    )
