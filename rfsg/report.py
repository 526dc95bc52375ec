"""The files of a run: links, paths, channel, map and report; and the tables of what a scene holds.

Everything is written beside its final place and then renamed: a run that fails leaves nothing
half-written behind, and nothing that is there is replaced unless it is asked for.
"""

import csv
import json
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rfsg.objects.plain import array

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene

LINK_COLUMNS = (
    "tx",
    "rx",
    "path_gain_db",
    "rss_dbm",
    "mean_delay_ns",
    "delay_spread_ns",
    "excess_delay_ns",
    "k_factor_db",
    "coherence_bandwidth_hz",
    "asd_deg",
    "asa_deg",
    "zsd_deg",
    "zsa_deg",
    "doppler_spread_hz",
    "coherence_time_s",
    "n_paths",
    "los",
)
PATH_COLUMNS = (
    "tx",
    "rx",
    "delay_ns",
    "gain_db",
    "phase_rad",
    "doppler_hz",
    "aod_azimuth_deg",
    "aod_elevation_deg",
    "aoa_azimuth_deg",
    "aoa_elevation_deg",
    "interactions",
    "vertices",
)
_PACKAGES = ("rfsg", "torch", "numpy", "scipy", "embreex", "usd-core", "manifold3d", "trimesh")


class OutputExists(Exception):
    """The place to write to is taken, and overwriting was not asked for."""


def refuse_taken(out: Path, overwrite: bool) -> None:
    """Raise OutputExists if ``out`` is a file, or a folder with something in it."""
    if overwrite and not (out.exists() and not out.is_dir()):
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        kind = "is not empty" if out.is_dir() else "is a file, not a folder"
        raise OutputExists(f"{out}: {kind}; choose another place, or say --overwrite")


@contextmanager
def output_folder(out: Path, overwrite: bool = False) -> Iterator[Path]:
    """A folder to write into that becomes ``out`` when all went well, and vanishes otherwise.

    With ``overwrite``, files of the same names are replaced one by one; others stay.
    Raises OutputExists as ``refuse_taken`` does.
    """
    refuse_taken(out, overwrite)
    out.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        yield beside
        out.mkdir(exist_ok=True)
        for file in sorted(beside.iterdir()):
            if file.is_dir():  # a folder takes the place of one of its name, whole
                shutil.rmtree(out / file.name, ignore_errors=True)
            os.replace(file, out / file.name)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_links(result: Any, file: Path) -> None:
    """links.csv: one row per transmitter and receiver; cells without a finite value stay empty."""
    _write_table(file, LINK_COLUMNS, result.links())


def write_paths(result: Any, file: Path) -> None:
    """paths.csv: one row per arriving path; columns and order are those of ``pathtable.path_rows``."""
    from rfsg.tracer.pathtable import path_rows

    _write_table(file, PATH_COLUMNS, path_rows(result))


def write_channel(result: Any, file: Path, responses: dict[str, Any] | None = None) -> None:
    """channel.npz: the whole channel and its paths as arrays; ``np.load`` needs no pickle.

    gain [p, f] complex, delay [p] s, frequency [f] Hz, doppler [p] Hz, departure and arrival
    [p, 3], tx and rx [p] into tx_paths and rx_paths, which [p, d] and crossed [x, 3] into
    node_paths (-1 pads), act and item [p, d] as in ``records.Paths``, vertices [p, d+2, 3] m, status
    [p], path_gain [tx, rx, f] linear; with ``responses``, what ``response_arrays`` gives. Where a
    radio has several ports: mimo [tx, rx, f, ports of rx, ports of tx], zeros beyond the
    mimo_tx_ports [tx] and mimo_rx_ports [rx] that each has.
    """
    scene, channel, paths = result.scene, result.channel, result.paths
    names = ("tx", "rx", "frequency", "delay", "gain", "doppler", "departure", "arrival")
    arrays: dict[str, Any] = {
        name: array(getattr(channel, name)) for name in (*names, "crossed", "blocked")
    }
    shared = ("which", "act", "item", "vertices", "status")
    arrays |= {name: array(getattr(paths, name)) for name in shared}
    arrays |= {
        "path_gain": array(result.path_gain()),
        "tx_paths": np.array([radio.path for radio in scene.transmitters], dtype=str),
        "rx_paths": np.array([radio.path for radio in scene.receivers], dtype=str),
        "node_paths": np.array([node.path for node in scene.nodes], dtype=str),
    }
    np.savez_compressed(file, **arrays, **(responses or {}), **_mimo_arrays(result))


def response_arrays(
    result: Any,
    bandwidth_hz: float | None = None,
    subcarriers: int = 64,
    snapshots: int | None = None,
    duration_s: float | None = None,
) -> dict[str, Any]:
    """What a channel does to a signal, about each frequency f of the run, for channel.npz.

    With ``snapshots``: time [s], evenly over ``duration_s`` from 0; transfer [tx, rx, f, s]. With a
    bandwidth: subcarrier_frequency [f, k] Hz, cfr [tx, rx, f, s, k]; taps [tx, rx, f, s, l], the
    first of which is tap number first_tap; bandwidth. Raises ValueError for what makes no response.
    """
    import torch

    from rfsg.tracer import response

    size = len(result.scene.transmitters), len(result.scene.receivers)
    time = torch.zeros(1, dtype=torch.float64)
    if snapshots is not None:
        if not (snapshots >= 1 and duration_s and 0 < duration_s < float("inf")):
            raise ValueError(f"{snapshots} snapshots over {duration_s} s: expected both above 0")
        time = torch.arange(snapshots, dtype=torch.float64) * (duration_s / snapshots)
    carriers = [
        response.at_carrier(result.channel, k) for k in range(len(result.channel.frequency))
    ]

    def over(bands: list[Any]) -> np.ndarray:
        found = zip(carriers, bands, strict=True)
        parts = [response.frequency_response(one, *size, band, time) for one, band in found]
        return array(torch.stack(parts, 2))

    arrays: dict[str, Any] = {}
    if snapshots is not None:
        arrays |= {"time": array(time), "transfer": over([c.frequency for c in carriers])[..., 0]}
    if bandwidth_hz is not None:
        bands = [
            response.subcarriers(float(f), bandwidth_hz, subcarriers)
            for f in result.channel.frequency
        ]
        sampled = [response.taps(one, *size, bandwidth_hz, time=time) for one in carriers]
        arrays |= {
            "bandwidth": float(bandwidth_hz),
            "subcarrier_frequency": np.stack([array(band) for band in bands]),
            "cfr": over(bands),
            "taps": array(torch.stack([t.gain for t in sampled], 2)),
            "first_tap": sampled[0].first,
        }
    return arrays


def _mimo_arrays(result: Any) -> dict[str, Any]:
    """The mimo_* arrays of channel.npz; why there are none, if there should be; else nothing."""
    from rfsg.scene.radios import port_names
    from rfsg.scene.scene import SceneError
    from rfsg.tracer.mimo import mimo

    radios = (*result.scene.transmitters, *result.scene.receivers)
    if all(len(port_names(radio)) == 1 for radio in radios):
        return {}
    try:
        found = mimo(result)
        matrices = found.padded()
    except SceneError as error:  # too large; the rest of the run is not lost for it
        return {"mimo_left_out": np.array(str(error))}
    return {
        "mimo": array(matrices),
        "mimo_tx_ports": np.array([len(ports) for ports in found.tx_ports]),
        "mimo_rx_ports": np.array([len(ports) for ports in found.rx_ports]),
    }


def write_map(
    radio_map: Any, file: Path, bandwidth_hz: float = 20e6, noise_figure_db: float = 0.0
) -> None:
    """map.npz: path_gain [tx, *c] linear; error_db, path_loss_db, rss_dbm and sinr_db alike;
    best_server [*c], -1 for none; tx_paths, frequency, bandwidth and noise_figure_db of the SINR.

    On a plane *c is [ny, nx]: cell [m], x [nx] and y [ny], the cells' middles in the plane, which
    stand at origin + x u + y v in the world. On a surface it is [c]: triangle [k, 3, 3] and whose each
    is, owner [k]; point and normal [c, 3], area [c].
    """
    cells = radio_map.cells
    names = (
        ("x", "y", "cell")
        if hasattr(cells, "plane")
        else ("triangle", "owner", "point", "normal", "area")
    )
    arrays: dict[str, Any] = {name: array(getattr(cells, name)) for name in names}
    if hasattr(cells, "plane"):
        u, v = array(cells.plane.rotation).T[:2]
        arrays |= {"origin": array(cells.plane.translation), "u": u, "v": v}
    np.savez_compressed(
        file,
        **arrays,
        path_gain=array(radio_map.path_gain),
        error_db=array(radio_map.error_db),
        path_loss_db=array(radio_map.path_loss_db()),
        rss_dbm=array(radio_map.rss_dbm()),
        sinr_db=array(radio_map.sinr_db(bandwidth_hz, noise_figure_db)),
        best_server=array(radio_map.best_server()),
        tx_paths=np.array([radio.path for radio in radio_map.scene.transmitters], dtype=str),
        frequency=float(radio_map.frequency),
        bandwidth=float(bandwidth_hz),
        noise_figure_db=float(noise_figure_db),
    )


def write_json(facts: dict[str, Any], file: Path) -> None:
    """A dictionary as readable JSON; numbers that JSON does not know become null."""
    text = json.dumps(_plain(facts), indent=2, ensure_ascii=False, allow_nan=False)
    file.write_text(text + "\n", encoding="utf-8")


def report(result: Any, **facts: Any) -> dict[str, Any]:
    """What report.json holds: what was asked, modelled, left out, counted and timed."""
    from rfsg.tracer.pathtable import arriving
    from rfsg.tracer.records import Status

    sentences = {status.name: status.sentence for status in Status}
    return facts | {
        "quality": _plain(result.plan.quality),
        "frequency_hz": array(result.channel.frequency).tolist(),
        "modelled": list(result.plan.modelled),
        "left_out": list(result.plan.left_out),
        "objects": len(result.scene.nodes),
        "transmitters": len(result.scene.transmitters),
        "receivers": len(result.scene.receivers),
        "paths": int(len(arriving(result.channel))),
        "status_counts": dict(result.status_counts),
        "status_meaning": {k: sentences[k] for k in result.status_counts if k in sentences},
        "search": result.search,
        "seconds": dict(result.seconds),
        "peak_bytes": result.peak_bytes,
        "warnings": list(result.warnings),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide the numbers."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def scene_table(scene: "Scene") -> list[dict[str, Any]]:
    """One row per object: its kinds, how many numbers they hold, its size and place [m]."""
    return [_node_row(node) for node in scene.nodes]


def parameter_table(scene: "Scene") -> list[dict[str, Any]]:
    """One row per parameter tensor that a fit may change; objects of one asset share theirs."""
    return [
        {
            "path": f"{node.path}.{name}",
            "shape": " x ".join(map(str, tensor.shape)) or "scalar",
            "value": f"{float(tensor.detach()):.4g}" if tensor.numel() == 1 else "",
        }
        for node in scene.nodes
        for name, tensor in node.body.named_parameters()
    ]


def radio_table(scene: "Scene") -> list[dict[str, Any]]:
    """One row per radio, transmitters first: its place [m], power, pattern and array."""
    rows = [_radio_row("transmitter", radio) for radio in scene.transmitters]
    return rows + [_radio_row("receiver", radio) for radio in scene.receivers]


def short(value: Any) -> str:
    """A value for a table: numbers to four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _radio_row(role: str, radio: Any) -> dict[str, Any]:
    power = f"{radio.power_dbm:g}" if role == "transmitter" else ""
    row = {"path": radio.path, "role": role, "at [m]": _place(radio.position)}
    row |= {"power [dBm]": power, "pattern": radio.pattern, "polarization": radio.polarization}
    return row | {"array": "" if radio.array is None else radio.array}


def _node_row(node: Any) -> dict[str, Any]:
    shape, surface = node.body.shape, node.body.surface
    low, high = array(shape.bounds()) * float(node.pose.scale.detach())
    config = surface.config() if hasattr(surface, "config") else {}
    return {
        "path": node.path,
        "shape": shape.kind,
        "surface": surface.kind,
        "parameters": f"{_count(shape)} + {_count(surface)}",
        "size [m]": " x ".join(f"{x:.3g}" for x in high - low),
        "at [m]": _place(node.pose.translation),
        "settings": " ".join(
            f"{k}={short(v).replace(' ', '')}" for k, v in config.items() if v is not None
        ),
    }


def _count(module: Any) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def _place(point: Any) -> str:
    return " ".join(f"{x:.3g}" for x in array(point))


def _write_table(file: Path, columns: tuple[str, ...], rows: list[dict[str, Any]]) -> None:
    with open(file, "w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, columns, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow({name: _cell(row[name]) for name in columns})


def _cell(value: Any) -> Any:
    """Numbers to nine digits (a delay to femtoseconds); what is not finite stays empty."""
    if isinstance(value, bool | np.bool_):
        return int(value)
    if isinstance(value, float | np.floating):
        return f"{float(value) + 0.0:.9g}" if np.isfinite(value) else ""  # no -0
    return value


def _plain(value: Any) -> Any:
    """Anything of ours as JSON knows it."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    if value is None or isinstance(value, str | int | bool):
        return value
    return str(value)
