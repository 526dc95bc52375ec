"""Which objects may a ray meet, and between which distances: spans, found by Embree, proven exactly.

Embree proposes boxes in float32 (``boxes``); an exact float64 slab test in each object's own frame
decides. No span is lost: ``brute_spans`` is the plain twin that the tests hold against it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.scene.world import FLUSH, World
from rfsg.tracer.boxes import Layer, layers_of
from rfsg.tracer.columns import at, columns, dot, minus
from rfsg.tracer.records import Rays, Spans


class Proxies:
    """The oriented boxes of a world's bounded nodes in Embree; what did not move is not built again."""

    def __init__(self, world: World):
        self.world = world
        bounded = torch.isfinite(world.bounds_object).all(-1).all(-1)
        self.owner = torch.nonzero(bounded).squeeze(-1)
        self.layers = layers_of(self.corners(self.owner)) if len(self.owner) else []
        hubs = [layer.owner[layer.boxes.hubs] for layer in self.layers]
        hubs = torch.cat([self.owner[:0], *hubs])
        # what has no bounds, or touches too much, is proposed to every ray
        unbounded = torch.nonzero(~bounded).squeeze(-1)
        self.always = torch.cat([unbounded, self.owner[hubs[hubs >= 0]]])

    def corners(self, which: Int[Tensor, "k"]) -> Float[Tensor, "k 8 3"]:
        """Corners of nodes' bounding boxes in the world [m]."""
        world = self.world
        low, high = world.bounds_object[which, 0], world.bounds_object[which, 1]
        bit = torch.tensor(
            [[k >> 0 & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)],
            dtype=torch.bool,
            device=world.device,
        )
        corner = torch.where(bit, high[:, None], low[:, None])
        flat = world.point_world(which.repeat_interleave(8), corner.reshape(-1, 3))
        return flat.reshape(-1, 8, 3).detach()

    @torch.no_grad()
    def spans(self, rays: Rays) -> Spans:
        """Every stretch of every ray inside a node's bounding box, within [0, limit]."""
        ray, which = self._candidates(rays)
        return _exact(self.world, rays, ray, which)

    def _candidates(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """(ray, node) pairs that may meet, each once."""
        pairs = [_product(rays.origin.shape[0], self.always)]
        pairs += [self._met(layer, rays) for layer in self.layers]
        return _distinct(pairs, rays.origin.shape[0], len(self.world))

    def _met(self, layer: Layer, rays: Rays) -> tuple[Tensor, Tensor]:
        """(ray, node) pairs of one layer: the boxes met, and all that touch them, moved ones left out."""
        boxes, owner = layer.boxes, layer.owner
        active = torch.arange(rays.origin.shape[0], device=rays.origin.device)
        done = torch.zeros_like(rays.limit)
        none = active[:0]
        pairs = [(none, none)]
        while len(active):
            start = rays.origin[active] + done[active, None] * rays.direction[active]
            hit, distance = boxes.first(start, rays.direction[active])
            found = hit >= 0
            active, hit, distance = active[found], hit[found], distance[found]
            pairs.append(boxes.neighbours.of(active, hit))
            reached = done[active] + distance
            # a grazing float32 hit may miss the exact box, and where one has moved away nothing is
            # known of it: then step past the hit alone
            there = torch.nonzero(owner[hit] >= 0).squeeze(-1)
            _, leave = _slab(self.world, rays, active[there], self.owner[owner[hit[there]]])
            reached[there] = torch.maximum(reached[there], leave.clamp(max=1e300))
            done[active] = reached + 0.5 * boxes.gap
            active = active[done[active] < rays.limit[active]]
        ray, box = (torch.cat(column) for column in zip(*pairs, strict=True))
        standing = owner[box] >= 0
        return ray[standing], self.owner[owner[box[standing]]]


def _distinct(pairs: list[tuple[Tensor, Tensor]], n: int, k: int) -> tuple[Tensor, Tensor]:
    """Pairs without repeats, in order of ray: by a table of flags, or by sorting if it were large."""
    ray, which = (torch.cat(column) for column in zip(*pairs, strict=True))
    if n * k <= FLAGS_A_PAIR * len(ray):
        seen = torch.zeros(n, k, dtype=torch.bool, device=ray.device)
        seen[ray, which] = True
        found, node = torch.nonzero(seen, as_tuple=True)
        return found, node
    code = torch.unique(ray * k + which)
    return code // k, code % k


FLAGS_A_PAIR = 64  # a table of more is slower than sorting the pairs


@torch.no_grad()
def brute_spans(world: World, rays: Rays, nodes: Int[Tensor, "k"] | None = None) -> Spans:
    """The plain twin: every ray against every node's box, or against those of ``nodes``."""
    nodes = torch.arange(len(world), device=world.device) if nodes is None else nodes
    ray, which = _product(rays.origin.shape[0], nodes)
    return _exact(world, rays, ray, which)


def _product(n: int, nodes: Tensor) -> tuple[Tensor, Tensor]:
    ray = torch.arange(n, device=nodes.device).repeat_interleave(len(nodes))
    return ray, nodes.repeat(n)


def _slab(world: World, rays: Rays, ray: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
    """Exact (enter, leave) of lines through nodes' boxes, in the object's frame, in metres.

    The boxes are a hair wider than their objects: a ray in a face, or in the rounding between two
    flush ones, has its span (see ``seams``).
    """
    away = minus(at(columns(rays.origin), ray), at(columns(world.translation), which))
    direction = at(columns(rays.direction), ray)
    scale, skin = world.scale[which], 0.5 * FLUSH / world.scale
    near, far = torch.full_like(scale, -torch.inf), torch.full_like(scale, torch.inf)
    for axis in range(3):
        turn = at(columns(world.rotation[:, :, axis]), which)
        o, d = dot(turn, away) / scale, dot(turn, direction)
        low = (world.bounds_object[:, 0, axis] - skin)[which]
        high = (world.bounds_object[:, 1, axis] + skin)[which]
        parallel = d == 0
        safe = torch.where(parallel, 1.0, d)
        a, b = (low - o) / safe, (high - o) / safe
        always = torch.where((o >= low) & (o <= high), torch.inf, -torch.inf)
        near = torch.maximum(near, torch.where(parallel, -always, torch.minimum(a, b)))
        far = torch.minimum(far, torch.where(parallel, always, torch.maximum(a, b)))
    return near * scale, far * scale


def _exact(world: World, rays: Rays, ray: Tensor, which: Tensor) -> Spans:
    enter, leave = _slab(world, rays, ray, which)
    enter = torch.clamp(enter, min=0.0)
    leave = torch.minimum(leave, rays.limit[ray])
    keep = enter <= leave
    ray, which, enter, leave = ray[keep], which[keep], enter[keep], leave[keep]
    order = sort_by(ray, enter)
    return Spans(ray[order], which[order], enter[order], leave[order])


def sort_by(ray: Int[Tensor, "m"], enter: Float[Tensor, "m"]) -> Int[Tensor, "m"]:
    """Order of (ray, enter), stable."""
    by_enter = torch.argsort(enter, stable=True)
    return by_enter[torch.argsort(ray[by_enter], stable=True)]
