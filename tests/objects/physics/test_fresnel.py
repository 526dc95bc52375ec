"""Interface and slab against an independent transfer matrix and the closed limits."""

import math

import numpy as np
import pytest
import torch

from rfsg.objects.physics import fresnel, media

F64, C128 = torch.float64, torch.complex128
MEDIA = [2.0 + 0j, 5.24 - 0.3j, 31.4 - 8.0j, 1.0 - 1e-3j, 1.0 - 1e7j]


def _tensor(x):
    return torch.as_tensor(x, dtype=C128 if np.iscomplexobj(x) else F64)


def _characteristic(cosine: float, eps: complex, d: float, f: float) -> tuple[list, list]:
    """R and T (not relative) by the 2x2 characteristic matrix of a film (Born and Wolf, 1.6.2).

    TM is written for the tangential electric field, so R_TE = R_TM at normal incidence.
    """
    k = 2 * math.pi * f / fresnel.SPEED_OF_LIGHT
    kappa = np.sqrt(np.complex128(eps - (1 - cosine**2)))
    kappa = -kappa if kappa.imag > 0 else kappa
    q, r, t = k * d * kappa, [], []
    for outer, inner in ((cosine, kappa), (1 / cosine, eps / kappa)):
        matrix = np.array(
            [
                [np.cos(q), 1j * np.sin(q) / inner],
                [1j * inner * np.sin(q), np.cos(q)],
            ]
        )
        e, h = matrix @ np.array([1.0, outer])
        r.append((outer * e - h) / (outer * e + h))
        t.append(2 * outer / (outer * e + h))
    return r, t


@pytest.mark.parametrize("eps", [2.0 + 0j, 5.24 - 0.3j, 31.4 - 8.0j, 0.5 + 0j, 6.31 - 0.02j])
@pytest.mark.parametrize("cosine", [1.0, 0.8, 0.31, 0.02])
@pytest.mark.parametrize("d", [1e-4, 0.01, 0.2])
def test_slab_against_the_characteristic_matrix(eps, cosine, d):
    f = 2.4e9
    r, t = fresnel.slab(_tensor(cosine), _tensor(complex(eps)), d, _tensor(f))
    r_film, t_film = _characteristic(cosine, complex(eps), d, f)
    free = np.exp(2j * math.pi * f / fresnel.SPEED_OF_LIGHT * d * cosine)
    np.testing.assert_allclose(r.numpy(), r_film, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(t.numpy(), np.array(t_film) * free, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("eps", MEDIA)
def test_interface_against_the_textbook_form(eps):
    c = torch.linspace(0.01, 1, 50, dtype=F64)
    te, tm = fresnel.interface(c, _tensor(eps))
    cosine = c.numpy().astype(complex)
    kappa = np.sqrt(eps - (1 - cosine**2))
    # Cancellation in the textbook numerators, for media near vacuum, leaves ~1e-11 of |R|.
    np.testing.assert_allclose(te, (cosine - kappa) / (cosine + kappa), rtol=1e-9, atol=1e-15)
    expected = (kappa - eps * cosine) / (kappa + eps * cosine)
    np.testing.assert_allclose(tm, expected, rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("eps", MEDIA)
def test_normal_incidence_has_one_coefficient(eps):
    te, tm = fresnel.interface(_tensor(1.0), _tensor(eps))
    index = np.sqrt(eps)
    expected = -(eps - 1) / (1 + index) ** 2
    np.testing.assert_allclose([te.item(), tm.item()], expected, rtol=1e-12)


def test_brewster():
    """TM vanishes at tan theta = sqrt(eps): cos^2 = 1/(1 + eps)."""
    eps = 5.24
    te, tm = fresnel.interface(_tensor(1 / math.sqrt(1 + eps)), _tensor(complex(eps)))
    assert abs(tm.item()) < 1e-15 and abs(te.item()) > 0.5


@pytest.mark.parametrize("eps", [2.0 + 0j, 5.24 - 0.3j, 31.4 - 8.0j])
def test_grazing_reflects_everything(eps):
    """R_TE -> -1; R_TM -> +1 in the contract's reference: in both the tangential field cancels."""
    te, tm = fresnel.interface(_tensor(0.0), _tensor(complex(eps)))
    assert te.item() == pytest.approx(-1, abs=1e-7) and tm.item() == pytest.approx(1, abs=1e-7)
    r, t = fresnel.slab(_tensor(0.0), _tensor(complex(eps)), 0.1, _tensor(3e9))
    np.testing.assert_allclose(r.numpy(), [-1, 1], atol=1e-6)
    assert t.abs().max() < 1e-6


def test_a_conductor_is_the_limit_of_a_lossy_medium():
    c = torch.linspace(0.2, 1, 5, dtype=F64)
    te, tm = fresnel.interface(c, _tensor(1 - 1e14j))
    one = torch.ones(5, dtype=C128)
    torch.testing.assert_close(te, -one, rtol=0, atol=1e-5)
    torch.testing.assert_close(tm, -one, rtol=0, atol=1e-5)


@pytest.mark.parametrize("cosine", [1.0, 0.7, 1e-3, 0.0])
@pytest.mark.parametrize("d", [1e-3, 0.1, 10.0])
def test_a_vacuum_slab_is_not_there(cosine, d):
    one, f = _tensor(1.0 + 0j), _tensor(28e9)
    r, t = fresnel.slab(_tensor(cosine), one, d, f)
    assert torch.equal(r, torch.zeros(2, dtype=C128))
    torch.testing.assert_close(t, torch.ones(2, dtype=C128), rtol=0, atol=1e-15)
    delay = fresnel.slab_excess_delay(_tensor(cosine), one, 0 * one, d, f)
    assert torch.equal(delay.abs(), torch.zeros(2, dtype=F64))


def _random(n=2000):
    torch.manual_seed(3)
    u = torch.rand(4, n, dtype=F64)
    return u[0], 1 + 9 * u[1], 10 ** (-4 + 5 * u[2]), 10 ** (9 + 2 * u[3])


def test_energy_is_kept_without_loss():
    c, eps, d, f = _random()
    r, t = fresnel.slab(c, torch.complex(eps, 0 * eps), d, f)
    torch.testing.assert_close(
        r.abs() ** 2 + t.abs() ** 2, torch.ones(len(c), 2, dtype=F64), rtol=0, atol=1e-12
    )


def test_energy_never_grows_with_loss():
    c, eps, d, f = _random()
    for scale in (1e-3, 1.0, 1e8):
        r, t = fresnel.slab(c, torch.complex(eps, -scale * eps), d, f)
        power = r.abs() ** 2 + t.abs() ** 2
        assert power.isfinite().all() and power.max() <= 1 + 1e-12


def test_extra_phase_of_ten_centimetres_of_free_space():
    """The Recommendation's T counts the free-space travel; ours does not."""
    f, d = 2.4e9, 0.1
    _, t = fresnel.slab(_tensor(1.0), _tensor(1.0 + 0j), d, _tensor(f))
    _, itu = _characteristic(1.0, 1.0 + 0j, d, f)
    turn = -math.degrees(np.angle(itu[0])) % 360
    assert turn == pytest.approx(360 * d * f / fresnel.SPEED_OF_LIGHT % 360, abs=1e-6)
    assert abs(np.angle(t[0].item())) < 1e-15


@pytest.mark.parametrize("name", ["concrete", "glass", "metal"])
@pytest.mark.parametrize("cosine", [1.0, 0.6, 0.1])
def test_delay_is_the_slope_of_the_phase(name, cosine):
    d, f = (0.1 if name != "metal" else 1e-9), torch.tensor([2.4e9, 5.0e9], dtype=F64)

    def transmission(x):
        return fresnel.slab(_tensor(cosine), media.complex_permittivity(name, x), d, x)[1]

    step = 1e4
    turn = torch.angle(transmission(f + step) / transmission(f - step))
    expected = -turn / (2 * step) / (2 * math.pi)
    delay = fresnel.slab_excess_delay(
        _tensor(cosine),
        media.complex_permittivity(name, f),
        media.permittivity_slope(name, f),
        d,
        f,
    ).reshape(2, 2)
    torch.testing.assert_close(delay, expected.reshape(2, 2), rtol=1e-5, atol=1e-16)


def test_a_matched_slab_delays_by_its_index():
    """No echo at Brewster's angle: TM group delay = d (kappa + cos tan..)/c from q alone."""
    eps, d, f = 4.0, 0.2, 3e9
    c = 1 / math.sqrt(1 + eps)
    kappa = math.sqrt(eps - 1 + c * c)
    delay = fresnel.slab_excess_delay(_tensor(c), _tensor(eps + 0j), _tensor(0j), d, _tensor(f))
    assert float(delay[1]) == pytest.approx(d * (kappa - c) / fresnel.SPEED_OF_LIGHT, rel=1e-10)


def test_gradcheck():
    c = torch.tensor([0.9, 0.3], dtype=F64, requires_grad=True)
    e = torch.tensor([2.0, 6.0], dtype=F64, requires_grad=True)
    loss = torch.tensor([0.1, 0.6], dtype=F64, requires_grad=True)
    d = torch.tensor([0.02, 0.05], dtype=F64, requires_grad=True)
    f = torch.tensor(2.4e9, dtype=F64)

    def run(c, e, loss, d):
        eps = torch.complex(e, -loss)
        r, t = fresnel.slab(c, eps, d, f)
        te, tm = fresnel.interface(c, eps)
        delay = 1e9 * fresnel.slab_excess_delay(c, eps, 1e-10 * eps, d, f)
        return torch.view_as_real(r), torch.view_as_real(t), te.real, tm.imag, delay

    assert torch.autograd.gradcheck(run, (c, e, loss, d))


@pytest.mark.parametrize("eps", [1.0 + 0j, 0.5 + 0j, 1e8 - 1e12j])
@pytest.mark.parametrize("cosine", [0.0, math.sqrt(0.5), 1.0])
@pytest.mark.parametrize("d", [1e-12, 1e3])
def test_gradients_are_finite_at_the_corners(eps, cosine, d):
    c = _tensor(cosine).requires_grad_()
    e = _tensor(complex(eps)).requires_grad_()
    r, t = fresnel.slab(c, e, d, _tensor(6e10))
    delay = fresnel.slab_excess_delay(c, e, 0 * e, d, _tensor(6e10))
    assert r.isfinite().all() and t.isfinite().all() and delay.isfinite().all()
    grads = torch.autograd.grad(r.abs().sum() + t.real.sum() + t.imag.sum(), [c, e])
    assert all(x.isfinite().all() for x in grads)
