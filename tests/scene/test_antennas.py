"""Antenna patterns: power over the sphere, known values, poles without NaN, gradients."""

import math

import numpy as np
import pytest
import torch

from rfsg.scene.antennas import PATTERNS

LOSSLESS = ("isotropic", "short_dipole", "half_wave_dipole")


def direction(theta_deg, phi_deg):
    theta, phi = (
        torch.deg2rad(torch.as_tensor(a, dtype=torch.float64)) for a in (theta_deg, phi_deg)
    )
    parts = (theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos() * torch.ones_like(phi))
    return torch.stack(torch.broadcast_tensors(*parts), -1)


def mean_gain(pattern) -> float:
    """Mean of G over the sphere by Gauss-Legendre in cos(theta): 1 for a lossless antenna."""
    cosine, weight = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(400))
    phi = torch.arange(-179.75, 180, 0.5, dtype=torch.float64)
    gain = pattern(direction(torch.rad2deg(cosine.acos())[:, None], phi)) ** 2
    return float((gain.mean(-1) * weight).sum() / 2)


@pytest.mark.parametrize("name", LOSSLESS)
def test_lossless_patterns_radiate_what_they_are_given(name):
    assert mean_gain(PATTERNS[name]) == pytest.approx(1.0, abs=1e-12)


def test_the_3gpp_element_has_a_directivity_of_its_own():
    """Table 7.3-1 gives a gain of 8 dBi; the shape of the pattern alone has 9.8 dBi."""
    directivity_dbi = 8 - 10 * math.log10(mean_gain(PATTERNS["tr38901"]))
    assert directivity_dbi == pytest.approx(9.83, abs=0.01)


@pytest.mark.parametrize(
    "name, theta, phi, dbi",
    [
        ("isotropic", 20, 30, 0.0),
        ("short_dipole", 90, 77, 1.7609),  # 10 log10 1.5
        ("short_dipole", 30, 0, 1.7609 - 6.0206),  # sin^2 30 degrees
        ("half_wave_dipole", 90, 0, 2.1509),  # 10 log10 1.6409, Balanis section 4.6
        ("half_wave_dipole", 51, 0, 2.1509 - 3.0),  # half-power beam width 78 degrees
        ("tr38901", 90, 0, 8.0),
        ("tr38901", 90, 32.5, 5.0),  # 3 dB at half the beam width, both ways
        ("tr38901", 122.5, 0, 5.0),
        ("tr38901", 122.5, -32.5, 2.0),
        ("tr38901", 90, 180, -22.0),  # 30 dB front to back
        ("tr38901", 0, 0, 8 - 12 * (90 / 65) ** 2),
    ],
)
def test_known_gains(name, theta, phi, dbi):
    gain = 20 * torch.log10(PATTERNS[name](direction(theta, phi)))
    assert float(gain) == pytest.approx(dbi, abs=0.05 if theta == 51 else 1e-3)


@pytest.mark.parametrize("name", PATTERNS)
def test_poles_have_values_and_gradients_without_nan(name):
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1e-160, 0, 1]], dtype=torch.float64)
    poles.requires_grad_()
    gain = PATTERNS[name](poles)
    (gain.sum() + 0 * poles.sum()).backward()  # a constant has a gradient of zero
    assert bool(torch.isfinite(gain).all()) and bool(torch.isfinite(poles.grad).all())


@pytest.mark.parametrize("name", PATTERNS)
def test_gradients(name):
    d = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64), dim=-1)
    d[0] = torch.tensor([1.0, 0, 0])
    if name == "tr38901":  # away from the kinks of its floor
        d = direction([60.0, 80, 110], [20.0, -35, 50])
    assert torch.autograd.gradcheck(PATTERNS[name], d.requires_grad_(), atol=1e-7)


@pytest.mark.parametrize("name", PATTERNS)
def test_batch_is_loop(name):
    d = torch.nn.functional.normalize(torch.randn(2, 3, 3, dtype=torch.float64), dim=-1)
    one_by_one = torch.stack([PATTERNS[name](v) for v in d.reshape(-1, 3)]).reshape(2, 3)
    torch.testing.assert_close(PATTERNS[name](d), one_by_one)
