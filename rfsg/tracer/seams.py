"""Faces that touch or coincide: where two objects would both count, or neither, one does.

A mirror of flush pieces reflects once where their seam lies, and one drawn twice as well.

A line in a face is outside its object: an antenna on a ceiling sees along it. But where two walls
stand flush, their seam is the inside of what they make together, and a ray along it would slip through
a wall without touching either. Coordinates are round, so such rays are common. Told apart by two rays
a hair to either side: where both are inside something, so is the ray between them.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import FLUSH, World, unit
from rfsg.tracer.records import Chains, Rays, Spans

# no face of a drawing holds this direction
ASIDE = (1.0, 0.7548776662466927, 0.5698402909980532)


def along_seams(world: World, rays: Rays, spans: Spans) -> tuple[Spans, Float[Tensor, "m 2 3"]]:
    """Stretches along seams, and how far aside of either end the surface of the node is.

    spans: of flat-faced nodes that the rays themselves are not inside.

    Of two flush objects one counts: where the ray is inside for the shorter stretch, or the first
    by name.
    """
    aside = FLUSH * unit(rays.origin.new_tensor(ASIDE))
    a, b = (_shifted(world, rays, spans, sign * aside) for sign in (1.0, -1.0))
    i, j = _pairs(a.ray, b.ray)
    met = torch.minimum(a.leave[i], b.leave[j]) - torch.maximum(a.enter[i], b.enter[j]) > FLUSH
    i, j = i[met], j[met]
    name = _order(world)
    longer = (a.leave - a.enter)[i] - (b.leave - b.enter)[j]
    first = torch.where(longer.abs() <= FLUSH, name[a.which[i]] < name[b.which[j]], longer < 0)
    both = torch.unique(torch.cat([i[first], len(a.ray) + j[~first]]))
    names = Spans.__dataclass_fields__
    seams = Spans(*(torch.cat([getattr(a, n), getattr(b, n)])[both] for n in names))
    aside = torch.where(both < len(a.ray), 1.0, -1.0)[:, None].to(aside) * aside
    straight = _straightened(world, rays, seams, aside)
    direction = rays.direction[seams.ray]
    slips = (seams.enter - straight.enter, seams.leave - straight.leave)
    return straight, torch.stack([aside + slip[:, None] * direction for slip in slips], 1)


def _straightened(world: World, rays: Rays, seams: Spans, aside: Float[Tensor, "m 3"]) -> Spans:
    """The same stretches on the rays themselves: from where they lie at one hair and at two."""
    origin, direction = rays.origin[seams.ray], rays.direction[seams.ray]
    enter, leave = world.interval(seams.which, origin + 2.0 * aside, direction)
    enter, leave = enter.clamp(min=0.0), torch.minimum(leave, rays.limit[seams.ray])
    hit = leave > enter
    enter = torch.where(hit, 2.0 * seams.enter - enter, seams.enter)
    leave = torch.where(hit, 2.0 * seams.leave - leave, seams.leave)
    return Spans(seams.ray, seams.which, enter, leave)


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


@torch.no_grad()
def coincident(
    world: World,
    chains: Chains,
    vertices: Float[Tensor, "c k 3"],
    normal: Float[Tensor, "c d 3"],
    good: Bool[Tensor, "c"],
) -> Bool[Tensor, "c"]:
    """Reflections at the same points of faces that look the same way, on other objects: of the good
    paths all but the one whose objects stand first by name."""
    i = torch.nonzero(good).squeeze(-1)
    place = torch.round(vertices[i].flatten(1) / SAME).to(torch.int64)
    turn = torch.round(normal[i].flatten(1) / TURNED).to(torch.int64)
    key = torch.cat([chains.tx[i, None], chains.rx[i, None], place, turn], 1)
    # one number for a row: integers wrap around, and two rows share one by a chance of 1 in 1e19. A
    # power for each column: multiples of one number would leave small sums of them that meet often
    odd = torch.cumprod(torch.full((key.shape[1],), 0x1E3779B97F4A7C15, device=i.device), 0)
    _, group, count = torch.unique((key * odd).sum(1), return_inverse=True, return_counts=True)
    several = count[group] > 1
    i, group = i[several], group[several]
    out = torch.zeros_like(good)
    if len(i):
        name = torch.cat([_order(world), torch.full_like(i[:1], -1)])  # the last is the padding's
        order = torch.arange(len(i), device=i.device)
        for column in (*name[chains.which[i]].unbind(1)[::-1], group):
            order = order[torch.argsort(column[order], stable=True)]
        first = torch.ones_like(several[: len(i)])
        first[1:] = group[order][1:] != group[order][:-1]
        out[i[order[~first]]] = True
    return out


SAME = 1e-7  # [m] vertices nearer than this
TURNED = 1e-3  # [rad] and normals


def _order(world: World) -> Int[Tensor, "n"]:
    """The place of each node's name among all: what it is does not depend on the scene's order."""
    names = [n.path for n in world.scene.nodes]
    sorted_by_name = sorted(range(len(names)), key=lambda i: names[i])
    place = torch.zeros(len(names), dtype=torch.int64, device=world.device)
    place[torch.tensor(sorted_by_name, dtype=torch.int64, device=world.device)] = torch.arange(
        len(names), device=world.device
    )
    return place
