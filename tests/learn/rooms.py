"""Small rooms and simulated readings that the tests of fitting share."""

from dataclasses import replace

import torch

import rfsg
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.interface import DielectricHalfSpace
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.scene import Node, Scene
from tests.scenes import box_node, radio, room_nodes

QUALITY = rfsg.Quality.named("draft", depth=1)
FREQUENCY = 2.4e9


def places(count: int, seed: int = 3) -> list[list[float]]:
    """Random places in the room, clear of its walls and of the thing in its middle."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(3 * count, 3, generator=generator, dtype=torch.float64)
    place = 0.4 + share * torch.tensor([5.2, 3.2, 2.2])
    away = (place[:, :2] - torch.tensor([3.1, 2.0])).norm(dim=1)
    return place[away > 0.8][:count].tolist()


def room_with(*nodes: Node, count: int = 12) -> Scene:
    """The empty room with things in it: one transmitter, receivers here and there."""
    rx = tuple(radio(f"/rx{i}", *p) for i, p in enumerate(places(count)))
    return Scene(
        (*room_nodes(), *nodes), (radio("/tx", 1.31, 2.11, 1.73, power_dbm=10.0),), rx, FREQUENCY
    )


def with_surface(scene: Scene, path: str, surface) -> Scene:
    """Another surface on one object, its shape kept."""
    nodes = [
        replace(n, body=Body(n.body.shape, surface)) if n.path == path else n for n in scene.nodes
    ]
    return replace(scene, nodes=tuple(nodes))


def halfspace(eps_r: float, sigma: float) -> DielectricHalfSpace:
    return DielectricHalfSpace(eps_r=eps_r, sigma=sigma)


def thing(surface=None, half=(0.3, 0.5, 0.8)) -> Node:
    """A box in the middle of the room, in the way of some links."""
    return box_node("/thing", (3.1, 2.0, 1.2), half, surface or learned(0), yaw_deg=20.0)


def learned(seed: int, **options) -> StochasticSurface:
    torch.manual_seed(seed)
    return StochasticSurface(**options)


def box(half) -> Box:
    return Box(half)


def readings(scene: Scene, kind: str = "gain", quality=QUALITY) -> rfsg.Measurements:
    """What a scene gives between its transmitters and all its receivers, without noise."""
    result = rfsg.simulate(scene, FREQUENCY, quality)
    h = result.transfer()[..., 0].flatten()
    pairs = [(t, r.path) for t in scene.transmitters for r in scene.receivers]
    db = 20.0 * torch.log10(h.abs())
    sent = torch.tensor([t.power_dbm for t, _ in pairs], dtype=torch.float64)
    columns = {
        "gain": {"gain_re": h.real.tolist(), "gain_im": h.imag.tolist()},
        "path_gain": {"path_gain_db": db.tolist()},
        "rssi": {"rssi_dbm": (db + sent).tolist()},
        "delay": {"delay_s": _delays(result)},
    }[kind]
    tx, rx = [t.path for t, _ in pairs], [r for _, r in pairs]
    return rfsg.Measurements.of(tx=tx, rx=rx, frequency_hz=FREQUENCY, **columns)


def _delays(result: rfsg.Result) -> list[float]:
    """Of the strongest path of every link [s]."""
    channel = result.channel
    link = channel.tx * len(result.scene.receivers) + channel.rx
    size = channel.gain[:, 0].abs()
    strongest = [
        int(torch.where(link == k, size, -1.0).argmax()) for k in range(int(link.max()) + 1)
    ]
    return channel.delay[strongest].tolist()
