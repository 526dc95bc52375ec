"""Diffuse reflection against closed forms, plain quadrature, its own laws, and the rays of maps."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.physics import fresnel, media
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer import scatter
from rfsg.tracer.channel import power
from rfsg.tracer.montecarlo import estimate_power
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act
from rfsg.tracer.simulate import Result, simulate
from rfsg.tracer.tiles import curved_tiles, hashed
from tests.scenes import box_node, radio, room_nodes
from tests.tracer.shapes import Field, ball, two_walls
from tests.truths.rough import (
    FREE,
    FREQUENCY,
    LOBES,
    QUALITY,
    at_phase_angles,
    diffuse,
    ground,
    lambert_disc,
    lambert_plane,
    lambert_sphere,
    of_one,
    plain_sum,
    real,
)


def mirrors(result: Result) -> int:
    return int((result.paths.act[result.paths.which >= 0] == int(Act.REFLECT)).sum())


# closed forms


@pytest.mark.parametrize(("low", "high"), [(1.0, 1.5), (1.0, 10.0), (0.1, 100.0)])
def test_endless_lambertian_plane(low, high):
    body = Body(HalfSpace(), Conductor(Scattering(1.0)))
    for count, error in ((8, 3e-3), (32, 3e-4)):
        quality = replace(QUALITY, diffuse=count)
        found = diffuse(of_one(body, (0, 0, low), [(0, 1e-9, high)], quality))
        assert float(found) == pytest.approx(lambert_plane(low, high), rel=error)


def test_lambertian_disc():
    """The top of a cylinder, in tiles of straight lines."""
    h, a = 1.3, 0.9
    body = Body(Cylinder(a, 0.2), Conductor(Scattering(1.0)))
    truth = lambert_disc(h, a)
    for count, error in ((8, 8e-3), (24, 2e-3)):
        quality = replace(QUALITY, diffuse=count)
        found = diffuse(of_one(body, (0, 0, 0.2 + h), [(0, 1e-9, 0.2 + h)], quality))
        assert float(found) == pytest.approx(truth, rel=error)


def test_lambert_sphere():
    a, angles = 0.7, (0.01, 0.5, 1.2, 2.0, 2.8)
    truth = [lambert_sphere(a, b) for b in angles]
    for shape, error in ((Sphere(a), 4e-3), (Field(ball(a), [a + 0.05] * 3), 8e-3)):
        body = Body(shape, Conductor(Scattering(1.0)))
        found = at_phase_angles(body, angles)
        assert found.tolist() == pytest.approx(truth, rel=error)


@pytest.mark.parametrize("kind", LOBES)
def test_plate_against_plain_quadrature_and_tiles_converge(kind):
    """A dielectric plate of 3 m x 1.4 m seen at different angles: second order in the tiles."""
    half, tx, rx = (1.5, 0.7), (-1.1, 0.3, 0.8), (0.9, -0.5, 1.4)
    truth = plain_sum(LOBES[kind], tx, rx, half)
    surface = DielectricHalfSpace(eps_r=5.24, sigma=0.05, scattering=LOBES[kind])
    body, pose = Body(Box((*half, 0.1)), surface), Pose.at(0, 0, -0.1)
    errors = []
    for count in (8, 16, 32):
        found = of_one(body, tx, [rx], replace(QUALITY, diffuse=count), pose=pose)
        errors.append(abs(float(diffuse(found)) / truth - 1.0))
    assert errors[0] < 0.02 and errors[2] < 1.5e-3
    assert errors[2] < 0.25 * errors[0]


@pytest.mark.parametrize("kind", LOBES)
def test_energy_over_the_hemisphere(kind):
    """What crosses a hemisphere of receivers is S^2 |R|^2 of what the plate receives."""
    s, far, theta = 0.6, 300.0, math.radians(50.0)
    half = 0.5
    options = {k: v for k, v in LOBES[kind].config().items() if k != "coefficient"}
    rough = Scattering(s, **options)
    surface = DielectricHalfSpace(eps_r=5.24, sigma=0.05, scattering=rough)
    body = Body(Box((half, half, 1e-6)), surface)
    node, weight = np.polynomial.legendre.leggauss(16)
    height, weight = 0.5 * (node + 1.0), 0.5 * weight
    phi = 2 * math.pi * (np.arange(32) + 0.3) / 32
    ring = [
        (
            far * math.sqrt(1 - z * z) * math.cos(p),
            far * math.sqrt(1 - z * z) * math.sin(p),
            far * z,
        )
        for z in height
        for p in phi
    ]
    tx = (far * math.sin(theta), 0.0, far * math.cos(theta))
    found = of_one(body, tx, ring, replace(QUALITY, diffuse=2))
    area = np.repeat(weight, 32) * 2 * math.pi / 32
    # |gain|^2 / (lambda / 4 pi)^2 is 4 pi x density on the receiver; times 4 pi / 4 pi far^2
    leaving = float((diffuse(found)[0] * torch.from_numpy(area)).sum()) * far**2 / (4 * math.pi)
    arriving = (2 * half) ** 2 * math.cos(theta) / (4 * math.pi * far**2)
    eps = media.from_constants(real(5.24), real(0.05), real([FREQUENCY]))
    te, tm = fresnel.interface(torch.tensor([math.cos(theta)], dtype=torch.float64), eps)
    reflected = float(0.5 * (te.abs() ** 2 + tm.abs() ** 2))
    assert leaving / arriving == pytest.approx(s**2 * reflected, rel=5e-3)


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        (Sphere(0.7), 4 * math.pi * 0.49),
        (Capsule(0.3, 0.5), 4 * math.pi * 0.09 + 2 * math.pi * 0.3),
        (Cylinder(0.9, 0.2), 2 * math.pi * 0.81 + 2 * math.pi * 0.9 * 0.4),
        # two plates of 1 x 1 m, 8 cm thick, that the bounds cut off at the sides
        (Field(two_walls(0.3, 0.08), [0.3, 0.5, 0.5]), 4.0),
    ],
)
def test_tiles_hold_the_whole_area(shape, area):
    """Also turned, and at another scale."""
    pose = replace(Pose.at(5.0, 6.0, 7.0, 20.0), scale=torch.tensor(0.5, dtype=torch.float64))
    world = World(Scene((Node("/it", Body(shape, Conductor(Scattering(1.0))), pose),)))
    for count, error in ((8, 1e-2), (16, 4e-3)):
        tiles = curved_tiles(world, 0, count)
        assert float(tiles.area.sum()) == pytest.approx(0.25 * area, rel=error)
        assert 2 * count**2 <= len(tiles) <= 6 * count**2


# the mirror's share


def test_smooth_is_exactly_nothing():
    """S = 0 and no word of scattering: the same bits, and the plan says that it was dropped."""
    tx, rx = (0.0, 0.0, 1.0), [(4.0, 0.0, 2.0)]
    plain = of_one(ground(), tx, rx)
    for body in (ground(Scattering(0.0)), ground(None)):
        found = of_one(body, tx, rx)
        assert torch.equal(found.channel.gain, plain.channel.gain)
        assert torch.equal(found.paths.vertices, plain.paths.vertices)
        assert any("no surface of the scene scatters" in s for s in found.plan.left_out)


def test_the_mirror_keeps_its_share_whether_or_not_tiles_are_followed():
    tx, rx = (0.0, 0.0, 1.0), [(4.0, 0.0, 2.0)]
    whole = of_one(ground(), tx, rx).channel.gain[1, 0]
    for count in (0, 8):
        found = of_one(ground(Scattering(0.6)), tx, rx, replace(QUALITY, diffuse=count))
        mirror = found.channel.gain[1, 0]
        assert int(found.paths.act[1, 0]) == int(Act.REFLECT)
        assert complex(mirror / whole) == pytest.approx(0.8, abs=1e-12)
        assert bool((found.paths.act == int(Act.SCATTER)).any()) == (count > 0)
        everything = of_one(ground(Scattering(1.0)), tx, rx, replace(QUALITY, diffuse=count))
        assert mirrors(everything) == 0
    left = of_one(ground(Scattering(0.6)), tx, rx, replace(QUALITY, diffuse=0)).plan.left_out
    assert any("mirrors do without" in s for s in left)


def test_learned_surface_scatters_what_alpha_leaves():
    """Share 1 - alpha by Lambert's law where it is followed; the whole of R in the mirror elsewhere.
    At alpha = 0 |R| is the same at all angles, and the tiles are those of a conductor times |R|^2."""
    tx, rx = (-0.8, 0.2, 1.0), [(0.9, -0.3, 1.2)]
    pose, box = Pose.at(0, 0, -0.1), Box((1.5, 0.7, 0.1))
    for alpha in (0.7, 0.0):
        body = Body(box, StochasticSurface(m=0.4, alpha=alpha, phi=0.2))
        off = of_one(body, tx, rx, replace(QUALITY, diffuse=0), pose=pose)
        on = of_one(body, tx, rx, pose=pose)
        assert mirrors(off) == 1
        assert bool(diffuse(on) > 0) and not bool(diffuse(off).any())
        whole = off.channel.gain[1, 0]
        share = complex(on.channel.gain[1, 0] / whole)
        assert share == pytest.approx(math.sqrt(alpha), abs=1e-6)
    rough = Body(box, Conductor(Scattering(1.0)))
    reflected = float(whole.abs() * off.paths.length[1]) ** 2 / FREE
    plate = float(diffuse(of_one(rough, tx, rx, pose=pose)))
    assert float(diffuse(on)) == pytest.approx(reflected * plate, rel=1e-6)


# reciprocity, polarisation


def lab(surface, pol: str = "none") -> Scene:
    """A room with one rough wall, a rough ball and a rough post."""
    nodes = [replace(n, body=Body(n.body.shape, Conductor())) for n in room_nodes()]
    nodes[1] = replace(nodes[1], body=Body(nodes[1].body.shape, surface))
    nodes.append(Node("/ball", Body(Sphere(0.3), surface), Pose.at(4.4, 2.9, 1.1)))
    nodes.append(Node("/post", Body(Cylinder(0.15, 0.9), surface), Pose.at(2.4, 1.0, 1.0)))
    tilt = Pose.at(0, 0, 0, 35.0).rotation
    options = {"polarization": pol, "rotation": tilt}
    tx = (radio("/a", 1.31, 2.11, 1.73, **options), radio("/b", 3.3, 1.9, 2.4, **options))
    rx = (radio("/c", 1.03, 1.21, 1.07, polarization=pol),)
    return Scene(tuple(nodes), tx, rx, FREQUENCY)


def by_tile(result: Result, values: Tensor, flip: bool) -> dict:
    rows = {}
    for p in torch.nonzero((result.paths.act == int(Act.SCATTER)).any(1)).squeeze(-1).tolist():
        ends = (int(result.paths.tx[p]), int(result.paths.rx[p]))
        steps = [
            (w, i)
            for w, i in zip(
                result.paths.which[p].tolist(), result.paths.item[p].tolist(), strict=True
            )
            if w >= 0
        ]
        key = (ends[::-1], tuple(steps[::-1])) if flip else (ends, tuple(steps))
        assert key not in rows
        rows[key] = values[p]
    return rows


def test_reciprocity_of_conductors_that_scatter_by_lamberts_law():
    """Every path, mirrors beside the tile included, with its 2 x 2 matrix and its cross-polar share."""
    scene = lab(Conductor(Scattering(0.8, cross_share=0.3)), "V")
    quality = replace(QUALITY, depth=2, diffuse=4)
    turned = replace(scene, transmitters=scene.receivers, receivers=scene.transmitters)
    there, back = simulate(scene, quality=quality), simulate(turned, quality=quality)
    assert there.channel.jones is not None and back.channel.jones is not None
    a = by_tile(there, there.channel.jones[:, 0], False)
    b = by_tile(back, back.channel.jones[:, 0].mT, True)
    assert a.keys() == b.keys() and len(a) > 300
    assert {len(steps) for _, steps in a} == {1, 2}
    worst = max(float((a[k] - b[k]).abs().max() / a[k].abs().max()) for k in a)
    assert worst < 1e-9
    h = there.transfer(), back.transfer().transpose(0, 1)
    torch.testing.assert_close(h[0], h[1], rtol=1e-9, atol=1e-15)


def test_reciprocity_of_a_dielectric_at_equal_angles_only():
    """|R(theta_i)|^2 is the same both ways at equal angles; the model has no more (Vitucci 2023)."""
    surface = DielectricHalfSpace(eps_r=5.24, sigma=0.05, scattering=Scattering(0.8))
    body, pose = Body(Box((0.2, 0.2, 0.1)), surface), Pose.at(0, 0, -0.1)
    quality = replace(QUALITY, diffuse=1)
    for angle, alike in ((50.0, True), (10.0, False)):
        there, here = math.radians(50.0), math.radians(angle)
        a = (-7 * math.sin(there), 0.0, 7 * math.cos(there))
        b = (0.0, 4 * math.sin(here), 4 * math.cos(here))
        gain = [of_one(body, x, [y], quality, pose=pose) for x, y in ((a, b), (b, a))]
        one, two = (complex(g.channel.gain[g.paths.act[:, 0] == int(Act.SCATTER), 0]) for g in gain)
        assert (abs(one - two) < 1e-12 * abs(one)) == alike


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
def test_cross_polarisation_has_its_share(share):
    """A wall lit and seen in the horizontal plane: V stays V but for K_x of the power in H."""
    surface = Conductor(Scattering(0.7, cross_share=share))
    body = Body(Box((0.1, 0.3, 1e-4)), surface)
    found = of_one(body, (9.0, 0.0, 6.0), [(-4.0, 0.0, 11.0)], polarization="V", pose=upright())
    i = (found.paths.act == int(Act.SCATTER)).any(1)
    assert found.channel.jones is not None
    column = found.channel.jones[i, 0, :, 0]  # what a theta wave becomes
    co, cross = (column.abs() ** 2).sum(0).tolist()
    assert co + cross == pytest.approx(float(diffuse_unpolarised(surface)), rel=1e-6)
    assert cross / (co + cross) == pytest.approx(share, abs=1e-3)


def upright() -> Pose:
    """z up becomes y up: the plate of the xy plane stands."""
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    return replace(Pose.identity(), rotation=turn)


def diffuse_unpolarised(surface) -> Tensor:
    body = Body(Box((0.1, 0.3, 1e-4)), surface)
    return diffuse(of_one(body, (9.0, 0.0, 6.0), [(-4.0, 0.0, 11.0)], pose=upright())) * FREE


def test_field_vectors_carry_the_power_of_the_scalar_link():
    """Of a conductor ||J||_F^2 / 2 = |gain|^2 for every tile, at any angle and any K_x."""
    scalars = simulate(lab(Conductor(Scattering(0.8))), quality=QUALITY)
    vectors = simulate(lab(Conductor(Scattering(0.8, cross_share=0.4)), "V"), quality=QUALITY)
    assert vectors.channel.jones is not None
    a = by_tile(scalars, scalars.channel.gain[:, 0].abs() ** 2, False)
    b = by_tile(vectors, 0.5 * (vectors.channel.jones[:, 0].abs() ** 2).sum((1, 2)), False)
    assert a.keys() == b.keys()
    for key, value in a.items():
        assert float(b[key]) == pytest.approx(float(value), rel=1e-9)


# phases, orders, mirrors


def test_same_every_time_and_another_seed_changes_phases_alone():
    scene = lab(concrete_rough())
    one, again = (simulate(scene, quality=QUALITY) for _ in range(2))
    assert torch.equal(one.channel.gain, again.channel.gain)
    other = simulate(scene, quality=replace(QUALITY, phase_seed=1))
    i = (one.paths.act == int(Act.SCATTER)).any(1)
    torch.testing.assert_close(one.channel.gain.abs(), other.channel.gain.abs(), rtol=1e-13, atol=0)
    assert torch.equal(one.channel.gain[~i], other.channel.gain[~i])
    turn = torch.angle(one.channel.gain[i, 0] / other.channel.gain[i, 0])
    assert abs(complex(torch.polar(torch.ones_like(turn), turn).mean())) < 4 / int(i.sum()) ** 0.5


def concrete_rough() -> Slab:
    return Slab(0.2, eps_r=5.24, sigma=0.05, scattering=Scattering(0.6))


def test_the_mean_over_seeds_is_the_sum_of_powers():
    """|sum|^2 of random phases is exponential about the sum of powers: 400 draws, 5 %."""
    tx, rx = (0.0, 0.0, 1.0), [(2.0, 0.0, 1.5)]
    body = Body(HalfSpace(), Conductor(Scattering(1.0)))
    found = of_one(body, tx, rx)
    i = torch.nonzero((found.paths.act == int(Act.SCATTER)).any(1)).squeeze(-1)
    size = found.channel.gain[i, 0].abs()
    mean = 0.0
    for seed in range(400):
        number = hashed(torch.stack([torch.full_like(i, seed), found.paths.item[i, 0]], 1))
        phase = number.double() * (2 * math.pi / 2**47)
        mean += float(torch.polar(size, phase).sum().abs() ** 2) / 400
    assert mean == pytest.approx(float((size**2).sum()), rel=4 / 400**0.5)
    assert int(hashed(torch.arange(4096)[:, None]).unique().numel()) == 4096


def test_order_of_objects_and_a_rigid_motion_change_nothing():
    opaque = DielectricHalfSpace(
        eps_r=5.24, sigma=0.05, scattering=Scattering(0.6, cross_share=0.1)
    )
    scene = lab(opaque, "V")
    h = simulate(scene, quality=QUALITY).transfer()
    flipped = simulate(replace(scene, nodes=scene.nodes[::-1]), quality=QUALITY).transfer()
    torch.testing.assert_close(flipped, h, rtol=1e-9, atol=0)
    turn, shift = Pose.at(0, 0, 0, 30.0).rotation, torch.tensor([900.0, -300.0, 20.0])

    def moved(x):
        return turn @ x + shift.double()

    nodes = tuple(
        replace(n, pose=replace(n.pose, rotation=turn @ n.pose.rotation,
                                translation=moved(n.pose.translation)))
        for n in scene.nodes
    )  # fmt: skip
    radios = [
        tuple(replace(r, position=moved(r.position), rotation=turn @ r.rotation) for r in some)
        for some in (scene.transmitters, scene.receivers)
    ]
    there = simulate(
        replace(scene, nodes=nodes, transmitters=radios[0], receivers=radios[1]), quality=QUALITY
    )
    torch.testing.assert_close(there.transfer(), h, rtol=1e-8, atol=0)


def test_a_mirror_beside_the_tile_is_an_image():
    """A rough wall on a smooth floor: floor then wall is the wall alone, lit by the image."""
    wall = box_node("/wall", (0.0, 2.1, 1.0), (2.0, 0.1, 1.0), concrete_rough())
    floor = Node("/floor", Body(HalfSpace(), Conductor()), Pose.identity())
    tx, rx = radio("/t", -0.7, 0.9, 0.9), radio("/r", 0.8, 0.7, 1.1)
    both = simulate(
        Scene((wall, floor), (tx,), (rx,), FREQUENCY), quality=replace(QUALITY, depth=2)
    )
    order = (both.paths.which >= 0).sum(1)
    scattered = (both.paths.act == int(Act.SCATTER)).any(1) & (order == 2)
    gain = both.channel.gain[:, 0].abs() ** 2
    for level, sources in ((1, (-0.9, 1.1)), (0, (0.9, -1.1))):
        mine = scattered & (both.paths.act[:, level] == int(Act.SCATTER))
        lone = simulate(
            Scene(
                (wall,),
                (radio("/t", -0.7, 0.9, sources[0]),),
                (radio("/r", 0.8, 0.7, sources[1]),),
                FREQUENCY,
            ),
            quality=QUALITY,
        )
        assert float(gain[mine].sum()) / FREE == pytest.approx(float(diffuse(lone)), rel=1e-9)
    assert any("up to one planar mirror" in s for s in both.plan.modelled)


def test_tiles_stand_or_fall_together():
    """The floor of the power is for an object's tiles together, however fine they are."""
    body = Body(Box((1.0, 1.0, 0.1)), Conductor(Scattering(0.3)))
    tx, rx = (0.4, 0.3, 2.0), [(-0.5, 0.2, 3.0)]
    for count in (4, 32):
        every = of_one(body, tx, rx, replace(QUALITY, diffuse=count))
        i = (every.paths.act == int(Act.SCATTER)).any(1)
        below = every.channel.gain[i, 0].abs() * every.paths.length[i] / FREE**0.5
        whole = 20 * math.log10(float(below.square().sum().sqrt()))
        for floor, kept in ((whole - 0.01, True), (whole + 0.01, False)):
            assert bool((20 * torch.log10(below) < floor).all())  # each alone would have fallen
            found = of_one(body, tx, rx, replace(QUALITY, diffuse=count, floor_db=floor))
            assert float(diffuse(found)) == (float(diffuse(every)) if kept else 0.0)
            assert (found.status_counts.get("BELOW_FLOOR", 0) >= count**2) == (not kept)


def test_what_stands_between_takes_its_toll():
    """An opaque screen takes the tiles behind it away; a slab lets its share through."""
    wall = box_node("/wall", (0.0, 2.1, 1.0), (2.0, 0.1, 1.0), Conductor(Scattering(1.0)))
    ends = (radio("/t", -0.7, 0.9, 0.9),), (radio("/r", 0.8, 0.7, 1.1),)

    def seen(surface):
        screen = box_node("/screen", (0.0, 1.0, 1.0), (0.01, 0.4, 3.0), surface)
        return simulate(Scene((wall, screen), *ends, FREQUENCY), quality=QUALITY)

    opaque, thin = seen(Conductor()), seen(Slab(0.01, eps_r=1.0, sigma=0.0))
    free = simulate(Scene((wall,), *ends, FREQUENCY), quality=QUALITY)
    assert 0 < float(diffuse(opaque)) < 0.9 * float(diffuse(free))
    assert opaque.status_counts["OPAQUE"] > 0
    assert float(diffuse(thin)) == pytest.approx(float(diffuse(free)), rel=1e-9)


def test_too_many_tiles_are_refused_or_left_out(monkeypatch):
    tx, rx = (0.0, 0.0, 1.0), [(4.0, 0.0, 2.0)]
    monkeypatch.setattr(scatter, "MOST_TILES", 10)
    with pytest.raises(ValueError, match="diffuse=8: the tiles between 1 transmitters and 1"):
        of_one(ground(Scattering(0.5)), tx, rx)
    scene = lab(concrete_rough())
    direct = len(simulate_tiles(scene, 1))
    monkeypatch.setattr(scatter, "MOST_TILES", 100_000)
    assert len(simulate_tiles(scene, 1)) > direct
    monkeypatch.setattr(scatter, "MOST_TILES", 2000)
    found = simulate(scene, quality=replace(QUALITY, depth=2))
    assert any("mirrors beside a scattering tile" in s for s in found.plan.left_out)


def simulate_tiles(scene: Scene, depth: int) -> list:
    try:
        return simulate(scene, quality=replace(QUALITY, depth=depth)).paths.tx.tolist()
    except ValueError:
        return []


# gradients


def test_power_differentiates():
    """In S, a radio's position, poses, and sizes of flat and curved shapes: central differences."""
    box, ball_shape, post = Box((0.1, 1.5, 1.0)), Sphere(0.4), Cylinder(0.2, 0.9)
    shares = [Scattering(0.6), Scattering(0.5), Scattering(0.7, "directive", alpha_r=3)]
    surfaces = (
        Slab(0.2, eps_r=5.24, sigma=0.05, scattering=shares[0]),
        DielectricHalfSpace(eps_r=4.0, scattering=shares[1]),
        Conductor(shares[2]),
    )
    bodies = [Body(*b) for b in zip((box, ball_shape, post), surfaces, strict=True)]
    place = real([0.4, 0.7, 0.3])
    poses = [real([-2.1, -0.3, -0.1]), real([1.1, 0.3, 0.1]), real([0.2, -1.2, 0.1])]
    sizes = [box.half_size, ball_shape.radius, post.radius]
    inputs = [place, *poses, *sizes, *(s.coefficient for s in shares)]

    def total(gradients):
        nodes = tuple(
            Node(f"/{i}", body, replace(Pose.identity(), translation=pose))
            for i, (body, pose) in enumerate(zip(bodies, poses, strict=True))
        )
        rx = replace(radio("/r", 0, 0, 0), position=place)
        scene = Scene(nodes, (radio("/t", 0.0, 0.1, 0.2),), (rx,), FREQUENCY)
        quality = replace(QUALITY, diffuse=2)
        result = simulate(scene, quality=quality, gradients=gradients)
        return power(result.channel, 1, 1).sum() / FREE

    for p in inputs:
        p.requires_grad_(True)
    found = torch.autograd.grad(total(True), inputs)
    h = 1e-6
    for p, gradient in zip(inputs, found, strict=True):
        way = torch.rand(p.shape, dtype=torch.float64) + 0.2
        with torch.no_grad():
            p += h * way
            above = float(total(False))
            p -= 2 * h * way
            below = float(total(False))
            p += h * way
        expected = (above - below) / (2 * h)
        assert float((gradient * way).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-8)
        assert expected != 0.0


def test_learned_shapes_carry_gradients_to_their_tiles():
    """Of a ball that is marched: dA/dr = 8 pi r, and what it gathers grows as that of the true ball."""
    radius = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    marched = Field(lambda p: torch.sqrt((p * p).sum(-1) + 1e-30) - radius, [0.75] * 3)
    exact = Sphere(0.7)
    exact.radius.requires_grad_(True)
    slopes = []
    for shape, size in ((marched, radius), (exact, exact.radius)):
        world = World(
            Scene((Node("/it", Body(shape, Conductor(Scattering(1.0))), Pose.identity()),))
        )
        tiles = curved_tiles(world, 0, 8)
        ends = [real([2.0, 1.0, 0.7]), real([1.5, -1.0, 1.2])]
        source, target = (e.expand(len(tiles), 3) for e in ends)
        sums = tiles.area.sum(), scatter.gather(world, tiles, source, target).sum()
        slopes.append([float(torch.autograd.grad(v, size, retain_graph=True)[0]) for v in sums])
    assert slopes[0][0] == pytest.approx(8 * math.pi * 0.7, rel=5e-3)
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-2)


def test_gradients_are_finite_at_the_ends():
    """S at 0 and 1, K_x at 0, normal incidence, a transmitter a nanometre above the face."""
    receivers = (radio("/r", 0.0, 0.0, 1.0, polarization="V"), radio("/s", 3.0, 0.0, 1e-3))
    for s in (0.0, 1.0):
        rough, place = Scattering(s), real([0.0, 0.0, 1e-9]).requires_grad_(True)
        rough.coefficient.requires_grad_(True)
        tx = replace(radio("/t", 0, 0, 0, polarization="V"), position=place)
        node = Node("/it", Body(HalfSpace(), Conductor(rough)), Pose.identity())
        scene = Scene((node,), (tx,), receivers, FREQUENCY)
        found = simulate(scene, quality=replace(QUALITY, diffuse=2), gradients=True)
        assert bool(torch.isfinite(found.channel.gain).all())
        total = power(found.channel, 1, 2).sum()
        for slope in torch.autograd.grad(total, [rough.coefficient, place]):
            assert bool(torch.isfinite(slope).all())


# rays


@pytest.mark.parametrize(
    ("rough", "branching"),
    [
        (Scattering(1.0), "enumerate"),
        (Scattering(0.9, "backscattering", alpha_r=3, alpha_i=6, forward_share=0.4), "draw"),
    ],
)
def test_rays_and_paths_agree_in_the_mean(rough, branching):
    """A rough wall on a mirror of a floor, a screen before the line of sight: depth 2, both orders."""
    surface = DielectricHalfSpace(eps_r=5.24, sigma=0.05, scattering=rough)
    black = DielectricHalfSpace(eps_r=1.0, sigma=0.0)
    nodes = (
        box_node("/wall", (0.0, 2.1, 1.0), (2.0, 0.1, 1.0), surface),
        box_node("/screen", (0.0, -0.5, 1.0), (0.02, 1.5, 1.0), black),
        Node("/floor", Body(HalfSpace(), Conductor()), Pose.identity()),
    )
    scene = Scene(nodes, (radio("/t", -0.7, 0.9, 0.9),), (radio("/r", 0.8, 0.8, 1.0),), FREQUENCY)
    quality = Quality(depth=2, diffuse=12, diffraction=0, floor_db=-120.0, map_rays=80_000)
    result = simulate(scene, quality=quality)
    paths = float(power(result.channel, 1, 1))
    assert float(diffuse(result)) * FREE > 0.5 * paths
    rays, error = estimate_power(scene, quality=quality, radius=0.2, branching=branching)
    assert float(error) < 0.2 * paths
    assert abs(float(rays) - paths) < 3.5 * float(error)


# files

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    custom double rfsg:frequencyHz = 2440000000
    def Material "Stucco"
    {
        custom token rfsg:material:model = "slab"
        custom token rfsg:material:itu = "concrete"
        custom double rfsg:material:scattering = 0.4
        SAYS
    }
    def Cube "Wall" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {
        double size = 1
        rel material:binding = </World/Stucco>
        double3 xformOp:translate = (2, 2, 1)
        double3 xformOp:scale = (3, 0.2, 2)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }
    def Xform "AP"
    {
        custom token rfsg:radio:role = "tx"
        double3 xformOp:translate = (1, 0, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Xform "rx_0"
    {
        custom token rfsg:radio:role = "rx"
        double3 xformOp:translate = (3, 0.3, 1.2)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""
DIRECTIVE = """custom token rfsg:material:lobe = "backscattering"
        custom int rfsg:material:alphaR = 4
        custom int rfsg:material:alphaI = 2
        custom double rfsg:material:forwardShare = 0.75
        custom double rfsg:material:crossShare = 0.1"""


def stage(tmp_path, says: str):
    file = tmp_path / "scene.usda"
    file.write_text(STAGE.replace("SAYS", says))
    return file


def test_usd_says_how_a_surface_scatters_and_is_written_back(tmp_path):
    scene = Scene.from_usd(stage(tmp_path, DIRECTIVE))
    rough = scene.node("/World/Wall").body.scattering
    assert rough is not None and rough.config() == {
        "coefficient": 0.4,
        "lobe": "backscattering",
        "alpha_r": 4,
        "alpha_i": 2,
        "forward_share": 0.75,
        "cross_share": 0.1,
    }
    again = Scene.from_usd(scene.to_usd(tmp_path / "again.usda"))
    assert again.node("/World/Wall").body.surface.config() == (
        scene.node("/World/Wall").body.surface.config()
    )
    plain = Scene.from_usd(stage(tmp_path, "")).node("/World/Wall").body.scattering
    assert plain is not None and plain.lobe == "lambertian"
    one, two = (simulate(s, quality=QUALITY).transfer() for s in (scene, again))
    torch.testing.assert_close(one, two, rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("says", "complaint"),
    [
        ('custom token rfsg:material:lobe = "gaussian"', "lambertian, directive, backscattering"),
        ('custom token rfsg:material:lobe = "directive"', "alpha_r"),
        ("custom double rfsg:material:crossShare = 1.5", "cross_share"),
    ],
)
def test_usd_that_says_it_wrong_is_refused(tmp_path, says, complaint):
    from rfsg.scene.scene import SceneError

    with pytest.raises(SceneError, match=complaint):
        Scene.from_usd(stage(tmp_path, says))


def test_command_line_follows_it(tmp_path, capsys):
    from rfsg import cli

    file = stage(tmp_path, DIRECTIVE)
    out = tmp_path / "out"
    code = cli.run(["simulate", str(file), "--set", "diffuse=8", "--out", str(out)])
    assert code == 0, capsys.readouterr().err
    report = (out / "report.json").read_text()
    assert "diffuse reflection" in report and "over one tile each" in report
    assert "scattering(/World/Wall)" in (out / "paths.csv").read_text()
