"""Rigid pose with uniform scale, mirrors allowed: where an object stands in the world."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Pose:
    """point_world = scale * rotation @ point_object + translation (float64 throughout).

    ``rotation`` is orthonormal; determinant -1 is a mirror. ``scale`` is uniform and positive: a
    distance stays a distance. Differentiable: any field may carry a gradient.
    """

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: Float[Tensor, ""]

    @staticmethod
    def identity() -> "Pose":
        one = torch.ones((), dtype=torch.float64)
        return Pose(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), one)

    @staticmethod
    def at(x: float, y: float, z: float, yaw_deg: float = 0.0, scale: float = 1.0) -> "Pose":
        """A pose at (x, y, z) metres, turned about +z by ``yaw_deg`` degrees."""
        yaw = torch.deg2rad(torch.tensor(float(yaw_deg), dtype=torch.float64))
        c, s, o, i = torch.cos(yaw), torch.sin(yaw), torch.zeros_like(yaw), torch.ones_like(yaw)
        rotation = torch.stack([c, -s, o, s, c, o, o, o, i]).reshape(3, 3)
        translation = torch.tensor([float(x), float(y), float(z)], dtype=torch.float64)
        return Pose(rotation, translation, torch.tensor(float(scale), dtype=torch.float64))

    def point_world(self, point_object: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        return self.scale * (point_object @ self.rotation.T) + self.translation

    def point_object(self, point_world: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        return ((point_world - self.translation) @ self.rotation) / self.scale

    def direction_world(self, direction_object: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Rotates directions, normals and gradients alike (the scale is left out)."""
        return direction_object @ self.rotation.T

    def direction_object(self, direction_world: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        return direction_world @ self.rotation

    def compose(self, inner: "Pose") -> "Pose":
        """world_from_inner = world_from_self . self_from_inner."""
        return Pose(
            self.rotation @ inner.rotation,
            self.point_world(inner.translation),
            self.scale * inner.scale,
        )
