"""Boxes in Embree: which of many may a ray meet? Complete, whatever they touch or overlap.

Embree returns the first hit only, in float32, so it *proposes*: the box it hit, and every box that
touches that one, become candidates; then the search goes on from where the hit box is left. Two boxes
that do not touch are more than ``gap`` apart, so nothing can begin between the exit of one and the
restart behind it: no box is lost.

A box that touches very many (a floor) would propose them all to every ray that meets it, so such hubs
are taken out and proposed to every ray. And what was built is kept: where a few boxes of many have
moved, those stand in a small scene of their own, and the others are not built again.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.tracer.triangles import Triangles

# The twelve triangles of a box whose corner k has bits (x, y, z) of k.
_TRIANGLES = torch.tensor(
    [
        [0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 7, 3], [1, 5, 7],
    ]
)  # fmt: skip
MOST_NEIGHBOURS = 32  # more, and a box is a hub
MOST_HUBS = 64  # then long lists of neighbours are the lesser evil
MOST_PAIRS = 4_000_000  # of boxes side by side along an axis, compared at a time
MOVED = 1 / 8  # of the boxes: beyond it everything is built anew
FEW_MOVED = 16  # so many may always move
MOST_KEPT = 4  # sets of boxes whose scenes are kept


@dataclass(frozen=True)
class Neighbours:
    """For every box those that touch it: ``other[begin[i] : begin[i + 1]]``."""

    begin: Int[Tensor, "k1"]
    other: Int[Tensor, "m"]

    def of(self, ray: Int[Tensor, "n"], box: Int[Tensor, "n"]) -> tuple[Tensor, Tensor]:
        """(ray, neighbour) for all neighbours of each ray's box."""
        begin, count = self.begin[box], self.begin[box + 1] - self.begin[box]
        row = torch.repeat_interleave(torch.arange(len(box), device=box.device), count)
        place = torch.arange(len(row), device=box.device) - (torch.cumsum(count, 0) - count)[row]
        return ray[row], self.other[begin[row] + place]


class Boxes:
    """k boxes by their corners [k 8 3] m, in one Embree scene; immutable."""

    def __init__(self, corners: Float[Tensor, "k 8 3"]):
        self.keys = _keys(corners)
        device = corners.device
        middle = 0.5 * (corners.amin((0, 1)) + corners.amax((0, 1))) if len(corners) else 0.0
        extent = float((corners - middle).abs().max()) if len(corners) else 1.0
        # Embree sees float32: a millimetre, or 64 float32 steps of the scene's extent if that is more
        self.gap = max(1e-3, 64.0 * 2.0**-23 * extent)
        first, second = touching(corners, self.gap)
        hub = _hubs(len(corners), first, second)
        self.hubs = torch.nonzero(hub).squeeze(-1)
        self.row = torch.nonzero(~hub).squeeze(-1)  # of the boxes that stand in the scene
        apart = ~hub[first] & ~hub[second]
        self.neighbours = _listed(len(corners), first[apart], second[apart])
        self.triangles = Triangles(corners[self.row][:, _TRIANGLES.to(device)].reshape(-1, 3, 3))

    def first(
        self, origin: Float[Tensor, "r 3"], direction: Float[Tensor, "r 3"]
    ) -> tuple[Int[Tensor, "r"], Float[Tensor, "r"]]:
        """First box that each ray meets, -1 for none, hubs left out; and the distance [m]."""
        hit, distance = self.triangles.first(origin, direction)
        which = torch.div(hit.clamp(min=0), len(_TRIANGLES), rounding_mode="floor")
        if not len(self.row):
            return hit, distance
        return torch.where(hit < 0, -1, self.row[which]), distance


def touching(corners: Float[Tensor, "k 8 3"], gap: float) -> tuple[Tensor, Tensor]:
    """Pairs (i, j) of boxes whose axis-aligned hulls come within ``gap``, each once, i not j: a
    superset of those that do. Swept along the axis on which the fewest lie side by side."""
    low, high = corners.amin(1) - gap, corners.amax(1) + gap
    sweeps = [_sweep(low[:, axis], high[:, axis]) for axis in range(3)] if len(corners) else []
    none = torch.zeros(0, dtype=torch.int64, device=corners.device)
    pairs = [(none, none)]
    if sweeps:
        order, count = min(sweeps, key=lambda sweep: int(sweep[1].sum()))
        low, high = low[order], high[order]
        total = torch.cumsum(count, 0)
        blocks = torch.div(total, MOST_PAIRS, rounding_mode="floor")
        for block in torch.unique(blocks):
            mine = torch.nonzero(blocks == block).squeeze(-1)
            i = torch.repeat_interleave(mine, count[mine])
            first = torch.cumsum(count[mine], 0) - count[mine]
            at = torch.arange(len(i), device=i.device) - first.repeat_interleave(count[mine])
            j = i + 1 + at
            meets = torch.ones_like(i, dtype=torch.bool)
            for axis in range(3):
                meets &= (low[i, axis] <= high[j, axis]) & (low[j, axis] <= high[i, axis])
            pairs.append((order[i[meets]], order[j[meets]]))
    first, second = (torch.cat(column) for column in zip(*pairs, strict=True))
    return first, second


def _sweep(low: Float[Tensor, "k"], high: Float[Tensor, "k"]) -> tuple[Tensor, Tensor]:
    """Order of stretches by where they begin, and how many begin after each, before it ends."""
    order = torch.argsort(low, stable=True)
    last = torch.searchsorted(low[order].contiguous(), high[order].contiguous(), right=True)
    return order, (last - 1 - torch.arange(len(order), device=low.device)).clamp(min=0)


def _hubs(k: int, first: Tensor, second: Tensor) -> Bool[Tensor, "k"]:
    """Boxes that are taken out, the one with the most neighbours first, until none has too many."""
    hub = torch.zeros(k, dtype=torch.bool, device=first.device)
    count = torch.bincount(torch.cat([first, second]), minlength=k)
    for _ in range(min(MOST_HUBS, k)):
        most = int(count.argmax())
        if int(count[most]) <= MOST_NEIGHBOURS:
            break
        hub[most] = True
        beside = torch.cat([second[first == most], first[second == most]])
        count[beside] -= 1
        count[most] = 0
    return hub


def _listed(k: int, first: Tensor, second: Tensor) -> Neighbours:
    """Pairs as lists, every box its own neighbour."""
    own = torch.arange(k, device=first.device)
    box, other = torch.cat([first, second, own]), torch.cat([second, first, own])
    order = torch.argsort(box, stable=True)
    begin = torch.searchsorted(box[order].contiguous(), torch.arange(k + 1, device=box.device))
    return Neighbours(begin, other[order])


@dataclass(frozen=True)
class Layer:
    """Boxes and whose each is: ``owner`` [k], -1 for one that has moved away since they were built."""

    boxes: Boxes
    owner: Int[Tensor, "k"]


_KEPT: list[Boxes] = []


def layers_of(corners: Float[Tensor, "k 8 3"]) -> list[Layer]:
    """All boxes, owned 0 to k - 1, in one layer; or those that stand as in a scene that was kept, and
    the few others in a second."""
    keys = _keys(corners)
    for kept in _KEPT:
        owner = _owners(kept.keys, keys, corners.device)
        new = torch.ones(len(corners), dtype=torch.bool, device=corners.device)
        new[owner[owner >= 0]] = False
        if max(int(new.sum()), int((owner < 0).sum())) <= max(FEW_MOVED, MOVED * len(corners)):
            moved = torch.nonzero(new).squeeze(-1)
            apart = [Layer(Boxes(corners[moved]), moved)] if len(moved) else []
            return [Layer(kept, owner), *apart]
    everything = torch.arange(len(corners), device=corners.device)
    layer = Layer(Boxes(corners), everything)
    _KEPT.insert(0, layer.boxes)
    del _KEPT[MOST_KEPT:]
    return [layer]


def _keys(corners: Float[Tensor, "k 8 3"]) -> list[bytes]:
    flat = np.ascontiguousarray(corners.cpu().numpy().reshape(len(corners), -1))
    return [row.tobytes() for row in flat]


def _owners(kept: list[bytes], now: list[bytes], device: torch.device) -> Int[Tensor, "k"]:
    """For each box kept the number of one that now stands exactly there; each is taken once."""
    places: dict[bytes, list[int]] = {}
    for number in reversed(range(len(now))):
        places.setdefault(now[number], []).append(number)
    owner = [places[key].pop() if places.get(key) else -1 for key in kept]
    return torch.tensor(owner, dtype=torch.int64, device=device)
