"""Lobes of diffuse reflection (Degli-Esposti et al. 2007) against quadrature."""

import json
import math

import numpy as np
import pytest
import torch

from rfsg.objects.physics.lobes import Scattering, mirrored, normalisation, share_amplitude

KINDS = {
    "lambertian": {},
    "directive 1": {"lobe": "directive", "alpha_r": 1},
    "directive 4": {"lobe": "directive", "alpha_r": 4},
    "directive 50": {"lobe": "directive", "alpha_r": 50},
    "backscattering": {
        "lobe": "backscattering",
        "alpha_r": 6,
        "alpha_i": 3,
        "forward_share": 0.7,
    },
    "back only": {
        "lobe": "backscattering",
        "alpha_r": 2,
        "alpha_i": 5,
        "forward_share": 0.0,
    },
}
INCIDENCES = (0.0, 15.0, 40.0, 65.0, 80.0, 89.0)
NORMAL = torch.tensor([0.36, -0.48, 0.8], dtype=torch.float64)


def frame():
    """Two unit vectors across NORMAL."""
    x = torch.tensor([0.8, 0.6, 0.0], dtype=torch.float64)
    return x, torch.linalg.cross(NORMAL, x)


def arriving(degrees: float):
    x, y = frame()
    theta = math.radians(degrees)
    side = math.cos(0.7) * x + math.sin(0.7) * y
    return math.sin(theta) * side - math.cos(theta) * NORMAL


def hemisphere(n: int = 160):
    """Gauss points in cos(theta), even ones in phi: exact for polynomials far above alpha."""
    node, weight = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(n))
    height, weight = 0.5 * (node + 1.0), 0.5 * weight
    phi = 2.0 * math.pi * torch.arange(2 * n, dtype=torch.float64) / (2 * n)
    r = torch.sqrt(1.0 - height**2)[:, None]
    x, y = frame()
    around = torch.cos(phi)[:, None] * x + torch.sin(phi)[:, None] * y
    out = r[..., None] * around[None] + height[:, None, None] * NORMAL
    area = (weight[:, None] * 2.0 * math.pi / (2 * n)).expand(n, 2 * n)
    return out.reshape(-1, 3), area.reshape(-1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("degrees", INCIDENCES)
def test_every_lobe_holds_one_at_every_incidence(kind, degrees):
    out, area = hemisphere()
    scattering = Scattering(1.0, **KINDS[kind])
    p = scattering.density(arriving(degrees).expand_as(out), out, NORMAL.expand_as(out))
    assert bool((p >= 0).all())
    assert float((p * area).sum()) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("alpha", [1, 2, 7, 128])
def test_the_closed_sum_against_plain_quadrature(alpha):
    """F_alpha by its own definition; at grazing incidence half of the lobe's 4 pi / (alpha + 1) lies
    above the surface."""
    out, area = hemisphere(400)
    for degrees in INCIDENCES:
        axis = mirrored(arriving(degrees), NORMAL)
        lobe = (0.5 * (1.0 + out @ axis)) ** alpha
        cosine = torch.tensor(math.cos(math.radians(degrees)), dtype=torch.float64)
        expected = float((lobe * area).sum())
        assert float(normalisation(alpha, cosine)) == pytest.approx(expected, rel=1e-7)
    grazing = normalisation(alpha, torch.zeros((), dtype=torch.float64))
    assert float(grazing) == pytest.approx(2.0 * math.pi / (alpha + 1), rel=1e-12)


def test_the_lobe_looks_where_it_should():
    out, _ = hemisphere()
    k = arriving(40.0)
    forward = Scattering(1.0, "directive", alpha_r=20)
    back = Scattering(1.0, "backscattering", alpha_r=1, alpha_i=20, forward_share=0.0)
    for scattering, axis in ((forward, mirrored(k, NORMAL)), (back, -k)):
        best = out[scattering.density(k.expand_as(out), out, NORMAL.expand_as(out)).argmax()]
        assert float(best @ axis) > math.cos(0.03)
    behind = -out
    assert not bool(forward.density(k.expand_as(out), behind, NORMAL.expand_as(out)).any())
    assert not bool(forward.density(-k.expand_as(out), out, NORMAL.expand_as(out)).any())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("degrees", [10.0, 75.0])
def test_draws_follow_the_lobe(kind, degrees):
    """Weighted draws give 1, and the first moments of the lobe, within their own scatter."""
    m = 40_000
    scattering = Scattering(1.0, **KINDS[kind])
    k, n = arriving(degrees).expand(m, 3), NORMAL.expand(m, 3)
    u = torch.rand(m, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    drawn, weight = scattering.draw(k, n, u)
    assert torch.allclose(drawn.norm(dim=-1), torch.ones(m, dtype=torch.float64))
    assert bool((weight[(drawn @ NORMAL) <= 0] == 0).all())
    out, area = hemisphere()
    p = scattering.density(arriving(degrees).expand_as(out), out, NORMAL.expand_as(out)) * area
    for values, truth in (
        (weight, 1.0),
        *((weight * drawn[:, a], float((p * out[:, a]).sum())) for a in range(3)),
        (weight * (drawn @ NORMAL) ** 2, float((p * (out @ NORMAL) ** 2).sum())),
    ):
        error = float(values.std()) / m**0.5
        assert abs(float(values.mean()) - truth) < 4.5 * error + 1e-12


def test_shares_of_power():
    """S^2 + (1 - S^2) = 1, exact at both ends, with finite slopes there."""
    for s in (0.0, 0.3, 1.0):
        scattering = Scattering(s)
        diffuse, mirror = scattering.diffuse_amplitude(), scattering.mirror_amplitude()
        assert float(diffuse**2 + mirror**2) == pytest.approx(1.0, abs=1e-15)
    assert float(Scattering(0.0).mirror_amplitude()) == 1.0
    assert float(Scattering(1.0).mirror_amplitude()) == 0.0
    for s in (0.0, 1.0):
        scattering = Scattering(s)
        scattering.coefficient.requires_grad_(True)
        (slope,) = torch.autograd.grad(scattering.mirror_amplitude(), scattering.coefficient)
        assert bool(torch.isfinite(slope))
    power = torch.tensor([0.0, 1e-13, 1e-12, 0.25, 1.0], dtype=torch.float64)
    assert share_amplitude(power).tolist() == pytest.approx([0.0, 1e-7, 1e-6, 0.5, 1.0])


@pytest.mark.parametrize("kind", KINDS)
def test_density_differentiates(kind):
    scattering = Scattering(1.0, **KINDS[kind])

    def density(k, out, n):
        k, out, n = (v / v.norm(dim=-1, keepdim=True) for v in (k, out, n))
        return scattering.density(k, out, n)

    k = torch.stack([arriving(30.0), arriving(70.0)]).requires_grad_(True)
    out = torch.stack([mirrored(arriving(20.0), NORMAL), NORMAL + 0.1]).requires_grad_(True)
    n = NORMAL.repeat(2, 1).requires_grad_(True)
    assert torch.autograd.gradcheck(density, (k, out, n))


def test_config_round_trips_and_wrong_numbers_are_refused():
    for options in KINDS.values():
        scattering = Scattering(0.4, **options, cross_share=0.1)
        text = json.dumps(scattering.config())
        again = Scattering.of(json.loads(text))
        assert again is not None and again.config() == scattering.config()
    for wrong, name in (
        ({"coefficient": 1.2}, "coefficient"),
        ({"coefficient": float("nan")}, "coefficient"),
        ({"coefficient": 0.5, "lobe": "gaussian"}, "lobe"),
        ({"coefficient": 0.5, "lobe": "directive"}, "alpha_r"),
        ({"coefficient": 0.5, "lobe": "directive", "alpha_r": 0}, "alpha_r"),
        ({"coefficient": 0.5, "alpha_r": 3}, "alpha_r"),
        ({"coefficient": 0.5, "cross_share": -0.1}, "cross_share"),
    ):
        with pytest.raises(ValueError, match=f"scattering: {name}"):
            Scattering(**wrong)
