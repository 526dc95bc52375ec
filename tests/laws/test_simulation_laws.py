"""Laws of whole simulations (design: laws 2, 5 and 6), on a small furnished room."""

import math
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.channel import coefficients
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, concrete, radio, room, room_nodes, vector

QUALITY = Quality(depth=2, rays=6000, floor_db=-100.0)


def furnished() -> Scene:
    """A room with a partition, a metal column, a ball, a post and a stochastic box: every surface."""
    surface = StochasticSurface(m=0.5, alpha=0.8, phi=0.3, sharpness=30.0, bulk=0.5)
    nodes = (
        *room_nodes(),
        box_node("/partition", (3.6, 1.2, 1.5), (0.05, 1.15, 1.45), Slab(0.1, itu="plasterboard")),
        Node("/column", Body(Cylinder(0.2, 1.4), Conductor()), Pose.at(2.4, 3.2, 1.5)),
        Node(
            "/ball",
            Body(Sphere(0.3), DielectricHalfSpace(eps_r=4.0, sigma=0.1)),
            Pose.at(4.9, 2.9, 1.1),
        ),
        Node("/post", Body(Capsule(0.15, 0.6), concrete()), Pose.at(1.9, 0.9, 1.0)),
        Node("/crate", Body(Box([0.3, 0.25, 0.4]), surface), Pose.at(4.6, 1.0, 0.6, 25.0)),
    )
    receivers = ((1.03, 1.21, 1.07), (5.17, 3.13, 2.29), (3.31, 0.71, 1.93), (5.37, 0.53, 0.91))
    rx = tuple(radio(f"/rx{i}", *p) for i, p in enumerate(receivers))
    tx = (radio("/tx0", 1.31, 2.11, 1.73), radio("/tx1", 5.3, 1.9, 2.4))
    return Scene(nodes, tx, rx, 2.4e9)


@pytest.fixture(scope="module")
def result():
    return simulate(furnished(), quality=QUALITY)


def _gains(result):
    return sorted(result.channel.gain[:, 0].abs().tolist())


def _close(a, b, relative):
    """|h| alike, relative to the strongest path of the link: a coherent sum may cancel."""
    difference = (a.transfer() - b.transfer()).abs()
    assert bool((difference <= relative * a.transfer().abs().clamp(min=1e-9)).all())


def test_reciprocity(result):
    """Transmitter and receiver change places: the same paths, each to 1e-9."""
    scene = result.scene
    swapped = simulate(
        replace(scene, transmitters=scene.receivers, receivers=scene.transmitters), quality=QUALITY
    )

    def table(found, flip):
        value = coefficients(found.channel)[:, 0]
        rows = {}
        for p in range(len(found.paths.tx)):
            chain = [w for w in found.paths.which[p].tolist() if w >= 0]
            ends = (int(found.paths.tx[p]), int(found.paths.rx[p]))
            key = (ends[::-1], tuple(chain[::-1])) if flip else (ends, tuple(chain))
            rows.setdefault(key, []).append(
                (round(float(found.paths.length[p]), 7), complex(value[p]))
            )
        return {k: sorted(v, key=lambda r: r[0]) for k, v in rows.items()}

    there, back = table(result, False), table(swapped, True)
    assert there.keys() == back.keys()
    for key, paths in there.items():
        assert len(paths) == len(back[key])
        for (_, a), (_, b) in zip(paths, back[key], strict=True):
            assert abs(a - b) <= 1e-9 * abs(a)


def test_rigid_motion_changes_nothing(result):
    """The whole scene turned, mirrored and carried 100 km away."""
    turn = Pose.at(0.0, 0.0, 0.0, 37.0).rotation
    mirror = torch.diag(vector(1.0, -1.0, 1.0))
    for rotation, offset in ((turn, vector(0, 0, 0)), (turn @ mirror, vector(1e5, -7e4, 300.0))):
        outer = Pose(rotation, offset, torch.ones((), dtype=torch.float64))
        scene = result.scene
        move = lambda r: replace(r, position=outer.point_world(r.position))  # noqa: E731, B023
        moved = replace(
            scene,
            nodes=tuple(replace(n, pose=outer.compose(n.pose)) for n in scene.nodes),
            transmitters=tuple(map(move, scene.transmitters)),
            receivers=tuple(map(move, scene.receivers)),
        )
        other = simulate(moved, quality=QUALITY)
        assert len(other.paths.tx) == len(result.paths.tx)
        # float64 holds 100 km to 1.5e-11 m: phases to 1e-9, gains of curved mirrors to 1e-8
        assert _gains(other) == pytest.approx(_gains(result), rel=1e-7)


def test_order_of_objects_changes_nothing(result):
    scene = result.scene
    other = simulate(replace(scene, nodes=scene.nodes[::-1]), quality=QUALITY)
    _close(result, other, 1e-9)


def test_receivers_one_by_one(result):
    """Batch equals loop: no receiver's result depends on who else listens."""
    for r, receiver in enumerate(result.scene.receivers):
        alone = simulate(result.scene.with_receivers([receiver]), quality=QUALITY)
        torch.testing.assert_close(
            alone.transfer()[:, 0], result.transfer()[:, r], rtol=1e-9, atol=1e-15
        )


def test_frequencies_one_by_one(result):
    both = simulate(
        result.scene, torch.tensor([2.4e9, 5.8e9]).double(), QUALITY, chains=result.chains
    )
    for k, f in enumerate((2.4e9, 5.8e9)):
        alone = simulate(result.scene, f, QUALITY, chains=result.chains)
        floor = 1e-3 * alone.transfer().abs().amax()
        assert float((both.transfer()[..., k] - alone.transfer()[..., 0]).abs().amax()) < floor


def test_chunks_change_nothing(result):
    small = replace(QUALITY, chunk=997)
    _close(result, simulate(result.scene, quality=small), 1e-9)


def test_no_gain_above_free_space(result):
    """Passivity: on planar mirrors every path is weaker than free space of its length."""
    flat = torch.tensor([isinstance(n.body.shape, Box) for n in result.scene.nodes])
    planar = (flat[result.paths.which.clamp(min=0)] | (result.paths.which < 0)).all(1)
    free = 299_792_458.0 / 2.4e9 / (4 * math.pi) / result.paths.length
    assert int(planar.sum()) > 50
    assert bool((result.channel.gain[:, 0].abs()[planar] <= free[planar] * (1 + 1e-12)).all())


def test_scaled_scene_at_scaled_frequency():
    """Lengths by c and frequency by 1/c: |h| by 1/c x 1/c... = gain unchanged (lambda / d is)."""
    c = 3.0

    def scene(scale):
        slab = Slab(0.1 * scale, eps_r=4.0, sigma=0.0)
        stuff = StochasticSurface(m=0.5, alpha=0.8, phi=0.3, sharpness=30.0)
        nodes = (
            Node(
                "/wall",
                Body(Box([0.05 * scale, 5.0 * scale, 5.0 * scale]), slab),
                Pose.at(scale, 0, 0),
            ),
            Node("/crate", Body(Box([0.3, 0.3, 0.3]), stuff), Pose.at(0, -scale, 0, 30.0, scale)),
            Node("/ball", Body(Sphere(0.4 * scale), Conductor()), Pose.at(-scale, 0.3 * scale, 0)),
        )
        tx, rx = (
            radio("/t", -0.2 * scale, 1.3 * scale, 0.1 * scale),
            radio("/r", 1.9 * scale, -1.1 * scale, 0.0),
        )
        return Scene(nodes, (tx,), (rx,))

    small, large = simulate(scene(1.0), 3e9, QUALITY), simulate(scene(c), 3e9 / c, QUALITY)
    assert len(small.paths.tx) > 2
    assert abs(complex(small.transfer()[0, 0, 0] - large.transfer()[0, 0, 0])) <= 1e-7 * abs(
        complex(small.transfer()[0, 0, 0])
    )


def test_power_has_the_right_gradients():
    """Path gains with respect to radio positions and an object's place: autograd against central
    differences, in float64, on kept chains."""

    def run(x, chains=None):
        ball = Body(Sphere(0.3), DielectricHalfSpace(eps_r=4.0, sigma=0.1))
        wall = Body(Box([0.1, 3.0, 3.0]), Slab(0.2, eps_r=5.0, sigma=0.05))
        pose = Pose.at(2.0, 0.5, 0.0)
        ball_pose = Pose(pose.rotation, pose.translation + x[3] * vector(0, 1.0, 0), pose.scale)
        tx = radio("/t", 0.0, 0.0, 0.0)
        rx = replace(radio("/r", 0.4, 2.2, 0.3), position=x[:3])
        scene = Scene(
            (Node("/ball", ball, ball_pose), Node("/wall", wall, Pose.at(-1.0, 0, 0))), (tx,), (rx,)
        )
        return simulate(scene, 1e9, QUALITY, gradients=True, chains=chains)

    start = torch.tensor([0.4, 2.2, 0.3, 0.05], dtype=torch.float64)
    chains = run(start).chains

    def power(x):
        return run(x, chains).path_gain().sum() * 1e6

    x = start.clone().requires_grad_(True)
    found = torch.autograd.grad(power(x), x)[0]
    for k in range(4):
        h = torch.zeros(4, dtype=torch.float64)
        h[k] = 1e-6
        expected = float(power(start + h) - power(start - h)) / 2e-6
        assert float(found[k]) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_power_differentiates_in_sizes_and_materials():
    """A ball's radius, a wall's permittivity and conductivity: autograd against central differences."""
    ball = Body(Sphere(0.3), DielectricHalfSpace(eps_r=4.0, sigma=0.1))
    wall = Body(Box([0.1, 3.0, 3.0]), Slab(0.2, eps_r=5.0, sigma=0.05))
    nodes = (Node("/ball", ball, Pose.at(2.0, 0.5, 0.0)), Node("/wall", wall, Pose.at(-1.0, 0, 0)))
    scene = Scene(nodes, (radio("/t", 0.0, 0.0, 0.0),), (radio("/r", 0.4, 2.2, 0.3),))
    chains = simulate(scene, 1e9, QUALITY).chains
    inputs = [ball.shape.radius, *wall.surface.parameters(), *ball.surface.parameters()]
    for p in inputs:
        p.requires_grad_(True)

    def power(gradients: bool):
        return (
            simulate(scene, 1e9, QUALITY, gradients=gradients, chains=chains).path_gain().sum()
            * 1e6
        )

    found = torch.autograd.grad(power(True), inputs)
    assert len(found) == 5
    for p, gradient in zip(inputs, found, strict=True):
        h = 1e-6
        with torch.no_grad():
            p += h
            above = float(power(False))
            p -= 2 * h
            below = float(power(False))
            p += h
        assert float(gradient) == pytest.approx((above - below) / (2 * h), rel=1e-4, abs=1e-6)
        assert float(gradient) != 0.0


def test_coincident_radios_and_empty_scene():
    """No NaN: a receiver on the transmitter is a status, not an infinity."""
    scene = Scene((), (radio("/t", 1.0, 2.0, 3.0),), (radio("/r", 1.0, 2.0, 3.0),))
    result = simulate(scene, 2.4e9)
    assert result.status_counts == {"DEGENERATE": 1}
    assert float(result.path_gain()) == 0.0
    nobody = simulate(Scene((), (), ()), 2.4e9)
    assert nobody.links() == []


def test_transmitter_inside_an_object_and_on_a_surface():
    for y in (0.0, 0.1):  # the middle of a wall, and its face
        nodes = (box_node("/wall", (0.0, 0.0, 0.0), (2.0, 0.1, 2.0)),)
        scene = Scene(nodes, (radio("/t", 0.0, y, 0.0),), (radio("/r", 0.3, 1.7, 0.2),))
        result = simulate(scene, 2.4e9, "draft")
        assert bool(torch.isfinite(result.path_gain()).all())
        assert len(result.paths.tx) >= 1


def test_moved_changes_only_paths_that_touch_or_cross():
    scene = room()
    crate = box_node("/crate", (4.0, 1.1, 0.5), (0.3, 0.3, 0.5), Conductor())
    scene = replace(scene, nodes=(*scene.nodes, crate))
    moved = scene.moved("/crate", (1.1, 0.0, 0.0))
    a, b = (simulate(s, quality=QUALITY) for s in (scene, moved))
    index = scene.index("/crate")

    def table(result):
        value, paths = coefficients(result.channel)[:, 0], result.paths
        rows = {}
        for p in range(len(paths.tx)):
            chain = tuple(paths.which[p].tolist())
            key = (int(paths.rx[p]), chain, round(float(paths.length[p]), 9))
            rows[key] = (complex(value[p]), index in chain)
        return rows

    before, after = table(a), table(b)
    untouched = {k: v for k, v in before.items() if k in after and not v[1]}
    for key, (value, _) in untouched.items():
        assert abs(value - after[key][0]) <= 1e-12 * abs(value)
    for key, (_, touches) in {**before, **after}.items():
        if (key in before) != (key in after) and not touches:
            # appeared or vanished without reflecting on the crate: the metal crate blocks it
            other = b if key in before else a
            assert _blocked_by(other, key, scene if other is a else moved, index)


def _blocked_by(result, key, scene, index):
    """True where the same chain, forced, meets the opaque object."""
    node = scene.nodes[index]
    paths = simulate(scene.without(node.path), quality=QUALITY)
    for p in range(len(paths.paths.tx)):
        which = [w + (w >= index) for w in paths.paths.which[p].tolist()]
        if (int(paths.paths.rx[p]), tuple(which)) == key[:2]:
            v = paths.paths.vertices[p]
            d = v[1:] - v[:-1]
            local = node.pose.point_object(v[:-1])
            direction = node.pose.direction_object(d)
            enter, leave = node.body.shape.interval(local, direction)
            if bool(((leave.clamp(max=1.0) - enter.clamp(min=0.0)) > 0).any()):
                return True
    return False
