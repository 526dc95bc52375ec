"""A learned shape scaled differently along its axes: its own network, asked at squeezed points."""

from typing import Any

import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor, nn

from rfsg.objects.body import Body
from rfsg.objects.contract import Jet
from rfsg.objects.shapes.neural import NeuralShape


class Stretched(nn.Module):
    """f(x) = s f_base(x / s along each axis), s the least scale.

    With s in front f is never more than L times the distance to the surface where f_base is not: what
    a march trusts stays true, though it takes smaller steps along the longer axes. The weights are the
    base's own, and so are features: a material is asked at the point that was stretched to here.

    scales: [3], along the axes of the base's frame, > 0. Raises ValueError for others.
    """

    kind = "stretched"
    convex = False
    faceted = False
    exact = False
    scales: Tensor

    def __init__(self, base: NeuralShape, scales: Float[Tensor, "3"]):
        super().__init__()
        if tuple(scales.shape) != (3,) or not bool((scales.isfinite() & (scales > 0)).all()):
            raise ValueError(f"scales={scales.tolist()}: expected three finite numbers > 0")
        self.base = base
        self.register_buffer("scales", scales.detach().to(torch.float64).clone(), persistent=False)

    @property
    def lipschitz(self) -> float:
        """Bound on |grad f|: the base's, as no axis is squeezed by more than s."""
        return self.base.lipschitz

    @lipschitz.setter
    def lipschitz(self, bound: float) -> None:
        self.base.lipschitz = bound

    def config(self) -> dict[str, object]:
        return {"scales": self.scales.tolist(), "base": self.base.config()}

    def bounds(self) -> Float[Tensor, "2 3"]:
        return self.base.bounds() * self.scales

    def sdf(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        scales, least = self._like(point)
        return least * self.base.sdf(point / scales)

    def feature(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b h"]:
        return self.base.feature(point / self._like(point)[0])

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        scales, least = self._like(point)
        value, gradient = self.base.value_and_gradient(point / scales)
        return least * value, (least / scales) * gradient

    def value_gradient_feature(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"], Float[Tensor, "*b h"]]:
        scales, least = self._like(point)
        value, gradient, feature = self.base.value_gradient_feature(point / scales)
        return least * value, (least / scales) * gradient, feature

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        scales, least = self._like(point)
        own = self.base.jet(point / scales)
        bend = least / (scales[:, None] * scales)
        return Jet(least * own.value, (least / scales) * own.gradient, bend * own.hessian)

    def normal_at(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Unit vector along the gradient; zero where the gradient is zero."""
        return nn.functional.normalize(self.value_and_gradient(point)[1], dim=-1, eps=1e-300)

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        raise NotImplementedError(
            "a neural shape is not convex: march it within its bounds instead"
        )

    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        return self.base.patch(point / self._like(point)[0])

    def planes(self) -> Float[Tensor, "0 4"]:
        return self.base.planes()

    def _like(self, point: Tensor) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
        scales = self.scales.to(point)
        return scales, scales.min()


def stretched(body: Body, scales: Float[ndarray, "3"]) -> Body:
    """A body with a learned shape, scaled along the axes of its frame. Lengths are those of the world:
    what is learned of a metre of its matter holds for each metre of the stretched one."""
    assert isinstance(body.shape, NeuralShape)
    shape: Any = Stretched(body.shape, torch.from_numpy(scales.copy()))
    return Body(shape, body.surface, body.band)
