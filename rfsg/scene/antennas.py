"""Antenna patterns as pure functions: a unit direction in the radio's own frame -> amplitude gain.

The amplitude is the real sqrt(G), with G the gain over isotropic of a lossless antenna. Directions
point away from the antenna, theta from +z and phi from +x (3GPP TR 38.901 section 7.1): dipoles lie
along z, the 38.901 element looks along +x.

Polarisation is model 2 of TR 38.901 section 7.3.2: a slant zeta turns the field in the plane across
the direction, F_theta = F cos zeta and F_phi = F sin zeta, and leaves the pattern alone. Model 1
slants the antenna itself, pattern and all; the two agree along the boresight. Model 2 is taken because
its two ports are orthogonal and of equal power in every direction, and because a pattern that was
measured on a slanted antenna holds the slant's effect on the gain already.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Amplitude = Callable[[Tensor], Tensor]

SHORT_DIPOLE_DIRECTIVITY = 1.5  # Balanis, Antenna Theory, section 4.2
HALF_WAVE_DIRECTIVITY = 1.6409223769845853  # 4 / Cin(2 pi), Balanis section 4.6
ELEMENT_GAIN_DB = 8.0  # 3GPP TR 38.901 Table 7.3-1: G_E,max
ELEMENT_WIDTH_DEG = 65.0  # theta_3dB = phi_3dB
ELEMENT_FLOOR_DB = 30.0  # SLA_V = A_max
ON_AXIS = 1e-12  # [rad] nearer to the z axis the azimuth of a rounded direction means nothing


def isotropic(direction: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """1 everywhere."""
    return torch.ones_like(direction[..., 0])


def short_dipole(direction: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """sqrt(3/2) sin(theta)."""
    return math.sqrt(SHORT_DIPOLE_DIRECTIVITY) * _sine(direction)


def half_wave_dipole(direction: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """sqrt(D) cos(pi/2 cos theta) / sin(theta), D = 1.6409.

    With s = 1 - |cos theta| the quotient is pi/2 sin(theta) sinc(s/2) / (1 + |cos theta|), which
    divides by nothing small at the poles.
    """
    up = direction[..., 2].abs()
    taper = torch.sinc((1.0 - up) / 2.0) / (1.0 + up)
    return math.sqrt(HALF_WAVE_DIRECTIVITY) * (math.pi / 2.0) * _sine(direction) * taper


def tr38901(direction: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """The antenna element of 3GPP TR 38.901 Table 7.3-1: 8 dBi, 65 degrees wide, 30 dB floor.

    The table's pattern is not lossless: its mean gain over the sphere is 0.657, not 1. On the z
    axis, where the azimuth is undefined, azimuth 0 is taken.
    """
    zenith, azimuth = (torch.rad2deg(angle) for angle in angles(direction))
    vertical = (12.0 * ((zenith - 90.0) / ELEMENT_WIDTH_DEG) ** 2).clamp(max=ELEMENT_FLOOR_DB)
    horizontal = (12.0 * (azimuth / ELEMENT_WIDTH_DEG) ** 2).clamp(max=ELEMENT_FLOOR_DB)
    loss = (vertical + horizontal).clamp(max=ELEMENT_FLOOR_DB)
    return 10.0 ** ((ELEMENT_GAIN_DB - loss) / 20.0)


PATTERNS: dict[str, Amplitude] = {
    "isotropic": isotropic,
    "short_dipole": short_dipole,
    "half_wave_dipole": half_wave_dipole,
    "tr38901": tr38901,
}


# each token: the single polarisations of its ports, in order
POLARIZATIONS: dict[str, tuple[str, ...]] = {
    "none": ("none",),
    "V": ("V",),
    "H": ("H",),
    "+45": ("+45",),
    "-45": ("-45",),
    "VH": ("V", "H"),
    "cross": ("+45", "-45"),
}
# (cos zeta, sin zeta) of each; "none", where a polarised radio stands beside it, counts as V
SLANTS: dict[str, tuple[float, float]] = {
    "none": (1.0, 0.0),
    "V": (1.0, 0.0),
    "H": (0.0, 1.0),
    "+45": (math.sqrt(0.5), math.sqrt(0.5)),
    "-45": (math.sqrt(0.5), -math.sqrt(0.5)),
}


def angles(direction: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """(theta, phi) [rad] of unit directions: theta in [0, pi], phi in (-pi, pi].

    On the z axis, where the azimuth is undefined, phi is 0, and so is its gradient.
    """
    x, y, z = direction.unbind(-1)
    sine = _sine(direction)
    on_axis = sine < ON_AXIS
    x = torch.where(on_axis, torch.ones_like(x), x)
    y = torch.where(on_axis, torch.zeros_like(y), y) + 0.0  # -0 would turn pi into -pi
    return torch.atan2(sine, z), torch.atan2(y, x)


def basis(direction: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2 3"]:
    """Rows theta-hat and phi-hat at unit directions (3GPP TR 38.901 section 7.1).

    On the z axis those of phi = 0: phi-hat is +y.
    """
    x, y, z = direction.unbind(-1)
    sine = _sine(direction)
    on_axis = sine < ON_AXIS
    safe = torch.where(on_axis, torch.ones_like(sine), sine)
    cos_phi = torch.where(on_axis, torch.ones_like(x), x / safe)
    sin_phi = torch.where(on_axis, torch.zeros_like(y), y / safe)
    theta_hat = torch.stack([z * cos_phi, z * sin_phi, -sine], -1)
    phi_hat = torch.stack([-sin_phi, cos_phi, torch.zeros_like(sine)], -1)
    return torch.stack([theta_hat, phi_hat], -2)


def _sine(direction: Tensor) -> Tensor:
    """sin(theta), with gradient zero (not NaN) on the axis."""
    square = direction[..., 0] ** 2 + direction[..., 1] ** 2
    on_axis = square == 0
    root = torch.sqrt(torch.where(on_axis, torch.ones_like(square), square))
    return torch.where(on_axis, torch.zeros_like(square), root)
