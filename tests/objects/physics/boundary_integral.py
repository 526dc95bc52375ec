"""The exact field of a line source beside a conducting rectangle: a small boundary integral method.

On a polygon the kernel of the second-kind equations vanishes between points of one side, so plain
Gauss-Legendre panels do, halved towards the corners. With G = H0(2)(kR) / 4j and n outward,

    hard  u/2 - K u = u_i,               u(r) = u_i + int u dG/dn' ds'
    soft  psi/2 + K' psi = du_i/dn,      u(r) = u_i - int G psi ds',  psi = du/dn

(Colton and Kress, Inverse Acoustic and Electromagnetic Scattering Theory, ch. 3). Inside the body
both representations are 0: ``leak`` tells how far that holds, and with it how good the solution is.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import hankel2

POINTS, HALVINGS = 8, 16


def _source(k, place, point):
    """H0(k R) and its gradient."""
    away = point - place
    distance = np.linalg.norm(away, axis=-1)
    slope = -k * hankel2(1, k * distance) / distance
    return hankel2(0, k * distance), slope[..., None] * away


def _side(a, b, panel):
    """Nodes and weights from corner a to corner b, panels at most ``panel`` long."""
    length = np.linalg.norm(b - a)
    fine = length * 0.5 ** np.arange(HALVINGS, 0, -1)
    cuts = np.concatenate([[0.0], fine, length - fine[-2::-1], [length]])
    cuts = np.concatenate(
        [
            np.linspace(x, y, int(np.ceil((y - x) / panel)) + 1)[:-1]
            for x, y in zip(cuts, cuts[1:], strict=False)
        ]
        + [[length]]
    )
    node, weight = np.polynomial.legendre.leggauss(POINTS)
    half, middle = 0.5 * np.diff(cuts), 0.5 * (cuts[1:] + cuts[:-1])
    t = (middle[:, None] + half[:, None] * node).reshape(-1)
    return a + t[:, None] / length * (b - a), (half[:, None] * weight).reshape(-1)


@dataclass
class Rectangle:
    """Corners (left, low) and (right, high) [m]; ``field`` is the total field of a source H0(kR)."""

    k: float
    low: tuple[float, float]
    high: tuple[float, float]
    source: tuple[float, float]
    hard: bool

    def __post_init__(self):
        (x0, y0), (x1, y1) = self.low, self.high
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])  # anticlockwise
        panel = 2 * np.pi / self.k
        sides = [_side(corners[i], corners[(i + 1) % 4], panel) for i in range(4)]
        self.point = np.concatenate([p for p, _ in sides])
        self.weight = np.concatenate([w for _, w in sides])
        normals = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)], dtype=float)
        self.normal = np.repeat(normals, [len(w) for _, w in sides], axis=0)
        side = np.repeat(np.arange(4), [len(w) for _, w in sides])
        other = side[:, None] != side[None]
        u, slope = _source(self.k, np.array(self.source), self.point)
        away = self.point[:, None] - self.point[None]  # r - r'
        distance = np.where(other, np.linalg.norm(away, axis=-1), 1.0)
        # dG/dn' = (k/4j) H1 (r - r').n' / R;  dG/dn = -(k/4j) H1 (r - r').n / R
        kernel = np.where(other, self.k / 4j * hankel2(1, self.k * distance) / distance, 0.0)
        root = np.sqrt(self.weight)
        if self.hard:
            kernel = -kernel * np.einsum("abi,bi->ab", away, self.normal)
            right = u
        else:
            kernel = -kernel * np.einsum("abi,ai->ab", away, self.normal)
            right = (slope * self.normal).sum(-1)
        # weights by halves on both sides: the singular corners then stay well conditioned
        matrix = 0.5 * np.eye(len(root)) + root[:, None] * kernel * root[None]
        self.density = np.linalg.solve(matrix, root * right) / root

    def field(self, point):
        """Total field at points [m 2] outside; inside it should be 0."""
        point = np.asarray(point, dtype=float)
        away = point[:, None] - self.point[None]
        distance = np.linalg.norm(away, axis=-1)
        share = self.weight * self.density
        if self.hard:
            dipole = np.einsum("abi,bi->ab", away, self.normal) / distance
            scattered = self.k / 4j * hankel2(1, self.k * distance) * dipole @ share
        else:
            scattered = -hankel2(0, self.k * distance) / 4j @ share
        return _source(self.k, np.array(self.source), point)[0] + scattered

    def leak(self):
        """Greatest field at places well inside, over the source's own there."""
        t = np.linspace(0.2, 0.8, 7)
        low, high = np.array(self.low), np.array(self.high)
        inside = low + (high - low) * np.stack(np.meshgrid(t, t), -1).reshape(-1, 2)
        own = _source(self.k, np.array(self.source), inside)[0]
        return np.abs(self.field(inside) / own).max()
