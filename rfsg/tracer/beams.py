"""Which points of a map may a sequence of planar mirrors light?

A sequence turns the transmitter into one image, and whatever that image lights has passed the
rectangles of its mirrors, each seen unfolded to where the later mirrors put it. Through a rectangle
means on the inner side of four planes through the image. So what a sequence lights of a straight row
of points is an interval, found from a few inequalities: points that hear nothing cost nothing, and no
ray is shot at them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.tracer.faces import Planes
from rfsg.tracer.prefixes import Prefixes

WIDER = 1e-6  # [m] intervals hold this much more than is lit: the vertices decide
INEQUALITIES = 4_000_000  # at a time


@dataclass(frozen=True)
class Rows:
    """Points in straight rows of ``count``: origin + k step, one row after the other [m]."""

    origin: Float[Tensor, "r 3"]
    step: Float[Tensor, "3"]
    count: int

    def to(self, device: torch.device) -> "Rows":
        return Rows(self.origin.to(device), self.step.to(device), self.count)


@dataclass(frozen=True)
class Lit:
    """Which sequence may light which point: flat."""

    sequence: Int[Tensor, "m"]
    point: Int[Tensor, "m"]


def lit_by(planes: Planes, sequences: Prefixes, rows: Rows, most: int) -> Iterator[Lit]:
    """Pairs of a sequence and a point that it may light, about ``most`` at a time.

    A superset, by ``WIDER``: every window and the front of the last mirror is an inequality
    A + k B >= 0 in the number k of a point in its row.
    """
    normal, image = _half_spaces(planes, sequences), sequences.image
    p, h, r = len(image), normal.shape[1], len(rows.origin)
    offset = torch.einsum("phi,pi->ph", normal[..., :3], image) + normal[..., 3]
    for some in torch.arange(p, device=image.device).split(max(1, INEQUALITIES // max(1, h * r))):
        at_first = normal[some, :, :3] @ rows.origin.T - offset[some, :, None] + WIDER  # [p h r]
        slope = (normal[some, :, :3] @ rows.step)[..., None].expand_as(at_first)
        level = slope == 0
        bound = -at_first / torch.where(level, 1.0, slope)
        first = torch.where(slope > 0, bound, torch.where(level & (at_first < 0), torch.inf, 0.0))
        last = torch.where(slope < 0, bound, torch.inf)
        low = torch.ceil(first.amax(1).clamp(min=0.0)) if h else at_first.new_zeros(len(some), r)
        high = torch.floor(last.amin(1)) if h else torch.full_like(low, torch.inf)
        count = (high.clamp(max=rows.count - 1.0) - low + 1.0).clamp(min=0.0)
        which, row = torch.nonzero(count, as_tuple=True)
        start = row * rows.count + low[which, row].long()
        yield from _listed(some[which], start, count[which, row].long(), most)


def _listed(sequence: Tensor, start: Tensor, count: Tensor, most: int) -> Iterator[Lit]:
    """Intervals as their points."""
    portion = torch.div(torch.cumsum(count, 0), most, rounding_mode="floor")
    for i in torch.split(
        torch.arange(len(count), device=count.device),
        torch.unique_consecutive(portion, return_counts=True)[1].tolist(),
    ):
        n = count[i]
        rank = torch.arange(int(n.sum()), device=n.device)
        rank -= (torch.cumsum(n, 0) - n).repeat_interleave(n)
        yield Lit(sequence[i].repeat_interleave(n), start[i].repeat_interleave(n) + rank)


def _half_spaces(planes: Planes, sequences: Prefixes) -> Float[Tensor, "p h 4"]:
    """(n, d) with n . (x - image) >= d where the sequence may light x: four planes through the image
    and the sides of every mirror, unfolded, and the last mirror's own plane."""
    p, depth = sequences.faces.shape
    image, parts = sequences.image, [sequences.image.new_zeros(p, 0, 4)]
    for level in range(depth):
        corner = planes.corners()[sequences.faces[:, level]]
        for later in range(level + 1, depth):
            face = sequences.faces[:, later, None]
            height = (corner * planes.normal[face]).sum(-1) - planes.offset[face]
            corner = corner - 2.0 * height[..., None] * planes.normal[face]
        spoke = corner - image[:, None]
        side = torch.linalg.cross(spoke, spoke.roll(-1, 1))
        side = side / side.norm(dim=-1, keepdim=True).clamp(min=1e-300)
        # unfolding turns a rectangle about: inside is where its middle is
        side = side * torch.sign((side * spoke.mean(1, keepdim=True)).sum(-1, keepdim=True))
        parts.append(torch.cat([side, torch.zeros_like(side[..., :1])], -1))
    if depth:
        last = sequences.faces[:, -1]
        beyond = planes.offset[last] - (planes.normal[last] * image).sum(-1)
        parts.append(torch.cat([planes.normal[last], beyond[:, None]], -1)[:, None])
    return torch.cat(parts, 1)
