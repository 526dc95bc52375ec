"""What each way to meet a baked shape errs by, measured on points of the shape itself.

certain: on baked values where these are as good as ``TOLERANCE``, else on the network.
newton: a step to the root from where the zero mesh was hit.  mesh: that hit.  grid: baked values.
All along the normal of the face, which is what lengthens a path: |f| / |grad f| where a hit would be.
What a way may lack is looked for where the surface may be by the values' own errors, met or not: points
there are moved onto the surface, and one that the grid's values keep away from is lost.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import Baked, Off
from rfsg.objects.shapes.blocks import ROUNDING, corners, places
from rfsg.objects.shapes.refined import newton

TOLERANCE = 5e-5  # [m] how well f must be known at a hit
SHORT_STEP = 1e-3  # [m] longest step from the mesh to the root
STEEP = 0.15  # least |df/dt| of a root that is not grazing
RESIDUAL = 2e-6  # [m] of f at a root that the network gave: four times its rounding in float32
COUNT = 16_384  # points of each kind
SAFETY = 1.25  # of a largest error over the largest found
ON = 1e-5  # [m] points this near lie on the surface
OF_THREE = 3.0  # of n points none, or k of many: at most (k + 3) / n in 95 % (rule of three)


def step_to_root(value: Float[Tensor, "k"], slope: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
    """Newton's step along rays [m] for f and its slope there, no longer than ``SHORT_STEP``."""
    steep = torch.where(slope.abs() < STEEP, torch.where(slope < 0, -STEEP, STEEP), slope)
    return -(value / steep).clamp(-SHORT_STEP, SHORT_STEP)


@torch.no_grad()
def measured_offs(shape: Shape, found: Baked) -> dict[str, Off]:
    """What "certain", "newton", "mesh" and "grid" err by on this shape."""
    point, slope = _on_mesh(found)
    value, gradient = _asked(shape, point)
    steep = gradient.norm(dim=-1).clamp(min=ROUNDING)
    direction = _towards(slope)
    moved = point + step_to_root(value, (slope * direction).sum(-1))[:, None] * direction
    on = point - newton(value, gradient, SHORT_STEP)
    on = on[_asked(shape, on)[0].abs() < ON]
    about, doubt = found.look(on)
    sure = torch.where(doubt <= TOLERANCE, about.abs(), torch.full_like(about, RESIDUAL))
    steep_on = _asked(shape, on)[1].norm(dim=-1).clamp(min=ROUNDING)
    lost = _lost(shape, found)
    return {
        "certain": _off(sure / steep_on, 0.0),
        "newton": _off(_asked(shape, moved)[0].abs() / steep, lost),
        "mesh": _off(value.abs() / steep, lost),
        "grid": _off(about.abs() / steep_on, lost),
    }


def _off(errors: Float[Tensor, "n"], lost: float) -> Off:
    errors = errors.double() + ROUNDING
    return Off(float(torch.quantile(errors, 0.99)), SAFETY * float(errors.max()), lost)


def _on_mesh(found: Baked) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Points anywhere on the zero mesh alike, and the gradient as it is interpolated there."""
    generator = torch.Generator().manual_seed(2)
    triangles = found.zero.triangles.long()
    corner = found.zero.vertices[triangles]
    sides = corner[:, 1:] - corner[:, :1]
    area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=-1).double().cumsum(0)
    share = torch.rand(COUNT, generator=generator, dtype=torch.float64) * area[-1]
    some = torch.searchsorted(area, share).clamp(max=len(area) - 1)
    u, v = torch.rand(2, COUNT, generator=generator)
    u, v = torch.where(u + v > 1.0, 1.0 - u, u), torch.where(u + v > 1.0, 1.0 - v, v)
    weight = torch.stack([1.0 - u - v, u, v], -1)[..., None]
    return (weight * corner[some]).sum(1), (weight * found.gradient[triangles[some]]).sum(1)


def _towards(outward: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Directions of rays that hit a face, as often as rays from everywhere do (cosine law)."""
    generator = torch.Generator().manual_seed(3)
    anywhere = F.normalize(torch.randn(len(outward), 3, generator=generator), dim=-1)
    return F.normalize(anywhere - (1.0 + ROUNDING) * F.normalize(outward, dim=-1), dim=-1)


def _lost(shape: Shape, found: Baked) -> float:
    """Bound on the share of the surface where no corner of a cell changes sign, and that the values
    keep away from by more than ``SHORT_STEP``."""
    generator = torch.Generator().manual_seed(4)
    ends, error = corners(found), found.error.float()
    unsure = (ends.amin(0) <= error) & (ends.amax(0) >= -error)
    block, cell = torch.nonzero(unsure, as_tuple=True)
    some = torch.randint(len(block), (COUNT,), generator=generator)
    low = places(found, block[some], cell[some])
    start = low + found.step * torch.rand(COUNT, 3, generator=generator)
    point = start
    for _ in range(3):
        point = point - newton(*_asked(shape, point), found.step)
    on = (_asked(shape, point)[0].abs() < ON) & ((point - start).norm(dim=-1) < 2.0 * found.step)
    point = point[on]
    if not len(point):
        return 1.0
    away = found.look(point)[0].abs() / found.slope
    return min((float((away > SHORT_STEP).sum()) + OF_THREE) / len(point), 1.0)


def _asked(shape: Shape, point: Tensor) -> tuple[Tensor, Tensor]:
    """f and its gradient, at points taken into the bounds."""
    low, high = shape.bounds().float()
    value, gradient = shape.value_and_gradient(point.to(low).clamp(low, high))
    return value.cpu(), gradient.cpu()
