"""Edge diffraction against exact solutions: half plane, wedge, thick screen; and its laws.

The exact solutions are 2D: a line source, and fields per sqrt(m) of spreading. The coefficient is the
same in 2D and 3D; only ``spreading`` differs.
"""

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy.special import hankel2, jv, wofz

from rfsg.objects.physics import utd

F64, C128 = torch.float64, torch.complex128
PI = math.pi
N_WEDGES = [1.15, 4 / 3, 1.5, 1.8, 2.0]


def real(x):
    return torch.as_tensor(x, dtype=F64)


def pair(soft, hard):
    return torch.tensor([soft, hard], dtype=C128)


METAL, NOTHING = pair(-1, 1), pair(0, 0)


def metal(phi_in, phi_out, n, s_in, s_out, k, beta0=PI / 2):
    """(soft, hard) of a perfect conductor."""
    geometry = [real(a) for a in (phi_in, phi_out, beta0, n, s_in, s_out, k)]
    return utd.wedge_coefficients(*geometry, *(METAL, METAL, NOTHING))


# the transition function


def _exact_transition(x):
    """F(x) by mpmath, from the error function of 40 digits."""
    with mpmath.workdps(40):
        root = mpmath.sqrt(mpmath.mpf(x))
        y = mpmath.exp(mpmath.mpc(0, mpmath.pi / 4)) * root
        if x > 1e3:  # the series of the definition, where exp overflows any sensible time
            w = 1 / (2j * mpmath.mpf(x))
            return complex(mpmath.nsum(lambda m: mpmath.fac2(2 * m - 1) * (-w) ** m, [0, 12]))
        tail = mpmath.exp(mpmath.mpc(0, x)) * mpmath.erfc(y)
        return complex(mpmath.sqrt(mpmath.pi) * y * tail)


def test_transition_function_against_mpmath():
    x = np.concatenate([[0.0], np.logspace(-14, 12, 160), np.linspace(40.0, 60.0, 40)])
    exact = np.array([_exact_transition(v) for v in x])
    np.testing.assert_allclose(utd.transition(real(x)).numpy(), exact, rtol=1e-13, atol=0)


def test_transition_function_of_the_published_table():
    """The table from which programs after Kouyoumjian and Pathak interpolate (Balanis 2012, 13.3)."""
    x = [0.5, 0.7, 1.0, 1.5, 2.3, 4.0, 5.5]
    table_real = [0.6768, 0.7439, 0.8095, 0.8730, 0.9240, 0.9658, 0.9797]
    table_imag = [0.2682, 0.2549, 0.2322, 0.1982, 0.1577, 0.1073, 0.0828]
    f = utd.transition(real(x))
    np.testing.assert_allclose(f.real, table_real, atol=6e-5)
    np.testing.assert_allclose(f.imag, table_imag, atol=6e-5)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_derivatives_on_the_diagonal(order):
    """Against mpmath's own derivatives of w, near and far from where the formula changes."""
    z = np.array([0.0, 1e-9, 0.3, 2.0, 6.9, 6.999999, 7.000001, 7.1, 40.0])
    with mpmath.workdps(40):

        def g(t):
            return mpmath.exp(1j * t * t) * mpmath.erfc(mpmath.exp(1j * mpmath.pi / 4) * t)

        exact = [complex(mpmath.diff(g, mpmath.mpf(float(v)), order)) for v in z]
    np.testing.assert_allclose(utd.erfcx_diagonal(real(z), order).numpy(), exact, rtol=1e-11)


def test_the_diagonal_against_the_faddeeva_function():
    z = np.linspace(0, 30, 4001)
    exact = wofz(1j * np.exp(0.25j * PI) * z)
    np.testing.assert_allclose(utd.erfcx_diagonal(real(z)).numpy(), exact, rtol=1e-13)


def test_gradient_at_zero_is_finite():
    x = real([0.0, 1e-300, 1e-12, 1.0]).requires_grad_()
    utd.transition(x).abs().sum().backward()
    assert x.grad is not None and bool(torch.isfinite(x.grad).all())


# the terms


def _plain_term(delta, n, kl):
    """cot F with F from the Faddeeva function: the formula of the article, as it stands."""
    root = np.sqrt(2 * kl) * np.abs(np.sin(delta / 2))
    f = np.sqrt(PI) * np.exp(0.25j * PI) * root * wofz(1j * np.exp(0.25j * PI) * root)
    return f / np.tan(delta / (2 * n))


@pytest.mark.parametrize("n", N_WEDGES)
def test_product_against_the_plain_formula(n):
    delta = np.concatenate([np.linspace(0.01, n * PI - 0.01, 60), np.logspace(-7, -1, 60)])
    delta = np.concatenate([delta, -delta])
    for kl in (0.05, 3.0, 1e5):
        product = utd.cotangent_transition(real(delta), real(n), real(kl)).numpy()
        np.testing.assert_allclose(product, _plain_term(delta, n, kl), rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("n", N_WEDGES)
def test_product_at_the_boundary_is_the_limit_of_kouyoumjian_and_pathak(n):
    """Eq. 33: n [sqrt(2 pi kL) sign(e) - 2 kL e e^{j pi/4}] e^{j pi/4}."""
    kl = 7.0
    for e in (0.0, 1e-9, -1e-9, 1e-5, -1e-5):
        sign = -1.0 if e < 0 else 1.0
        limit = n * (math.sqrt(2 * PI * kl) * sign - 2 * kl * e * np.exp(0.25j * PI))
        value = utd.cotangent_transition(real(e), real(n), real(kl)).numpy()
        np.testing.assert_allclose(value, limit * np.exp(0.25j * PI), rtol=1e-7)


def test_terms_are_those_of_the_article():
    """Kouyoumjian and Pathak eq. 25 with a+- and N+- spelled out, at random angles."""
    rng = np.random.default_rng(1)
    for n in N_WEDGES:
        phi_in, phi_out = rng.uniform(0.02, n * PI - 0.02, (2, 50))
        beta0, s_in, s_out, k = 1.1, 3.0, 1.7, 51.0
        length = s_in * s_out / (s_in + s_out) * math.sin(beta0) ** 2
        front = -np.exp(-0.25j * PI) / (2 * n * math.sqrt(2 * PI * k) * math.sin(beta0))
        columns = []
        for beta, side in (
            (phi_out - phi_in, 1),
            (phi_out - phi_in, -1),
            (phi_out + phi_in, -1),
            (phi_out + phi_in, 1),
        ):
            wraps = np.round((side * PI + beta) / (2 * PI * n))
            a = 2 * np.cos((2 * n * PI * wraps - beta) / 2) ** 2
            root = np.sqrt(k * length * a)
            f = np.sqrt(PI) * np.exp(0.25j * PI) * root * wofz(1j * np.exp(0.25j * PI) * root)
            columns.append(front / np.tan((PI + side * beta) / (2 * n)) * f)
        terms = utd.wedge_terms(*(real(a) for a in (phi_in, phi_out, beta0, n, s_in, s_out, k)))
        np.testing.assert_allclose(terms.numpy(), np.stack(columns, -1), rtol=1e-9, atol=1e-13)


def test_along_the_edge_everything_is_finite():
    """sin(beta0) -> 0: F ~ sin(beta0) cancels the factor 1/sin(beta0) of the article."""
    for beta0 in (1e-3, 1e-9, 0.0):
        d = metal(0.7, 3.1, 1.5, 2.0, 3.0, 50.0, beta0=beta0)
        assert bool(torch.isfinite(d.abs()).all())


# exact solutions


def _fresnel_tail(a):
    """int_a^inf e^{-j t^2} dt for any real a."""
    y = np.exp(0.25j * PI) * np.abs(a)
    tail = 0.5 * np.sqrt(PI) * np.exp(-0.25j * PI) * wofz(1j * y) * np.exp(-1j * a * a)
    return np.where(a < 0, np.sqrt(PI) * np.exp(-0.25j * PI) - tail, tail)


def _sommerfeld(rho, phi, phi_in, k, hard):
    """Total field of a plane wave on a conducting half plane (Sommerfeld 1896; Born and Wolf 11.5)."""

    def part(angle):
        wave = np.exp(1j * k * rho * np.cos(angle))
        return wave * _fresnel_tail(-np.sqrt(2 * k * rho) * np.cos(angle / 2))

    sign = 1 if hard else -1
    return np.exp(0.25j * PI) / np.sqrt(PI) * (part(phi - phi_in) + sign * part(phi + phi_in))


@pytest.mark.parametrize("phi_in", [0.05, 0.6, PI / 2, 2.0, 4.0, 6.2])
def test_half_plane_is_exact(phi_in):
    """UTD of n = 2 and a plane wave is Sommerfeld's exact solution at any distance."""
    phi = np.linspace(0.0, 2 * PI, 721)
    for rho, k in ((0.02, 1.0), (1.0, 1.0), (3.0, 40.0)):
        d = metal(phi_in, phi, 2.0, 1e12, rho, k).numpy() * np.exp(-1j * k * rho) / np.sqrt(rho)
        for hard in (0, 1):
            direct = np.exp(1j * k * rho * np.cos(phi - phi_in)) * (np.abs(phi - phi_in) <= PI)
            image = np.exp(1j * k * rho * np.cos(phi + phi_in))
            lit = (phi + phi_in <= PI) | (phi + phi_in >= 3 * PI)
            total = direct + (1 if hard else -1) * image * lit + d[:, hard]
            exact = _sommerfeld(rho, phi, phi_in, k, hard)
            np.testing.assert_allclose(total, exact, atol=1e-9)


def _wedge_series(k, rho_in, phi_in, rho_out, phi_out, n, hard):
    """Line source H0(k R) by a conducting wedge: the eigenfunction series (Balanis 2012, 14.5)."""
    low, high = min(rho_in, rho_out), max(rho_in, rho_out)
    m = np.arange(int(n * (k * low + 40)) + 60)
    radial = np.where(m == 0, 1, 2) / n * jv(m / n, k * low) * hankel2(m / n, k * high)
    difference = np.cos(m / n * (phi_out - phi_in)[:, None])
    total = np.cos(m / n * (phi_out + phi_in)[:, None])
    return (radial * (difference + (1 if hard else -1) * total)).sum(1)


def _rays(k, rho_in, phi_in, rho_out, phi_out, n, hard):
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


@pytest.mark.parametrize("hard", [0, 1])
@pytest.mark.parametrize("n", [1.25, 1.5, 1.75, 2.0])
def test_wedge_against_the_eigenfunction_series(n, hard):
    """Everywhere about the wedge; the error falls at least as (k rho)^(-1) of the free field."""
    phi = np.linspace(0.0, n * PI, 181)
    errors = []
    for k_rho in (10.0, 40.0, 160.0):
        worst = 0.0
        for phi_in in (0.4, 1.3, 1.01 * n * PI / 2):
            exact = _wedge_series(k_rho, 1.0, phi_in, 1.3, phi, n, hard)
            ours = _rays(k_rho, 1.0, phi_in, 1.3, phi, n, hard)
            scale = abs(hankel2(0, k_rho * 2.3))
            worst = max(worst, np.abs(ours - exact).max() / scale)
        errors.append(worst)
    assert errors[0] < 7e-3 and errors[2] < 4e-4
    assert errors[1] < errors[0] / 4 and errors[2] < errors[1] / 4
