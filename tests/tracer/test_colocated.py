"""Radios in one place: two polarisations of one mast, the elements of an array at a few hundred GHz."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import radio
from tests.tracer.shapes import Field, ball

PLACE = (-1.0, 2.0, 0.3)
RECEIVERS = (PLACE, PLACE, (-1.0001, 2.0, 0.3))


@pytest.mark.parametrize("shape", [Sphere(0.25), Field(ball(0.25), [0.3, 0.3, 0.3])])
def test_each_has_its_own_curved_paths(shape):
    """They were one another's duplicates: found by one receiver, lost to the others."""
    thing = Node("/ball", Body(shape, Conductor()), Pose.at(-1.5, -1.5, -1.5))
    tx = (radio("/t0", -2.0, -2.2, -1.9), radio("/t1", -2.0, -2.2, -1.9))
    rx = tuple(radio(f"/r{i}", *p) for i, p in enumerate(RECEIVERS))
    result = simulate(Scene((thing,), tx, rx), 2.4e9, Quality(depth=1))
    assert result.status_counts == {"OK": 12}
    h = result.transfer()[..., 0]
    torch.testing.assert_close(h[0], h[1], rtol=1e-9, atol=0.0)
    torch.testing.assert_close(h[:, 0], h[:, 1], rtol=1e-9, atol=0.0)


def test_a_solid_without_end_has_finite_gradients():
    """How deep it is behind its face is infinite, and so was its derivative by the pose's scale."""
    pose = Pose.identity()
    pose.scale.requires_grad_(True)
    ground = Node("/ground", Body(HalfSpace(), Solid(eps_r=4.0, sigma=0.1)), pose)
    scene = Scene((ground,), (radio("/t", 0.0, 0.0, 2.0),), (radio("/r", 3.0, 0.0, 1.0),), 1e9)
    power = simulate(scene, gradients=True, quality=Quality(depth=1)).path_gain().sum()
    (found,) = torch.autograd.grad(power, pose.scale)
    assert float(found) == 0.0
