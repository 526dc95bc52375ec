"""A learned shape scaled unevenly: the stretched zero set, bounds that hold, derivatives, features."""

import pytest
import torch

import rfsg
from rfsg.objects.body import Body, unstretched
from rfsg.objects.contract import Shape
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.shapes.stretched import Stretched
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from tests.objects.shapes.test_neural import BOUNDS, shape

SCALES = torch.tensor([0.5, 2.0, 1.25], dtype=torch.float64)


def made() -> Stretched:
    return Stretched(shape(), SCALES)


def points(n: int = 40) -> torch.Tensor:
    low, high = torch.tensor(BOUNDS, dtype=torch.float64) * SCALES
    generator = torch.Generator().manual_seed(0)
    return low + (high - low) * torch.rand(n, 3, generator=generator, dtype=torch.float64)


def test_it_is_a_shape_with_the_zero_set_stretched():
    s, x = made(), points()
    assert isinstance(s, Shape) and s.planes().shape == (0, 4)
    assert torch.equal(s.bounds(), s.base.bounds() * SCALES)
    # f and the base's have one sign at points that belong together: so have their zero sets
    torch.testing.assert_close(s.sdf(x), 0.5 * s.base.sdf(x / SCALES))
    assert torch.equal(s.patch(x), s.base.patch(x / SCALES))
    torch.testing.assert_close(s.feature(x), s.base.feature(x / SCALES))


def test_equal_scales_are_a_pose_with_that_scale():
    """scale * f(x / scale) is how a pose scales a distance (conventions.md)."""
    base, x = shape(), points()
    s = Stretched(base, torch.full((3,), 3.0))
    torch.testing.assert_close(s.sdf(3 * x), 3 * base.sdf(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(s.jet(3 * x).hessian, base.jet(x).hessian / 3)


def test_waves_meet_equal_scales_as_they_meet_a_pose_with_that_scale():
    """The whole tracer: a mirror's path and what hides behind it, by the network marched as scaled."""
    base = Body(NeuralShape(BOUNDS, lipschitz=2.0), Conductor())
    wide = Body(Stretched(base.shape, torch.full((3,), 1.3)), base.surface)
    ends = (Radio.at("/tx", -2.5, 0.2, 0.7),), (Radio.at("/rx", -2, 1.5, 0.8),)
    gains = []
    for body, scale in ((base, 1.3), (wide, 1.0)):
        node = Node("/ball", body, Pose.at(0, 0, 0, yaw_deg=20, scale=scale))
        result = rfsg.simulate(Scene((node,), *ends, 2.4e9), quality="draft")
        assert len(result.paths.tx) == 2  # clear, and by the ball
        gains.append(result.path_gain().detach())
    # one settles from a sketch of its network, the other without: to within 1e-7
    torch.testing.assert_close(*gains, rtol=1e-7, atol=0)


def test_no_slope_is_steeper_than_its_bound():
    """|grad f| = s |grad f_base / scales| <= |grad f_base|: what a march steps by stays true."""
    s = made()
    gradient = s.value_and_gradient(points(500))[1]
    own = s.base.value_and_gradient(points(500) / SCALES)[1]
    assert bool((gradient.norm(dim=-1) <= own.norm(dim=-1) + 1e-12).all())
    assert s.lipschitz == s.base.lipschitz
    s.lipschitz = 3.0  # as a fit does, when it has measured it again
    assert s.base.lipschitz == 3.0


def test_gradient_hessian_and_normal_agree_with_autograd():
    s, x = made(), points(8).requires_grad_()
    (expected,) = torch.autograd.grad(s.sdf(x).sum(), x, create_graph=True)
    value, gradient = s.value_and_gradient(x)
    torch.testing.assert_close(value, s.sdf(x))
    torch.testing.assert_close(gradient, expected)
    jet = s.jet(x)
    torch.testing.assert_close(jet.gradient, expected)
    rows = [torch.autograd.grad(expected[:, i].sum(), x, retain_graph=True)[0] for i in range(3)]
    torch.testing.assert_close(jet.hessian, torch.stack(rows, 1))
    torch.testing.assert_close(s.normal_at(x), expected / expected.norm(dim=-1, keepdim=True))
    again, slope, feature = s.value_gradient_feature(x)
    torch.testing.assert_close((again, slope), (value, gradient))
    torch.testing.assert_close(feature, s.feature(x))


def test_derivatives_are_those_of_differences():
    s = made().double()
    x = points(2).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: s.value_gradient_feature(p)[:2], (x,))


def test_a_body_comes_back_as_it_was_learned():
    base = Body(shape(), Conductor(), (1e9, 2e9))
    body = Body(Stretched(base.shape, SCALES), base.surface, base.band)
    own, scales = unstretched(body)
    assert (own.shape, own.surface, own.band) == (base.shape, base.surface, base.band)
    assert torch.equal(scales, SCALES)
    same, ones = unstretched(base)
    assert same is base and torch.equal(ones, torch.ones(3, dtype=torch.float64))


@pytest.mark.parametrize("scales", [(1, 0, 1), (1, -1, 1), (1, float("nan"), 1)])
def test_other_scales_are_refused(scales):
    with pytest.raises(ValueError, match="expected three finite numbers > 0"):
        Stretched(shape(), torch.tensor(scales, dtype=torch.float64))
