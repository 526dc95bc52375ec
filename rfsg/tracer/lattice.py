"""Directions spread evenly over the sphere: all at once, or in rounds that fill one another's gaps."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

HALVINGS = 3  # the first round takes an eighth; a sixteenth of the lattice would leave holes
FEWEST = 250  # directions in a first round, at least: fewer are no evidence


def fibonacci(count: int, device: torch.device | str = "cpu") -> Float[Tensor, "count 3"]:
    """Nearly even directions on the sphere (Gonzalez 2010, 'Measurement of areas on a sphere')."""
    i = torch.arange(count, dtype=torch.float64, device=device) + 0.5
    z = 1.0 - 2.0 * i / count
    r = torch.sqrt((1.0 - z) * (1.0 + z))
    angle = torch.pi * (3.0 - 5.0**0.5) * i
    return torch.stack([r * torch.cos(angle), r * torch.sin(angle), z], -1)


def spacing(count: int) -> float:
    """Angle between neighbours of so many directions [rad]: each speaks for its square."""
    return math.sqrt(4.0 * math.pi / count)


def rounds(count: int) -> list[slice]:
    """A lattice of so many directions in rounds, each as many as all before it: its sub-lattices.

    Every 8th direction, those halfway between them, then every 4th of the rest, and all others. A
    round and those before it are an even lattice by themselves: no direction is further from it than
    1.5 of its own spacings.
    """
    stride = 1
    while stride < 2**HALVINGS and count // (2 * stride) >= FEWEST:
        stride *= 2
    out = [slice(0, count, stride)]
    while stride > 1:
        out.append(slice(stride // 2, count, stride))
        stride //= 2
    return out
