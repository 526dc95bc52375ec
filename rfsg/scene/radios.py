"""Transmitters and receivers: prims with a place, an aim and antennas."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.scene.antennas import PATTERNS, POLARIZATIONS, SLANTS
from rfsg.scene.arrays import Array
from rfsg.scene.errors import SceneError
from rfsg.scene.patterns import Pattern
from rfsg.scene.pose import Pose


@dataclass(frozen=True)
class Radio:
    """A transmitter or a receiver.

    rotation: world_from_radio, columns are the radio's axes in the world; +x is the boresight and
    +z is up in the radio's own frame (3GPP TR 38.901 section 7.1: theta from +z, phi from +x).
    power_dbm: transmit power [dBm] (receivers ignore it). frequency: [Hz], or None to follow the
    scene. pattern: a name in ``rfsg.scene.antennas.PATTERNS``, or a measured one. polarization:
    "none" (scalar), "V", "H", "+45", "-45", or the pairs of ports "VH" and "cross" (+45, -45).
    velocity: [m/s], world. array: places of its elements; None is one element at the position.

    Raises SceneError for a pattern or a polarization of another name.
    """

    path: str
    position: Float[Tensor, "3"]
    rotation: Float[Tensor, "3 3"]
    velocity: Float[Tensor, "3"]
    power_dbm: float = 0.0
    frequency: float | None = None
    pattern: str | Pattern = "isotropic"
    polarization: str = "none"
    array: Array | None = None

    def __post_init__(self) -> None:
        for name, known in (("pattern", PATTERNS), ("polarization", POLARIZATIONS)):
            value = getattr(self, name)
            if isinstance(value, str) and value not in known:
                names = ", ".join(known)
                raise SceneError([f"{self.path}: {name} is {value!r}; expected one of {names}"])

    @staticmethod
    def at(path: str, x: float, y: float, z: float, yaw_deg: float = 0.0, **fields: Any) -> "Radio":
        """A still radio at (x, y, z) metres, turned about +z by ``yaw_deg``; more by field name."""
        pose = Pose.at(x, y, z, yaw_deg)
        still = torch.zeros(3, dtype=torch.float64)
        return Radio(path, pose.translation, pose.rotation, **{"velocity": still, **fields})


def amplitude(radio: Radio, direction_radio: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """sqrt(G) of a radio's pattern along unit directions in its own frame, whatever polarisation."""
    if isinstance(radio.pattern, Pattern):
        return radio.pattern.amplitude(direction_radio)
    return PATTERNS[radio.pattern](direction_radio)


def field_components(
    radio: Radio, direction_radio: Float[Tensor, "*b 3"]
) -> Complex[Tensor, "*b ports 2"]:
    """(theta, phi) field of each polarisation port along unit directions in the radio's own frame.

    The pattern's field, turned by the port's slant (model 2 of 3GPP TR 38.901 section 7.3.2). A
    pattern of gains alone is a theta field: F_theta = F cos zeta, F_phi = F sin zeta; a measured field
    is that of slant 0, and a second port has the same field across. |F|^2 is the gain over isotropic.
    "none" gives its amplitude as V, which is what it counts as beside a polarised radio.
    """
    if isinstance(radio.pattern, Pattern):
        field = radio.pattern.field(direction_radio)
    else:
        gain = PATTERNS[radio.pattern](direction_radio)
        field = torch.stack([gain, torch.zeros_like(gain)], -1)
        field = field.to(gain.dtype.to_complex())
    slants = [SLANTS[port] for port in POLARIZATIONS[radio.polarization]]
    cos, sin = torch.tensor(slants, dtype=field.dtype, device=field.device).unbind(-1)
    theta, phi = field[..., None, 0], field[..., None, 1]
    return torch.stack([cos * theta - sin * phi, sin * theta + cos * phi], -1)


def port_names(radio: Radio) -> tuple[str, ...]:
    """POLARISATION:ELEMENT of every port, polarisation slowest.

    That is the order of the codebooks of 3GPP TS 38.214 section 5.2.2.2.1: all elements of the first
    polarisation in the array's order, then all of the second.
    """
    elements = range(1 if radio.array is None else len(radio.array))
    return tuple(f"{p}:{e}" for p in POLARIZATIONS[radio.polarization] for e in elements)
