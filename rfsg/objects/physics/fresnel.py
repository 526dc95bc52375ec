"""Plane waves at an interface and a slab: Recommendation ITU-R P.2040-4, sections 2.2.1, 2.2.2.

Pairs (TE, TM) stand on a last axis of 2. theta is the angle to the normal, in free space on both
sides, and kappa = sqrt(eps_c - sin^2 theta), so with A = cos theta for TE and eps_c cos theta for
TM

    |R| = |kappa - A| / |kappa + A|,   1 - R^2 = 4 A kappa / (kappa + A)^2.

Signs are those of ``rfsg.objects.contract``: R_TE = R_TM at normal incidence, hence at grazing
incidence R_TE -> -1 and R_TM -> +1 (the Recommendation's R_TM has the other sign: its reference for
the reflected field is turned, which no observable sees once the field is put together).

Every difference of nearly equal terms is written in the factor eps_c - 1 it contains, so a vacuum
interface reflects exactly 0 and a vacuum slab transmits exactly 1.
"""

import math

import torch
from jaxtyping import Complex, Float
from torch import Tensor

SPEED_OF_LIGHT = 299_792_458.0  # [m/s], exact (SI)
# A wave within a nanoradian of the surface is taken at a nanoradian: the limits are reached to 1e-9
# there, and 0/0 (vacuum at exactly grazing incidence) cannot occur.
GRAZING_COSINE = 1e-9
# |eps_c - sin^2| below this is the critical angle of a medium thinner than vacuum, where the square
# root has no derivative; the square of GRAZING_COSINE, so that vacuum is left alone.
_CRITICAL = GRAZING_COSINE**2


def interface(
    cos_incidence: Float[Tensor, "*#b"], eps_c: Complex[Tensor, "*#b"]
) -> tuple[Complex[Tensor, "*b"], Complex[Tensor, "*b"]]:
    """(R_TE, R_TM) from free space onto a half-space (P.2040-4 section 2.2.1); arguments broadcast.

    ``cos_incidence`` in [0, 1] is |direction . normal|.
    """
    kappa, admittance = _layer(cos_incidence, eps_c)
    r = _reflection(kappa, admittance, _cosine(cos_incidence), eps_c)
    return r[..., 0], r[..., 1]


def refraction(
    cos_incidence: Float[Tensor, "*#b"], eps_c: Complex[Tensor, "*#b"]
) -> Complex[Tensor, "*b 2"]:
    """sqrt(1 - R^2), (TE, TM), of a wave through one face of a half-space, the same both ways.

    The field transmission t is this times sqrt(p_1 / p_2), with p = cos theta (TE) or kappa the
    admittances of the two sides (Born and Wolf 1.5.2): the power through a unit of the face stays,
    its ray tube widens. Into and out of a layer of parallel faces, t_12 t_21 = 1 - R^2.
    ``cos_incidence`` is that on the side of free space.
    """
    cosine = _cosine(cos_incidence)
    kappa, admittance = _layer(cosine, eps_c)
    return 2 * torch.sqrt(admittance * kappa[..., None]) / (kappa[..., None] + admittance)


def slab(
    cos_incidence: Float[Tensor, "*#b"],
    eps_c: Complex[Tensor, "*#b"],
    thickness: Float[Tensor, "*#b"] | float,
    frequency: Float[Tensor, "*#b"],
) -> tuple[Complex[Tensor, "*b 2"], Complex[Tensor, "*b 2"]]:
    """R and T, (TE, TM), of one layer in free space (P.2040-4 section 2.2.2); arguments broadcast.

    ``thickness`` d [m], ``frequency`` [Hz]. R refers to the front face. T is *relative to free
    space*: the Recommendation's T contains the travel through d (a slab of vacuum has T = exp(-j k
    d cos theta)), but a path's length counts d already, so T is multiplied by exp(+j k d cos
    theta).
    """
    layer = _SlabTerms(cos_incidence, eps_c, thickness, frequency)
    return layer.r * layer.gap / layer.loop, layer.t * layer.through / layer.loop


def slab_excess_delay(
    cos_incidence: Float[Tensor, "*#b"],
    eps_c: Complex[Tensor, "*#b"],
    eps_slope: Complex[Tensor, "*#b"],
    thickness: Float[Tensor, "*#b"] | float,
    frequency: Float[Tensor, "*#b"],
) -> Float[Tensor, "*b 2"]:
    """Group delay -(1 / 2 pi) d arg T / df [s] of the relative T of ``slab``, (TE, TM).

    ``eps_slope`` = d eps_c / df [1/Hz] brings the dispersion of the material in. Derived from ln T,
    so it stays finite when |T| underflows.
    """
    layer = _SlabTerms(cos_incidence, eps_c, thickness, frequency)
    kappa, a, r = layer.kappa[..., None], layer.admittance, layer.r
    slope = eps_slope[..., None]
    d_kappa = slope / (2 * kappa)
    turn = torch.stack([torch.zeros_like(eps_c), torch.ones_like(eps_c)], -1)  # A' = eps' cos: TM
    d_a = turn * slope * layer.cosine[..., None]
    sign = 2 * turn - 1  # R_TE = -(kappa - A)/(kappa + A), R_TM = +(kappa - A)/(kappa + A)
    d_r = sign * 2 * (a * d_kappa - kappa * d_a) / (kappa + a).square()
    d_log_t = d_a / a + d_kappa / kappa - 2 * (d_kappa + d_a) / (kappa + a)
    wavenumber = (2 * math.pi * layer.thickness / SPEED_OF_LIGHT)[..., None]
    d_q = wavenumber * (kappa + layer.frequency[..., None] * d_kappa)
    d_through = -1j * (d_q - wavenumber * (kappa - layer.lead[..., None]))
    d_echo = (2 * r * d_r - 2j * d_q * r.square()) * layer.round_trip[..., None]
    d_log_transmission = d_log_t + d_through + d_echo / layer.loop
    return -d_log_transmission.imag / (2 * math.pi)


class _SlabTerms:
    """The terms that R, T and the delay share: T = t * through / loop, R = r * gap / loop."""

    def __init__(self, cos_incidence: Tensor, eps_c: Tensor, thickness, frequency: Tensor):
        thickness = torch.as_tensor(thickness, dtype=frequency.dtype, device=frequency.device)
        # torch.broadcast_shapes would load sympy first: seconds, for the shape of four tensors
        shape = torch.broadcast_tensors(cos_incidence, eps_c, thickness, frequency)[0].shape
        self.cosine = _cosine(cos_incidence).expand(shape)
        self.thickness, self.frequency = thickness.expand(shape), frequency.expand(shape)
        eps_c = eps_c.expand(shape)
        self.kappa, self.admittance = _layer(self.cosine, eps_c)
        self.r = _reflection(self.kappa, self.admittance, self.cosine, eps_c)
        total = self.kappa[..., None] + self.admittance
        self.t = 4 * self.admittance * self.kappa[..., None] / total.square()  # 1 - r^2
        kd = 2 * math.pi * self.frequency * self.thickness / SPEED_OF_LIGHT
        self.lead = (eps_c - 1) / (self.kappa + self.cosine)  # kappa - cos theta
        self.through = torch.exp(-1j * kd * self.lead)[..., None]
        below = _expm1(-2j * kd * self.kappa)
        self.round_trip = 1 + below
        self.gap = -below[..., None]  # 1 - e^{-2jq}
        self.loop = self.gap + self.t * self.round_trip[..., None]  # 1 - r^2 e^{-2jq}


def _cosine(cos_incidence: Tensor) -> Tensor:
    return cos_incidence.clamp(GRAZING_COSINE, 1.0)


def _layer(cos_incidence: Tensor, eps_c: Tensor) -> tuple[Tensor, Tensor]:
    """kappa [*b], decaying into the layer (Im <= 0), and A [*b 2]."""
    cosine = _cosine(cos_incidence)
    square = (eps_c - 1) + cosine.square()
    square = torch.where(square.abs() < _CRITICAL, torch.full_like(square, _CRITICAL), square)
    kappa = torch.sqrt(square)
    kappa = torch.where(kappa.imag > 0, -kappa, kappa)
    admittance = torch.stack(torch.broadcast_tensors(cosine.to(kappa.dtype), eps_c * cosine), -1)
    return kappa, admittance


def _reflection(kappa: Tensor, admittance: Tensor, cosine: Tensor, eps_c: Tensor) -> Tensor:
    """R [*b 2], with the factor eps_c - 1 of both numerators taken out."""
    square = (kappa[..., None] + admittance).square()
    te = torch.ones_like(eps_c) * -torch.ones_like(cosine)
    tm = 1 - (1 + eps_c) * cosine.square()  # zero at Brewster's angle
    return (eps_c - 1)[..., None] * torch.stack([te, tm], -1) / square


def _expm1(z: Tensor) -> Tensor:
    """e^z - 1 for complex z, accurate near 0 (real and imaginary parts apart)."""
    x, y = z.real, z.imag
    real = torch.expm1(x) * torch.cos(y) - 2 * torch.sin(0.5 * y).square()
    return torch.complex(real, torch.exp(x) * torch.sin(y))
