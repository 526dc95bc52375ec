"""The arriving paths of a result as rows: what paths.csv, tables and labelled arrays are made of."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from rfsg.objects.plain import array
from rfsg.tracer.channel import coefficients
from rfsg.tracer.records import Act, Channel

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene
    from rfsg.tracer.simulate import Result


def arriving(channel: Channel) -> ndarray:
    """Indices of the paths that carry power, link by link, strongest first."""
    power = np.abs(array(channel.gain)[:, 0]) ** 2
    tx, rx = array(channel.tx), array(channel.rx)
    order = np.lexsort((-power, rx, tx))
    return order[(power[order] > 0) & ~array(channel.blocked)[order]]


def angles_deg(direction: ndarray) -> ndarray:
    """Azimuth and elevation [deg] of unit vectors [n, 3]: [n, 2]."""
    x, y, z = direction.T + 0.0  # -0 would turn +180 degrees into -180
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    return np.degrees(np.stack([azimuth, elevation], axis=-1))


def path_rows(result: "Result") -> list[dict[str, Any]]:
    """One row per arriving path, link by link, strongest first, at the first frequency.

    ``phase_rad`` is that of gain * exp(-j 2 pi f delay), in (-pi, pi]. Angles are in the world:
    departure along the travel from the transmitter, arrival from the receiver back to the wave.
    ``interactions`` lists what happens in order along the path, in the words of ``records.Act`` and
    "penetration"; ``vertices`` is "x y z; x y z".
    """
    scene, paths, channel = result.scene, result.paths, result.channel
    gain, delay, doppler = (array(x) for x in (channel.gain, channel.delay, channel.doppler))
    which, act, vertices = (array(x) for x in (paths.which, paths.act, paths.vertices))
    phase = np.angle(array(coefficients(channel))[:, 0])
    tx, rx = array(channel.tx), array(channel.rx)
    leave, arrive = angles_deg(array(channel.departure)), angles_deg(array(channel.arrival))
    through = crossed_by_path(channel)
    rows = []
    for p in arriving(channel):
        acts = [(int(a), int(i)) for a, i in zip(act[p], which[p], strict=True) if i >= 0]
        corners = vertices[p][: len(acts) + 2]
        rows.append(
            {
                "tx": scene.transmitters[tx[p]].path,
                "rx": scene.receivers[rx[p]].path,
                "delay_ns": 1e9 * delay[p],
                "gain_db": 20 * np.log10(abs(gain[p, 0])),
                "phase_rad": phase[p],
                "doppler_hz": doppler[p],
                "aod_azimuth_deg": leave[p, 0],
                "aod_elevation_deg": leave[p, 1],
                "aoa_azimuth_deg": arrive[p, 0],
                "aoa_elevation_deg": arrive[p, 1],
                "interactions": interactions(scene, acts, through.get(int(p), [])),
                "vertices": "; ".join(" ".join(f"{x:.6f}" for x in corner) for corner in corners),
            }
        )
    return rows


def interactions(
    scene: "Scene", acts: list[tuple[int, int]], crossed: list[tuple[int, int]]
) -> str:
    """What happens at vertices, as (act, node), and penetrations, as (segment, node), in order."""
    words = []
    for segment in range(len(acts) + 1):
        words += [f"penetration({scene.nodes[i].path})" for s, i in crossed if s == segment]
        if segment < len(acts):
            act, node = acts[segment]
            words.append(f"{Act(act).word}({scene.nodes[node].path})")
    return " ".join(words) or "line_of_sight"


def crossed_by_path(channel: Channel) -> dict[int, list[tuple[int, int]]]:
    """(segment, node) of everything that each path goes through, in order."""
    through: dict[int, list[tuple[int, int]]] = {}
    for path, node, segment in array(channel.crossed).tolist():
        through.setdefault(path, []).append((segment, node))
    return through
