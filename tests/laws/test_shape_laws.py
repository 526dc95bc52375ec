"""Laws of every shape of the catalogue, asked only what its contract promises."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.contract import Shape
from rfsg.objects.shapes.edges import Edges, edges_of
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.march import march
from tests.laws.catalogue import (
    F64,
    MARCH,
    SHAPES,
    box,
    contacts,
    inside,
    lines,
    made,
    names,
    some,
    through_box,
)
from tests.scenes import vector

EVERY_SHAPE = pytest.mark.parametrize("name", names(SHAPES))


def points(shape: Shape, count: int, seed: int = 0) -> Tensor:
    """Random points in the box about a shape."""
    low, high = box(shape)
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, 3, generator=generator, dtype=F64)


@EVERY_SHAPE
@torch.no_grad()
def test_no_slope_is_steeper_than_the_bound(name):
    """|f(p) - f(q)| <= L |p - q| for neighbours, strangers, and along the steepest slope."""
    shape: Shape = made(SHAPES, name)
    p, q = points(shape, 5_000), points(shape, 5_000, 1)
    low, high = box(shape)
    for other in (q, (p + 0.01 * (q - p)), (p + 1e-4 * (q - p))):
        apart = (p - other).norm(dim=-1)
        assert bool(
            (shape.sdf(p) - shape.sdf(other)).abs().le(shape.lipschitz * apart + 1e-12).all()
        )
    slope = shape.value_and_gradient(p)[1].norm(dim=-1)
    assert float(slope.max()) <= shape.lipschitz * (1 + 1e-12)
    assert float(slope.max()) > 0.1  # a distance [m], not a number


@EVERY_SHAPE
@torch.no_grad()
def test_jets_are_derivatives(name):
    """Value, gradient and Hessian by central differences. A few points lie within the step of a ridge,
    where there is no derivative: fewer than one in fifty, and none of a network's."""
    shape: Shape = made(SHAPES, name)
    p, h = points(shape, 500), 1e-6
    value, gradient = shape.value_and_gradient(p)
    jet = shape.jet(p)
    for same in (shape.sdf(p), jet.value):
        torch.testing.assert_close(same, value, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(jet.gradient, gradient, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(jet.hessian, jet.hessian.mT, rtol=1e-10, atol=1e-10)
    steps = h * torch.eye(3, dtype=F64)
    slope = torch.stack([shape.sdf(p + e) - shape.sdf(p - e) for e in steps], -1) / (2 * h)
    bend = [shape.value_and_gradient(p + e)[1] - shape.value_and_gradient(p - e)[1] for e in steps]
    bend = torch.stack(bend, -1) / (2 * h)
    scale = 1.0 + jet.hessian.flatten(1).norm(dim=-1)
    for off in (
        (slope - gradient).norm(dim=-1) / scale,
        (bend - jet.hessian).flatten(1).norm(dim=-1) / scale,
    ):
        assert float(off.quantile(0.98 if shape.exact else 1.0)) < 1e-5


@EVERY_SHAPE
@torch.no_grad()
def test_normals_point_outward(name):
    shape, contact = contacts(name)
    x, n = contact.point, contact.normal
    torch.testing.assert_close(n.norm(dim=-1), torch.ones(len(n), dtype=F64), rtol=1e-12, atol=0)
    step = 1e-6
    # half a step is left for the bend of a learned face
    assert float(shape.sdf(x).abs().max()) < 1e-9
    assert float(shape.sdf(x + step * n).min()) > 0.05 * step
    assert float(shape.sdf(x - step * n).max()) < -0.05 * step


@EVERY_SHAPE
@pytest.mark.parametrize("count", [200, pytest.param(400, marks=pytest.mark.slow)])
@torch.no_grad()
def test_where_lines_are_inside(name, count):
    """Stretches, in closed form or marched, against 1500 looks along each line; and closed forms
    against the march. What is shallower than the march's least step may be stepped over."""
    shape: Shape = made(SHAPES, name)
    i, start, length = through_box(shape, *lines(shape, count, 5))
    direction = lines(shape, count, 5)[1][i]
    row, enter, leave = inside(shape, start, direction, length)
    assert bool((enter <= leave).all()) and len(row) > 50
    looks = torch.linspace(0.0, 1.0, 1_500, dtype=F64)
    t = length[:, None] * looks
    value = shape.sdf(start[:, None] + t[..., None] * direction[:, None])
    within = torch.zeros_like(t, dtype=torch.bool)
    for k in range(len(row)):
        within[row[k]] |= (t[row[k]] >= enter[k]) & (t[row[k]] <= leave[k])
    shallow = 1e-9 if shape.convex else MARCH.step_floor * shape.lipschitz
    assert not bool(((within != (value < 0)) & (value.abs() > shallow)).any())
    if shape.convex:
        again, first, last = march(shape, start, direction, length, replace(MARCH, step_floor=2e-4))
        long = torch.nonzero(leave - enter > 1e-3).squeeze(-1)
        order = torch.searchsorted(again, row[long])
        assert torch.equal(again[order], row[long])
        torch.testing.assert_close(first[order], enter[long], rtol=0, atol=1e-10)
        torch.testing.assert_close(last[order], leave[long], rtol=0, atol=1e-10)
    else:
        with pytest.raises(NotImplementedError):
            shape.interval(start, direction)


@EVERY_SHAPE
@torch.no_grad()
def test_planes_are_the_first_patches(name):
    """Patch i < k is row i of the planes, with its normal; no other patch lies on one."""
    shape, contact = contacts(name)
    patch, planes = shape.patch(contact.point), shape.planes()
    assert patch.dtype == torch.int64 and bool((patch >= 0).all())
    assert set(range(len(planes))) <= set(patch.tolist())
    flat = patch < len(planes)
    rows = planes[patch[flat]]
    if len(planes):
        torch.testing.assert_close(planes[:, :3].norm(dim=-1), torch.ones(len(planes), dtype=F64))
        torch.testing.assert_close(rows[:, :3], contact.normal[flat], rtol=0, atol=1e-12)
        height = (rows[:, :3] * contact.point[flat]).sum(-1)
        torch.testing.assert_close(height, rows[:, 3], rtol=0, atol=1e-12)
    bent = shape.jet(contact.point[~flat]).hessian.flatten(1).norm(dim=-1)
    assert not shape.exact or bool((bent > 1e-3).all())


def _along(edges: Edges, share: float) -> tuple[Tensor, Tensor, Tensor]:
    """Points of edges, and the normals of both faces there."""
    straight = torch.isinf(edges.radius)[:, None]
    turn = 2 * math.pi * share
    out = edges.normal1
    around = math.cos(turn) * out + math.sin(turn) * torch.linalg.cross(edges.axis, out)
    radius = torch.where(torch.isinf(edges.radius), 1.0, edges.radius)[:, None]
    point = torch.where(
        straight, edges.start + share * (edges.end - edges.start), edges.centre + radius * around
    )
    return point, edges.normal0, torch.where(straight, out, around)


@EVERY_SHAPE
@torch.no_grad()
def test_edges_lie_on_the_surface_and_turn_outward(name):
    """Sharp to rounding on exact shapes; learned ones round their edges, by up to a few millimetres."""
    shape: Shape = made(SHAPES, name)
    edges = edges_of(shape)
    assert bool((edges.opening > 1.0).all()) and bool((edges.opening <= 2.0).all())
    slack, step = (1e-12, 1e-4) if shape.exact else (4e-3, 1.5e-2)
    for share in (0.1, 0.35, 0.5, 0.9):
        point, normal0, normal1 = _along(edges, share)
        assert bool((shape.sdf(point).abs() <= slack).all())
        outward = normal0 + normal1
        assert bool((shape.sdf(point + step * outward) > 0).all())
        if step < 0.5 * float((box(shape)[1] - box(shape)[0]).min()):
            assert bool((shape.sdf(point - step * outward) < 0).all())
    planes, turned = shape.planes(), torch.isinf(edges.radius)
    if shape.exact and len(edges):
        faces = torch.cat([edges.patch0, edges.patch1[turned]])
        normals = torch.cat([edges.normal0, edges.normal1[turned]])
        torch.testing.assert_close(planes[faces, :3], normals, rtol=0, atol=1e-12)


@EVERY_SHAPE
@torch.no_grad()
def test_a_shape_is_itself_wherever_it_stands(name):
    """Turned, mirrored, doubled and carried 100 km away: f scales, slopes turn, curvature halves."""
    shape, contact = contacts(name)
    contact = some(contact, slice(200))
    tilt = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3)).to(F64))[0]
    pose = Pose(-tilt * torch.det(tilt), vector(1e5, -7e4, 300.0), torch.tensor(2.0, dtype=F64))
    assert float(torch.det(pose.rotation)) == pytest.approx(-1.0)
    world = World(Scene((Node("/it", Body(shape, Conductor()), pose),)))
    which = torch.zeros(200, dtype=torch.int64)
    p = points(shape, 200, 9)
    away, s = pose.point_world(p), float(pose.scale)
    # float64 holds 100 km to 1.5e-11 m
    close = {"rtol": 0, "atol": 1e-9 * (1.0 + shape.lipschitz)}
    own, jet = shape.jet(p), world.jet(which, away)
    bend = own.hessian.flatten(1).norm(dim=-1)
    smooth = bend < 1e3  # beside an axis or a corner the rounding of places counts for more
    assert int(smooth.sum()) > 150
    value, gradient = world.value_and_gradient(which, away)
    torch.testing.assert_close(value, s * own.value, **close)
    torch.testing.assert_close(world.sdf(which, away), value)
    turned = pose.direction_world(own.gradient)
    kept = smooth & ((gradient - turned).norm(dim=-1) < 0.1)  # a point on a ridge may change sides
    assert int(kept.sum()) >= int(smooth.sum()) - 2
    torch.testing.assert_close(gradient[kept], turned[kept], rtol=0, atol=1e-6)
    rotated = pose.rotation @ own.hessian @ pose.rotation.T / s
    torch.testing.assert_close(jet.hessian[kept], rotated[kept], rtol=1e-6, atol=1e-6)
    met = pose.point_world(contact.point)
    torch.testing.assert_close(
        world.normal(which, met), pose.direction_world(contact.normal), rtol=0, atol=1e-6
    )
    _planes_and_lines(world, pose, shape, which)


def _planes_and_lines(world: World, pose: Pose, shape: Shape, which: Tensor) -> None:
    """Planes and stretches of lines go along."""
    planes, s = shape.planes(), pose.scale
    for k, row in enumerate(planes):
        normal, offset, planar = world.plane(which[:1], torch.tensor([k]))
        expected = pose.direction_world(row[:3])
        foot = pose.point_world(row[3] * row[:3])
        assert bool(planar.all())
        torch.testing.assert_close(normal[0], expected, rtol=0, atol=1e-12)
        torch.testing.assert_close(offset[0], (foot * expected).sum(), rtol=0, atol=1e-9)
    if shape.convex:
        origin, direction = lines(shape, len(which), 11)
        enter, leave = shape.interval(origin, direction)
        far = world.interval(which, pose.point_world(origin), pose.direction_world(direction))
        clear = (leave - enter > 1e-3) | torch.isinf(enter)
        for there, here in zip(far, (enter, leave), strict=True):
            torch.testing.assert_close(there[clear], s * here[clear], rtol=0, atol=1e-7)
