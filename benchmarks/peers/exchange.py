"""What the two sides hand over: paths as plain arrays in one .npz file, read without pickle."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy import ndarray

REFLECT, DIFFRACT, SCATTER = 0, 1, 2  # kinds of vertices; -1 pads


@dataclass(frozen=True)
class Traced:
    """All paths of one case.

    names [n]: of the objects. rx [p]; kind, item [p d]: what happens at each vertex and on which
    object (index into names), -1 in the padding; vertex [p d 3] [m], NaN in the padding; crossed
    [p]: walls gone through. delay [p] [s]; gain [p], complex, without the phase of the delay.
    departure, arrival [p 3]: unit vectors from the transmitter, and from the receiver to the wave.
    """

    names: ndarray
    rx: ndarray
    kind: ndarray
    item: ndarray
    vertex: ndarray
    crossed: ndarray
    delay: ndarray
    gain: ndarray
    departure: ndarray
    arrival: ndarray

    def share(self, frequency: float) -> ndarray:
        """[p]: each path's share of h(f), with the phase of its delay in float64."""
        return self.gain * np.exp(-2j * np.pi * np.mod(frequency * self.delay, 1.0))

    def transfer(self, frequency: float, receivers: int) -> ndarray:
        """h(f) of every receiver [r]."""
        h = np.zeros(receivers, complex)
        np.add.at(h, self.rx, self.share(frequency))
        return h

    def key(self, p: int) -> tuple[int, tuple[tuple[int, str], ...]]:
        """Receiver and the kinds and objects in order: what two tracers must agree on."""
        d = self.kind[p] >= 0
        steps = zip(self.kind[p][d].tolist(), self.names[self.item[p][d]].tolist(), strict=True)
        return int(self.rx[p]), tuple(steps)

    def polyline(self, p: int, transmitter: ndarray, receiver: ndarray) -> ndarray:
        """[k 3]: transmitter, vertices, receiver of one path."""
        return np.vstack([transmitter, self.vertex[p][self.kind[p] >= 0], receiver])

    @staticmethod
    def joined(parts: "list[Traced]") -> "Traced":
        """All paths of several parts with the same objects and depth."""
        rest = [f.name for f in fields(Traced) if f.name != "names"]
        merged = {n: np.concatenate([getattr(p, n) for p in parts]) for n in rest}
        return Traced(names=parts[0].names, **merged)

    def save(self, path: Path) -> None:
        np.savez(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @staticmethod
    def load(path: Path) -> "Traced":
        with np.load(path, allow_pickle=False) as file:
            return Traced(**{f.name: file[f.name] for f in fields(Traced)})


def file_of(folder: Path, case_name: str, side: str) -> Path:
    return folder / f"{case_name.replace(' ', '_')}.{side}.npz"
