"""What makes settling quick is held against its plain twin: drops, Newton's steps, looks."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Sphere
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World, unit
from rfsg.tracer import faces, zone
from rfsg.tracer.feet import DROPS, FIRM, STEEP, THERE, dropped
from rfsg.tracer.implicit import kkt, multipliers, segments, solve_regular
from rfsg.tracer.newton import Batch, newton, surfaces_of

WAVELENGTH = 0.12


def rippled() -> NeuralShape:
    """A learned ball of half a metre whose sines are not silent."""
    shape = NeuralShape([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], width=32, depth=4, skip=2, seed=3)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        weight = shape.hidden[0].weight  # type: ignore[union-attr]
        weight[:, 3:] += 2e-3 * torch.randn(weight[:, 3:].shape, generator=generator)
    return shape


@torch.no_grad()
def _all_looks(shape: NeuralShape) -> faces.Looks:
    looks = faces.Looks(shape, torch.device("cpu"), WAVELENGTH)
    looks._measure(torch.arange(len(looks.point)))
    return looks


@pytest.fixture(scope="module")
def world() -> World:
    pose = Pose.at(1.0, 2.0, 0.5, 30.0)
    return World(Scene((Node("/ball", Body(rippled(), Conductor()), pose),)))


def vertices(world: World, count: int = 40) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Places near the surface, their normals, and radii of zones that reach over its sides."""
    generator = torch.Generator().manual_seed(1)
    out = unit(torch.randn(count, 3, generator=generator, dtype=torch.float64))
    which = torch.zeros(count, dtype=torch.int64)
    point = world.point_world(which, 0.5 * out)
    for _ in range(5):
        value, gradient = world.value_and_gradient(which, point)
        point = point - (value / (gradient * gradient).sum(-1))[:, None] * gradient
    radius = 0.05 + 0.4 * torch.rand(count, generator=generator, dtype=torch.float64)
    return point, world.normal(which, point), radius


def plain_drop(world, which, base, normal, reach, dtype):
    """Three steps of every sample, those that have arrived as well."""
    height, gradient, value = base.new_zeros(len(base)), base, base
    for _ in range(DROPS):
        value, gradient = world.value_and_gradient(which, base + height[:, None] * normal, dtype)
        along = (gradient * normal).sum(-1)
        step = value / torch.where(along.abs() > STEEP, along, torch.ones_like(along))
        height = torch.maximum(torch.minimum(height - step, reach), -reach)
    return height, gradient, value.abs()


@pytest.mark.parametrize(
    ("dtype", "close"), [(torch.float32, 2e-6), (torch.float64, 1e-12)], ids=["single", "double"]
)
def test_samples_that_have_arrived_are_where_three_steps_end(world, dtype, close):
    point, normal, radius = vertices(world, 400)
    base = point + 1e-3 * radius[:, None] * normal.roll(1, 0)
    which = torch.zeros(len(base), dtype=torch.int64)
    plain = plain_drop(world, which, base, normal, radius, dtype)
    quick = dropped(world, which, base, normal, radius, torch.zeros_like(radius), dtype)
    assert bool((plain[2] <= THERE[dtype] * radius).any())  # or nothing was left out
    torch.testing.assert_close(quick[0], plain[0], rtol=0, atol=close)


@pytest.mark.parametrize(
    ("dtype", "close"), [(torch.float32, 2e-4), (torch.float64, 1e-10)], ids=["single", "double"]
)
def test_zones_begun_from_the_feet_of_others_are_the_same(world, dtype, close, monkeypatch):
    """A zone moved by a millimetre: facets from the last zone's feet and from its own plane, with
    fewer points asked. Float32 may leave a foot THERE short of its face, and answers as nearly."""
    point, normal, radius = vertices(world)
    which = torch.zeros(len(point), dtype=torch.int64)
    radius = radius.clamp(max=0.15)
    asked: list[int] = []
    plain = World.value_and_gradient

    def counting(self, which, point, dtype=torch.float64):
        asked.append(len(point))
        return plain(self, which, point, dtype)

    monkeypatch.setattr(World, "value_and_gradient", counting)
    aside = point + 1e-3 * torch.linalg.cross(normal, normal.roll(1, 1))
    about = [zone.Zones(world, which, x, normal, radius, WAVELENGTH, 2) for x in (point, aside)]
    with torch.no_grad():
        feet = about[0].measured(dtype, None)[1]
        asked.clear()
        fresh, after = about[1].measured(dtype, None)[0], sum(asked)
        asked.clear()
        begun, fewer = about[1].measured(dtype, feet)[0], sum(asked)
    assert fewer < after
    for name in ("offset", "slope", "weight", "residual"):
        torch.testing.assert_close(getattr(begun, name), getattr(fresh, name), rtol=0, atol=close)


def test_feet_that_missed_are_not_begun_from(world):
    """Far off the surface nothing is firm: every start is the plane itself."""
    point, normal, radius = vertices(world)
    which = torch.zeros(len(point), dtype=torch.int64)
    far = zone.Zones(world, which, point + 0.45 * normal, normal, 0.05 * radius, WAVELENGTH, 1)
    feet = far.measured(torch.float64, None)[1]
    base = (point + 0.45 * normal)[:, None].expand(-1, 7, 3)
    most = FIRM[torch.float64] * 0.05 * radius
    start = feet.heights(0, torch.arange(len(point)), base, normal, most)
    assert bool((start == 0).all())


def test_newton_that_drops_settled_chains_ends_where_all_of_them_do():
    """Against the plain loop that steps every chain until all have settled."""
    ball = Node("/b", Body(Sphere(0.4), Conductor()), Pose.at(0.0, 0.0, 0.0))
    world = World(Scene((ball,)))
    generator = torch.Generator().manual_seed(2)

    def spread(scale):
        return scale * torch.randn(200, 3, generator=generator, dtype=torch.float64)

    tx, rx = (
        spread(0.5) + torch.tensor([3.0, 1.0, 0.0]),
        spread(0.5) + torch.tensor([2.0, -2.0, 1.0]),
    )
    x = (0.4 * unit(tx + rx + spread(1.5)))[:, None]
    none = torch.zeros(200, 1, dtype=torch.int64)
    batch = Batch(none[:, 0], tx, rx, none, none, x)
    surfaces = surfaces_of(world, batch, None)
    found, settled = newton(batch, surfaces, 40)
    for _ in range(40):
        vertices = batch.polyline(x)
        length, u = segments(vertices)
        jet = surfaces.jet(x)
        system = kkt(vertices, jet, multipliers(u, jet.gradient))
        dx = -solve_regular(system.matrix, system.residual[..., None])[0][:, :3, 0]
        bend = jet.hessian.flatten(2).norm(dim=-1)
        reach = 0.5 * torch.minimum(torch.minimum(length[:, :1], length[:, 1:]), 1.0 / bend)[:, 0]
        x = x + (torch.clamp(reach / dx.norm(dim=-1), max=1.0)[:, None] * dx)[:, None]
    assert float(settled.double().mean()) > 0.9
    torch.testing.assert_close(found[settled], x[settled], rtol=0, atol=1e-10)


@torch.no_grad()
def test_looks_measure_what_is_asked_for_and_no_more(world):
    """Facets of some samples, asked for in two goes, are those of all samples measured at once."""
    shape = world.shapes[0]
    looks = faces.Looks(shape, world.device, WAVELENGTH)
    whole = _all_looks(shape)
    point = looks.point[5:900:7]
    first, second = looks.nearest(point[:40]), looks.nearest(point[20:])
    assert len(looks.facets.radius) == len(point)  # type: ignore[union-attr]
    for got, asked in ((first, point[:40]), (second, point[20:])):
        expected = whole.nearest(asked)
        torch.testing.assert_close(got.centre, expected.centre, rtol=0, atol=0)
        for name in ("offset", "slope", "weight"):
            torch.testing.assert_close(
                getattr(got, name), getattr(expected, name), rtol=0, atol=1e-5
            )
