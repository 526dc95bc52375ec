"""Which segments can go through nothing? A proof by separating planes, for many segments at once.

An object lies behind each face of its own box. A segment whose ends both stand before one of those
faces does not go through it: in an empty room that holds for every segment and every wall, in a
street for the ground, and nothing of them needs to be traced. Segments that run along a face, where
flush objects make a seam of it (``seams``), are left to the tracing.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import FLUSH, World
from rfsg.tracer.march import TOUCH
from rfsg.tracer.records import Rays

DRAWN = 512  # segments that say which faces to try; any would do, the proof is made of all
FEW = 64  # nodes that are worth a proof: beyond, tracing a segment is cheaper than comparing it
LEFT = 8  # nodes without a proof at most, for the others' to save anything


@torch.no_grad()
def traced(world: World, rays: Rays) -> tuple[Int[Tensor, "m"], Bool[Tensor, "n"]]:
    """Segments that may go through something, and the nodes that any of them may go through."""
    everything = torch.arange(len(rays.limit), device=world.device)
    nodes = torch.ones(len(world), dtype=torch.bool, device=world.device)
    if not len(world):
        return everything[:0], nodes
    if not len(everything) or len(world) > FEW or not bool(torch.isfinite(rays.limit).all()):
        return everything, nodes
    normal, offset = _walls(world)
    ends = torch.stack([rays.origin, rays.origin + rays.limit[:, None] * rays.direction])
    step = max(1, len(everything) // DRAWN)
    height = ends[:, ::step].reshape(-1, 3) @ normal.flatten(0, 1).T - offset.flatten()
    lowest = height.amin(0).reshape(len(world), 6)
    height, face = lowest.max(1)
    worthwhile = torch.nonzero(height > -TOUCH).squeeze(-1)
    suspect = torch.zeros(len(everything), dtype=torch.bool, device=world.device)
    unproven = len(world) - len(worthwhile)
    if unproven > LEFT:
        return everything, nodes
    suspect |= unproven > 0
    for node in worthwhile.tolist():
        n, d = normal[node, face[node]], offset[node, face[node]]
        near, far = ends @ n - d
        may = ~_before(near, far, rays.limit)
        nodes[node] = bool(may.any())
        suspect |= may
    return torch.nonzero(suspect).squeeze(-1), nodes


def _before(near: Tensor, far: Tensor, length: Tensor) -> Bool[Tensor, "m"]:
    """Whether segments with ends at such heights over a plane [m] do not go below it.

    What is no longer than a touch at an end goes through nothing (``march.crossings``); what is as
    flat as a seam may.
    """
    low, high = torch.minimum(near, far), torch.maximum(near, far)
    return (high > FLUSH) & (-low * length <= TOUCH * (high - low))


def _walls(world: World) -> tuple[Float[Tensor, "n 6 3"], Float[Tensor, "n 6"]]:
    """The six planes of each node's box, outward, in the world; of no use where it has no end."""
    bounds, rotation = world.bounds_object.detach(), world.rotation.detach()
    normal = torch.stack([-rotation.mT, rotation.mT], 2).flatten(1, 2)  # -x, +x, -y, ...
    reach = torch.stack([-bounds[:, 0], bounds[:, 1]], -1).flatten(1)
    place = torch.einsum("nkj,nj->nk", normal, world.translation.detach())
    return normal, reach * world.scale.detach()[:, None] + place
