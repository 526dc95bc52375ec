"""Small scenes drawn at random, of every kind of object: rooms and yards that no choice was made on."""

import math
from pathlib import Path

import numpy as np

from rfsg.objects.body import Body
from rfsg.objects.contract import Surface
from rfsg.objects.shapes.analytic import Box, Cylinder
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene

CABINET = Path(__file__).resolve().parents[1] / "assets" / "objects" / "cabinet" / "cabinet.usda"
CARRIERS = (1.5e9, 2.44e9, 3.5e9, 5.8e9)
WALL = 0.1  # [m], half the thickness of a wall
CLEAR = 0.25  # [m] between a radio and the nearest thing


def random_scene(
    seed: int, receivers: int = 6, round_thing: str | None = None, most_things: int = 3
) -> Scene:
    """A room of slabs or an open yard, a few boxes in it, one transmitter, some receivers.

    round_thing: "cylinder" or "learned" puts one such object among them; None keeps to planes.
    """
    draw = np.random.default_rng(seed)
    size = draw.uniform((4.0, 3.5, 2.4), (9.0, 7.0, 3.4))
    indoors = draw.random() < 0.7
    nodes = _shell(size, draw) if indoors else _yard(size, draw)
    things: list[Node] = []
    for k in range(int(draw.integers(0, most_things + 1))):
        half = draw.uniform((0.1, 0.1, 0.4), (0.6, 0.6, 0.9))
        surface = _surface(draw, 2 * float(half.min()))
        things.append(_thing(f"/thing{k}", Body(Box(half.tolist()), surface), half, size, draw))
    if round_thing == "cylinder":
        half = np.array([0.2, 0.2, 0.9])
        things.append(_thing("/round", Body(Cylinder(0.2, 0.9), Conductor()), half, size, draw))
    elif round_thing == "learned":
        half = np.array([0.5, 0.3, 0.0])  # its origin is the middle of its base
        things.append(_thing("/learned", load_asset(CABINET).body, half, size, draw))
    elif round_thing is not None:
        raise ValueError(f"round_thing {round_thing!r}: expected cylinder, learned or None")
    places = _free_places(1 + receivers, size, things, draw)
    radios = [Radio.at(f"/radio{i}", *p) for i, p in enumerate(places.tolist())]
    frequency = CARRIERS[int(draw.integers(len(CARRIERS)))]
    return Scene((*nodes, *things), (radios[0],), tuple(radios[1:]), frequency)


def _surface(draw: np.random.Generator, thickness: float) -> Surface:
    """Metal, concrete, wood or glass; what is not metal is a slab as thick as the thing."""
    itu = draw.choice(["metal", "concrete", "wood", "glass"])
    return Conductor() if itu == "metal" else Slab(itu=str(itu), thickness_m=thickness)


def _shell(size: np.ndarray, draw: np.random.Generator) -> list[Node]:
    """Six slabs about a room whose inner faces lie at 0 and at ``size``; of one make each."""
    itu = str(draw.choice(["concrete", "plasterboard", "wood"]))
    nodes = []
    for axis, name in enumerate("xyz"):
        for side in (0, 1):
            half, centre = 0.5 * size, 0.5 * size.copy()
            half[axis] = WALL
            centre[axis] = size[axis] + WALL if side else -WALL
            body = Body(Box(half.tolist()), Slab(itu=itu, thickness_m=2 * WALL))
            nodes.append(Node(f"/{name}{side}", body, Pose.at(*centre.tolist())))
    return nodes


def _yard(size: np.ndarray, draw: np.random.Generator) -> list[Node]:
    """A floor, and one or two brick walls at its sides."""
    half = 0.5 * size * (1.5, 1.5, 0.0) + (0.0, 0.0, WALL)
    floor = Body(Box(half.tolist()), DielectricHalfSpace(itu="concrete"))
    nodes = [Node("/floor", floor, Pose.at(0.5 * size[0], 0.5 * size[1], -WALL))]
    for side in range(int(draw.integers(1, 3))):
        body = Body(
            Box((0.5 * size[0], WALL, 0.5 * size[2])), Slab(itu="brick", thickness_m=2 * WALL)
        )
        y = size[1] + WALL if side else -WALL
        nodes.append(Node(f"/wall{side}", body, Pose.at(0.5 * size[0], y, 0.5 * size[2] + 0.005)))
    return nodes


def _thing(
    path: str, body: Body, half: np.ndarray, size: np.ndarray, draw: np.random.Generator
) -> Node:
    """It stands 5 mm above the floor, turned by any angle, clear of the walls."""
    reach = math.hypot(half[0], half[1]) + 0.05
    x, y = draw.uniform((reach, reach), (size[0] - reach, size[1] - reach))
    return Node(path, body, Pose.at(x, y, half[2] + 0.005, float(draw.uniform(0.0, 360.0))))


def _free_places(
    count: int, size: np.ndarray, things: list[Node], draw: np.random.Generator
) -> np.ndarray:
    """Random places in the room that are not in a thing."""
    found: list[np.ndarray] = []
    while len(found) < count:
        place = draw.uniform((0.4, 0.4, 0.4), size - 0.4)
        if all(_clear(place, thing) for thing in things):
            found.append(place)
    return np.stack(found)


def _clear(place: np.ndarray, thing: Node) -> bool:
    low, high = thing.body.shape.bounds().detach().numpy()
    reach = 0.5 * float(np.linalg.norm((high - low)[:2])) + CLEAR
    return float(np.hypot(*(place - thing.pose.translation.numpy())[:2])) > reach
