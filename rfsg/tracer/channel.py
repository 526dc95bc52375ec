"""What people read off a channel: transfer function, power, noise, and one record per link."""

import math
from typing import TypedDict

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.scene.scene import Scene
from rfsg.tracer import spreads
from rfsg.tracer.links import link_of, summed
from rfsg.tracer.records import Channel, Paths
from rfsg.tracer.response import at_carrier

BOLTZMANN = 1.380649e-23  # [J/K], exact (SI)


class Link(TypedDict):
    """One transmitter and one receiver, at the first frequency; definitions in ``docs/channel.md``.

    Where nothing arrives: dB are -inf, spreads 0, coherence inf. Never NaN.
    """

    tx: str
    rx: str
    path_gain_db: float  # 10 log10 |h|^2
    rss_dbm: float  # received signal strength
    mean_delay_ns: float
    delay_spread_ns: float  # rms; 0 for one path
    excess_delay_ns: float  # from the first to the last path within 20 dB of the strongest
    k_factor_db: float  # the strongest path over all others; inf for one path
    coherence_bandwidth_hz: float  # frequency correlation falls to 0.5; inf if it does not
    asd_deg: float  # azimuth spread of departure; then of arrival, zenith alike
    asa_deg: float
    zsd_deg: float
    zsa_deg: float
    doppler_spread_hz: float  # rms
    coherence_time_s: float  # time correlation falls to 0.5; inf if it does not
    n_paths: int
    los: bool  # a path without any interaction arrives through nothing


def coefficients(channel: Channel) -> Complex[Tensor, "p f"]:
    """gain exp(-j 2 pi f tau): each path's share of h(f). The phase is reduced in float64 turns."""
    turns = channel.frequency[None] * channel.delay[:, None]
    phase = -2.0 * math.pi * (turns - torch.floor(turns.detach()))
    return channel.gain * torch.polar(torch.ones_like(phase), phase)


def transfer(channel: Channel, n_tx: int, n_rx: int) -> Complex[Tensor, "t r f"]:
    """h(f) = sum over paths of gain exp(-j 2 pi f tau)."""
    return summed(channel, coefficients(channel), n_tx, n_rx)


def power(channel: Channel, n_tx: int, n_rx: int) -> Float[Tensor, "t r f"]:
    """Incoherent path gain, the sum of |gain|^2: what remains when phases are averaged over."""
    return summed(channel, channel.gain.real**2 + channel.gain.imag**2, n_tx, n_rx)


def thermal_noise_dbm(
    bandwidth_hz: float, noise_figure_db: float = 0.0, temperature_k: float = 290.0
) -> float:
    """k T B of a receiver with a noise figure [dBm]: -173.98 dBm in 1 Hz at 290 K (ITU-R P.372).

    Raises ValueError for numbers that are not finite, a band or temperature not above 0.
    """
    numbers = (bandwidth_hz, noise_figure_db, temperature_k)
    if not (all(map(math.isfinite, numbers)) and bandwidth_hz > 0 and temperature_k > 0):
        raise ValueError(
            f"noise: bandwidth {bandwidth_hz!r} Hz, noise figure {noise_figure_db!r} dB, temperature "
            f"{temperature_k!r} K: expected finite numbers, bandwidth and temperature above 0"
        )
    return 10.0 * math.log10(BOLTZMANN * temperature_k * bandwidth_hz * 1e3) + noise_figure_db


def line_of_sight(paths: Paths, channel: Channel, n_tx: int, n_rx: int) -> Int[Tensor, "t r"]:
    """1 where a path arrives without touching or crossing anything."""
    clear = (paths.which >= 0).sum(1) == 0
    clear[channel.crossed[:, 0]] = False
    return (summed(channel, clear.long(), n_tx, n_rx) > 0).long()


@torch.no_grad()
def links(scene: Scene, paths: Paths, channel: Channel) -> list[Link]:
    """One record per transmitter and receiver, in scene order."""
    t, r = size = len(scene.transmitters), len(scene.receivers)
    channel = at_carrier(channel, 0)
    angles = spreads.angular_spreads(channel, *size)
    columns = {
        "path_gain_db": 10.0 * torch.log10(transfer(channel, *size).abs() ** 2),
        "mean_delay_ns": 1e9 * spreads.mean_delay(channel, *size),
        "delay_spread_ns": 1e9 * spreads.delay_spread(channel, *size),
        "excess_delay_ns": 1e9 * spreads.maximum_excess_delay(channel, *size),
        "k_factor_db": 10.0 * torch.log10(spreads.k_factor(channel, *size)),
        "coherence_bandwidth_hz": spreads.coherence_bandwidth(channel, *size),
        "doppler_spread_hz": spreads.doppler_spread(channel, *size),
        "coherence_time_s": spreads.coherence_time(channel, *size),
    } | {f"{name}_deg": torch.rad2deg(angle) for name, angle in angles._asdict().items()}
    table = {name: column[..., 0].tolist() for name, column in columns.items()}
    seen = line_of_sight(paths, channel, *size).tolist()
    arrives = link_of(channel, r)[~channel.blocked]
    count = torch.bincount(arrives, minlength=t * r).reshape(t, r).tolist()
    records: list[Link] = []
    for i, tx in enumerate(scene.transmitters):
        for j, rx in enumerate(scene.receivers):
            row = {name: column[i][j] for name, column in table.items()}
            rss = tx.power_dbm + row["path_gain_db"]
            flags = {"n_paths": count[i][j], "los": bool(seen[i][j])}
            records.append(Link(tx=tx.path, rx=rx.path, rss_dbm=rss, **row, **flags))  # type: ignore[typeddict-item]
    return records
