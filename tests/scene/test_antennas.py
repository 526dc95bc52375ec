"""Antenna patterns and polarisation: power over the sphere, known values, poles, gradients."""

import math

import numpy as np
import pytest
import torch

from rfsg.scene.antennas import PATTERNS, POLARIZATIONS, angles, basis
from rfsg.scene.errors import SceneError
from rfsg.scene.radios import Radio, amplitude, field_components, port_names

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


@pytest.mark.parametrize("theta", range(0, 181, 15))
@pytest.mark.parametrize("phi", range(-180, 181, 45))
def test_tr38901_is_the_table_everywhere(theta, phi):
    """3GPP TR 38.901 Table 7.3-1, row by row: both cuts, their sum, and the floor under it."""
    vertical = -min(12 * ((theta - 90) / 65) ** 2, 30)
    horizontal = -min(12 * (phi / 65) ** 2, 30)
    if theta in (0, 180):
        horizontal = 0.0  # the azimuth of a pole is taken as 0
    dbi = 8 - min(-(vertical + horizontal), 30)
    gain = 20 * torch.log10(PATTERNS["tr38901"](direction(theta, phi)))
    assert float(gain) == pytest.approx(dbi, abs=1e-9)


# directions


def test_angles_and_basis_at_named_directions():
    x, y, z = torch.eye(3, dtype=torch.float64)
    for d, theta, phi, theta_hat, phi_hat in (
        (x, 90, 0, -z, y),
        (y, 90, 90, -z, -x),
        (-x, 90, 180, -z, -y),
        (z, 0, 0, x, y),
        (-z, 180, 0, -x, y),
    ):
        found = torch.rad2deg(torch.stack(angles(d)))
        torch.testing.assert_close(found, torch.tensor([theta, phi], dtype=torch.float64))
        torch.testing.assert_close(basis(d), torch.stack([theta_hat, phi_hat]))


def test_the_basis_is_right_handed_with_the_direction():
    """theta-hat x phi-hat = r-hat, all of length 1 (TR 38.901 section 7.1)."""
    d = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    theta_hat, phi_hat = basis(d).unbind(-2)
    torch.testing.assert_close(torch.linalg.cross(theta_hat, phi_hat), d)
    whole = torch.stack([theta_hat, phi_hat, d], -2)
    torch.testing.assert_close(whole @ whole.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))


def test_basis_gradients():
    d = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64), dim=-1)
    assert torch.autograd.gradcheck(basis, d.requires_grad_())
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1]], dtype=torch.float64, requires_grad=True)
    basis(poles).sum().backward()
    assert poles.grad is not None and bool(torch.isfinite(poles.grad).all())


# polarisation: TR 38.901 section 7.3.2, model 2


def some_directions(n=40):
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=-1)


def antenna(polarization: str, pattern="isotropic") -> Radio:
    return Radio.at("/r", 0, 0, 0, polarization=polarization, pattern=pattern)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("polarization", ["VH", "cross"])
def test_the_ports_of_a_pair_are_orthogonal_and_each_has_the_whole_power(pattern, polarization):
    d = some_directions()
    first, second = field_components(antenna(polarization, pattern), d).unbind(-2)
    gain = PATTERNS[pattern](d) ** 2
    torch.testing.assert_close((first * second.conj()).sum(-1), torch.zeros_like(first[:, 0]))
    for port in (first, second):
        torch.testing.assert_close((port.abs() ** 2).sum(-1), gain)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(
    "token, zeta", [("V", 0), ("H", 90), ("+45", 45), ("-45", -45), ("none", 0)]
)
def test_a_slant_divides_the_field_by_its_cosine_and_sine(pattern, token, zeta):
    d = some_directions()
    (field,) = field_components(antenna(token, pattern), d).unbind(-2)
    angle = math.radians(zeta)
    expected = PATTERNS[pattern](d)[:, None] * torch.tensor(
        [math.cos(angle), math.sin(angle)], dtype=torch.float64
    )
    torch.testing.assert_close(field.real, expected, rtol=1e-12, atol=1e-15)
    assert not bool(field.imag.any())


def test_pairs_are_their_single_ports_in_order():
    d = some_directions()
    for pair, singles in POLARIZATIONS.items():
        both = field_components(antenna(pair), d)
        for k, single in enumerate(singles):
            torch.testing.assert_close(both[:, k], field_components(antenna(single), d)[:, 0])


def test_v_and_h_are_exact():
    d = some_directions()
    v, h = field_components(antenna("VH"), d).unbind(-2)
    assert not bool(v[:, 1].any()) and not bool(h[:, 0].any())


def test_v_of_a_radio_on_its_side_is_h():
    """Rolled by 90 degrees about its boresight: along it, V has become the H of an upright radio."""
    d = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    roll = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)

    def world(token, rotation):
        local = d @ rotation
        field = field_components(antenna(token), local).real
        return field[0] @ basis(local) @ rotation.T

    upright = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(world("V", roll), world("H", upright))
    torch.testing.assert_close(world("H", roll), -world("V", upright))
    torch.testing.assert_close(world("V", upright), torch.tensor([0.0, 0, -1]).double())


@pytest.mark.parametrize("pattern", ["half_wave_dipole", "short_dipole", "isotropic"])
def test_field_gradients(pattern):
    radio = antenna("cross", pattern)
    d = some_directions(5).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: field_components(radio, v), d, atol=1e-7)


def test_amplitude_is_the_length_of_every_port():
    d = some_directions()
    for token in POLARIZATIONS:
        radio = antenna(token, "tr38901")
        field = field_components(radio, d)
        expected = amplitude(radio, d)[:, None].expand(field.shape[:-1])
        torch.testing.assert_close(torch.linalg.vector_norm(field, dim=-1), expected)


def test_float32_directions_stay_float32():
    d = some_directions().float()
    assert field_components(antenna("VH"), d).dtype == torch.complex64


def test_ports_are_named_polarisation_slowest():
    from rfsg.scene.arrays import Array

    assert port_names(antenna("none")) == ("none:0",)
    pair = Radio.at("/r", 0, 0, 0, polarization="cross", array=Array.planar(1, 2))
    assert port_names(pair) == ("+45:0", "+45:1", "-45:0", "-45:1")


@pytest.mark.parametrize("field, value", [("polarization", "circular"), ("pattern", "yagi")])
def test_a_radio_names_what_it_does_not_know(field, value):
    with pytest.raises(SceneError, match=f"^/r: {field} is '{value}'; expected one of "):
        Radio.at("/r", 0, 0, 0, **{field: value})
