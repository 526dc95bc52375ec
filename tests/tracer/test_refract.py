"""Bent paths as a part of the tracer: laws, gradients, and what stands in a solid's way."""

import math
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.channel import coefficients
from rfsg.tracer.newton import Batch, newton, surfaces_of
from rfsg.tracer.passages import merged
from rfsg.tracer.pencils import snell
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act, Crossings, runs_in
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, radio, vector

C = 299_792_458.0
DIRECT = Quality(depth=0, diffraction=0, floor_db=-300.0)
ONCE = Quality(depth=1, diffraction=0, floor_db=-150.0)


def solid(n: float, sigma: float = 0.0) -> Solid:
    return Solid(eps_r=n * n, sigma=sigma)


def node(path, shape, surface, *place, yaw=0.0):
    return Node(path, Body(shape, surface), Pose.at(*place, yaw))


def glassworks(polarization="none") -> Scene:
    """A ball, a rod, a prism and a wall, all solid, on a metal floor."""
    nodes = (
        node("/ball", Sphere(0.5), solid(1.5, 1e-4), 0.0, 0.0, 1.0),
        node("/rod", Cylinder(0.2, 0.8), solid(1.4), 1.2, 0.5, 0.9),
        node("/prism", Box([0.4, 0.4, 0.6]), solid(1.3), -1.1, 0.6, 1.0, yaw=45.0),
        node("/wall", Box([0.1, 2.0, 2.0]), Solid(itu="wood"), 2.5, 0.0, 1.0),
        node("/floor", HalfSpace(), Conductor(), 0.0, 0.0, 0.0),
    )
    places = ((3.3, 0.3, 1.1), (1.9, 0.9, 0.8))
    rx = tuple(radio(f"/r{i}", *p, polarization=polarization) for i, p in enumerate(places))
    return Scene(nodes, (radio("/t", -2.6, 0.4, 1.2, polarization=polarization),), rx, 5e9)


@pytest.fixture(scope="module")
def result():
    return simulate(glassworks("V"), quality=ONCE)


def table(found, flip=False):
    """Every path's length and coefficient, by radios and chain."""
    rows = {}
    value = coefficients(found.channel)[:, 0]
    for p in range(len(found.paths.tx)):
        chain = [w for w in found.paths.which[p].tolist() if w >= 0]
        ends = (int(found.paths.tx[p]), int(found.paths.rx[p]))
        key = (ends[::-1], tuple(chain[::-1])) if flip else (ends, tuple(chain))
        rows.setdefault(key, []).append((float(found.paths.length[p]), complex(value[p])))
    return {key: sorted(v, key=lambda r: r[0]) for key, v in rows.items()}


# laws


def test_everything_is_there(result):
    """The scene is a test of what it says it holds."""
    bent = (result.paths.act == Act.LEAVE).any(1)
    mirrored = (result.paths.act == Act.REFLECT) & (result.paths.which >= 0)
    met = result.paths.which[bent]
    assert set(met[met >= 0].tolist()) >= {0, 1, 2}
    assert int((bent & mirrored.any(1)).sum()) > 0
    assert int((result.paths.which[bent] >= 0).sum(1).max()) >= 4


def test_reciprocity(result):
    """Transmitter and receiver change places: the same paths, each to 1e-9."""
    scene = result.scene
    swapped = replace(scene, transmitters=scene.receivers, receivers=scene.transmitters)
    there, back = table(result), table(simulate(swapped, quality=ONCE), True)
    assert there.keys() == back.keys()
    for key, paths in there.items():
        assert len(paths) == len(back[key])
        for (_, a), (_, b) in zip(paths, back[key], strict=True):
            assert abs(a - b) <= 1e-9 * abs(a)


def test_rigid_motion_changes_nothing(result):
    """The whole scene turned, mirrored and carried 100 km away."""
    scene = result.scene
    turn = Pose.at(0.0, 0.0, 0.0, 37.0).rotation @ torch.diag(vector(1.0, -1.0, 1.0))
    outer = Pose(turn, vector(1e5, -7e4, 300.0), torch.ones((), dtype=torch.float64))

    def moved(radios):
        unpolarised = (replace(r, polarization="none") for r in radios)
        return tuple(replace(r, position=outer.point_world(r.position)) for r in unpolarised)

    other = Scene(
        tuple(replace(n, pose=outer.compose(n.pose)) for n in scene.nodes),
        moved(scene.transmitters),
        moved(scene.receivers),
        scene.frequency,
    )
    here, there = table(simulate(glassworks(), quality=ONCE)), table(simulate(other, quality=ONCE))
    assert here.keys() == there.keys()
    for key, paths in here.items():
        assert len(paths) == len(there[key])
        for (length, a), (far, b) in zip(paths, there[key], strict=True):
            assert far == pytest.approx(length, abs=1e-9)
            assert abs(b) == pytest.approx(abs(a), rel=1e-6)


def test_receivers_one_by_one(result):
    for r, receiver in enumerate(result.scene.receivers):
        alone = simulate(result.scene.with_receivers([receiver]), quality=ONCE)
        torch.testing.assert_close(
            alone.transfer()[:, 0], result.transfer()[:, r], rtol=1e-9, atol=1e-15
        )


def test_frequencies_share_one_geometry():
    """At another frequency the index has changed a little, and the path with it: by Fermat's
    principle the phase has not, to first order."""
    wet = Solid(itu="wet_ground")
    scene = Scene(
        (node("/b", Sphere(0.1), wet, 0, 0, 0),),
        (radio("/t", -1.0, 0.03, 0.0),),
        (radio("/r", 0.4, 0.02, 0.01),),
    )
    quality = replace(DIRECT, floor_db=-3000.0)
    both = simulate(scene, torch.tensor([5e9, 5.05e9]).double(), quality)
    alone = simulate(scene, 5.05e9, quality)
    assert len(both.paths.tx) == len(alone.paths.tx) > 0
    length = both.paths.vertices.diff(dim=1).norm(dim=-1)
    assert float(length[:, 1].amin()) > 0.15  # through the ball, not past it
    turned = coefficients(both.channel)[:, 1] / coefficients(alone.channel)[:, 0]
    assert float(turned.angle().abs().max()) < 1e-2
    moved = both.paths.vertices - alone.paths.vertices
    assert float(moved.norm(dim=-1).max()) > 1e-6


def test_doppler_is_the_rate_of_the_optical_length():
    """Of a moving ball, a moving transmitter and one radio inside: against two snapshots."""
    velocity, f, h = vector(3.0, -2.0, 1.0), 5e9, 1e-6

    def run(t, inside):
        ball = replace(
            node("/b", Sphere(0.5), solid(1.5), 0, 0, 0),
            pose=Pose.at(*(t * velocity).tolist()),
            velocity=velocity,
        )
        tx = replace(
            radio("/t", -2.0 + 5.0 * t, 0.2, 0.1 - 4.0 * t), velocity=vector(5.0, 0.0, -4.0)
        )
        rx = replace(radio("/r", *((0.2, 0.1, 0.0) if inside else (1.5, 0.3, -0.2))))
        return simulate(Scene((ball,), (tx,), (rx,)), f, DIRECT)

    for inside in (False, True):
        late, early, now = run(h, inside), run(-h, inside), run(0.0, inside)
        bent = [int(torch.nonzero((r.paths.act > 0).any(1))[0]) for r in (late, early, now)]
        rate = (late.channel.delay[bent[0]] - early.channel.delay[bent[1]]) / (2 * h)
        assert float(now.channel.doppler[bent[2]]) == pytest.approx(-f * float(rate), rel=1e-6)


# gradients


def lens_scene(x, surface, lens):
    """A lens that x moves and turns and a receiver that it carries; behind a ball's edge of focus
    three paths meet; through a prism one leads by neighbouring faces, one by opposite ones."""
    o, c, s = torch.zeros_like(x[0]), torch.cos(x[2] + math.pi / 4), torch.sin(x[2] + math.pi / 4)
    turn = torch.stack([c, -s, o, s, c, o, o, o, o + 1.0]).reshape(3, 3)
    pose = Pose(turn, torch.stack([x[0], x[1], o]), torch.ones_like(o))
    tx, rx = (vector(-4, 0, 0), vector(0.62, 0.02, 0.01))
    if isinstance(lens, Box):
        tx, rx = vector(-2.0, 0.25, 0.1), vector(2.0, 0.2, -0.1)
    radios = (
        (replace(radio("/t", 0, 0, 0), position=tx),),
        (replace(radio("/r", 0, 0, 0), position=rx + torch.stack([o, x[3], x[4]])),),
    )
    return Scene((Node("/lens", Body(lens, surface), pose),), *radios)


def observed(scene):
    """Power, phase and delay of each bent path, in the order of their delays."""
    result = simulate(scene, 2e9, DIRECT, gradients=True)
    bent = (result.paths.act == Act.LEAVE).any(1)
    order = torch.argsort(result.channel.delay.detach())
    k = order[bent[order]]
    value = coefficients(result.channel)[k, 0]
    return torch.cat([1e6 * value.abs() ** 2, value.angle(), 1e9 * result.channel.delay[k]])


@pytest.mark.parametrize(
    ("lens", "n", "paths"), [(Sphere(0.5), 1.5, 3), (Box([1.0, 1.0, 2.0]), 1.3, 2)]
)
def test_bent_paths_have_the_right_gradients(lens, n, paths):
    """Pose, size, permittivity, conductivity and receiver: autograd against central differences."""
    surface = Solid(eps_r=n * n, sigma=1e-3)
    fitted = [*lens.parameters(), *surface.medium.parameters()]
    for p in fitted:
        p.requires_grad_(True)
    x = torch.zeros(5, dtype=torch.float64, requires_grad=True)
    value = observed(lens_scene(x, surface, lens))
    assert len(value) == 3 * paths
    inputs = [x, *fitted]
    found = [torch.autograd.grad(v, inputs, retain_graph=True) for v in value]
    flat = torch.stack([torch.cat([g.reshape(-1) for g in row]) for row in found])

    def shifted(step):
        with torch.no_grad():
            moved = torch.zeros(5, dtype=torch.float64)
            pieces = [moved, *(p.view(-1) for p in fitted)]
            parts = step.split([len(p) for p in pieces])
            for piece, part in zip(pieces, parts, strict=True):
                piece += part
            value = observed(lens_scene(moved, surface, lens))
            for piece, part in zip(pieces, parts, strict=True):
                piece -= part
            return value

    generator = torch.Generator().manual_seed(5)
    for _ in range(3):  # ways for all inputs to change together
        way = torch.randn(flat.shape[1], generator=generator, dtype=torch.float64)
        difference = ((shifted(1e-6 * way) - shifted(-1e-6 * way)) / 2e-6).detach()
        torch.testing.assert_close(flat @ way, difference, rtol=2e-5, atol=2e-6)
    # a ball may be turned, and a prism grow along its edges, without a change; nothing else may
    idle = torch.zeros(flat.shape[1], dtype=torch.bool)
    idle[7 if isinstance(lens, Box) else 2] = True
    assert torch.equal(flat.abs().amax(0) < 1e-9, idle)


@pytest.mark.parametrize("make", [lambda: Slab(0.2, eps_r=5.0), lambda: Solid(eps_r=5.0)])
def test_walls_have_the_right_gradients(make):
    """Straight through: where the receiver is and how the wall is turned both change the angle."""

    def run(x):
        o = torch.zeros_like(x[0])
        c, s = torch.cos(x[0]), torch.sin(x[0])
        turn = torch.stack([c, -s, o, s, c, o, o, o, o + 1.0]).reshape(3, 3)
        wall = Node(
            "/w", Body(Box([0.1, 3, 3]), make()), Pose(turn, torch.stack([x[1], o, o]), o + 1)
        )
        rx = replace(radio("/r", 0, 0, 0), position=torch.stack([x[2] + 3.0, x[3] + 1.0, o]))
        result = simulate(
            Scene((wall,), (radio("/t", -3, -1, 0),), (rx,)), 1e9, DIRECT, gradients=True
        )
        h = result.transfer()[0, 0, 0]
        return torch.stack([1e6 * h.abs() ** 2, h.angle(), 1e9 * result.channel.delay[0]])

    x = torch.zeros(4, dtype=torch.float64)
    found = torch.autograd.functional.jacobian(run, x)
    for k in range(4):
        h = torch.zeros(4, dtype=torch.float64)
        h[k] = 1e-6
        difference = (run(x + h) - run(x - h)) / 2e-6
        torch.testing.assert_close(found[:, k], difference.detach(), rtol=1e-6, atol=1e-6)


# cutting


def halves(axis, surface):
    """A wall of 0.2 x 4 x 4 m, whole, and cut across one of its axes into two that are flush."""
    half, centre = [0.1, 2.0, 2.0], [0.0, 0.0, 0.0]
    small = [h / 2 if a == axis else h for a, h in enumerate(half)]
    parts = []
    for side in (-1, 1):
        at = [
            c + side * s if a == axis else c
            for a, (c, s) in enumerate(zip(centre, small, strict=True))
        ]
        parts.append(box_node(f"/half{side}", at, small, surface))
    return (box_node("/whole", centre, half, surface),), tuple(parts)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_wall_cut_into_flush_halves_is_the_same_wall(axis):
    """Across its thickness or across its face: T, R and delay of every path to 1e-12."""
    rx = (radio("/through", 2.0, 0.5, 0.2), radio("/off", -1.5, 0.5, 0.1))
    tables = []
    for nodes in halves(axis, Solid(eps_r=5.0, sigma=0.02)):
        scene = Scene(nodes, (radio("/t", -2.0, -0.6, 0.0),), rx)
        found = simulate(scene, 2.4e9, ONCE).channel
        order = torch.argsort(found.delay)
        tables.append((found.delay[order], found.gain[order]))
    (delay, gain), (cut_delay, cut_gain) = tables
    assert len(delay) == len(cut_delay) == 3
    torch.testing.assert_close(cut_delay, delay, rtol=1e-14, atol=0)
    torch.testing.assert_close(cut_gain, gain, rtol=1e-12, atol=0)


def test_a_prism_cut_into_flush_halves_is_the_same_prism():
    """A path enters one half and leaves the other; the seam between them is not there."""
    gains = []
    surface = solid(1.3)
    whole = (node("/p", Box([0.5, 0.5, 1.0]), surface, 0, 0, 0, yaw=45.0),)
    # cut along the plane through its middle that the path crosses
    step = 0.25 * math.sqrt(0.5)
    cut = tuple(
        node(f"/p{k}", Box([0.25, 0.5, 1.0]), surface, s * step, s * step, 0, yaw=45.0)
        for k, s in enumerate((-1, 1))
    )
    for nodes in (whole, cut):
        scene = Scene(nodes, (radio("/t", -1.5, -0.1, 0.1),), (radio("/r", 1.5, -0.1, -0.1),))
        found = simulate(scene, 2.4e9, DIRECT)
        order = torch.argsort(found.channel.delay)
        gains.append(found.channel.gain[order, 0])
    assert len(gains[0]) > 0
    torch.testing.assert_close(gains[1], gains[0], rtol=1e-10, atol=0)


def test_solids_apart_or_of_two_media_are_not_one():
    """What is merged is flush and of one medium; a micrometre of air is a gap (its echoes are not
    followed, so the product of both transmissions is the answer)."""
    one, other = Solid(eps_r=5.0), Solid(eps_r=5.5)
    alone = simulate(
        Scene((box_node("/a", (0, 0, 0), (0.1, 2, 2), one),), *_ends()), 2.4e9, DIRECT
    ).channel
    second = simulate(
        Scene((box_node("/a", (0.2, 0, 0), (0.1, 2, 2), other),), *_ends()), 2.4e9, DIRECT
    ).channel
    free = simulate(Scene((), *_ends()), 2.4e9, DIRECT).channel
    product = alone.gain * second.gain / free.gain
    for gap, surface in ((0.0, other), (1e-6, other)):
        nodes = (
            box_node("/a", (0, 0, 0), (0.1, 2, 2), one),
            box_node("/b", (0.2 + gap, 0, 0), (0.1, 2, 2), surface),
        )
        found = simulate(Scene(nodes, *_ends()), 2.4e9, DIRECT).channel
        torch.testing.assert_close(found.gain, product, rtol=1e-9, atol=0)


def _ends():
    return (radio("/t", -2, 0, 0),), (radio("/r", 2, 0.0, 0.0),)


def test_merged_stretches_against_a_plain_loop():
    """Random stretches on rays: runs of one medium, flush or overlapping, found one by one."""
    media = (Solid(eps_r=2.0), Solid(eps_r=3.0), Conductor())
    nodes = tuple(box_node(f"/n{k}", (k, 0, 0), (1, 1, 1), media[k % 3]) for k in range(9))
    world = World(Scene(nodes))
    generator = torch.Generator().manual_seed(3)
    draw = lambda *n: torch.randint(0, 40, n, generator=generator).double() / 4  # noqa: E731
    m = 400
    ray = torch.sort(torch.randint(0, 60, (m,), generator=generator)).values
    which = torch.randint(0, 9, (m,), generator=generator)
    enter = draw(m)
    leave = enter + 0.25 + draw(m) / 8
    order = torch.argsort(ray * 1000.0 + enter, stable=True)
    normal = torch.arange(m).double()[:, None].expand(m, 3)
    columns = (ray, which, enter, leave, normal, -normal)
    runs = merged(world, Crossings(*(c[order] for c in columns)))
    found = sorted(
        zip(
            *(getattr(runs, n).tolist() for n in ("ray", "which", "last", "enter", "leave")),
            strict=True,
        )
    )
    expected, open_run = [], {}
    for i in order.tolist():
        r, w, a, b = int(ray[i]), int(which[i]), float(enter[i]), float(leave[i])
        key = (r, w % 3)
        last = open_run.get(key)
        if w % 3 == 2 or last is None or a > last[4] + 1e-8:
            expected.append([r, w, w, a, b])
            open_run[key] = expected[-1]
        elif b > last[4]:
            last[2], last[4] = w, b
    assert found == sorted(tuple(e) for e in expected)
    assert len(found) < m


# what stands in the way


def test_a_metal_core_shadows_a_ball():
    tx, rx = (radio("/t", -2, 0, 0),), (radio("/r", 2, 0, 0),)
    ball = node("/b", Sphere(0.5), solid(1.4), 0, 0, 0)
    core = node("/c", Sphere(0.05), Conductor(), 0, 0, 0)
    free, shadowed = (
        simulate(Scene(nodes, tx, rx), 10e9, DIRECT) for nodes in ((ball,), (ball, core))
    )
    assert free.status_counts["OK"] == shadowed.status_counts.get("OK", 0) + 1
    assert shadowed.status_counts["OPAQUE"] == 1


def test_a_pane_of_vacuum_in_a_ball_changes_nothing_and_a_real_one_counts():
    tx, rx = (radio("/t", -2, 0.1, 0),), (radio("/r", 2, 0.0, 0.1),)
    ball = node("/b", Sphere(0.5), solid(1.4), 0, 0, 0)
    gains = []
    for pane in (None, Slab(0.02, eps_r=1.0), Slab(0.02, eps_r=1.0, sigma=0.1)):
        extra = () if pane is None else (box_node("/p", (0, 0, 0), (0.01, 0.2, 0.2), pane),)
        found = simulate(Scene((ball, *extra), tx, rx), 10e9, DIRECT)
        assert len(found.paths.tx) == 1
        gains.append(complex(found.channel.gain[0, 0]))
    assert gains[1] == pytest.approx(gains[0], rel=1e-12)
    assert abs(gains[2]) < 0.9 * abs(gains[0])


def test_without_refraction_a_solid_is_crossed_straight():
    """sqrt((1 - R^2)(1 - R^2)) exp(-j k (n - 1) chord) over the straight line's 1/r."""
    n, f = 1.5, 5e9
    ball = node("/b", Sphere(0.5), solid(n), 0, 0, 0)
    scene = Scene((ball,), (radio("/t", -2, 0.3, 0),), (radio("/r", 2, 0.3, 0),))
    result = simulate(scene, f, replace(DIRECT, refraction=False))
    cosine = 0.8
    inner = math.sqrt(1 - 0.36 / n**2)
    te = (cosine - n * inner) / (cosine + n * inner)
    tm = (n * cosine - inner) / (n * cosine + inner)
    power = 0.5 * ((1 - te**2) ** 2 + (1 - tm**2) ** 2)
    h = complex(result.transfer()[0, 0, 0])
    assert abs(h) == pytest.approx(C / f / (4 * math.pi * 4.0) * math.sqrt(power), rel=1e-12)
    optical = 4.0 + (n - 1) * 0.8
    assert float(result.channel.delay[0]) == pytest.approx(optical / C, rel=1e-14)
    phase = h * complex(
        math.cos(2 * math.pi * f * optical / C), math.sin(2 * math.pi * f * optical / C)
    )
    assert phase.imag / phase.real == pytest.approx(0.0, abs=1e-9)


class Rippling(Sphere):
    """A ball that is only known to the accuracy of a learned shape."""

    exact = False


def test_learned_solids_are_crossed_straight_and_say_so():
    ends = (radio("/t", -2, 0.3, 0),), (radio("/r", 2, 0.3, 0),)
    learned = simulate(Scene((node("/b", Rippling(0.5), solid(1.5), 0, 0, 0),), *ends), 5e9, DIRECT)
    straight = replace(DIRECT, refraction=False)
    exact = simulate(Scene((node("/b", Sphere(0.5), solid(1.5), 0, 0, 0),), *ends), 5e9, straight)
    torch.testing.assert_close(learned.transfer(), exact.transfer(), rtol=1e-12, atol=0)
    said = lambda r, part: any(part in s for s in (*r.plan.modelled, *r.plan.left_out))  # noqa: E731
    assert said(learned, "refraction in solids")
    assert said(exact, "solids are crossed straight")
    assert said(simulate(Scene((), *ends), 5e9, DIRECT), "the scene holds no solid")


def test_faces_of_two_media_at_one_point_leave_the_path_straight():
    """A lens let into another: nobody says which medium lies between, so nothing is bent there."""
    nodes = (
        node("/a", Sphere(0.5), solid(1.4), 0, 0, 0),
        node("/b", Sphere(0.3), solid(1.7), 0.1, 0, 0),
    )
    scene = Scene(nodes, (radio("/t", -2, 0.1, 0),), (radio("/r", 2, 0.1, 0),))
    result = simulate(scene, 5e9, DIRECT)
    straight = (result.paths.which < 0).all(1)
    assert int(straight.sum()) == 1
    assert sorted(result.channel.crossed[:, 1].tolist()) == [0, 1]


# how they are found


def test_no_path_through_a_ball_is_missed():
    """Newton from two hundred random pairs of points finds no path that the search did not, near a
    focus and far from it."""
    world = World(Scene((node("/b", Sphere(0.5), solid(1.5), 0, 0, 0),)))
    generator = torch.Generator().manual_seed(7)
    for rx in (
        (0.62, 0.03, 0.01),
        (0.8, 0.3, -0.2),
        (3.0, 0.4, 0.1),
        (1.0, 2.0, 0.5),
    ):
        tx = (-2.0, 0.0, 0.1)
        scene = Scene(world.scene.nodes, (radio("/t", *tx),), (radio("/r", *rx),))
        found = simulate(scene, 30e9, DIRECT)
        bent = (found.paths.act == Act.LEAVE).any(1)
        mine = found.paths.vertices[bent][:, 1:3]
        x = torch.randn(200, 2, 3, generator=generator, dtype=torch.float64)
        x = 0.5 * torch.nn.functional.normalize(x, dim=-1)
        zero = torch.zeros(200, 2, dtype=torch.int64)
        batch = Batch(
            zero[:, 0], vector(*tx).expand(200, 3), vector(*rx).expand(200, 3), zero, zero, x
        )
        index = vector(1.0, 1.5, 1.0).expand(200, 3)
        rest, settled = newton(batch, surfaces_of(world, batch, None), 60, index)
        u = torch.nn.functional.normalize(batch.polyline(rest).diff(dim=1), dim=-1)
        n = rest / 0.5
        inward = [(u[:, k] * n[:, 0]).sum(-1) < -1e-6 for k in (0, 1)]
        outward = [(u[:, k] * n[:, 1]).sum(-1) > 1e-6 for k in (1, 2)]
        true = rest[torch.stack([settled, *inward, *outward]).all(0)]
        assert len(true) > 0
        gap = (true[:, None] - mine[None]).norm(dim=-1).amax(-1).amin(1)
        assert float(gap.max()) < 1e-6


def test_no_path_through_a_box_is_missed():
    """Each pair of its faces has one stationary path, which Newton finds from the faces' middles; what
    lies on them and is met from the right sides is what the search found. None of these receivers is
    seen straight through opposite faces."""
    n = 1.25
    box = node("/b", Box([0.5, 0.4, 0.6]), solid(n), 0, 0, 0, yaw=40.0)
    world = World(Scene((box,)))
    pairs = torch.cartesian_prod(torch.arange(6), torch.arange(6))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    count = len(pairs)
    which = torch.zeros_like(pairs)
    normal, offset, _ = world.plane(which.reshape(-1), pairs.reshape(-1))
    middle = (normal * offset[:, None]).reshape(count, 2, 3)
    first, last = normal.reshape(count, 2, 3).unbind(1)
    seen = 0
    for rx in ((1.6, 0.1, 0.2), (1.5, -0.7, 0.1), (1.1, 0.6, 0.9), (1.4, 0.4, -0.8)):
        tx = (-1.5, 0.1, -0.2)
        found = simulate(Scene((box,), (radio("/t", *tx),), (radio("/r", *rx),)), 30e9, DIRECT)
        bent = (found.paths.act == Act.LEAVE).any(1)
        mine = {tuple(row) for row in found.paths.item[bent].tolist()}
        ends = (vector(*tx).expand(count, 3), vector(*rx).expand(count, 3))
        batch = Batch(which[:, 0], *ends, which, pairs, middle)
        index = vector(1.0, n, 1.0).expand(count, 3)
        rest, settled = newton(batch, surfaces_of(world, batch, None), 80, index)
        u = torch.nn.functional.normalize(batch.polyline(rest).diff(dim=1), dim=-1)
        good = settled & ((u[:, 0] * first).sum(-1) < 0) & ((u[:, 1] * first).sum(-1) < 0)
        good &= ((u[:, 1] * last).sum(-1) > 0) & ((u[:, 2] * last).sum(-1) > 0)
        off = world.sdf(which.reshape(-1), rest.reshape(-1, 3)).abs().reshape(-1, 2).amax(1)
        good &= off < 1e-9
        assert mine == {tuple(row) for row in pairs[good].tolist()}
        seen += len(mine)
    assert seen >= 3


def test_snell_turns_and_returns():
    generator = torch.Generator().manual_seed(1)
    normal = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=generator).double(), dim=-1
    )
    u = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator).double(), dim=-1)
    u = torch.where(((u * normal).sum(-1) > 0)[:, None], -u, u)
    ratio = torch.full((500,), 1 / 1.7, dtype=torch.float64)
    into, passes = snell(u, normal, ratio)
    assert bool(passes.all())
    along = torch.linalg.cross(u, normal) - 1.7 * torch.linalg.cross(into, normal)
    assert float(along.abs().max()) < 1e-14
    back, passes = snell(-into, -normal, 1 / ratio)
    assert bool(passes.all())
    torch.testing.assert_close(back, -u, rtol=0, atol=1e-12)
    _, passes = snell(u, normal, 1 / ratio)
    sine = torch.linalg.cross(u, normal).norm(dim=-1)
    assert torch.equal(passes, sine < 1 / 1.7)


def test_which_solid_a_segment_runs_in():
    """Between entering and leaving, before a first leaving and after a last entering."""
    e, x, r = int(Act.ENTER), int(Act.LEAVE), int(Act.REFLECT)
    which = torch.tensor([[4, 4, 7], [2, 2, 5], [3, -1, -1], [6, 8, 6], [1, 9, -1], [5, 5, -1]])
    act = torch.tensor([[e, x, r], [r, e, x], [x, 0, 0], [e, r, x], [e, r, 0], [r, r, 0]])
    expected = [[-1, 4, -1, -1], [-1, -1, 5, -1], [3, -1, -1, -1], [-1, 6, 6, -1], [-1, 1, 1, 1]]
    assert runs_in(which, act).tolist() == [*expected, [-1, -1, -1, -1]]
