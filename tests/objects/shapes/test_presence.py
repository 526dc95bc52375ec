"""Shapes without a surface are told from thin ones, and from small ones."""

import pytest
import torch

from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.shapes.presence import absence
from tests.tracer.shapes import Field, ball

HALF = [0.5, 0.4, 0.6]


def plate(thickness: float, at: float = 0.123):
    """f of a plate across z: none of a few thousand points falls into a thin one."""
    return lambda p: (p[..., 2] - at).abs() - 0.5 * thickness


def network() -> NeuralShape:
    return NeuralShape([[-0.5] * 3, [0.5] * 3], width=8, depth=3, skip=1, lipschitz=2.0)


@pytest.mark.parametrize(
    "f",
    [plate(0.1), plate(1e-3), plate(1e-5), ball(0.3), ball(0.01), lambda p: -plate(1e-4)(p)],
    ids=["plate", "1 mm", "10 um", "ball", "1 cm ball", "a slit in a solid"],
)
def test_what_has_a_surface(f):
    assert absence(Field(f, HALF)) is None


@pytest.mark.parametrize(
    ("f", "words"),
    [
        (lambda p: 0.0 * p[..., 0] + 0.2, "f is 0.2 to 0.2 m, everywhere positive"),
        (lambda p: 0.0 * p[..., 0] - 0.2, "f is -0.2 to -0.2 m, everywhere negative"),
        (lambda p: 0.0 * p[..., 0], "nothing to hit"),
        (lambda p: (p * p).sum(-1) + 0.01, "everywhere positive, so it has no inside"),
        (lambda p: p[..., 0] - 1.0, "everywhere negative, so it has no outside"),
        (lambda p: p[..., 0] / 0.0, "not a number"),
    ],
)
def test_what_has_none(f, words):
    assert words in str(absence(Field(f, HALF)))


def test_networks():
    shape = network()
    assert absence(shape) is None
    with torch.no_grad():
        shape.to_value.bias += 20.0
    assert "everywhere positive" in str(absence(shape))
    with torch.no_grad():
        shape.to_value.bias -= 40.0
    assert "everywhere negative" in str(absence(shape))
    with torch.no_grad():
        shape.to_value.weight.zero_()
        shape.to_value.bias.fill_(0.1)
    assert "has no surface within its bounds: nothing to hit" in str(absence(shape))
    with torch.no_grad():
        shape.hidden[0].weight[0, 0] = torch.nan
    assert "weights are broken" in str(absence(shape))
