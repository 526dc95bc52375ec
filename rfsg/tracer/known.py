"""What of a path's surroundings is as it was: which boxes its segments cross, which edges stand free."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import FLUSH, World
from rfsg.tracer.columns import Columns, columns, dot, moved
from rfsg.tracer.edges import NEARBY, Edges, stands_free, upright
from rfsg.tracer.embree import brute_spans
from rfsg.tracer.implicit import segments
from rfsg.tracer.kept import Since
from rfsg.tracer.records import Rays

BLOCK = 1 << 19  # segments at a time


@torch.no_grad()
def crosses(
    vertices: Float[Tensor, "p v 3"], places: Sequence[tuple[World, Bool[Tensor, "_"]]]
) -> Bool[Tensor, "p"]:
    """Polylines with a segment in the bounding box of one of some worlds' nodes: what else a path goes
    through is no matter of those nodes."""
    hit = torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device)
    if not any(bool(nodes.any()) for _, nodes in places) or not len(hit):
        return hit
    length, u = segments(vertices)
    path, segment = torch.nonzero(length > 0, as_tuple=True)
    rays = Rays(vertices[path, segment], u[path, segment], length[path, segment])
    origin, direction = columns(rays.origin), columns(rays.direction)
    for world, nodes in places:
        for node in torch.nonzero(nodes).squeeze(-1):
            low, high = (x[0] for x in upright(world, node[None]))
            centre, radius = 0.5 * (low + high), 0.5 * float((high - low).norm())
            near = torch.nonzero(_beside(origin, direction, rays.limit, centre, radius))
            for i in near.squeeze(-1).split(BLOCK):
                spans = brute_spans(world, rays.take(i), node[None])
                hit[path[i[spans.ray]]] = True
    return hit


def _beside(
    origin: Columns, direction: Columns, limit: Tensor, centre: Float[Tensor, "3"], radius: float
) -> Bool[Tensor, "r"]:
    """Segments that come within ``radius`` of a point, a little more, or any where that is infinite:
    what others do not enter the box about it."""
    if not math.isfinite(radius):
        return torch.ones_like(limit, dtype=torch.bool)
    away = tuple(c - o for c, o in zip(centre.tolist(), origin, strict=True))
    along = torch.minimum(dot(away, direction).clamp(min=0.0), limit)
    nearest = moved(away, -along, direction)
    return dot(nearest, nearest) <= (ROUNDING * radius + FLUSH) ** 2


@dataclass(frozen=True)
class KnownEdges:
    """Of the long edges of the new scene: which are known, and which stand free. number: of the old
    scene's free edges, their numbers among the new free ones, -1 for those that are not known."""

    same: Bool[Tensor, "e"]
    standing: Bool[Tensor, "e"]
    number: Int[Tensor, "o"]


@torch.no_grad()
def known_edges(world: World, every: Edges, since: Since, wavelength: float) -> KnownEdges:
    """Compare edges, node by node, with those that were kept.

    An edge is known where its node stands as it did and nothing that changed comes near it.
    """
    kept, c = since.kept, since.changes
    old = kept.edges
    assert old is not None
    count = torch.bincount(every.node, minlength=len(world))
    begin = torch.cumsum(count, 0) - count
    before = torch.bincount(old.node, minlength=len(c.node))
    rank = torch.arange(len(old), device=count.device)
    rank = rank - (torch.cumsum(before, 0) - before)[old.node]
    node = c.node[old.node]
    place = torch.where(node >= 0, begin[node] + rank, -1)
    same = torch.zeros(len(every), dtype=torch.bool, device=count.device)
    same[place[place >= 0]] = True
    reach = NEARBY[0] * wavelength
    same &= ~_near(every, world, c.came, reach) & ~_near(every, kept.seen.world, c.gone, reach)
    standing = torch.zeros_like(same)
    there = torch.nonzero(place >= 0).squeeze(-1)
    standing[place[there]] = kept.standing[there]
    others = torch.nonzero(~same).squeeze(-1)
    if len(others):
        standing[others] = stands_free(world, every.take(others), wavelength)
    row = torch.where(same & standing, torch.cumsum(standing, 0) - 1, -1)
    place = place[kept.standing]
    return KnownEdges(same, standing, torch.where(place >= 0, row[place], -1))


def _near(edges: Edges, world: World, nodes: Bool[Tensor, "n"], reach: float) -> Bool[Tensor, "e"]:
    """Edges whose upright boxes, wider by ``reach``, meet those of any of the nodes."""
    near = torch.zeros(len(edges), dtype=torch.bool, device=edges.node.device)
    which = torch.nonzero(nodes).squeeze(-1)
    if not len(which) or not len(near):
        return near
    straight = edges.straight[:, None]
    around = torch.where(straight, 0.0, edges.radius[:, None])
    end = torch.where(straight, edges.start + edges.length[:, None] * edges.along, edges.centre)
    start = torch.where(straight, edges.start, edges.centre)
    low = torch.minimum(start, end) - around - reach * ROUNDING
    high = torch.maximum(start, end) + around + reach * ROUNDING
    node_low, node_high = upright(world, which)
    for k in range(len(which)):
        near |= ((low <= node_high[k]) & (high >= node_low[k])).all(1)
    return near


ROUNDING = 1.01  # wider by so much than what is looked at
