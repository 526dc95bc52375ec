"""Colours of numbers: one scale for paths and maps, in the viewer and in USD alike."""

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

# Nine colours of matplotlib's "plasma" and "viridis" (CC0): dark is weak, bright is strong. Both rise
# evenly in lightness, so they read in grey and by the colour-blind.
_SCALES = {
    "plasma": (
        (13, 8, 135), (75, 3, 161), (125, 3, 168), (168, 34, 150), (203, 70, 121),
        (229, 107, 93), (248, 148, 65), (253, 195, 40), (240, 249, 33),
    ),
    "viridis": (
        (68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141),
        (39, 173, 129), (92, 200, 99), (170, 220, 50), (253, 231, 37),
    ),
}  # fmt: skip
PATHS, MAP = "plasma", "viridis"


def colours(
    value: Float[ndarray, "*n"], low: float, high: float, scale: str = PATHS
) -> UInt8[ndarray, "*n 3"]:
    """sRGB of finite numbers on a scale from ``low`` to ``high``; what is beyond takes its end's."""
    anchors = np.array(_SCALES[scale], np.float64)
    span = high - low
    at = (value - low) / span if span > 0 else np.ones_like(value)
    at = at.clip(0.0, 1.0) * (len(anchors) - 1)
    below = np.floor(at).astype(np.int64).clip(0, len(anchors) - 2)
    share = (at - below)[..., None]
    mixed = anchors[below] * (1 - share) + anchors[below + 1] * share
    return np.rint(mixed).astype(np.uint8)


def linear(srgb: UInt8[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """Linear RGB in [0, 1], as USD holds colours (IEC 61966-2-1)."""
    x = srgb.astype(np.float64) / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def srgb(rgb: tuple[float, float, float]) -> tuple[int, int, int]:
    """sRGB of one linear colour."""
    x = np.array(rgb).clip(0.0, 1.0)
    y = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    red, green, blue = np.rint(255 * y).astype(int).tolist()
    return red, green, blue


def css(scale: str = PATHS) -> str:
    """A scale as a CSS gradient, weak on the left."""
    stops = ", ".join(f"rgb{colour}" for colour in _SCALES[scale])
    return f"linear-gradient(to right, {stops})"
