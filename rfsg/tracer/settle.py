"""Paths over learned surfaces come to rest: measure the zone, solve on the facet, measure again.

The first look costs no network at all: the facets of an object's samples were measured once. Most
candidates end there. Rounds then run on sketches of the networks until a vertex hardly moves, and on the
networks themselves, in float64, until it stands still, so that the answer depends on where the path
rests and not on where the search began: reciprocity is as exact as float64.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.scene.world import World, unit
from rfsg.tracer import zone
from rfsg.tracer.faces import nearest_facets
from rfsg.tracer.feet import Feet
from rfsg.tracer.implicit import segments
from rfsg.tracer.lone import stationary
from rfsg.tracer.mixing import History
from rfsg.tracer.newton import NEWTON_SETTLED, ROUNDING, Batch, newton, surfaces_of
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Status
from rfsg.tracer.zone import Facets, Zones

ON_SURFACE = 1e-7  # of the object's size: a polished vertex is orders closer, an edge passed is not
SETTLED = 1e-11  # [m] a vertex moves less than this between rounds: gains to 1e-9 either way round
PRECISE = 3  # times ``Quality.refits`` in float64: the last digits come slowly, to few chains
EDGE_SLACK = 0.03  # [m] how far beyond a planar face's edge a vertex under way may be
NEARLY = 2e-6  # [m] where float32's own rounding begins: float64 takes over
PATIENCE = 5  # rounds after which a vertex must keep shrinking its steps, from
RESTLESS, SHRINKING = (
    0.05,
    0.7,
)  # of its zone's radius: else it cycles between two views of a rough face
LATE = 6  # rounds after which whatever still moves is near its end
STILL = 1e-4  # [m] a vertex that moves less stays on the face that it has, or on none
RETURN = 5.0  # times its last move: a vertex comes back no further than this
SAME = 1e-3  # [m] chains of one sequence this close after two rounds are on their way to one path


@dataclass(frozen=True)
class Charts:
    """Where each vertex's surface was measured: centre, normal and zone radius."""

    centre: Float[Tensor, "c d 3"]
    normal: Float[Tensor, "c d 3"]
    radius: Float[Tensor, "c d"]

    def take(self, i: Tensor) -> "Charts":
        return Charts(self.centre[i], self.normal[i], self.radius[i])


@dataclass
class State:
    """Where the chains of a batch are; rows are changed in place as they move."""

    x: Float[Tensor, "c d 3"]
    status: Tensor
    charts: Charts
    curvature: Float[Tensor, "c d"]
    history: History


@dataclass(frozen=True)
class Seen:
    """Where one solve led, whether it settled, and the surfaces met there: normals and bends."""

    moved: Float[Tensor, "c d 3"]
    settled: Tensor
    normal: Float[Tensor, "c d 3"]
    curvature: Float[Tensor, "c d"]


@dataclass(frozen=True)
class Settling:
    """What all rounds of a batch have in common."""

    world: World
    wavelength: float
    quality: Quality

    def zones(
        self, part: Batch, normal: Float[Tensor, "c d 3"], curvature: Float[Tensor, "c d"]
    ) -> tuple[Zones, Float[Tensor, "c d"]]:
        """Zones of the learned vertices (flat) and every vertex's zone radius."""
        length, u = segments(part.polyline())
        before = torch.cumsum(length, 1)[:, :-1]
        after = length.sum(1, keepdim=True) - before
        cosine = (u[:, :-1] * normal).sum(-1).abs()
        radius = zone.zone_radius(before, after, cosine, curvature, self.wavelength)
        which = part.which.reshape(-1)
        i = torch.nonzero(~self.world.exact[which]).squeeze(-1)
        x, n, reach = part.x.reshape(-1, 3)[i], normal.reshape(-1, 3)[i], radius.reshape(-1)[i]
        rings = self.quality.zone_rings
        return Zones(self.world, which[i], x, n, reach, self.wavelength, rings), radius

    def solve(self, part: Batch, facets: Facets) -> Seen:
        surfaces, steps = surfaces_of(self.world, part, facets), self.quality.newton
        if part.x.shape[1] == 1:
            floor = ROUNDING * part.polyline().abs().amax((1, 2))
            ends = part.x[:, 0], part.tx, part.rx
            moved, settled = stationary(facets, *ends, steps, NEWTON_SETTLED, floor)
            moved = moved[:, None]
        else:
            moved, settled = newton(part, surfaces, steps)
        bend = torch.zeros_like(surfaces.plane_offset)
        bend[surfaces.learned] = facets.curvature()
        normal = unit(surfaces.jet(moved).gradient)
        return Seen(moved, settled, normal, bend.reshape(normal.shape[:2]))


def settle(
    world: World, batch: Batch, wavelength: float, quality: Quality
) -> tuple[Float[Tensor, "c d 3"], Tensor, Charts]:
    """Vertices at rest, status [c] and the charts they rest on, of chains with learned vertices."""
    state = _start(batch)
    settling = Settling(world, wavelength, quality)
    rows = _look(settling, batch, state)
    rough = replace(settling, world=world.sketched(zone.SKETCHED * wavelength))
    rows = _rounds(rough, batch, state, rows, torch.float32)
    twin = _twins(batch.take(rows), state.x[rows])
    state.status[rows[twin]] = int(Status.DUPLICATE)
    rows = rows[~twin]
    precise = replace(settling, quality=replace(quality, refits=PRECISE * quality.refits))
    _rounds(precise, batch, state, rows, torch.float64)
    return state.x, state.status, state.charts


def _start(batch: Batch) -> State:
    """Nothing known but where the chains begin: normals and bends are the first look's to say."""
    c, depth = batch.which.shape
    flat = torch.zeros_like(batch.x[..., 0])
    status = torch.full((c,), int(Status.NOT_CONVERGED), device=batch.x.device)
    charts = Charts(batch.x.clone(), torch.zeros_like(batch.x), flat)
    history = History.none(c, 7 * depth, batch.x)
    return State(batch.x.clone(), status, charts, flat.clone(), history)


def _look(settling: Settling, batch: Batch, state: State) -> Tensor:
    """The first look, at facets measured beforehand; returns the rows that go on."""
    world = settling.world
    learned = ~world.exact[batch.which]
    facets = nearest_facets(world, batch.which[learned], batch.x[learned], settling.wavelength)
    seen = settling.solve(batch, facets)
    lost = _lost(settling, batch, seen, facets, learned, precise=False, first=True)
    state.status = torch.where(lost > 0, lost, state.status)
    state.x, state.charts.normal[:], state.curvature = seen.moved, seen.normal, seen.curvature
    return torch.nonzero(lost == 0).squeeze(-1)


def _rounds(
    settling: Settling, batch: Batch, state: State, rows: Tensor, dtype: torch.dtype
) -> Tensor:
    """Rounds in one precision; returns the rows that came to rest in it, and in float32 those that are
    not given up as well."""
    done, feet = [rows[:0]], None
    for number in range(settling.quality.refits):
        going, feet = _round(settling, batch, state, rows, dtype=dtype, number=number, feet=feet)
        rested = state.status[rows] == int(Status.OK)
        done.append(rows[rested])
        rows = going
        if not len(rows):
            break
    if dtype != torch.float64:
        done.append(rows)
    ready = torch.cat(done)
    if dtype != torch.float64:
        state.status[ready] = int(Status.NOT_CONVERGED)  # until float64 has confirmed them
    return ready


def _round(
    settling: Settling,
    batch: Batch,
    state: State,
    rows: Tensor,
    *,
    dtype: torch.dtype,
    number: int,
    feet: Feet | None,
) -> tuple[Tensor, Feet | None]:
    """One measurement and one solve of the rows given; returns those that go on, and their feet."""
    if not len(rows):
        return rows, None
    world, precise = settling.world, dtype == torch.float64
    part = batch.take(rows)
    part.x = state.x[rows]
    learned = ~world.exact[part.which]
    zones, radius = settling.zones(part, state.charts.normal[rows], state.curvature[rows])
    facets, feet = zones.measured(dtype, feet)
    state.charts.centre[rows], state.charts.radius[rows] = part.x, radius
    seen = settling.solve(part, facets)
    moved = seen.moved
    step = (moved - part.x).norm(dim=-1).amax(-1)
    least = SETTLED + ROUNDING * moved.abs().amax((1, 2)) if precise else NEARLY
    at_rest = seen.settled & (step < least)
    lost = _lost(settling, part, seen, facets, learned, precise, number == 0)
    restless = (step > RESTLESS * radius.amax(1) * SHRINKING ** (number - PATIENCE)) & (
        number >= PATIENCE
    )
    lost = torch.where(restless & (lost == 0), int(Status.NOT_CONVERGED), lost)
    state.status[rows[at_rest]] = int(Status.OK)
    state.status[rows[lost > 0]] = lost[lost > 0]
    go = ~at_rest & (lost == 0)
    if number in (2, 5) and not precise:
        twin = _twins(part, moved) & go
        state.status[rows[twin]] = int(Status.DUPLICATE)
        go = go & ~twin
    state.x[rows] = moved
    _advance(state, rows, part, seen, radius, number, go, all_of_it=precise or number >= LATE)
    feet = feet.take(torch.nonzero(go[torch.nonzero(learned)[:, 0]]).squeeze(-1))
    return rows[go], feet


def _twins(part: Batch, moved: Tensor) -> Tensor:
    """All but one of the chains of one link and one sequence that have come to the same place."""
    cell = torch.round(moved.flatten(1) / SAME).to(torch.int64)
    key = torch.cat([part.link[:, None], part.which, cell], 1)
    _, group = torch.unique(key, dim=0, return_inverse=True)
    order = torch.argsort(moved.flatten(1).sum(1), stable=True)  # whose turn it is says nothing
    order = order[torch.argsort(group[order], stable=True)]
    twin = torch.zeros(len(group), dtype=torch.bool, device=group.device)
    twin[order[1:]] = group[order[1:]] == group[order[:-1]]
    return twin


def _advance(
    state: State,
    rows: Tensor,
    part: Batch,
    seen: Seen,
    radius: Float[Tensor, "c d"],
    number: int,
    go: Tensor,
    all_of_it: bool,
) -> None:
    """Where the rows that ``go`` on begin their next round: at a mix of the last rounds' answers.

    all_of_it: places, normals and bends, of several rounds; else places alone, of two, for from afar
    rounds are anything but linear. The charts of rows at rest stay those that they rest on.
    """
    c, depth = radius.shape
    led = _row(seen.moved, seen.normal, seen.curvature)
    change = led - _row(part.x, state.charts.normal[rows], state.curvature[rows])
    share = 1.0 if all_of_it else 0.0
    weight = (share * radius)[..., None].expand_as(part.x)
    scale = _row(torch.ones_like(part.x), weight, weight[..., 0] * radius)
    rounds = 0 if number < 2 else number if all_of_it else 1
    mixed = state.history.mixed(rows, led, change, scale, rounds)
    x, normal, bend = mixed[go].split([3 * depth, 3 * depth, depth], 1)
    some = rows[go]
    state.x[some] = x.reshape(-1, depth, 3)
    state.charts.normal[some] = unit(normal.reshape(-1, depth, 3)) if all_of_it else seen.normal[go]
    state.curvature[rows] = seen.curvature
    if all_of_it:
        state.curvature[some] = bend.clamp(min=0.0)


def _row(x: Tensor, normal: Tensor, bend: Tensor) -> Float[Tensor, "c n"]:
    """Places, normals and bends of all vertices of each chain, side by side."""
    return torch.cat([x.flatten(1), normal.flatten(1), bend], 1)


def _lost(
    settling: Settling,
    batch: Batch,
    seen: Seen,
    facets: Facets,
    learned: Tensor,
    precise: bool,
    first: bool,
) -> Tensor:
    """Why a chain is given up early (a Status), 0 while there is hope: most candidates end here."""
    world, moved, wavelength = settling.world, seen.moved, settling.wavelength
    c, depth = batch.which.shape
    stride = (moved - batch.x).norm(dim=-1)
    still = stride.amax(1) < STILL
    hopeless = torch.zeros(c, dtype=torch.int64, device=moved.device)
    unresolved = torch.zeros_like(learned.reshape(-1))
    unresolved[learned.reshape(-1)] = ~facets.resolved(wavelength, 1.0 if precise else MARGIN)
    unresolved = unresolved.reshape(c, depth).any(1)
    hopeless[unresolved & (still | precise)] = int(Status.UNRESOLVED)
    if precise:
        hopeless[~seen.settled] = int(Status.NOT_CONVERGED)
    # a stationary point off the object by a tenth of its size is another object's business
    allowed = 2.0 * tolerance(world, batch, wavelength)
    far = torch.where(
        learned, 0.03 * world.size[batch.which] + 0.1 * stride, EDGE_SLACK + 0.5 * stride
    )
    # a mirror's own edge is as sharp as its object: an unfinished vertex may yet come back a little
    far = torch.where(
        (still | (not first))[:, None], torch.minimum(far, RETURN * stride + STILL), far
    )
    most = allowed if precise else allowed + far
    # beyond its bounds a network may say anything; the surface is at least as far as they are
    beyond = _beyond(world, batch.which.reshape(-1), moved.reshape(-1, 3)).reshape(c, depth)
    off = (beyond > most).any(1) | ~torch.isfinite(moved).all(-1).all(-1)
    i = torch.nonzero(~off).squeeze(-1)  # and only these are worth asking about
    f, gradient = world.value_and_gradient(
        batch.which[i].reshape(-1), moved[i].reshape(-1, 3), torch.float32
    )
    past = f.reshape(-1, depth).abs() > most[i]
    if not first:  # another face, seen from behind
        behind = (gradient.reshape(-1, depth, 3) * seen.normal[i]).sum(-1) < 0
        past |= learned[i] & behind
    off[i] = past.any(1)
    hopeless[off] = int(Status.OFF_SURFACE)
    return hopeless


def _beyond(
    world: World, which: Int[Tensor, "m"], point: Float[Tensor, "m 3"]
) -> Float[Tensor, "m"]:
    """How far points lie outside the bounds of their objects [m]."""
    low, high = world.bounds_object.detach()[which].unbind(1)
    local = world.point_object(which, point)
    out = torch.maximum(low - local, local - high).clamp(min=0.0)
    return out.norm(dim=-1) * world.scale.detach()[which]


MARGIN = 1.1  # by which a face may fail in float32 and be a mirror in float64


def tolerance(world: World, batch: Batch, wavelength: float) -> Tensor:
    """How far a vertex may lie from f = 0 [m], per vertex."""
    exact = ON_SURFACE * torch.clamp(world.size[batch.which], min=1.0)
    relief = torch.full_like(exact, zone.RELIEF * wavelength)
    return torch.where(
        world.exact[batch.which], exact, torch.minimum(relief, 0.05 * world.size[batch.which])
    )
