"""Chains become exact paths: every vertex on its surface and on the stationary path, in float64.

Planar faces alone: the image method, their closed form. Any curved or learned surface: Newton on the
Lagrangian (``implicit``), seeded by the launched ray; learned surfaces are measured at the wave's own
scale (``zone``) and measured again where the vertex has moved to, until it stands still.

The search for the stationary point carries no gradient; one Newton step at the answer does (implicit
function theorem), so paths are differentiable in poses, shapes, radios and network weights.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import World, unit
from rfsg.tracer import zone
from rfsg.tracer.columns import dot, minus
from rfsg.tracer.implicit import (
    caustics,
    kkt,
    multipliers,
    segments,
    solve_regular,
    spreading,
    transverse,
)
from rfsg.tracer.march import FORWARD
from rfsg.tracer.mirrored import Folded, Mirrors, folded, mirrors_of, stacked, within_sides
from rfsg.tracer.newton import Batch, Surfaces, newton, surfaces_of
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Chains, Paths, Status
from rfsg.tracer.seams import coincident
from rfsg.tracer.settle import Charts, settle, tolerance
from rfsg.tracer.zone import Facets

RIM = 1e-6  # of an object's size: the step that tells a rim from a bend
COINCIDENT = 1e-9  # [m] vertices nearer to each other than this define no direction
GRAZING = 1e-9  # cosine below which a path runs along a face and is not reflected by it


@dataclass(frozen=True)
class Solved:
    """Exact vertices, normals, spreading [1/m], caustics passed and status of a batch."""

    vertices: Float[Tensor, "c k 3"]
    normal: Float[Tensor, "c d 3"]
    spread: Float[Tensor, "c"]
    caustics: Int[Tensor, "c"]
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
    parts = _parts(world, chains, (tx_position, rx_position), wavelength, quality)
    paths, status = _gather(world, chains, parts, keep_failed, twins=False)
    numbers = torch.bincount(status, minlength=len(Status)).tolist()
    return paths, {s: numbers[s] for s in Status if numbers[s]}


def solve_each(
    world: World,
    chains: Chains,
    tx_position: Float[Tensor, "t 3"],
    rx_position: Float[Tensor, "r 3"],
    wavelength: float,
    quality: Quality,
) -> tuple[Paths, Int[Tensor, "c"]]:
    """Exact paths of candidate chains, in their order, and how each candidate ended. Paths over faces
    that coincide (``seams``) are left to the caller."""
    parts = _parts(world, chains, (tx_position, rx_position), wavelength, quality)
    return _gather(world, chains, parts, keep_failed=False, twins=True)


def _parts(
    world: World,
    chains: Chains,
    ends: tuple[Float[Tensor, "t 3"], Float[Tensor, "r 3"]],
    wavelength: float,
    quality: Quality,
) -> list[tuple[Tensor, Solved]]:
    """Chains of one depth at a time: their rows, and what became of them."""
    tx_position, rx_position = ends
    depth_of = (chains.which >= 0).sum(1)
    most = chains.which.shape[1]
    mirrors = mirrors_of(world)
    parts: list[tuple[Tensor, Solved]] = []
    for depth in torch.unique(depth_of).tolist():
        for i in torch.nonzero(depth_of == depth).squeeze(-1).split(quality.chunk):
            batch = Batch(
                chains.tx[i] * len(rx_position) + chains.rx[i],
                tx_position[chains.tx[i]],
                rx_position[chains.rx[i]],
                chains.which[i, :depth],
                chains.patch[i, :depth],
                chains.seed[i, :depth],
            )
            parts.append((i, _pad(_one_way(world, mirrors, batch, wavelength, quality), most)))
    return parts


def _one_way(
    world: World, mirrors: Mirrors, batch: Batch, wavelength: float, quality: Quality
) -> Solved:
    """Solve every chain from the same end, whichever end transmits: the same bits both ways.

    Over a rough learned face Newton may find one of several glints; swapping transmitter and receiver
    must not change which.
    """
    back = (batch.rx - batch.tx) @ batch.tx.new_tensor(FORWARD) < 0
    solved = _solve_depth(world, mirrors, batch.turned(back), wavelength, quality)
    return replace(
        solved,
        vertices=torch.where(back[:, None, None], solved.vertices.flip(1), solved.vertices),
        normal=torch.where(back[:, None, None], solved.normal.flip(1), solved.normal),
    )


def _solve_depth(
    world: World, mirrors: Mirrors, batch: Batch, wavelength: float, quality: Quality
) -> Solved:
    c, depth = batch.which.shape
    if depth == 0:
        return _direct(batch)
    planar = world.is_planar(batch.which, batch.patch).all(1)
    if bool(planar.all()):
        return _images(world, mirrors, batch)
    curved = ~planar
    return _merge(
        c,
        [
            (torch.nonzero(planar).squeeze(-1), lambda b: _images(world, mirrors, b)),
            (
                torch.nonzero(curved).squeeze(-1),
                lambda b: _stationary(world, b, wavelength, quality),
            ),
        ],
        batch,
    )


def _merge(c: int, jobs: list[tuple[Tensor, Callable[[Batch], Solved]]], batch: Batch) -> Solved:
    done = [(i, job(batch.take(i))) for i, job in jobs if len(i)]
    order = torch.argsort(torch.cat([i for i, _ in done]))
    assert len(order) == c
    return Solved(
        *(
            torch.cat([getattr(s, name) for _, s in done])[order]
            for name in Solved.__dataclass_fields__
        )
    )


def _direct(batch: Batch) -> Solved:
    vertices = batch.polyline()
    length, _ = segments(vertices)
    apart = length[:, 0] > COINCIDENT
    status = torch.where(apart, int(Status.OK), int(Status.DEGENERATE))
    spread = 1.0 / torch.where(apart, length[:, 0], 1.0)
    return Solved(vertices, batch.x, spread, torch.zeros_like(status), status)


# planar mirrors: the image method


def _images(world: World, mirrors: Mirrors, batch: Batch) -> Solved:
    path = folded(mirrors, batch.which, batch.patch, batch.tx, batch.rx)
    vertices, normal = stacked(path.vertices), stacked(path.normals)
    status = _mirror_status(world, batch, path, vertices, normal)
    apart = path.length > 0
    status = torch.where(apart, status, int(Status.DEGENERATE))
    spread = 1.0 / torch.where(apart, path.length, 1.0)
    return Solved(vertices, normal, spread, torch.zeros_like(status), status)


@torch.no_grad()
def _mirror_status(
    world: World, batch: Batch, path: Folded, vertices: Tensor, normal: Tensor
) -> Int[Tensor, "c"]:
    """``_validate`` of chains of planar mirrors, where rectangular faces need only look at their
    sides."""
    rectangular = world.rectangular[batch.which].all(1)
    on = torch.ones_like(rectangular)
    limit = tolerance(world, batch, 0.0)
    for level, point in enumerate(path.vertices[1:-1]):
        on &= within_sides(
            world, batch.which[:, level], batch.patch[:, level], point, limit[:, level]
        )
    others = torch.nonzero(~rectangular).squeeze(-1)
    if len(others):
        rest = batch.take(others)
        on[others] = on_faces(world, rest, vertices[others], normal[others], 0.0).all(1)
    steps = [minus(b, a) for a, b in pairwise(path.vertices)]
    lengths = [torch.sqrt(dot(step, step)) for step in steps]
    front, apart = torch.ones_like(on), torch.ones_like(on)
    for level, n in enumerate(path.normals):
        front &= dot(steps[level], n) < -GRAZING * lengths[level]
        front &= dot(steps[level + 1], n) > GRAZING * lengths[level + 1]
    for length in lengths:
        apart &= (length > COINCIDENT) & torch.isfinite(length)
    status = torch.full_like(batch.link, int(Status.OK))
    status[~front] = int(Status.WRONG_SIDE)
    status[~on] = int(Status.OFF_SURFACE)
    status[~apart] = int(Status.DEGENERATE)
    return status


# anything else: Newton on the Lagrangian


def _stationary(world: World, batch: Batch, wavelength: float, quality: Quality) -> Solved:
    with torch.no_grad():
        loose = replace(batch, tx=batch.tx.detach(), rx=batch.rx.detach(), x=batch.x.detach())
        x, status, charts = _rest(world, loose, wavelength, quality)
        batch.x = x
    found = torch.nonzero(status == int(Status.OK)).squeeze(-1)
    part, charts = batch.take(found), charts.take(found)
    facets = _last_measure(world, part, charts, wavelength, quality)
    surfaces = surfaces_of(world, part, facets)
    vertices = part.polyline(implicit_step(part, surfaces))
    jet = surfaces.jet(vertices[:, 1:-1])
    cap = torch.tensor(1.0 / wavelength, dtype=x.dtype, device=x.device)
    lam = multipliers(segments(vertices)[1], jet.gradient)
    spread, capped, regular = spreading(vertices, jet, lam, cap)
    normal = unit(jet.gradient)
    with torch.no_grad():
        passed = caustics(vertices, jet, lam)
        outcome = _validate(world, part, vertices, normal, facets, wavelength)
        good = outcome == int(Status.OK)
        outcome = torch.where(good & ~regular, int(Status.DEGENERATE), outcome)
        outcome = torch.where(good & regular & capped, int(Status.CAUSTIC_CAPPED), outcome)
        status[found] = duplicates(part, vertices, charts.radius, outcome)
    return Solved(
        batch.polyline().index_copy(0, found, vertices),
        torch.zeros_like(batch.x).index_copy(0, found, normal),
        torch.zeros_like(batch.x[:, 0, 0]).index_copy(0, found, spread),
        torch.zeros_like(status).index_copy(0, found, passed),
        status,
    )


def _rest(
    world: World, batch: Batch, wavelength: float, quality: Quality
) -> tuple[Tensor, Tensor, Charts]:
    """Vertices at rest, status and charts: exact chains by Newton alone, learned ones settle."""
    learned = (~world.exact[batch.which]).any(1)
    exact = torch.nonzero(~learned).squeeze(-1)
    x = batch.x.clone()
    status = torch.full((len(x),), int(Status.NOT_CONVERGED), device=x.device)
    charts = Charts(x.clone(), torch.zeros_like(x), torch.zeros_like(x[..., 0]))
    if len(exact):
        part = batch.take(exact)
        # no round measures again, so Newton has them all to itself
        x[exact], settled = newton(part, surfaces_of(world, part, None), 3 * quality.newton)
        status[exact] = torch.where(settled, int(Status.OK), int(Status.NOT_CONVERGED))
    i = torch.nonzero(learned).squeeze(-1)
    if len(i):
        x[i], status[i], found = settle(world, batch.take(i), wavelength, quality)
        charts.centre[i], charts.normal[i], charts.radius[i] = (
            found.centre,
            found.normal,
            found.radius,
        )
    return x, status, charts


def _last_measure(
    world: World, batch: Batch, charts: "Charts", wavelength: float, quality: Quality
) -> Facets | None:
    """Facets where learned vertices came to rest, this time with gradients if they are wanted."""
    which = batch.which.reshape(-1)
    i = torch.nonzero(~world.exact[which]).squeeze(-1)
    if not len(i):
        return None
    return zone.measure(
        world,
        which[i],
        charts.centre.reshape(-1, 3)[i],
        charts.normal.reshape(-1, 3)[i],
        charts.radius.reshape(-1)[i],
        wavelength,
        quality.zone_rings,
    )


def implicit_step(
    batch: Batch, surfaces: Surfaces, index: Float[Tensor, "c s"] | None = None
) -> Float[Tensor, "c d 3"]:
    """x - K^-1 residual, with K held fixed: the same points, now carrying gradients."""
    vertices = batch.polyline()
    jet = surfaces.jet(batch.x)
    with torch.no_grad():
        lam = multipliers(segments(vertices)[1], jet.gradient, index)
        matrix = kkt(vertices, jet, lam, index).matrix
    residual = kkt(vertices, jet, lam, index).residual
    step, _ = solve_regular(matrix, residual[..., None])
    depth = batch.which.shape[1]
    return batch.x - step[:, : 3 * depth, 0].reshape(-1, depth, 3)


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
        finite = torch.isfinite(vertices).all(-1).all(-1)
        front = ((u[:, :-1] * normal).sum(-1) < -GRAZING) & ((u[:, 1:] * normal).sum(-1) > GRAZING)
        on = on_faces(world, batch, vertices, normal, wavelength)
        status = torch.full((c,), int(Status.OK), device=vertices.device)
        if facets is not None:
            exact = world.exact[batch.which.reshape(-1)]
            resolved = torch.ones_like(exact)
            resolved[~exact] = facets.resolved(wavelength)
            status[~resolved.reshape(c, depth).all(1)] = int(Status.UNRESOLVED)
        status[~front.all(1)] = int(Status.WRONG_SIDE)
        status[~on.all(1)] = int(Status.OFF_SURFACE)
        status[~(length > COINCIDENT).all(1) | ~finite] = int(Status.DEGENERATE)
        return status


@torch.no_grad()
def on_faces(
    world: World,
    batch: Batch,
    vertices: Float[Tensor, "c k 3"],
    normal: Float[Tensor, "c d 3"],
    wavelength: float,
) -> Bool[Tensor, "c d"]:
    """Which vertices lie on the face that they were sought on, within its bounds."""
    c, depth = batch.which.shape
    which, x = batch.which.reshape(-1), vertices[:, 1:-1].reshape(-1, 3)
    x = torch.where(torch.isfinite(x), x, torch.zeros_like(x))
    f = world.sdf(which, x).abs().reshape(c, depth)
    exact = world.exact[which]
    # a planar face is itself alone, its edges included: on a convex shape whatever lies on its plane
    # and on the surface is of it. A curved surface may be sought from another of its pieces
    patch = world.patch(which, x)
    planar = world.is_planar(which, batch.patch.reshape(-1))
    curved = ~planar & ~world.is_planar(which, patch)
    same = (patch == batch.patch.reshape(-1)) | curved | (planar & world.convex[which])
    rim = torch.zeros_like(exact)
    i = torch.nonzero(exact & curved).squeeze(-1)
    rim[i] = _on_a_rim(world, which[i], x[i], normal.reshape(-1, 3)[i])
    within = ((same & ~rim) | ~exact).reshape(c, depth)
    return (f <= tolerance(world, batch, wavelength)) & within


def _on_a_rim(world: World, which: Tensor, x: Tensor, normal: Tensor) -> Tensor:
    """True where a curved surface ends: a step along its tangent leaves it at once.

    Newton may come to rest on the sharp rim of a cylinder, as if on a very thin round; that is an
    edge's business, not a mirror's.
    """
    step = RIM * world.size[which][:, None]
    rim = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    for tangent in transverse(unit(normal)).unbind(1):
        for sign in (1.0, -1.0):
            away = world.sdf(which, x + sign * step * tangent).abs()
            rim |= away > 0.1 * step[:, 0]
    return rim


def duplicates(
    batch: Batch,
    vertices: Float[Tensor, "c k 3"],
    radius: Float[Tensor, "c d"],
    status: Int[Tensor, "c"],
) -> Int[Tensor, "c"]:
    """Solutions of one sequence of objects closer than a zone (or, on exact surfaces, closer than
    rounding) are one path: the shortest stays."""
    good = (status == int(Status.OK)) | (status == int(Status.CAUSTIC_CAPPED))
    i = torch.nonzero(good).squeeze(-1)
    if len(i) < 2:
        return status
    sequence = torch.cat([batch.link[i, None], batch.which[i]], 1)
    _, key = torch.unique(sequence, dim=0, return_inverse=True)
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
        solved.caustics,
        solved.status,
    )


def _gather(
    world: World,
    chains: Chains,
    parts: list[tuple[Tensor, Solved]],
    keep_failed: bool,
    twins: bool,
) -> tuple[Paths, Int[Tensor, "c"]]:
    device, most = chains.tx.device, chains.which.shape[1]
    if not parts:
        empty = torch.zeros(0, dtype=torch.float64, device=device)
        blank = Solved(
            empty.reshape(0, most + 2, 3),
            empty.reshape(0, most, 3),
            empty,
            chains.tx.clone(),
            chains.tx.clone(),
        )
        parts = [(chains.tx, blank)]
    index = torch.cat([i for i, _ in parts])
    order = torch.argsort(index)
    whole = Solved(
        *(torch.cat([getattr(s, n) for _, s in parts])[order] for n in Solved.__dataclass_fields__)
    )
    good = (whole.status == int(Status.OK)) | (whole.status == int(Status.CAUSTIC_CAPPED))
    if not twins:
        twin = coincident(world, chains, whole.vertices, whole.normal, good)
        whole.status[twin] = int(Status.DUPLICATE)
        good &= ~twin
    keep = torch.nonzero(good | keep_failed).squeeze(-1)
    vertices = whole.vertices[keep]
    return (
        Paths(
            chains.tx[keep],
            chains.rx[keep],
            chains.which[keep],
            torch.zeros_like(chains.which[keep]),  # all of them reflections
            chains.patch[keep],
            vertices,
            whole.normal[keep],
            # in order of length, so that the sum is the same to the bit from either end
            segments(vertices)[0].sort(1).values.sum(1),
            whole.spread[keep],
            whole.caustics[keep],
            whole.status[keep],
        ),
        whole.status,
    )
