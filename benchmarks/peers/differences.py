"""Which path of one tracer is which of the other, and where they differ by more than a threshold."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from cases import Case
from exchange import Traced
from numpy import ndarray
from scipy.optimize import linear_sum_assignment

THRESHOLD = {
    "power [dB]": 0.1,
    "delay [ns]": 0.01,
    "phase [deg]": 1.0,
    "link power [dB]": 0.1,
    "scattered power [dB]": 0.1,
}
SAME_VERTEX = 0.5  # [m]: of one sequence of objects, farther apart is another path
KINDS = {0: "", 1: "edge of ", 2: "scattered by "}


@dataclass(frozen=True)
class Difference:
    """One number that the peer has otherwise. ``p``, ``s``: the path in rfsg and in the peer, or -1."""

    quantity: str
    rx: int
    path: str
    value: float  # peer minus rfsg
    p: int = -1
    s: int = -1


@dataclass(frozen=True)
class Compared:
    """One case traced by both sides and, where there is one, by a closed form."""

    case: Case
    rfsg: Traced
    peer: Traced
    truth: Traced | None

    @cached_property
    def pairs(self) -> ndarray:
        """[m 2]: path in rfsg, path in the peer."""
        return matched(self.case, self.rfsg, self.peer)

    @cached_property
    def truth_of(self) -> dict[int, int]:
        """Path in rfsg -> path of the closed form."""
        if self.truth is None:
            return {}
        return {int(p): int(t) for p, t in matched(self.case, self.rfsg, self.truth)}

    def errors(self, quantity: str) -> ndarray:
        """[m]: peer minus rfsg, of the paths that both have."""
        return compare(quantity, self.case, self.rfsg, self.peer, self.pairs)

    def error_to_truth(self, side: str, quantity: str) -> ndarray:
        """[m]: one side minus the closed form, of the paths that both have."""
        if self.truth is None:
            return np.zeros(0)
        traced: Traced = getattr(self, side)
        pairs = matched(self.case, self.truth, traced)
        return compare(quantity, self.case, self.truth, traced, pairs)

    def link_power(self, traced: Traced) -> ndarray:
        """|h|^2 of every receiver [dB]."""
        h = traced.transfer(self.case.frequency, len(self.case.receivers))
        return decibel(h)

    @cached_property
    def differences(self) -> list[Difference]:
        found = []
        for p in sorted(set(range(len(self.rfsg.rx))) - set(self.pairs[:, 0])):
            rx = int(self.rfsg.rx[p])
            found.append(Difference("missing in the peer", rx, label(self.rfsg, p), 0.0, p=p))
        for s in sorted(set(range(len(self.peer.rx))) - set(self.pairs[:, 1])):
            rx = int(self.peer.rx[s])
            found.append(Difference("missing in rfsg", rx, label(self.peer, s), 0.0, s=s))
        for quantity in ("power [dB]", "delay [ns]", "phase [deg]"):
            values = self.errors(quantity)
            for i in np.nonzero(np.abs(values) > THRESHOLD[quantity])[0]:
                p, s = (int(k) for k in self.pairs[i])
                rx = int(self.rfsg.rx[p])
                found.append(Difference(quantity, rx, label(self.rfsg, p), float(values[i]), p, s))
        link = self.link_power(self.peer) - self.link_power(self.rfsg)
        for r in np.nonzero(np.abs(link) > THRESHOLD["link power [dB]"])[0]:
            found.append(Difference("link power [dB]", int(r), "all paths", float(link[r])))
        return found


def matched(case: Case, ours: Traced, theirs: Traced) -> ndarray:
    """[m 2]: paths over the same objects in the same order, those nearest to each other."""
    tx, rx = np.array(case.transmitter), np.array(case.receivers)
    groups: dict[tuple, tuple[list[int], list[int]]] = {}
    for side, traced in enumerate((ours, theirs)):
        for p in range(len(traced.rx)):
            groups.setdefault(traced.key(p), ([], []))[side].append(p)
    pairs = []
    for (r, _), (left, right) in groups.items():
        a = [ours.polyline(p, tx, rx[r]) for p in left]
        b = [theirs.polyline(p, tx, rx[r]) for p in right]
        far = np.array([[np.linalg.norm(x - y, axis=1).max() for y in b] for x in a])
        if far.size:
            for i, j in zip(*linear_sum_assignment(far), strict=True):
                if far[i, j] < SAME_VERTEX:
                    pairs.append((left[i], right[j]))
    return np.array(sorted(pairs), int).reshape(-1, 2)


def compare(quantity: str, case: Case, first: Traced, second: Traced, pairs: ndarray) -> ndarray:
    """[m]: second minus first, pair by pair."""
    i, j = pairs.T
    if quantity == "power [dB]":
        return decibel(second.gain[j]) - decibel(first.gain[i])
    if quantity == "delay [ns]":
        return (second.delay[j] - first.delay[i]) * 1e9
    if quantity == "phase [deg]":
        a, b = first.share(case.frequency)[i], second.share(case.frequency)[j]
        return np.degrees(np.angle(b * a.conj()))
    between = [
        2 * np.arcsin(np.clip(np.linalg.norm(x[j] - y[i], axis=1) / 2, 0, 1))
        for x, y in ((second.departure, first.departure), (second.arrival, first.arrival))
    ]
    return np.degrees(np.max(between, axis=0))  # "angle [deg]"


def label(traced: Traced, p: int) -> str:
    """A path in words: what it meets, in order."""
    steps = [KINDS[k] + name for k, name in traced.key(p)[1]]
    crossed = f" through {traced.crossed[p]}" if traced.crossed[p] else ""
    return (" ".join(steps) or "direct") + crossed


def decibel(amplitude: ndarray | complex) -> ndarray:
    return 20 * np.log10(np.maximum(np.abs(amplitude), 1e-300))
