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

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact, Crossing
from rfsg.scene.antennas import PATTERNS
from rfsg.scene.radios import Radio
from rfsg.scene.world import World, unit
from rfsg.tracer.embree import Proxies
from rfsg.tracer.implicit import segments, transverse
from rfsg.tracer.march import EVALUATE, crossings
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Channel, Crossings, Paths, Rays

SPEED_OF_LIGHT = 299_792_458.0  # [m/s], exact (SI)
OWN_RIPPLE = 0.25  # [wavelengths] along the normal: a path that leaves a learned face may graze it


@dataclass(frozen=True)
class Passages:
    """What the segments of paths go through: flat, sorted by path segment, then by distance."""

    path: Int[Tensor, "m"]
    segment: Int[Tensor, "m"]
    which: Int[Tensor, "m"]
    crossing: Crossing


@torch.no_grad()
def passages(
    world: World, proxies: Proxies, paths: Paths, wavelength: float, quality: Quality
) -> Passages:
    """Every crossing of every segment, less the grazing of a segment's own mirrors."""
    p, k = paths.vertices.shape[:2]
    length, u = segments(paths.vertices.detach())
    path, segment = torch.nonzero(length > 0, as_tuple=True)
    rays = Rays(paths.vertices.detach()[path, segment], u[path, segment], length[path, segment])
    parts = []
    for i in torch.arange(len(path), device=world.device).split(quality.chunk):
        some = Rays(rays.origin[i], rays.direction[i], rays.limit[i])
        parts.append((i, crossings(world, some, proxies.spans(some), EVALUATE)))
    if not parts:
        return _empty(world)
    inside = Crossings(
        torch.cat([i[c.ray] for i, c in parts]),
        *(
            torch.cat([getattr(c, n) for _, c in parts])
            for n in list(Crossings.__dataclass_fields__)[1:]
        ),
    )
    keep = ~_own(world, paths, path, segment, rays, inside, wavelength)
    i = torch.nonzero(keep).squeeze(-1)
    ray = inside.ray[i]
    o, d = rays.origin[ray], rays.direction[ray]
    leave = torch.where(torch.isfinite(inside.leave[i]), inside.leave[i], inside.enter[i])
    return Passages(
        path[ray],
        segment[ray],
        inside.which[i],
        Crossing(
            o + inside.enter[i, None] * d,
            o + leave[:, None] * d,
            inside.normal_enter[i],
            inside.normal_leave[i],
        ),
    )


def _empty(world: World) -> Passages:
    none = torch.zeros(0, dtype=torch.int64, device=world.device)
    point = torch.zeros(0, 3, dtype=torch.float64, device=world.device)
    return Passages(none, none, none, Crossing(point, point, point, point))


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
    normals = torch.nn.functional.pad(paths.normal.detach(), (0, 0, 1, 1))
    length = rays.limit[ray]
    for vertex, near, far in (
        (s, inside.enter, inside.leave),
        (s + 1, length - inside.leave, length - inside.enter),
    ):
        mine = (reflecting[p, vertex] == inside.which) & (inside.which >= 0)
        cosine = (rays.direction[ray] * normals[p, vertex]).sum(-1).abs()
        shallow = far * cosine <= OWN_RIPPLE * wavelength
        touching = near * cosine <= OWN_RIPPLE * wavelength
        own |= mine & (world.convex[inside.which] | (shallow & touching))
    return own


def with_gradient(world: World, passages: Passages) -> Passages:
    """The same crossings, whose ends move with what they lie on.

    t' = t - f(p(t)) / (grad f . d), with the slope held fixed (implicit function theorem).
    """
    if not torch.is_grad_enabled() or not len(passages.path):
        return passages
    crossing = passages.crossing
    direction = unit(crossing.end - crossing.start).detach()
    start = _on_surface(world, passages.which, crossing.start, crossing.normal_start, direction)
    end = _on_surface(world, passages.which, crossing.end, crossing.normal_end, direction)
    moved = Crossing(start, end, crossing.normal_start, crossing.normal_end)
    return Passages(passages.path, passages.segment, passages.which, moved)


def _on_surface(
    world: World, which: Tensor, point: Tensor, normal: Tensor, direction: Tensor
) -> Tensor:
    on_boundary = normal.abs().sum(-1) > 0
    value, gradient = world.value_and_gradient(which, point)
    slope = (gradient * direction).sum(-1).detach()
    safe = torch.where(slope.abs() < 1e-3, torch.ones_like(slope), slope)
    move = torch.where(on_boundary & (slope.abs() >= 1e-3), value / safe, torch.zeros_like(value))
    return point - move[:, None] * direction


def channel(
    world: World,
    proxies: Proxies,
    paths: Paths,
    transmitters: tuple[Radio, ...],
    receivers: tuple[Radio, ...],
    frequency: Float[Tensor, "f"],
    quality: Quality,
) -> Channel:
    """The channel of exact paths at all frequencies. Paths through opaque objects have gain 0."""
    wavelength = SPEED_OF_LIGHT / frequency
    through = passages(world, proxies, paths, float(wavelength.min()), quality)
    through = with_gradient(world, through)
    _, u = segments(paths.vertices)
    departure, arrival = u[:, 0], -_last(u, paths)
    if _polarised(transmitters, receivers):
        action = _jones(world, paths, through, u, transmitters, receivers, frequency)
    else:
        antennas = _patterns(transmitters, paths.tx, departure) * _patterns(
            receivers, paths.rx, arrival
        )
        action = _scalar(world, paths, through, u, frequency) * antennas[:, None]
    gain = action * (wavelength / (4 * torch.pi))[None] * paths.spread[:, None]
    excess = _excess(world, through, len(paths.tx), frequency)
    # T carries the phase of what was crossed; what moves into the delay leaves the gain
    phase = 2.0 * torch.pi * frequency[None] * excess[:, None]
    gain = gain * torch.polar(torch.ones_like(phase), phase)
    delay = paths.length / SPEED_OF_LIGHT + excess
    blocked = torch.zeros(len(paths.tx), dtype=torch.bool, device=world.device)
    blocked[through.path[world.opaque[through.which]]] = True
    return Channel(
        paths.tx,
        paths.rx,
        frequency,
        delay,
        gain,
        _doppler(world, paths, u, transmitters, receivers, frequency[0]),
        departure,
        arrival,
        torch.stack([through.path, through.which, through.segment], -1),
        blocked,
    )


def _last(u: Tensor, paths: Paths) -> Tensor:
    """Direction of the last true segment (padding repeats the receiver)."""
    last = (paths.which >= 0).sum(1)
    return u[torch.arange(len(u), device=u.device), last]


def _contacts(paths: Paths, u: Tensor, level: int) -> tuple[Tensor, Tensor, Contact]:
    """Paths that reflect at a level, on what, and how."""
    i = torch.nonzero(paths.which[:, level] >= 0).squeeze(-1)
    contact = Contact(
        paths.vertices[i, level + 1], u[i, level], u[i, level + 1], paths.normal[i, level]
    )
    return i, paths.which[i, level], contact


def _scalar(
    world: World, paths: Paths, through: Passages, u: Tensor, frequency: Tensor
) -> Complex[Tensor, "p f"]:
    """Product of all scalar coefficients."""
    shape = (len(paths.tx), len(frequency))
    product = torch.ones(shape, dtype=torch.complex128, device=world.device)
    for level in range(paths.which.shape[1]):
        i, which, contact = _contacts(paths, u, level)
        if len(i):
            factor = scalar(world.reflection(which, contact, frequency))
            product = product * torch.ones_like(product).index_copy(0, i, factor)
    if len(through.path):
        factor = scalar(world.transmission(through.which, through.crossing, frequency))
        for slot in _slots(through.path):
            i = through.path[slot]
            product = product * torch.ones_like(product).index_copy(0, i, factor[slot])
    return product


def scalar(pair: Complex[Tensor, "*b 2"]) -> Complex[Tensor, "*b"]:
    """One coefficient for an unpolarised link: mean power of (TE, TM), phase of TE."""
    te, tm = pair[..., 0], pair[..., 1]
    te_power = te.real**2 + te.imag**2
    power = 0.5 * (te_power + tm.real**2 + tm.imag**2)
    dark = te_power < DARK
    ratio = torch.where(dark, torch.ones_like(power), power / torch.where(dark, 1.0, te_power))
    # without a TE wave there is no phase to take: the TM share alone, in phase
    alone = torch.sqrt(torch.where(dark & (power > DARK), power, torch.ones_like(power)))
    alone = torch.where(dark & (power > DARK), alone, torch.zeros_like(alone)).to(pair.dtype)
    return torch.where(dark, alone, torch.sqrt(ratio) * te)


DARK = 1e-60  # power of -600 dB: nothing


def _slots(path: Int[Tensor, "m"]) -> list[Tensor]:
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
    world: World,
    paths: Paths,
    through: Passages,
    u: Tensor,
    transmitters: tuple[Radio, ...],
    receivers: tuple[Radio, ...],
    frequency: Tensor,
) -> Complex[Tensor, "p f"]:
    """Receiver's field vector . everything on the path . transmitter's field vector."""
    departure, arrival = u[:, 0], -_last(u, paths)
    field = _field_vectors(transmitters, paths.tx, departure)[:, None].to(torch.complex128)
    field = field.expand(-1, len(frequency), -1)
    transmission = (
        world.transmission(through.which, through.crossing, frequency)
        if len(through.path)
        else None
    )
    for level in range(paths.which.shape[1] + 1):
        if transmission is not None:
            here = torch.nonzero(through.segment == level).squeeze(-1)
            if len(here):
                for slot in _slots(through.path[here]):
                    field = _through(field, through, here[slot], u[:, level], transmission)
        if level < paths.which.shape[1]:
            i, which, contact = _contacts(paths, u, level)
            if len(i):
                pair = world.reflection(which, contact, frequency)
                bent = _act(field[i], pair, contact.incoming, contact.outgoing, contact.normal)
                field = field.index_copy(0, i, bent)
    received = _field_vectors(receivers, paths.rx, arrival)
    return (field * received[:, None]).sum(-1)


def _through(
    field: Tensor, through: Passages, i: Tensor, u: Tensor, transmission: Tensor
) -> Tensor:
    path = through.path[i]
    n = through.crossing.normal_start[i] - through.crossing.normal_end[i]
    return field.index_copy(0, path, _act(field[path], transmission[i], u[path], u[path], unit(n)))


def _act(
    field: Complex[Tensor, "m f 3"],
    pair: Complex[Tensor, "m f 2"],
    incoming: Float[Tensor, "m 3"],
    outgoing: Float[Tensor, "m 3"],
    normal: Float[Tensor, "m 3"],
) -> Complex[Tensor, "m f 3"]:
    """E_out = R_te e (e . E) + R_tm p_out (p_in . E), e across the plane of incidence.

    p_in = e x k_in, and p_out is its mirror image: at normal incidence the two coefficients then
    do the same, as the contract says.
    """
    e = torch.linalg.cross(incoming, normal)
    straight = (e * e).sum(-1, keepdim=True) < 1e-20
    e = unit(torch.where(straight, transverse(incoming)[:, 0], e))
    p_in = torch.linalg.cross(e, incoming)
    reflected = ((outgoing - incoming) ** 2).sum(-1, keepdim=True) > 1e-20
    mirrored = p_in - 2.0 * (p_in * normal).sum(-1, keepdim=True) * normal
    p_out = torch.where(reflected, mirrored, p_in)
    te = (field * e[:, None]).sum(-1, keepdim=True) * pair[..., :1]
    tm = (field * p_in[:, None]).sum(-1, keepdim=True) * pair[..., 1:]
    return te * e[:, None] + tm * p_out[:, None]


def _field_vectors(
    radios: tuple[Radio, ...], index: Int[Tensor, "p"], direction: Float[Tensor, "p 3"]
) -> Float[Tensor, "p 3"]:
    """Pattern amplitude times the unit field vector of each radio's polarisation, in the world.

    "V" is theta-hat and "H" phi-hat of the radio's own frame (3GPP TR 38.901 section 7.1);
    "none" beside a polarised radio is taken as V.
    """
    out = torch.zeros_like(direction)
    for r in torch.unique(index).tolist():
        i = torch.nonzero(index == r).squeeze(-1)
        rotation = radios[r].rotation.to(direction)
        local = direction[i] @ rotation
        flat = torch.stack([-local[:, 1], local[:, 0], torch.zeros_like(local[:, 0])], -1)
        pole = (flat * flat).sum(-1, keepdim=True) < 1e-24
        y_axis = torch.tensor([0.0, 1.0, 0.0], dtype=flat.dtype, device=flat.device)
        phi = unit(torch.where(pole, y_axis, flat))
        vector = phi if radios[r].polarization == "H" else torch.linalg.cross(phi, local)
        gain = PATTERNS[radios[r].pattern](local)[:, None]
        out = out.index_copy(0, i, gain * (vector @ rotation.T))
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
        out = out.index_copy(0, i, PATTERNS[radios[r].pattern](local))
    return out


# delays


def _excess(world: World, through: Passages, n: int, frequency: Tensor) -> Float[Tensor, "p"]:
    """Group delay beyond free space of everything crossed, at the first frequency [s]."""
    total = torch.zeros(n, dtype=torch.float64, device=world.device)
    if not len(through.path):
        return total
    excess = world.excess_delay(through.which, through.crossing, frequency[:1])[:, 0]
    return total.index_add(0, through.path, excess)


def _doppler(
    world: World,
    paths: Paths,
    u: Tensor,
    transmitters: tuple[Radio, ...],
    receivers: tuple[Radio, ...],
    frequency: Tensor,
) -> Float[Tensor, "p"]:
    """-(f / c) dL/dt, with dL/dt = u_last . v_rx - u_0 . v_tx + sum (u_i - u_{i+1}) . v_i [Hz]."""
    zero = torch.zeros(0, 3, dtype=torch.float64, device=world.device)
    v_tx = torch.stack([r.velocity.to(zero) for r in transmitters]) if transmitters else zero
    v_rx = torch.stack([r.velocity.to(zero) for r in receivers]) if receivers else zero
    growth = (_last(u, paths) * v_rx[paths.rx]).sum(-1) - (u[:, 0] * v_tx[paths.tx]).sum(-1)
    for level in range(paths.which.shape[1]):
        i, which, contact = _contacts(paths, u, level)
        rate = ((contact.incoming - contact.outgoing) * world.velocity[which]).sum(-1)
        growth = growth.index_add(0, i, rate)
    return -growth * frequency / SPEED_OF_LIGHT
