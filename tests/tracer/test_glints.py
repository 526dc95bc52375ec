"""Glints looked up cluster by cluster, against every sample asked in plain loops."""

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Cylinder, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World, unit
from rfsg.tracer.faces import Looks, Samples, samples_of
from rfsg.tracer.glances import astray
from rfsg.tracer.glints import ALIKE, BESIDE, NEAR, _good, glints, may_glint
from rfsg.tracer.launch import fibonacci
from rfsg.tracer.newton import Batch
from rfsg.tracer.plan import Quality
from rfsg.tracer.sequences import enumerate_chains
from rfsg.tracer.settle import Settling, _look, _start
from tests.scenes import vector
from tests.test_lab import ASSETS

WAVELENGTH = 0.125
STEPS = Quality().newton


def _learned(name: str):
    return load_asset(ASSETS / "objects" / name / f"{name}.usda").body.shape


def _samples(shape) -> Samples:
    node = Node("/item", Body(shape, Conductor()), Pose.identity())
    return samples_of(World(Scene((node,))))[0]


@pytest.fixture(scope="module", params=["ball", "post", "cabinet", "person"])
def item(request) -> Samples:
    known = {"ball": lambda: Sphere(0.4), "post": lambda: Cylinder(0.1, 0.7)}
    return _samples(known.get(request.param, lambda: _learned(request.param))())


def _images(item: Samples, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """From just off the samples to far away: near images see a cluster from within its ball."""
    generator = torch.Generator().manual_seed(seed)

    def some() -> torch.Tensor:
        out = unit(torch.randn(count, 3, generator=generator, dtype=torch.float64))
        away = 10.0 ** (3.0 * torch.rand(count, 1, generator=generator, dtype=torch.float64) - 1.5)
        return item.centre + (item.radius + away) * out

    return some(), some()


def plain_scores(item: Samples, fore: torch.Tensor, aft: torch.Tensor) -> torch.Tensor:
    """One pair, every sample, by the definition."""
    to_fore, to_aft = fore - item.point, aft - item.point
    a, b = unit(to_fore), unit(to_aft)
    lit = ((a * item.normal).sum(-1) > 0) & ((b * item.normal).sum(-1) > 0)
    both = a + b
    along = both - (both * item.normal).sum(-1, keepdim=True) * item.normal
    bend = 1.0 / to_fore.norm(dim=-1) + 1.0 / to_aft.norm(dim=-1) + 2.0 * item.curvature
    score = -along.norm(dim=-1) / (bend * item.reach)
    return torch.where(lit, score, -torch.inf)


def plain_glints(item: Samples, fore: torch.Tensor, aft: torch.Tensor) -> set[int]:
    """The best sample of each patch, less those with a better one beside them."""
    score = plain_scores(item, fore, aft)
    best = []
    for patch in torch.unique(item.patch).tolist():
        inside = torch.nonzero(item.patch == patch).squeeze(-1)
        k = int(inside[score[inside].argmax()])
        if score[k] > -NEAR:
            best.append(k)
    kept = set()
    for k in best:
        beside = (item.point[best] - item.point[k]).norm(dim=-1) < BESIDE * item.radius
        alike = item.normal[best] @ item.normal[k] > ALIKE
        if not bool((beside & alike & (score[best] > score[k])).any()):
            kept.add(k)
    return kept


def test_clusters_hold_every_sample_once_within_their_bounds(item):
    members, clusters = item.clusters.members, item.clusters
    assert members[members >= 0].sort().values.tolist() == list(range(len(item.point)))
    for k in range(len(clusters)):
        sample = members[k][members[k] >= 0]
        away = (item.point[sample] - clusters.centre[k]).norm(dim=-1)
        assert float(away.max()) <= float(clusters.radius[k]) * (1 + 1e-12)
        cosine = item.normal[sample] @ clusters.normal[k]
        assert bool((cosine >= torch.cos(clusters.cone[k]) - 1e-12).all())
        assert bool((item.reach[sample] <= clusters.reach[k]).all())


def test_no_cluster_put_aside_holds_a_candidate(item):
    fore, aft = _images(item, 60)
    possible = may_glint(item.clusters, fore, aft)
    good = _good(item, fore, aft)
    dropped = 0
    for p in range(len(fore)):
        every = plain_scores(item, fore[p], aft[p])
        # a score at the limit itself is as rounding has it
        sure = torch.nonzero(every > -NEAR + 1e-6).squeeze(-1)
        mine = set(good.sample[good.pair == p].tolist())
        assert set(sure.tolist()) <= mine
        assert bool((every[sorted(mine)] > -NEAR - 1e-6).all()) or not mine
        dropped += int((~possible[p]).sum())
    assert dropped > 0  # else the test tests nothing


def test_glints_are_those_of_the_plain_loop(item):
    fore, aft = _images(item, 40, seed=1)
    pair, sample = glints(item, fore, aft)
    for p in range(len(fore)):
        assert set(sample[pair == p].tolist()) == plain_glints(item, fore[p], aft[p])


def test_a_sphere_glints_where_its_mirror_law_says():
    """The law of Alhazen's problem: at the glint the normal halves the angle between the images."""
    item = _samples(Sphere(0.4))
    fore, aft = _images(item, 50, seed=2)
    pair, sample = glints(item, fore, aft)
    lattice, seen = 0.4 * fibonacci(20_000), 0
    for p in range(len(fore)):
        a, b = unit(fore[p] - lattice), unit(aft[p] - lattice)
        normal = lattice / 0.4
        cosine = torch.stack([(a * normal).sum(-1), (b * normal).sum(-1)]).amin(0)
        turn = torch.where(cosine > 0.3, (unit(a + b) - normal).norm(dim=-1), torch.inf)
        if float(turn.min()) > 0.05:
            continue  # the glint grazes, or the ball stands between
        nearest = (item.point[sample[pair == p]] - lattice[turn.argmin()]).norm(dim=-1).min()
        assert float(nearest) <= NEAR * float(item.reach.max())
        seen += 1
    assert seen > 10


def test_samples_are_a_shapes_own_whatever_the_number_of_its_nodes():
    ball = Body(Sphere(0.4), Conductor())
    nodes = [Node(f"/b{i}", ball, Pose.at(2.0 * i, 0.0, 0.0)) for i in range(50)]
    world = World(Scene(tuple(nodes)))
    (found,) = samples_of(world)
    assert found.nodes.tolist() == list(range(50))
    assert found.point.data_ptr() == samples_of(world)[0].point.data_ptr()


def test_every_object_of_a_shape_is_looked_at_as_if_it_were_alone():
    ball, post = Body(Sphere(0.4), Conductor()), Body(Cylinder(0.1, 0.7), Conductor())
    poses = [
        Pose.at(3.0, 1.0, 0.5, 20.0, 2.0),
        Pose.at(-2.0, 4.0, 0.0),
        Pose.at(0.0, -3.0, 1.0, 70.0),
    ]
    nodes = [
        Node(f"/{k}{i}", b, p) for k, b in (("b", ball), ("p", post)) for i, p in enumerate(poses)
    ]
    tx, rx = vector(6.0, 0.0, 1.0)[None], torch.stack([vector(0, 7, 2), vector(-6, -5, 0.3)])

    def chains(some: list[Node], number: list[int], receivers: torch.Tensor, first: int) -> set:
        world = World(Scene(tuple(some)))
        found = enumerate_chains(world, tx, receivers, WAVELENGTH, Quality(depth=1))
        columns = zip(
            found.rx.tolist(),
            found.which[:, 0].tolist(),
            found.patch[:, 0].tolist(),
            found.seed[:, 0].tolist(),
            strict=True,
        )
        return {
            (r + first, number[w], k, *(round(x, 9) for x in seed)) for r, w, k, seed in columns
        }

    every = chains(nodes, list(range(6)), rx, 0)
    alone = [chains([n], [i], rx[r : r + 1], r) for i, n in enumerate(nodes) for r in (0, 1)]
    assert every == set().union(*alone) and len(every) > 6


# the first look


@pytest.mark.parametrize("lone", [True, False])
def test_a_first_look_leaves_glints_on_a_flat_side_and_drops_those_far_past_it(lone):
    """The cabinet's front: mirrors of its middle stay; of a point metres beside it, they go."""
    shape = _learned("cabinet")
    looks = Looks(shape, torch.device("cpu"), WAVELENGTH)
    low, high = looks.bounds
    middle = 0.5 * (low + high)
    aim = torch.stack([high[0], middle[1], middle[2]])
    sample = (looks.point - aim).norm(dim=-1).argmin()[None]
    normal = looks.normal[sample]
    side = torch.linalg.cross(normal, vector(0.0, 0.0, 1.0)[None])
    foot = looks.point[sample]
    fore, aft = foot + 3.0 * normal + side, foot + 3.0 * normal - side
    assert not bool(astray(looks, sample, fore, aft, STEPS, lone))
    beside = foot + 3.0 * normal + 9.0 * side, foot + 3.0 * normal + 7.0 * side
    assert bool(astray(looks, sample, *beside, STEPS, lone))


@pytest.mark.parametrize("lone", [True, False])
@pytest.mark.parametrize("name", ["cabinet", "person"])
@torch.no_grad()
def test_what_a_first_look_drops_settling_would_give_up_at_once(name, lone):
    """The plain twin: each candidate as a chain, after the first look that settling takes itself."""
    shape = _learned(name)
    item, looks = _samples(shape), Looks(shape, torch.device("cpu"), WAVELENGTH)
    fore, aft = _images(item, 80, seed=5)
    pair, sample = glints(item, fore, aft)
    dropped = astray(looks, sample, fore[pair], aft[pair], STEPS, lone)
    assert bool(dropped.any()) and not bool(dropped.all())
    node = Node("/item", Body(shape, Conductor()), Pose.identity())
    world, none = World(Scene((node,))), torch.zeros(len(pair), 1, dtype=torch.int64)
    x = item.point[sample][:, None]
    batch = Batch(pair, fore[pair], aft[pair], none, item.patch[sample][:, None], x)
    settling = Settling(world, WAVELENGTH, Quality())
    left = _look(settling, batch, _start(batch))
    assert not bool(dropped[left].any())
