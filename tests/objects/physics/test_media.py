"""ITU-R P.2040-4 Table 3: values by hand, band edges, and what is refused."""

import math

import pytest
import torch

from rfsg.objects.physics import media

F64 = torch.float64


def test_concrete_by_hand():
    """eps_r = 5.24, sigma = 0.0462 * 3.5^0.7822 S/m at 3.5 GHz; eps'' = 17.98 sigma / f."""
    eps = media.complex_permittivity("concrete", 3.5e9)
    sigma = 0.0462 * 3.5**0.7822
    assert float(eps.real) == 5.24
    assert float(eps.imag) == pytest.approx(-17.98 * sigma / 3.5, rel=1e-3)
    exact = -sigma / (2 * math.pi * 3.5e9 * media.VACUUM_PERMITTIVITY)
    assert float(eps.imag) == pytest.approx(exact, rel=1e-14)


@pytest.mark.parametrize("name", sorted(media.MATERIALS))
def test_edges_belong_to_the_band_and_beyond_is_refused(name):
    rows = media.MATERIALS[name]
    for row in rows:
        for edge in (row.low, row.high):
            eps = media.complex_permittivity(name, edge * 1e9)
            assert eps.real >= 1 and eps.imag <= 0
    low, high = min(r.low for r in rows) * 1e9, max(r.high for r in rows) * 1e9
    for outside in (low * 0.99, high * 1.01):
        with pytest.raises(ValueError, match=rf"{name}.*GHz.*extrapolate=True"):
            media.complex_permittivity(name, outside)
        assert media.complex_permittivity(name, outside, extrapolate=True).isfinite()


def test_the_gap_between_bands_is_outside():
    with pytest.raises(ValueError, match="1-40 GHz, 110-330 GHz, not for 60 GHz"):
        media.complex_permittivity("brick", 60e9)
    eps = media.complex_permittivity("brick", 60e9, extrapolate=True)
    assert float(eps.real) == 3.91  # 40 GHz is nearer to 60 GHz than 110 GHz is


def test_each_frequency_finds_its_own_row():
    eps = media.complex_permittivity("concrete", torch.tensor([[2e9], [200e9]], dtype=F64))
    assert eps.shape == (2, 1) and eps.real.flatten().tolist() == [5.24, 5.17]


def test_vacuum_and_metal():
    assert media.complex_permittivity("vacuum", 1e9) == 1
    assert float(media.complex_permittivity("metal", 1e9).imag) < -1e8


def test_unknown_material_is_named():
    with pytest.raises(ValueError, match="'steel'.*concrete.*eps_r and sigma"):
        media.complex_permittivity("steel", 1e9)
    with pytest.raises(ValueError, match="positive number of hertz"):
        media.complex_permittivity("concrete", 0.0)


@pytest.mark.parametrize("name", ["concrete", "plywood", "wet_ground", "vacuum"])
def test_slope_is_the_derivative(name):
    f = torch.tensor([2.4e9, 5.2e9], dtype=F64)
    step = 1e3
    difference = media.complex_permittivity(name, f + step) - media.complex_permittivity(
        name, f - step
    )
    slope = media.permittivity_slope(name, f)
    torch.testing.assert_close(slope, difference / (2 * step), rtol=1e-6, atol=1e-20)
    assert torch.autograd.gradcheck(
        lambda x: torch.view_as_real(media.complex_permittivity(name, x * 1e9)),
        (f * 1e-9).requires_grad_(),
    )
