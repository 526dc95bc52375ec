"""Sketches of networks against the networks, and mixing against what it solves exactly."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes import sketch as sketches
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.shapes.sketch import BLOCK, Sketched, sketch, sketch_of
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.mixing import History
from tests.tracer.shapes import Field


def quadratic() -> Field:
    """f = c + b.x + x.H.x / 2: what a sketch is exact for, but for float32."""
    generator = torch.Generator().manual_seed(4)
    half, slope = torch.randn(3, 3, generator=generator), torch.randn(3, generator=generator)

    def f(p: torch.Tensor) -> torch.Tensor:
        pull = p @ (half + half.T).to(p)
        return 0.02 + p @ slope.to(p) + 0.5 * (pull * p).sum(-1)

    return Field(f, [0.31, 0.4, 0.25])


def _places(shape, count: int = 3000) -> torch.Tensor:
    low, high = shape.bounds()
    generator = torch.Generator().manual_seed(7)
    return low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)


def plain(shape, found, point):
    """The sums of the module's head, corner by corner, at the grid that each point falls in."""
    value, gradient = [], []
    for p in point.float():
        place = (p - found.low) / found.step
        block = [
            min(int(u / BLOCK), n - 1)
            for u, n in zip(place.tolist(), found.block.shape, strict=True)
        ]
        step = found.step if int(found.block[tuple(block)]) >= 0 else found.step * BLOCK
        cell = torch.floor((p - found.low) / step)
        total, slope = torch.zeros(()), torch.zeros(3)
        for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
            x = found.low + step * (cell + corner)
            share = (1.0 - (p - x).abs() / step).prod()
            f, g = shape.value_and_gradient(x[None])
            total = total + share * (f[0] + 0.5 * (g[0] * (p - x)).sum())
            slope = slope + share * g[0]
        value.append(total)
        gradient.append(slope)
    return torch.stack(value), torch.stack(gradient)


def test_a_sketch_of_a_quadratic_is_the_quadratic():
    shape = quadratic()
    found = sketch(shape, 0.02)
    fine = found.block >= 0
    assert bool(fine.any()) and bool((~fine).any())  # both grids are asked
    point = _places(shape).float()
    value, gradient = found.value_and_gradient(point)
    expected, slope = shape.value_and_gradient(point)
    torch.testing.assert_close(value, expected, rtol=0, atol=2e-6)
    torch.testing.assert_close(gradient, slope, rtol=0, atol=2e-5)


@torch.no_grad()
def test_a_sketch_is_the_sum_over_corners():
    shape = NeuralShape([[-0.4] * 3, [0.4] * 3], width=16, depth=3, skip=1, seed=2)
    found = sketch(shape, 0.03)
    point = _places(shape, 60)
    value, gradient = found.value_and_gradient(point)
    expected, slope = plain(shape, found, point)
    torch.testing.assert_close(value, expected, rtol=0, atol=2e-6)
    # places of 0.8 m in cells of 0.03 m round to 3e-6 of a cell, and so do the shares of its corners
    torch.testing.assert_close(gradient, slope, rtol=0, atol=1e-5)


@torch.no_grad()
def test_errors_near_the_surface_are_as_tested_and_fall_with_the_step():
    shape = NeuralShape([[-0.4] * 3, [0.4] * 3], width=16, depth=3, skip=1, seed=2)
    errors = []
    for step in (0.04, 0.02):
        found = sketch(shape, step)
        point = _places(shape).float()
        for _ in range(4):
            value, gradient = shape.value_and_gradient(point)
            square = (gradient * gradient).sum(-1, keepdim=True).clamp(min=0.1)
            point = (point - value[:, None] * gradient / square).clamp(-0.4, 0.4)
        off = (found.value_and_gradient(point)[0] - shape.sdf(point)).abs()
        # the same share of other points, give or take what a share of 1 % of 4096 may vary by
        assert float((off > 1.5 * found.error).double().mean()) < 1.0 - sketches.MOST
        errors.append(found.error)
    assert errors[1] < 0.5 * errors[0]


def test_beyond_the_bounds_values_grow_with_the_distance():
    found = sketch(quadratic(), 0.02)
    out = torch.tensor([[0.31 + 0.5, 0.1, 0.1]])
    edge = torch.tensor([[0.31, 0.1, 0.1]])
    there, here = found.value_and_gradient(out)[0], found.value_and_gradient(edge)[0]
    assert float(there - here) > 0.45  # the grid may reach past the bounds by less than a block


def test_a_world_sketches_networks_whose_sketches_are_good_enough():
    shape = NeuralShape([[-0.4] * 3, [0.4] * 3], width=16, depth=3, skip=1, seed=2)
    world = World(Scene((Node("/n", Body(shape, Conductor()), Pose.at(1.0, 0.0, 0.0)),)))
    found = sketch_of(shape)
    assert found is not None and sketch_of(shape) is found
    rough = world.sketched(2.0 * found.error)
    assert isinstance(rough.shapes[0], Sketched) and world.shapes[0] is shape
    assert world.sketched(0.5 * found.error) is world
    with torch.no_grad():
        shape.to_value.bias.add_(0.01)
    assert sketch_of(shape) is not found  # of other weights


# mixing


def _linear(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Maps x -> A x + b of 40 rows with three slow directions, and where they rest."""
    generator = torch.Generator().manual_seed(seed)
    base = torch.linalg.qr(torch.randn(40, 6, 6, generator=generator, dtype=torch.float64))[0]
    factor = torch.tensor([0.9, -0.8, 0.6, 0.0, 0.0, 0.0], dtype=torch.float64)
    return base @ torch.diag(factor) @ base.mT, torch.randn(
        40, 6, generator=generator, dtype=torch.float64
    )


def test_linear_rounds_with_three_slow_directions_end_after_four():
    """Anderson's mixing of m + 1 rounds is GMRES: exact where the map has m factors that are not 0."""
    matrix, rest = _linear()
    x, rows = torch.zeros_like(rest), torch.arange(len(rest))
    history = History.none(len(rest), 6, rest)
    for number in range(5):
        led = torch.einsum("mij,mj->mi", matrix, x - rest) + rest
        x = history.mixed(rows, led, led - x, torch.ones_like(x), number)
    torch.testing.assert_close(x, rest, rtol=0, atol=1e-6)


@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_rounds_that_all_change_alike_are_mixed_without_a_number_that_is_not_finite(rounds):
    history = History.none(3, 4, torch.zeros(0, dtype=torch.float64))
    rows, one = torch.arange(3), torch.ones(3, 4, dtype=torch.float64)
    for number in range(5):
        x = history.mixed(rows, one * number, one, one, min(number, rounds))
        assert bool(torch.isfinite(x).all())


def test_what_weighs_nothing_has_no_say():
    """Of two parts that converge at factors of their own, one weighed alone is solved by one mix."""
    rows, x = torch.arange(1), torch.tensor([[1.0, 1.0]], dtype=torch.float64)
    factor, scale = torch.tensor([[0.5, 0.9]]), torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    history = History.none(1, 2, x)
    for number in (0, 1):
        led = factor * x
        x = history.mixed(rows, led, led - x, scale, number)
    assert abs(float(x[0, 0])) < 1e-6 and abs(float(x[0, 1])) > 0.1
