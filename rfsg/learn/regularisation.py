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
from rfsg.objects.physics.transport import gradient_norm
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.stochastic import StochasticSurface

STENCIL = 0.02  # of the half diagonal: the step of the discrete Laplacian


@dataclass(frozen=True)
class Regularisation:
    """Weights of the terms (0 leaves one out), and how many points each object is asked.

    every: steps from one asking to the next. They are a quarter of a step's work; asked more rarely and so
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


def regularised(
    body: Body, point: Float[Tensor, "n 3"], how: Regularisation, *, shape: bool, surface: bool
) -> Float[Tensor, ""]:
    """Both terms at points [m] with their weights; shape, surface: what of the object is learned.

    The eikonal term asks for slopes where the Laplacian has its middles: one sweep answers both.
    """
    total = point.new_zeros(())
    if not how.laplacian:
        return how.eikonal * eikonal(body, point) if how.eikonal and shape else total
    around = stencil(body, point)
    said = _Said.of(body, around, slope=shape and how.eikonal > 0, value=shape, feature=surface)
    total = how.laplacian * _laplacian(body, around, said)
    if said.gradient is not None:
        total = total + how.eikonal * _off_unit(said.gradient[:, 0])
    return total


def laplacian(
    body: Body, point: Float[Tensor, "n 3"], *, shape: bool, surface: bool
) -> Float[Tensor, ""]:
    """Mean over points of |lap f| + |lap m| + |lap alpha| + |lap phi| (+ |lap kappa|) (Eq. 25).

    shape, surface: whether f, and the fields, are asked. Lengths in half diagonals of the bounds.
    """
    around = stencil(body, point)
    return _laplacian(body, around, _Said.of(body, around, value=shape, feature=surface))


def eikonal(body: Body, point: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean of (|grad f| - 1)^2."""
    return _off_unit(body.shape.value_and_gradient(point)[1])


def stencil(body: Body, point: Float[Tensor, "n 3"]) -> Float[Tensor, "n 7 3"]:
    """Each point, and those a step away from it both ways along each axis [m]."""
    eye = torch.eye(3, dtype=point.dtype)
    away = torch.cat([torch.zeros_like(eye[:1]), eye, -eye])
    return point[:, None] + STENCIL * _half_diagonal(body) * away


@dataclass(frozen=True)
class _Said:
    """What an object says of points: f [m] and its gradient, and the fields; None was not asked."""

    value: Float[Tensor, "n 7"] | None = None
    gradient: Float[Tensor, "n 7 3"] | None = None
    fields: tuple[Float[Tensor, "n 7"], ...] = ()

    @staticmethod
    def of(
        body: Body,
        point: Float[Tensor, "n 7 3"],
        *,
        value: bool,
        feature: bool,
        slope: bool = False,
    ) -> "_Said":
        """In one sweep of the shape, where it can tell all at once."""
        f = g = h = None
        surface = body.surface if feature else None
        learned = surface if isinstance(surface, StochasticSurface) else None
        if value and learned and isinstance(body.shape, NeuralShape):
            f, g, h = body.shape.value_gradient_feature(point)
        elif slope:
            f, g = body.shape.value_and_gradient(point)
        elif value:
            f = body.shape.sdf(point)
        fields = learned.fields(body.shape, point, h) if learned else ()
        return _Said(f, g if slope else None, tuple(x for x in fields if x is not None))


def _laplacian(body: Body, around: Float[Tensor, "n 7 3"], said: _Said) -> Float[Tensor, ""]:
    values = (
        said.fields if said.value is None else (said.value / _half_diagonal(body), *said.fields)
    )
    if not values:
        return around.new_zeros(())
    each = torch.stack(values)
    bent = (each[..., 1:].sum(-1) - 6.0 * each[..., 0]) / STENCIL**2
    return bent.abs().mean(-1).sum()


def _off_unit(gradient: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    return ((gradient_norm(gradient) - 1.0) ** 2).mean()


def _half_diagonal(body: Body) -> float:
    """Of the object's bounds [m]."""
    low, high = body.shape.bounds().tolist()
    return 0.5 * math.dist(low, high)
