"""All crossings of rays with a learned shape, baked or not, for the march."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.recent import Recent
from rfsg.objects.shapes.band import WAYS, Baked
from rfsg.tracer.banded import bracketed, polished
from rfsg.tracer.intersect import BEHIND, Intersector

MOST_BUILT = 16


@dataclass(frozen=True)
class Roots:
    """Roots of f on rays: t [m] of row ``row``, its ``slot``-th; ``count`` of each ray, and whether it
    begins ``inside``."""

    row: Int[Tensor, "k"]
    slot: Int[Tensor, "k"]
    t: Float[Tensor, "k"]
    count: Int[Tensor, "m"]
    inside: Bool[Tensor, "m"]


@torch.no_grad()
def roots_on(
    shape: Shape,
    baked: Baked | None,
    start: Float[Tensor, "m 3"],
    direction: Float[Tensor, "m 3"],
    end: Float[Tensor, "m"],
    way: str,
    floor: float,
    most: int,
    rounds: int,
) -> Roots:
    """The first ``most`` roots on each ray within [0, end] and the bounds, in the rays' precision.

    certain: marched on the baked values and by the network next to the surface, or where nothing is
    baked by the network alone, whatever the way; roots by ``rounds`` rounds of the Illinois method.
    The other ways as in ``intersect``. Raises ValueError for no known way.
    """
    if way not in WAYS:
        raise ValueError(f"intersection {way!r}: expected one of {', '.join(WAYS)}")
    if baked is not None and way in ("mesh", "newton"):
        return _peeled(intersector(shape, baked), start, direction, end, way == "newton", most)
    certain = baked is None or way == "certain"
    used = baked
    if baked is not None and not certain:
        used = replace(baked, error=torch.zeros_like(baked.error))
    found = bracketed(shape, used, start, direction, end, floor, most)
    row = found.row
    if certain:
        tolerance = 256 * torch.finfo(start.dtype).eps  # a network's own rounding
        t = polished(shape, start[row], direction[row], found, rounds, tolerance)
    else:
        t = torch.lerp(found.a, found.b, found.fa / (found.fa - found.fb)).to(start.dtype)
    return Roots(row, found.slot, t, found.count, found.inside)


def _peeled(
    traced: Intersector, start: Tensor, direction: Tensor, end: Tensor, step: bool, most: int
) -> Roots:
    """Hits of the zero mesh one after the other, each search beginning behind the last."""
    o, d, last = start.float(), direction.float(), end.float()
    count = torch.zeros(len(end), dtype=torch.int64)
    inside = torch.zeros(len(end), dtype=torch.bool)
    done, active = torch.zeros_like(last), torch.arange(len(end))
    parts = [(active[:0], count[:0], start.new_zeros(0))]
    for k in range(most):
        begin = torch.addcmul(o[active], done[active, None], d[active])
        met = traced.zero.met(begin, d[active])
        if k == 0:
            inside = (met.triangle >= 0) & met.behind
        i = torch.nonzero((met.triangle >= 0) & (done[active] + met.t <= last[active])).squeeze(-1)
        if not len(i):
            break
        row = active[i]
        t = met.t[i]
        done[row], count[row] = done[row] + t + BEHIND, count[row] + 1
        if step:
            t = traced.stepped(begin[i], d[row], t, traced.gradient(met, i))
        t = (done[row] - BEHIND - met.t[i] + t).clamp(min=0.0)
        parts.append((row, torch.full_like(row, k), torch.minimum(t, last[row]).to(start.dtype)))
        active = row
    row, slot, t = (torch.cat(column) for column in zip(*parts, strict=True))
    return Roots(row, slot, t, count, inside)


_BUILT: Recent[Intersector] = Recent(MOST_BUILT)


def intersector(shape: Shape, baked: Baked) -> Intersector:
    """The shape's ``Intersector``, kept by key: building Embree's trees takes a second."""
    return _BUILT.get(baked.key, shape, lambda: Intersector(shape, baked))
