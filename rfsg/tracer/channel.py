"""What people read off a channel: transfer function, impulse response, power, spreads, links."""

import math
from typing import TypedDict

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.scene.scene import Scene
from rfsg.tracer.records import Channel, Paths


class Link(TypedDict):
    """One transmitter and one receiver, at the first frequency."""

    tx: str
    rx: str
    path_gain_db: float  # 10 log10 |h|^2; -inf where nothing arrives
    rss_dbm: float  # received signal strength
    delay_spread_ns: float  # rms, power-weighted; nan-free: 0 for one path or none
    n_paths: int
    los: bool  # a path without reflection arrives through nothing


def coefficients(channel: Channel) -> Complex[Tensor, "p f"]:
    """gain exp(-j 2 pi f tau): each path's share of h(f). The phase is reduced in float64 turns."""
    turns = channel.frequency[None] * channel.delay[:, None]
    phase = -2.0 * math.pi * (turns - torch.floor(turns.detach()))
    return channel.gain * torch.polar(torch.ones_like(phase), phase)


def transfer(channel: Channel, n_tx: int, n_rx: int) -> Complex[Tensor, "t r f"]:
    """h(f) = sum over paths of gain exp(-j 2 pi f tau)."""
    f = len(channel.frequency)
    h = torch.zeros(n_tx * n_rx, f, dtype=torch.complex128, device=channel.gain.device)
    return h.index_add(0, channel.tx * n_rx + channel.rx, coefficients(channel)).reshape(
        n_tx, n_rx, f
    )


def power(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r f"]:
    """Incoherent path gain, the sum of |gain|^2: what remains when phases are averaged over."""
    f = len(channel.frequency)
    p = torch.zeros(n_tx * n_rx, f, dtype=torch.float64, device=channel.gain.device)
    square = channel.gain.real**2 + channel.gain.imag**2
    return p.index_add(0, channel.tx * n_rx + channel.rx, square).reshape(n_tx, n_rx, f)


def delay_spread(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r"]:
    """rms delay spread [s] at the first frequency (ITU-R P.1407-8 section 2.2.2)."""
    link = channel.tx * n_rx + channel.rx
    weight = (channel.gain[:, 0].abs() ** 2).double()
    zero = torch.zeros(n_tx * n_rx, dtype=torch.float64, device=weight.device)
    total = zero.index_add(0, link, weight)
    safe = torch.where(total > 0, total, torch.ones_like(total))
    mean = zero.index_add(0, link, weight * channel.delay) / safe
    # about the mean, so that small spreads of long delays keep their digits
    second = zero.index_add(0, link, weight * (channel.delay - mean[link]) ** 2) / safe
    return torch.sqrt(second).reshape(n_tx, n_rx)


def line_of_sight(paths: Paths, channel: Channel, n_tx: int, n_rx: int) -> Int[Tensor, "t r"]:
    """1 where a path arrives without touching or crossing anything."""
    clear = (paths.which >= 0).sum(1) == 0
    clear[channel.crossed[:, 0]] = False
    seen = torch.zeros(n_tx * n_rx, dtype=torch.int64, device=clear.device)
    seen[(channel.tx * n_rx + channel.rx)[clear]] = 1
    return seen.reshape(n_tx, n_rx)


def links(scene: Scene, paths: Paths, channel: Channel) -> list[Link]:
    """One record per transmitter and receiver, in scene order."""
    t, r = len(scene.transmitters), len(scene.receivers)
    gain = transfer(channel, t, r)[..., 0].abs().detach() ** 2
    spread = delay_spread(channel, t, r).detach()
    seen = line_of_sight(paths, channel, t, r)
    count = torch.bincount(channel.tx * r + channel.rx, minlength=t * r).reshape(t, r)
    records: list[Link] = []
    for i, tx in enumerate(scene.transmitters):
        for j, rx in enumerate(scene.receivers):
            g = float(gain[i, j])
            db = 10.0 * math.log10(g) if g > 0 else -math.inf
            records.append(
                Link(
                    tx=tx.path,
                    rx=rx.path,
                    path_gain_db=db,
                    rss_dbm=tx.power_dbm + db,
                    delay_spread_ns=float(spread[i, j]) * 1e9,
                    n_paths=int(count[i, j]),
                    los=bool(seen[i, j]),
                )
            )
    return records
