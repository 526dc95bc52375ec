"""Which radios of a scene the readings are between: names and positions become radios and links."""

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.learn.errors import MeasurementError
from rfsg.learn.measurements import Measurements, Place
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene


@dataclass(frozen=True)
class Links:
    """l links that n readings are of. tx, rx: numbers of each link's radios.

    link_of, frequency_of: the link and the frequency of each reading.
    """

    transmitters: tuple[Radio, ...]
    receivers: tuple[Radio, ...]
    tx: Int[Tensor, "l"]
    rx: Int[Tensor, "l"]
    frequency: Float[Tensor, "f"]
    link_of: Int[Tensor, "n"]
    frequency_of: Int[Tensor, "n"]

    def __len__(self) -> int:
        return len(self.tx)

    def groups(self) -> Iterator[tuple[list[int], list[int]]]:
        """(transmitters, receivers) whose every pair is a link: each link once.

        By the end with fewer places; those with the same partners go together.
        """
        flipped = len(self.receivers) < len(self.transmitters)
        one, other = (self.rx, self.tx) if flipped else (self.tx, self.rx)
        partners: dict[int, list[int]] = {}
        for a, b in zip(one.tolist(), other.tolist(), strict=True):
            partners.setdefault(a, []).append(b)
        alike: dict[tuple[int, ...], list[int]] = {}
        for a, many in partners.items():
            alike.setdefault(tuple(sorted(many)), []).append(a)
        for many, ones in alike.items():
            yield (list(many), ones) if flipped else (ones, list(many))

    def find(self, tx: Int[Tensor, "p"], rx: Int[Tensor, "p"]) -> Int[Tensor, "p"]:
        """The links between radios that are linked. The links stand in order of (tx, rx)."""
        width = len(self.receivers)
        return torch.searchsorted(self.tx * width + self.rx, tx * width + rx)


def link_up(scene: Scene, measured: Measurements) -> Links:
    """Find the radios that readings name, and make those that stand at positions.

    A name is a prim path, or the last part of one where only one radio has it. A radio of the scene
    may be either end: readings of a receiver that sends are as good, for channels are reciprocal.
    What stands at a position is isotropic, without polarisation, and sends 0 dBm.
    Raises MeasurementError for names that are unknown or mean several radios.
    """
    faults: list[str] = []
    ends = []
    for end, places, first, second in (
        ("tx", measured.tx_places, scene.transmitters, scene.receivers),
        ("rx", measured.rx_places, scene.receivers, scene.transmitters),
    ):
        radios = [_radio(end, k, p, first, second, faults) for k, p in enumerate(places)]
        ends.append(radios)
    if faults:
        where = measured.source or "measurements"
        raise MeasurementError([f"{where}: {fault}" for fault in faults])
    tx, rx = (_distinct(radios) for radios in ends)
    pairs = torch.stack([tx[1][measured.tx], rx[1][measured.rx]], -1)
    pairs, link_of = torch.unique(pairs, dim=0, return_inverse=True)
    frequency, frequency_of = torch.unique(measured.frequency, return_inverse=True)
    return Links(
        tx[0], rx[0], pairs[:, 0].clone(), pairs[:, 1].clone(), frequency, link_of, frequency_of
    )


def _radio(
    end: str,
    number: int,
    place: Place,
    first: Sequence[Radio],
    second: Sequence[Radio],
    faults: list[str],
) -> Radio | None:
    if not isinstance(place, str):
        return Radio.at(f"/Measured/{end}_{number}", *place)
    if not place:
        if len(first) == 1:
            return first[0]
        faults.append(f"{end} is empty, and the scene has {len(first)} of them: expected a name")
        return None
    for radios in (first, second):
        found = [r for r in radios if r.path == place]
        found = found or [r for r in radios if r.path.rsplit("/", 1)[-1] == place]
        if len(found) == 1:
            return found[0]
        if found:
            paths = ", ".join(r.path for r in found)
            faults.append(f"{end} {place!r} means several radios: {paths}; give the whole path")
            return None
    names = [r.path for r in (*first, *second)]
    short = {r.rsplit("/", 1)[-1]: r for r in names}
    near = difflib.get_close_matches(place.rsplit("/", 1)[-1], list(short), 3, 0.4)
    known = ", ".join(short[n] for n in near) or ", ".join(names[:5]) or "none at all"
    faults.append(f"{end} {place!r} is no radio of the scene; near it: {known}")
    return None


def _distinct(radios: Sequence[Radio | None]) -> tuple[tuple[Radio, ...], Int[Tensor, "k"]]:
    """Radios once each (two names may mean one), and which of them each place is."""
    order: dict[int, int] = {}
    kept: list[Radio] = []
    index = []
    for radio in radios:
        assert radio is not None  # a fault was raised before
        if id(radio) not in order:
            order[id(radio)] = len(kept)
            kept.append(radio)
        index.append(order[id(radio)])
    return tuple(kept), torch.tensor(index, dtype=torch.int64)
