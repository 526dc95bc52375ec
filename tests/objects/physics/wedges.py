"""Conducting wedges and a thick screen: exact fields of a line source, and those of rays with UTD."""

import math

import numpy as np
import torch
from scipy.special import hankel2, jv

from tests.objects.physics import wedge_twin
from tests.objects.physics.boundary_integral import Rectangle

F64, C128 = torch.float64, torch.complex128
PI = math.pi


def real(x):
    return torch.as_tensor(x, dtype=F64)


def pair(soft, hard):
    return torch.tensor([soft, hard], dtype=C128)


METAL, NOTHING = pair(-1, 1), pair(0, 0)


def metal(phi_in, phi_out, n, s_in, s_out, k, beta0=PI / 2):
    """(soft, hard) of a perfect conductor."""
    geometry = [real(a) for a in (phi_in, phi_out, beta0, n, s_in, s_out, k)]
    return wedge_twin.wedge_coefficients(*geometry, *(METAL, METAL, NOTHING))


def metal_slope(phi_in, phi_out, n, s_in, s_out, k):
    geometry = [real(a) for a in (phi_in, phi_out, PI / 2, n, s_in, s_out, k)]
    return wedge_twin.slope_coefficients(*geometry, *(METAL, METAL, NOTHING))


def wedge_series(k, rho_in, phi_in, rho_out, phi_out, n, hard):
    """Line source H0(k R) by a conducting wedge: the eigenfunction series (Balanis 2012, 14.5)."""
    low, high = min(rho_in, rho_out), max(rho_in, rho_out)
    m = np.arange(int(n * (k * low + 40)) + 60)
    radial = np.where(m == 0, 1, 2) / n * jv(m / n, k * low) * hankel2(m / n, k * high)
    difference = np.cos(m / n * (phi_out - phi_in)[:, None])
    total = np.cos(m / n * (phi_out + phi_in)[:, None])
    return (radial * (difference + (1 if hard else -1) * total)).sum(1)


def wedge_rays(k, rho_in, phi_in, rho_out, phi_out, n, hard):
    """Direct ray, reflections and diffraction of the same wedge."""
    sign = 1 if hard else -1

    def wave(angle):
        distance = np.sqrt(rho_in**2 + rho_out**2 - 2 * rho_in * rho_out * np.cos(angle))
        return hankel2(0, k * distance)

    total = wave(phi_out - phi_in) * (np.abs(phi_out - phi_in) <= PI)
    total = total + sign * wave(phi_out + phi_in) * (phi_out + phi_in <= PI)
    image_n = 2 * n * PI - phi_out - phi_in
    total = total + sign * wave(image_n) * (image_n <= PI)
    d = metal(phi_in, phi_out, n, rho_in, rho_out, k).numpy()[:, hard]
    return total + hankel2(0, k * rho_in) * d * np.exp(-1j * k * rho_out) / np.sqrt(rho_out)


def wedge_error(k, rho_in, rho_out, n, hard):
    """Worst difference of the rays from the series all about the wedge, for three azimuths of the
    source, in free fields at rho_in + rho_out."""
    phi = np.linspace(0.0, n * PI, 181)
    worst = 0.0
    for phi_in in (0.4, 1.3, 1.01 * n * PI / 2):
        exact = wedge_series(k, rho_in, phi_in, rho_out, phi, n, hard)
        ours = wedge_rays(k, rho_in, phi_in, rho_out, phi, n, hard)
        worst = max(worst, np.abs(ours - exact).max() / abs(hankel2(0, k * (rho_in + rho_out))))
    return worst


# two edges: a thick screen

WIDTH, HEIGHT = 2.34, 6.28  # [m], as far from interior resonances (4 k^2) as such sizes get
CORNERS = {  # place, direction of the face in common, direction away from it
    "A": ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)),
    "B": ((WIDTH, 0.0), (-1.0, 0.0), (0.0, 1.0)),
    "C": ((0.0, -HEIGHT), (1.0, 0.0), (0.0, -1.0)),
    "D": ((WIDTH, -HEIGHT), (-1.0, 0.0), (0.0, -1.0)),
}
SOURCE = (-5.0, -1.5)
BEHIND = [(6.0, -4.0), (6.0, -3.0), (6.0, -2.0), (6.0, -1.0), (12.0, -3.0)]  # sees B and D
ABOVE = [(6.0, 1.0), (6.0, 2.0), (1.0, 3.0)]  # sees A and B, the last two the source


def _seen_from(corner, point):
    place, along, out = (np.array(v) for v in CORNERS[corner])
    away = np.array(point) - place
    return math.atan2(away @ out, away @ along) % (2 * PI), float(np.linalg.norm(away))


def around_screen(k, receiver, slopes=True, source=SOURCE):
    """Field (soft, hard) behind the screen: direct, A, A then B, C then D."""
    total = np.zeros(2, dtype=complex)
    away = np.array(receiver) - source
    if source[1] - source[0] * away[1] / away[0] > 0:  # passes above A
        total += hankel2(0, k * np.linalg.norm(away))
    if receiver[1] > 0:
        (phi_in, s_in), (phi_out, s_out) = _seen_from("A", source), _seen_from("A", receiver)
        d = metal(phi_in, phi_out, 1.5, s_in, s_out, k).numpy()
        total += hankel2(0, k * s_in) * d * np.exp(-1j * k * s_out) / np.sqrt(s_out)
    for first, second in (("A", "B"), ("C", "D")):
        if receiver[0] < WIDTH and first == "C":
            continue  # out of sight of D
        (phi_in, s_in), (phi_out, s_out) = _seen_from(first, source), _seen_from(second, receiver)
        zero = pair(0, 0)
        d = wedge_twin.along_face(
            metal(phi_in, 0.0, 1.5, s_in, WIDTH, k),
            metal(0.0, phi_out, 1.5, WIDTH, s_out, k),
            metal_slope(0.0, phi_in, 1.5, WIDTH, s_in, k) if slopes else zero,
            metal_slope(0.0, phi_out, 1.5, WIDTH, s_out, k) if slopes else zero,
            *(real(a) for a in (PI / 2, PI / 2, WIDTH, k)),
        ).numpy()
        travelled = np.exp(-1j * k * (WIDTH + s_out)) / math.sqrt(WIDTH * s_out)
        total += hankel2(0, k * s_in) * d * travelled
    return total


def _screen(k, hard, source):
    return Rectangle(k, (0.0, -HEIGHT), (WIDTH, 0.0), source, bool(hard))


def screen_errors(k, hard):
    """Of the rays about the screen, against the boundary integral: the worst in free fields, the worst
    in the shadow in fields there, and the integral's own."""
    points = BEHIND + ABOVE
    free = hankel2(0, k * np.linalg.norm(np.array(points) - SOURCE, axis=1))
    ours = np.array([around_screen(k, p)[hard] for p in points])
    screen = _screen(k, hard, SOURCE)
    exact = screen.field(points)
    apart, shadow = np.abs(ours - exact), slice(len(BEHIND))
    of_free = (apart / np.abs(free)).max()
    of_field = (apart[shadow] / np.abs(exact)[shadow]).max()
    return of_free, of_field, screen.leak()


def in_line(hard):
    """(ours, exact) a wavelength of 1 m, source, both edges and receiver within 0.05 m of one plane."""
    k, source, receiver = 2 * PI, (-5.0, -0.02), (6.0, -0.05)
    exact = _screen(k, hard, source).field([receiver])[0]
    return around_screen(k, receiver, source=source)[hard], exact
