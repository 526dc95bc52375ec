"""Channels in the layouts that other tools read: Sionna's impulse responses, DeepMIMO's matrices.

Numpy arrays, axes as those tools document them; docs/interchange.md has the table. Nothing is dropped:
the path axis is as long as the busiest link needs, and the rest is padded as the tool pads.

Phases: h(f) = sum a_i exp(-j 2 pi f tau_i), so the baseband coefficient is a_i exp(-j 2 pi f_c tau_i).
Both tools take it so. Angles: azimuth from +x towards +y, zenith from +z, in the world; arrival angles
look from the receiver back to the wave.
"""

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from numpy import ndarray
from torch import Tensor

from rfsg.objects.plain import array
from rfsg.report import output_folder, write_json
from rfsg.scene.errors import SceneError
from rfsg.scene.radios import port_names
from rfsg.scene.weights import write_beside
from rfsg.tracer.mimo import port_gains
from rfsg.tracer.pathtable import arriving, crossed_by_path
from rfsg.tracer.records import Act
from rfsg.tracer.response import at_carrier

if TYPE_CHECKING:
    from rfsg.tracer.simulate import Result

MOST_VALUES = 1 << 27  # complex numbers in one array: 2 GiB; more is a mistyped size
ABSENT = -1.0  # Sionna's delay of a path that is not there

REFLECTION, DIFFRACTION, SCATTERING, TRANSMISSION = 1, 2, 3, 4  # DeepMIMO's codes
_CODES = {
    Act.REFLECT: REFLECTION,
    Act.DIFFRACT: DIFFRACTION,
    Act.SCATTER: SCATTERING,
    Act.ENTER: TRANSMISSION,
    Act.LEAVE: TRANSMISSION,
}


@dataclass(frozen=True)
class Cir:
    """Sionna RT's ``Paths.cir``: coefficients with the carrier's phase, and delays.

    a: complex [num_rx, num_rx_ant, num_tx, num_tx_ant, num_paths, num_time_steps], 0 in the padding.
    tau: [s] [num_rx, num_tx, num_paths], -1 in the padding; of the synthetic array, as there.
    """

    a: Complex[ndarray, "*b r ra t ta l s"]
    tau: Float[ndarray, "*b r t l"]

    def batched(self) -> "Cir":
        """With the leading batch axis of one that Sionna PHY and SYS expect."""
        return Cir(self.a[None], self.tau[None])


@torch.no_grad()
def sionna_cir(
    result: "Result",
    *,
    frequency: int = 0,
    time: Float[Tensor, "s"] | None = None,
    normalize_delays: bool = True,
) -> Cir:
    """The impulse response as Sionna RT's ``Paths.cir`` gives it, strongest path first.

    frequency: which of the result's. time: [s], by default t = 0. normalize_delays: the first path of
    every link arrives at 0, and phases count from there, as is the default there.
    Raises SceneError for more than 2^27 values.
    """
    scene, channel = result.scene, at_carrier(result.channel, frequency)
    carrier = float(channel.frequency)
    steps = torch.zeros(1, dtype=torch.float64) if time is None else time.double().reshape(-1)
    slots = _slots(result)
    most = max((len(p) for p in slots.values()), default=0)
    rx_ports, tx_ports = (
        max((len(port_names(r)) for r in side), default=0)
        for side in (scene.receivers, scene.transmitters)
    )
    shape = (len(scene.receivers), rx_ports, len(scene.transmitters), tx_ports, most, len(steps))
    if math.prod(shape) > MOST_VALUES:
        raise SceneError(
            [f"impulse response of {' x '.join(map(str, shape))} values: expected at most "
             f"{MOST_VALUES}; take fewer receivers, ports or times"]
        )  # fmt: skip
    a = np.zeros(shape, dtype=np.complex128)
    tau = np.full((shape[0], shape[2], most), ABSENT)
    for (i, j), paths in slots.items():
        if not len(paths):
            continue
        chosen = torch.from_numpy(paths).to(channel.tx.device)
        tx, rx = scene.transmitters[i], scene.receivers[j]
        gains = array(port_gains(channel, tx, rx, chosen))[:, 0]  # p, n_rx, n_tx
        delay = array(channel.delay[chosen])
        turn = array(channel.doppler[chosen])[:, None] * array(steps)
        if normalize_delays:
            first = delay.min()
            gains, delay = gains * np.exp(2j * np.pi * ((carrier * first) % 1.0)), delay - first
        course = gains[..., None] * np.exp(2j * np.pi * (turn % 1.0))[:, None, None]
        rows, columns = gains.shape[1:]
        a[j, :rows, i, :columns, : len(paths)] = np.moveaxis(course, 0, 2)
        tau[j, i, : len(paths)] = delay
    return Cir(a, tau)


@torch.no_grad()
def deepmimo_matrices(result: "Result", transmitter: int = 0) -> dict[str, ndarray]:
    """DeepMIMO v4's matrices of one transmitter and all receivers, at the first frequency.

    power [dBW for 1 W sent], phase [deg], delay [s], aoa_az, aoa_el, aod_az, aod_el [deg, el is the
    zenith angle], inter (digits: 1 reflection, 2 diffraction, 3 scattering, 4 transmission; 0 line of
    sight): [n_rx, max_paths], NaN in the padding. inter_pos [n_rx, max_paths, max_interactions, 3] m,
    rx_pos [n_rx, 3], tx_pos [1, 3]. Where a path goes straight through an object its place there is not
    kept: NaN. Between the reference ports of the radios, antennas included.
    """
    scene, channel = result.scene, result.channel
    slots = {j: p for (i, j), p in _slots(result).items() if i == transmitter}
    codes, places = _interactions(result)
    most = max((len(p) for p in slots.values()), default=0)
    deepest = max((len(places[p]) for mine in slots.values() for p in mine), default=0)
    count = len(scene.receivers)
    gain, delay = array(channel.gain)[:, 0], array(channel.delay)
    turns = (float(channel.frequency[0]) * delay) % 1.0
    phase = np.degrees(np.angle(gain * np.exp(-2j * np.pi * turns)))
    leaving, coming = (_azimuth_zenith(array(x)) for x in (channel.departure, channel.arrival))
    columns = {
        "power": 20.0 * np.log10(np.maximum(np.abs(gain), 1e-300)),
        "phase": phase,
        "delay": delay,
        "aoa_az": coming[:, 0],
        "aoa_el": coming[:, 1],
        "aod_az": leaving[:, 0],
        "aod_el": leaving[:, 1],
        "inter": codes,
    }
    found: dict[str, ndarray] = {name: np.full((count, most), np.nan) for name in columns}
    found["inter_pos"] = np.full((count, most, deepest, 3), np.nan)
    for j, mine in slots.items():
        for name, column in columns.items():
            found[name][j, : len(mine)] = column[mine]
        for slot, p in enumerate(mine):
            for k, place in enumerate(places[p]):
                found["inter_pos"][j, slot, k] = place
    sent, heard = scene.transmitters[transmitter : transmitter + 1], scene.receivers
    found["tx_pos"] = np.stack([array(r.position) for r in sent]).reshape(-1, 3)
    found["rx_pos"] = np.stack([array(r.position) for r in heard]).reshape(-1, 3)
    return found


def write_deepmimo(result: "Result", folder: str | Path, overwrite: bool = False) -> Path:
    """A scenario folder that ``deepmimo.load`` (version 4) reads: params.json and npz matrices.

    The folder's name is the scenario's; DeepMIMO asks for lower case. Objects and materials are left
    empty: their shapes are rfsg's. Raises SceneError for a name it refuses, OutputExists for a folder
    that is taken.
    """
    folder = Path(folder)
    scene = result.scene
    if folder.name != folder.name.lower() or set(folder.name) & set(":*?\"'<>|\n"):
        raise SceneError([f"{folder}: expected a scenario name in lower case, without :*?\"'<>|"])
    if not (scene.transmitters and scene.receivers):
        raise SceneError([f"{folder}: a scenario needs a transmitter and a receiver"])
    with output_folder(folder, overwrite) as place:
        for i in range(len(scene.transmitters)):
            for name, matrix in deepmimo_matrices(result, i).items():
                _save(place / f"{name}_t000_tx{i:03}_r001.npz", **{name: matrix})
        _save(place / "vertices.npz", vertices=np.zeros((0, 3)))
        (place / "objects.json").write_text("[]\n")
        write_json(_params(result), place / "params.json")
    return folder


def write_sionna(
    result: "Result", file: str | Path, time: Float[Tensor, "s"] | None = None
) -> Path:
    """NAME.npz with ``a`` and ``tau`` of ``sionna_cir``, batch axis first, and the radios' paths."""
    file, cir = Path(file), sionna_cir(result, time=time).batched()
    names = {
        "tx_paths": np.array([radio.path for radio in result.scene.transmitters], dtype=str),
        "rx_paths": np.array([radio.path for radio in result.scene.receivers], dtype=str),
    }
    _save(file, a=cir.a.astype(np.complex64), tau=cir.tau, frequency=result.frequency[0], **names)
    return file


def _save(file: Path, **arrays: Any) -> None:
    """Written beside its place, then renamed."""
    plain: dict[str, Any] = {name: array(value) for name, value in arrays.items()}
    data = io.BytesIO()
    np.savez_compressed(data, allow_pickle=False, **plain)
    write_beside(file, data.getvalue(), overwrite=True)


def _slots(result: "Result") -> dict[tuple[int, int], Int[ndarray, "m"]]:
    """The arriving paths of every (transmitter, receiver), strongest first."""
    order = arriving(result.channel)
    n_rx = len(result.scene.receivers)
    link = (array(result.channel.tx) * n_rx + array(result.channel.rx))[order]
    begin = np.searchsorted(link, np.arange(len(result.scene.transmitters) * n_rx + 1))
    return {
        divmod(k, n_rx): order[begin[k] : begin[k + 1]]
        for k in range(len(result.scene.transmitters) * n_rx)
    }


def _interactions(result: "Result") -> tuple[Float[ndarray, "p"], list[list[Any]]]:
    """DeepMIMO's code of every path, and where each of its digits happens [m], NaN if not kept."""
    paths = result.paths
    which, act, vertices = (array(x) for x in (paths.which, paths.act, paths.vertices))
    through = crossed_by_path(result.channel)
    codes, places = np.zeros(len(which)), []
    for p in range(len(which)):
        digits, where = [], []
        met = int((which[p] >= 0).sum())
        for segment in range(met + 1):
            crossed = sum(s == segment for s, _ in through.get(p, ()))
            digits += [TRANSMISSION] * crossed
            where += [np.full(3, np.nan)] * crossed
            if segment < met:
                digits.append(_CODES[Act(int(act[p, segment]))])
                where.append(vertices[p, segment + 1])
        codes[p] = float("".join(map(str, digits)) or 0)
        places.append(where)
    return codes, places


def _azimuth_zenith(direction: Float[ndarray, "p 3"]) -> Float[ndarray, "p 2"]:
    """Azimuth, and angle from +z [deg]."""
    x, y, z = direction.T + 0.0
    return np.degrees(np.stack([np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)], -1))


def _params(result: "Result") -> dict[str, Any]:
    """params.json, as ``deepmimo.load`` asks for it."""
    from rfsg import __version__

    quality, scene = result.plan.quality, result.scene
    sides = (("transmitters", scene.transmitters, True), ("receivers", scene.receivers, False))
    return {
        "version": "4.0.0",
        "rt_params": {
            "raytracer_name": "rfsg",
            "raytracer_version": __version__,
            "frequency": float(result.channel.frequency[0]),
            "max_path_depth": quality.depth,
            "max_reflections": quality.depth,
            "max_diffractions": quality.diffraction,
            "max_scattering": int(quality.diffuse > 0),
            "max_transmissions": int(result.paths.which.shape[1]) + 1,
            "num_rays": quality.rays,
            "synthetic_array": True,
        },
        "scene": {
            "num_scenes": 1,
            "n_objects": 0,
            "n_vertices": 0,
            "n_faces": 0,
            "n_triangular_faces": 0,
            "representation": "hull",
        },
        "materials": {},
        "txrx_sets": {
            f"txrx_set_{number}": {
                "name": name,
                "id_orig": number,
                "id": number,
                "is_tx": sends,
                "is_rx": not sends,
                "num_points": len(radios),
                "num_active_points": len(radios),
                "num_ant": 1,
                "dual_pol": False,
                "ant_rel_positions": [[0, 0, 0]],
                "array_orientation": [0, 0, 0],
                "grid_spacing": None,
            }
            for number, (name, radios, sends) in enumerate(sides)
        },
    }
