"""Powers of traced mirrors and edges between places: what ``FloorPlan`` may add to its straight lines.

Traced with the materials that the scene guesses, one interaction a path, and kept in a file: each place
is searched once.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act
from rfsg.tracer.simulate import simulate

QUALITY = Quality.named("standard", depth=1, diffraction=1)
KINDS = (Act.REFLECT, Act.DIFFRACT)
AT_ONCE = 64  # places: bounds memory
Lookup = Callable[[Float[ndarray, "n 3"], Float[ndarray, "n 3"]], Float[ndarray, "n 2"]]


def lookup(
    scene: Path,
    tx_position: Float[ndarray, "n 3"],
    rx_position: Float[ndarray, "m 3"],
    work: Path,
    frequency_hz: float = 2.44e9,
) -> Lookup:
    """Path gains [linear] of mirrors and of edges, summed in power, between any of the places given [m].

    Receivers launch: path gain is the same both ways, and there are fewer of them.
    """
    tx, rx = np.unique(tx_position, axis=0), np.unique(rx_position, axis=0)
    key = hashlib.sha256(scene.read_bytes() + repr((QUALITY, frequency_hz)).encode())
    key.update(tx.tobytes() + rx.tobytes())
    path = work / f"rays-{key.hexdigest()[:12]}.npy"
    if not path.is_file():
        found = traced(Scene.from_usd(scene), tx, rx, frequency_hz)
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(".part")
        with open(beside, "wb") as file:
            np.save(file, found)
        beside.replace(path)
    power = np.load(path)
    tx_of, rx_of = ({tuple(p): i for i, p in enumerate(places)} for places in (tx, rx))

    def at(
        tx_asked: Float[ndarray, "n 3"], rx_asked: Float[ndarray, "n 3"]
    ) -> Float[ndarray, "n 2"]:
        """KeyError for a place that was not given."""
        i = [tx_of[tuple(p)] for p in tx_asked]
        return power[[rx_of[tuple(p)] for p in rx_asked], i]

    return at


def traced(
    scene: Scene, tx: Float[ndarray, "t 3"], rx: Float[ndarray, "r 3"], frequency_hz: float
) -> Float[ndarray, "r t 2"]:
    """Sums over the paths of each pair of places, by KINDS."""
    scene = scene.with_transmitters(radios("rx", rx))
    parts = []
    for places in np.split(tx, range(AT_ONCE, len(tx), AT_ONCE)):
        result = simulate(
            scene.with_receivers(radios("tx", places)),
            torch.tensor([frequency_hz], dtype=torch.float64),
            QUALITY,
        )
        link = (result.channel.tx * len(places) + result.channel.rx).numpy()
        power = (result.channel.gain.abs() ** 2)[:, 0].numpy()
        meets, act = (result.paths.which[:, 0] >= 0).numpy(), result.paths.act[:, 0].numpy()
        sums = [
            np.bincount(link[use], power[use], minlength=len(rx) * len(places))
            for use in (meets & (act == int(kind)) for kind in KINDS)
        ]
        parts.append(np.stack(sums, axis=-1).reshape(len(rx), len(places), len(KINDS)))
    return np.concatenate(parts, axis=1)


def radios(stem: str, places: Float[ndarray, "n 3"]) -> list[Radio]:
    """Isotropic ones."""
    return [Radio.at(f"/{stem}{i}", *place) for i, place in enumerate(places.tolist())]
