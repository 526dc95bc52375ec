"""Diffraction at the edges of boxes of perfect conductor, written out.

Kouyoumjian & Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly
conducting surface", Proc. IEEE 62(11), 1974, here [KP].
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from cases import Block, Case
from numpy import ndarray
from scipy.special import modfresnelm
from waves import C, antenna

N = 1.5  # exterior angle of a box's edge, over pi
# the weights of [KP]'s four terms in the field along the edge (soft) and across it (hard): eq. 25
CONDUCTOR = np.array([[-1, -1, 1, 1], [-1, -1, -1, -1]])


@dataclass(frozen=True)
class Edge:
    """Where a path bends: on which object, the point, and the outward normals of both faces."""

    item: int
    point: ndarray
    normal0: ndarray
    normal1: ndarray


def bending(case: Case, rx: ndarray) -> Iterator[Edge]:
    """The edges that both ends see from outside, at the point of Keller's cone."""
    tx = np.array(case.transmitter)
    for item, block in enumerate(case.standing()):
        if not isinstance(block, Block):
            continue
        low, high = np.array(block.low), np.array(block.high)
        for axis, i, j in product(range(3), (0, 1), (0, 1)):
            across = [(axis + 1) % 3, (axis + 2) % 3]
            point = np.where([i, j], high[across], low[across])
            far = [np.linalg.norm(p[across] - point) for p in (tx, rx)]
            along = (tx[axis] * far[1] + rx[axis] * far[0]) / sum(far)
            normals = np.zeros((2, 3))
            normals[[0, 1], across] = 2 * i - 1, 2 * j - 1
            place = np.empty(3)
            place[axis], place[across] = along, point
            seen = [max((p - place) @ n for n in normals) > 0 for p in (tx, rx)]
            if all(seen) and low[axis] < along < high[axis]:
                yield Edge(item, place, *normals)


def terms(case: Case, edge: Edge, rx: ndarray) -> ndarray:
    """[2 4]: what [KP]'s terms 1 to 4 give of a path's gain, in its soft and its hard component.

    Face 0 is the one the transmitter is nearer to. The path's gain is the sum of ``CONDUCTOR`` times
    these.
    """
    first, last = edge.point - np.array(case.transmitter), rx - edge.point
    s1, s2 = float(np.linalg.norm(first)), float(np.linalg.norm(last))
    k, onward = first / s1, last / s2
    turned = -k @ edge.normal0 < -k @ edge.normal1
    normal0, normal1 = (edge.normal1, edge.normal0) if turned else (edge.normal0, edge.normal1)
    along = np.cross(-normal1, normal0)  # azimuth grows from face 0 towards its normal
    sine = float(np.linalg.norm(np.cross(along, k)))
    phi_in, phi_out = (
        float(np.arctan2(p @ normal0, p @ -normal1)) % (2 * np.pi) for p in (-k, onward)
    )
    wave = 2 * np.pi * case.frequency / C
    reach = wave * s1 * s2 / (s1 + s2) * sine**2
    apart, together = phi_out - phi_in, phi_out + phi_in
    front = -np.exp(-1j * np.pi / 4) / (2 * N * np.sqrt(2 * np.pi * wave) * sine)
    spread = np.sqrt(s1 / (s2 * (s1 + s2))) / s1 / (2 * wave)  # lambda / 4 pi = 1 / 2k
    each = [_term(b, sign, reach) for b in (apart, together) for sign in (1, -1)]
    sent = antenna(case.polarization, k)
    got = antenna(case.receiver_polarization or case.polarization, -onward)
    hard = [_unit(np.cross(along, x)) for x in (-k, onward)]
    soft = [np.cross(k, hard[0]), np.cross(onward, hard[1])]
    share = np.array([(sent @ v) * (w @ got) for v, w in (soft, hard)])
    return share[:, None] * front * spread * np.array(each)


def _term(angle: float, sign: int, reach: float) -> complex:
    """cot((pi +- angle) / 2n) F(reach a(angle)): [KP] eqs. 25 to 27."""
    turns = np.round((angle + sign * np.pi) / (2 * np.pi * N))
    x = np.sqrt(2 * reach) * abs(np.cos(N * np.pi * turns - angle / 2))
    transition = 2j * x * np.exp(1j * x**2) * modfresnelm(x)[0]
    return transition / np.tan((np.pi + sign * angle) / (2 * N))


def _unit(v: ndarray) -> ndarray:
    return v / np.linalg.norm(v)
