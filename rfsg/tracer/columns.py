"""Vectors as three columns: x, y and z each one contiguous tensor.

A sum or a maximum over the last three numbers of a row is the slowest thing that torch does to points;
over three columns it is two additions of long vectors.
"""

import torch
from torch import Tensor

Columns = tuple[Tensor, Tensor, Tensor]  # x, y, z, of one shape


def columns(vector: Tensor) -> Columns:
    """The columns of vectors [*b 3]."""
    x, y, z = vector.movedim(-1, 0).contiguous().unbind(0)
    return x, y, z


def dot(a: Columns, b: Columns) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Columns, b: Columns) -> Columns:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def moved(point: Columns, by: Tensor, along: Columns) -> Columns:
    """point + by * along."""
    return (
        point[0] + by * along[0],
        point[1] + by * along[1],
        point[2] + by * along[2],
    )


def minus(a: Columns, b: Columns) -> Columns:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def at(vector: Columns, i: Tensor) -> Columns:
    """Rows ``i``."""
    return vector[0][i], vector[1][i], vector[2][i]


def chosen(condition: Tensor, a: Columns, b: Columns) -> Columns:
    """a where the condition holds, else b."""
    return (
        torch.where(condition, a[0], b[0]),
        torch.where(condition, a[1], b[1]),
        torch.where(condition, a[2], b[2]),
    )
