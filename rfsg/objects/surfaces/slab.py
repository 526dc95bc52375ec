"""A thin wall of known material: the single-layer slab of ITU-R P.2040-4, section 2.2.2."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.objects.contract import Contact, Crossing, Shape
from rfsg.objects.physics import fresnel
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.surfaces.interface import (
    Dielectric,
    Known,
    at_boundary,
    contact_cosine,
    crossing_cosines,
)


class Slab(Known):
    """A layer of ``thickness_m`` metres, reflecting and transmitting as a whole.

    The thickness is the wall's own, in physical metres, whatever shape and scale the object is
    drawn with: a shape of any depth is crossed once, as one slab. An end of a crossing that lies
    inside the object changes nothing but the angle. Raises ValueError for a thickness that is not
    positive, and as ``Dielectric`` does.
    """

    kind = "slab"
    opaque = False

    def __init__(
        self,
        thickness_m: float,
        itu: str | None = None,
        eps_r: float | None = None,
        sigma: float | None = None,
        extrapolate: bool = False,
        scattering: Scattering | Mapping[str, Any] | None = None,
    ):
        super().__init__(scattering)
        if not 0 < thickness_m < float("inf"):
            raise ValueError(f"slab: expected a thickness in metres > 0, got {thickness_m!r}")
        self.thickness_m = thickness_m
        self.medium = Dielectric(itu, eps_r, sigma, extrapolate)

    def whole(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """R of the slab, referred to its front face, at the mean of both directions' |cos|."""
        frequency = frequency.to(contact.point.device, torch.float64)
        cosine = contact_cosine(contact).to(torch.float64)[..., None]
        eps = self.medium.permittivity(frequency)
        r, _ = fresnel.slab(cosine, eps, self.thickness_m, frequency)
        return r.to(contact.point.dtype.to_complex())

    def transmission(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """T of the slab relative to free space, at the mean |cos| of the ends on the boundary."""
        frequency = frequency.to(crossing.start.device, torch.float64)
        cosine = _mean_cosine(crossing).to(torch.float64)[..., None]
        eps = self.medium.permittivity(frequency)
        _, t = fresnel.slab(cosine, eps, self.thickness_m, frequency)
        return t.to(crossing.start.dtype.to_complex())

    def excess_delay(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]:
        """Group delay beyond free space [s] of the TE wave, whose phase a scalar link carries."""
        frequency = frequency.to(crossing.start.device, torch.float64)
        cosine = _mean_cosine(crossing).to(torch.float64)[..., None]
        eps, slope = self.medium.permittivity(frequency), self.medium.slope(frequency)
        delay = fresnel.slab_excess_delay(cosine, eps, slope, self.thickness_m, frequency)
        return delay[..., 0].to(crossing.start.dtype)

    def config(self) -> dict:
        return {"thickness_m": self.thickness_m, **self.medium.config(), **self.roughness()}


def _mean_cosine(crossing: Crossing) -> Tensor:
    """Mean |cos| over the ends on the boundary; 1 when both ends lie inside."""
    first, last = crossing_cosines(crossing)
    count = at_boundary(crossing.normal_start).to(first) + at_boundary(crossing.normal_end).to(
        first
    )
    return torch.where(count > 0, (first + last) / count.clamp(min=1.0), 1.0)
