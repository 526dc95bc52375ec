"""The network distance: hand-written sweeps against autograd, start, precision, Lipschitz bound."""

import json

import pytest
import torch

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.neural import CPU_CHUNK, NeuralShape, compute_lipschitz
from rfsg.objects.shapes.sweeps import Question

BOUNDS = [[-0.4, -0.7, 0.0], [0.6, 0.5, 1.1]]


def shape(seed=0, **sizes):
    """An untrained network with its sines awake, so that all terms of the sweeps count."""
    s = NeuralShape(BOUNDS, seed=seed, lipschitz=2.0, **sizes)
    generator = torch.Generator().manual_seed(seed + 1)
    with torch.no_grad():
        for p in s.parameters():
            p += 0.05 * torch.randn(p.shape, generator=generator)
    return s


def points(n=50, seed=0, dtype=torch.float64):
    low, high = torch.tensor(BOUNDS, dtype=torch.float64)
    g = torch.Generator().manual_seed(seed)
    return (low + (high - low) * torch.rand(n, 3, generator=g, dtype=torch.float64)).to(dtype)


def test_satisfies_the_contract_and_comes_back_from_its_config():
    s = shape()
    assert isinstance(s, Shape) and not s.convex and not s.exact
    again = NeuralShape(**json.loads(json.dumps(s.config())))
    again.load_state_dict(s.state_dict())
    assert torch.equal(again.sdf(points()), s.sdf(points()))
    assert torch.equal(again.bounds(), s.bounds()) and again.lipschitz == s.lipschitz
    assert s.planes().shape == (0, 4)
    with pytest.raises(NotImplementedError, match="convex"):
        s.interval(points(), points())


def test_it_is_the_network_of_the_paper():
    s = NeuralShape(BOUNDS, lipschitz=2.0)
    assert len(s.hidden) == 8 and {layer.out_features for layer in s.hidden} == {64}
    assert s.hidden[0].in_features == 3 + 2 * 3 * 6
    assert s.hidden[4].in_features == 64 + 39
    assert s.feature(points()).shape == (50, 128)


def test_gradient_agrees_with_autograd():
    s, x = shape(), points().requires_grad_()
    (expected,) = torch.autograd.grad(s.sdf(x).sum(), x)
    value, gradient = s.value_and_gradient(x)
    assert torch.equal(value, s.sdf(x))
    assert torch.allclose(gradient, expected, rtol=1e-10, atol=1e-10)


def test_hessian_agrees_with_autograd_of_the_value():
    s, x = shape(), points(8)
    hessian = torch.stack([torch.autograd.functional.hessian(s.sdf, p) for p in x])
    jet = s.jet(x)
    assert torch.allclose(jet.hessian, hessian, rtol=1e-8, atol=1e-8 * hessian.abs().max())
    assert hessian.abs().max() > 1.0
    assert torch.equal(jet.gradient, s.value_and_gradient(x)[1])


def test_everything_can_be_differentiated_in_points_and_weights():
    s = shape(width=4, depth=3, skip=1, frequencies=2, features=2).double()
    names = [n for n, _ in s.named_parameters()]
    x = points(2).requires_grad_()
    weights = [p.detach().clone().requires_grad_() for p in s.parameters()]

    class Ask(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.s = s

        def forward(self, p):
            jet = self.s.jet(p)
            return jet.hessian, *self.s.value_gradient_feature(p), self.s.feature(p)

    def answers(p, *w):
        state = {f"s.{n}": v for n, v in zip(names, w, strict=True)}
        return torch.func.functional_call(Ask(), state, (p,))

    assert torch.autograd.gradcheck(answers, (x, *weights), eps=1e-6, atol=1e-4, rtol=1e-4)


ASKED = [(True, False, False), (False, False, True), (True, True, False), (True, True, True)]


def asked_plainly(s, x, asked):
    """The same question, its graph autograd's own: one node for every operation."""
    own = (t.to(x.dtype) for t in (s._centre, s._reach, s._octaves))
    question = Question(s.skip, s.softness, *own, *asked)
    return s._plain(question, x, *s._parameters_in_turn())


def asked_at_once(s, x, asked):
    return s._answers(x, **dict(zip(("value", "gradient", "feature"), asked, strict=True)))


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize("count", [0, 1, 40])
def test_derivatives_of_one_node_are_those_of_the_plain_sweep(asked, count):
    """Of points and of every weight, whichever answers the loss depends on."""
    s, x = shape(), points(count).requires_grad_()
    inputs = [x, *s.parameters()]
    fused, plain = asked_at_once(s, x, asked), asked_plainly(s, x, asked)
    generator = torch.Generator().manual_seed(5)
    pull = [torch.randn(a.shape, generator=generator, dtype=a.dtype) for a in plain]
    subsets = [range(len(plain)), *([i] for i in range(len(plain)))]
    for some in subsets:
        found, expected = (
            torch.autograd.grad(
                [answers[i] for i in some],
                inputs,
                [pull[i] for i in some],
                retain_graph=True,
                materialize_grads=True,
                allow_unused=True,
            )
            for answers in (fused, plain)
        )
        for a, b in zip(found, expected, strict=True):
            tolerance = 1e-12 if b.dtype == torch.float64 else 1e-6
            assert a.dtype == b.dtype
            size = float(b.abs().max()) if b.numel() else 0.0
            torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance * size)


def test_second_derivatives_of_one_node_are_right():
    """Points that depend on the weights too: what goes through them must not count twice."""
    s = shape(width=4, depth=3, skip=1, frequencies=2, features=2).double()
    weights = list(s.parameters())
    found = []
    for ask in (asked_at_once, asked_plainly):
        x = points(3) + 0.1 * weights[0].sum()
        value, gradient, feature = ask(s, x, (True, True, True))
        total = (value**2).sum() + (gradient**3).sum() + (feature**2).sum()
        first = torch.autograd.grad(total, weights, create_graph=True)
        found.append(torch.autograd.grad(sum((g * g).sum() for g in first), weights))
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9 * float(b.abs().max()))


def test_frozen_weights_and_points_are_left_alone():
    s, x = shape(), points(5)
    s.requires_grad_(False)
    assert not any(a.requires_grad for a in s.value_gradient_feature(x))
    s.to_value.requires_grad_(True)
    s.value_and_gradient(x)[1].sum().backward()
    assert s.hidden[0].weight.grad is None and s.to_value.weight.grad is not None


def test_one_sweep_gives_the_same_as_three_questions():
    s, x = shape(), points(7).reshape(7, 1, 3).expand(7, 2, 3)
    value, gradient, feature = s.value_gradient_feature(x)
    assert value.shape == (7, 2) and gradient.shape == (7, 2, 3) and feature.shape == (7, 2, 128)
    assert torch.allclose(value, s.sdf(x)) and torch.allclose(feature, s.feature(x))
    assert torch.allclose(gradient, s.value_and_gradient(x)[1])


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize("count", [0, 1, 2 * CPU_CHUNK + 5])
def test_answers_without_a_graph_are_those_of_the_plain_sweep(asked, count):
    s, x = shape(), points(count)
    whole = asked_plainly(s, x, asked)
    with torch.no_grad():
        pieces = asked_at_once(s, x, asked)
    for a, b in zip(whole, pieces, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-11)
    # nothing that a later chunk needs the room of
    with torch.no_grad():
        again = asked_at_once(s, x.flip(0), asked)
    for a, b in zip(pieces, again, strict=True):
        torch.testing.assert_close(a, b.flip(0), rtol=1e-12, atol=1e-11)


def test_float32_without_a_graph_is_as_exact_as_with_one():
    s, x = shape(), points(4000, dtype=torch.float32)
    exact = s.value_and_gradient(x.double())
    recorded = s.value_and_gradient(x)
    with torch.no_grad():
        swept = s.value_and_gradient(x)
    for a, b, c in zip(exact, recorded, swept, strict=True):
        assert c.dtype == torch.float32
        assert (c - a).square().mean() <= 1.5 * (b - a).square().mean()


def test_dtype_of_the_points_decides_the_precision():
    s, x = shape(), points(200)
    assert s.sdf(x).dtype == torch.float64 and s.sdf(x.float()).dtype == torch.float32
    assert (s.sdf(x) - s.sdf(x.float().double())).abs().max() < 1e-5
    difference = (s.sdf(x.float().double()) - s.sdf(x.float()).double()).abs().max()
    assert 0 < difference < 1e-5
    assert all(p.dtype == torch.float32 for p in s.parameters())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_new_network_is_about_a_sphere(seed):
    s, x = NeuralShape(BOUNDS, seed=seed, lipschitz=2.0), points(2000)
    centre = s.bounds().mean(0)
    reach = (s.bounds()[1] - s.bounds()[0]).max() / 2
    away = (x - centre).norm(dim=-1)
    value, gradient = s.value_and_gradient(x)
    assert (value - (away - reach / 2)).abs().mean() < 0.3 * reach
    outward = (gradient * (x - centre)).sum(-1) / away
    assert (outward[away > 0.3 * reach] > 0.3).all()
    assert s.sdf(centre) < 0 and (s.sdf(s.bounds()) > 0).all()


def test_lipschitz_bound_holds_on_independent_samples():
    s = shape(3)
    bound = compute_lipschitz(s)
    slope = s.value_and_gradient(points(40_000, seed=9, dtype=torch.float32))[1].norm(dim=-1)
    assert slope.max() <= bound <= 3 * slope.max()
    x, y = points(5000, seed=4), points(5000, seed=5)
    y = x + 0.05 * (y - x)
    assert ((s.sdf(x) - s.sdf(y)).abs() <= bound * (x - y).norm(dim=-1)).all()
    assert NeuralShape(BOUNDS).lipschitz > 0.5


def test_patch_tells_facing_and_place():
    s = NeuralShape([[-1.0] * 3, [1.0] * 3], lipschitz=2.0)
    x = torch.tensor([[-0.5, 0, 0], [0.5, 0, 0], [0, -0.5, 0], [0, 0.5, 0], [0, 0, -0.5]]).double()
    code = s.patch(torch.cat([x, torch.tensor([[0, 0, 0.5]]).double()]))
    assert (code % 6).tolist() == [0, 1, 2, 3, 4, 5]
    assert (code // 6).tolist() == [4, 22, 10, 16, 12, 14]


def test_normal_is_a_unit_vector_and_safe_where_there_is_none():
    s = shape()
    assert torch.allclose(s.normal_at(points()).norm(dim=-1), torch.ones(50).double())
    with torch.no_grad():
        s.to_value.weight.zero_()
    assert torch.equal(s.normal_at(points()), torch.zeros(50, 3).double())


FLAT = [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]


@pytest.mark.parametrize("wrong", [{"bounds": FLAT}, {"skip": 8}, {"softness": 0.0}, {"width": 0}])
def test_what_is_not_a_network_is_refused(wrong):
    with pytest.raises(ValueError, match="NeuralShape"):
        NeuralShape(**({"bounds": BOUNDS} | wrong))
