"""A fitted scene that predicts: powers, the interval they lie in, and both with the residual.

    said = load("fitted").predict(measurements)
    said.rssi_dbm(), said.interval_dbm
    said.with_residual_dbm, said.with_residual_interval_dbm

``Fitted.model`` is one as well.
"""

import json
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.learn.errors import LearnError
from rfsg.learn.kept import Kept
from rfsg.learn.losses import Predicted
from rfsg.learn.measurements import Measurements
from rfsg.learn.mixture import INTERVAL, Mixture
from rfsg.learn.over_scene import Ends, SceneResidual
from rfsg.learn.predict import predict_kept, search
from rfsg.learn.uncertainty import LinkPaths, Uncertainty, widened
from rfsg.scene.scene import Scene
from rfsg.tracer.plan import Quality

SCENE, REPORT, RESIDUAL = "scene.usda", "report.json", "residual.safetensors"
Interval = tuple[Float[Tensor, "n"], Float[Tensor, "n"]]


@dataclass(frozen=True)
class Predictive(Predicted):
    """What a fitted scene says of n readings, and how sure it is of their powers.

    Where ``arrives`` is False, nothing is meant. What takes time is computed when it is asked for: ask
    before weights change. kept: the paths; scene: in which they were found; moved: whether that is
    another than the model's own.
    """

    model: "Model"
    kept: Kept
    scene: Scene
    moved: bool

    @cached_property
    def interval_dbm(self) -> Interval | None:
        """5 % and 95 % bounds [dBm] of new readings of power, by physics alone; None without powers in
        the fit."""
        sure, links = self.model.uncertainty, self.kept.links
        if sure is None:
            return None
        paths = LinkPaths.of(self.kept, self.scene, self.model.coherent)
        return sure.interval(self.rssi_dbm(), paths, links.link_of, links.frequency_of)

    @cached_property
    def left(self) -> Mixture | None:
        """Readings less ``rssi_dbm`` [dB], as the residual has them; None without one."""
        if self.model.residual is None:
            return None
        return self.model.residual.at(Ends.of(self.kept.links), moved=self.moved)

    @cached_property
    def with_residual_dbm(self) -> Float[Tensor, "n"] | None:
        """Median of new readings [dBm], with what the scene leaves; None without a residual."""
        if self.left is None:
            return None
        return self.rssi_dbm() + torch.from_numpy(self.left.quantile(0.5))

    @cached_property
    def with_residual_interval_dbm(self) -> Interval | None:
        """5 % and 95 % bounds [dBm] of new readings, with the residual; None without one."""
        if self.left is None:
            return None
        low, high = (self.rssi_dbm() + end for end in bounds_of(self.left))
        return widened(low, high, self.model.residual_widened_db)


def bounds_of(left: Mixture) -> Interval:
    """5 % and 95 % quantiles."""
    tail = 0.5 * (1.0 - INTERVAL)
    return torch.from_numpy(left.quantile(tail)), torch.from_numpy(left.quantile(1.0 - tail))


@dataclass(frozen=True)
class Model:
    """A fitted scene, and what no scene holds: offsets of radios, noise, what physics leaves.

    gains_db: by radio's path. offset_db: of what sends and is no transmitter of the scene.
    residual_widened_db: as ``Uncertainty.widened_db``, of the interval with the residual.
    """

    scene: Scene
    quality: Quality
    coherent: bool = True
    gains_db: dict[str, float] = field(default_factory=dict)
    offset_db: float = 0.0
    uncertainty: Uncertainty | None = None
    residual: SceneResidual | None = None
    residual_widened_db: float = 0.0

    def predict(self, measured: Measurements, scene: Scene | None = None) -> Predictive:
        """What the fitted scene, or one made from it, says of readings; their values are not read.

        With another scene, one with an object moved say, the residual gives its common term alone.
        """
        moved = scene is not None and scene is not self.scene
        scene = self.scene if scene is None else scene
        kept = search(scene, measured, self.quality)
        said = predict_kept(kept, scene, self.coherent, self.gains_db, self.offset_db)
        known = {f.name: getattr(said, f.name) for f in fields(Predicted)}
        return Predictive(**known, model=self, kept=kept, scene=scene, moved=moved)


def load(folder: str | Path) -> Model:
    """What a fit left in its folder, ready to predict. Learned objects stay files of that folder.

    Raises LearnError where the folder holds no finished fit, SceneError for a scene at fault.
    """
    folder = Path(folder)
    report = _report(folder / REPORT)
    try:
        settings, offsets = report["settings"], report["offsets"]
        sure, left = report["uncertainty"], report["residual"]
        model = {
            "quality": Quality(**settings["quality"]),
            "coherent": bool(settings["losses"]["coherent"]),
            "gains_db": {str(k): float(v) for k, v in offsets["gains_db"].items()},
            "offset_db": float(offsets["power_db"] or 0.0),
            "uncertainty": None if sure is None else Uncertainty(**sure["law"]),
            "residual_widened_db": 0.0 if left is None else float(left["widened_db"]),
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise LearnError(
            f"{folder / REPORT}: not the report of a fit by this version of rfsg: {error!r}"
        ) from error
    file = folder / RESIDUAL
    residual = None if left is None else SceneResidual.unpack(file)
    return Model(scene=Scene.from_usd(folder / SCENE), residual=residual, **model)


def _report(file: Path) -> dict[str, Any]:
    try:
        report = json.loads(file.read_bytes())
    except (OSError, ValueError) as error:
        raise LearnError(
            f"{file}: cannot be read ({error}); expected the folder of a finished fit"
        ) from error
    if not isinstance(report, dict):
        raise LearnError(f"{file}: expected the report of a fit")
    return report
