"""Two rooms, three objects of known materials, and links between places in them, drawn by a seed.

In every room x, y, z run from 0 to its size [m]. Another seed is another layout: other poses, other
gateways, other places. "before" is where the objects are learned; nothing is learned elsewhere.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

import rfsg
from rfsg.learn.baselines import Readings
from rfsg.objects.contract import Shape
from rfsg.objects.shapes.analytic import Box, Capsule
from rfsg.objects.surfaces.interface import DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab

FREQUENCY = 2.44e9
WALL = 0.1  # half the depth that walls are drawn with [m]; their material has its own thickness
GATEWAYS = 6  # of each kind, heard and unheard
APART = 0.15  # least distance between objects, and from them to walls and to radios [m]
SITUATIONS = ("before", "moved", "room B", "copies")
HEARD, NEW = "heard gateways", "new gateways"


@dataclass(frozen=True)
class Room:
    """A cuboid of ``size`` metres behind walls of an ITU-R P.2040 material."""

    size: tuple[float, float, float]
    itu: str
    thickness_m: float

    def walls(self) -> list[rfsg.Node]:
        surface = Slab(thickness_m=self.thickness_m, itu=self.itu)
        return [self._wall(axis, side, surface) for axis in range(3) for side in (0, 1)]

    def _wall(self, axis: int, side: int, surface: Slab) -> rfsg.Node:
        centre = [length / 2 for length in self.size]
        half = [length / 2 for length in self.size]
        half[axis] = WALL
        centre[axis] = self.size[axis] + WALL if side else -WALL
        body = rfsg.Body(Box(half), surface)
        return rfsg.Node(f"/World/Walls/{'xyz'[axis]}{side}", body, rfsg.Pose.at(*centre))


ROOMS = {
    "A": Room((6.0, 5.0, 3.0), "concrete", 0.2),
    "B": Room((7.5, 4.4, 2.6), "brick", 0.12),
}


@dataclass(frozen=True)
class Thing:
    """An object: its shape, which all know, and its material, which only the truth knows.

    radius: of a circle on the floor that holds it [m]; half_height [m].
    """

    shape: Shape
    surface: torch.nn.Module
    radius: float
    half_height: float

    def body(self) -> rfsg.Body:
        return rfsg.Body(self.shape, self.surface)


def things() -> dict[str, Thing]:
    """A cabinet of plywood, a person, whose skin is muscle that nothing passes, a brick partition.

    Muscle at 2.44 GHz: eps_r 52.7, 1.74 S/m (S. Gabriel, R. W. Lau, C. Gabriel, "The dielectric
    properties of biological tissues: III", Physics in Medicine and Biology 41, 1996).
    """
    person = DielectricHalfSpace(eps_r=52.7, sigma=1.74)
    return {
        "Cabinet": Thing(Box((0.28, 0.5, 0.7)), Slab(thickness_m=0.022, itu="plywood"), 0.58, 0.7),
        "Person": Thing(Capsule(0.2, 0.67), person, 0.2, 0.87),
        "Partition": Thing(Box((0.05, 0.9, 1.0)), Slab(thickness_m=0.1, itu="brick"), 0.91, 1.0),
    }


THINGS = things()


@dataclass(frozen=True)
class Layout:
    """Where everything is, in all situations of a seed."""

    seed: int

    def room(self, situation: str) -> Room:
        return ROOMS["B" if situation == "room B" else "A"]

    def poses(self, situation: str) -> list[tuple[str, str, rfsg.Pose]]:
        """(prim path, which thing, pose) of every object, standing 5 mm above the floor."""
        draw = np.random.default_rng([self.seed, 1, SITUATIONS.index(situation)])
        names = [*THINGS] * (2 if situation == "copies" else 1)
        spots = apart(draw, [THINGS[n].radius for n in names], self.room(situation).size)
        found = []
        for i, (name, (x, y)) in enumerate(zip(names, spots, strict=True)):
            pose = rfsg.Pose.at(x, y, THINGS[name].half_height + 0.005, draw.uniform(0.0, 360.0))
            found.append((f"/World/{name}_{i // len(THINGS)}", name, pose))
        return found

    def scene(self, situation: str, bodies: Mapping[str, rfsg.Body]) -> rfsg.Scene:
        """The room, and in it those things that ``bodies`` has a body for."""
        nodes = [
            rfsg.Node(path, bodies[name], pose)
            for path, name, pose in self.poses(situation)
            if name in bodies
        ]
        return rfsg.Scene((*self.room(situation).walls(), *nodes), frequency=FREQUENCY)

    def gateways(self, kind: str) -> Float[ndarray, "g 3"]:
        """Gateways stand where they stand in both rooms, free of all objects of all situations."""
        low, high = np.array([0.3, 0.3, 1.0]), np.array([5.7, 4.1, 2.3])
        draw = np.random.default_rng([self.seed, 2, int(kind == NEW)])
        return free(draw, GATEWAYS, low, high, [self.truth(s) for s in SITUATIONS])

    def truth(self, situation: str) -> rfsg.Scene:
        return self.scene(situation, {name: thing.body() for name, thing in THINGS.items()})

    def asked(self, situation: str, kind: str, count: int, pool: int = 0) -> "Asked":
        """Links between random places and the gateways in turn; ``pool`` tells draws apart."""
        draw = np.random.default_rng(
            [self.seed, 3, SITUATIONS.index(situation), int(kind == NEW), pool]
        )
        x, y, _ = self.room(situation).size
        low, high = np.array([0.3, 0.3, 0.6]), np.array([x - 0.3, y - 0.3, 1.6])
        tag = free(draw, count, low, high, [self.truth(situation)])
        gateway = np.arange(count) % GATEWAYS
        number = gateway + (GATEWAYS if kind == NEW else 0)
        return Asked(tag, self.gateways(kind)[gateway], number)


@dataclass(frozen=True)
class Asked:
    """Links: places of tags and gateways [m], and the gateways' numbers."""

    tag: Float[ndarray, "n 3"]
    gateway: Float[ndarray, "n 3"]
    number: Int[ndarray, "n"]

    def __len__(self) -> int:
        return len(self.number)

    def first(self, count: int) -> "Asked":
        return Asked(self.tag[:count], self.gateway[:count], self.number[:count])

    def measured(self, gain_db: Float[ndarray, "n"] | None = None) -> rfsg.Measurements:
        """As readings of path gain [dB]; 0 where there are none yet."""
        value = np.zeros(len(self)) if gain_db is None else gain_db
        columns = {f"tx_{a}_m": self.tag[:, i].tolist() for i, a in enumerate("xyz")}
        columns |= {f"rx_{a}_m": self.gateway[:, i].tolist() for i, a in enumerate("xyz")}
        return rfsg.Measurements.of(**columns, path_gain_db=value.tolist(), frequency_hz=FREQUENCY)

    def readings(self, gain_db: Float[ndarray, "n"]) -> Readings:
        return Readings(self.tag, self.gateway, self.number, gain_db)


def apart(
    draw: np.random.Generator, radii: list[float], size: tuple[float, float, float]
) -> list[tuple[float, float]]:
    """Places on a floor for circles of these radii [m], none near another or a wall."""
    while True:
        spots: list[tuple[float, float]] = []
        for radius in radii:
            edge = radius + APART
            for _ in range(200):
                x, y = (float(draw.uniform(edge, length - edge)) for length in size[:2])
                others = zip(spots, radii, strict=False)
                if all(np.hypot(x - u, y - v) > radius + r + APART for (u, v), r in others):
                    spots.append((x, y))
                    break
        if len(spots) == len(radii):
            return spots


def free(
    draw: np.random.Generator,
    count: int,
    low: Float[ndarray, "3"],
    high: Float[ndarray, "3"],
    scenes: list[rfsg.Scene],
) -> Float[ndarray, "count 3"]:
    """Random places in a cuboid [m] that are near no object of any of the scenes."""
    kept = np.zeros((0, 3))
    while len(kept) < count:
        some = draw.uniform(low, high, (2 * count, 3))
        point = torch.from_numpy(some)
        clear = torch.ones(len(some), dtype=torch.bool)
        for node in (n for scene in scenes for n in scene.nodes):
            clear &= node.body.shape.sdf(node.pose.point_object(point)) > APART
        kept = np.concatenate([kept, some[clear.numpy()]])
    return kept[:count]
