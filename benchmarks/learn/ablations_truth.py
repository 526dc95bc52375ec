"""What the ablations are learned from: a room of known materials, readings of it, the same room moved.

Truth and fit follow the same paths, so that a right material leaves no error: what is left is the
learning's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

import rfsg
from rfsg.objects.contract import Shape, Surface
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene

LAB = Path(__file__).parents[2] / "assets" / "scenes" / "lab.usda"
OTHERS = ("Desk", "Chairs/Chair_0", "Chairs/Chair_1", "Person", "Cabinet")
CABINET, SCREEN = "/World/Cabinet", "/World/Screen"
FREQUENCY = 2.44e9
QUALITY = rfsg.Quality.named("draft", depth=1)
SEEN, UNSEEN = 200, 120
SEEN_GEOMETRY = 60  # of them, where a shape is learned: a step and a search are dear there
NOISE_DB, NOISE_GAIN = 2.0, 0.1
SENT_DBM = -40.0  # of the beacons: the weakest quarter of the readings is then about at -93 dBm
LOST = 0.25  # share of the readings that are not received
MATTERS_DB = 1.0  # an object matters for a link whose gain is another by this much without it
CLEAR = 0.15  # [m] between a receiver and an object, before and after the move
BEACONS = ((0.6, 5.5, 1.1), (4.6, 0.6, 1.4))
PLACES = ((0.4, 0.4, 0.7), (4.8, 5.6, 1.6))  # of the receivers, from and to [m]
FACING, PLACES_FACING = (
    ((4.4, 4.2, 1.1),),
    ((2.7, 3.2, 0.7), (4.7, 5.2, 1.5)),
)  # the cabinet's front
MOVES = {CABINET: (-0.9, -1.2, 0.0), SCREEN: (0.2, 1.2, 0.0)}
DEEPER = 0.025  # [m] to each side, of the cabinet whose shape is learned
HALF_CABINET = (0.225, 0.45, 0.7)


@dataclass(frozen=True)
class Truth:
    """A scene as it is, links in it, and what they are found to carry.

    gain_db: path gains of all links, SEEN of them read and the rest asked for, matters: see
    MATTERS_DB; both before and after the move, by name. measured: what was read of the first SEEN.
    """

    scene: Scene
    objects: tuple[str, ...]
    measured: rfsg.Measurements
    asked: rfsg.Measurements
    gain_db: dict[str, Float[Tensor, "n"]]
    matters: dict[str, Bool[Tensor, "n"]]

    def scenes(self, scene: Scene) -> dict[str, Scene]:
        """A scene before and after the move of its objects."""
        return {"before": scene, "moved": moved(scene, self.objects)}


def materials(seed: int) -> Truth:
    """A cabinet of 22 mm chipboard and a screen of 10 mm glass; received powers, the weak ones lost."""
    shapes: dict[str, tuple[Shape, Surface, Pose]] = {
        CABINET: (Box(HALF_CABINET), Slab(0.022, itu="chipboard"), Pose.at(2.2, 4.2, 0.705)),
        SCREEN: (Box((0.03, 0.6, 0.9)), Slab(0.01, itu="glass"), Pose.at(3.6, 2.2, 0.905, 30.0)),
    }
    things = [Node(p, rfsg.Body(shape, of), at) for p, (shape, of, at) in shapes.items()]
    scene, asked, generator = room(things, seed)
    truth = told(scene, asked)
    power = truth.gain_db["before"][:SEEN] + SENT_DBM
    power = power + NOISE_DB * torch.randn(SEEN, generator=generator, dtype=torch.float64)
    threshold = float(power.quantile(LOST))
    read = [p if p >= threshold else None for p in power.tolist()]
    return replace(truth, measured=readings(scene, SEEN, threshold, rssi_dbm=read))


def geometry(seed: int) -> Truth:
    """A metal cabinet 5 cm deeper than ``thin_cabinet``, seen from its front; complex gains, which
    hold the phase."""
    half = (HALF_CABINET[0] + DEEPER, *HALF_CABINET[1:])
    metal = rfsg.Scene.from_usd(LAB).node(CABINET).body.surface
    scene, asked, generator = room(
        [Node(CABINET, rfsg.Body(Box(half), metal), Pose.at(2.2, 4.2, 0.705))],
        seed,
        FACING,
        PLACES_FACING,
    )
    truth = told(scene, asked)
    said = rfsg.predict(scene, asked, QUALITY).gain[:SEEN_GEOMETRY]
    noise = torch.randn(SEEN_GEOMETRY, generator=generator, dtype=torch.complex128)
    read = said + NOISE_GAIN * said.abs() * noise
    gain = {"gain_re": read.real.tolist(), "gain_im": read.imag.tolist()}
    return replace(truth, measured=readings(scene, SEEN_GEOMETRY, **gain))


def thin_cabinet() -> Node:
    """The lab's metal cabinet where it stands: its learned shape is 0.45 m deep."""
    return rfsg.Scene.from_usd(LAB).node(CABINET)


def room(
    things: Sequence[Node],
    seed: int,
    beacons: Sequence[Sequence[float]] = BEACONS,
    places: Sequence[Sequence[float]] = PLACES,
) -> tuple[Scene, rfsg.Measurements, torch.Generator]:
    """The lab with some things, beacons and receivers; all links; the rest of the seed's numbers."""
    lab = rfsg.Scene.from_usd(LAB)
    for name in OTHERS:
        lab = lab.without(f"/World/{name}")
    lab = replace(lab, nodes=(*lab.nodes, *things))
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(3 * (SEEN + UNSEEN), 3, generator=generator, dtype=torch.float64)
    low, high = torch.tensor(places, dtype=torch.float64)
    place = low + (high - low) * share
    there = [*things, *moved(lab, [t.path for t in things]).nodes[-len(things) :]]
    apart = torch.stack([n.body.shape.sdf(n.pose.point_object(place)) for n in there])
    place = place[(apart > CLEAR).all(0)][: SEEN + UNSEEN]
    senders = [
        rfsg.Radio.at(f"/World/Radios/B{i}", *p, power_dbm=SENT_DBM) for i, p in enumerate(beacons)
    ]
    receivers = [rfsg.Radio.at(f"/World/R{i}", *p) for i, p in enumerate(place.tolist())]
    lab = lab.with_transmitters(senders).with_receivers(receivers)
    count = len(receivers)
    return lab, readings(lab, count, path_gain_db=[0.0] * count), generator


def readings(
    scene: Scene, count: int, threshold: float | None = None, **columns: Sequence[float | None]
) -> rfsg.Measurements:
    """Of the first receivers, each hearing one of the beacons in turn."""
    return rfsg.Measurements.of(
        tx=[scene.transmitters[i % len(scene.transmitters)].path for i in range(count)],
        rx=[r.path for r in scene.receivers[:count]],
        frequency_hz=FREQUENCY,
        threshold_dbm=threshold,
        **columns,
    )


def told(scene: Scene, asked: rfsg.Measurements) -> Truth:
    """What the links carry, and which of them the objects matter for; nothing is read yet."""
    objects = tuple(n.path for n in scene.nodes if n.path in MOVES)
    empty = rfsg.predict(without(scene, objects), asked, QUALITY).path_gain_db()
    truth = Truth(scene, objects, asked, asked, {}, {})
    for when, there in truth.scenes(scene).items():
        truth.gain_db[when] = rfsg.predict(there, asked, QUALITY).path_gain_db()
        truth.matters[when] = (truth.gain_db[when] - empty).abs() > MATTERS_DB
    return truth


def without(scene: Scene, objects: Sequence[str]) -> Scene:
    """The scene with these objects taken away."""
    for path in objects:
        scene = scene.without(path)
    return scene


def moved(scene: Scene, objects: Sequence[str]) -> Scene:
    """Each object that is there where it stands after the move."""
    for node in scene.nodes:
        if node.path in objects:
            scene = scene.moved(node.path, MOVES[node.path])
    return scene
