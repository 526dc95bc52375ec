"""The search: which objects, in which order, may a wave visit between these radios? No gradients.

From each transmitter a Fibonacci lattice of rays. At every boundary that a ray enters, its mirror
image is a new ray; the ray itself goes straight on. Each ray carries the half-width and divergence of
the tube it stands for, so a reflected ray knows which receivers its tube may hold; those make
candidate chains (objects, patches), each kept once with the ray that came closest as its seed.
Nothing here decides what a path is worth: ``solve`` and ``field`` do.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact, Crossing
from rfsg.objects.shapes.kept import BAKE_AFTER
from rfsg.scene.world import World
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.march import MarchOptions, crossings
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Chains, Crossings, Rays
from rfsg.tracer.sequences import TooMany, enumerate_chains

TUBE = 2.0  # tubes this much wider than the lattice's spacing: a ray near an edge speaks for its neighbours
WIDEST = 1.0  # [rad] a tube bent at a sharp edge diverges no further than this
STEEPEST = 0.1  # least cosine in the bending of tubes: grazing tubes would widen without end


@dataclass
class SearchReport:
    rays: int = 0
    hits: int = 0
    sequences: int = 0
    candidates: int = 0
    pruned: int = 0  # hits below the power floor
    complete: bool = False  # every sequence of faces was looked at: nothing can be missing
    per_depth: list[int] = field(default_factory=list)

    def sentence(self) -> str:
        """How the paths were looked for, for the report."""
        if self.complete:
            return f"search: every sequence of faces, {self.candidates} candidate paths in all"
        return f"search: {self.rays} rays launched, {self.candidates} candidate paths in all"


@dataclass
class Tubes:
    """Rays under way from one transmitter: geometry, tube, amplitude bound, and their history."""

    rays: Rays
    width: Float[Tensor, "r"]  # half-width at the origin [m]
    spread: Float[Tensor, "r"]  # growth of the half-width [m per m]
    bound: Float[Tensor, "r"]  # amplitude, relative to free space over the same length, at most
    history: Int[Tensor, "r d 2"]  # (node, patch) of the reflections so far
    vertices: Float[Tensor, "r d 3"]

    def __len__(self) -> int:
        return self.width.shape[0]

    def take(self, i: Tensor | slice) -> "Tubes":
        rays = self.rays.take(i)
        return Tubes(
            rays, self.width[i], self.spread[i], self.bound[i], self.history[i], self.vertices[i]
        )


def fibonacci(count: int, device: torch.device | str = "cpu") -> Float[Tensor, "count 3"]:
    """Nearly even directions on the sphere (Gonzalez 2010, 'Measurement of areas on a sphere')."""
    i = torch.arange(count, dtype=torch.float64, device=device) + 0.5
    z = 1.0 - 2.0 * i / count
    r = torch.sqrt((1.0 - z) * (1.0 + z))
    angle = torch.pi * (3.0 - 5.0**0.5) * i
    return torch.stack([r * torch.cos(angle), r * torch.sin(angle), z], -1)


@torch.no_grad()
def search(
    world: World,
    proxies: Proxies,
    tx_position: Float[Tensor, "t 3"],
    rx_position: Float[Tensor, "r 3"],
    frequency: Float[Tensor, "f"],
    quality: Quality,
) -> tuple[Chains, SearchReport]:
    """Candidate chains between every transmitter and every receiver, direct ones included.

    Enumerated (``sequences``) where that is complete and affordable, else searched by rays. Raises
    ValueError when an enumeration that was insisted on is too large.
    """
    report = SearchReport()
    depth = quality.depth if len(world) else 0
    # one curved face in a sequence can be enumerated, several only where there are none
    few = quality.curved < 2 or all(n.body.shape.faceted for n in world.scene.nodes)
    parts = [_direct(len(tx_position), len(rx_position), depth, world.device)]
    if depth and quality.search != "rays" and (few or quality.search == "enumerate"):
        try:
            wavelength = SPEED_OF_LIGHT / float(frequency[0])  # as ``solve`` measures faces
            parts.append(enumerate_chains(world, tx_position, rx_position, wavelength, quality))
            report.complete = few
        except TooMany:
            if quality.search == "enumerate":
                raise ValueError(
                    "search='enumerate': the scene has too many sequences of faces at "
                    f"depth {depth}; lower the depth or search by rays"
                ) from None
    for t in range(len(tx_position) if depth and len(parts) == 1 else 0):
        tubes = first_tubes(tx_position[t], quality)
        report.rays += len(tubes)
        for _ in range(depth):
            tubes = _bounce(world, proxies, tubes, frequency, quality, report)
            report.per_depth.append(len(tubes))
            if not len(tubes):
                break
            parts.append(_receive(tubes, t, rx_position, depth, quality, report))
    chains = _few_curved(world, Chains.joined(parts), quality)
    report.candidates = len(chains.tx)
    return chains, report


def _few_curved(world: World, chains: Chains, quality: Quality) -> Chains:
    """Chains with no more reflections on curved or learned faces than the quality follows."""
    if not len(world) or not chains.which.numel():
        return chains
    planar = world.is_planar(chains.which.clamp(min=0), chains.patch.clamp(min=0))
    curved = (~planar & (chains.which >= 0)).sum(1)
    order = (chains.which >= 0).sum(1)
    few = (curved == 0) | ((curved <= quality.curved) & (order <= quality.curved_depth))
    return chains.take(torch.nonzero(few).squeeze(-1))


def first_tubes(position: Float[Tensor, "3"], quality: Quality) -> Tubes:
    """The lattice of rays from one transmitter."""
    n, device = quality.rays, position.device
    direction = fibonacci(n, device)
    zero = torch.zeros(n, dtype=torch.float64, device=device)
    spacing = (4.0 * torch.pi / n) ** 0.5
    return Tubes(
        Rays(position.expand(n, 3).clone(), direction, zero + torch.inf),
        zero,
        zero + spacing,
        zero + 1.0,
        torch.zeros(n, 0, 2, dtype=torch.int64, device=device),
        torch.zeros(n, 0, 3, dtype=torch.float64, device=device),
    )


def _bounce(
    world: World,
    proxies: Proxies,
    tubes: Tubes,
    frequency: Tensor,
    quality: Quality,
    report: SearchReport,
) -> Tubes:
    parts = []
    for begin in range(0, len(tubes), quality.chunk):
        piece = tubes.take(slice(begin, begin + quality.chunk))
        parts.append(_bounce_chunk(world, proxies, piece, frequency, quality, report))
    return join(parts)


def join(parts: list[Tubes]) -> Tubes:
    if len(parts) == 1:
        return parts[0]
    rays = Rays(
        *(torch.cat([getattr(p.rays, n) for p in parts]) for n in Rays.__dataclass_fields__)
    )
    names = ("width", "spread", "bound", "history", "vertices")
    return Tubes(rays, *(torch.cat([getattr(p, n) for p in parts]) for n in names))


def search_options(quality: Quality, rays: int) -> MarchOptions:
    """How a search of so many rays marches: a tenth of the paper's epsilon as the least step, sign
    changes only. A way other than the certain one needs baked shapes, however few the rays."""
    return MarchOptions(
        step_floor=0.1 * quality.epsilon,
        chunk=quality.chunk,
        rays=rays if quality.intersection == "certain" else max(rays, BAKE_AFTER),
        intersection=quality.intersection,
    )


def _bounce_chunk(
    world: World,
    proxies: Proxies,
    tubes: Tubes,
    frequency: Tensor,
    quality: Quality,
    report: SearchReport,
) -> Tubes:
    spans = proxies.spans(tubes.rays)
    inside = crossings(world, tubes.rays, spans, search_options(quality, quality.rays))
    before = amplitude_before(world, tubes.rays, inside, frequency)
    report.hits += len(inside.ray)
    entered = (inside.enter > 0) & (inside.normal_enter.abs().sum(-1) > 0)
    floor = 10.0 ** (quality.floor_db / 20.0)
    bound = tubes.bound[inside.ray] * before
    strong = bound > floor
    report.pruned += int((entered & ~strong).sum())
    i = torch.nonzero(entered & strong).squeeze(-1)
    return _reflect(world, tubes, inside, i, bound[i], frequency, floor)


def amplitude_before(
    world: World, rays: Rays, inside: Crossings, frequency: Float[Tensor, "f"]
) -> Float[Tensor, "m"]:
    """Largest amplitude that can reach each crossing through those before it on its ray.

    Learned surfaces are let through whole (an upper bound that needs no network).
    """
    loss = torch.zeros(len(inside.ray), dtype=torch.float64, device=world.device)
    opaque = world.opaque[inside.which]
    loss[opaque] = torch.inf
    known = torch.nonzero(~opaque & ~world.learned_surface[inside.which]).squeeze(-1)
    if len(known):
        t = transmission_of(world, rays, inside, known, frequency)
        strongest = t.abs().amax(-1).amax(-1)
        loss[known] = -torch.log(strongest.clamp(min=1e-300))
    # a crossing that begins inside another begins before that one has taken its toll: order by
    # where they end, and charge each with those that ended before it begins
    return torch.exp(-ended_before(inside, loss))


def ended_before(inside: Crossings, loss: Float[Tensor, "m"]) -> Float[Tensor, "m"]:
    """Sum of the losses of crossings on the same ray that end no later than each one begins."""
    m = len(loss)
    if not m:
        return loss
    total = torch.zeros_like(loss)
    first = torch.ones(m, dtype=torch.bool, device=loss.device)
    first[1:] = inside.ray[1:] != inside.ray[:-1]
    start = torch.cummax(torch.where(first, torch.arange(m, device=loss.device), 0), 0).values
    position = torch.arange(m, device=loss.device) - start
    slack = 1e-9 * (1.0 + inside.enter.abs())  # flush faces meet to rounding
    for shift in range(1, int(position.max()) + 1):
        a = torch.nonzero(position >= shift).squeeze(-1)
        ended = inside.leave[a - shift] <= inside.enter[a] + slack[a]
        total[a] += torch.where(ended, loss[a - shift], torch.zeros_like(loss[a]))
    return total


def transmission_of(
    world: World, rays: Rays, inside: Crossings, i: Int[Tensor, "k"], frequency: Float[Tensor, "f"]
) -> Complex[Tensor, "k f 2"]:
    """(TE, TM) transmission of a selection of crossings; half-spaces that never end pass nothing."""
    ray, which = inside.ray[i], inside.which[i]
    o, d = rays.origin[ray], rays.direction[ray]
    leave = torch.where(torch.isfinite(inside.leave[i]), inside.leave[i], inside.enter[i])
    crossing = Crossing(
        o + inside.enter[i, None] * d,
        o + leave[:, None] * d,
        inside.normal_enter[i],
        inside.normal_leave[i],
    )
    return world.transmission(which, crossing, frequency)


def _reflect(
    world: World,
    tubes: Tubes,
    inside: Crossings,
    i: Tensor,
    bound: Tensor,
    frequency: Tensor,
    floor: float,
) -> Tubes:
    """The mirror images of rays at chosen entries."""
    ray, which, t, normal = inside.ray[i], inside.which[i], inside.enter[i], inside.normal_enter[i]
    d = tubes.rays.direction[ray]
    cosine = -(d * normal).sum(-1)
    front = cosine > 0
    ray, which, t, normal, d, cosine, bound = (
        x[front] for x in (ray, which, t, normal, d, cosine, bound)
    )
    point = tubes.rays.origin[ray] + t[:, None] * d
    out = d + 2.0 * cosine[:, None] * normal
    bound = bound * _reflected_at_most(world, which, point, d, out, normal, frequency)
    width = tubes.width[ray] + tubes.spread[ray] * t
    bend = 2.0 * _curvature(world, which, point) * width / cosine.clamp(min=STEEPEST)
    spread = torch.clamp(tubes.spread[ray] + bend, max=WIDEST)
    patch = world.patch(which, point)
    step = torch.stack([which, patch], -1)[:, None]
    keep = bound > floor
    grown = Tubes(
        Rays(point, out, torch.full_like(t, torch.inf)),
        width,
        spread,
        bound,
        torch.cat([tubes.history[ray], step], 1),
        torch.cat([tubes.vertices[ray], point[:, None]], 1),
    )
    return _lifted(grown.take(torch.nonzero(keep).squeeze(-1)), normal[keep], world)


def _lifted(tubes: Tubes, normal: Tensor, world: World) -> Tubes:
    """Start reflected rays just off their surface: a rounding error must not find it again."""
    which = tubes.history[:, -1, 0]
    exact = world.exact[which]
    scale = torch.maximum(world.size[which], tubes.rays.origin.abs().amax(-1))
    lift = torch.where(exact, 1e-12 * scale, LEARNED_LIFT * torch.ones_like(scale))
    origin = tubes.rays.origin + lift[:, None] * normal
    tubes.rays = Rays(origin, tubes.rays.direction, tubes.rays.limit)
    return tubes


LEARNED_LIFT = 1e-3  # [m] above a searched float32 root and the ripple next to it


def _reflected_at_most(
    world: World,
    which: Tensor,
    point: Tensor,
    incoming: Tensor,
    outgoing: Tensor,
    normal: Tensor,
    frequency: Tensor,
) -> Tensor:
    """Largest |R| over frequency and polarisation."""
    out = torch.ones(len(which), dtype=torch.float64, device=world.device)
    i = torch.nonzero(~world.learned_surface[which]).squeeze(-1)
    if len(i):
        contact = Contact(point[i], incoming[i], outgoing[i], normal[i])
        out[i] = world.reflection(which[i], contact, frequency).abs().amax(-1).amax(-1)
    return out


def _curvature(world: World, which: Tensor, point: Tensor) -> Tensor:
    """Largest curvature of the surface at hits [1/m], up to the size of the tube's own worth."""
    bend = torch.zeros(len(which), dtype=torch.float64, device=world.device)
    flat = world.is_flat(which, point)
    i = torch.nonzero(~flat).squeeze(-1)
    if len(i):
        hessian = world.jet(which[i], point[i], torch.float32).hessian
        bend[i] = hessian.reshape(len(i), 9).norm(dim=-1)
    return bend


def _direct(n_tx: int, n_rx: int, depth: int, device: torch.device) -> Chains:
    tx = torch.arange(n_tx, device=device).repeat_interleave(n_rx)
    rx = torch.arange(n_rx, device=device).repeat(n_tx)
    none = torch.full((len(tx), depth), -1, dtype=torch.int64, device=device)
    seed = torch.zeros(len(tx), depth, 3, dtype=torch.float64, device=device)
    return Chains(tx, rx, none, none.clone(), seed)


def _receive(
    tubes: Tubes,
    t: int,
    rx_position: Tensor,
    depth: int,
    quality: Quality,
    report: SearchReport,
) -> Chains:
    """Chains to every receiver within a reflected tube, once per sequence, by the closest ray."""
    sequence = _sequence(tubes.history)
    report.sequences += int(sequence.max()) + 1 if len(sequence) else 0
    rays, receivers, misses = [], [], []
    block = max(1, quality.chunk * 16 // max(1, len(rx_position)))
    for begin in range(0, len(tubes), block):
        piece = slice(begin, begin + block)
        miss = _miss(tubes.take(piece), rx_position)
        i, r = torch.nonzero(miss < TUBE, as_tuple=True)
        rays.append(i + begin)
        receivers.append(r)
        misses.append(miss[i, r])
    ray, rx, miss = torch.cat(rays), torch.cat(receivers), torch.cat(misses)
    key = sequence[ray] * len(rx_position) + rx
    order = torch.argsort(miss, stable=True)
    order = order[torch.argsort(key[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool, device=order.device)
    first[1:] = key[order][1:] != key[order][:-1]
    best = order[first]
    ray, rx = ray[best], rx[best]
    level = tubes.history.shape[1]
    c = len(ray)
    which = torch.full((c, depth), -1, dtype=torch.int64, device=ray.device)
    patch = which.clone()
    seed = torch.zeros(c, depth, 3, dtype=torch.float64, device=ray.device)
    which[:, :level], patch[:, :level] = tubes.history[ray, :, 0], tubes.history[ray, :, 1]
    seed[:, :level] = tubes.vertices[ray]
    return Chains(torch.full_like(rx, t), rx, which, patch, seed)


def _miss(tubes: Tubes, rx_position: Tensor) -> Float[Tensor, "r n"]:
    """How far each receiver lies from each ray's axis, in half-widths of its tube there."""
    away = rx_position[None] - tubes.rays.origin[:, None]
    along = (away * tubes.rays.direction[:, None]).sum(-1)
    across = torch.sqrt(torch.clamp((away * away).sum(-1) - along**2, min=0.0))
    width = tubes.width[:, None] + tubes.spread[:, None] * along
    return torch.where(along > 0, across / width.clamp(min=1e-300), torch.inf)


def _sequence(history: Int[Tensor, "r d 2"]) -> Int[Tensor, "r"]:
    """A number for each distinct sequence of (node, patch)."""
    flat = history.reshape(history.shape[0], -1)
    return torch.unique(flat, dim=0, return_inverse=True)[1]
