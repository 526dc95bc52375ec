"""Where rays are inside objects: learned shapes against closed forms, and against dense sampling."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.embree import Proxies
from rfsg.tracer.launch import fibonacci
from rfsg.tracer.march import EVALUATE, SEARCH, crossings, far_in_float32, march, plain_march
from rfsg.tracer.records import Rays
from tests import shipped
from tests.scenes import vector
from tests.tracer.shapes import Field, ball, two_walls


def _cross(shape, pose, origin, direction, limit, options):
    world = World(Scene((Node("/a", Body(shape, Conductor()), pose),)))
    rays = Rays(origin, direction, limit)
    return crossings(world, rays, Proxies(world).spans(rays), options)


@pytest.mark.parametrize("options", [SEARCH, EVALUATE])
def test_marched_ball_is_the_ball(options):
    pose = Pose.at(0.3, -0.2, 0.1, 40.0, scale=1.7)
    torch.manual_seed(0)
    count = 3000
    origin = pose.translation + 3.0 * fibonacci(count)
    aim = pose.translation + torch.randn(count, 3, dtype=torch.float64)
    direction = torch.nn.functional.normalize(aim - origin, dim=-1)
    limit = torch.full((count,), torch.inf, dtype=torch.float64)
    marched = _cross(Field(ball(0.5), [0.6] * 3), pose, origin, direction, limit, options)
    closed = _cross(Sphere(0.5), pose, origin, direction, limit, options)
    # a chord shorter than twice the least step may be stepped over: sag of such a chord
    least = closed.leave - closed.enter > 2 * 1.7 * options.step_floor
    assert set(closed.ray[least].tolist()) <= set(marched.ray.tolist()) <= set(closed.ray.tolist())
    both = torch.isin(closed.ray, marched.ray)
    tolerance = 1e-9 if options.dtype == torch.float64 else 1e-4
    normal = least[both]
    assert float((marched.enter - closed.enter[both])[normal].abs().median()) < 0.1 * tolerance
    deep = (closed.leave - closed.enter)[both] > 0.1
    assert float((marched.enter - closed.enter[both])[deep].abs().max()) < tolerance
    assert float((marched.leave - closed.leave[both])[deep].abs().max()) < tolerance
    torch.testing.assert_close(
        marched.normal_enter[deep], closed.normal_enter[both][deep], atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("name", ["cabinet", "person"])
def test_far_steps_in_float32_find_what_all_in_float64_do(name):
    """Plain twin: every step of the march by the network in float64."""
    learned = shipped.shape(name)
    low, high = learned.bounds().detach()
    generator = torch.Generator().manual_seed(1)
    drawn = torch.rand(2, 1500, 3, generator=generator, dtype=torch.float64)
    start, end = (low - 0.2 + (high - low + 0.4) * d for d in drawn)
    length = (end - start).norm(dim=-1)
    asked = start, (end - start) / length[:, None], length
    with torch.no_grad():
        (row, *ends), (plain_row, *plain) = (
            m(learned, *asked, EVALUATE) for m in (march, plain_march)
        )
    assert len(row) > 300 and torch.equal(row, plain_row)
    torch.testing.assert_close(ends, plain, rtol=0, atol=1e-9)
    near = 0.02 * torch.randn(500, 3, generator=generator, dtype=torch.float64) + start[:500]
    mixed, value = far_in_float32(learned, near), learned.sdf(near)
    assert torch.equal(mixed < 0, value < 0)
    torch.testing.assert_close(mixed, value, rtol=1e-4, atol=0)


def test_a_thing_met_twice_gives_two_stretches():
    shape = Field(two_walls(0.4, 0.05), [0.5, 0.5, 0.5])
    origin = vector(-2.0, 0.0, 0.0)[None]
    direction = vector(1.0, 0.0, 0.0)[None]
    found = _cross(
        shape, Pose.identity(), origin, direction, torch.full((1,), torch.inf).double(), EVALUATE
    )
    expected = torch.tensor([1.75, 2.2], dtype=torch.float64)
    torch.testing.assert_close(found.enter, expected, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.leave, expected + 0.05, atol=1e-9, rtol=0)


def test_slope_of_two_needs_the_bound():
    """f need not be a distance: with its true bound nothing thin is lost."""
    steep = Field(lambda p: 2.0 * (p[..., 0].abs() - 0.005), [0.5, 0.5, 0.5], lipschitz=2.0)
    count = 500
    angle = torch.linspace(-1.2, 1.2, count, dtype=torch.float64)
    origin = vector(-0.45, 0.0, 0.0).expand(count, 3)
    direction = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    limit = torch.full((count,), torch.inf, dtype=torch.float64)
    found = _cross(steep, Pose.identity(), origin, direction, limit, SEARCH)
    inside_box = 0.45 * angle.tan().abs() < 0.5 - 0.01
    assert set(torch.nonzero(inside_box).squeeze(-1).tolist()) <= set(found.ray.tolist())


def test_segment_ends_inside():
    """A ray that begins or ends inside has no boundary there: zero normal, clipped ends."""
    for shape in (Box([0.5, 0.5, 0.5]), Field(ball(0.5), [0.6] * 3)):
        origin = torch.stack([vector(0.0, 0.0, 0.0), vector(-2.0, 0.0, 0.0)])
        direction = vector(1.0, 0.0, 0.0).expand(2, 3)
        limit = torch.tensor([3.0, 2.0], dtype=torch.float64)
        found = _cross(shape, Pose.identity(), origin, direction, limit, EVALUATE)
        torch.testing.assert_close(
            found.enter, torch.tensor([0.0, 1.5]).double(), atol=1e-9, rtol=0
        )
        torch.testing.assert_close(
            found.leave, torch.tensor([0.5, 2.0]).double(), atol=1e-9, rtol=0
        )
        assert bool((found.normal_enter[0] == 0).all()) and bool((found.normal_leave[1] == 0).all())
        torch.testing.assert_close(found.normal_leave[0], vector(1.0, 0.0, 0.0))
        torch.testing.assert_close(found.normal_enter[1], vector(-1.0, 0.0, 0.0))


def test_grazing_rays_do_not_hit():
    """Stopping where |f| is small called grazing rays hits; a sign change does not."""
    count = 200
    height = torch.linspace(0.5001, 0.515, count, dtype=torch.float64)
    origin = torch.stack([torch.full_like(height, -2.0), height, torch.zeros_like(height)], -1)
    direction = vector(1.0, 0.0, 0.0).expand(count, 3)
    limit = torch.full((count,), torch.inf, dtype=torch.float64)
    found = _cross(Field(ball(0.5), [0.6] * 3), Pose.identity(), origin, direction, limit, SEARCH)
    assert len(found.ray) == 0
