"""Fast ways to meet a learned shape, held to the plain march, to closed forms and to dense sampling."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rfsg.objects.shapes import kept
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.baked import bake
from rfsg.objects.shapes.blocks import ROUNDING
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.scene.assets import load_asset
from rfsg.tracer import intersect as intersecting
from rfsg.tracer import march as marching
from rfsg.tracer.intersect import FLOOR as LEAST
from rfsg.tracer.intersect import WAYS, Intersector
from rfsg.tracer.march import EVALUATE, SEARCH, march, plain_march
from rfsg.tracer.plan import INTERSECTIONS, Quality
from rfsg.tracer.roots import roots_on
from tests.tracer.shapes import Field, ball

ASSETS = Path(__file__).resolve().parents[2] / "assets" / "objects"
FLOOR = 1e-3


def around(shape, count, seed=0):
    """Rays from 3 m away at points in and beside the bounds, cut to them: half of them miss."""
    generator = torch.Generator().manual_seed(seed)
    low, high = shape.bounds().double()
    centre = 0.5 * (low + high)
    away = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origin = centre + 3.0 * torch.nn.functional.normalize(away, dim=-1)
    share = 2.0 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1.0
    direction = torch.nn.functional.normalize(centre + 0.6 * (high - low) * share - origin, dim=-1)
    ends = torch.stack([(low - origin) / direction, (high - origin) / direction])
    enter, leave = ends.amin(0).amax(-1), ends.amax(0).amin(-1)
    met = leave > enter.clamp(min=0.0)
    origin = (origin + enter[:, None] * direction)[met]
    return origin, direction[met], (leave - enter)[met]


class Squashed(Field):
    """Another shape with the same zero set: f becomes ``change(f)``."""

    def __init__(self, inner, change, slope):
        super().__init__(lambda p: change(inner.sdf(p)), [1.0] * 3, slope * inner.lipschitz)
        self.inner = inner.requires_grad_(False)

    def bounds(self):
        return self.inner.bounds()


def trained(name):
    return load_asset(ASSETS / name / f"{name}.usda").body.shape.requires_grad_(False)


@pytest.fixture(scope="module")
def chair():
    shape = trained("chair")
    return shape, bake(shape, 0.01)


def stretches(shape, made, rays, options, monkeypatch):
    monkeypatch.setattr(marching, "baked_if_it_pays", lambda *_: made)
    return march(shape, *rays, options)


def differences(one, other, count):
    """(rays whose number of stretches differs, errors of the ends of the others [m])."""
    counts = [torch.bincount(rows, minlength=count) for rows, _, _ in (one, other)]
    same = counts[0] == counts[1]
    ends = [torch.stack(part[1:])[:, same[part[0]]] for part in (one, other)]
    return torch.nonzero(~same).squeeze(-1), (ends[0] - ends[1]).abs()


@pytest.mark.parametrize("change", ["itself", "twice", "squashed"])
def test_certain_crossings_are_the_plain_marchs(change, chair, monkeypatch):
    shape, made = chair
    if change != "itself":
        law = {"twice": lambda f: 2.0 * f, "squashed": lambda f: 0.05 * torch.tanh(f / 0.05)}
        shape = Squashed(shape, law[change], 2.0 if change == "twice" else 1.0)
        made = bake(shape, 0.01)
    rays = around(shape, 500)
    options = replace(EVALUATE, step_floor=FLOOR)
    plain = plain_march(shape, *rays, options)
    fast = stretches(shape, made, rays, options, monkeypatch)
    other, error = differences(plain, fast, len(rays[0]))
    assert len(plain[0]) > 150
    # two marches may differ only in what is thinner than their least step
    for row in other.tolist():
        thin = [leave - enter for r, enter, leave in zip(*plain, strict=True) if r == row]
        thin += [leave - enter for r, enter, leave in zip(*fast, strict=True) if r == row]
        assert min(thin) < FLOOR
    assert float(error.max()) < 1e-8


def test_steps_looked_ahead_find_what_steps_one_by_one_do(monkeypatch):
    """Few rays look further ahead than many: neither may lose what the plain march finds."""
    shape = trained("chair")
    rays, options = around(shape, 300, seed=5), replace(SEARCH, step_floor=FLOOR)
    plain = plain_march(shape, *rays, options)
    together = stretches(shape, None, rays, options, monkeypatch)
    parts = [
        (row + begin, enter, leave)
        for begin in range(0, 300, 10)
        for row, enter, leave in [
            stretches(shape, None, [x[begin : begin + 10] for x in rays], options, monkeypatch)
        ]
    ]
    for found in (together, tuple(torch.cat(column) for column in zip(*parts, strict=True))):
        other, error = differences(plain, found, len(rays[0]))
        for row in other.tolist():
            thin = [leave - enter for r, enter, leave in zip(*found, strict=True) if r == row]
            assert thin and min(thin) < FLOOR
        assert float(torch.quantile(error, 0.95)) < 2e-5


def test_float32_crossings_are_those_of_float64(chair, monkeypatch):
    shape, made = chair
    rays = around(shape, 2000, seed=1)
    coarse = replace(SEARCH, step_floor=FLOOR)
    low = stretches(shape, made, rays, coarse, monkeypatch)
    high = stretches(shape, made, rays, replace(EVALUATE, step_floor=FLOOR), monkeypatch)
    other, error = differences(low, high, len(rays[0]))
    assert len(other) <= 2
    assert float(torch.quantile(error, 0.95)) < 2e-5


@pytest.fixture(scope="module")
def met(chair):
    """Rays, and the first of what they meet in float64: whether, where and how thick [m]."""
    rays = around(chair[0], 2000, seed=2)
    row, enter, leave = plain_march(chair[0], *rays, replace(EVALUATE, step_floor=0.5 * LEAST))
    inf = torch.full((len(rays[0]),), torch.inf, dtype=torch.float64)
    first = inf.scatter_reduce(0, row, enter, "amin")
    of_first = torch.nonzero(enter == first[row]).squeeze(-1)
    thickness = torch.zeros_like(first).index_copy(0, row[of_first], (leave - enter)[of_first])
    return rays, torch.isfinite(first), first, thickness


def lowest(shape, rays, begin, end, count):
    """The least f between two ends of each ray, looked for at so many places, in float64."""
    share = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    along = torch.lerp(begin[:, None], end[:, None], share)
    return shape.sdf(rays[0][:, None] + along[..., None] * rays[1][:, None]).amin(-1)


def taken(rays, i):
    return tuple(x[i] for x in rays)


@pytest.mark.parametrize("way", WAYS)
def test_first_hits_err_by_no_more_than_the_baked_shape_says(way, chair, met):
    """Hits are off their face by what is said; nothing is missed that goes deeper than a stand-in may
    be off, and nothing met that stays further away. A march steps over what is shorter than its step."""
    shape, made = chair
    rays, there, first, thickness = met
    hits = Intersector(shape, made).first_hits(*rays, way)
    found = torch.full_like(first, torch.inf).index_copy(0, hits.ray, hits.t.double())
    hit, off = torch.isfinite(found), made.offs[way]
    reach = off.most * made.slope + (LEAST * made.slope if way in ("certain", "grid") else 0.0)

    i = torch.nonzero(hit & there).squeeze(-1)
    normal = shape.normal_at(rays[0][i] + first[i, None] * rays[1][i])
    aside = (found - first)[i].abs() * (normal * rays[1][i]).sum(-1).abs()
    assert float(torch.quantile(aside, 0.99)) <= off.most

    lost = torch.nonzero(there & ~hit).squeeze(-1)
    depth = -lowest(shape, taken(rays, lost), first[lost], (first + thickness)[lost], 201)
    assert int((depth > reach).sum()) <= off.lost * int(there.sum())

    untrue = torch.nonzero(hit & ~there).squeeze(-1)
    at = found[untrue]
    height = lowest(shape, taken(rays, untrue), at - 2e-3, at + 2e-3, 4001)
    assert float(height.amax() if len(height) else 0.0) <= (0.0 if way == "certain" else reach)


def test_certain_hits_are_all_that_is_thicker_than_a_step(chair, met):
    shape, made = chair
    rays, there, first, thickness = met
    hits = Intersector(shape, made).first_hits(*rays)
    found = torch.full_like(first, torch.inf).index_copy(0, hits.ray, hits.t.double())
    hit = torch.isfinite(found)
    assert not bool((there & ~hit & (thickness > LEAST)).any())
    off = (first - found)[hit & there].abs()
    assert float(torch.quantile(off, 0.99)) <= 5e-5


def test_rays_meet_the_same_in_passes_and_in_one_march(chair, monkeypatch):
    """All late rays marched to their ends at once are the plain twin of passes through the shell. What
    is thinner than a step one of them may step over."""
    shape, made = chair
    rays = around(shape, 3000, seed=6)
    traced, answers = Intersector(shape, made), []
    for again in (6, 0):
        monkeypatch.setattr(intersecting, "AGAIN", again)
        if again == 0:
            monkeypatch.setattr(Intersector, "_pass", Intersector._to_the_end)
        hits = traced.first_hits(*rays)
        t = torch.full_like(rays[2], torch.inf).index_copy(0, hits.ray, hits.t.double())
        answers.append(t)
    differ = torch.nonzero((answers[0] - answers[1]).abs() > 5e-5).squeeze(-1)
    differ = torch.cat([differ, torch.nonzero(answers[0].isinf() != answers[1].isinf())[:, 0]])
    row, enter, leave = plain_march(shape, *taken(rays, differ), replace(EVALUATE, step_floor=5e-5))
    thin = torch.zeros(len(differ), dtype=torch.bool).index_fill(
        0, row[leave - enter < LEAST], True
    )
    assert len(answers[0]) > 1500 and len(differ) <= 2 and bool(thin.all())


def test_ways_have_one_list_of_names():
    assert WAYS == INTERSECTIONS


@pytest.mark.parametrize("way", WAYS)
def test_threads_change_nothing(way, chair, monkeypatch):
    """Blocks of rays side by side, and the march of late ones in shares."""
    shape, made = chair
    rays = around(shape, 3000, seed=5)
    monkeypatch.setattr(intersecting, "CHUNK", 700)
    monkeypatch.setattr(intersecting, "LEAST_LATE", 5)
    answers, threads = [], torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            hits = Intersector(shape, made).first_hits(*rays, way)
            assert torch.get_num_threads() == count
            order = hits.ray.argsort()
            answers.append((hits.ray[order], hits.t[order], hits.normal[order]))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(answers[0][0], answers[1][0])
    if way != "certain":
        assert torch.equal(answers[0][1], answers[1][1])
        assert torch.equal(answers[0][2], answers[1][2])
        return
    # a march of fewer rays looks further ahead: another bracket, but a root to the same residual
    ray, one, _ = answers[0]
    point = [rays[0][ray] + t[:, None] * rays[1][ray] for t in (one, answers[1][1])]
    apart = (shape.sdf(point[0]) - shape.sdf(point[1])).abs()
    assert float(apart.max()) <= 2.0 * (intersecting.RESIDUAL + ROUNDING)


def test_a_hit_normal_is_the_networks(chair):
    shape, made = chair
    rays = around(shape, 2000, seed=3)
    hits = Intersector(shape, made, network_normals=True).first_hits(*rays)
    point = rays[0][hits.ray] + hits.t[:, None] * rays[1][hits.ray]
    gradient = torch.nn.functional.normalize(shape.value_and_gradient(point)[1], dim=-1)
    turn = torch.linalg.cross(gradient, hits.normal.double()).norm(dim=-1)
    assert float(torch.quantile(turn, 0.95)) < 0.02
    assert float((gradient * hits.normal).sum(-1).min()) > 0.0


def test_rays_from_within_leave(chair):
    """A ray that begins inside first meets the surface from behind."""
    ball_shape = Field(ball(0.3), [0.4] * 3, lipschitz=1.0)
    made = bake(ball_shape, 0.01)
    torch.manual_seed(0)
    origin = 0.1 * torch.randn(500, 3, dtype=torch.float64)
    origin = origin[origin.norm(dim=-1) < 0.28]
    direction = torch.nn.functional.normalize(torch.randn_like(origin), dim=-1)
    along = (origin * direction).sum(-1)
    exact = -along + (along**2 - (origin**2).sum(-1) + 0.09).sqrt()
    hits = Intersector(ball_shape, made).first_hits(origin, direction, torch.ones(len(origin)))
    assert sorted(hits.ray.tolist()) == list(range(len(origin)))
    torch.testing.assert_close(hits.t.double(), exact[hits.ray], atol=5e-5, rtol=0)


def pane(squash: bool):
    """A 5 cm wall whose middle is a 1 cm pane; squashed, as a network with a slope of a half is."""

    def f(p):
        hole = 0.3 - torch.maximum(p[..., 1].abs(), p[..., 2].abs())
        wall = torch.maximum(p[..., 0].abs() - 0.025, hole)
        value = torch.minimum(p[..., 0].abs() - 0.005, wall)
        return 0.02 * torch.tanh(value / 0.02) if squash else value

    return Field(f, [0.2, 0.5, 0.5], lipschitz=1.0)


def shot_at_the_pane(count):
    """Rays through the wall and its pane, from one side, all of which must hit."""
    generator = torch.Generator().manual_seed(4)
    aim = 0.9 * (torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.5)
    origin = torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.5
    start = torch.cat([torch.full_like(aim[:, :1], -0.19), 0.9 * origin], -1)
    end = torch.cat([torch.zeros_like(aim[:, :1]), aim], -1)
    direction = torch.nn.functional.normalize(end - start, dim=-1)
    return start, direction, (end - start).norm(dim=-1) + 0.01


@pytest.mark.parametrize(
    "count", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)], ids=["few", "a million"]
)
@pytest.mark.parametrize("squash", [False, True])
def test_no_ray_goes_through_a_pane(count, squash):
    shape = pane(squash)
    made = bake(shape, 0.01)  # a grid as coarse as the pane is thin
    rays = shot_at_the_pane(count)
    hits = Intersector(shape, made).first_hits(*rays)
    assert len(torch.unique(hits.ray)) == count


@pytest.mark.parametrize(
    "count", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)], ids=["few", "a million"]
)
@pytest.mark.parametrize("half", [0.025, 0.005, 0.0005])
def test_no_ray_goes_through_a_sheet(count, half):
    """A wall of 5 cm, a pane of 1 cm, a sheet of 1 mm: boxes answer in closed form."""
    start, direction, _ = shot_at_the_pane(count)
    enter, leave = Box([half, 0.5, 0.5]).interval(start, direction)
    assert bool((leave > enter).all())
    torch.testing.assert_close(enter, (-half - start[:, 0]) / direction[:, 0])


def test_unknown_ways_are_refused(chair):
    shape, made = chair
    rays = around(shape, 5)
    with pytest.raises(ValueError, match="certain, newton, mesh, grid"):
        Intersector(shape, made).first_hits(*rays, "exact")
    with pytest.raises(ValueError, match="certain, newton, mesh, grid"):
        roots_on(shape, made, *rays, "exact", FLOOR, 4, 6)
    with pytest.raises(ValueError, match="certain, newton, mesh, grid"):
        Quality(intersection="exact")


def test_a_shape_is_baked_for_a_question_of_many_rays(monkeypatch, tmp_path):
    monkeypatch.setattr(kept, "BAKE_AFTER", 1000)
    monkeypatch.setattr(kept, "bake", lambda shape, step: bake(shape, 0.02))
    shape = NeuralShape([[-0.3] * 3, [0.3] * 3], width=16, depth=3, skip=1, lipschitz=2.0)
    shape.requires_grad_(False)
    rays = around(shape, 900)
    shape.folder = str(tmp_path)
    assert kept.baked_if_it_pays(shape, 999) is None and kept.baked_if_it_pays(shape, 999) is None
    made = kept.baked_if_it_pays(shape, 1000)
    assert made is not None and kept.baked_if_it_pays(shape, 5000) is made
    assert kept.baked_if_it_pays(shape, 999) is None  # whatever was asked before
    assert len(list(tmp_path.glob("*.baked.safetensors"))) == 1
    shape.to_value.bias.add_(1e-3)  # another shape
    assert kept.baked_if_it_pays(shape, 1000) is not made
    plain = plain_march(shape, *rays, EVALUATE)
    fast = march(shape, *rays, replace(EVALUATE, rays=1000))
    other, error = differences(plain, fast, len(rays[0]))
    assert len(other) == 0 and float(error.max()) < 1e-8
