"""Body(shape, surface): the one concrete RadioObject."""

from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from rfsg.objects.contract import Contact, Crossing, Scatters, Shape, Surface
from rfsg.objects.physics.lobes import Scattering


class Body(nn.Module):
    """A shape joined with a surface; see ``rfsg.objects.contract`` for what each answers.

    band: lowest and highest frequency [Hz] that it was learned at; None where that says nothing
    of it, as for known materials."""

    shape: Shape
    surface: Surface

    def __init__(self, shape: Shape, surface: Surface, band: tuple[float, float] | None = None):
        super().__init__()
        self.shape = shape
        self.surface = surface
        self.band = band

    def reflection(
        self, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        return self.surface.reflection(self.shape, contact, frequency)

    @property
    def scattering(self) -> Scattering | None:
        """How the surface scatters; None where it is smooth."""
        rough = self.surface.scattering if isinstance(self.surface, Scatters) else None
        return rough if rough is not None and rough.active else None

    def diffuse(self, contact: Contact, frequency: Float[Tensor, "f"]) -> Complex[Tensor, "*b f 2"]:
        """Amplitudes (TE, TM) of the diffuse wave, of a surface that scatters."""
        assert isinstance(self.surface, Scatters)
        return self.surface.diffuse(self.shape, contact, frequency)

    def transmission(
        self, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        return self.surface.transmission(self.shape, crossing, frequency)

    def excess_delay(
        self, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]:
        return self.surface.excess_delay(self.shape, crossing, frequency)


def unstretched(body: Body) -> tuple[Body, Float[Tensor, "3"]]:
    """The body as it was learned, and the scales along the axes of its frame: 1, but for one whose
    shape is ``shapes.stretched.Stretched``."""
    shape: Any = body.shape
    if shape.kind != "stretched":
        return body, torch.ones(3, dtype=torch.float64)
    return Body(shape.base, body.surface, body.band), shape.scales
