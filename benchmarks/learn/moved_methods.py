"""What is compared where objects move: learned objects, one network for a room, interpolators."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from numpy import ndarray

import rfsg
from learn.moved_rooms import THINGS, Asked, Layout
from rfsg.learn import baselines
from rfsg.learn.fit import Fitted
from rfsg.learn.leaves import HEADS, RATES
from rfsg.learn.losses import Losses
from rfsg.learn.regions import EMPTY, INTERACTION_LENGTH, SHARPNESS
from rfsg.learn.regularisation import Regularisation
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.stochastic import StochasticSurface

WHOLE = "/World/Everything"
INTERPOLATORS: dict[str, Callable[[], baselines.Method]] = {
    "log-distance": baselines.LogDistance,
    "1-NN": lambda: baselines.NearestNeighbours((1,)),
    "k-NN": baselines.NearestNeighbours,
    "MRI": baselines.Mri,
    "kriging": baselines.GatewayKriging,
    "joint kriging": baselines.JointKriging,
}


@dataclass(frozen=True)
class Budget:
    """How a fit goes: chosen on seed 100, whose rooms, links and noise are in no table.

    heads: the steps of the fields' heads, rfsg's own, said here because results depend on them.
    """

    steps: int = 300
    batch: int = 16
    learning_rate: float = 3e-3
    law: str = "student"
    quality: rfsg.Quality = field(default_factory=lambda: rfsg.Quality.named("draft"))
    laplacian: float = 1e-4
    heads: tuple[float, ...] = tuple(RATES[head] for head in HEADS)

    def said(self) -> str:
        """In words, for the page."""
        how = self.quality
        return (
            f"Budget: {self.steps} steps of {self.batch} readings, {LAWS[self.law]}, "
            f"rate {self.learning_rate:g} falling to 1 %; {how.depth} reflections, "
            f"{how.diffraction} edges, {how.crossing_samples} intervals per crossing."
        )


LAWS = {"gaussian": "a normal law", "student": "Student's law", "huber": "Huber's law"}
OBJECTS = Budget()
# The room is crossed whole, so more intervals; one reflection, as it has no faces to reflect.
ROOM = Budget(quality=rfsg.Quality.named("draft", depth=1, crossing_samples=24))


# What a blank surface is before it has seen anything: rfsg's default, and nearly clear.
STARTS: dict[str, dict[str, float]] = {
    "default": {},
    "nearly clear": {"sharpness": 125.0, "interaction_length": 0.2, "phi": 1.45},
}
SETTLED = 30  # last steps, whose mean loss says how well a fit went


def blank(seed: int, start: str = "default") -> dict[str, rfsg.Body]:
    """Bodies that know their shape and nothing of their material, with a loss inside."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return {
            name: rfsg.Body(thing.shape, StochasticSurface(bulk=0.1, **STARTS[start]))  # type: ignore[arg-type]
            for name, thing in THINGS.items()
        }


def learned(
    layout: Layout,
    links: Asked,
    gain_db: Float[ndarray, "n"],
    budget: Budget = OBJECTS,
    starts: Sequence[str] = ("default",),
) -> dict[str, rfsg.Body]:
    """The three objects, learned together from readings in room A.

    Of several starts the one whose loss of the training readings came out least.
    """
    paths = {name: path for path, name, _ in layout.poses("before")}
    select = [f"{path}.surface" for path in paths.values()]
    fits = [
        fit(
            layout.scene("before", blank(layout.seed, start)),
            select,
            layout.seed,
            links,
            gain_db,
            budget,
        )
        for start in starts
    ]
    best = min(fits, key=lambda fitted: sum(fitted.history["data"][-SETTLED:]))
    return {name: best.scene.node(path).body for name, path in paths.items()}


def learned_room(layout: Layout, links: Asked, gain_db: Float[ndarray, "n"]) -> rfsg.Node:
    """One neural object over the whole of room A, in world coordinates: the paper's own form.

    It begins as nothing, as regions do (``rfsg.learn.regions``); the walls are known to it.
    """
    half = [length / 2 - 0.01 for length in layout.room("before").size]
    centre = [length / 2 for length in layout.room("before").size]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(layout.seed)
        surface = StochasticSurface(
            m=0.0,
            alpha=0.0,
            sharpness=SHARPNESS,
            interaction_length=INTERACTION_LENGTH,
            bulk=EMPTY,
            interface="paper",
        )
    node = rfsg.Node(WHOLE, rfsg.Body(Box(half), surface), rfsg.Pose.at(*centre))
    select = [f"{WHOLE}.surface.weights", f"{WHOLE}.surface.bulk"]
    scene = with_node(layout.scene("before", {}), node)
    return fit(scene, select, layout.seed, links, gain_db, ROOM).scene.node(WHOLE)


def fit(
    scene: rfsg.Scene,
    select: list[str],
    seed: int,
    links: Asked,
    gain_db: Float[ndarray, "n"],
    budget: Budget,
) -> Fitted:
    return rfsg.fit(
        scene,
        links.measured(gain_db),
        select=select,
        steps=budget.steps,
        batch=budget.batch,
        quality=budget.quality,
        seed=seed,
        learning_rate=budget.learning_rate,
        schedule="cosine",
        losses=Losses(coherent=False, law=budget.law),
        regularisation=Regularisation(laplacian=budget.laplacian),
        validation=0.0,
    )


def with_node(scene: rfsg.Scene, node: rfsg.Node) -> rfsg.Scene:
    return replace(scene, nodes=(*scene.nodes, node))
