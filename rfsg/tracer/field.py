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
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.scene.antennas import basis
from rfsg.scene.radios import Radio, amplitude, field_components
from rfsg.scene.world import World
from rfsg.tracer.acting import Acting, crossing_normal, dyad_of, scalar
from rfsg.tracer.edges import Edges
from rfsg.tracer.embree import Proxies
from rfsg.tracer.implicit import segments
from rfsg.tracer.mechanisms import COEFFICIENT, DYAD
from rfsg.tracer.passages import Passages, passages
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Channel, Paths
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
    wavelength = SPEED_OF_LIGHT / frequency
    if through is None:
        through = passages(world, proxies, paths, float(wavelength.min()), quality)
    _, u = segments(paths.vertices)
    departure, arrival = u[:, 0], -_last(u, paths)
    scale = wavelength[None] / (4 * torch.pi) * paths.spread[:, None]
    way, refracted = inside(world, paths, frequency)
    excess = _excess(world, paths, through, frequency) + refracted
    # T carries the phase of what was crossed; what moves into the delay leaves the gain. Every
    # caustic passed advances the phase by pi/2 (exp(+j 2 pi f t); Kouyoumjian and Pathak 1974, Eq. 6)
    phase = (
        2.0 * torch.pi * frequency[None] * excess[:, None]
        + 0.5 * torch.pi * paths.caustics[:, None].double()  # an integer's product is float32
    )
    scale = scale * way * torch.polar(torch.ones_like(phase), phase)
    at = Acting(world, paths, u, frequency, edges)
    jones = None
    if _polarised(transmitters, receivers):
        jones = _jones(at, through, transmitters, receivers) * scale[..., None, None]
        gain = _between_ports(jones, paths, departure, arrival, transmitters, receivers)
    else:
        antennas = _patterns(transmitters, paths.tx, departure) * _patterns(
            receivers, paths.rx, arrival
        )
        gain = _scalar(at, through, without) * antennas[:, None] * scale
    blocked = torch.zeros(len(paths.tx), dtype=torch.bool, device=world.device)
    blocked[through.path[world.opaque[through.which]]] = True
    return Channel(
        paths.tx,
        paths.rx,
        frequency,
        paths.length / SPEED_OF_LIGHT + excess,
        gain,
        _doppler(world, paths, u, transmitters, receivers, frequency),
        departure,
        arrival,
        through.crossed,
        blocked,
        jones,
    )


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


def slots(path: Int[Tensor, "m"]) -> list[Tensor]:
    """The k-th entries of every path, for k = 0, 1, ...: each list names a path at most once."""
    order = torch.argsort(path, stable=True)
    first = torch.ones(len(path), dtype=torch.bool, device=path.device)
    first[1:] = path[order][1:] != path[order][:-1]
    number = torch.arange(len(path), device=path.device)
    rank = number - torch.cummax(torch.where(first, number, 0), 0).values
    return [order[rank == k] for k in range(int(rank.max()) + 1)]


# polarisation


def _polarised(transmitters: tuple[Radio, ...], receivers: tuple[Radio, ...]) -> bool:
    return any(r.polarization != "none" for r in (*transmitters, *receivers))


def _jones(
    at: Acting, through: Passages, transmitters: tuple[Radio, ...], receivers: tuple[Radio, ...]
) -> Complex[Tensor, "p f 2 2"]:
    """From (theta, phi) of the transmitter to (theta, phi) of the receiver, without spreading."""
    paths, u = at.paths, at.u
    sent = _basis(transmitters, paths.tx, u[:, 0])
    field = sent.mT[:, None].to(torch.complex128).expand(-1, len(at.frequency), -1, -1)
    transmission = _transmission(at, through) if len(through.path) else None
    for level in range(paths.which.shape[1] + 1):
        if transmission is not None:
            here = torch.nonzero(through.segment == level).squeeze(-1)
            if len(here):
                for slot in slots(through.path[here]):
                    field = _through(field, through, here[slot], u[:, level], transmission)
        if level < paths.which.shape[1]:
            for i, act in at.vertices(level):
                field = field.index_copy(0, i, DYAD[act](at, i, level) @ field[i])
    received = _basis(receivers, paths.rx, -_last(u, paths))
    return received[:, None].to(field.dtype) @ field


def _through(
    field: Tensor, through: Passages, i: Tensor, u: Tensor, transmission: Tensor
) -> Tensor:
    path, crossing = through.path[i], through.crossing
    n = crossing_normal(u[path], crossing.normal_start[i], crossing.normal_end[i])
    bent = dyad_of(transmission[i], u[path], u[path], n) @ field[path]
    return field.index_copy(0, path, bent)


def _basis(
    radios: tuple[Radio, ...], index: Int[Tensor, "p"], direction: Float[Tensor, "p 3"]
) -> Float[Tensor, "p 2 3"]:
    """Rows theta-hat and phi-hat, in the world, of each path's radio along a direction."""
    if not radios:
        return direction.new_zeros(0, 2, 3)
    rotation = torch.stack([r.rotation.to(direction) for r in radios])[index]
    local = torch.einsum("pij,pi->pj", rotation, direction)
    return basis(local) @ rotation.mT


def _between_ports(
    jones: Complex[Tensor, "p f 2 2"],
    paths: Paths,
    departure: Float[Tensor, "p 3"],
    arrival: Float[Tensor, "p 3"],
    transmitters: tuple[Radio, ...],
    receivers: tuple[Radio, ...],
) -> Complex[Tensor, "p f"]:
    """Gain between the reference ports, the first of each radio."""
    sent = _components(transmitters, paths.tx, departure)
    heard = _components(receivers, paths.rx, arrival)
    return torch.einsum("pa,pfab,pb->pf", heard, jones, sent)


def _components(
    radios: tuple[Radio, ...], index: Int[Tensor, "p"], direction: Float[Tensor, "p 3"]
) -> Complex[Tensor, "p 2"]:
    """(theta, phi) field of each path's radio, its first port, along a world direction."""
    out = torch.zeros(len(index), 2, dtype=torch.complex128, device=direction.device)
    for r in torch.unique(index).tolist():
        i = torch.nonzero(index == r).squeeze(-1)
        local = direction[i] @ radios[r].rotation.to(direction)
        out = out.index_copy(0, i, field_components(radios[r], local)[:, 0])
    return out


def _patterns(
    radios: tuple[Radio, ...], index: Int[Tensor, "p"], direction: Float[Tensor, "p 3"]
) -> Float[Tensor, "p"]:
    """Amplitude pattern sqrt(G) of each path's radio along a world direction."""
    out = torch.ones(len(index), dtype=torch.float64, device=direction.device)
    plain = {r for r, radio in enumerate(radios) if radio.pattern == "isotropic"}
    if len(plain) == len(radios):
        return out
    for r in set(torch.unique(index).tolist()) - plain:
        i = torch.nonzero(index == r).squeeze(-1)
        local = direction[i] @ radios[r].rotation.to(direction)
        out = out.index_copy(0, i, amplitude(radios[r], local))
    return out


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
    u = u * indices(world, paths, frequency[:1])[..., None]
    zero = torch.zeros(0, 3, dtype=torch.float64, device=world.device)
    v_tx = torch.stack([r.velocity.to(zero) for r in transmitters]) if transmitters else zero
    v_rx = torch.stack([r.velocity.to(zero) for r in receivers]) if receivers else zero
    growth = (_last(u, paths) * v_rx[paths.rx]).sum(-1) - (u[:, 0] * v_tx[paths.tx]).sum(-1)
    for level in range(paths.which.shape[1]):
        i = torch.nonzero(paths.which[:, level] >= 0).squeeze(-1)
        moving = world.velocity[paths.which[i, level]]
        growth = growth.index_add(0, i, ((u[i, level] - u[i, level + 1]) * moving).sum(-1))
    return -growth * frequency[0] / SPEED_OF_LIGHT
