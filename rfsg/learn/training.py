"""One fit under way: what lasts from step to step, and what a step does.

A step draws its readings from (seed, step) alone, so that a run taken up from a checkpoint does what
the uninterrupted one would have done, to the bit.
"""

import hashlib
import json
import math
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from rfsg.learn.adam import Adam
from rfsg.learn.checkpoint import load_checkpoint, save_checkpoint, under
from rfsg.learn.errors import LearnError
from rfsg.learn.kept import Kept, Progress
from rfsg.learn.links import Links
from rfsg.learn.losses import Losses, Predicted, loss, residual_db
from rfsg.learn.measurements import Measurements, Quantity
from rfsg.learn.predict import predict_all, predict_rows
from rfsg.learn.regularisation import Regularisation, random_points, regularised
from rfsg.learn.selection import Selection
from rfsg.objects.body import Body
from rfsg.scene.scene import Scene
from rfsg.scene.weights import digest, pack
from rfsg.tracer.plan import Quality

MOST_REFUSED = 200  # steps refused one after another: nothing will come of it
STEEPEST = 1e15  # a slope whose square float32 cannot hold is no slope
MET_DB = 1e-9  # a power predicted to within this is predicted to rounding
LAST_RATE = 0.01  # of the first, where the rate falls
SCHEDULES = ("constant", "cosine")
COLUMNS = ("loss", "data", "regularisation", "error_db")


@dataclass(frozen=True)
class Settings:
    """How to fit: see ``fit``. Raises LearnError for values out of range."""

    steps: int = 2000
    batch: int = 4
    refresh: int = 500
    quality: Quality = field(default_factory=lambda: Quality.named("draft"))
    seed: int = 0
    learning_rate: float = 1e-4
    schedule: str = "constant"
    rates: Mapping[str, float] = field(default_factory=dict)
    losses: Losses = field(default_factory=Losses)
    regularisation: Regularisation = field(default_factory=Regularisation)
    exact: bool = False

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "refresh"):
            if getattr(self, name) < 1:
                raise LearnError(f"fit: {name}={getattr(self, name)!r}: expected at least 1")
        if not 0 < self.learning_rate < math.inf:
            raise LearnError(f"fit: learning_rate={self.learning_rate!r}: expected a number > 0")
        if self.schedule not in SCHEDULES:
            known = ", ".join(SCHEDULES)
            raise LearnError(f"fit: schedule={self.schedule!r}: expected one of {known}")

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        if self.schedule == "constant":
            return self.learning_rate
        fallen = 0.5 * (1.0 + math.cos(math.pi * step / self.steps))
        return self.learning_rate * (LAST_RATE + (1.0 - LAST_RATE) * fallen)

    def told(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return asdict(self) | {"rates": dict(self.rates)}


class Training:
    """Parameters, optimiser, kept paths and history of one fit."""

    def __init__(
        self,
        scene: Scene,
        selection: Selection,
        measured: Measurements,
        links: Links,
        held: Bool[Tensor, "n"],
        settings: Settings,
        progress: Progress | None = None,
    ):
        self.selection, self.measured, self.links = selection, measured, links
        self.held, self.settings, self.tell = held, settings, progress
        self.parameters, self.masks = selection.parameters(), selection.masks()
        self.optimiser = Adam(self.parameters, selection.rates(settings.rates))
        self.surface = selection.nodes("surface")
        self.moving = selection.nodes("shape", "pose")
        self.asked = _bodies(selection)
        self.delays = bool((measured.quantity == int(Quantity.DELAY)).any())
        self.done = 0
        self.history = torch.zeros(settings.steps, len(COLUMNS), dtype=torch.float64)
        self.refused: Counter[str] = Counter()
        self.in_a_row = 0
        self.statuses: dict[str, int] = {}
        self.searches, self.searched_at = 0, 0
        self.seconds: list[float] = []
        self.kept: Kept | None = None
        self.searched: list[Tensor] = []
        self.pool = torch.zeros(0, dtype=torch.int64)
        self.job = _job(scene, selection, measured, held, settings)

    # searching

    def search(self) -> Kept:
        """Look for the paths of all links with the parameters as they are."""
        self.searched_at = self.done
        self.searched = [p.detach().clone() for p in self.parameters]
        self.kept = Kept(
            self.scene(),
            self.links,
            self.settings.quality,
            self.surface,
            self.moving,
            exact=self.settings.exact,
            delays=self.delays,
            progress=self.tell,
        )
        self.searches += 1
        self.statuses = dict(self.kept.counts)
        self.pool = torch.nonzero(self.speaking(self.kept) & ~self.held).squeeze(-1)
        if not len(self.pool):
            raise LearnError(self._why_silent())
        return self.kept

    def due(self, step: int) -> bool:
        """Whether to search before a step. Without anything that moves, once is for ever."""
        if self.kept is None:
            return True
        return bool(self.moving) and step % self.settings.refresh == 0 and step != self.searched_at

    def speaking(self, kept: Kept) -> Bool[Tensor, "n"]:
        """Readings that can say something of what is learned: a path of theirs meets it."""
        if self.selection.power is not None:
            meets = torch.ones(len(self.links), dtype=torch.bool)
        else:
            meets = kept.says()
            for radios, which in (
                (self.links.transmitters, self.links.tx),
                (self.links.receivers, self.links.rx),
            ):
                own = torch.tensor([r.path in self.selection.gains for r in radios])
                meets = meets | own[which]
        arrives = torch.bincount(kept.link, minlength=len(self.links)) > 0
        return (meets & arrives)[self.links.link_of]

    # stepping

    def step(self, step: int) -> float:
        """One step; returns the loss. What is not finite never reaches the parameters."""
        began = time.perf_counter()
        rows = self._batch(step)
        total, parts = self._loss(rows, step)
        gradients = self._gradients(total)
        cause = self._fault(total, gradients)
        if step == 0 and cause is None and not any(bool(g.any()) for g in gradients):
            self._refuse_flat()
        if cause is None:
            self.in_a_row = 0
            self.optimiser.step(gradients, self.settings.rate(step))
            self.selection.clamp()
        else:
            self.refused[cause] += 1
            self.in_a_row += 1
            if self.in_a_row >= MOST_REFUSED:
                raise LearnError(
                    f"fit: {self.in_a_row} steps one after another were refused ({cause} not "
                    "finite); likely causes: a learning rate that is too high, an object that "
                    "has lost its surface, or a noise scale far too small"
                )
        self.history[step] = torch.tensor([float(total.detach()), *parts], dtype=torch.float64)
        self.done = step + 1
        self.seconds.append(time.perf_counter() - began)
        return float(total.detach())

    def _batch(self, step: int) -> Int[Tensor, "b"]:
        """Readings of a step: each once before any comes again, in an order of its own each time."""
        size, batch = len(self.pool), min(self.settings.batch, len(self.pool))
        begin = step * batch
        turns = range(begin // size, (begin + batch - 1) // size + 1)
        orders = [torch.randperm(size, generator=_generator(self.settings.seed, t)) for t in turns]
        first = begin - (begin // size) * size
        return self.pool[torch.cat(orders)[first : first + batch]]

    def _loss(self, rows: Tensor, step: int) -> tuple[Tensor, tuple[float, float, float]]:
        predicted, measured = self.predicted(rows), self.measured.take(rows)
        costs, counts = loss(predicted, measured, self.settings.losses)
        data = costs.sum() / max(1, int(counts.sum()))
        extra = self._regularisation(step)
        with torch.no_grad():
            off = residual_db(predicted, measured)[measured.received & predicted.arrives].abs()
            error = float(off.median()) if len(off) else 0.0
        return data + extra, (float(data.detach()), float(extra.detach()), error)

    def predicted(self, rows: Int[Tensor, "b"]) -> Predicted:
        """What the scene says of some readings now."""
        kept = self.kept or self.search()
        coherent, gains = self.settings.losses.coherent, self.selection.gains
        return predict_rows(kept, self.scene(), rows, coherent, gains, self.selection.power)

    def predicted_all(self) -> Predicted:
        """What the scene says of all readings now, without gradients."""
        kept = self.kept or self.search()
        coherent, gains = self.settings.losses.coherent, self.selection.gains
        return predict_all(kept, self.scene(), coherent, gains, self.selection.power)

    def _regularisation(self, step: int) -> Tensor:
        how, total = self.settings.regularisation, torch.zeros((), dtype=torch.float64)
        if step % how.every:
            return total
        generator = _generator(self.settings.seed + 1, step)
        for body, shape, surface in self.asked:
            point = random_points(body, how.points, generator).float()
            total = total + regularised(body, point, how, shape=shape, surface=surface)
        return how.every * total

    def _gradients(self, total: Tensor) -> list[Tensor]:
        if not total.requires_grad:
            return [torch.zeros_like(p) for p in self.parameters]
        found = torch.autograd.grad(total, self.parameters, allow_unused=True)
        given = [
            torch.zeros_like(p) if g is None else g
            for p, g in zip(self.parameters, found, strict=True)
        ]
        return [g if m is None else g * m for g, m in zip(given, self.masks, strict=True)]

    def _fault(self, total: Tensor, gradients: list[Tensor]) -> str | None:
        """What of a step is not finite, if anything."""
        if not bool(torch.isfinite(total)):
            return "loss"
        if all(float(torch.dot(g, g)) < STEEPEST**2 for g in (g.reshape(-1) for g in gradients)):
            return None  # the square of every slope is below that of their sum
        for p, gradient in zip(self.parameters, gradients, strict=True):
            if not bool((gradient.abs() < STEEPEST).all()):
                leaf = next(f for f in self.selection.leaves if any(t is p for t in f.tensors))
                return f"gradient of {leaf.names[0]}"
        return None

    def scene(self) -> Scene:
        return self.selection.scene()

    # stopping at once

    def _refuse_flat(self) -> None:
        """Many readings together without any slope: nothing can be learned, unless all are met."""
        rows = self.pool[:64]
        if self._met(rows):
            return
        total, _ = self._loss(rows, 0)
        if not any(bool(g.any()) for g in self._gradients(total)):
            raise LearnError(
                "fit: the loss does not depend on anything that is selected; likely causes: the "
                "readings are censored and all well below their threshold, the selected fields are "
                "saturated (m, alpha or phi at the end of its range), or nothing gets through the "
                f"object. Selected:\n{self.selection.table()}"
            )

    @torch.no_grad()
    def _met(self, rows: Tensor) -> bool:
        """Whether powers among these readings are predicted to rounding: no slope is left there."""
        predicted, measured = self.predicted(rows), self.measured.take(rows)
        power = (measured.quantity == int(Quantity.RSSI)) | (
            measured.quantity == int(Quantity.PATH_GAIN)
        )
        known = measured.received & predicted.arrives & power
        off = residual_db(predicted, measured)[known]
        return bool(len(off)) and float(off.abs().max()) <= MET_DB

    def _why_silent(self) -> str:
        objects = sorted({o for leaf in self.selection.leaves for o in leaf.owners})
        kept = self.kept
        assert kept is not None
        spoken = int((self.speaking(kept) & self.held).sum())
        dark = int((torch.bincount(kept.link, minlength=len(self.links)) == 0).sum())
        return (
            f"fit: no measured link has a path that meets {', '.join(objects)}: there is no gradient. "
            f"{len(self.links)} links have {len(kept.link)} paths; {dark} links have none; "
            f"{spoken} readings held for validation would have said something. Likely causes: the "
            "object stands away from all links, the quality follows too few reflections (depth, "
            "curved), or an opaque object stands before it"
        )

    # checkpoints

    def save(self, path: Path) -> None:
        """Write beside and rename: there is always one whole checkpoint."""
        tensors = {f"parameter.{i}": p for i, p in enumerate(self.parameters)}
        tensors |= {f"searched.{i}": p for i, p in enumerate(self.searched)}
        tensors |= {f"optimiser.{k}": v for k, v in self.optimiser.tensors().items()}
        tensors["history"] = self.history[: self.done]
        state = {
            "job": self.job,
            "done": self.done,
            "searches": self.searches,
            "searched_at": self.searched_at,
            "refused": dict(self.refused),
            "in_a_row": self.in_a_row,
        }
        save_checkpoint(path, tensors, state)

    def load(self, path: Path) -> None:
        """Continue from a checkpoint: search again where it was searched, then go on as it was.

        Raises LearnError for a file that is broken, of another fit, or of more steps than asked for.
        """
        tensors, state = load_checkpoint(path, self.job)
        self.done = int(state["done"])
        if self.done > self.settings.steps:
            raise LearnError(f"{path}: holds {self.done} steps; asked for {self.settings.steps}")
        self._put(under("searched.", tensors))
        self.search()
        self._put(under("parameter.", tensors))
        self.optimiser.load(under("optimiser.", tensors))
        self.history[: self.done] = tensors["history"]
        self.searches, self.searched_at = int(state["searches"]), int(state["searched_at"])
        self.refused, self.in_a_row = Counter(state["refused"]), int(state["in_a_row"])

    @torch.no_grad()
    def _put(self, values: dict[str, Tensor]) -> None:
        for i, p in enumerate(self.parameters):
            p.copy_(values[str(i)])


def _generator(seed: int, number: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed * 1_000_003 + number)


def _bodies(selection: Selection) -> list[tuple[Body, bool, bool]]:
    """Bodies of which a network is learned, once each: (body, its shape, its surface)."""
    shape, surface = selection.nodes("shape"), selection.nodes("surface")
    nodes = selection.base.nodes
    found = {
        id(nodes[i].body): (nodes[i].body, i in shape, i in surface)
        for i in sorted({*shape, *surface})
    }
    return [(b, s, u) for b, s, u in found.values() if s or (u and b.surface.kind == "stochastic")]


def _job(
    scene: Scene, selection: Selection, measured: Measurements, held: Tensor, settings: Settings
) -> str:
    """What a checkpoint belongs to: hash of scene, readings, which are held, selection, settings.

    Without the number of steps where it changes nothing that was done: a fit may be prolonged.
    """
    bodies = {id(n.body): digest(pack(n.body)) for n in scene.nodes}
    radios = [
        (
            r.path,
            r.position.tolist(),
            r.rotation.tolist(),
            r.power_dbm,
            str(r.pattern),
            r.polarization,
        )
        for r in (*scene.transmitters, *scene.receivers)
    ]
    nodes = [
        (n.path, bodies[id(n.body)], n.pose.rotation.tolist(), n.pose.translation.tolist())
        for n in scene.nodes
    ]
    told = settings.told()
    if settings.schedule == "constant":
        told.pop("steps")
    read = digest(measured.csv()), held.tolist()
    whole = [read, nodes, radios, list(selection.matched), told]
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
