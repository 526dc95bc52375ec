"""Antenna patterns as pure functions: a unit direction in the radio's own frame -> amplitude gain.

The amplitude is the real sqrt(G), with G the gain over isotropic of a lossless antenna. Directions
point away from the antenna, theta from +z and phi from +x (3GPP TR 38.901 section 7.1): dipoles lie
along z, the 38.901 element looks along +x.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Pattern = Callable[[Tensor], Tensor]

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
    x, y, z = direction.unbind(-1)
    sine = _sine(direction)
    on_axis = sine < ON_AXIS
    x = torch.where(on_axis, torch.ones_like(x), x)
    azimuth = torch.rad2deg(torch.atan2(torch.where(on_axis, torch.zeros_like(y), y), x))
    zenith = torch.rad2deg(torch.atan2(sine, z))
    vertical = (12.0 * ((zenith - 90.0) / ELEMENT_WIDTH_DEG) ** 2).clamp(max=ELEMENT_FLOOR_DB)
    horizontal = (12.0 * (azimuth / ELEMENT_WIDTH_DEG) ** 2).clamp(max=ELEMENT_FLOOR_DB)
    loss = (vertical + horizontal).clamp(max=ELEMENT_FLOOR_DB)
    return 10.0 ** ((ELEMENT_GAIN_DB - loss) / 20.0)


PATTERNS: dict[str, Pattern] = {
    "isotropic": isotropic,
    "short_dipole": short_dipole,
    "half_wave_dipole": half_wave_dipole,
    "tr38901": tr38901,
}


def _sine(direction: Tensor) -> Tensor:
    """sin(theta), with gradient zero (not NaN) on the axis."""
    square = direction[..., 0] ** 2 + direction[..., 1] ** 2
    on_axis = square == 0
    root = torch.sqrt(torch.where(on_axis, torch.ones_like(square), square))
    return torch.where(on_axis, torch.zeros_like(square), root)
