"""Mitsuba's transforms: what is written first acts first."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy import ndarray

Value = Callable[..., str]


def transform_of(element: ET.Element | None, value: Value) -> Float[ndarray, "4 4"]:
    """The matrix [m] of a ``<transform>``; the identity without one. ``value`` looks attributes up.

    Raises ValueError for steps of other kinds and for matrices that are singular or projective."""
    whole = np.eye(4)
    for step in element if element is not None else ():
        if step.tag not in STEPS:
            raise ValueError(f"<{step.tag}> in a transform; read are {', '.join(STEPS)}")
        whole = STEPS[step.tag](step, value) @ whole
    affine = np.isfinite(whole).all() and np.allclose(whole[3], [0, 0, 0, 1])
    if not affine or not np.linalg.svd(whole[:3, :3])[1].min() > 1e-12:
        raise ValueError("its transform is singular, projective or not finite")
    return whole


def _vector(step: ET.Element, value: Value, fallback: float) -> ndarray:
    """x, y, z, or ``value`` with one or three numbers."""
    given = value(step)
    if given:
        numbers = np.array([float(w) for w in given.replace(",", " ").split()])
        if len(numbers) not in (1, 3):
            raise ValueError(f"{given!r} in a transform; expected one number or three")
        return np.broadcast_to(numbers, 3)
    return np.array([float(value(step, axis) or fallback) for axis in "xyz"])


def _translate(step: ET.Element, value: Value) -> ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = _vector(step, value, 0.0)
    return matrix


def _scale(step: ET.Element, value: Value) -> ndarray:
    return np.diag([*_vector(step, value, 1.0), 1.0])


def _rotate(step: ET.Element, value: Value) -> ndarray:
    """Rodrigues' formula, about an axis through the origin, counter-clockwise in degrees."""
    axis = np.array([float(value(step, a) or 0.0) for a in "xyz"])
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise ValueError("a rotation without an axis")
    x, y, z = axis / length
    turn = math.radians(float(value(step, "angle") or 0.0))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += math.sin(turn) * cross + (1 - math.cos(turn)) * cross @ cross
    return matrix


def _matrix(step: ET.Element, value: Value) -> ndarray:
    numbers = [float(w) for w in value(step).replace(",", " ").split()]
    if len(numbers) == 9:
        matrix = np.eye(4)
        matrix[:3, :3] = np.reshape(numbers, (3, 3))
        return matrix
    if len(numbers) != 16:
        raise ValueError(f"a matrix of {len(numbers)} numbers; expected 16, or 9")
    return np.reshape(numbers, (4, 4))


STEPS = {"translate": _translate, "scale": _scale, "rotate": _rotate, "matrix": _matrix}
