"""Glints on one curved or learned face, looked up on its samples.

Between two images a face glints where the length of the path stops changing along it. A sample says
how far away, at least, that is: the slope of the length there over its bend. Objects that share a
shape share its samples, so images are brought into the objects' frame, not samples into the world.
Samples lie in clusters, and a cluster that holds no candidate is put aside whole: as a ball of points
and a cone of normals it bounds the slopes of all its samples from below.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.tracer.faces import Clusters, Samples

NEAR = 3.0  # times the samples' spacing: how far a glint may lie from its nearest sample
PAIRS = 1 << 12  # pairs at a time: what a cluster sees of them stays in the cache
BESIDE = 0.12  # of the object's radius: candidates of one pair this close may be one glint
ALIKE = 0.9  # cosine between the normals of two such candidates, at least


@dataclass(frozen=True)
class Seen:
    """Samples that may be near a glint: number of the pair of images, of the sample, its score."""

    pair: Int[Tensor, "m"]
    sample: Int[Tensor, "m"]
    score: Float[Tensor, "m"]  # minus the glint's distance, at least, in spacings of the samples

    def take(self, i: Tensor) -> "Seen":
        return Seen(self.pair[i], self.sample[i], self.score[i])


def glints(
    item: Samples, fore: Float[Tensor, "p 3"], aft: Float[Tensor, "p 3"]
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """(pair of images, sample) where the path's length slopes least along the face, in each patch.

    fore, aft: images at either end of every pair, in the object's frame [its units].
    """
    none = torch.zeros(0, dtype=torch.int64, device=fore.device)
    found = [(none, none)]
    patches = int(item.patch_column.max()) + 1
    for begin in range(0, len(fore), PAIRS):
        piece = slice(begin, begin + PAIRS)
        some = _good(item, fore[piece], aft[piece])
        some = some.take(_best_of_patch(item, some, len(fore[piece]), patches))
        some = some.take(torch.nonzero(~_outdone(item, some)).squeeze(-1))
        # pair by pair, whatever the clusters' order
        some = some.take(torch.argsort(some.pair * len(item.point) + some.sample))
        found.append((some.pair + begin, some.sample))
    pair, sample = (torch.cat(c) for c in zip(*found, strict=True))
    return pair, sample


def _good(item: Samples, fore: Tensor, aft: Tensor) -> Seen:
    """All samples with a score above -NEAR, cluster by cluster."""
    parts, possible = [], may_glint(item.clusters, fore, aft)
    for cluster in torch.nonzero(possible.any(0)).squeeze(-1).tolist():
        row = torch.nonzero(possible[:, cluster]).squeeze(-1)
        sample = item.clusters.members[cluster]
        sample = sample[sample >= 0]
        value = scores(item, sample, fore[row], aft[row])
        i, j = torch.nonzero(value > -NEAR, as_tuple=True)
        parts.append(Seen(row[i], sample[j], value[i, j]))
    if not parts:
        none = torch.zeros(0, dtype=torch.int64, device=fore.device)
        return Seen(none, none, fore.new_zeros(0))
    return Seen(*(torch.cat([getattr(p, n) for p in parts]) for n in Seen.__dataclass_fields__))


@dataclass(frozen=True)
class Views:
    """What points see of the images of each pair: inverse distances, heights over the tangent plane
    and the cosine between the images, of unit vectors towards them."""

    near: tuple[Float[Tensor, "p m"], Float[Tensor, "p m"]]  # one over the distance
    height: tuple[Float[Tensor, "p m"], Float[Tensor, "p m"]]
    cosine: Float[Tensor, "p m"]

    def slope_squared(self) -> Float[Tensor, "p m"]:
        """Of the path's length along the face: zero where it reflects, small when it grazes."""
        height = self.height[0] + self.height[1]
        return (2.0 + 2.0 * self.cosine - height * height).clamp(min=0.0)


def _views(point: Tensor, normal: Tensor, fore: Tensor, aft: Tensor) -> Views:
    """All pairs and points by matrix products: a vector for each of them would take most of the time."""
    middle = point.mean(0)  # products of far coordinates would cancel
    q, f, g = point - middle, fore - middle, aft - middle
    square, foot = (q * q).sum(-1), (q * normal).sum(-1)
    near = [
        ((x * x).sum(-1, keepdim=True) - 2.0 * x @ q.T + square).clamp(min=LEAST**2).rsqrt()
        for x in (f, g)
    ]
    height = [(x @ normal.T - foot) * n for x, n in zip((f, g), near, strict=True)]
    product = (f * g).sum(-1, keepdim=True) - (f + g) @ q.T + square
    return Views((near[0], near[1]), (height[0], height[1]), product * near[0] * near[1])


LEAST = 1e-9  # [units of the object] nearer images define no direction


def scores(
    item: Samples, sample: Int[Tensor, "m"], fore: Float[Tensor, "p 3"], aft: Float[Tensor, "p 3"]
) -> Float[Tensor, "p m"]:
    """Minus how far away, at least, the glint is, in spacings; -inf where either image is behind."""
    seen = _views(item.point[sample], item.normal[sample], fore, aft)
    # slope / bend of the length is how far away, at least, the glint is
    bend = seen.near[0] + seen.near[1] + 2.0 * item.curvature[sample]
    distance = seen.slope_squared().sqrt() / (bend * item.reach[sample])
    lit = (seen.height[0] > 0) & (seen.height[1] > 0)
    return torch.where(lit, -distance, -torch.inf)


def may_glint(
    clusters: Clusters, fore: Float[Tensor, "p 3"], aft: Float[Tensor, "p 3"]
) -> Bool[Tensor, "p k"]:
    """False where no sample of a cluster can score above -NEAR: sums of bounds, none is a guess.

    From a point within r of the middle, at a distance d from an image, the direction to the image
    differs from that at the middle by a vector of at most 2 r / (d + (d - r)); a normal in the cone,
    of half-angle w, by at most 2 sin(w / 2), and the projection along it by at most sin(w).
    """
    seen = _views(clusters.centre, clusters.normal, fore, aft)
    (far_a, turn_a), (far_b, turn_b) = (_bounds(clusters, near) for near in seen.near)
    tilt = 2.0 * torch.sin(0.5 * clusters.cone) + ROUNDING
    lit = (seen.height[0] + turn_a + tilt > 0) & (seen.height[1] + turn_b + tilt > 0)
    lean = torch.sin(clusters.cone.clamp(max=0.5 * torch.pi))
    both = (2.0 + 2.0 * seen.cosine).clamp(min=0.0).sqrt()
    least = seen.slope_squared().sqrt() - turn_a - turn_b - both * lean
    most = NEAR * ((1.0 / far_a + 1.0 / far_b) * clusters.reach + clusters.bend)
    return lit & (least <= most + ROUNDING)


ROUNDING = 1e-6  # of slopes, which are at most 2: the square root of cancelled digits


def _bounds(clusters: Clusters, near: Tensor) -> tuple[Tensor, Tensor]:
    """The least distance from a cluster's samples to images, and by how much directions differ."""
    distance = 1.0 / near
    nearest = (distance - clusters.radius).clamp(min=LEAST)
    turn = 2.0 * clusters.radius / (distance + nearest)
    return nearest, torch.where(distance <= clusters.radius, 2.0, turn)


def _best_of_patch(item: Samples, seen: Seen, pairs: int, patches: int) -> Int[Tensor, "k"]:
    """In each patch of each pair the best sample."""
    cell = seen.pair * patches + item.patch_column[seen.sample]
    best = seen.score.new_full((pairs * patches,), -torch.inf)
    best = best.scatter_reduce(0, cell, seen.score, "amax")
    return torch.nonzero(seen.score == best[cell]).squeeze(-1)


def _outdone(item: Samples, seen: Seen) -> Bool[Tensor, "m"]:
    """A candidate with a better one of the same pair beside it (a flat face spans several patches)."""
    order = torch.argsort(seen.pair, stable=True)
    pair, sample, value = seen.pair[order], seen.sample[order], seen.score[order]
    lost = torch.zeros(len(order), dtype=torch.bool, device=order.device)
    for shift in range(1, len(order)):
        i = torch.nonzero(pair[shift:] == pair[:-shift]).squeeze(-1)
        if not len(i):
            break
        here, there = sample[i], sample[i + shift]
        close = (item.point[there] - item.point[here]).norm(dim=-1) < BESIDE * item.radius
        alike = (item.normal[there] * item.normal[here]).sum(-1) > ALIKE
        i, better = i[close & alike], (value[i] < value[i + shift])[close & alike]
        lost[i[better]] = True
        lost[i[~better] + shift] = True
    out = torch.zeros_like(lost)
    out[order] = lost
    return out
