"""The search: which objects, in which order, may a wave visit between these radios? No gradients.

Sequences of faces are enumerated (``sequences``) where that is affordable. Elsewhere rays are launched
from each radio of the side that has fewer, in rounds of as many as all before: the sub-lattices of one
Fibonacci lattice. At every boundary that a ray enters, its mirror image is a new ray; the ray itself
goes straight on. Each carries the tube it stands for (``tubes``), so a reflected ray knows which of the
other side's radios its tube may hold; those make candidate chains (objects, patches), each kept once
with the ray that came closest as its seed (``candidates``). A round that finds no new one is the last.
Nothing here decides what a path is worth: ``solve`` and ``field`` do.
"""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.contract import Crossing
from rfsg.objects.shapes.kept import BAKE_AFTER
from rfsg.scene.world import World
from rfsg.tracer.bounds import Floor, least_product
from rfsg.tracer.candidates import Candidacy
from rfsg.tracer.embree import Proxies
from rfsg.tracer.faces import planes_of
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.lattice import fibonacci, rounds, spacing
from rfsg.tracer.march import FORWARD, MarchOptions, crossings
from rfsg.tracer.places import Places
from rfsg.tracer.plan import Quality
from rfsg.tracer.prefixes import TooMany
from rfsg.tracer.records import Chains, Crossings, Only, Rays
from rfsg.tracer.sequences import enumerate_chains
from rfsg.tracer.tubes import Tubes, first_tubes, mirrored


@dataclass
class Round:
    """Rays launched at a time, from all radios together, and the chains that they were the first to
    meet."""

    rays: int = 0
    found: int = 0


@dataclass
class SearchReport:
    """How paths were looked for.

    asked: rays that the quality allows, of which ``rays`` were launched. once: chains of planar mirrors
    that one ray alone met; once_curved: others. Of those of planar mirrors only the ones that a path
    can be folded onto count, here and in ``rounds``; of the others all, and most come to nothing.
    pruned: hits below the power floor, or beginnings of sequences that nothing can lift above it.
    complete: every sequence of faces was looked at, nothing can be missing. enumerated: sequences
    were; restricted: to those that were asked for (``Only``).
    """

    rays: int = 0
    asked: int = 0
    hits: int = 0
    candidates: int = 0
    pruned: int = 0
    once: int = 0
    once_curved: int = 0
    complete: bool = False
    enumerated: bool = False
    restricted: bool = False
    launched_from: str = "transmitters"
    per_depth: list[int] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)

    def sentence(self) -> str:
        """How the paths were looked for and what may be missing, for the report."""
        candidates = f"{self.candidates} candidate paths in all"
        if self.enumerated:
            what = "every sequence of faces" + " with at most one curved" * (not self.complete)
            dropped = f"; {self.pruned} beginnings of sequences cannot reach the power floor"
            return f"search: {what}, {candidates}{dropped * (self.pruned > 0)}"
        dropped = f"; {self.pruned} hits below the power floor"
        return f"search: {self._evidence()}{candidates}{dropped * (self.pruned > 0)}"

    def _evidence(self) -> str:
        """What each round found, and what another would.

        Chains that one ray alone met are as many as further rays, as many again, would be the first to
        meet, on average and at most (Good and Toulmin 1956: n_1 - n_2 + n_3 - ..., where n_k chains
        were met by k rays; its first term is a bound).
        """
        if not self.rounds:
            return f"{self.rays} rays launched, "
        rays, found = (
            " + ".join(str(getattr(r, name)) for r in self.rounds) for name in ("rays", "found")
        )
        curved = f" and {self.once_curved} candidates on curved faces" * (self.once_curved > 0)
        return (
            f"{self.rays} of {self.asked} rays launched from the {self.launched_from}, in rounds of "
            f"{rays} that found {found} chains; as many again may find {self.once} more{curved} (so "
            "many were met by one ray alone); "
        )


@torch.no_grad()
def search(
    world: World,
    proxies: Proxies,
    tx_position: Float[Tensor, "t 3"],
    rx_position: Float[Tensor, "r 3"],
    frequency: Float[Tensor, "f"],
    quality: Quality,
    only: Only | None = None,
) -> tuple[Chains, SearchReport]:
    """Candidate chains between every transmitter and every receiver, direct ones included.

    Enumerated (``sequences``) where that is complete and affordable, else searched by rays; either
    way from the side with fewer radios. only: which of the enumerated chains, if not all; rays find
    all. Raises ValueError when an enumeration that was insisted on is too large.
    """
    report = SearchReport()
    depth = quality.depth if len(world) else 0
    # one curved face in a sequence can be enumerated, several only where there are none
    few = quality.curved < 2 or all(n.body.shape.faceted for n in world.scene.nodes)
    direct = _direct(len(tx_position), len(rx_position), depth, world.device)
    ends = tx_position, rx_position
    chains = None
    if depth and quality.search != "rays" and (few or quality.search == "enumerate"):
        try:
            chains = _enumerated(world, *ends, frequency, quality, only, report)
            report.complete, report.enumerated = few, True
            if only is not None:
                direct = direct.take(only.tx[direct.tx] | only.rx[direct.rx])
                report.restricted = True
        except TooMany:
            if quality.search == "enumerate":
                raise ValueError(
                    "search='enumerate': the scene has too many sequences of faces at "
                    f"depth {depth}; lower the depth or search by rays"
                ) from None
    if depth and chains is None:
        chains = _by_rays(world, proxies, *ends, frequency, quality, report)
    parts = [direct] if chains is None else [direct, chains]
    chains = Chains.joined(parts)
    if len(world) and depth:
        chains = chains.take(_followed(world, chains.which, chains.patch, quality))
    report.candidates = len(chains.tx)
    return chains, report


def _enumerated(
    world: World,
    tx_position: Tensor,
    rx_position: Tensor,
    frequency: Tensor,
    quality: Quality,
    only: Only | None,
    report: SearchReport,
) -> Chains:
    """All sequences of faces, begun from the side with fewer radios."""
    wavelength = SPEED_OF_LIGHT / float(frequency[0])  # as ``solve`` measures faces
    floor = Floor.of(world, planes_of(world), frequency, quality)
    back = len(rx_position) < len(tx_position)
    ends = (rx_position, tx_position) if back else (tx_position, rx_position)
    if only is not None and back:
        only = replace(only, tx=only.rx, rx=only.tx)
    chains = enumerate_chains(world, *ends, wavelength, quality, only, floor)
    report.pruned = 0 if floor is None else floor.pruned
    return turned(chains) if back else chains


def _by_rays(
    world: World,
    proxies: Proxies,
    tx_position: Tensor,
    rx_position: Tensor,
    frequency: Tensor,
    quality: Quality,
    report: SearchReport,
) -> Chains:
    """Chains that rays from the side with fewer radios find."""
    back = _from_receivers(tx_position, rx_position)
    sources, targets = (rx_position, tx_position) if back else (tx_position, rx_position)
    report.launched_from = "receivers" if back else "transmitters"
    report.asked = quality.rays * len(sources)
    report.per_depth = [0] * quality.depth
    places = Places(targets)
    parts = [_no_chains(quality.depth, world.device)]
    for t, source in enumerate(sources):
        found = Candidacy(world, t, source, places, quality.depth)
        _in_rounds(world, proxies, found, frequency, quality, report)
        parts += [candidates.chains for candidates in found.found.values()]
        planar, curved = found.once()
        report.once += planar
        report.once_curved += curved
    chains = Chains.joined(parts)
    return turned(chains) if back else chains


def _in_rounds(
    world: World,
    proxies: Proxies,
    found: Candidacy,
    frequency: Tensor,
    quality: Quality,
    report: SearchReport,
) -> None:
    """Launch rays from one radio, round by round, until one finds no new chain or all are launched."""
    direction = fibonacci(quality.rays, world.device)
    launched = 0
    for number, some in enumerate(rounds(quality.rays)):
        launched += len(direction[some])
        # the widest tubes first: each round is an even lattice together with those before it
        tubes = first_tubes(found.source, direction[some], spacing(launched))
        if number == len(report.rounds):
            report.rounds.append(Round())
        this, new = report.rounds[number], 0
        this.rays += len(tubes)
        report.rays += len(tubes)
        for level in range(quality.depth):
            tubes = _bounce(world, proxies, tubes, frequency, quality, report)
            report.per_depth[level] += len(tubes)
            if not len(tubes):
                break
            new += found.receive(tubes, spacing(launched))
        this.found += new
        if number and not new:
            break


def _from_receivers(tx_position: Float[Tensor, "t 3"], rx_position: Float[Tensor, "r 3"]) -> bool:
    """Whether rays start at the receivers: the fewer, or of as many those that come first.

    A choice that knows nothing of who sends: both directions of a link launch the same rays.
    """
    if len(tx_position) != len(rx_position):
        return len(rx_position) < len(tx_position)
    ahead = (rx_position.sum(0) - tx_position.sum(0)) @ tx_position.new_tensor(FORWARD)
    return bool(ahead < 0)


def turned(chains: Chains) -> Chains:
    """The same chains, each from its other end: transmitters are receivers, and the reverse."""
    depth = chains.which.shape[1]
    last = (chains.which >= 0).sum(1, keepdim=True) - 1
    place = last - torch.arange(depth, device=last.device)
    there = place >= 0
    place = place.clamp(min=0)
    which, patch = (
        torch.where(there, x.gather(1, place), -1) for x in (chains.which, chains.patch)
    )
    seed = chains.seed.gather(1, place[..., None].expand_as(chains.seed))
    return Chains(chains.rx, chains.tx, which, patch, torch.where(there[..., None], seed, 0.0))


def _followed(
    world: World, which: Int[Tensor, "c d"], patch: Int[Tensor, "c d"], quality: Quality
) -> Bool[Tensor, "c"]:
    """Sequences with no more reflections on curved or learned faces than the quality follows."""
    met = which >= 0
    curved = (met & ~world.is_planar(which.clamp(min=0), patch.clamp(min=0))).sum(1)
    return (curved == 0) | ((curved <= quality.curved) & (met.sum(1) <= quality.curved_depth))


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
    return Tubes.joined(parts)


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
    floor = least_product(world, quality)
    bound = tubes.bound[inside.ray] * before
    strong = bound > floor
    report.pruned += int((entered & ~strong).sum())
    i = torch.nonzero(entered & strong).squeeze(-1)
    grown = mirrored(world, tubes, inside, i, bound[i], frequency, floor)
    which, patch = grown.history.unbind(-1)
    return grown.take(torch.nonzero(_followed(world, which, patch, quality)).squeeze(-1))


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


def _direct(n_tx: int, n_rx: int, depth: int, device: torch.device) -> Chains:
    tx = torch.arange(n_tx, device=device).repeat_interleave(n_rx)
    rx = torch.arange(n_rx, device=device).repeat(n_tx)
    none = torch.full((len(tx), depth), -1, dtype=torch.int64, device=device)
    seed = torch.zeros(len(tx), depth, 3, dtype=torch.float64, device=device)
    return Chains(tx, rx, none, none.clone(), seed)


def _no_chains(depth: int, device: torch.device) -> Chains:
    return _direct(0, 0, depth, device)
