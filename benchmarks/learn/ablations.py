"""Fits that differ from the reference in one thing each, their errors, and where these are stored."""

import copy
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

import rfsg
from learn import ablations_truth as truths
from learn.ablations_truth import CABINET, QUALITY, SEEN, Truth, without
from learn.methods import FOLDER, code
from learn.store import write
from rfsg.learn.losses import Losses
from rfsg.learn.regularisation import Regularisation
from rfsg.objects.contract import Shape
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.stochastic import Fields, StochasticSurface
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Scene

LEARN = ("leaves", "losses", "regularisation", "training")  # of rfsg/learn: a result is of theirs
HEADS = ("m", "alpha", "phi")
# |R| of about 0.2 and little loss: most of sigma is phase
CLEAR = {"phi": 1.45, "sharpness": 125.0, "interaction_length": 0.2}
FINE = 64  # intervals of a crossing, against 8 in the fit: is it the material that was learned?
STUDENT = Losses(law="student")
RIEMANN = replace(QUALITY, integral="riemann")
DARK_DB = -150.0  # behind metal nothing arrives, and no decibel can be compared
ROOM = Box((4.0, 3.0, 1.5))
MIDDLE = (4.0, 3.0, 1.5)  # of the room [m, world]


@dataclass(frozen=True)
class Variant:
    """One row. ``of`` says which default it is about. ``network``: "own", "shared" or "world", or
    "none" for a scene without the objects. ``heads``: the step of a field's head against that of
    other weights, None for rfsg's. ``start``: what surfaces are before they learn."""

    of: str
    name: str
    network: str = "own"
    interface: str = "conserving"
    quality: rfsg.Quality = QUALITY
    steps: int = 400
    batch: int = 16
    rate: float = 3e-3
    schedule: str = "cosine"
    losses: Losses = STUDENT
    regularisation: Regularisation = field(default_factory=Regularisation)
    heads: float | None = None
    start: Mapping[str, Any] = field(default_factory=dict)
    fine: bool = False
    shape: bool = False


REFERENCE = Variant("reference", "reference")
NONE = "no objects in the scene"


@dataclass(frozen=True)
class Outcome:
    """Absolute errors [dB] of unseen links by place ("before", "moved", "fine": before, with FINE
    intervals) and by whether the objects matter; CPU seconds of the fit; measures of a shape."""

    error_db: dict[str, list[float]]
    matters: dict[str, list[bool]]
    fit_s: float
    step_ms: float
    shape: dict[str, float]


def variants() -> list[Variant]:
    """The reference first, and rows of one default together."""
    every = [*deciding(), *others()]
    first = [how.of for how in every]
    return sorted(every, key=lambda how: first.index(how.of))


def deciding() -> list[Variant]:
    """What the choice of a default hangs on."""
    plain = {"batch": 4, "losses": Losses()}
    return [
        replace(REFERENCE, fine=True),
        other("reference", "nothing learned", steps=0),
        other("reference", NONE, steps=0, network="none"),
        other("step of the heads", "1", heads=1.0),
        other("batch", "4", batch=4),
        other("law", "gaussian", losses=Losses()),
        other("together", "batch 4, gaussian", **plain),
        other("together", "batch 4, gaussian, heads 1", heads=1.0, **plain),
        other("law", "huber", losses=Losses(law="huber")),
        other("censoring", "fill -100 dBm", losses=replace(STUDENT, censoring="fill")),
        other("censoring", "ignored", losses=replace(STUDENT, censoring="ignore")),
        other("interface", "paper", interface="paper"),
        other("transmittance", "Riemann", quality=RIEMANN, fine=True),
        other("Laplacian", "none", regularisation=Regularisation(laplacian=0.0)),
        other("network", "one for all, world frame", network="world"),
        other("steps", "100", steps=100),
        other("steps", "800", steps=800),
    ]


def others() -> list[Variant]:
    """The rest, quick ones first."""
    shape = Variant(
        "eikonal",
        "0.1 (default)",
        shape=True,
        steps=100,
        batch=4,
        rate=1e-4,
        schedule="constant",
        losses=Losses(),
    )
    paper = {"rate": 1e-4, "schedule": "constant", "batch": 4, "losses": Losses()}
    return [
        *(other("steps", str(n), steps=n) for n in (50, 200)),
        other("rate", "1e-4 constant (paper)", rate=1e-4, schedule="constant"),
        other("rate", "1e-3 cosine", rate=1e-3),
        other("rate", "1e-2 cosine", rate=1e-2),
        other("start", "nearly clear", start=CLEAR),
        other("network", "one for all, object frame", network="shared"),
        other("Laplacian", "1e-2", regularisation=Regularisation(laplacian=1e-2)),
        replace(shape, name="nothing learned", steps=0),
        shape,
        replace(shape, name="none", regularisation=Regularisation(eikonal=0.0)),
        replace(shape, name="1", regularisation=Regularisation(eikonal=1.0)),
        other("together", "rfsg's defaults, 2000 steps", steps=2000, **paper),
    ]


def other(of: str, name: str, **change: object) -> Variant:
    return replace(REFERENCE, of=of, name=name, **change)  # type: ignore[arg-type]


# one network for all


class InWorld(StochasticSurface):
    """A network of places in the world, as the paper's: where an object stands decides what it is.

    ``placed`` gives the surface of an object at a pose; all of them share every parameter.
    """

    pose: Pose | None = None

    def placed(self, pose: Pose) -> "InWorld":
        other = copy.copy(self)
        other.pose = pose
        return other

    def _network(self, shape: Shape, point: Tensor, feature: Tensor | None) -> Fields:
        assert self.pose is not None
        world = self.pose.point_world(point.double()) - torch.tensor(MIDDLE, dtype=torch.float64)
        return super()._network(ROOM, world.to(point), None)


def blank(truth: Truth, how: Variant, seed: int) -> Scene:
    """The scene before anything is learned; networks by the seed."""
    torch.manual_seed(seed)
    if how.shape:
        thin = truths.thin_cabinet()
        nodes = [thin if n.path == CABINET else n for n in truth.scene.nodes]
        return replace(truth.scene, nodes=tuple(nodes))
    scene = truth.scene
    if how.network == "none":
        return without(scene, truth.objects)
    shared = {"shared": StochasticSurface, "world": InWorld}.get(how.network)
    one = None if shared is None else shared(interface=how.interface, **how.start)
    for path in truth.objects:
        node = scene.node(path)
        surface = one or StochasticSurface(interface=how.interface, **how.start)
        if isinstance(surface, InWorld):
            surface = surface.placed(node.pose)
        scene = scene.replaced(path, rfsg.Body(node.body.shape, surface))
    return scene


def settled(scene: Scene, objects: tuple[str, ...]) -> Scene:
    """Networks of places told where their objects stand now."""
    for node in scene.nodes:
        if node.path in objects and isinstance(node.body.surface, InWorld):
            body = rfsg.Body(node.body.shape, node.body.surface.placed(node.pose))
            scene = scene.replaced(node.path, body)
    return scene


# one run


@cache
def truth_of(shape: bool, seed: int) -> Truth:
    return truths.geometry(seed) if shape else truths.materials(seed)


def evaluate(how: Variant, seed: int) -> Outcome:
    """Fit, and ask for the unseen links where the objects stood and where they were moved to."""
    truth = truth_of(how.shape, seed)
    scene, seconds, step_ms = fitted(truth, how, seed)
    asked = truth.asked.take(torch.arange(SEEN, len(truth.asked)))
    errors, matters = {}, {}
    for when, there in truth.scenes(scene).items():
        there = settled(there, truth.objects)
        said = rfsg.predict(there, asked, how.quality).path_gain_db()
        errors[when], matters[when] = compared(said, truth, when)
    if how.fine:
        finely = replace(how.quality, crossing_samples=FINE)
        said = rfsg.predict(settled(scene, truth.objects), asked, finely).path_gain_db()
        errors["fine"], matters["fine"] = compared(said, truth, "before")
    shape = measured_shape(truth, scene) if how.shape else {}
    return Outcome(errors, matters, seconds, step_ms, shape)


def compared(said: Float[Tensor, "u"], truth: Truth, when: str) -> tuple[list[float], list[bool]]:
    """Absolute errors [dB] of the unseen links where anything arrives, and where objects matter."""
    gain = truth.gain_db[when][SEEN:]
    lit = gain > DARK_DB
    error = (said - gain).abs()[lit]
    return error.numpy().round(3).tolist(), truth.matters[when][SEEN:][lit].tolist()


def fitted(truth: Truth, how: Variant, seed: int) -> tuple[Scene, float, float]:
    """The scene after the fit, CPU seconds of it all, and CPU milliseconds a step without searches."""
    scene = blank(truth, how, seed)
    if not how.steps:
        return scene, 0.0, 0.0
    part = "shape" if how.shape else "surface"
    began = time.process_time()
    found = rfsg.fit(
        scene,
        truth.measured,
        select=[f"{path}.{part}" for path in truth.objects],
        steps=how.steps,
        batch=how.batch,
        refresh=how.steps,  # nothing moves but the shape, and that by less than a wavelength
        quality=how.quality,
        seed=seed,
        learning_rate=how.rate,
        rates={} if how.heads is None else {f"*.surface.{name}": how.heads for name in HEADS},
        schedule=how.schedule,
        losses=how.losses,
        regularisation=how.regularisation,
        validation=0.0,
    )
    seconds = time.process_time() - began
    return found.scene, seconds, 1e3 * found.report["seconds_per_step"]["median"]


@torch.no_grad()
def measured_shape(truth: Truth, scene: Scene) -> dict[str, float]:
    """Mean |f| [mm] on the front, which was wrong, and mean | |grad f| - 1 | there."""
    node, true = scene.node(CABINET), truth.scene.node(CABINET)
    high = true.body.shape.bounds()[1]
    share = torch.linspace(-0.8, 0.8, 21, dtype=torch.float64)
    across = torch.cartesian_prod(share, share) * high[1:]
    point = torch.cat([high[0].expand(len(across), 1), across], 1)
    at = node.pose.point_object(true.pose.point_world(point))
    value, gradient = node.body.shape.value_and_gradient(at)
    slope = (gradient.norm(dim=-1) - 1.0).abs()
    return {"off_mm": 1e3 * float(value.abs().mean()), "slope": float(slope.mean())}


# results on disk


def in_turn(seeds: Sequence[int]) -> list[tuple[Variant, int]]:
    """All runs: what decides for every seed, row by row; then the rest, seed by seed."""
    first = [(how, seed) for how in deciding() for seed in seeds]
    return first + [(how, seed) for seed in seeds for how in others()]


def outcome(how: Variant, seed: int, work: Path) -> Outcome:
    """The stored result; computed and stored when there is none."""
    path = place(how, seed, work)
    if not path.is_file():
        write(path, json.dumps(asdict(evaluate(how, seed))) + "\n")
    return load(path)


def stored(how: Variant, seed: int, work: Path) -> Outcome | None:
    path = place(how, seed, work)
    return load(path) if path.is_file() else None


def place(how: Variant, seed: int, work: Path) -> Path:
    """File of a result: another truth, variant or code of the fit is another file."""
    key = repr(how) + code_of_all()
    name = f"{how.of}-{how.name}".replace(" ", "_").replace(",", "").replace("/", "_")
    return work / f"{name}-{seed}-{hashlib.sha256(key.encode()).hexdigest()[:12]}.json"


@cache
def code_of_all() -> str:
    """What makes the truth and the fit, as it was when this process asked first."""
    truth = Path(__file__).parent / "ablations_truth.py"
    return "".join(code(path) for path in (truth, *(FOLDER.parent / f"{n}.py" for n in LEARN)))


def load(path: Path) -> Outcome:
    return Outcome(**json.loads(path.read_text()))
