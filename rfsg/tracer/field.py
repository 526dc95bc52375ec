"""From exact paths to the channel: reflections, everything crossed on the way, spreading, antennas.

    c_l(f) = (lambda / 4 pi) S_l  prod R  prod T  g_tx g_rx,     h(f) = sum_l c_l exp(-j 2 pi f tau_l)

Free space is a factor, not an exponent of Eq. 24: S_l is 1/r there. T is relative to free space over
the same stretch, because the delay already counts it. Differentiable in everything but the choice of
paths: the ends of crossings carry gradients by the implicit function theorem.

Scalars unless a radio is polarised: then complex field vectors in the world frame travel the path and
each vertex acts by its TE and TM coefficients. The scalar coefficient carries the mean power of the
two and the phase of TE, which is the scalar wave's own (and right at normal and grazing incidence
alike; an average of the two amplitudes would cancel at grazing, where they differ in sign).
"""

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.scene.radios import Radio
from rfsg.scene.world import World
from rfsg.tracer.acting import Acting, scalar
from rfsg.tracer.edges import Edges
from rfsg.tracer.embree import Proxies
from rfsg.tracer.implicit import segments
from rfsg.tracer.jones import slots, transported
from rfsg.tracer.mechanisms import COEFFICIENT
from rfsg.tracer.passages import Passages, passages
from rfsg.tracer.plan import Quality
from rfsg.tracer.ports import Antennas
from rfsg.tracer.records import Act, Channel, Paths
from rfsg.tracer.refract import indices, inside


def channel(
    world: World,
    proxies: Proxies,
    paths: Paths,
    transmitters: tuple[Radio, ...],
    receivers: tuple[Radio, ...],
    frequency: Float[Tensor, "f"],
    quality: Quality,
    edges: Edges | None = None,
    through: Passages | None = None,
    without: Bool[Tensor, "n"] | None = None,
) -> Channel:
    """The channel of exact paths at all frequencies. Paths through opaque objects have gain 0.

    edges: those that the paths' DIFFRACT vertices number. through: what the paths go through, where
    that is known; it is found otherwise. without: nodes whose coefficients are left out of unpolarised
    gains, for a caller who knows them by heart or is about to learn them.
    """
    radios = transmitters, receivers
    antennas = Antennas(transmitters, world.device), Antennas(receivers, world.device)

    def one(some: Paths, through: Passages) -> Channel:
        return _channel(world, some, radios, antennas, frequency, edges, through, without)

    if through is not None:
        return one(paths, through)
    wavelength = float((SPEED_OF_LIGHT / frequency).min())
    parts = []
    for i in torch.arange(len(paths.tx), device=world.device).split(min(AT_ONCE, quality.chunk)):
        some = paths.take(slice(int(i[0]), int(i[-1]) + 1)) if len(i) else paths
        parts.append(one(some, passages(world, proxies, some, wavelength, quality)))
    return Channel.joined(parts)


AT_ONCE = 16_384  # paths: what they need stays near the cache


def _channel(
    world: World,
    paths: Paths,
    radios: tuple[tuple[Radio, ...], tuple[Radio, ...]],
    antennas: tuple[Antennas, Antennas],
    frequency: Float[Tensor, "f"],
    edges: Edges | None,
    through: Passages,
    without: Bool[Tensor, "n"] | None,
) -> Channel:
    wavelength = SPEED_OF_LIGHT / frequency
    _, u = segments(paths.vertices)
    departure, arrival = u[:, 0], -_last(u, paths)
    scale = wavelength[None] / (4 * torch.pi) * paths.spread[:, None]
    excess = _excess(world, paths, through, frequency)
    if _refracted(paths):
        way, more = inside(world, paths, frequency)
        excess, scale = excess + more, scale * way
    # T carries the phase of what was crossed; what moves into the delay leaves the gain. Every
    # caustic passed advances the phase by pi/2 (exp(+j 2 pi f t); Kouyoumjian and Pathak 1974, Eq. 6)
    phase = (
        2.0 * torch.pi * frequency[None] * excess[:, None]
        + 0.5 * torch.pi * paths.caustics[:, None].double()  # an integer's product is float32
    )
    scale = scale * torch.polar(torch.ones_like(phase), phase)
    at = Acting(world, paths, u, frequency, edges)
    jones = None
    (tx, rx), ends = antennas, ((paths.tx, departure), (paths.rx, arrival))
    if any(r.polarization != "none" for r in (*tx.kinds, *rx.kinds)):
        bases = tx.basis(*ends[0]), rx.basis(*ends[1])
        jones = transported(at, through, *bases) * scale[..., None, None]
        gain = _between_ports(jones, tx.components(*ends[0]), rx.components(*ends[1]))
    else:
        amplitude = tx.patterns(*ends[0]) * rx.patterns(*ends[1])
        gain = _scalar(at, through, without) * amplitude[:, None] * scale
    blocked = torch.zeros(len(paths.tx), dtype=torch.bool, device=world.device)
    blocked[through.path[world.opaque[through.which]]] = True
    return Channel(
        paths.tx,
        paths.rx,
        frequency,
        paths.length / SPEED_OF_LIGHT + excess,
        gain,
        _doppler(world, paths, u, *radios, frequency),
        departure,
        arrival,
        through.crossed,
        blocked,
        jones,
    )


def _refracted(paths: Paths) -> bool:
    """Whether any path runs in a solid."""
    return bool(((paths.act == int(Act.ENTER)) | (paths.act == int(Act.LEAVE))).any())


def _last(u: Tensor, paths: Paths) -> Tensor:
    """Direction of the last true segment (padding repeats the receiver)."""
    last = (paths.which >= 0).sum(1)
    return u[torch.arange(len(u), device=u.device), last]


def _scalar(
    at: Acting, through: Passages, without: Bool[Tensor, "n"] | None
) -> Complex[Tensor, "p f"]:
    """Product of all scalar coefficients, but for those of the nodes ``without``."""
    shape = (len(at.paths.tx), len(at.frequency))
    product = torch.ones(shape, dtype=torch.complex128, device=at.world.device)
    for level in range(at.paths.which.shape[1]):
        for i, act in at.vertices(level):
            factor = COEFFICIENT[act](at, i, level)
            if without is not None:
                factor = torch.where(without[at.paths.which[i, level], None], 1.0, factor)
            product = product * torch.ones_like(product).index_copy(0, i, factor)
    if len(through.path):
        factor = scalar(_transmission(at, through))
        if without is not None:
            factor = torch.where(without[through.which, None], 1.0, factor)
        for slot in slots(through.path):
            i = through.path[slot]
            product = product * torch.ones_like(product).index_copy(0, i, factor[slot])
    return product


def _transmission(at: Acting, through: Passages) -> Complex[Tensor, "m f 2"]:
    return at.world.transmission(through.which, through.crossing, at.frequency, through.last)


def _between_ports(
    jones: Complex[Tensor, "p f 2 2"],
    sent: Complex[Tensor, "p 2"],
    heard: Complex[Tensor, "p 2"],
) -> Complex[Tensor, "p f"]:
    """Gain between the reference ports, the first of each radio."""
    (tt, tp), (pt, pp) = (row.unbind(-1) for row in jones.unbind(2))
    theta, phi = sent[:, None].unbind(-1)
    heard_theta, heard_phi = heard[:, None].unbind(-1)
    return heard_theta * (tt * theta + tp * phi) + heard_phi * (pt * theta + pp * phi)


# delays


def _excess(world: World, paths: Paths, through: Passages, frequency: Tensor) -> Float[Tensor, "p"]:
    """Group delay beyond free space of everything crossed, at the first frequency [s]."""
    total = torch.zeros(len(paths.tx), dtype=torch.float64, device=world.device)
    if not len(through.path):
        return total
    excess = world.excess_delay(through.which, through.crossing, frequency[:1], through.last)[:, 0]
    return total.index_add(0, through.path, excess)


def _doppler(
    world: World,
    paths: Paths,
    u: Tensor,
    transmitters: tuple[Radio, ...],
    receivers: tuple[Radio, ...],
    frequency: Tensor,
) -> Float[Tensor, "p"]:
    """-(f / c) dL/dt, with dL/dt = u_last . v_rx - u_0 . v_tx + sum (u_i - u_{i+1}) . v_i [Hz].

    Each u times the index that its segment runs in: L is the optical length.
    """
    zero = torch.zeros(0, 3, dtype=torch.float64, device=world.device)
    v_tx = torch.stack([r.velocity.to(zero) for r in transmitters]) if transmitters else zero
    v_rx = torch.stack([r.velocity.to(zero) for r in receivers]) if receivers else zero
    velocities = (v_tx, v_rx, world.velocity)
    if not any(v.requires_grad or bool(v.any()) for v in velocities):
        return torch.zeros_like(paths.length)
    if _refracted(paths):
        u = u * indices(world, paths, frequency[:1])[..., None]
    growth = (_last(u, paths) * v_rx[paths.rx]).sum(-1) - (u[:, 0] * v_tx[paths.tx]).sum(-1)
    for level in range(paths.which.shape[1]):
        i = torch.nonzero(paths.which[:, level] >= 0).squeeze(-1)
        moving = world.velocity[paths.which[i, level]]
        growth = growth.index_add(0, i, ((u[i, level] - u[i, level + 1]) * moving).sum(-1))
    return -growth * frequency[0] / SPEED_OF_LIGHT
