"""Losses: closed forms, slopes in float64, and finite at every extreme."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.stats import norm

from rfsg.learn.errors import LearnError
from rfsg.learn.losses import (
    LAWS,
    Losses,
    Predicted,
    log_ndtr,
    loss,
    residual_db,
    spherical,
    tobit,
)
from rfsg.learn.measurements import Measurements
from rfsg.learn.regularisation import (
    Regularisation,
    eikonal,
    laplacian,
    random_points,
    regularised,
)
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Sphere
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor
from tests.learn.rooms import learned

F64 = torch.float64


def predicted(gain: torch.Tensor, delay: torch.Tensor, way: torch.Tensor) -> Predicted:
    power = gain.real**2 + gain.imag**2
    sent = torch.full_like(power, 10.0)
    there = torch.ones(len(gain), dtype=torch.bool)
    return Predicted(gain, power, sent, delay, -way, way, there)


def some_measurements(n: int = 5) -> Measurements:
    """One reading of each kind; the last was not received."""
    row = lambda i, v: [v if k == i else None for k in range(n)]  # noqa: E731
    return Measurements.of(
        tx=["a"] * n,
        rx=["b"] * n,
        frequency_hz=1e9,
        rssi_dbm=row(0, -52.0),
        path_gain_db=row(1, -63.0),
        gain_re=row(2, 1.1e-3),
        gain_im=row(2, -0.4e-3),
        delay_s=row(3, 2.1e-8),
        aoa_azimuth_deg=row(3, 170.0),
        aoa_zenith_deg=row(3, 80.0),
        aod_azimuth_deg=row(3, -20.0),
        threshold_dbm=-58.0,
    )


def leaves(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    gain = 1e-3 * torch.randn(5, 2, generator=generator, dtype=F64)
    delay = 2e-8 + 1e-9 * torch.randn(5, generator=generator, dtype=F64)
    way = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=F64), dim=-1)
    return gain, delay, way


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("censoring", ["tobit", "fill"])
def test_every_loss_has_its_slope(law, censoring):
    """Autograd against central differences in float64, in units of each input's own size."""
    how, measured = Losses(law=law, censoring=censoring), some_measurements()
    gain, delay, way = leaves()

    def cost(g, d, w):
        p = predicted(torch.view_as_complex(1e-3 * g), 1e-9 * d, w)
        return loss(p, measured, how)[0]

    given = [(t).clone().requires_grad_() for t in (1e3 * gain, 1e9 * delay, way)]
    assert torch.autograd.gradcheck(cost, given, eps=1e-6, rtol=1e-5, atol=1e-6)


def test_costs_are_their_closed_forms():
    gain, delay, way = leaves()
    p = predicted(torch.view_as_complex(gain), delay, way)
    measured, how = some_measurements(), Losses()
    costs, counts = loss(p, measured, how)
    db = 20 * torch.log10(torch.linalg.vector_norm(gain, dim=-1))
    assert counts.all()
    assert float(costs[0]) == pytest.approx(0.5 * ((float(db[0]) + 10 + 52) / 2) ** 2)
    assert float(costs[1]) == pytest.approx(0.5 * ((float(db[1]) + 63) / 2) ** 2)
    h = complex(1.1e-3, -0.4e-3)
    off = abs(complex(*gain[2].tolist()) - h) / (0.1 * abs(h))
    assert float(costs[2]) == pytest.approx(0.5 * off**2)
    expected = -norm.logcdf((-58.0 - float(db[4]) - 10.0) / 2.0)
    assert float(costs[4]) == pytest.approx(expected, rel=1e-12)
    assert residual_db(p, measured).tolist()[:2] == pytest.approx(
        [float(db[0]) + 62, float(db[1]) + 63]
    )


@pytest.mark.parametrize("law", LAWS)
def test_a_small_residual_costs_half_its_square_and_an_outlier_less(law):
    small, large = torch.tensor([1e-8], dtype=F64), torch.tensor([100.0], dtype=F64)
    assert float(LAWS[law](small)) == pytest.approx(0.5e-8, rel=1e-6)
    if law != "gaussian":
        assert float(LAWS[law](large)) < 0.3 * float(LAWS["gaussian"](large))


def test_the_tobit_loss_is_its_closed_form_and_finite_at_extremes():
    z = torch.tensor([-8.0, -5.0 - 1e-9, -5.0 + 1e-9, -1.0, 0.0, 3.0, 8.0], dtype=F64)
    torch.testing.assert_close(log_ndtr(z), torch.from_numpy(norm.logcdf(z.numpy())))
    slope = torch.from_numpy(norm.pdf(z.numpy()) / norm.cdf(z.numpy()))
    asked = z.clone().requires_grad_()
    torch.testing.assert_close(torch.autograd.grad(log_ndtr(asked).sum(), asked)[0], slope)
    far = torch.tensor([-1e6, -1e3, -40.0, 40.0, 1e6], dtype=F64, requires_grad=True)
    value = log_ndtr(far)
    (slope,) = torch.autograd.grad(value.sum(), far)
    assert bool(value.isfinite().all()) and bool(slope.isfinite().all())
    # asymptotic: log ndtr(z) = -z^2 / 2 - log(-z sqrt(2 pi)) + ..., slope -z
    assert slope[:3].tolist() == pytest.approx([1e6, 1e3, 40.0], rel=1e-3)
    assert slope[3:].tolist() == [0.0, 0.0]
    threshold = torch.tensor([-90.0], dtype=F64)
    assert float(tobit(threshold, threshold, 3.0)) == pytest.approx(math.log(2.0))


def test_nothing_that_arrives_is_no_reading_but_silence_is_satisfied():
    gain, delay, way = leaves()
    dark = replace(
        predicted(torch.view_as_complex(gain), delay, way),
        power=torch.zeros(5, dtype=F64, requires_grad=True),
        arrives=torch.zeros(5, dtype=torch.bool),
    )
    costs, counts = loss(dark, some_measurements(), Losses())
    assert costs.tolist() == [0.0] * 5
    assert counts.tolist() == [False] * 4 + [True]


def test_deep_fades_have_finite_slopes():
    gain = torch.tensor([[1e-19, 0.0]] * 5, dtype=F64, requires_grad=True)
    _, delay, way = leaves()
    costs, _ = loss(
        predicted(torch.view_as_complex(gain), delay, way), some_measurements(), Losses()
    )
    (slope,) = torch.autograd.grad(costs.sum(), gain)
    assert bool(slope.isfinite().all())


def test_angles_are_spherical_and_turn_round():
    up = torch.tensor([[0.0, 0, 1], [0, 0, -1]], dtype=F64, requires_grad=True)
    angle = spherical(up)
    assert angle.tolist() == [[0.0, 0.0], [0.0, math.pi]]
    (slope,) = torch.autograd.grad(angle.sum(), up)
    assert bool(slope.isfinite().all())
    measured = Measurements.of(
        tx=["a"], rx=["b"], frequency_hz=1e9, delay_s=[1e-9], aoa_azimuth_deg=[179.0]
    )
    turn = math.radians(-179.0)
    way = torch.tensor([[math.cos(turn), math.sin(turn), 0.0]], dtype=F64)
    at = predicted(torch.ones(1, dtype=torch.complex128), torch.tensor([1e-9], dtype=F64), way)
    cost, _ = loss(at, measured, Losses(noise_angle_deg=2.0))
    assert float(cost) == pytest.approx(0.5)


def test_options_out_of_range_are_refused():
    with pytest.raises(LearnError, match="noise_db"):
        Losses(noise_db=0.0)
    with pytest.raises(LearnError, match="law='cauchy'.*gaussian"):
        Losses(law="cauchy")
    with pytest.raises(LearnError, match="laplacian"):
        Regularisation(laplacian=-1.0)
    with pytest.raises(LearnError, match="every=0"):
        Regularisation(every=0)


def test_the_laplacian_of_a_ball_is_its_closed_form():
    """lap |x| = 2 / |x|; in half diagonals of the bounds, half times that."""
    body = Body(Sphere(0.7), Conductor())
    half = 0.7 * math.sqrt(3.0)
    point = torch.nn.functional.normalize(torch.randn(20, 3, dtype=F64), dim=-1) * 0.6
    found = laplacian(body, point, shape=True, surface=True)
    assert float(found) == pytest.approx(half * 2.0 / 0.6, rel=1e-3)
    assert float(eikonal(body, point)) == pytest.approx(0.0, abs=1e-24)


def test_fields_that_are_constant_cost_nothing():
    body = Body(Sphere(0.7), learned(0, bulk=0.3))
    point = random_points(body, 8, torch.Generator().manual_seed(0))
    low, high = body.shape.bounds()
    assert bool(((point >= low) & (point <= high)).all())
    assert float(laplacian(body, point, shape=False, surface=True).detach()) < 1e-9


def test_regularisation_has_its_slope():
    """Along a random direction in all weights together, in float64."""
    torch.manual_seed(0)
    shape = NeuralShape([[-0.5] * 3, [0.5] * 3], width=8, depth=3, skip=1, frequencies=2)
    body = Body(shape, learned(1, bulk=0.3)).double()
    with torch.no_grad():
        body.surface.head_weight.normal_(0.0, 0.05)
    weights = list(body.parameters())
    point = random_points(body, 6, torch.Generator().manual_seed(2))
    way = [torch.randn_like(w) / w.numel() ** 0.5 for w in weights]

    def cost() -> torch.Tensor:
        smooth = laplacian(body, point, shape=True, surface=True)
        return smooth + eikonal(body, point)

    slopes = torch.autograd.grad(cost(), weights, allow_unused=True)
    slope = sum(float((s * w).sum()) for s, w in zip(slopes, way, strict=True) if s is not None)
    values = []
    for step in (1e-6, -2e-6):
        with torch.no_grad():
            for w, d in zip(weights, way, strict=True):
                w.add_(d, alpha=step)
            values.append(float(cost()))
    assert slope == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("surface", [True, False])
@pytest.mark.parametrize("shape", [True, False])
@pytest.mark.parametrize("weights", [(0.3, 0.7), (0.3, 0.0), (0.0, 0.7)])
def test_terms_of_one_sweep_are_those_of_their_own(weights, shape, surface):
    torch.manual_seed(0)
    network = NeuralShape([[-0.5] * 3, [0.5] * 3], width=8, depth=3, skip=1, frequencies=2)
    body = Body(network, learned(1)).double()
    with torch.no_grad():
        body.surface.head_weight.normal_(0.0, 0.05)
    point = random_points(body, 6, torch.Generator().manual_seed(2))
    how = Regularisation(laplacian=weights[0], eikonal=weights[1])
    plain = weights[0] * laplacian(body, point, shape=shape, surface=surface)
    if shape:
        plain = plain + weights[1] * eikonal(body, point)
    found = regularised(body, point, how, shape=shape, surface=surface)
    torch.testing.assert_close(found, plain, rtol=1e-13, atol=0)
    if not found.requires_grad:
        return
    parameters = list(body.parameters())
    slopes = [torch.autograd.grad(x, parameters, allow_unused=True) for x in (found, plain)]
    for p, *pair in zip(parameters, *slopes, strict=True):
        one, other = (torch.zeros_like(p) if s is None else s for s in pair)
        # A Laplacian is a difference over STENCIL^2: rounding comes out 1e4 times as large.
        largest = float(other.abs().max())
        torch.testing.assert_close(one, other, rtol=0, atol=1e-11 * largest)
