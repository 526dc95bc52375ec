"""One vertex on a quadric between two points: against Newton's method of all chains, and closed forms."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.lone import stationary
from rfsg.tracer.newton import NEWTON_SETTLED, ROUNDING, Batch, Surfaces, newton
from rfsg.tracer.zone import Facets
from tests.scenes import vector

STEPS, TIGHT = 12, 1e-12


def _facets(offset, slope, bend, centre=None, frame=None) -> Facets:
    m = len(offset)
    one = torch.ones(m, dtype=torch.float64)
    frame = torch.eye(3, dtype=torch.float64).expand(m, 3, 3) if frame is None else frame
    centre = torch.zeros(m, 3, dtype=torch.float64) if centre is None else centre
    return Facets(centre, frame, offset, slope, bend, 0.0 * one, one, 0.1 * one)


def _floor(m: int) -> torch.Tensor:
    return torch.full((m,), TIGHT, dtype=torch.float64)


@pytest.mark.parametrize("steps", [1, 3, STEPS])
def test_its_steps_are_those_of_chains_of_any_length(steps):
    """The plain twin solves the whole system of place and multiplier, in the world's frame."""
    m, generator = 200, torch.Generator().manual_seed(7)

    def some(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    root, centre = 0.5 * some(m, 2, 2), some(m, 3)
    frame = torch.linalg.qr(some(m, 3, 3)).Q
    facets = _facets(0.1 * some(m), 0.2 * some(m, 2), -root @ root.mT, centre, frame)
    local = torch.cat([some(2, m, 2), 4.0 + some(2, m, 1).abs()], -1)
    tx, rx = centre + torch.einsum("mji,emj->emi", frame, local)
    x = centre + 0.1 * some(m, 3)
    none, no = torch.zeros(m, dtype=torch.int64), torch.zeros(m, dtype=torch.bool)
    world = World(Scene((Node("/a", Body(Sphere(1.0), Conductor()), Pose.identity()),)))
    batch = Batch(none, tx, rx, none[:, None], none[:, None], x[:, None])
    surfaces = Surfaces(world, none, no, torch.zeros_like(x), x[:, 0] * 0.0, ~no, facets)
    twin, rested = newton(batch, surfaces, steps)
    floor = ROUNDING * batch.polyline().abs().amax((1, 2))
    found, settled = stationary(facets, x, tx, rx, steps, NEWTON_SETTLED, floor)
    torch.testing.assert_close(found, twin[:, 0], rtol=0.0, atol=1e-9)
    assert torch.equal(settled, rested)
    assert int(settled.sum()) > 0.9 * m or steps < STEPS  # or little would have been compared


def test_the_stationary_path_over_a_quadric():
    """Its length has no slope there, by differences."""
    generator = torch.Generator().manual_seed(3)
    bend = 0.3 * torch.randn(30, 2, 2, generator=generator, dtype=torch.float64)
    facets = _facets(
        torch.zeros(30, dtype=torch.float64),
        0.1 * torch.randn(30, 2, generator=generator, dtype=torch.float64),
        -bend @ bend.mT,  # convex towards the ends: no caustic, one stationary path
    )
    ends = torch.randn(2, 30, 3, generator=generator, dtype=torch.float64)
    ends[..., 2] = 3.0 + ends[..., 2].abs()
    start = torch.zeros(30, 3, dtype=torch.float64)
    found, settled = stationary(facets, start, ends[0], ends[1], STEPS, 0.0, _floor(30))
    assert bool(settled.all())

    def length(uv: torch.Tensor) -> torch.Tensor:
        height = (facets.slope * uv).sum(-1)
        height = height + 0.5 * torch.einsum("mi,mij,mj->m", uv, facets.bend, uv)
        x = torch.cat([uv, height[:, None]], -1)
        return (x - ends[0]).norm(dim=-1) + (x - ends[1]).norm(dim=-1)

    torch.testing.assert_close(
        found[:, 2],
        (facets.slope * found[:, :2]).sum(-1)
        + 0.5 * torch.einsum("mi,mij,mj->m", found[:, :2], facets.bend, found[:, :2]),
    )
    for k in (0, 1):
        step = torch.zeros(2, dtype=torch.float64)
        step[k] = 1e-5
        slope = (length(found[:, :2] + step) - length(found[:, :2] - step)) / 2e-5
        assert float(slope.abs().max()) < 1e-7


def test_a_plane_mirrors_where_the_image_method_says():
    flat = _facets(*(torch.zeros(1, *s, dtype=torch.float64) for s in ((), (2,), (2, 2))))
    fore, aft = vector(0.0, 0.0, 1.0)[None], vector(4.0, 2.0, 3.0)[None]
    start = torch.zeros(1, 3, dtype=torch.float64)
    found, settled = stationary(flat, start, fore, aft, STEPS, 0.0, _floor(1))
    torch.testing.assert_close(found, vector(1.0, 0.5, 0.0)[None])
    assert bool(settled.all())


def test_nothing_asked_is_nothing_found():
    flat = _facets(*(torch.zeros(0, *s, dtype=torch.float64) for s in ((), (2,), (2, 2))))
    none = torch.zeros(0, 3, dtype=torch.float64)
    found, settled = stationary(flat, none, none, none, STEPS, 0.0, _floor(0))
    assert found.shape == (0, 3) and settled.shape == (0,)
