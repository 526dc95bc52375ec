"""The only door to Embree: which objects may a ray meet, and between which distances.

Embree returns the first hit only, in float32, so it *proposes*: the node it hit, and every node whose
proxy touches that one, become candidates; an exact float64 slab test in the object's own frame
decides; then the search goes on from where the hit proxy is left. Two proxies that do not touch are
more than ``gap`` apart, so nothing can begin between the exit of one and the restart behind it: no
span is lost (``brute_spans`` is the plain twin that the tests hold against it).
"""

import numpy as np
import torch
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import FLUSH, World
from rfsg.tracer.records import Rays, Spans

# The twelve triangles of a box whose corner k has bits (x, y, z) of k.
_TRIANGLES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 7, 3], [1, 5, 7],
    ]
)  # fmt: skip


class Proxies:
    """The oriented boxes of a world's bounded nodes in one Embree scene; rebuilt when a node moves."""

    def __init__(self, world: World):
        self.world = world
        bounds = world.bounds_object
        self.bounded = torch.isfinite(bounds).all(-1).all(-1)
        corners = self.corners(torch.nonzero(self.bounded).squeeze(-1))
        self.owner = torch.nonzero(self.bounded).squeeze(-1)
        self.unbounded = torch.nonzero(~self.bounded).squeeze(-1)
        # float32 Embree runs about the middle of the scene, so far-off origins cost no precision
        self.middle = (
            0.5 * (corners.amin((0, 1)) + corners.amax((0, 1)))
            if len(corners)
            else torch.zeros(3, dtype=torch.float64, device=world.device)
        )
        local = corners - self.middle
        extent = float(local.abs().max()) if len(local) else 1.0
        # Embree sees float32: a millimetre, or 64 float32 steps of the scene's extent if that is more
        self.gap = max(1e-3, 64.0 * 2.0**-23 * extent)
        self.touching = _touching(local, self.gap)
        self.scene = None
        if len(local):
            self.scene = rtcore_scene.EmbreeScene()
            triangles = local.cpu().numpy()[:, _TRIANGLES].reshape(-1, 3, 3)
            TriangleMesh(self.scene, np.ascontiguousarray(triangles, dtype=np.float32))

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
        """(ray, node) pairs that Embree proposes, each once."""
        pairs = [_product(rays.origin.shape[0], self.unbounded)]
        if self.scene is not None:
            active = torch.arange(rays.origin.shape[0], device=rays.origin.device)
            done = torch.zeros_like(rays.limit)
            while len(active):
                start = rays.origin[active] + done[active, None] * rays.direction[active]
                hit, distance = self._first(start, rays.direction[active])
                found = hit >= 0
                active, hit, distance = active[found], hit[found], distance[found]
                if not len(active):
                    break
                pairs.append(self._with_neighbours(active, self.owner[hit]))
                _, leave = _slab(self.world, rays, active, self.owner[hit])
                # a grazing float32 hit may miss the exact box: then step past the hit alone
                reached = torch.maximum(done[active] + distance, torch.clamp(leave, max=1e300))
                done[active] = reached + 0.5 * self.gap
                active = active[done[active] < rays.limit[active]]
        return _distinct(pairs, rays.origin.shape[0], len(self.world))

    def _with_neighbours(self, ray: Tensor, node: Tensor) -> tuple[Tensor, Tensor]:
        inverse = torch.full((len(self.world),), -1, dtype=torch.int64, device=node.device)
        inverse[self.owner] = torch.arange(len(self.owner), device=node.device)
        row, col = torch.nonzero(self.touching[inverse[node]], as_tuple=True)
        return ray[row], self.owner[col]

    def _first(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        local = (origin - self.middle).cpu().numpy().astype(np.float32)
        assert self.scene is not None
        out = self.scene.run(
            np.ascontiguousarray(local),
            np.ascontiguousarray(direction.cpu().numpy().astype(np.float32)),
            query="INTERSECT",
            output=True,
        )
        triangle = torch.from_numpy(out["primID"].astype(np.int64)).to(origin.device)
        distance = torch.from_numpy(out["tfar"].astype(np.float64)).to(origin.device)
        missed = torch.from_numpy(out["geomID"].astype(np.int64)).to(origin.device) < 0
        return torch.where(missed | (triangle < 0), -1, triangle // len(_TRIANGLES)), distance


def _distinct(pairs: list[tuple[Tensor, Tensor]], n: int, k: int) -> tuple[Tensor, Tensor]:
    """Pairs without repeats, in order of ray: by a table of flags, or by sorting if it were large."""
    ray, which = (torch.cat(column) for column in zip(*pairs, strict=True))
    if n * k <= MOST_FLAGS:
        seen = torch.zeros(n, k, dtype=torch.bool, device=ray.device)
        seen[ray, which] = True
        found, node = torch.nonzero(seen, as_tuple=True)
        return found, node
    code = torch.unique(ray * k + which)
    return code // k, code % k


MOST_FLAGS = 1 << 28  # bytes of such a table


@torch.no_grad()
def brute_spans(world: World, rays: Rays) -> Spans:
    """The plain twin: every ray against every node's box."""
    everything = torch.arange(len(world), device=world.device)
    ray, which = _product(rays.origin.shape[0], everything)
    return _exact(world, rays, ray, which)


def _product(n: int, nodes: Tensor) -> tuple[Tensor, Tensor]:
    ray = torch.arange(n, device=nodes.device).repeat_interleave(len(nodes))
    return ray, nodes.repeat(n)


def _slab(world: World, rays: Rays, ray: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
    """Exact (enter, leave) of lines through nodes' boxes, in the object's frame, in metres.

    The boxes are a hair wider than their objects: a ray in a face, or in the rounding between two
    flush ones, has its span (see ``seams``).
    """
    o = world.point_object(which, rays.origin[ray])
    d = world.direction_object(which, rays.direction[ray])
    skin = (0.5 * FLUSH / world.scale[which])[:, None]
    low, high = world.bounds_object[which, 0] - skin, world.bounds_object[which, 1] + skin
    parallel = d == 0
    safe = torch.where(parallel, torch.ones_like(d), d)
    a, b = (low - o) / safe, (high - o) / safe
    within = (o >= low) & (o <= high)
    inf = torch.full_like(a, torch.inf)
    near = torch.where(parallel, torch.where(within, -inf, inf), torch.minimum(a, b))
    far = torch.where(parallel, torch.where(within, inf, -inf), torch.maximum(a, b))
    scale = world.scale[which]
    return near.amax(-1) * scale, far.amin(-1) * scale


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


def _touching(corners: Float[Tensor, "k 8 3"], gap: float) -> Bool[Tensor, "k k"]:
    """Pairs of boxes whose axis-aligned hulls come within ``gap`` (a superset of those that do)."""
    low, high = corners.amin(1) - gap, corners.amax(1) + gap
    return ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(-1)
