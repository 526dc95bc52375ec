"""MIMO channel matrices between the ports of radios: elements of arrays times polarisations.

The synthetic array takes every path to each element as a plane wave: the path found between the
radios' positions, its phase advanced by k u . d for an element at d, with u the direction in which it
leaves a transmitter, or from a receiver back to the wave. That costs one path search whatever the
array, and holds where the array is small against the distance to the next point of each path (the
Fraunhofer distance 2 D^2 / lambda: IEEE Std 145; the phase is then off by pi / 8 at most) and where
all its elements see the same paths. ``synthetic=False`` searches and solves for every element.

Port order: see ``rfsg.scene.radios.port_names``; polarisation slowest, then elements as the array
lists them.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.scene.errors import SceneError
from rfsg.scene.radios import Radio, field_components, port_names
from rfsg.tracer.channel import coefficients
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.implicit import segments
from rfsg.tracer.records import Channel
from rfsg.tracer.simulate import Result, simulate

MAX_ENTRIES = 2**26  # complex numbers in all matrices together: 1 GiB
MAX_EXACT_ELEMENTS = 1024  # radios of one side of an exact simulation
PLANE = math.pi / 8  # [rad] phase error at the Fraunhofer distance


@dataclass(frozen=True)
class Mimo:
    """Channel matrices of all links, 1 W in, antennas and propagation included.

    transmitters, receivers: prim paths. tx_ports, rx_ports: the names of each radio's ports, in the
    order of rows and columns. blocks[t][r]: Complex [f, ports of r, ports of t]; radios may differ.
    warnings: sentences about where plane waves over an array are not what arrives.
    """

    transmitters: tuple[str, ...]
    receivers: tuple[str, ...]
    tx_ports: tuple[tuple[str, ...], ...]
    rx_ports: tuple[tuple[str, ...], ...]
    frequency: Float[Tensor, "f"]
    blocks: tuple[tuple[Tensor, ...], ...]
    warnings: tuple[str, ...] = ()

    def link(self, tx: str, rx: str) -> Complex[Tensor, "f n_rx n_tx"]:
        """The matrix between two prim paths. SceneError names what there is instead."""
        for path, known in ((tx, self.transmitters), (rx, self.receivers)):
            if path not in known:
                raise SceneError([f"{path}: no such radio here; there are {', '.join(known)}"])
        return self.blocks[self.transmitters.index(tx)][self.receivers.index(rx)]

    def padded(self) -> Complex[Tensor, "t r f n_rx n_tx"]:
        """All matrices in one, zeros where a radio has fewer ports than the largest of its side.

        Raises SceneError for more than 2^26 entries."""
        most_rx, most_tx = (max(map(len, p), default=0) for p in (self.rx_ports, self.tx_ports))
        links = (len(self.transmitters), len(self.receivers))
        shape = (*links, len(self.frequency), most_rx, most_tx)
        _bounded(math.prod(shape))
        out = self.frequency.new_zeros(shape, dtype=torch.complex128)
        for i, row in enumerate(self.blocks):
            for j, block in enumerate(row):
                out[i, j, :, : block.shape[1], : block.shape[2]] = block
        return out


def mimo(result: Result, synthetic: bool = True) -> Mimo:
    """The channel matrices of a simulation, from its paths or, exactly, from one per pair of elements.

    synthetic: plane waves over each array (see the module); False simulates again with every element
    a radio of its own, at most 1024 on each side, with the quality of the result. Differentiable like
    the result. Raises SceneError for more than 2^26 entries in all.
    """
    tx, rx = result.scene.transmitters, result.scene.receivers
    tx_ports, rx_ports = (tuple(map(port_names, radios)) for radios in (tx, rx))
    entries = sum(map(len, tx_ports)) * sum(map(len, rx_ports)) * len(result.frequency)
    _bounded(entries)
    blocks = _synthetic(result) if synthetic else _exact(result)
    return Mimo(
        tuple(r.path for r in tx),
        tuple(r.path for r in rx),
        tx_ports,
        rx_ports,
        result.frequency,
        blocks,
        plane_wave_warnings(result) if synthetic else (),
    )


def capacity(
    h: Complex[Tensor, "*b n_rx n_tx"], snr: float | Float[Tensor, "*b"]
) -> Float[Tensor, "*b"]:
    """log2 det(I + snr / n_tx H H^H) [bit/s/Hz], equal power on all transmitting ports.

    Telatar, Capacity of multi-antenna Gaussian channels, Eur. Trans. Telecommun. 10(6), 1999. snr:
    power in over noise power at each receiving port (linear), for matrices that hold the path loss as
    those of ``mimo`` do. From singular values, so it neither overflows nor loses a weak mode.
    """
    ratio = torch.as_tensor(snr, dtype=torch.float64, device=h.device)
    if not bool((torch.isfinite(ratio) & (ratio >= 0)).all()):
        raise ValueError(f"snr: expected finite ratios of 0 or more, got {snr!r}")
    modes = torch.linalg.svdvals(h) ** 2 * (ratio[..., None] / h.shape[-1])
    return torch.log1p(modes).sum(-1) / math.log(2.0)


def _bounded(entries: int) -> None:
    if entries > MAX_ENTRIES:
        raise SceneError(
            [f"mimo: {entries} entries in all matrices; the limit is {MAX_ENTRIES}: take fewer "
             "frequencies, radios or elements"]
        )  # fmt: skip


# ---- the synthetic array ----------------------------------------------------------------------


def _synthetic(result: Result) -> tuple[tuple[Tensor, ...], ...]:
    channel = result.channel
    return tuple(
        tuple(
            _combined(channel, tx, rx, torch.nonzero((channel.tx == i) & (channel.rx == j))[:, 0])
            for j, rx in enumerate(result.scene.receivers)
        )
        for i, tx in enumerate(result.scene.transmitters)
    )


def _combined(
    channel: Channel, tx: Radio, rx: Radio, paths: Int[Tensor, "m"]
) -> Complex[Tensor, "f n_rx n_tx"]:
    """sum over paths of (polarisations at the origins) x (phases of the elements)."""
    between = _between(channel, tx, rx, paths)
    sent = _steering(tx, channel.departure[paths], channel.frequency)
    heard = _steering(rx, channel.arrival[paths], channel.frequency)
    rows = torch.einsum("pfab,pfi->fpaib", between, heard).flatten(2, 3)
    matrix = torch.einsum("fprb,pfj->frbj", rows, sent)
    return matrix.flatten(2, 3)


def port_gains(
    channel: Channel, tx: Radio, rx: Radio, paths: Int[Tensor, "m"]
) -> Complex[Tensor, "m f n_rx n_tx"]:
    """Each path's own matrix between the ports of two radios, delay included: ``mimo`` is their sum."""
    between = _between(channel, tx, rx, paths)
    sent = _steering(tx, channel.departure[paths], channel.frequency)
    heard = _steering(rx, channel.arrival[paths], channel.frequency)
    each = torch.einsum("pfab,pfi,pfj->pfaibj", between, heard, sent)
    return each.flatten(4, 5).flatten(2, 3)


def _between(
    channel: Channel, tx: Radio, rx: Radio, paths: Int[Tensor, "m"]
) -> Complex[Tensor, "m f a b"]:
    """Transfer of some paths between polarisation ports at the radios' positions, delay included."""
    delayed = coefficients(replace(channel, gain=torch.ones_like(channel.gain)))[paths]
    if channel.jones is None:
        return (channel.gain[paths] * delayed)[..., None, None]
    sent = field_components(tx, channel.departure[paths] @ tx.rotation.to(channel.departure))
    heard = field_components(rx, channel.arrival[paths] @ rx.rotation.to(channel.arrival))
    jones = channel.jones[paths] * delayed[..., None, None]
    return torch.einsum("pax,pfxy,pby->pfab", heard, jones, sent)


def _steering(
    radio: Radio, direction: Float[Tensor, "m 3"], frequency: Float[Tensor, "f"]
) -> Complex[Tensor, "m f n"]:
    """exp(+j k u . d) for each element of a radio, u in the world."""
    nearer = direction @ _offsets(radio, frequency).T
    phase = 2.0 * math.pi / SPEED_OF_LIGHT * frequency[None, :, None] * nearer[:, None]
    return torch.polar(torch.ones_like(phase), phase)


def _offsets(radio: Radio, frequency: Float[Tensor, "f"]) -> Float[Tensor, "n 3"]:
    """Places of a radio's elements from its position, in the world [m]."""
    if radio.array is None:
        return frequency.new_zeros(1, 3)
    carrier = radio.frequency or float(frequency[0])
    metres = radio.array.metres(SPEED_OF_LIGHT / carrier).to(frequency)
    return metres @ radio.rotation.to(frequency).T


# ---- its validity -----------------------------------------------------------------------------


@torch.no_grad()
def plane_wave_errors(result: Result) -> dict[str, float]:
    """Phase error [rad] that plane waves make over each radio with an array, by prim path.

    k a^2 / (2 s), with a the largest distance of an element from its radio's position, plus that of
    the link's other end, and s the shortest first (last) segment of the radio's paths: the wave is no
    more curved than a sphere about that next point, on flat and convex mirrors and at edges. A concave
    mirror may focus; that is not bounded here. At the Fraunhofer distance s = 2 (2a)^2 / lambda it is
    pi / 8.
    """
    channel, scene = result.channel, result.scene
    length, _ = segments(result.paths.vertices)
    number = torch.arange(length.shape[1], device=length.device)
    last = torch.where(length > 0, number, 0).amax(1, keepdim=True)
    reach_tx, reach_rx = (
        length.new_tensor([float(_offsets(r, channel.frequency).norm(dim=-1).max()) for r in side])
        for side in (scene.transmitters, scene.receivers)
    )
    k = 2.0 * math.pi * float(channel.frequency.max()) / SPEED_OF_LIGHT
    errors: dict[str, float] = {}
    for radios, index, reach, near in (
        (scene.transmitters, channel.tx, reach_tx, length[:, 0]),
        (scene.receivers, channel.rx, reach_rx, length.gather(1, last)[:, 0]),
    ):
        both = reach_tx[channel.tx] + reach_rx[channel.rx]
        error = k * both**2 / (2.0 * near.clamp(min=1e-300))
        for i, radio in enumerate(radios):
            mine = error[index == i]
            if float(reach[i]) > 0.0 and len(mine):
                errors[radio.path] = float(mine.max())
    return errors


def plane_wave_warnings(result: Result) -> tuple[str, ...]:
    """A sentence for each radio whose array is too large for plane waves."""
    return tuple(
        f"{path}: a path's next point lies within the Fraunhofer distance of its array (with the other "
        f"end's): plane waves may be off by {min(math.degrees(error), 180.0):.0f} degrees between "
        "elements; mimo(result, synthetic=False) solves for every element"
        for path, error in plane_wave_errors(result).items()
        if error > PLANE
    )


# ---- exactly ----------------------------------------------------------------------------------


def _exact(result: Result) -> tuple[tuple[Tensor, ...], ...]:
    """Every element a radio of its own: the oracle of the synthetic array."""
    scene, frequency = result.scene, result.frequency
    sides = [_elements(radios, frequency) for radios in (scene.transmitters, scene.receivers)]
    for name, (elements, _) in zip(("transmitting", "receiving"), sides, strict=True):
        if len(elements) > MAX_EXACT_ELEMENTS:
            raise SceneError(
                [f"mimo: {len(elements)} {name} elements; an exact simulation takes at most "
                 f"{MAX_EXACT_ELEMENTS}"]
            )  # fmt: skip
    (transmitters, tx_of), (receivers, rx_of) = sides
    apart = scene.with_transmitters(transmitters).with_receivers(receivers)
    channel = simulate(
        apart,
        frequency,
        result.plan.quality,
        gradients=result.channel.gain.requires_grad,
        device=frequency.device,
    ).channel
    return tuple(
        tuple(
            _assembled(channel, t, r, tx_of == i, rx_of == j) for j, r in enumerate(scene.receivers)
        )
        for i, t in enumerate(scene.transmitters)
    )


def _elements(
    radios: tuple[Radio, ...], frequency: Float[Tensor, "f"]
) -> tuple[list[Radio], Int[Tensor, "n"]]:
    """All elements as radios, and whose each is."""
    elements, owner = [], []
    for i, radio in enumerate(radios):
        for e, offset in enumerate(_offsets(radio, frequency)):
            place = radio.position.to(offset) + offset
            elements.append(replace(radio, path=f"{radio.path}/{e}", position=place, array=None))
            owner.append(i)
    return elements, torch.tensor(owner, dtype=torch.int64, device=frequency.device)


def _assembled(
    channel: Channel, tx: Radio, rx: Radio, sent: Tensor, heard: Tensor
) -> Complex[Tensor, "f n_rx n_tx"]:
    """One link's matrix from the paths between the elements that the two masks tell."""
    paths = torch.nonzero(sent[channel.tx] & heard[channel.rx])[:, 0]
    between = _between(channel, tx, rx, paths)
    n_tx, n_rx = int(sent.sum()), int(heard.sum())
    column = (torch.cumsum(sent.long(), 0) - 1)[channel.tx[paths]]
    row = (torch.cumsum(heard.long(), 0) - 1)[channel.rx[paths]]
    zero = between.new_zeros((n_rx * n_tx, *between.shape[1:]))
    matrix = zero.index_add(0, row * n_tx + column, between).unflatten(0, (n_rx, n_tx))
    return matrix.permute(2, 3, 0, 4, 1).flatten(3, 4).flatten(1, 2)
