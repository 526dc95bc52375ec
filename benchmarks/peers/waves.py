"""What the closed forms are made of: materials, a layer, antennas, boundaries, a ball's spreading."""

import numpy as np
from numpy import ndarray

C = 299_792_458.0  # [m/s]
EPS0 = 8.8541878188e-12  # [F/m], CODATA 2022
ITU = {  # P.2040-4 Table 3: eps_r = a f^b, sigma = c f^d [S/m], f in GHz, below 40 GHz
    "concrete": (5.24, 0.0, 0.0462, 0.7822),
    "brick": (3.91, 0.0, 0.0238, 0.16),
    "wood": (1.99, 0.0, 0.0047, 1.0718),
    "glass": (6.31, 0.0, 0.0036, 1.3394),
    "marble": (7.074, 0.0, 0.0055, 0.9262),
    "vacuum": (1.0, 0.0, 0.0, 0.0),
    "metal": (1.0, 0.0, 1e7, 0.0),
    "conductor": (1.0, 0.0, 1e24, 0.0),  # no row of the Recommendation: as good as perfect
}


def permittivity(itu: str, frequency: float) -> complex:
    a, b, c, d = ITU[itu]
    f = frequency / 1e9
    return a * f**b - 1j * c * f**d / (2 * np.pi * frequency * EPS0)


def layer(cosine: ndarray | float, eps: complex, thickness: float, frequency: float) -> ndarray:
    """[4 ...]: R_TE, R_TM, T_TE, T_TM of one layer, from face to face, at cos(incidence)."""
    k = 2 * np.pi * frequency / C
    root = np.sqrt(eps - (1 - cosine**2) + 0j)
    through = np.exp(-1j * k * thickness * root)  # once through the layer
    out = []
    for r in (
        (cosine - root) / (cosine + root),
        (eps * cosine - root) / (eps * cosine + root),
    ):
        loop = 1 - r**2 * through**2
        out.append((r * (1 - through**2) / loop, (1 - r**2) * through / loop))
    return np.array([out[0][0], out[1][0], out[0][1], out[1][1]])


def antenna(polarization: str, direction: ndarray) -> ndarray:
    """Unit field vector of an isotropic antenna: "V" along growing theta, "H" along growing phi."""
    flat = np.hypot(direction[0], direction[1])
    x, y = (1.0, 0.0) if flat == 0 else direction[:2] / flat
    if polarization == "H":
        return np.array([-y, x, 0.0])
    return np.array([direction[2] * x, direction[2] * y, -flat])


def bent(field: ndarray, k: ndarray, onward: ndarray, n: ndarray, te, tm) -> ndarray:
    """A field vector after a boundary: s across the plane of incidence, p = s x k within it."""
    s = np.cross(k, n)
    if s @ s < 1e-24:
        s = np.cross(k, np.eye(3)[np.argmin(np.abs(k))])
    s = s / np.linalg.norm(s)
    return te * s * (s @ field) + tm * np.cross(s, onward) * (np.cross(s, k) @ field)


def divergence(s1: float, s2: float, cosine: float, radius: float) -> float:
    """Amplitude [1/m] after a ball: s1 to it, s2 from it (Kouyoumjian & Pathak 1974, eqs. 25-27)."""
    a, b = 1 / (1 / s1 + 2 / (radius * cosine)), 1 / (1 / s1 + 2 * cosine / radius)
    return np.sqrt(a * b / ((a + s2) * (b + s2))) / s1
