"""Fit what is selected of a scene to readings: ``rfsg.fit``.

    fitted = rfsg.fit(scene, "readings.csv", select=["/World/Cabinet.surface"], out="fit")
    moved = rfsg.simulate(fitted.scene.moved("/World/Cabinet", (1.2, 0, 0)))

The gradients are those of ``tracer.solve`` (envelope and implicit function theorems); paths are
searched every ``refresh`` steps and kept between (``kept``). Everything about a fit lies in one folder.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rfsg.learn.calibration import Spread, refuse_early, spread_of
from rfsg.learn.errors import LearnError
from rfsg.learn.links import link_up
from rfsg.learn.losses import Losses, Predicted
from rfsg.learn.measurements import Measurements
from rfsg.learn.model import Model, Predictive
from rfsg.learn.output import CHECKPOINT, prepare, write
from rfsg.learn.over_scene import ResidualSettings
from rfsg.learn.regularisation import Regularisation
from rfsg.learn.reporting import report_of
from rfsg.learn.selection import Selection
from rfsg.learn.selection import select as choose
from rfsg.learn.training import COLUMNS, Settings, Training
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Scene
from rfsg.tracer.plan import Quality

CHECKPOINT_EVERY = 200
Progress = Callable[[int, int, str], None]  # (steps done, steps in all, a word on how it goes)


@dataclass(frozen=True)
class Fitted:
    """What came of a fit.

    scene: with what was learned; transmit powers hold the power offset. history: one entry per step,
    by column. report: errors before and after, counts, settings; what ``report.json`` holds.
    gains_db: offsets of radios, which no scene holds. measured, before, after: the readings, and what
    was and is predicted of them; held: which of them were kept for validation. spread: how far readings
    of power lie from that, and what is left where a residual was asked for; None without powers.
    """

    scene: Scene
    history: dict[str, list[float]]
    report: dict[str, Any]
    gains_db: dict[str, float]
    quality: Quality
    losses: Losses
    measured: Measurements
    held: Tensor
    before: Predicted
    after: Predicted
    spread: Spread | None = None

    @property
    def model(self) -> Model:
        """What predicts, apart from how it was fitted; ``rfsg.learn.model.load`` reads it from OUT."""
        spread = self.spread
        return Model(
            self.scene,
            self.quality,
            self.losses.coherent,
            self.gains_db,
            self.report["offsets"]["power_db"] or 0.0,
            None if spread is None else spread.uncertainty,
            None if spread is None else spread.residual,
            0.0 if spread is None else spread.left_widened_db,
        )

    def predict(self, measured: Measurements, scene: Scene | None = None) -> Predictive:
        """What the fitted scene, or one made from it, says of readings; their values are not read.

        With 90 % intervals, and with the residual where there is one: see ``Predictive``.
        """
        return self.model.predict(measured, scene)


def fit(
    scene: Scene,
    measurements: Measurements | str | Path,
    *,
    select: Sequence[str],
    out: str | Path | None = None,
    steps: int = 2000,
    batch: int = 4,
    refresh: int = 500,
    quality: str | Quality = "draft",
    seed: int = 0,
    learning_rate: float = 1e-4,
    schedule: str = "constant",
    rates: Mapping[str, float] | None = None,
    losses: Losses | None = None,
    regularisation: Regularisation | None = None,
    validation: float = 0.2,
    exact: bool = False,
    residual: bool | ResidualSettings = False,
    checkpoint_every: int = CHECKPOINT_EVERY,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Fitted:
    """Learn what ``select`` names of a scene from measurements; the scene itself stays as it is.

    select: patterns over names (``rfsg.learn.selection``). steps, batch, learning_rate: Adam; batch
    and rate are the paper's (section 5.1). schedule: "constant", or "cosine" for a rate that falls to
    1 %. rates: by pattern, how much larger a step is than that of a weight. refresh: steps between
    searches, where anything moves. validation: share of the readings that is never trained on.
    exact: learned fields in float64 too. residual: model what physics leaves of powers as well
    (``rfsg.learn.over_scene``), reported beside physics, never instead of it. out: folder for
    everything; a checkpoint is written there every ``checkpoint_every`` steps, and with ``resume`` a
    run that was killed ends in the same bits as one that was not. ``overwrite`` begins anew in a
    folder that holds a fit.

    Raises MeasurementError for readings that cannot be used, LearnError for a fit that cannot begin
    or go on (with the likely causes), SceneError where ``out`` is taken.
    """
    if isinstance(measurements, (str, Path)):
        measurements = Measurements.from_csv(measurements)
    settings = Settings(
        steps=steps,
        batch=batch,
        refresh=refresh,
        quality=Quality.named(quality) if isinstance(quality, str) else quality,
        seed=seed,
        learning_rate=learning_rate,
        schedule=schedule,
        rates=dict(rates or {}),
        losses=losses or Losses(),
        regularisation=regularisation or Regularisation(),
        exact=exact,
    )
    over = ResidualSettings.of(residual)
    links = link_up(scene, measurements)
    radios = [r.path for r in (*links.transmitters, *links.receivers)]
    selection = choose(scene, select, radios=radios, frequency=float(links.frequency[0]))
    held = _held(measurements, validation, seed)
    folder = None if out is None else prepare(Path(out), resume, overwrite)
    tell = (lambda stage: progress(0, steps, f"search: {stage}")) if progress else None
    training = Training(scene, selection, measurements, links, held, settings, tell)
    training.search()
    before = training.predicted_all()
    if over is not None:
        refuse_early(training, before)
    checkpoint = None if folder is None else folder / CHECKPOINT
    if checkpoint is not None and resume and checkpoint.exists():
        training.load(checkpoint)
    _run(training, checkpoint, checkpoint_every, progress)
    if training.moving:
        training.search()
    fitted = _fitted(scene, training, before, over)
    if folder is not None:
        write(folder, fitted, selection)
    return fitted


def _run(
    training: Training, checkpoint: Path | None, every: int, progress: Progress | None
) -> None:
    steps = training.settings.steps
    for step in range(training.done, steps):
        if training.due(step):
            training.search()
        value = training.step(step)
        if checkpoint is not None and ((step + 1) % every == 0 or step + 1 == steps):
            training.save(checkpoint)
        if progress is not None:
            progress(step + 1, steps, f"loss {value:.4g}")


def _held(measured: Measurements, share: float, seed: int) -> Tensor:
    """Which readings are kept for validation."""
    if not 0 <= share < 1:
        raise LearnError(f"fit: validation={share!r}: expected a share in [0, 1)")
    order = torch.randperm(len(measured), generator=torch.Generator().manual_seed(seed))
    held = torch.zeros(len(measured), dtype=torch.bool)
    held[order[: int(share * len(measured))]] = True
    return held


# the result


def _fitted(
    scene: Scene, training: Training, before: Predicted, over: ResidualSettings | None
) -> Fitted:
    selection, settings = training.selection, training.settings
    after = training.predicted_all()
    gains = {path: float(p.detach()) for path, p in selection.gains.items()}
    history = {n: training.history[:, k].tolist() for k, n in enumerate(COLUMNS)}
    fitted = Fitted(
        _scene(scene, selection),
        history,
        {},
        gains,
        settings.quality,
        settings.losses,
        training.measured,
        training.held,
        before,
        after,
        spread_of(training, after, over),
    )
    return replace(fitted, report=report_of(training, fitted))


@torch.no_grad()
def _scene(scene: Scene, selection: Selection) -> Scene:
    """The caller's scene with what was learned in place; what was not is the caller's own."""
    changed = selection.nodes("shape", "surface")
    learned = selection.scene()
    nodes = list(scene.nodes)
    for i, node in enumerate(nodes):
        if i in changed:
            body = learned.nodes[i].body
            _restore(body, node.body)
            nodes[i] = replace(node, body=body, asset=None)
        if i in selection.moves:
            pose = learned.nodes[i].pose
            still = Pose(pose.rotation.detach(), pose.translation.detach(), pose.scale.detach())
            nodes[i] = replace(nodes[i], pose=still)
    radios = scene.transmitters
    if selection.power is not None:
        offset = float(selection.power.detach())
        radios = tuple(replace(r, power_dbm=r.power_dbm + offset) for r in radios)
    return replace(scene, nodes=tuple(nodes), transmitters=radios)


def _restore(body: nn.Module, like: nn.Module) -> None:
    """Which parameters ask for gradients, as it was in the caller's scene."""
    wanted = {name: p.requires_grad for name, p in like.named_parameters()}
    for name, p in body.named_parameters():
        p.requires_grad_(wanted.get(name, False))
