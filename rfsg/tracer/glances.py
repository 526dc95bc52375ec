"""A first look at candidate glints of learned faces, before any network is asked.

The wave steers by the quadric of a face's zone, and the quadrics of an object's samples are measured
once for all objects that have its shape. Most candidates lie by a sharp edge, where by its normals a
glint may be anywhere near; the quadric there sends the path far past the object. ``settle`` gives such
a candidate up after its own first look. Here it never becomes a chain: between two images one vertex
is left, on a quadric, and the stationary path is Newton's method in two unknowns.

What may be lost? Of a chain that holds no mirror, what rounding decides: ``settle`` begins on the same
quadric, takes the same steps (``lone``) and gives up whatever they leave outside the object by less than
is asked here; only steps that wander without settling may part, as rounding grows along them.
Planar mirrors unfold exactly, so the stationary place is that of the whole chain as well; but there
``settle`` solves for all vertices, and on the way, or on a quadric with several stationary paths, its
steps may lead elsewhere. So of these chains only those are dropped whose steps have settled: that both
then end on the same path is tested, not proven.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.tracer.faces import Looks
from rfsg.tracer.lone import stationary

SETTLED = 1e-6  # [units of the object] of a step: it only has to tell past the object from on it
# how far past the object a candidate is given up, of its size and of the stride it takes: wider than
# what ``settle`` allows in its first look
PAST, STRIDE = 0.15, 0.15


@torch.no_grad()
def astray(
    looks: Looks,
    sample: Int[Tensor, "m"],
    fore: Float[Tensor, "m 3"],
    aft: Float[Tensor, "m 3"],
    steps: int,
    lone: bool,
) -> Bool[Tensor, "m"]:
    """Candidates that Newton's method, on the facets of their samples, sends far past the object.

    fore, aft: the images at either end, in the object's frame. steps: of Newton's method, at most, as
    many as ``settle`` takes. lone: whether the chains hold no other vertex.
    """
    start, (low, high) = looks.point[sample], looks.bounds
    floor = torch.full_like(start[:, 0], SETTLED)
    place, settled = stationary(looks.of(sample), start, fore, aft, steps, 0.0, floor)
    outside = torch.maximum(low - place, place - high).clamp(min=0.0).norm(dim=-1)
    allowed = PAST * float((high - low).amax()) + STRIDE * (place - start).norm(dim=-1)
    away = (outside > allowed) & torch.isfinite(outside)
    return away if lone else away & settled
