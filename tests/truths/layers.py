"""A dielectric wall: T of its layer, and the exact field of a point source behind it."""

import math

import numpy as np
from scipy.special import j0

from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.scene import Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, radio

C = 299_792_458.0
EPS0 = 8.8541878188e-12
DIRECT = Quality(depth=0, diffraction=0, floor_db=-300.0)
CONCRETE = {"eps_r": 5.24, "sigma": 0.15}
WALLS = {"slab": lambda d: Slab(d, **CONCRETE), "solid": lambda d: Solid(**CONCRETE)}


def eps_of(f, eps_r=5.24, sigma=0.15):
    return eps_r - 1j * sigma / (2 * math.pi * f * EPS0)


def wall_scene(surface, angle_deg, thickness=0.1, half_way=3.0, polarization="none"):
    """Through a wide wall across x at an angle; the plane of incidence is level, so V is TE."""
    lean = half_way * math.tan(math.radians(angle_deg))
    node = box_node("/wall", (0, 0, 0), (thickness / 2, 500.0, 500.0), surface)
    tx = radio("/t", -half_way, -lean, 0.0, polarization=polarization)
    rx = radio("/r", half_way, lean, 0.0, polarization=polarization)
    return Scene((node,), (tx,), (rx,))


def transfer_matrix(sine, cosine, eps, d, f):
    """(R, T face to face) for TE and TM, at k_t = k sine and k_n = k cosine: interface and
    propagation matrices of waves to and fro multiplied out (Yeh, Optical Waves in Layered Media, 5.1)."""
    k0 = 2 * math.pi * f / C
    kappa = np.sqrt(eps - sine**2 + 0j)
    kappa = np.where(kappa.imag > 0, -kappa, kappa)
    out = []
    for y0, y1 in ((cosine, kappa), (cosine, kappa / eps)):
        enter = np.array([[y0 + y1, y0 - y1], [y0 - y1, y0 + y1]]) / (2 * y0)
        leave = np.array([[y1 + y0, y1 - y0], [y1 - y0, y1 + y0]]) / (2 * y1)
        way = np.exp(1j * k0 * d * kappa)
        zero = np.zeros_like(way)
        m = np.einsum(
            "ij...,jk...,kl...->il...", enter, np.array([[way, zero], [zero, 1 / way]]), leave
        )
        out.append((m[1, 0] / m[0, 0], 1 / m[0, 0]))
    return out


def panels(low, high, count):
    """Nodes and weights of Gauss's 20-point rule on each of many panels."""
    x, w = np.polynomial.legendre.leggauss(20)
    edge = np.linspace(low, high, count + 1)
    half = 0.5 * np.diff(edge)[:, None]
    return (edge[:-1, None] + half * (x + 1)).ravel(), (half * w).ravel()


def sommerfeld(f, d, rho, height):
    """exp(-jkr)/r through a layer of concrete, times r exp(+jkr): plane-wave spectrum, TE (Chew, Waves
    and Fields in Inhomogeneous Media, Eq. 2.2.30). In the visible range k_rho = k sin a, beyond it
    k_rho = k cosh b; Gauss-Legendre, which has settled: see the vacuum's own error."""
    k = 2 * math.pi * f / C
    count = 100 + int(k * math.hypot(rho, height) / 20)  # 20 nodes for at most 20 rad of phase
    a, wa = panels(0.0, math.pi / 2, count)
    b, wb = panels(0.0, 40.0 / (k * height), count)
    sine = np.concatenate([np.sin(a), np.cosh(b)])
    root = np.concatenate([np.cos(a) + 0j, -1j * np.sinh(b)])
    weight = np.concatenate([wa + 0j, 1j * wb]) * sine
    layer = (
        transfer_matrix(sine, root, eps_of(f), d, f)[0][1] * np.exp(1j * k * d * root) if d else 1.0
    )
    spectrum = j0(k * rho * sine) * np.exp(-1j * k * height * root) * weight
    r = math.hypot(rho, height)
    return -1j * k * np.sum(spectrum * layer) * r * np.exp(1j * k * r)


def relative(angle, f, d):
    """T of the layer relative to free space, TE, at an angle [rad]."""
    sine, cosine = np.sin(angle), np.cos(angle)
    face_to_face = transfer_matrix(sine, cosine, eps_of(f), d, f)[0][1]
    return face_to_face * np.exp(2j * math.pi * f / C * d * cosine)


def second_term(angle, f, d, r):
    """What follows T in the field of a point source: (j / 2 k r) times T's Laplacian on the sphere of
    directions, for a spherical wave of order l falls short of its limit by j l (l + 1) / 2 k r
    (Abramowitz and Stegun 10.1.9)."""
    h = 1e-4
    low, mid, high = (relative(np.float64(angle + s), f, d) for s in (-h, 0.0, h))
    bend, slope = (low - 2 * mid + high) / h**2, (high - low) / (2 * h)
    turning = bend if angle == 0 else slope / math.tan(angle)
    return 1j / (4 * math.pi * f / C * r) * (bend + turning)


def seen_at(angle_deg, half_way):
    """(rho, height, r) [m] of a receiver as far behind a wall as the source is before it."""
    height = 2 * half_way
    rho = height * math.tan(math.radians(angle_deg))
    return rho, height, math.hypot(rho, height)


def through(surface, angle_deg, f, d, half_way):
    """What the tracer has instead of ``sommerfeld``: TE, relative to free space."""
    r = seen_at(angle_deg, half_way)[2]
    free = C / f / (4 * math.pi * r) * np.exp(-2j * math.pi * ((f * r / C) % 1.0))
    result = simulate(wall_scene(surface, angle_deg, d, half_way, "V"), f, DIRECT)
    return complex(result.transfer()[0, 0, 0]) / free
