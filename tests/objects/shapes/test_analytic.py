"""Closed-form shapes against autograd, dense sampling and geometry that can be read off."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere

SHAPES = [
    Box([0.3, 0.5, 0.7]),
    Sphere(0.6),
    Cylinder(0.4, 0.7),
    Capsule(0.3, 0.5),
    HalfSpace(),
]
BOUNDED = SHAPES[:-1]
ids = [s.kind for s in SHAPES]
every = pytest.mark.parametrize("shape", SHAPES, ids=ids)
bounded = pytest.mark.parametrize("shape", BOUNDED, ids=ids[:-1])


def points(n=400, size=1.2, seed=0):
    g = torch.Generator().manual_seed(seed)
    return (torch.rand(n, 3, generator=g, dtype=torch.float64) * 2 - 1) * size


def directions(n=400, seed=1):
    g = torch.Generator().manual_seed(seed)
    d = torch.randn(n, 3, generator=g, dtype=torch.float64)
    return d / d.norm(dim=-1, keepdim=True)


def autograd_gradient(shape, x):
    x = x.clone().requires_grad_()
    (g,) = torch.autograd.grad(shape.sdf(x).sum(), x)
    return g


@every
def test_satisfies_the_contract(shape):
    assert isinstance(shape, Shape)
    assert shape.convex and shape.exact and shape.lipschitz == 1.0
    again = type(shape)(**shape.config())
    assert torch.equal(again.sdf(points()), shape.sdf(points()))


@every
def test_gradient_and_hessian_agree_with_autograd(shape):
    x = points()
    value, gradient = shape.value_and_gradient(x)
    jet = shape.jet(x)
    assert torch.equal(value, shape.sdf(x)) and torch.equal(jet.value, value)
    assert torch.allclose(gradient, autograd_gradient(shape, x), atol=1e-12)
    assert torch.equal(jet.gradient, gradient)
    y = x.clone().requires_grad_()
    g = shape.value_and_gradient(y)[1]
    rows = [
        torch.autograd.grad(g[:, i].sum(), y, retain_graph=True, allow_unused=True)[0]
        if g.requires_grad
        else None
        for i in range(3)
    ]
    hessian = torch.stack([torch.zeros_like(x) if r is None else r for r in rows], dim=1)
    assert torch.allclose(jet.hessian, hessian, atol=1e-9)
    assert torch.allclose(jet.hessian, jet.hessian.mT, atol=1e-12)


@every
def test_hessian_agrees_with_finite_differences(shape):
    x, h = points(200, seed=3), 1e-5
    step = torch.eye(3, dtype=torch.float64) * h
    g = lambda y: shape.value_and_gradient(y)[1]  # noqa: E731
    difference = torch.stack([(g(x + e) - g(x - e)) / (2 * h) for e in step], dim=-1)
    error = (difference - shape.jet(x).hessian).abs().amax((-2, -1))
    # A few points lie within h of a ridge, where no second derivative exists.
    assert error.quantile(0.97) < 1e-6


@every
def test_slope_is_one_and_distance_is_lipschitz(shape):
    x = points()
    assert torch.allclose(shape.value_and_gradient(x)[1].norm(dim=-1), torch.ones(400).double())
    y = points(seed=7)
    assert ((shape.sdf(x) - shape.sdf(y)).abs() <= (x - y).norm(dim=-1) + 1e-12).all()


@every
def test_value_is_the_distance_to_the_surface(shape):
    """A step of f against the gradient lands on the surface, from both sides."""
    x = points()
    value, gradient = shape.value_and_gradient(x)
    assert shape.sdf(x - value[:, None] * gradient).abs().max() < 1e-12


def test_box_distance_by_hand():
    box = Box([1.0, 2.0, 3.0])
    p = torch.tensor([[2.0, 3, 0], [0, 0, 0], [1, 2, 3], [0.5, 0, 0], [2, 3, 4]]).double()
    expected = torch.tensor([math.sqrt(2), -1.0, 0.0, -0.5, math.sqrt(3)]).double()
    assert torch.allclose(box.sdf(p), expected)


def test_cylinder_and_capsule_distance_by_hand():
    p = torch.tensor([[3.0, 4, 5], [0, 0, 3], [0, 0, 0.5], [6, 8, 0]]).double()
    assert torch.allclose(Cylinder(2.0, 1.0).sdf(p), torch.tensor([5.0, 2.0, -0.5, 8.0]).double())
    assert torch.allclose(
        Capsule(2.0, 1.0).sdf(p),
        torch.tensor([math.sqrt(41) - 2, 0.0, -2.0, 8.0]).double(),
    )


@bounded
def test_curvature_of_the_surface(shape):
    """Trace of the Hessian on the surface: 2/R for balls, 1/R for tubes, 0 for flats."""
    x = points()
    value, gradient = shape.value_and_gradient(x)
    x = x - (value * (1 - 1e-12))[:, None] * gradient
    trace = shape.jet(x).hessian.diagonal(dim1=-2, dim2=-1).sum(-1)
    patch = shape.patch(x)
    expected = {
        "box": [0.0] * 6,
        "sphere": [2 / 0.6],
        "cylinder": [0.0, 0.0, 1 / 0.4],
        "capsule": [1 / 0.3, 2 / 0.3, 2 / 0.3],
    }[shape.kind]
    expected = torch.tensor(expected).double()[patch]
    close = (trace - expected).abs() < 1e-6 * (1 + expected)
    # Points that project to an edge of the box or a rim of the cylinder have no surface curvature.
    q = shape.normal_at(x) - gradient
    assert close[q.norm(dim=-1) < 1e-6].all() and close.double().mean() > 0.3


@every
def test_interval_is_where_the_distance_is_negative(shape):
    o, d = points(size=1.0), directions()
    o, d = torch.cat([o, o[:50] * 0 + 1.0]), torch.cat([d, d[:50] * torch.tensor([1, 1, 0])])
    enter, leave = shape.interval(o, d)
    hit = enter < leave
    assert hit.sum() > 50 and (~hit).sum() > 30
    assert (enter[~hit] == math.inf).all() and (leave[~hit] == -math.inf).all()
    t = torch.linspace(-6, 6, 2001).double()
    inside = shape.sdf(o[:, None] + t[:, None] * d[:, None]) < 0
    between = (t > enter[:, None]) & (t < leave[:, None])
    at_end = ((t - enter[:, None]).abs() < 1e-9) | ((t - leave[:, None]).abs() < 1e-9)
    assert ((inside == between) | at_end).all()


@every
def test_interval_ends_lie_on_the_surface_also_from_far_and_for_any_speed(shape):
    d = directions()
    o = points(size=0.5) - 1e5 * d
    for speed in (1.0, 1e-3, 40.0):
        enter, leave = shape.interval(o, d * speed)
        for t in (enter, leave):
            ok = t.isfinite()
            end = o[ok] + t[ok, None] * d[ok] * speed
            assert shape.sdf(end).abs().max() < 1e-9


@every
def test_interval_from_inside_begins_behind(shape):
    o = points(2000, size=1.0)
    o = o[shape.sdf(o) < 0]
    enter, leave = shape.interval(o, directions(len(o)))
    assert len(o) and (enter < 0).all() and (leave > 0).all()


@every
def test_interval_of_parallel_and_touching_lines(shape):
    """Rays along every axis, through the centre, in the faces, on edges and past them: no NaN."""
    high = shape.bounds()[1].clamp(max=1.0)
    grid = torch.tensor([-1.5, -1.0, 0.0, 1.0, 1.5]).double()
    o = torch.cartesian_prod(grid, grid, grid) * high.clamp(min=0.5)
    for axis in torch.cat([torch.eye(3), -torch.eye(3), torch.eye(3) + 1e-200]).double():
        origin = o.clone().requires_grad_()
        direction = axis.expand_as(o).clone().requires_grad_()
        enter, leave = shape.interval(origin, direction)
        assert not enter.isnan().any() and not leave.isnan().any()
        ends = torch.cat([enter, leave])
        if ends.requires_grad:
            ends[ends.isfinite()].sum().backward()
            assert origin.grad.isfinite().all() and direction.grad.isfinite().all()
        hit = enter < leave
        middle = torch.where(hit, (enter.clamp(-9, 9) + leave.clamp(-9, 9)) / 2, torch.zeros(()))
        inside = shape.sdf(o + middle[:, None] * axis) < 0
        assert torch.equal(hit, inside)


def test_a_line_in_a_face_is_not_inside():
    box = Box([1.0, 1.0, 1.0])
    o = torch.tensor([[-2.0, 1.0, 0.0], [-2.0, 0.999999, 0.0]]).double()
    d = torch.tensor([1.0, 0.0, 0.0]).double().expand(2, 3)
    enter, leave = box.interval(o, d)
    assert enter.tolist() == [math.inf, 1.0] and leave.tolist() == [-math.inf, 3.0]


@pytest.mark.parametrize("shape", [Box([0.3, 0.5, 0.7]), Cylinder(0.4, 0.7), HalfSpace()])
def test_planes_are_the_planar_patches(shape):
    rows = shape.planes()
    high = shape.bounds()[1].clamp(max=1.0)
    for i, (*n, d) in enumerate(rows.tolist()):
        n = torch.tensor(n).double()
        tangent = torch.eye(3).double()[n == 0] * 0.1
        x = n * d + torch.cat([tangent, -tangent])
        assert shape.sdf(x).abs().max() < 1e-15
        assert (shape.patch(x) == i).all()
        assert torch.equal(shape.normal_at(x), n.expand_as(x))
    assert high.isfinite().all()


def test_order_of_the_faces_of_a_box():
    x = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])
    assert Box([1.0, 1.0, 1.0]).patch(x.double()).tolist() == [0, 1, 2, 3, 4, 5]


def test_normal_on_edges_and_corners_is_a_face_normal():
    box = Box([1.0, 1.0, 1.0])
    x = torch.tensor([[1.0, 1, 0], [1, 1, 1], [1 + 1e-15, 1 + 1e-15, 0], [-1, 1, -1]]).double()
    n = box.normal_at(x)
    assert torch.allclose(n.abs().sum(-1), torch.ones(4).double())
    rim = torch.tensor([[0.4, 0.0, 0.7]]).double()
    assert Cylinder(0.4, 0.7).normal_at(rim).norm() == 1.0


@every
def test_nothing_is_nan_at_the_singular_points(shape):
    x = torch.tensor([[0.0, 0, 0], [0, 0, 0.2], [0, 0, 0.7], [0.3, 0.5, 0.7], [0.4, 0, 0.7]])
    x = x.double().requires_grad_()
    jet = shape.jet(x)
    total = jet.value.sum() + jet.gradient.sum() + jet.hessian.sum()
    for part in (jet.value, jet.gradient, jet.hessian):
        assert part.isfinite().all()
    total.backward()
    assert x.grad.isfinite().all()


@bounded
def test_dimensions_can_be_fitted(shape):
    """Value, gradient, Hessian and interval have right derivatives in points and dimensions."""
    shape = type(shape)(**shape.config()).requires_grad_()
    names = [n for n, _ in shape.named_parameters()]
    x, o, d = points(6, seed=11), points(40, size=2.0, seed=12), directions(40, seed=13)
    enter, leave = shape.interval(o, d)
    hit = (enter < leave).nonzero()[:4, 0]

    def answers(point, origin, *dims):
        def ask(p, o):
            jet = shape.jet(p)
            return jet.value, jet.gradient, jet.hessian, *shape.interval(o, d[hit])

        call = _Functional(shape, ask)
        return torch.func.functional_call(
            call, {f"shape.{n}": v for n, v in zip(names, dims, strict=True)}, (point, origin)
        )

    dims = [p.detach().clone().requires_grad_() for p in shape.parameters()]
    inputs = (x.requires_grad_(), o[hit].requires_grad_(), *dims)
    assert torch.autograd.gradcheck(answers, inputs, eps=1e-6, atol=1e-5)


class _Functional(torch.nn.Module):
    def __init__(self, shape, ask):
        super().__init__()
        self.shape, self.ask = shape, ask

    def forward(self, *args):
        return self.ask(*args)


@every
def test_float32_points_give_float32_answers(shape):
    x = points().float()
    assert shape.sdf(x).dtype == torch.float32
    assert shape.jet(x).hessian.dtype == torch.float32
    assert shape.interval(x, directions().float())[0].dtype == torch.float32
    assert torch.allclose(shape.sdf(x).double(), shape.sdf(x.double()), atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_sizes_from_a_millimetre_to_a_kilometre(a, b, c):
    x, d = points(50, size=2 * max(a, b, c)), directions(50)
    for shape in (Box([a, b, c]), Cylinder(a, b), Capsule(a, b), Sphere(c)):
        enter, leave = shape.interval(x, d)
        ok = enter < leave
        assert shape.sdf(x[ok] + enter[ok, None] * d[ok]).abs().lt(1e-11 * (a + b + c)).all()
        assert shape.jet(x).hessian.isfinite().all()


@pytest.mark.parametrize("bad", [[1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0], [math.nan] * 3])
def test_bad_dimensions_are_refused(bad):
    with pytest.raises(ValueError, match="half_size"):
        Box(bad)
    with pytest.raises(ValueError, match="radius"):
        Sphere(-1.0)
