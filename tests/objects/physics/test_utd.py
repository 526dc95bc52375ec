"""Edge diffraction against exact solutions: half plane, wedge, thick screen; and its laws.

The exact solutions are 2D: a line source, and fields per sqrt(m) of spreading. The coefficient is the
same in 2D and 3D; only ``spreading`` differs.
"""

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy.special import wofz
from torch.autograd import gradcheck

from rfsg.objects.physics import fresnel, utd
from tests.objects.physics import wedge_twin
from tests.objects.physics.wedges import (
    BEHIND,
    C128,
    F64,
    METAL,
    NOTHING,
    PI,
    around_screen,
    in_line,
    metal,
    pair,
    real,
    screen_errors,
    wedge_error,
)

N_WEDGES = [1.15, 4 / 3, 1.5, 1.8, 2.0]


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
    np.testing.assert_allclose(wedge_twin.transition(real(x)).numpy(), exact, rtol=1e-13, atol=0)


def test_transition_function_of_the_published_table():
    """The table from which programs after Kouyoumjian and Pathak interpolate (Balanis 2012, 13.3)."""
    x = [0.5, 0.7, 1.0, 1.5, 2.3, 4.0, 5.5]
    table_real = [0.6768, 0.7439, 0.8095, 0.8730, 0.9240, 0.9658, 0.9797]
    table_imag = [0.2682, 0.2549, 0.2322, 0.1982, 0.1577, 0.1073, 0.0828]
    f = wedge_twin.transition(real(x))
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
        product = wedge_twin.cotangent_transition(real(delta), real(n), real(kl)).numpy()
        np.testing.assert_allclose(product, _plain_term(delta, n, kl), rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("n", N_WEDGES)
def test_product_at_the_boundary_is_the_limit_of_kouyoumjian_and_pathak(n):
    """Eq. 33: n [sqrt(2 pi kL) sign(e) - 2 kL e e^{j pi/4}] e^{j pi/4}."""
    kl = 7.0
    for e in (0.0, 1e-9, -1e-9, 1e-5, -1e-5):
        sign = -1.0 if e < 0 else 1.0
        limit = n * (math.sqrt(2 * PI * kl) * sign - 2 * kl * e * np.exp(0.25j * PI))
        value = wedge_twin.cotangent_transition(real(e), real(n), real(kl)).numpy()
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


@pytest.mark.parametrize("hard", [0, 1])
@pytest.mark.parametrize("n", [1.25, 1.5, 1.75, 2.0])
def test_wedge_against_the_eigenfunction_series(n, hard):
    """Everywhere about the wedge; the error falls at least as (k rho)^(-1) of the free field."""
    errors = [wedge_error(k_rho, 1.0, 1.3, n, hard) for k_rho in (10.0, 40.0, 160.0)]
    assert errors[0] < 7e-3 and errors[2] < 4e-4
    assert errors[1] < errors[0] / 4 and errors[2] < errors[1] / 4


# two edges: a thick screen against a boundary integral


def test_double_diffraction_by_a_thick_screen():
    """2.3 wavelengths thick: within 0.6 % (soft) and 2 % (hard) of the free field, 16 % and 8 % of the
    field in the shadow, where that is 15 to 45 dB down; the error falls as 1/k. Without slopes the
    soft field would be nothing there."""
    worst, inside = [], []
    for k in (2 * PI, 8 * PI):
        error = np.zeros(2)
        for hard in (0, 1):
            error[hard], shadow, leak = screen_errors(k, hard)
            inside.append(leak)
            assert shadow < (0.08 if hard else 0.16)
        worst.append(error)
    assert max(inside) < 3e-4  # the boundary integral's own error
    assert (worst[0] < [0.006, 0.02]).all()
    assert (worst[1] < worst[0] / 4).all()
    assert np.abs(around_screen(2 * PI, BEHIND[0], slopes=False)[0]) < 1e-12


def test_double_diffraction_errs_most_where_all_is_in_line():
    """Source, both edges and receiver within 0.05 m of one plane: a quarter of the field, 2.9 dB, low.

    There the second edge stands in the transition zone of the first, which two wedges one after the
    other do not know.
    """
    for hard in (0, 1):
        ours, exact = in_line(hard)
        assert 0.15 < abs(ours - exact) / abs(exact) < 0.3
        assert -3.0 < 20 * math.log10(abs(ours / exact)) < -2.0


def test_along_a_face_is_reciprocal():
    """Edge 1 of angle 1.3, edge 2 of 1.7, back and forth, at oblique angles, with lossy faces."""
    face, side = pair(-0.6 + 0.1j, 0.4), pair(-0.3, 0.7 - 0.2j)

    def chain(phi_in, beta_in, n_in, s_in, phi_out, beta_out, n_out, s_out):
        k, d = real(70.0), real(0.9)
        first = [real(a) for a in (0.0, phi_in, beta_in, n_in, 0.9, s_in)]
        second = [real(a) for a in (0.0, phi_out, beta_out, n_out, 0.9, s_out)]
        swapped = [first[1], first[0], first[2], first[3], first[5], first[4]]
        weights = (face, side, NOTHING)
        return wedge_twin.along_face(
            wedge_twin.wedge_coefficients(*swapped, *(k, *weights)),
            wedge_twin.wedge_coefficients(*second, *(k, *weights)),
            wedge_twin.slope_coefficients(*first, *(k, *weights)),
            wedge_twin.slope_coefficients(*second, *(k, *weights)),
            *(real(beta_in), real(beta_out), d, k),
        )

    one, two = (2.1, 1.1, 1.3, 3.0), (3.9, 0.8, 1.7, 2.0)
    torch.testing.assert_close(chain(*one, *two), chain(*two, *one), rtol=1e-13, atol=0)


# laws


def test_reciprocity():
    """The ends change places: terms 1 and 2 too, and nothing else."""
    rng = np.random.default_rng(2)
    for n in N_WEDGES:
        a, b = (real(x) for x in rng.uniform(0, n * PI, (2, 200)))
        rest = (real(1.2), real(n))
        there = utd.wedge_terms(a, b, *rest, real(3.0), real(0.7), real(40.0))
        back = utd.wedge_terms(b, a, *rest, real(0.7), real(3.0), real(40.0))
        torch.testing.assert_close(there, back[:, [1, 0, 2, 3]], rtol=1e-12, atol=1e-14)


def test_a_flat_face_and_a_transparent_screen_diffract_nothing():
    phi = real(np.linspace(0.01, PI - 0.01, 50))
    other = real(np.linspace(0.02, PI - 0.02, 50))
    geometry = [real(a) for a in (PI / 2, 1.0, 2.0, 3.0, 30.0)]
    r = pair(-0.4 + 0.2j, 0.7)
    flat = wedge_twin.wedge_coefficients(phi, other, *geometry, *(r, r, NOTHING))
    assert float(flat.abs().max()) < 1e-14
    air = wedge_twin.wedge_coefficients(
        2 * phi, 2 * other, *geometry, *(NOTHING, NOTHING, pair(1, 1))
    )
    assert float(air.abs().max()) == 0.0


def test_a_thin_wedge_tends_to_the_half_plane():
    phi = np.linspace(0.1, 6.0, 40)
    whole = metal(1.0, phi, 2.0, 2.0, 3.0, 30.0)
    errors = [
        float((metal(1.0, phi, 2.0 - e, 2.0, 3.0, 30.0) - whole).abs().max()) for e in (1e-3, 1e-6)
    ]
    assert errors[0] < 2e-3 and errors[1] < 2e-6


# total field across shadow boundaries

K = 60.0
PLACES = {"s_in": 2.0, "s_out": 1.3}  # distances across the edge [m]


def _total(phi_in, phi_out, n, lit, reflection, transmission, sign, rise, s_in, s_out):
    """GO + UTD of a spherical scalar wave beside a wedge along z, ends ``rise`` apart along it; [m].

    lit [3 m]: which of (direct, face 0, face n) count here. reflection, transmission: of the cosine to the
    face. sign: -1 counts R as it is (soft), +1 as -R (hard).
    """
    reach = math.hypot(s_in + s_out, rise) / (s_in + s_out)
    beta0, near, far = (real(x) for x in (math.asin(1.0 / reach), s_in * reach, s_out * reach))

    def wave(angle):
        square = s_in**2 + s_out**2 - 2 * s_in * s_out * torch.cos(angle) + rise**2
        distance = torch.sqrt(square)
        return torch.polar(1 / distance, -K * distance), distance

    def mirrored(in_angle, out_angle):
        """Reflection of a face from which the two azimuths are counted, and R for the edge."""
        field, distance = wave(in_angle + out_angle)
        cosine = (s_in * torch.sin(in_angle) + s_out * torch.sin(out_angle)) / distance
        mean = utd.mean_cosine(
            torch.sin(in_angle).abs() / reach, torch.sin(out_angle).abs() / reach, near, far
        )
        return -sign * reflection(cosine) * field, -sign * reflection(mean)

    difference = phi_out - phi_in
    direct, distance = wave(difference)
    # the plate lies in face 0: what goes through it meets it at this cosine
    t_edge = utd.mean_cosine(
        torch.sin(phi_in).abs() / reach, torch.sin(phi_out).abs() / reach, near, far
    )
    t_ray = (s_in * torch.sin(phi_in) - s_out * torch.sin(phi_out)).abs() / distance
    on_0, r0 = mirrored(phi_in, phi_out)
    on_n, rn = mirrored(n * PI - phi_in, n * PI - phi_out)
    terms = utd.wedge_terms(phi_in, phi_out, beta0, n, near, far, real(K))
    through = transmission(t_edge)
    total = (1 - through) * terms[:, :2].sum(1) + r0 * terms[:, 2] + rn * terms[:, 3]
    total = total * wedge_twin.spreading(near, far) * torch.polar(1 / near, -K * (near + far))
    total = total + direct * (lit[0] + (1 - lit[0]) * transmission(t_ray))
    return total + on_0 * lit[1] + on_n * lit[2]


def _boundaries(n, phi_in):
    """(angle of a boundary, which ray ends there, whether it is lit below) within the exterior."""
    found = [(PI - phi_in, 1, True), ((2 * n - 1) * PI - phi_in, 2, False)]
    found += [(phi_in + PI, 0, True), (phi_in - PI, 0, False)]
    return [f for f in found if 0.05 < f[0] < n * PI - 0.05]


def _lit(n, phi_in, phi, ray, on):
    """What is lit at phi, with the ray whose boundary this is switched by hand."""
    lit = [abs(phi - phi_in) < PI, phi + phi_in < PI, phi + phi_in > (2 * n - 1) * PI]
    lit[ray] = on
    return lit


def _steps(n, places, reflection, transmission, sign, rise, aside=0.0):
    """Relative steps of the total field's value and slope over (phi_in, boundary, ray, lit_below)."""
    hairs, phi_in, phi, lit = (-1e-11, 1e-11), [], [], []
    for hair in hairs:
        for source, boundary, ray, lit_below in places:
            phi_in.append(source)
            phi.append(boundary + aside + hair)
            lit.append(_lit(n, source, boundary, ray, lit_below == (hair < 0)))
    receiver = real(phi).requires_grad_()
    on = real(np.array(lit).T)
    u = _total(real(phi_in), receiver, real(n), on, reflection, transmission, sign, rise, **PLACES)
    parts = [torch.autograd.grad(x.sum(), receiver, retain_graph=True)[0] for x in (u.real, u.imag)]
    below, above = torch.stack([u.detach(), torch.complex(*parts)]).chunk(2, 1)
    return (above - below).abs() * math.hypot(3.3, rise)  # against the free field


def _metal_r(cosine):
    return torch.full_like(cosine, -1.0).to(C128)


def _brick_r(cosine):
    return fresnel.interface(cosine, torch.tensor(4.4 - 0.2j, dtype=C128))[0]


def _opaque(cosine):
    return torch.zeros_like(cosine).to(C128)


def _pane(cosine):
    eps, f = torch.tensor(6.3 - 0.1j, dtype=C128), torch.tensor(K * 299792458 / (2 * PI), dtype=F64)
    return fresnel.slab(cosine, eps, 0.02, f)[1][..., 0]


def _places(n, sources):
    return [(s, *b) for s in sources for b in _boundaries(n, s)]


@pytest.mark.parametrize("rise", [0.0, 2.5])
@pytest.mark.parametrize("n", N_WEDGES)
def test_total_field_has_no_step_and_no_kink(n, rise):
    """Value and slope across every boundary: metal and brick, soft and hard, any beta0."""
    places = _places(n, (0.3, 1.0, 0.55 * n * PI, n * PI - 0.4))
    assert {p[2] for p in places} == {0, 1, 2}
    for reflection in (_metal_r, _brick_r):
        for sign in (-1, 1):
            step, kink = _steps(n, places, reflection, _opaque, sign, rise)
            assert float(step.max()) < 1e-8 and float(kink.max()) < 1e-6


@pytest.mark.parametrize("rise", [0.0, 2.5])
def test_total_field_behind_a_pane_has_no_step_and_no_kink(rise):
    """A half plane that lets some through: weights 1 - T (Burnside and Burgener 1983)."""
    places = _places(2.0, (0.5, 1.4, 4.0))
    assert {p[2] for p in places} == {0, 1, 2}
    step, kink = _steps(2.0, places, _brick_r, _pane, -1, rise)
    assert float(step.max()) < 1e-8 and float(kink.max()) < 1e-6


def test_the_measure_of_steps_and_kinks_sees_them(monkeypatch):
    """A ray switched beside its boundary leaves a step; the plain mean of two angles, a kink."""
    places = _places(1.5, (1.0, 2.0))
    step, _ = _steps(1.5, places, _metal_r, _opaque, -1, 0.0, aside=0.01)
    assert float(step.min()) > 0.3
    monkeypatch.setattr(utd, "mean_cosine", lambda a, b, s_in, s_out: 0.5 * (a + b))
    _, kink = _steps(1.5, [p for p in places if p[2] > 0], _brick_r, _opaque, -1, 0.0)
    assert float(kink.min()) > 0.01


def _vector_total(source, receiver, n, lit):
    """Field vectors of a short dipole by a conducting wedge along z, face 0 in y = 0, x > 0."""
    dipole = np.array([0.3, -0.5, 0.8])

    def radiate(place, moment):
        away = receiver - place
        distance = np.linalg.norm(away)
        u = away / distance
        return (moment - u * (u @ moment)) * np.exp(-1j * K * distance) / distance

    total = radiate(source, dipole) if lit[0] else np.zeros(3, dtype=complex)
    face_n = np.array([math.sin(n * PI), -math.cos(n * PI), 0.0])  # outward normal of face n
    for on, normal in ((lit[1], np.array([0.0, 1.0, 0.0])), (lit[2], face_n)):
        if on:
            mirror = np.eye(3) - 2 * np.outer(normal, normal)
            total = total + radiate(mirror @ source, -mirror @ dipole)
    (rho_in, phi_in), (rho_out, phi_out) = (
        (math.hypot(p[0], p[1]), math.atan2(p[1], p[0]) % (2 * PI)) for p in (source, receiver)
    )
    z = (source[2] * rho_out + receiver[2] * rho_in) / (rho_in + rho_out)
    edge = np.array([0.0, 0.0, z])
    s_in, s_out = np.linalg.norm(edge - source), np.linalg.norm(receiver - edge)
    d_in, d_out = (edge - source) / s_in, (receiver - edge) / s_out
    at_edge = (dipole - d_in * (d_in @ dipole)) * np.exp(-1j * K * s_in) / s_in
    beta0 = math.acos(d_in[2])
    soft, hard = metal(phi_in, phi_out, n, s_in, s_out, K, beta0=beta0).numpy()
    phi_hat_in = np.array([-math.sin(phi_in), math.cos(phi_in), 0.0])
    phi_hat_out = np.array([-math.sin(phi_out), math.cos(phi_out), 0.0])
    beta_in, beta_out = np.cross(d_in, phi_hat_in), np.cross(d_out, phi_hat_out)
    dyad = -soft * np.outer(beta_out, beta_in) - hard * np.outer(phi_hat_out, phi_hat_in)
    spread = float(wedge_twin.spreading(real(s_in), real(s_out)))
    return total + dyad @ at_edge * spread * np.exp(-1j * K * s_out)


@pytest.mark.parametrize("n", [1.5, 2.0])
def test_field_vectors_have_no_step(n):
    """The dyad of the module and the signs of soft and hard: three components, oblique rays."""
    for phi_in in (0.7, 0.55 * n * PI, n * PI - 0.6):
        source = np.array([2.0 * math.cos(phi_in), 2.0 * math.sin(phi_in), 1.7])
        for boundary, ray, lit_below in _boundaries(n, phi_in):
            fields = []
            for hair in (-1e-11, 1e-11):
                phi = boundary + hair
                receiver = np.array([1.3 * math.cos(phi), 1.3 * math.sin(phi), -0.4])
                lit = _lit(n, phi_in, boundary, ray, lit_below == (hair < 0))
                fields.append(_vector_total(source, receiver, n, lit))
            np.testing.assert_allclose(fields[0], fields[1], atol=1e-8)


def test_conductor_in_the_signs_of_our_surfaces():
    """R_soft = R_TE and R_hard = -R_TM turn a very good conductor into (-1, +1)."""
    te, tm = fresnel.interface(real(0.7), torch.tensor(1 - 1e14j, dtype=C128))
    r = torch.stack([te, -tm])
    torch.testing.assert_close(r, METAL, atol=1e-6, rtol=0)


# derivatives

GEOMETRY = (1.1, 2.9, 1.2, 1.5, 2.0, 0.8, 35.0)


def _asking(values):
    return [real(v).requires_grad_() for v in values]


@pytest.mark.parametrize("function", [wedge_twin.wedge_coefficients, wedge_twin.slope_coefficients])
def test_gradients_of_coefficients(function):
    """All seven arguments and the three pairs, for several angles, also beside the boundaries."""
    r0, rn, t = (
        torch.randn(2, dtype=C128, requires_grad=True),
        torch.randn(2, dtype=C128, requires_grad=True),
        torch.randn(2, dtype=C128, requires_grad=True),
    )
    phi_out = real([0.2, PI - 1.1 + 1e-4, PI - 1.1 - 1e-4, 3.0, PI + 1.1 + 1e-4, 4.6])
    arguments = _asking(GEOMETRY)
    arguments[1] = phi_out.requires_grad_()
    assert gradcheck(function, (*arguments, r0, rn, t))
    assert gradcheck(
        wedge_twin.transition, (real([1e-3, 0.4, 48.9, 49.1, 300.0]).requires_grad_(),)
    )
    assert gradcheck(
        wedge_twin.cotangent_transition,
        (real([0.7, -1e-3, 1e-3]).requires_grad_(), *_asking([1.4, 3.0])),
    )


def test_second_derivatives():
    z = real([0.0, 0.5, 6.99, 7.01, 30.0]).requires_grad_()
    assert torch.autograd.gradgradcheck(
        utd.erfcx_diagonal, (real([0.3, 6.9, 7.1]).requires_grad_(),)
    )
    (first,) = torch.autograd.grad(utd.erfcx_diagonal(z).real.sum(), z)
    torch.testing.assert_close(first, utd.erfcx_diagonal(z, 1).real)


@pytest.mark.parametrize("n", N_WEDGES)
def test_slope_is_the_derivative_on_and_off_the_boundaries(n):
    """Autograd of the coefficient, and by differences; at a boundary the limit from either side."""
    phi_in = real(1.3).requires_grad_()
    boundary = PI - 1.3
    phi_out = real([0.1, boundary - 1e-6, boundary, boundary + 1e-6, 2.7, n * PI - 0.01])
    rest = [real(a) for a in (1.2, n, 2.0, 0.8, 35.0)]
    jacobian = torch.autograd.functional.jacobian(
        lambda a: torch.view_as_real(utd.wedge_terms(a, phi_out, *rest)), phi_in
    )
    slope = utd.slope_terms(real(1.3), phi_out, *rest)
    torch.testing.assert_close(torch.view_as_complex(jacobian), slope, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(slope[1], slope[2], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(slope[3], slope[2], rtol=1e-3, atol=1e-4)
    step = 1e-6
    ahead, behind = (utd.wedge_terms(real(1.3 + s), phi_out, *rest) for s in (step, -step))
    away = torch.tensor([0, 4, 5])
    torch.testing.assert_close(
        ((ahead - behind) / (2 * step))[away], slope[away], rtol=1e-6, atol=1e-8
    )


@pytest.mark.parametrize("beta0", [0.0, 1e-6, PI / 2])
def test_gradients_are_finite_at_all_extremes(beta0):
    """On faces, boundaries and along the edge, from 1 mm to 100 km and 2 to 6000 rad/m."""
    angles = [0.0, 1.0, PI - 1.0, PI + 1.0, 1.5 * PI]
    for s_in, s_out, k in ((1e-3, 1e5, 2.0), (1e5, 1e5, 6e3), (1e-3, 1e-3, 2.0)):
        arguments = [real(a) for a in (1.0, angles, beta0, 1.5, s_in, s_out, k)]
        arguments = [a.requires_grad_() for a in arguments]
        weights = (METAL, METAL, pair(0.3, 0.3))
        for function in (wedge_twin.wedge_coefficients, wedge_twin.slope_coefficients):
            value = function(*arguments, *weights)
            assert bool(torch.isfinite(value.abs()).all())
            found = torch.autograd.grad(torch.view_as_real(value).sum(), arguments)
            assert all(bool(torch.isfinite(g).all()) for g in found)
