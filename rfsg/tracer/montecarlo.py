"""The paper's own estimator: rays carry power, a sphere or a cell collects it (section 4.3).

A transmitter of unit power sends K rays of 1/K each. A ray's weight is multiplied by |R|^2 where it
reflects and |T|^2 where it goes through. What crosses a small disc of area A, divided by A, is power
density; times lambda^2 / 4 pi it is the power of an isotropic receiver. So the sum over rays carries
1/K and 1/(pi rho^2), and converges to the path solver's sum of |c_l|^2 (phases averaged out).

Two ways to branch. ``enumerate``: reflections are new rays and the ray goes on: no dice. ``draw``: the
paper's literal rule: at each boundary one of the two is drawn and the weight divided by its
probability. At f = 0 Eqs. 13 and 14 give sigma_in = sigma_out, so for a learned surface the paper's
p ~ sigma is a fair coin; known materials are drawn by |R|^2 : |T|^2.

Where diffuse reflection is followed, a rough surface sends on a second ray in a direction drawn from
its lobe, with the diffuse share of the power (``draw``: one of the two, by their powers). A ray scatters
once, like a path of the solver; so at a depth of 2 the two hold the same orders.

The lattice is shot in several turned copies; their scatter is the reported standard error. Copies fly
together, as many as asked for: each draws from a generator of its own, so company changes nothing.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact
from rfsg.objects.physics.lobes import mirrored
from rfsg.scene.radios import Radio, amplitude
from rfsg.scene.scene import Scene
from rfsg.scene.world import World
from rfsg.tracer.acting import scalar
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.lattice import fibonacci
from rfsg.tracer.launch import ended_before, search_options, transmission_of
from rfsg.tracer.march import crossings
from rfsg.tracer.plan import Quality
from rfsg.tracer.ports import Antennas
from rfsg.tracer.records import Crossings, Rays
from rfsg.tracer.scatter import rough_nodes
from rfsg.tracer.simulate import positions, resolve_frequency, world_for
from rfsg.tracer.tubes import LEARNED_LIFT

COPIES = 8  # turned copies of the lattice; eight give the standard error to about a quarter
MEETINGS = 1_000_000  # of rays and receivers looked at at a time


@dataclass(frozen=True)
class Lattice:
    """A turned copy of the lattice about a transmitter; all else that is random of it is drawn from the
    generator."""

    transmitter: Radio
    position: Float[Tensor, "3"]
    turn: Float[Tensor, "3 3"]
    generator: torch.Generator


@dataclass(frozen=True)
class Flight:
    """Rays of one bounce level and what they meet: collect along ``rays`` up to ``end`` [m].

    ``lattice`` [r] is the copy that each ray belongs to, ``weight`` [r] the power at the start, in
    shares of the transmitter's; ``toll`` [m] the loss -ln |T|^2 (with the draw's 1/p) of each crossing,
    paid where it is left.
    """

    rays: Rays
    lattice: Int[Tensor, "r"]
    weight: Float[Tensor, "r"]
    end: Float[Tensor, "r"]
    inside: Crossings
    toll: Float[Tensor, "m"]

    def power_at(self, ray: Int[Tensor, "k"], distance: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
        """Weight of rays at distances along them, everything left behind paid.

        What lets nothing through is paid where it is entered: it is dark inside.
        """
        paid = torch.zeros_like(distance)
        due = torch.where(torch.isinf(self.toll), self.inside.enter, self.inside.leave)
        count = torch.bincount(self.inside.ray, minlength=len(self.weight))
        first = torch.cumsum(count, 0) - count
        for k in range(int(count.max()) if len(self.inside.ray) else 0):
            has = torch.nonzero(count[ray] > k).squeeze(-1)
            i = first[ray[has]] + k
            behind = due[i] <= distance[has]
            paid[has] += torch.where(behind, self.toll[i], torch.zeros_like(self.toll[i]))
        alive = (distance <= self.end[ray]) & torch.isfinite(paid)
        return torch.where(alive, self.weight[ray] * torch.exp(-paid), torch.zeros_like(paid))


@dataclass(frozen=True)
class _Sent:
    """Rays under way: their lattice, their power, and whether they have yet to scatter (``fresh``)."""

    rays: Rays
    lattice: Int[Tensor, "r"]
    weight: Float[Tensor, "r"]
    fresh: Bool[Tensor, "r"]

    def none(self) -> "_Sent":
        """None of them."""
        return _Sent(self.rays.take(slice(0)), self.lattice[:0], self.weight[:0], self.fresh[:0])


@torch.no_grad()
def flights(
    world: World,
    proxies: Proxies,
    lattices: Sequence[Lattice],
    frequency: Float[Tensor, "1"],
    quality: Quality,
    branching: str,
) -> Iterator[Flight]:
    """The flights of some turned copies of the lattice together, bounce level by bounce level."""
    if branching not in ("enumerate", "draw"):
        raise ValueError(f"branching {branching!r}: expected 'enumerate' or 'draw'")
    generators = [lattice.generator for lattice in lattices]
    sent = _launched(lattices, quality, world.device)
    for level in range(quality.depth + 1):
        last = level == quality.depth
        flight, sent = _fly(world, proxies, sent, frequency, quality, branching, generators, last)
        yield flight
        if not len(sent.weight):
            break


def _launched(lattices: Sequence[Lattice], quality: Quality, device: torch.device) -> _Sent:
    """The rays of all lattices, those of one after those of another."""
    count = per_round(quality)
    even = fibonacci(count, device)
    turned = [even @ lattice.turn.to(device) for lattice in lattices]
    patterns = [
        amplitude(lattice.transmitter, d @ lattice.transmitter.rotation.to(d))
        for lattice, d in zip(lattices, turned, strict=True)
    ]
    direction, weight = torch.cat(turned), torch.cat(patterns) ** 2 / count
    which = torch.arange(len(lattices), device=device).repeat_interleave(count)
    origin = torch.stack([lattice.position for lattice in lattices])[which]
    endless = torch.full_like(weight, torch.inf)
    fresh = torch.full_like(which, quality.diffuse > 0, dtype=torch.bool)
    return _Sent(Rays(origin, direction, endless), which, weight, fresh)


def per_round(quality: Quality) -> int:
    """Rays of one turned copy of the lattice."""
    return max(1, quality.map_rays // COPIES)


class Draws:
    """Turns and generators of copies, one after the other: those of the n-th hang on the seed alone."""

    def __init__(self, seed: int):
        self._turns, self._seeds = (torch.Generator().manual_seed(seed) for _ in range(2))

    def next(self) -> tuple[Float[Tensor, "3 3"], torch.Generator]:
        seed = int(torch.randint(2**62, (1,), generator=self._seeds))
        return _turn(self._turns), torch.Generator().manual_seed(seed)


def _turn(generator: torch.Generator) -> Tensor:
    """A random rotation (QR of a Gaussian matrix, Haar-distributed up to sign)."""
    q, r = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    return q * torch.sign(torch.diagonal(r))


def _uniform(
    lattice: Int[Tensor, "k"], generators: Sequence[torch.Generator], columns: int
) -> Float[Tensor, "k columns"]:
    """Numbers between 0 and 1, each drawn from the generator of the lattice that asks for it."""
    drawn = torch.empty(len(lattice), columns, dtype=torch.float64, device=lattice.device)
    for number, generator in enumerate(generators):
        i = torch.nonzero(lattice == number).squeeze(-1)
        drawn[i] = torch.rand(len(i), columns, dtype=torch.float64, generator=generator).to(drawn)
    return drawn


def _fly(
    world: World,
    proxies: Proxies,
    sent: _Sent,
    frequency: Tensor,
    quality: Quality,
    branching: str,
    generators: Sequence[torch.Generator],
    last: bool,
) -> tuple[Flight, _Sent]:
    """One level of rays, and those that they send on, after the ``last`` none."""
    rays, lattice, weight, fresh = sent.rays, sent.lattice, sent.weight, sent.fresh
    inside = crossings(world, rays, proxies.spans(rays), search_options(quality, quality.map_rays))
    m, owner = len(inside.ray), lattice[inside.ray]
    every = torch.arange(m, device=world.device)
    t = scalar(transmission_of(world, rays, inside, every, frequency))[:, 0].abs() ** 2
    if last and branching == "enumerate":  # what reflects is of no account
        toll = torch.where(t <= 0, torch.inf, -torch.log(t.clamp(min=1e-300)))
        return Flight(rays, lattice, weight, rays.limit, inside, toll), sent.none()
    r, point, outgoing, front = _reflections(world, rays, inside, frequency)
    may = front & fresh[inside.ray]
    aside = _scattered(world, rays, inside, may, frequency, owner, generators)
    if branching == "draw":
        whole = r + aside.power
        share = torch.where(
            world.learned_surface[inside.which], 0.5, whole / (whole + t).clamp(min=1e-300)
        )
        share = torch.where(front, share, torch.zeros_like(share))
        drawn = _uniform(owner, generators, 1)[:, 0] < share
        toll = -torch.log((t / (1 - share).clamp(min=1e-300)).clamp(min=1e-300))
        gain = whole / share.clamp(min=1e-300)
    else:
        drawn, toll, gain = front, -torch.log(t.clamp(min=1e-300)), r
    toll = torch.where(t <= 0, torch.inf, toll)
    before = ended_before(inside, toll)
    arriving = weight[inside.ray] * torch.exp(-before)
    end = rays.limit.clone()
    if branching == "draw":
        # a ray that was turned aside ends where it first was
        turned = torch.where(drawn, inside.enter, torch.inf)
        end = end.scatter_reduce(0, inside.ray, turned, "amin")
        drawn = drawn & (inside.enter <= end[inside.ray])
        kinds = _either(r, outgoing, aside, gain, owner, generators)
    else:
        still = torch.zeros_like(drawn)
        kinds = [(outgoing, gain, ~still), (aside.direction, aside.power * aside.weight, still)]
    strongest = weight.new_zeros(len(generators)).scatter_reduce(0, lattice, weight, "amax")
    floor = (strongest * 10.0 ** (quality.floor_db / 10.0))[owner]
    parts = []
    for direction, power, straight in kinds:
        i = torch.nonzero(drawn & (arriving * power > floor)).squeeze(-1)
        kept = fresh[inside.ray[i]] & straight[i]
        parts.append((point[i], direction[i], owner[i], (arriving * power)[i], kept))
    origin, direction, whose, power, kept = (torch.cat(c) for c in zip(*parts, strict=True))
    onward = Rays(origin, direction, torch.full_like(power, torch.inf))
    flight = Flight(rays, lattice, weight, end, inside, toll)
    return flight, sent.none() if last else _Sent(onward, whose, power, kept)


@dataclass(frozen=True)
class _Aside:
    """What scatters at each crossing: its power, and a direction drawn with the weight p / q."""

    power: Float[Tensor, "m"]
    direction: Float[Tensor, "m 3"]
    weight: Float[Tensor, "m"]


def _scattered(
    world: World,
    rays: Rays,
    inside: Crossings,
    may: Tensor,
    frequency: Tensor,
    owner: Int[Tensor, "m"],
    generators: Sequence[torch.Generator],
) -> _Aside:
    """Nothing where the surface is smooth, or a ray may not scatter."""
    d, normal = rays.direction[inside.ray], inside.normal_enter
    power, weight = torch.zeros_like(inside.enter), torch.ones_like(inside.enter)
    direction = d.clone()
    i = torch.nonzero(may & rough_nodes(world)[inside.which]).squeeze(-1)
    if not len(i):
        return _Aside(power, direction, weight)
    which, point = inside.which[i], rays.origin[inside.ray[i]] + inside.enter[i, None] * d[i]
    contact = Contact(point, d[i], mirrored(d[i], normal[i]), normal[i])
    power[i] = scalar(world.diffuse(which, contact, frequency))[:, 0].abs() ** 2
    uniform = _uniform(owner[i], generators, 4)
    for body, j in world.surface_groups(which):
        assert body.scattering is not None
        k = i[j]
        direction[k], weight[k] = body.scattering.draw(d[k], normal[k], uniform[j])
    return _Aside(power, direction, weight)


def _either(
    r: Tensor,
    outgoing: Tensor,
    aside: _Aside,
    gain: Tensor,
    owner: Int[Tensor, "m"],
    generators: Sequence[torch.Generator],
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Of mirror and diffuse ray one, drawn by their powers: (direction, power, whether mirrored)."""
    if not bool(aside.power.any()):
        return [(outgoing, gain, torch.ones_like(r, dtype=torch.bool))]
    chance = aside.power / (r + aside.power).clamp(min=1e-300)
    off = _uniform(owner, generators, 1)[:, 0] < chance
    direction = torch.where(off[:, None], aside.direction, outgoing)
    return [(direction, torch.where(off, gain * aside.weight, gain), ~off)]


def _reflections(
    world: World, rays: Rays, inside: Crossings, frequency: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """|R|^2, lifted points, mirrored directions, and which crossings have an entry to reflect on."""
    d, normal = rays.direction[inside.ray], inside.normal_enter
    cosine = -(d * normal).sum(-1)
    front = (cosine > 0) & (inside.enter > 0)
    point = rays.origin[inside.ray] + inside.enter[:, None] * d
    out = d + 2.0 * cosine[:, None] * normal
    r = torch.zeros(len(front), dtype=torch.float64, device=world.device)
    i = torch.nonzero(front).squeeze(-1)
    if len(i):
        contact = Contact(point[i], d[i], out[i], normal[i])
        r[i] = scalar(world.reflection(inside.which[i], contact, frequency))[:, 0].abs() ** 2
    scale = torch.maximum(world.size[inside.which], point.abs().amax(-1))
    lift = torch.where(world.exact[inside.which], 1e-12 * scale, LEARNED_LIFT)
    return r, point + lift[:, None] * normal, out, front


@torch.no_grad()
def estimate_power(
    scene: Scene,
    frequency: float | None = None,
    quality: str | Quality = "standard",
    *,
    radius: float = 0.1,
    branching: str = "draw",
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> tuple[Float[Tensor, "t r"], Float[Tensor, "t r"]]:
    """Incoherent path gain by reception spheres of ``radius`` [m], and its standard error.

    Converges to ``channel.power`` of the path solver as rays grow and the radius shrinks.
    """
    quality = Quality.named(quality) if isinstance(quality, str) else quality
    f = resolve_frequency(scene, frequency)[:1].to(device)
    world = world_for(scene, quality, device)
    proxies = Proxies(world)
    tx, rx = (positions(x, device) for x in (scene.transmitters, scene.receivers))
    per_copy = torch.zeros(COPIES, len(tx), len(rx), dtype=torch.float64, device=device)
    aperture = float((SPEED_OF_LIGHT / f) ** 2) / (4 * math.pi)
    antennas = Antennas(scene.receivers, world.device)
    for t, radio in enumerate(scene.transmitters):
        draws = Draws(seed)
        for copy in per_copy:
            lattice = Lattice(radio, tx[t], *draws.next())
            for flight in flights(world, proxies, [lattice], f, quality, branching):
                copy[t] += _collected(flight, antennas, rx, radius)
    per_copy *= aperture / (math.pi * radius**2)
    return per_copy.mean(0), per_copy.std(0) / COPIES**0.5


def _collected(
    flight: Flight, antennas: Antennas, position: Float[Tensor, "r 3"], radius: float
) -> Float[Tensor, "r"]:
    """What the spheres about the receivers collect of the rays that meet them."""
    rays, power = flight.rays, torch.zeros_like(position[:, 0])
    every = torch.arange(len(rays.limit), device=power.device)
    for i in every.split(max(1, MEETINGS // max(1, len(position)))):
        away = position[None] - rays.origin[i, None]
        along = torch.einsum("irc,ic->ir", away, rays.direction[i])
        square = torch.einsum("irc,irc->ir", away, away) - along * along
        k, r = torch.nonzero((square < radius**2) & (along > 0), as_tuple=True)
        weight = flight.power_at(i[k], along[k, r])
        pattern = antennas.patterns(r, -rays.direction[i[k]])
        power.index_add_(0, r, weight * pattern**2)
    return power
