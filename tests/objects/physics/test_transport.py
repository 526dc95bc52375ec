"""Laws and closed forms of exponential transport (paper Eqs. 13-19, 23)."""

import math

import mpmath
import pytest
import torch

from rfsg.objects.physics import transport
from rfsg.objects.physics.transport import LAWS

F64 = torch.float64
NAMES = sorted(LAWS)


def _exact(name: str, u: float) -> tuple[mpmath.mpf, mpmath.mpf]:
    """(occupancy, hazard) of the definition, to 60 digits: the quotient is harmless there."""
    with mpmath.workdps(60):
        x = mpmath.mpf(u)
        if name == "logistic":
            o = 1 / (1 + mpmath.exp(x))
            density = 1 / ((1 + mpmath.exp(-x)) * (1 + mpmath.exp(x)))
        elif name == "gaussian":
            o, density = mpmath.erfc(x / mpmath.sqrt(2)) / 2, mpmath.npdf(x)
        else:
            o = mpmath.exp(-x) / 2 if x >= 0 else 1 - mpmath.exp(x) / 2
            density = mpmath.exp(-abs(x)) / 2
        return o, density / o


POINTS = [-1e4, -700.0, -60.0, -9.0, -1.3, -1e-9, 0.0, 0.4, 3.0, 19.99, 20.01, 60.0, 700.0, 1e4]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("u", POINTS)
def test_law_against_its_definition(name, u):
    law, x = LAWS[name], torch.tensor(u, dtype=F64)
    o, hazard = _exact(name, u)
    # Below 1e-300 a float64 is subnormal or 0: absolute there.
    assert float(law.hazard(x)) == pytest.approx(float(hazard), rel=1e-12, abs=1e-300)
    assert float(law.log_occupancy(x)) == pytest.approx(float(mpmath.log(o)), rel=1e-12, abs=1e-300)
    assert float(law.vacancy(-x)) == pytest.approx(float(o), rel=1e-10, abs=1e-300)
    assert float(law.occupancy(x) + law.vacancy(x)) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype, tolerance", [(F64, 1e-11), (torch.float32, 1e-4)])
def test_hazard_is_the_slope_of_the_log_survival(name, dtype, tolerance):
    u = torch.tensor(POINTS, dtype=dtype, requires_grad=True)
    law = LAWS[name]
    (slope,) = torch.autograd.grad(law.log_occupancy(u).sum(), u)
    torch.testing.assert_close(-slope, law.hazard(u), rtol=tolerance, atol=1e-30)
    (curve,) = torch.autograd.grad(law.hazard(u).sum(), u)
    assert curve.isfinite().all() and (curve >= 0).all()  # all three hazards never fall


@pytest.mark.parametrize("name", NAMES)
def test_laws_gradcheck(name):
    u = torch.tensor([-30.0, -3.0, -0.2, 0.3, 4.0, 19.0, 25.0], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(LAWS[name].log_occupancy, u)
    assert torch.autograd.gradcheck(LAWS[name].hazard, u)


def test_gradient_of_the_logistic_hazard_survives_float32():
    u = torch.tensor(20.0, requires_grad=True)  # torch's sigmoid has gradient 0 here
    (slope,) = torch.autograd.grad(LAWS["logistic"].hazard(u), u)
    assert float(slope) == pytest.approx(math.exp(-20), rel=1e-5)


def test_unknown_law_is_named():
    with pytest.raises(ValueError, match=r"logistic, gaussian, laplace.*'cauchy'"):
        transport.law_named("cauchy")


def _stretch(
    law, values, m=1.0, alpha=1.0, phi=0.0, s=1.0, gradient=(0.0, 0.0, 1.0), step=1.0, **k
):
    f = torch.as_tensor(values, dtype=F64)
    ones = torch.ones_like(f)
    g = torch.tensor(gradient, dtype=F64).expand(*f.shape, 3)
    along = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(*f.shape[:-1], 3)
    arguments = (f, g, m * ones, alpha * ones, phi * ones, torch.tensor(s, dtype=F64), along)
    return law, *arguments, torch.full(f.shape[:-1], step, dtype=F64), k.get("kappa")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("s", [1e-3, 1.0, 40.0, 1e3, 1e6])
@pytest.mark.parametrize("samples", [2, 3, 17])
def test_telescoped_is_exact_for_alpha_one(name, s, samples):
    """Integral of sigma_in = m |delta o| + |delta ln o| whatever s and the step (Eq. 13)."""
    law, m = LAWS[name], 2.5
    f = torch.linspace(-0.3, 0.0, samples, dtype=F64)
    a = transport.telescoped(*_stretch(law, f, m=m, s=s, step=0.3 / (samples - 1)))
    deep, _ = _exact(name, -0.3 * s)
    with mpmath.workdps(60):
        expected = m * (deep - mpmath.mpf(1) / 2) + mpmath.log(2 * deep)
    assert float(a.real) == pytest.approx(float(expected), rel=1e-11)
    assert float(a.imag) == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("alpha", [0.0, 0.4])
@pytest.mark.parametrize("s", [0.1, 40.0, 1e5])
def test_isotropic_share_on_a_slope(name, alpha, s):
    """f linear along the stretch, |omega . n| = c: the isotropic share is the other one / c."""
    law, m, c = LAWS[name], 3.0, 0.25
    f = torch.linspace(-0.2, 0.0, 9, dtype=F64)
    gradient = (math.sqrt(1 - c * c), 0.0, c)
    step = 0.2 / c / 8
    a = transport.telescoped(*_stretch(law, f, m=m, alpha=alpha, s=s, gradient=gradient, step=step))
    deep, _ = _exact(name, -0.2 * s)
    across = float(m * (deep - mpmath.mpf(1) / 2) + mpmath.log(2 * deep))
    expected = across * (alpha + 0.5 * (1 - alpha) / c)
    assert float(a.real) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_travel_along_a_level_set_is_the_plain_rule(name):
    """omega . n = 0 (the small divisor): a = sigma_in * length, and nothing divides by it."""
    law, s, m, alpha, length = LAWS[name], 30.0, 2.0, 0.7, 0.5
    f = torch.full((11,), -0.02, dtype=F64)
    arguments = _stretch(law, f, m=m, alpha=alpha, s=s, gradient=(1.0, 0.0, 0.0), step=length / 10)
    o, hazard = _exact(name, -0.02 * s)
    expected = float((m * o + 1) * s * hazard * (1 - alpha) / 2) * length
    assert float(transport.telescoped(*arguments).real) == pytest.approx(expected, rel=1e-11)
    assert float(transport.riemann(*arguments).real) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("alpha", [1.0, 0.3])
def test_riemann_tends_to_telescoped(name, alpha):
    law, errors = LAWS[name], []
    for n in (200, 2000):
        t = torch.linspace(0, 1, n + 1, dtype=F64)
        f = -0.1 * torch.sin(math.pi * t)  # in, deeper, out
        gradient = torch.stack([0 * t + 0.5, 0 * t, -0.1 * math.pi * torch.cos(math.pi * t)], -1)
        one = torch.ones_like(t)
        along, step = torch.tensor([0.0, 0.0, 1.0], dtype=F64), torch.tensor(1.0 / n, dtype=F64)
        s = torch.tensor(30.0, dtype=F64)
        rest = (f, gradient, 2 * one + t, alpha * one, 0.4 * one, s, along, step)
        a, b = transport.telescoped(law, *rest), transport.riemann(law, *rest)
        errors.append(float((a - b).abs() / a.abs()))
    assert errors[1] < 2e-3 and errors[1] < 0.2 * errors[0]


def test_only_the_inside_is_counted():
    """A stretch that pokes out halfway through an interval pays for the inside part alone."""
    law = LAWS["logistic"]
    whole = transport.telescoped(*_stretch(law, [-0.5, 0.0], alpha=0.3, s=20.0, step=0.5))
    poking = transport.telescoped(*_stretch(law, [-0.5, 0.5, 0.5], alpha=0.3, s=20.0, step=1.0))
    torch.testing.assert_close(poking, whole, rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", NAMES)
def test_bits_do_not_depend_on_the_direction(name):
    torch.manual_seed(0)
    n = 33
    f = -torch.rand(50, n, dtype=F64)
    g, (m, alpha, phi) = torch.randn(50, n, 3, dtype=F64), torch.rand(3, 50, n, dtype=F64)
    step, s = torch.full((50,), 0.03, dtype=F64), torch.tensor(25.0, dtype=F64)
    along = torch.nn.functional.normalize(torch.randn(50, 3, dtype=F64), dim=-1)
    forward = transport.telescoped(LAWS[name], f, g, m, alpha, phi, s, along, step)
    back = [x.flip(-1) for x in (f, m, alpha, phi)]
    reverse = transport.telescoped(LAWS[name], back[0], g.flip(-2), *back[1:], s, -along, step)
    assert torch.equal(forward, reverse)


def test_sigma_does_not_know_the_sign_of_the_direction():
    torch.manual_seed(1)
    cosine, alpha = 2 * torch.rand(2, 100, dtype=F64) - 1
    alpha = alpha.abs()
    assert torch.equal(transport.sigma_mix(alpha, cosine), transport.sigma_mix(alpha, -cosine))


def test_inside_and_outside_agree_on_the_boundary_and_mirror():
    law, one = LAWS["laplace"], torch.ones(5, dtype=F64)
    f, s = torch.linspace(0, 0.3, 5, dtype=F64), torch.tensor(12.0, dtype=F64)
    out = transport.sigma_outside(law, f, one, 2 * one, one, s)
    expected = (2 * law.vacancy(s * f) + 1) * s * law.hazard(-s * f)
    torch.testing.assert_close(out, expected, rtol=1e-14, atol=0)
    inside = transport.sigma_inside(law, -f, one, 2 * one, one, s)
    assert torch.equal(out, inside)


@pytest.mark.parametrize("name", NAMES)
def test_on_the_face_inside_and_outside_are_one(name):
    law, one = LAWS[name], torch.ones(5, dtype=F64)
    s = torch.tensor(12.0, dtype=F64, requires_grad=True)
    m, mix = torch.linspace(0, 3, 5, dtype=F64), torch.linspace(0, 1, 5, dtype=F64)
    face = transport.sigma_at_face(law, one, m, mix, s)
    for side in (transport.sigma_inside, transport.sigma_outside):
        own = side(law, torch.zeros_like(one), one, m, mix, s)
        torch.testing.assert_close(face, own, rtol=1e-15, atol=0)
        slopes = [torch.autograd.grad(x.sum(), s, retain_graph=True) for x in (face, own)]
        torch.testing.assert_close(*slopes, rtol=1e-15, atol=0)


@pytest.mark.parametrize("integral", sorted(transport.INTEGRALS))
@pytest.mark.parametrize("name", NAMES)
def test_gradcheck(integral, name):
    torch.manual_seed(2)
    n = 6
    f = -torch.rand(2, n, dtype=F64) - 0.05
    g = torch.randn(2, n, 3, dtype=F64)
    m, alpha, phi, kappa = 0.1 + 0.8 * torch.rand(4, 2, n, dtype=F64)
    step, s = torch.rand(2, dtype=F64) + 0.1, torch.tensor(3.0, dtype=F64)
    along = torch.nn.functional.normalize(torch.randn(2, 3, dtype=F64), dim=-1)
    inputs = [x.requires_grad_() for x in (f, g, m, alpha, phi, s, step, kappa)]

    def run(f, g, m, alpha, phi, s, step, kappa):
        function = transport.INTEGRALS[integral]
        return torch.view_as_real(function(LAWS[name], f, g, m, alpha, phi, s, along, step, kappa))

    assert torch.autograd.gradcheck(run, inputs)


@pytest.mark.parametrize("integral", sorted(transport.INTEGRALS))
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_extremes_stay_finite(integral, name, dtype):
    for s in (1e-3, 1.0, 1e6):
        for reach in (0.0, 1e-6, 1.0, 1e4):
            for m in (0.0, 1.0, 1e6):
                f = torch.linspace(-1, 1, 9, dtype=dtype) * reach / s
                f = f.requires_grad_()
                g = torch.zeros(9, 3, dtype=dtype)
                g[::2] = 1.0  # |grad f| = 0 at every other sample
                g = g.requires_grad_()
                fields = [
                    torch.full((9,), x, dtype=dtype, requires_grad=True)
                    for x in (m, 0.5, math.pi / 2)
                ]
                s_ = torch.tensor(s, dtype=dtype, requires_grad=True)
                along = torch.tensor([0.0, 0.0, 1.0], dtype=dtype)
                step = torch.tensor(0.01, dtype=dtype)
                a = transport.INTEGRALS[integral](LAWS[name], f, g, *fields, s_, along, step)
                t = (-a).exp()
                assert t.isfinite().all() and a.real >= 0 and t.abs() <= 1
                grads = torch.autograd.grad(torch.view_as_real(t).sum(), [f, g, *fields, s_])
                assert all(x.isfinite().all() for x in grads), (s, reach, m)


def test_bulk_loss_of_a_solid_is_its_length():
    law, f = LAWS["logistic"], torch.full((5,), -1.0, dtype=F64)  # o = 1 at s f = -1e3
    kappa = torch.full_like(f, 0.7)
    a = transport.telescoped(*_stretch(law, f, alpha=1.0, s=1e3, step=0.25, kappa=kappa))
    assert float(a.real) == pytest.approx(0.7, rel=1e-12)


@pytest.mark.parametrize("integral", sorted(transport.INTEGRALS))
def test_a_stretch_in_a_face_loses_the_same_above_and_below_rounding(integral):
    """Along a seam of turned boxes f is +-1e-16 m: half the bulk loss, as at 0, and not none."""
    n, kappa, step = 5, 0.7, torch.tensor(0.3, dtype=F64)
    gradient = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(n, 3)
    zero, along = torch.zeros(n, dtype=F64), torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    for f in (-1e-16, 0.0, 1e-16):
        total = transport.INTEGRALS[integral](
            LAWS["logistic"], torch.full((n,), f, dtype=F64), gradient, zero, zero + 1.0, zero,
            torch.tensor(20.0, dtype=F64), along, step, torch.full((n,), kappa, dtype=F64),
        )  # fmt: skip
        assert float(total.real) == pytest.approx(0.5 * kappa * 0.3 * (n - 1), rel=1e-9)
