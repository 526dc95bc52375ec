"""The power floor of an enumeration: what is dropped is proven, and what is asked for is kept."""

import math
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.contract import Contact
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid, backed
from rfsg.scene.antennas import PATTERNS
from rfsg.scene.patterns import Pattern
from rfsg.scene.pose import Pose
from rfsg.scene.radios import amplitude
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.bounds import CELLS, Floor, largest_amplitude, least_product, most_reflected
from rfsg.tracer.faces import planes_of
from rfsg.tracer.images import fold, images_of
from rfsg.tracer.lattice import fibonacci
from rfsg.tracer.plan import Quality
from rfsg.tracer.sequences import Budget, levels
from rfsg.tracer.simulate import simulate
from tests.scenes import radio, room, vector

MEDIA = (
    {"eps_r": 1.0},
    {"eps_r": 1.0, "sigma": 0.3},
    {"eps_r": 2.7, "sigma": 0.005},
    {"eps_r": 5.24, "sigma": 0.05},
    {"eps_r": 5.24, "sigma": 3.0},
    {"eps_r": 30.0, "sigma": 0.0},
    {"eps_r": 2.0, "sigma": 1e5},
)


def surfaces(medium, thick):
    rough = Scattering(0.4)
    return (
        Slab(thick, **medium),
        Slab(thick, scattering=rough, **medium),
        DielectricHalfSpace(**medium),
        DielectricHalfSpace(scattering=rough, **medium),
        Solid(**medium),
        Conductor(),
        Conductor(scattering=rough),
    )


@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("thick", [0.003, 0.1, 0.7])
def test_no_reflection_is_stronger_than_its_bound(medium, thick):
    frequency = vector(0.8e9, 5.8e9, 28e9)
    generator = torch.Generator().manual_seed(3)
    cosine = torch.cat(
        [torch.rand(3000, generator=generator).double(), torch.linspace(0, 1, 200).double()]
    )
    sine, none = torch.sqrt(1.0 - cosine**2), torch.zeros_like(cosine)
    box = Box([1.0, 1.0, 0.5 * thick])
    contact = Contact(
        vector(0.1, 0.2, 0.5 * thick).expand(len(cosine), 3),
        torch.stack([sine, none, -cosine], -1),
        torch.stack([sine, none, cosine], -1),
        vector(0.0, 0.0, 1.0).expand(len(cosine), 3),
    )  # fmt: skip
    for surface in surfaces(medium, thick):
        mine = backed(box, contact) if isinstance(surface, Solid) else contact
        true = surface.reflection(box, mine, frequency).abs().amax(-1).amax(-1)
        bound = most_reflected(Body(box, surface), frequency)
        assert bound.shape == (CELLS,) and bool((bound[1:] <= bound[:-1]).all())
        cell = (cosine * CELLS).long().clamp(max=CELLS - 1)
        assert bool((true <= bound[cell]).all())


def test_bounds_are_close_where_they_can_be():
    """A half-space is bounded by itself; a layer whose wavelengths are many cells to within a few %."""
    frequency = vector(2.4e9)
    half = Body(Box([1.0, 1.0, 1.0]), DielectricHalfSpace(eps_r=5.24))
    assert float(most_reflected(half, frequency)[-1]) == pytest.approx(
        (math.sqrt(5.24) - 1) / (math.sqrt(5.24) + 1), rel=1e-3
    )
    wall = Body(Box([1.0, 1.0, 0.1]), Slab(0.01, eps_r=2.7))
    down = Contact(*(vector(*x)[None] for x in ((0, 0, 0.1), (0, 0, -1), (0, 0, 1), (0, 0, 1))))
    true = float(wall.reflection(down, frequency).abs().amax())
    assert true < float(most_reflected(wall, frequency)[-1]) < 1.05 * true


@pytest.mark.parametrize("name", PATTERNS)
def test_antennas_reach_their_largest_amplitude_and_no_more(name):
    antenna = radio("/r", 0.0, 0.0, 0.0, pattern=name)
    around = torch.cat([fibonacci(20_000), torch.eye(3).double(), -torch.eye(3).double()])
    most = float(amplitude(antenna, around).max())
    assert most <= largest_amplitude(antenna) * (1 + 1e-12) and most > 0.999 * largest_amplitude(
        antenna
    )


def test_a_measured_antenna_and_what_antennas_lift():
    grid = torch.ones(7, 12, dtype=torch.float64)
    grid[3, 4] = 3.0
    degrees = [
        torch.linspace(0, 180, 7).double().numpy(),
        torch.arange(0, 360, 30).double().numpy(),
    ]
    pattern = Pattern.from_samples("lobe", *degrees, grid)
    antenna = radio("/tx", 1.31, 2.11, 1.73, pattern=pattern)
    assert largest_amplitude(antenna) == pytest.approx(3.0)
    scene = replace(room(), transmitters=(antenna,))
    quality = Quality(floor_db=-40.0)
    assert least_product(World(scene), quality) == pytest.approx(0.01 / 3.0)
    assert least_product(World(room()), quality) == pytest.approx(0.01)


def papered(scene, generator):
    """The room with a wall of its own for every side, and metal and a ball in it."""
    kinds = (
        lambda: Slab(0.02, eps_r=2.0),
        lambda: Slab(0.1, eps_r=2.7, sigma=0.02, scattering=Scattering(0.6)),
        lambda: DielectricHalfSpace(eps_r=3.0, sigma=0.1),
        lambda: DielectricHalfSpace(eps_r=1.5),
    )
    nodes = []
    for node in scene.nodes:
        kind = kinds[int(torch.randint(len(kinds), (1,), generator=generator))]
        nodes.append(replace(node, body=Body(node.body.shape, kind())))
    plate = Node("/plate", Body(Box([0.4, 0.3, 0.01]), Conductor()), Pose.at(3.0, 2.0, 1.2, 30.0))
    ball = Node("/ball", Body(Sphere(0.25), Conductor()), Pose.at(4.5, 1.2, 0.9))
    return replace(scene, nodes=(*nodes, plate, ball))


def table(result):
    paths = result.paths
    rows = zip(
        paths.tx.tolist(), paths.rx.tolist(), paths.which.tolist(), paths.item.tolist(), strict=True
    )
    gains = result.channel.gain[:, 0].tolist()
    return {(*map(str, row), round(float(length), 9)): gain
            for row, length, gain in zip(rows, paths.length, gains, strict=True)}  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("floor_db", [-15.0, -30.0, -45.0])
def test_the_same_paths_with_and_without_pruning(seed, floor_db, monkeypatch):
    scene = papered(room(), torch.Generator().manual_seed(seed))
    if seed % 2:
        scene = replace(scene, transmitters=(replace(scene.transmitters[0], pattern="tr38901"),))
    frequency = torch.tensor([2.4e9, 6.0e9], dtype=torch.float64)
    quality = Quality(depth=4, floor_db=floor_db, search="enumerate")
    pruned = simulate(scene, frequency, quality)
    monkeypatch.setattr(Floor, "of", staticmethod(lambda *_: None))
    every = simulate(scene, frequency, quality)
    assert table(pruned) == table(every)
    assert pruned.search.candidates <= every.search.candidates and every.search.pruned == 0
    if floor_db > -40.0:
        assert pruned.search.pruned > 0
        assert f"{pruned.search.pruned} beginnings" in pruned.search.sentence()


def test_what_a_prefix_carries_bounds_each_of_its_paths():
    """Fold paths onto prefixes and multiply their mirrors' own reflections."""
    world = World(papered(room(), torch.Generator().manual_seed(11)))
    planes, frequency = planes_of(world), vector(3.5e9)
    floor = Floor(world, planes, frequency, Quality(depth=3, floor_db=-300.0))
    source = vector(1.31, 2.11, 1.73)
    target = 0.1 + torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).double() * vector(
        5.8, 3.8, 2.8
    )
    looked_at = 0
    for prefixes in levels(planes, source, 3, Budget(10**9), floor)[1:]:
        row = torch.arange(len(prefixes.image)).repeat_interleave(len(target))
        end, faces = target.repeat(len(prefixes.image), 1), prefixes.faces[row]
        mirrors = [(planes.node[f], planes.patch[f]) for f in faces.unbind(1)]
        images = images_of(world, mirrors, source.expand(len(row), 3))
        points, on = fold(world, images, mirrors, end)
        row, points, end, faces = (x[on] for x in (row, points, end, faces))
        line = torch.cat([source.expand(len(row), 1, 3), points, end[:, None]], 1)
        way = torch.nn.functional.normalize(line.diff(dim=1), dim=-1)
        product = torch.ones(len(row), dtype=torch.float64)
        for level in range(faces.shape[1]):
            node, normal = planes.node[faces[:, level]], planes.normal[faces[:, level]]
            contact = Contact(points[:, level], way[:, level], way[:, level + 1], normal)
            product *= world.reflection(node, contact, frequency).abs().amax(-1).amax(-1)
        assert bool((product <= prefixes.carried.most[row]).all())
        looked_at += len(row)
    assert looked_at > 1000


def test_nothing_is_dropped_where_solids_bend_waves_or_nothing_can_be():
    scene = papered(room(), torch.Generator().manual_seed(0))
    glass = Node("/glass", Body(Box([0.1, 0.4, 0.4]), Solid(eps_r=6.0)), Pose.at(2.0, 1.5, 1.0))
    bending = World(replace(scene, nodes=(*scene.nodes, glass)))
    quality = Quality(depth=4, floor_db=-20.0)
    ask = lambda world, quality: Floor.of(world, planes_of(world), vector(2.4e9), quality)  # noqa: E731
    assert ask(World(scene), quality) is not None
    assert ask(bending, quality) is None
    assert ask(bending, replace(quality, refraction=False)) is not None
    assert ask(World(scene), replace(quality, floor_db=-200.0)) is None


def test_what_a_material_reflects_is_asked_anew_when_it_changes():
    wall = Body(Box([0.1, 2.0, 1.0]), Slab(0.1, eps_r=2.7, sigma=0.005))
    scene = Scene((Node("/wall", wall, Pose.at(0.0, 0.0, 0.0)),))
    frequency, quality = vector(2.4e9), Quality()

    def most():
        world = World(scene)
        return Floor(world, planes_of(world), frequency, quality).most

    def plain():
        return torch.stack([most_reflected(b, frequency) for b in World(scene).surfaces])

    before = most()
    assert torch.equal(before, plain()) and torch.equal(before, most())
    with torch.no_grad():
        wall.surface.medium.eps_r.mul_(1.5)  # as a fit does
    assert torch.equal(most(), plain()) and not torch.equal(most(), before)
