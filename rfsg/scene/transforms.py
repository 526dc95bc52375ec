"""4x4 matrices to rotation, translation and scales, or the reason why not.

Tolerances are relative. A rotation that came through single-precision quaternions or was typed with
six digits is off by about 1e-6, so up to ``TOLERANCE`` a frame is straightened, not refused.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from rfsg.scene.pose import Pose

TOLERANCE = 1e-5
ALREADY_STRAIGHT = 1e-14  # rounding of a matrix product: leave such a frame bit by bit as it is
SMALLEST_SCALE_RATIO = 1e-9  # below it a matrix flattens: its inverse has lost half the digits
LARGEST_SCALE = 1e100  # and its inverse: squares of what lies between are numbers


@dataclass(frozen=True)
class Placement:
    """point_world = rotation @ (scales * point_local) + translation; determinant -1 mirrors."""

    rotation: Float64[ndarray, "3 3"]
    translation: Float64[ndarray, "3"]
    scales: Float64[ndarray, "3"]

    def even(self, *axes: int) -> bool:
        """Whether the given axes (all by default) are scaled alike."""
        scales = self.scales[list(axes)] if axes else self.scales
        return bool(np.ptp(scales) <= TOLERANCE * scales.max())

    def uniform(self, *axes: int) -> float:
        """The common scale of the given axes (all by default); ValueError if they differ."""
        if not self.even(*axes):
            raise ValueError(f"scaled differently along its axes ({_digits(self.scales)})")
        scales = self.scales[list(axes)] if axes else self.scales
        return float(scales[0] if np.ptp(scales) == 0 else scales.mean())

    def pose(self, scale: float = 1.0) -> Pose:
        return Pose(
            torch.from_numpy(self.rotation.copy()),
            torch.from_numpy(self.translation.copy()),
            torch.tensor(scale, dtype=torch.float64),
        )


def broken(matrix: Float64[ndarray, "4 4"]) -> str | None:
    """Why a matrix places nothing (not finite, projective, singular), or None."""
    if not np.isfinite(matrix).all():
        return "the transform holds numbers that are not finite"
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        return "the transform is projective (its last column is not 0, 0, 0, 1)"
    values = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not values[-1] > SMALLEST_SCALE_RATIO * values[0]:
        return f"the transform is singular: it scales by {_digits(values)}"
    if not 1 / LARGEST_SCALE < values[-1] <= values[0] < LARGEST_SCALE:
        return f"the transform scales by {_digits(values)}: beyond what can be squared"
    return None


def decompose(matrix: Float64[ndarray, "4 4"]) -> Placement:
    """Rotation, translation and a scale along each local axis of a column-vector matrix.

    Raises ValueError for what is ``broken`` or sheared.
    """
    if reason := broken(matrix):
        raise ValueError(reason)
    linear = matrix[:3, :3]
    scales = np.sqrt((linear**2).sum(0))
    frame = linear / scales
    off = np.abs(frame.T @ frame - np.eye(3)).max()
    if off > TOLERANCE:
        raise ValueError(
            "the transform is sheared (a turned child of an unevenly scaled parent is): "
            f"its axes are {np.degrees(np.arcsin(min(1.0, off))):.3g} degrees from square"
        )
    return Placement(_straight(frame, off), matrix[:3, 3].copy(), scales)


def _straight(frame: ndarray, off: float) -> ndarray:
    """The nearest orthonormal frame (polar decomposition)."""
    if off <= ALREADY_STRAIGHT:
        return frame
    u, _, vt = np.linalg.svd(frame)
    return u @ vt


def _digits(values: ndarray) -> str:
    return ", ".join(f"{v:.6g}" for v in values)
