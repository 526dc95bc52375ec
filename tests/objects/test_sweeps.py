"""Heads of a network as one node of autograd, against the plain sweep."""

import pytest
import torch

from rfsg.objects.sweeps import plain_heads, swept_heads

SKIP = 2


def network(inputs=5, width=4, heads=3, depth=4):
    generator = torch.Generator().manual_seed(0)
    widths = [inputs] + [width + inputs * (i == SKIP) for i in range(1, depth)]
    shapes = [shape for n in widths for shape in ((width, n), (width,))]
    return [
        torch.randn(shape, generator=generator, dtype=torch.float64).requires_grad_()
        for shape in (*shapes, (heads, width), (heads,))
    ]


def inputs(*batch):
    generator = torch.Generator().manual_seed(1)
    return torch.randn(*batch, 5, generator=generator, dtype=torch.float64).requires_grad_()


@pytest.mark.parametrize("batch", [(0,), (7,), (3, 2)])
def test_answers_and_derivatives_are_those_of_the_plain_sweep(batch):
    x, weights = inputs(*batch), network()
    fused, plain = swept_heads(SKIP, x, *weights), plain_heads(SKIP, x, *weights)
    assert fused.shape == plain.shape == (*batch, 3)
    torch.testing.assert_close(fused, plain, rtol=1e-13, atol=1e-13)
    with torch.no_grad():
        torch.testing.assert_close(swept_heads(SKIP, x, *weights), plain, rtol=1e-13, atol=1e-13)
    pull = torch.cos(torch.arange(plain.numel()).double()).reshape(plain.shape)
    found = torch.autograd.grad(fused, [x, *weights], pull)
    expected = torch.autograd.grad(plain, [x, *weights], pull)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_derivatives_agree_with_finite_differences_to_second_order():
    x, weights = inputs(2), network()
    ask = lambda *given: swept_heads(SKIP, *given)  # noqa: E731
    assert torch.autograd.gradcheck(ask, (x, *weights))
    assert torch.autograd.gradgradcheck(ask, (x, *weights))


def test_weights_in_another_precision_are_cast_and_their_gradients_cast_back():
    x, weights = inputs(6), [w.detach().float().requires_grad_() for w in network()]
    found = torch.autograd.grad(swept_heads(SKIP, x, *weights).sum(), weights)
    expected = torch.autograd.grad(plain_heads(SKIP, x, *weights).sum(), weights)
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a, b)
