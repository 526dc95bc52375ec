"""A first look at candidate glints of learned faces, before any network is asked.

The wave steers by the quadric of a face's zone, and the quadrics of an object's samples are measured
once for all objects that have its shape. Most candidates lie by a sharp edge, where by its normals a
glint may be anywhere near; the quadric there sends the path far past the object. ``settle`` gives such
a candidate up after its own first look. Here it never becomes a chain: between two images one vertex
is left, on a quadric, and the stationary path is Newton's method in two unknowns.

What may be lost? Planar mirrors unfold exactly, so the stationary place is that of the whole chain, and
``settle`` begins on the same quadric. Only candidates whose steps have settled are dropped, and only
past the bounds by more than ``settle`` lets a vertex be from the surface, which lies within them. Both
then solve the same equations, but a quadric may have several stationary paths and Newton's methods in
two unknowns and in all of them may end on different ones: that is tested, not proven.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.tracer.faces import Looks
from rfsg.tracer.zone import Facets, take

STEPS = 12  # of Newton's method, at most, as many as ``settle`` takes in its first look
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
) -> Bool[Tensor, "m"]:
    """Candidates that Newton's method, on the facets of their samples, sends far past the object.

    fore, aft: the images at either end, in the object's frame.
    """
    start, (low, high) = looks.point[sample], looks.bounds
    place, settled = stationary(looks.of(sample), start, fore, aft)
    outside = torch.maximum(low - place, place - high).clamp(min=0.0).norm(dim=-1)
    allowed = PAST * float((high - low).amax()) + STRIDE * (place - start).norm(dim=-1)
    return settled & (outside > allowed) & torch.isfinite(outside)


def stationary(
    facets: Facets,
    start: Float[Tensor, "m 3"],
    fore: Float[Tensor, "m 3"],
    aft: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "m 3"], Bool[Tensor, "m"]]:
    """Where on each quadric the path between two points is stationary, and whether Newton's method has
    got there."""
    a, b, x = (
        torch.einsum("mij,mj->mi", facets.frame, p - facets.centre) for p in (fore, aft, start)
    )
    uv, going = x[:, :2].clone(), torch.arange(len(x), device=x.device)
    for _ in range(STEPS):
        step, reach = _step(take(facets, going), uv[going], a[going], b[going])
        size = step.norm(dim=-1)
        shrink = torch.where(size > reach, reach / size.clamp(min=1e-300), 1.0)
        uv[going] += shrink[:, None] * step
        going = going[size > SETTLED]
    place = torch.cat([uv, _height(facets, uv)[0][:, None]], 1)
    settled = torch.ones(len(x), dtype=torch.bool, device=x.device)
    settled[going] = False
    return facets.centre + torch.einsum("mji,mj->mi", facets.frame, place), settled


def _height(facets: Facets, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Heights of the quadrics over their frames, and their slopes."""
    pull = torch.einsum("mij,mj->mi", facets.bend, uv)
    return facets.offset + ((facets.slope + 0.5 * pull) * uv).sum(-1), facets.slope + pull


def _step(facets: Facets, uv: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Newton's step on the path's length, and how far its model reaches."""
    height, slope = _height(facets, uv)
    x = torch.cat([uv, height[:, None]], 1)
    gradient, hessian, lift, near = 0.0, 0.0, 0.0, []
    eye = torch.eye(2, dtype=x.dtype, device=x.device)
    outer = slope[:, :, None] * slope[:, None, :]
    for end in (a, b):
        away = x - end
        distance = away.norm(dim=-1).clamp(min=1e-12)
        u = away / distance[:, None]
        along = u[:, :2] + u[:, 2:] * slope
        gradient = gradient + along
        across = eye + outer - along[:, :, None] * along[:, None, :]
        hessian = hessian + across / distance[:, None, None]
        lift = lift + u[:, 2]
        near.append(distance)
    hessian = hessian + lift[:, None, None] * facets.bend
    p, q, r = hessian[:, 0, 0], hessian[:, 0, 1], hessian[:, 1, 1]
    det = p * r - q * q
    det = torch.where(det == 0, torch.full_like(det, 1e-300), det)
    first, second = gradient[:, 0], gradient[:, 1]
    step = torch.stack([q * second - r * first, q * first - p * second], -1) / det[:, None]
    bend = facets.bend.flatten(1).norm(dim=-1).clamp(min=1e-300)
    return step, 0.5 * torch.minimum(torch.minimum(near[0], near[1]), 1.0 / bend)
