"""What is asked of learned objects beside the readings: smooth fields, and f a distance.

The paper's Eq. 25: the discrete Laplacian of f, m, alpha and phi (and kappa) at random points, here
of the object's bounds and in units of their half diagonal, so that a weight means the same for a cup
and a hall. The eikonal term asks |grad f| = 1 (Gropp et al. 2020).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.learn.errors import LearnError
from rfsg.objects.body import Body
from rfsg.objects.surfaces.stochastic import StochasticSurface

STENCIL = 0.02  # of the half diagonal: the step of the discrete Laplacian


@dataclass(frozen=True)
class Regularisation:
    """Weights of the terms (0 leaves one out), and how many points each object is asked.

    every: steps from one asking to the next. They are 30 % of a step's time; asked more rarely and so
    many times as strongly, what they ask for is the same in the mean.
    """

    laplacian: float = 1e-4
    eikonal: float = 0.1
    points: int = 16
    every: int = 4

    def __post_init__(self) -> None:
        for name in ("laplacian", "eikonal"):
            if not 0 <= getattr(self, name) < math.inf:
                raise LearnError(
                    f"regularisation: {name}={getattr(self, name)!r}: expected a number >= 0"
                )
        for name in ("points", "every"):
            if getattr(self, name) < 1:
                raise LearnError(
                    f"regularisation: {name}={getattr(self, name)!r}: expected at least 1"
                )


def random_points(body: Body, count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """Points spread evenly over the object's bounds [m], its frame."""
    low, high = body.shape.bounds()
    share = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return low + (high - low) * share


def laplacian(
    body: Body, point: Float[Tensor, "n 3"], *, shape: bool, surface: bool
) -> Float[Tensor, ""]:
    """Mean over points of |lap f| + |lap m| + |lap alpha| + |lap phi| (+ |lap kappa|) (Eq. 25).

    shape, surface: whether f, and the fields, are asked. Lengths in half diagonals of the bounds.
    """
    low, high = body.shape.bounds().to(point)
    half = 0.5 * (high - low).norm()
    step = STENCIL * half
    away = step * torch.cat([torch.eye(3), -torch.eye(3)]).to(point)
    around = torch.cat([point[:, None], point[:, None] + away], 1)
    values = []
    if shape:
        values.append(body.shape.sdf(around) / half)
    if surface and isinstance(body.surface, StochasticSurface):
        values += [field for field in body.surface.fields(body.shape, around) if field is not None]
    total = point.new_zeros(())
    for value in values:
        total = total + ((value[:, 1:].sum(1) - 6.0 * value[:, 0]) / STENCIL**2).abs().mean()
    return total


def eikonal(body: Body, point: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean of (|grad f| - 1)^2."""
    _, gradient = body.shape.value_and_gradient(point)
    square = (gradient * gradient).sum(-1)
    zero = square == 0
    size = torch.where(zero, torch.zeros_like(square), torch.where(zero, 1.0, square).sqrt())
    return ((size - 1.0) ** 2).mean()
