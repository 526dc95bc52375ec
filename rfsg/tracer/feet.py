"""The feet of a zone's samples: where each meets its face.

Samples stand on a zone's tangent plane and drop along its normal to the face. Where a zone moves a
little, so do they, and the planes that touch the face at their feet say where to, to second order in
the move: there the next drop begins, and mostly ends after one question to the network.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.scene.world import World, unit

DROPS = 3  # most Newton steps of a sample
STEEP = 0.2  # least |cosine| of a slope that a step divides by
# of the zone's radius: the next step of a sample so near is about this squared, below what the
# precision resolves
THERE = {torch.float32: 2e-4, torch.float64: 1e-9}
# of the zone's radius: a foot as good as this is begun from; the others drop from the plane every
# time, for where three steps leave them depends on where they begin
FIRM = {torch.float32: 2e-4, torch.float64: 1e-9}


@dataclass(frozen=True)
class Drop:
    """Of samples: height of the face over the plane [m], its gradient there, and |f| before the last
    of Newton's steps [m]: what finds no face stays large."""

    height: Float[Tensor, "m q"]
    gradient: Float[Tensor, "m q 3"]
    missed: Float[Tensor, "m q"]

    def aligned(self, normal: Float[Tensor, "m 3"]) -> Float[Tensor, "m q"]:
        """Cosine of the face's normal and the zone's."""
        return (unit(self.gradient) * normal[:, None]).sum(-1)


@dataclass
class Feet:
    """Feet of the samples of m vertices, by zone size; ``place``: a vertex's row there, -1 without."""

    # one entry for each zone size: [m], [k q 3], [k q 3], [k q]; k differs from size to size
    place: list[Tensor] = field(default_factory=list)
    point: list[Tensor] = field(default_factory=list)
    gradient: list[Tensor] = field(default_factory=list)
    missed: list[Tensor] = field(default_factory=list)

    def take(self, i: Tensor) -> "Feet":
        return Feet([p[i] for p in self.place], self.point, self.gradient, self.missed)

    def keep(self, vertices: int, rows: Tensor, base: Tensor, normal: Tensor, drop: Drop) -> None:
        """Remember the next smaller zone, of some of the vertices."""
        place = torch.full((vertices,), -1, dtype=torch.int64, device=rows.device)
        place[rows] = torch.arange(len(rows), device=rows.device)
        self.place.append(place)
        self.point.append(base + drop.height[..., None] * normal[:, None])
        self.gradient.append(drop.gradient)
        self.missed.append(drop.missed)

    def heights(
        self,
        level: int,
        rows: Int[Tensor, "m"],
        base: Float[Tensor, "m q 3"],
        normal: Float[Tensor, "m 3"],
        most: Float[Tensor, "m"],
    ) -> Float[Tensor, "m q"]:
        """Where the planes at the feet lie over samples moved since; 0 where a foot is not known, or
        missed by more than ``most``."""
        none = torch.zeros_like(base[..., 0])
        if level >= len(self.place) or not len(self.point[level]):
            return none
        place = self.place[level][rows]
        k = place.clamp(min=0)
        gradient = self.gradient[level][k]
        along = (gradient * normal[:, None]).sum(-1)
        firm = (place >= 0)[:, None] & (self.missed[level][k] <= most[:, None])
        firm = firm & (along.abs() > STEEP)
        down = ((self.point[level][k] - base) * gradient).sum(-1)
        return torch.where(firm, down / torch.where(firm, along, 1.0), none)


@dataclass(frozen=True)
class Asked:
    """Drops by the network, evaluated in ``dtype``, and their feet; ``before``: those of the last time."""

    world: World
    which: Int[Tensor, "m"]
    dtype: torch.dtype
    before: Feet | None = None
    feet: Feet = field(default_factory=Feet)

    def drop(
        self, level: int, rows: Tensor, base: Tensor, normal: Tensor, reach: Float[Tensor, "m"]
    ) -> Drop:
        m, q = base.shape[:2]
        start = torch.zeros_like(base[..., 0])
        if self.before is not None:
            most = FIRM[self.dtype] * reach
            start = self.before.heights(level, rows, base, normal, most)
            start = start.clamp(-reach[:, None], reach[:, None])
        found = dropped(
            self.world,
            self.which[rows].repeat_interleave(q),
            base.reshape(-1, 3),
            normal.repeat_interleave(q, 0),
            reach.repeat_interleave(q),
            start.reshape(-1),
            self.dtype,
        )
        drop = Drop(*(x.reshape(m, q, *x.shape[1:]) for x in found))
        self.feet.keep(len(self.which), rows, base, normal, drop)
        return drop


def dropped(
    world: World,
    which: Int[Tensor, "m"],
    base: Float[Tensor, "m 3"],
    normal: Float[Tensor, "m 3"],
    reach: Float[Tensor, "m"],
    height: Float[Tensor, "m"],
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor, Tensor]:
    """(height, gradient, missed) after at most three of Newton's steps; what is there already is not
    asked again, and counts as having missed by what the next step would have been asked at."""
    gradients, missed = torch.zeros_like(base), torch.zeros_like(height)
    going = torch.arange(len(base), device=base.device)
    for _ in range(DROPS):
        at, up, most = height[going], normal[going], reach[going]
        point = base[going] + at[:, None] * up
        value, gradient = world.value_and_gradient(which[going], point, dtype)
        along = (gradient * up).sum(-1)
        at = at - value / torch.where(along.abs() > STEEP, along, torch.ones_like(along))
        height = height.index_copy(0, going, torch.maximum(torch.minimum(at, most), -most))
        gradients = gradients.index_copy(0, going, gradient)
        off = value.abs()
        there = off <= THERE[dtype] * most
        missed = missed.index_copy(0, going, torch.where(there, off * off / most, off))
        going = going[~there]
    return height, gradients, missed
