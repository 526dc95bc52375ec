"""Opaque surfaces: a perfect conductor, and a dielectric half-space (Fresnel, ITU-R P.2040-4).

Also ``Dielectric``, the medium that half-spaces and slabs are made of.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from rfsg.objects.contract import Contact, Crossing, Shape
from rfsg.objects.physics import fresnel, media
from rfsg.objects.physics.lobes import Scattering

ALIKE = 0.5  # cosine below which a slope is of another face than the normal it is compared with


@dataclass(frozen=True)
class Slid(Crossing):
    """A crossing whose ends have slid along it to where its surface is now, and whose normals are
    those of where it was found. They turn with the surface (``turned``): left to those who ask a
    shape about the ends anyway."""


class Dielectric(nn.Module):
    """A homogeneous medium: an ITU material by name, or constants eps_r and sigma [S/m].

    Constants are parameters, frozen until someone asks for their gradient. ``extrapolate`` lets an
    ITU formula be used outside its band. Raises ValueError for both or neither kind of description,
    an unknown name, eps_r < 1 or sigma < 0.
    """

    def __init__(
        self,
        itu: str | None = None,
        eps_r: float | None = None,
        sigma: float | None = None,
        extrapolate: bool = False,
    ):
        super().__init__()
        if (itu is None) == (eps_r is None) or (itu is not None and sigma is not None):
            raise ValueError(
                "material: expected either itu=NAME or eps_r=... (and sigma=...), got "
                f"itu={itu!r}, eps_r={eps_r!r}, sigma={sigma!r}"
            )
        if itu is not None and itu not in media.MATERIALS:
            raise ValueError(
                f"material: got itu={itu!r}, expected one of {', '.join(media.MATERIALS)}"
            )
        self.itu, self.extrapolate = itu, extrapolate
        if eps_r is not None:
            sigma = 0.0 if sigma is None else sigma
            if not (1 <= eps_r < float("inf") and 0 <= sigma < float("inf")):
                raise ValueError(
                    "material: expected finite eps_r >= 1 and sigma >= 0 S/m, got "
                    f"eps_r={eps_r!r}, sigma={sigma!r}"
                )
            self.eps_r = _frozen(eps_r)
            self.sigma = _frozen(sigma)

    def permittivity(self, frequency: Float[Tensor, "f"]) -> Complex[Tensor, "f"]:
        """eps_c at frequencies [Hz]; ValueError outside an ITU band unless ``extrapolate``."""
        if self.itu is not None:
            return media.complex_permittivity(self.itu, frequency, self.extrapolate)
        eps_r, sigma = self._constants()
        return media.from_constants(eps_r, sigma, frequency.to(torch.float64))

    def slope(self, frequency: Float[Tensor, "f"]) -> Complex[Tensor, "f"]:
        """d eps_c / df [1/Hz]."""
        if self.itu is not None:
            return media.permittivity_slope(self.itu, frequency, self.extrapolate)
        eps = self.permittivity(frequency)
        return torch.complex(torch.zeros_like(eps.real), -eps.imag) / frequency

    def config(self) -> dict:
        """Constructor arguments, JSON-able, as they are now."""
        if self.itu is not None:
            return {"itu": self.itu, "extrapolate": self.extrapolate}
        eps_r, sigma = self._constants()
        return {"eps_r": eps_r.item(), "sigma": sigma.item(), "extrapolate": self.extrapolate}

    def _constants(self) -> tuple[Tensor, Tensor]:
        # A fit may step over the edge of what is passive; the medium does not.
        return (
            self.eps_r.to(torch.float64).clamp(min=1.0),
            self.sigma.to(torch.float64).clamp(min=0.0),
        )


class Known(nn.Module):
    """What surfaces of known material share: a wave that they reflect may scatter in part.

    ``scattering``: how, as a ``Scattering`` or its ``config``; None for a smooth surface. A surface
    says in ``whole`` what it reflects in all; the mirror and the diffuse wave share its power, the
    mirror always without the diffuse share, whether or not that is followed.
    """

    scattering: Scattering | None

    def __init__(self, scattering: Scattering | Mapping[str, Any] | None = None):
        super().__init__()
        self.scattering = Scattering.of(scattering)

    def whole(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """Reflection coefficients (TE, TM) of all that is reflected."""
        raise NotImplementedError

    def reflection(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """sqrt(1 - S^2) R: the mirror's share."""
        whole = self.whole(shape, contact, frequency)
        return whole if self.scattering is None else whole * self.scattering.mirror_amplitude()

    def diffuse(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """S R: the amplitude of the diffuse wave in all directions together."""
        whole = self.whole(shape, contact, frequency)
        rough = self.scattering
        return torch.zeros_like(whole) if rough is None else whole * rough.diffuse_amplitude()

    def roughness(self) -> dict[str, Any]:
        """The part of ``config`` that says how it scatters."""
        return {} if self.scattering is None else {"scattering": self.scattering.config()}


class _Opaque(Known):
    """What conductors and half-spaces share: nothing comes through."""

    opaque = True

    def transmission(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """Zero: nothing comes out of the other side."""
        point = crossing.start
        return torch.zeros(
            *point.shape[:-1],
            len(frequency),
            2,
            dtype=point.dtype.to_complex(),
            device=point.device,
        )

    def excess_delay(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]:
        """Zero [s], by convention: there is nothing to delay."""
        point = crossing.start
        return point.new_zeros(*point.shape[:-1], len(frequency))


class Conductor(_Opaque):
    """A perfect electric conductor: R_TE = R_TM = -1 at every angle and frequency, where smooth."""

    kind = "conductor"

    def whole(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        point = contact.point
        return torch.full(
            (*point.shape[:-1], len(frequency), 2),
            -1.0,
            dtype=point.dtype.to_complex(),
            device=point.device,
        )

    def config(self) -> dict:
        return self.roughness()


class DielectricHalfSpace(_Opaque):
    """A body so thick that what enters never comes out: Fresnel (P.2040-4 section 2.2.1).

    Opaque, whatever its conductivity: for a wall that lets waves through use ``Slab``.
    """

    kind = "halfspace"

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
        frequency = frequency.to(contact.point.device)
        cosine = contact_cosine(contact).to(torch.float64)[..., None]
        r = torch.stack(fresnel.interface(cosine, self.medium.permittivity(frequency)), -1)
        return r.to(contact.point.dtype.to_complex())

    def config(self) -> dict:
        return {**self.medium.config(), **self.roughness()}


def contact_cosine(contact: Contact) -> Float[Tensor, "*b"]:
    """|direction . normal| of a contact, the mean of both directions: symmetric under reversal."""
    both = _cosine(contact.incoming, contact.normal) + _cosine(contact.outgoing, contact.normal)
    return 0.5 * both


def crossing_direction(crossing: Crossing) -> Float[Tensor, "*b 3"]:
    """Unit direction of travel; 0 for a stretch of no length."""
    span = crossing.end - crossing.start
    square = span.square().sum(-1, keepdim=True)
    zero = square == 0
    return span / torch.where(zero, 1.0, square).sqrt()


def crossing_cosines(
    crossing: Crossing,
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """|direction . normal| where the stretch enters and leaves; 0 at an end inside the object."""
    direction = crossing_direction(crossing)
    return (
        _cosine(direction, crossing.normal_start),
        _cosine(direction, crossing.normal_end),
    )


def turned(
    normal: Float[Tensor, "*b 3"], gradient: Float[Tensor, "*b 3"], slope: Float[Tensor, "*b"]
) -> Float[Tensor, "*b 3"]:
    """Normals turned to where grad f points now; slope = |grad f|.

    Zero vectors stay, and so do normals that are far from it: on an edge f may be another face's.
    """
    length = slope[..., None]
    now = gradient / torch.where(length == 0, 1.0, length)
    alike = (now.detach() * normal.detach()).sum(-1, keepdim=True) > ALIKE
    return torch.where(alike, now, normal)


def at_boundary(normal: Float[Tensor, "*b 3"]) -> Tensor:
    """Whether an end of a crossing stands on the boundary: its normal is not the zero vector."""
    return (normal != 0).any(-1)


def _cosine(direction: Tensor, normal: Tensor) -> Tensor:
    return (direction * normal).sum(-1).abs().clamp(max=1.0)


def _frozen(value: float) -> nn.Parameter:
    return nn.Parameter(torch.tensor(value, dtype=torch.float64), requires_grad=False)
