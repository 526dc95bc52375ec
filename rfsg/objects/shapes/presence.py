"""Is there anything there? Whether a learned shape has a surface within its bounds."""

import torch
from torch import Tensor

from rfsg.objects.contract import Shape

LOOKS = 4096  # points in the bounds; only a shape that shows one sign at all of them is looked at closer
CHASED = 256  # of them, those nearest to a change of sign
STEPS = 16
OVERSHOOT = 1.5  # of a Newton step: through a thin plate's face and into it


@torch.no_grad()
def absence(shape: Shape) -> str | None:
    """Why no wave can meet the shape, in words that follow its name; None where f changes sign.

    f is looked at in float32 at points spread through the bounds. Where all have one sign, the
    nearest are sent along grad f towards the other: a thin plate is found although none fell into it.
    """
    low, high = shape.bounds().detach().float()
    share = torch.rand(LOOKS, 3, generator=torch.Generator().manual_seed(0)).to(low)
    point = low + (high - low) * share
    value = shape.sdf(point)
    if not bool(torch.isfinite(value).all()):
        return "is not a number at some points within its bounds: its weights are broken"
    if _changes(value) or _changes(_chase(shape, point, value, low, high)):
        return None
    least, most = float(value.min()), float(value.max())
    sign = "negative, so it has no outside" if least < 0 else "positive, so it has no inside"
    return (
        f"has no surface within its bounds: nothing to hit (f is {least:.3g} to {most:.3g} m, "
        f"everywhere {sign})"
    )


def _changes(value: Tensor) -> bool:
    return bool((value < 0).any() & (value >= 0).any())


def _chase(shape: Shape, point: Tensor, value: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Values on the way from the least |f| towards f = 0 and beyond, [CHASED * (STEPS + 1)]."""
    point = point[value.abs().argsort()[:CHASED]]
    seen = []
    for _ in range(STEPS):
        value, gradient = shape.value_and_gradient(point)
        seen.append(value)
        square = (gradient * gradient).sum(-1, keepdim=True)
        flat = square < torch.finfo(square.dtype).eps ** 2
        step = OVERSHOOT * value[:, None] * gradient / torch.where(flat, 1.0, square)
        point = (point - torch.where(flat, 0.0, step)).clamp(low, high)
    return torch.cat([*seen, shape.sdf(point)])
