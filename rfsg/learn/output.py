"""Everything about a fit in one folder.

scene.usda          the scene with what was learned; references assets/
assets/NAME.usda    every fitted object, with what it was trained on
history.csv         one line per step
predictions.csv     measured and predicted, reading by reading
measurements.csv    the readings that were used
residual.safetensors  what the scene leaves of powers, where that was asked for
report.json         errors before and after, counts, settings; written last
checkpoint.safetensors
"""

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from rfsg.learn.losses import residual_db
from rfsg.learn.measurements import Quantity
from rfsg.learn.model import REPORT, RESIDUAL, SCENE
from rfsg.learn.selection import Selection
from rfsg.objects.body import Body
from rfsg.objects.shapes.proxy import extract_mesh
from rfsg.scene.assets import save_asset
from rfsg.scene.scene import Scene
from rfsg.scene.weights import refuse_overwrite, write_beside

if TYPE_CHECKING:
    from rfsg.learn.fit import Fitted

CHECKPOINT = "checkpoint.safetensors"
FILES = (SCENE, "history.csv", "predictions.csv", "measurements.csv", RESIDUAL, REPORT)
SHOWN_TOLERANCE = 0.002  # [m] by which the mesh that is only shown may differ from the zero mesh


def prepare(folder: Path, resume: bool, overwrite: bool) -> Path:
    """Make the folder; SceneError where it holds a fit that is neither resumed nor overwritten."""
    if not resume:
        refuse_overwrite([folder / name for name in (*FILES, CHECKPOINT)], overwrite)
        (folder / CHECKPOINT).unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write(folder: Path, fitted: "Fitted", selection: Selection) -> None:
    """Write all but the checkpoint; each file whole or not at all."""
    scene = save_assets(folder / "assets", fitted, selection)
    scene.to_usd(folder / SCENE, overwrite=True)
    write_beside(folder / "history.csv", _history(fitted.history), True)
    write_beside(folder / "predictions.csv", _predictions(fitted), True)
    write_beside(folder / "measurements.csv", fitted.measured.csv(), True)
    if fitted.spread is not None and fitted.spread.residual is not None:
        write_beside(folder / RESIDUAL, fitted.spread.residual.pack(), True)
    else:
        (folder / RESIDUAL).unlink(missing_ok=True)  # of a fit that is overwritten
    write_beside(folder / REPORT, to_json(fitted.report), True)


def save_assets(folder: Path, fitted: "Fitted", selection: Selection) -> Scene:
    """Every fitted body that a network describes, as an asset; the scene that refers to them."""
    scene, files = fitted.scene, {}
    nodes = list(scene.nodes)
    for i in selection.nodes("shape", "surface"):
        body = nodes[i].body
        if body.shape.kind != "neural" and body.surface.kind != "stochastic":
            continue  # known shapes and materials are written into the scene itself
        if id(body) not in files:
            body.band = _band(fitted)
            folder.mkdir(exist_ok=True)
            name = nodes[i].path.rsplit("/", 1)[-1]
            taken = {f.stem for f in files.values()}
            unused = (f"{name}_{k}" if k else name for k in range(len(taken) + 1))
            file = folder / f"{next(n for n in unused if n not in taken)}.usda"
            told = _provenance(fitted, nodes[i].path)
            files[id(body)] = save_asset(
                file, body, mesh=_mesh(body), provenance=told, overwrite=True
            )
        nodes[i] = replace(nodes[i], asset=str(files[id(body)]))
    return replace(scene, nodes=tuple(nodes))


def _band(fitted: "Fitted") -> tuple[float, float]:
    """The lowest and highest frequency of the readings [Hz]: where what was learned is known."""
    heard = fitted.report["frequency_hz"]
    return min(heard), max(heard)


def to_json(report: dict[str, Any]) -> bytes:
    """Strict JSON: no NaN, no infinity."""
    return (json.dumps(_finite(report), indent=2, allow_nan=False) + "\n").encode()


def _provenance(fitted: "Fitted", path: str) -> dict[str, Any]:
    report = fitted.report
    return {
        "learned_from": f"{report['readings']['train']} readings"
        + (f" of {Path(report['source']).name}" if report["source"] else ""),
        "learned": [row["parameter"] for row in report["selected"] if path in _of(row)],
        "frequency_band_hz": list(_band(fitted)),
        "train": report["train"]["after"],
        "validation": report["validation"]["after"],
        "steps": report["steps"],
        "seed": report["settings"]["seed"],
    }


def _of(row: dict[str, Any]) -> list[str]:
    return [*row["objects"], *row["also"]]


def _mesh(body: Body) -> Any:
    return extract_mesh(body.shape, simplify=SHOWN_TOLERANCE) if not body.shape.exact else None


def _history(history: dict[str, list[float]]) -> bytes:
    columns = list(history)
    rows = zip(*history.values(), strict=True)
    return _csv(["step", *columns], ([k + 1, *row] for k, row in enumerate(rows)))


COLUMNS = (
    "tx rx frequency_hz quantity measured predicted low high with_residual with_residual_low "
    "with_residual_high error_db used"
).split()


def _predictions(fitted: "Fitted") -> bytes:
    """One line per reading, in the units of its kind: dBm, dB, or seconds."""
    measured, after = fitted.measured, fitted.after
    value = {
        Quantity.RSSI: after.rssi_dbm().tolist(),
        Quantity.PATH_GAIN: after.path_gain_db().tolist(),
        Quantity.DELAY: after.delay.tolist(),
    }
    value[Quantity.GAIN] = value[Quantity.PATH_GAIN]
    off = residual_db(after, measured).tolist()
    beside = _beside(fitted)
    rows = []
    for i, kind in enumerate(measured.quantity.tolist()):
        quantity = Quantity(kind)
        arrives, received = bool(after.arrives[i]), bool(measured.received[i])
        shown, said = float(measured.value[i, 0]), value[quantity][i]
        if quantity == Quantity.GAIN:
            shown = 20.0 * math.log10(float(torch.linalg.vector_norm(measured.value[i])))
        around = beside[i] if beside else [None] * 5
        rows.append(
            [
                _name(measured.tx_places[int(measured.tx[i])]),
                _name(measured.rx_places[int(measured.rx[i])]),
                float(measured.frequency[i]),
                quantity.name.lower(),
                shown if received else "",
                said if arrives else "",
                *("" if x is None else said + x for x in around),
                off[i] if arrives and received and quantity != Quantity.DELAY else "",
                "validation" if bool(fitted.held[i]) else "train",
            ]
        )
    return _csv(COLUMNS, rows)


def _beside(fitted: "Fitted") -> list[list[float | None]]:
    """Bounds, and what stands in the columns with the residual, about each prediction [dB]."""
    spread = fitted.spread
    if spread is None:
        return []
    columns = [*spread.interval]
    if spread.left is not None and spread.left_interval is not None:
        columns += [spread.left, *spread.left_interval]
    rows = torch.stack(columns, -1).tolist()
    none: list[float | None] = [None] * 5
    return [
        [*row, *none][:5] if there else none
        for row, there in zip(rows, spread.of.tolist(), strict=True)
    ]


def _name(place: Any) -> str:
    return place if isinstance(place, str) else " ".join(f"{x:g}" for x in place)


def _csv(names: Sequence[str], rows: Any) -> bytes:
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(rows)
    return file.getvalue().encode()


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
