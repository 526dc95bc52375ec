"""A solid of known material: it fills its shape, so its thickness is the shape's own.

Between parallel plane faces the answer is exact: the single layer of ITU-R P.2040-4, section 2.2.2,
as thick as the shape is there. Elsewhere a wave bends. The surface answers for a *straight* stretch,
which is what is left where nobody bends it: two interfaces and the way between them. The tracer
bends paths through exact shapes (``rfsg.tracer.refract``) and asks for ``face``, ``inside`` and
``index`` instead.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact, Crossing, Shape
from rfsg.objects.physics import fresnel
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import Boxes
from rfsg.objects.surfaces.interface import (
    Dielectric,
    Known,
    at_boundary,
    contact_cosine,
    crossing_cosines,
)

PARALLEL = 1e-6  # [rad] between opposite faces of a shape known exactly
RIPPLING = math.radians(5.0)  # of a learned one, whose faces ripple


@dataclass(frozen=True)
class Backed(Contact):
    """A contact of which it is known how far the solid reaches behind it, along -normal, to a plane
    face parallel to the one that is met: ``behind`` in physical metres, inf without such a face."""

    behind: Float[Tensor, "*b"]


@dataclass(frozen=True)
class Stretch(Crossing):
    """A crossing of which it is known how long it is, in physical metres, and whether it leads from
    one plane face to another that is parallel to it."""

    length: Float[Tensor, "*b"]
    parallel: Bool[Tensor, "*b"]


def backed(shape: Shape, contact: Contact) -> Backed:
    """A contact of one object by itself, whose frame is in physical metres."""
    behind = depth_behind(shape, shape.patch(contact.point))
    return Backed(contact.point, contact.incoming, contact.outgoing, contact.normal, behind)


def depth_behind(shape: Shape, patch: Int[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """How far behind plane patches the parallel face of a convex shape lies [m]; inf without one."""
    if isinstance(shape, Boxes):
        return 2.0 * shape.half_size.gather(1, (patch // 2)[:, None]).squeeze(1)
    planes = shape.planes().to(torch.float64)
    alone = torch.full_like(patch, math.inf, dtype=torch.float64)
    if not (shape.convex and len(planes)):
        return alone
    opposite = (planes[:, None, :3] + planes[None, :, :3]).abs().amax(-1) <= PARALLEL
    depth = torch.where(opposite, planes[:, None, 3] + planes[None, :, 3], math.inf).amin(1)
    flat = patch < len(planes)
    return torch.where(flat, depth[torch.where(flat, patch, 0)], alone)


def stretch_of(shape: Shape, crossing: Crossing) -> Stretch:
    """A crossing of one object by itself, whose frame is in physical metres."""
    flat = is_flat(shape, crossing.start) & is_flat(shape, crossing.end)
    return stretched(crossing, flat, torch.full_like(flat, shape.exact))


def stretched(
    crossing: Crossing,
    flat: Bool[Tensor, "*b"],
    exact: Bool[Tensor, "*b"],
    scale: Float[Tensor, "*b"] | float = 1.0,
) -> Stretch:
    """A crossing with its length and kind. flat: both ends lie in plane faces, asked of exact shapes
    only; scale: physical metres in a metre of the crossing's frame."""
    span = crossing.end - crossing.start
    square = (span * span).sum(-1)
    length = torch.where(square == 0, 0.0, torch.where(square == 0, 1.0, square).sqrt()) * scale
    tilt = (crossing.normal_start + crossing.normal_end).square().sum(-1).sqrt()
    through = at_boundary(crossing.normal_start) & at_boundary(crossing.normal_end)
    parallel = torch.where(exact, flat & (tilt <= PARALLEL), tilt <= RIPPLING) & through
    return Stretch(
        crossing.start,
        crossing.end,
        crossing.normal_start,
        crossing.normal_end,
        length,
        parallel,
    )


def is_flat(shape: Shape, point: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
    """Whether surface points lie on a plane face."""
    return shape.patch(point) < len(shape.planes())


class Solid(Known):
    """A homogeneous dielectric body; the constants are those of ``Dielectric``, which see.

    Not opaque, however thick: what comes through may be 0. A radio inside is taken to be matched to
    the medium it stands in: its effective aperture is (lambda / |n|)^2 / 4 pi.
    """

    kind = "solid"
    opaque = False

    def __init__(
        self,
        itu: str | None = None,
        eps_r: float | None = None,
        sigma: float | None = None,
        extrapolate: bool = False,
        scattering: Scattering | Mapping[str, Any] | None = None,
    ):
        super().__init__(scattering)
        self.medium = Dielectric(itu, eps_r, sigma, extrapolate)

    def whole(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """R of the layer between parallel plane faces, else of a half-space; refers to the face."""
        contact = contact if isinstance(contact, Backed) else backed(shape, contact)
        frequency = frequency.to(contact.point.device, torch.float64)
        cosine = contact_cosine(contact).to(torch.float64)[..., None]
        eps = self.medium.permittivity(frequency)
        layer = torch.isfinite(contact.behind)
        thickness = torch.where(layer, contact.behind, 1.0).to(torch.float64)[..., None]
        of_layer, _ = fresnel.slab(cosine, eps, thickness, frequency)
        of_face = torch.stack(fresnel.interface(cosine, eps), -1)
        r = torch.where(layer[..., None, None], of_layer, of_face)
        return r.to(contact.point.dtype.to_complex())

    def transmission(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """T of the layer between parallel plane faces, else of one straight pass:

            sqrt((1 - R_1^2)(1 - R_2^2)) exp(-j k (n_c - 1) length),

        an approximation where the wave would bend. An end inside counts sqrt(1 / n_c) for its face.
        """
        stretch = crossing if isinstance(crossing, Stretch) else stretch_of(shape, crossing)
        frequency = frequency.to(stretch.start.device, torch.float64)
        first, last = (c.to(torch.float64) for c in crossing_cosines(stretch))
        of_layer = self._layer(fresnel.slab, stretch, first, last, frequency)[1]
        way = self.inside(stretch.length, frequency)[..., None]
        ends = [self.face(c, frequency) for c in (first, last)]
        matched = (1.0 / self._root(frequency)).sqrt()[:, None]
        for k, normal in enumerate((stretch.normal_start, stretch.normal_end)):
            ends[k] = torch.where(at_boundary(normal)[..., None, None], ends[k], matched)
        t = torch.where(stretch.parallel[..., None, None], of_layer, ends[0] * ends[1] * way)
        return t.to(stretch.start.dtype.to_complex())

    def excess_delay(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]:
        """Group delay beyond free space [s]: of the layer's TE wave, else (n_g - 1) length / c."""
        stretch = crossing if isinstance(crossing, Stretch) else stretch_of(shape, crossing)
        frequency = frequency.to(stretch.start.device, torch.float64)
        first, last = (c.to(torch.float64) for c in crossing_cosines(stretch))
        of_layer = self._layer(self._layer_delay, stretch, first, last, frequency)[..., 0]
        straight = self.inside_delay(stretch.length, frequency)
        delay = torch.where(stretch.parallel[..., None], of_layer, straight)
        return delay.to(stretch.start.dtype)

    # what a bent path asks

    def index(self, frequency: Float[Tensor, "f"]) -> Float[Tensor, "f"]:
        """n = Re sqrt(eps_c), by which rays bend: exact without loss, good while loss is low."""
        return self._root(frequency.to(torch.float64)).real

    def face(
        self, cosine: Float[Tensor, "*b"], frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """(TE, TM) amplitude sqrt(1 - R^2) of passing one face, at the |cos| outside.

        No more than 1: in a lossy medium the powers of the waves up and down do not simply add, and
        |1 - R^2| passes 1 by up to 17 % near the TM wave's Brewster angle. Through a layer its loss
        makes up for that; a stretch across a corner is too short for any.
        """
        frequency = frequency.to(cosine.device, torch.float64)
        passed = fresnel.refraction(cosine[..., None], self.medium.permittivity(frequency))
        return passed / passed.abs().clamp(min=1.0)

    def inside(
        self, length: Float[Tensor, "*b"], frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f"]:
        """exp(-j k (n_c - 1) length), length in physical metres."""
        frequency = frequency.to(length.device, torch.float64)
        k = 2 * math.pi * frequency / fresnel.SPEED_OF_LIGHT
        return torch.exp(-1j * k * (self._root(frequency) - 1.0) * length[..., None])

    def inside_delay(
        self, length: Float[Tensor, "*b"], frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]:
        """(n_g - 1) length / c [s], with the group index n_g = Re(n_c + f dn_c/df)."""
        frequency = frequency.to(length.device, torch.float64)
        root = self._root(frequency)
        group = (root + frequency * self.medium.slope(frequency) / (2 * root)).real
        return (group - 1.0) * length[..., None] / fresnel.SPEED_OF_LIGHT

    def config(self) -> dict:
        return {**self.medium.config(), **self.roughness()}

    def _root(self, frequency: Tensor) -> Complex[Tensor, "f"]:
        """n_c = sqrt(eps_c), Im n_c <= 0."""
        return torch.sqrt(self.medium.permittivity(frequency))

    def _layer(self, formula: Any, stretch: Stretch, first: Tensor, last: Tensor, frequency):
        """A formula of the layer that a stretch crosses, at the mean |cos| of its ends."""
        cosine = torch.where(stretch.parallel, 0.5 * (first + last), 1.0)
        thickness = (stretch.length * cosine).to(torch.float64)
        eps = self.medium.permittivity(frequency)
        return formula(cosine[..., None], eps, thickness[..., None], frequency)

    def _layer_delay(self, cosine: Tensor, eps: Tensor, thickness: Tensor, frequency: Tensor):
        slope = self.medium.slope(frequency)
        return fresnel.slab_excess_delay(cosine, eps, slope, thickness, frequency)
