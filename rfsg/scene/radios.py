"""Transmitters and receivers: prims with a place, an aim and an antenna."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.scene.pose import Pose


@dataclass(frozen=True)
class Radio:
    """A transmitter or a receiver.

    rotation: world_from_radio, columns are the radio's axes in the world; +x is the boresight and
    +z is up in the radio's own frame (3GPP TR 38.901 section 7.1: theta from +z, phi from +x).
    power_dbm: transmit power [dBm] (receivers ignore it). frequency: [Hz], or None to follow the
    scene. pattern: a name in ``rfsg.scene.antennas.PATTERNS``. polarization: "none" (scalar), "V"
    or "H". velocity: [m/s], world.
    """

    path: str
    position: Float[Tensor, "3"]
    rotation: Float[Tensor, "3 3"]
    velocity: Float[Tensor, "3"]
    power_dbm: float = 0.0
    frequency: float | None = None
    pattern: str = "isotropic"
    polarization: str = "none"

    @staticmethod
    def at(path: str, x: float, y: float, z: float, yaw_deg: float = 0.0, **fields: Any) -> "Radio":
        """A still radio at (x, y, z) metres, turned about +z by ``yaw_deg``; more by field name."""
        pose = Pose.at(x, y, z, yaw_deg)
        still = torch.zeros(3, dtype=torch.float64)
        return Radio(path, pose.translation, pose.rotation, **{"velocity": still, **fields})
