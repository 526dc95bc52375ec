"""What rays find: the chains that their tubes make likely, each once, and how often it was met."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import World
from rfsg.tracer.images import fold, images_of
from rfsg.tracer.places import Places
from rfsg.tracer.records import Chains
from rfsg.tracer.tubes import Tubes

TUBE = 2.0  # half-widths: a ray near an edge speaks for its neighbours
GATHERED = 1 << 20  # meetings of tubes and receivers that are put by before the closest are chosen


@dataclass(frozen=True)
class Candidates:
    """Chains of one length from one radio, each sequence and receiver once.

    miss: of the ray that came closest, of which the seed is [rad]. rays: how many met it. true:
    whether a path may exist: the image method finds one on planar mirrors; others are given the
    benefit of the doubt.
    """

    chains: Chains
    miss: Float[Tensor, "c"]
    rays: Int[Tensor, "c"]
    true: Bool[Tensor, "c"]

    def __len__(self) -> int:
        return len(self.miss)


class Candidacy:
    """All candidates from one radio, by length; filled by one level of tubes after the other.

    t: the radio's number; depth: what chains are padded to.
    """

    def __init__(
        self, world: World, t: int, source: Float[Tensor, "3"], places: Places, depth: int
    ):
        self.world, self.t, self.source, self.places, self.depth = world, t, source, places, depth
        self.found: dict[int, Candidates] = {}

    def receive(self, tubes: Tubes, spacing: float) -> int:
        """Take in the chains to all receivers within some tubes; how many true ones are new.

        spacing: of the tubes' directions as they were launched [rad].
        """
        more = self._met(tubes, spacing)
        level = tubes.history.shape[1]
        if level in self.found:
            more, new = _together(self.found[level], more)
        else:
            new = torch.ones_like(more.true)
        fresh = torch.nonzero(new).squeeze(-1)
        true = more.true.clone()
        true[fresh] = self._possible(more.chains.take(fresh), level)
        self.found[level] = replace(more, true=true)
        return int(true[fresh].sum())

    def once(self) -> tuple[int, int]:
        """Chains that a single ray met: of planar mirrors alone, and others."""
        numbers = [0, 0]
        for level, found in self.found.items():
            one = found.chains.take(torch.nonzero(found.true & (found.rays == 1)).squeeze(-1))
            planar = self.world.is_planar(one.which[:, :level], one.patch[:, :level]).all(1)
            for k, some in enumerate((planar, ~planar)):
                numbers[k] += int(some.sum())
        return numbers[0], numbers[1]

    def _met(self, tubes: Tubes, spacing: float) -> Candidates:
        """Every sequence and receiver once, by the closest ray."""
        sequence = numbered(tubes.history[..., 0], tubes.history[..., 1])
        none = sequence[:0]
        ray, rx, miss, rays = none, none, tubes.width[:0], none
        waiting, many = [], 0
        n = max(1, len(self.places))
        for piece in self.places.within(tubes.cones(), TUBE):
            waiting.append(piece)
            many += len(piece[0])
            if many > GATHERED:
                ray, rx, miss, rays = _closest(sequence, n, ray, rx, miss, rays, waiting)
                waiting, many = [], 0
        ray, rx, miss, rays = _closest(sequence, n, ray, rx, miss, rays, waiting)
        level, c = tubes.history.shape[1], len(ray)
        which = torch.full((c, self.depth), -1, dtype=torch.int64, device=ray.device)
        patch = which.clone()
        seed = torch.zeros(c, self.depth, 3, dtype=torch.float64, device=ray.device)
        which[:, :level], patch[:, :level] = tubes.history[ray].unbind(-1)
        seed[:, :level] = tubes.vertices[ray]
        chains = Chains(torch.full_like(rx, self.t), rx, which, patch, seed)
        return Candidates(chains, miss * spacing, rays, torch.zeros_like(rays, dtype=torch.bool))

    def _possible(self, chains: Chains, level: int) -> Bool[Tensor, "c"]:
        """Chains that are not of planar mirrors alone, or that the image method folds."""
        which, patch = chains.which[:, :level], chains.patch[:, :level]
        planar = torch.nonzero(self.world.is_planar(which, patch).all(1)).squeeze(-1)
        mirrors = list(zip(which[planar].unbind(1), patch[planar].unbind(1), strict=True))
        images = images_of(self.world, mirrors, self.source.expand(len(planar), 3))
        true = torch.ones_like(chains.rx, dtype=torch.bool)
        true[planar] = fold(self.world, images, mirrors, self.places.point[chains.rx[planar]])[1]
        return true


def numbered(which: Int[Tensor, "r d"], patch: Int[Tensor, "r d"]) -> Int[Tensor, "r"]:
    """A number for each distinct sequence of (node, patch)."""
    number = torch.zeros(len(which), dtype=torch.int64, device=which.device)
    for node, face in zip(which.unbind(1), patch.unbind(1), strict=True):
        for digit in (node, face):
            digit = digit - digit.min() if len(digit) else digit
            base = int(digit.max()) + 1 if len(digit) else 1
            number = torch.unique(number * base + digit, return_inverse=True)[1]
    return number


def _closest(
    sequence: Tensor,
    n: int,
    ray: Tensor,
    rx: Tensor,
    miss: Tensor,
    rays: Tensor,
    waiting: list[tuple[Tensor, Tensor, Tensor]],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What was chosen before, and meetings that wait, once per sequence and receiver (of n)."""
    if not waiting:
        return ray, rx, miss, rays
    more_ray, more_rx, more_miss = (torch.cat(c) for c in zip(*waiting, strict=True))
    ray, rx, miss = (
        torch.cat([a, b]) for a, b in ((ray, more_ray), (rx, more_rx), (miss, more_miss))
    )
    rays = torch.cat([rays, torch.ones_like(more_ray)])
    best, group = _best(sequence[ray] * n + rx, miss)
    return ray[best], rx[best], miss[best], torch.zeros_like(best).index_add(0, group, rays)


def _best(key: Int[Tensor, "m"], miss: Float[Tensor, "m"]) -> tuple[Tensor, Tensor]:
    """(row of each key's least miss, group of every row), keys in order."""
    order = torch.argsort(miss, stable=True)
    order = order[torch.argsort(key[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool, device=order.device)
    first[1:] = key[order][1:] != key[order][:-1]
    group = torch.empty_like(order)
    group[order] = torch.cumsum(first, 0) - 1
    return order[first], group


def _together(old: Candidates, more: Candidates) -> tuple[Candidates, Bool[Tensor, "c"]]:
    """The candidates of both, and which of them are new."""
    chains = Chains.joined([old.chains, more.chains])
    miss, rays = torch.cat([old.miss, more.miss]), torch.cat([old.rays, more.rays])
    n = int(chains.rx.max()) + 1 if len(chains.rx) else 1
    best, group = _best(numbered(chains.which, chains.patch) * n + chains.rx, miss)
    known = torch.zeros_like(best, dtype=torch.bool)
    known[group[: len(old)]] = True
    true = torch.zeros_like(known)
    true[group[: len(old)]] = old.true
    rays = torch.zeros_like(best).index_add(0, group, rays)
    return Candidates(chains.take(best), miss[best], rays, true), ~known
