"""Rays that run in the very faces of objects: between two that touch, they are inside.

A line in a face is outside its object: an antenna on a ceiling sees along it. But where two walls
stand flush, their seam is the inside of what they make together, and a ray along it would slip through
a wall without touching either. Coordinates are round, so such rays are common. Told apart by two rays
a hair to either side: where both are inside something, so is the ray between them.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.scene.world import FLUSH, World, unit
from rfsg.tracer.records import Rays, Spans

# no face of a drawing holds this direction
ASIDE = (1.0, 0.7548776662466927, 0.5698402909980532)


def along_seams(world: World, rays: Rays, spans: Spans) -> tuple[Spans, Float[Tensor, "m 3"]]:
    """Stretches along seams, and the hair's breadth aside at which the ray is inside the node.

    spans: of flat-faced nodes that the rays themselves are not inside.

    Of two flush objects one counts: where the ray is inside for the shorter stretch, or the first
    by name.
    """
    aside = FLUSH * unit(rays.origin.new_tensor(ASIDE))
    a, b = (_shifted(world, rays, spans, sign * aside) for sign in (1.0, -1.0))
    i, j = _pairs(a.ray, b.ray)
    met = torch.minimum(a.leave[i], b.leave[j]) - torch.maximum(a.enter[i], b.enter[j]) > FLUSH
    i, j = i[met], j[met]
    name = torch.tensor(_order([n.path for n in world.scene.nodes]), device=i.device)
    longer = (a.leave - a.enter)[i] - (b.leave - b.enter)[j]
    first = torch.where(longer.abs() <= FLUSH, name[a.which[i]] < name[b.which[j]], longer < 0)
    both = torch.unique(torch.cat([i[first], len(a.ray) + j[~first]]))
    names = Spans.__dataclass_fields__
    seams = Spans(*(torch.cat([getattr(a, n), getattr(b, n)])[both] for n in names))
    side = torch.where(both < len(a.ray), 1.0, -1.0)[:, None].to(aside)
    return seams, side * aside


def _shifted(world: World, rays: Rays, spans: Spans, aside: Float[Tensor, "3"]) -> Spans:
    """The stretches of rays moved aside, sorted by ray as the spans are."""
    ray, which = spans.ray, spans.which
    enter, leave = world.interval(which, rays.origin[ray] + aside, rays.direction[ray])
    enter, leave = enter.clamp(min=0.0), torch.minimum(leave, rays.limit[ray])
    hit = leave - enter > FLUSH
    return Spans(ray[hit], which[hit], enter[hit], leave[hit])


def _pairs(a: Int[Tensor, "n"], b: Int[Tensor, "m"]) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Every (row of a, row of b) with equal keys; b is sorted."""
    first, last = torch.searchsorted(b, a), torch.searchsorted(b, a, right=True)
    count = last - first
    i = torch.arange(len(a), device=a.device).repeat_interleave(count)
    rank = torch.arange(len(i), device=a.device) - (torch.cumsum(count, 0) - count)[i]
    return i, first[i] + rank


def _order(names: list[str]) -> list[int]:
    """The place of each name among all of them in order: what it is does not depend on the list's."""
    place = [0] * len(names)
    for k, i in enumerate(sorted(range(len(names)), key=lambda i: names[i])):
        place[i] = k
    return place
