"""Dielectric walls, prisms and balls against what is known of them in closed form or by quadrature."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, radio
from tests.truths.layers import (
    DIRECT,
    WALLS,
    C,
    eps_of,
    second_term,
    seen_at,
    sommerfeld,
    through,
    transfer_matrix,
    wall_scene,
)

# walls


@pytest.mark.parametrize("f", [2.4e9, 28e9])
@pytest.mark.parametrize("angle", [0.0, 45.0, 80.0])
@pytest.mark.parametrize("kind", WALLS)
def test_wall_transmits_as_the_transfer_matrix_says(kind, angle, f):
    """Amplitude, phase and group delay, TE and TM."""
    d, h = 0.1, f * 1e-6
    sine, cosine = np.float64(math.sin(math.radians(angle))), math.cos(math.radians(angle))
    scene = wall_scene(WALLS[kind](d), angle, d, polarization="V")
    length = 6.0 / cosine
    result = simulate(scene, f, DIRECT)

    def crossing(f, pol):
        face_to_face = transfer_matrix(sine, cosine, eps_of(f), d, f)[pol][1]
        return face_to_face * np.exp(2j * math.pi * f / C * d * cosine)

    free = C / f / (4 * math.pi * length)
    turns = f * float(result.channel.delay[0])
    jones = result.channel.jones[0, 0].numpy() * np.exp(-2j * math.pi * (turns % 1.0)) / free
    jones = jones * np.exp(2j * math.pi * ((f * length / C) % 1.0))
    # theta-hat is -z at both ends, across the plane of incidence; phi-hat of the receiver, which
    # looks back along the wave, is minus the transmitter's
    assert jones[0, 0] == pytest.approx(crossing(f, 0), rel=1e-9)
    assert -jones[1, 1] == pytest.approx(crossing(f, 1), rel=1e-9)
    assert abs(jones[0, 1]) + abs(jones[1, 0]) < 1e-12
    group = -np.angle(crossing(f + h, 0) / crossing(f - h, 0)) / (4 * math.pi * h)
    assert float(result.channel.delay[0]) - length / C == pytest.approx(group, rel=1e-5)


@pytest.mark.parametrize("f", [2.4e9, 28e9])
@pytest.mark.parametrize("angle", [0.0, 60.0, 85.0])
def test_solid_wall_is_the_slab_of_its_thickness(angle, f):
    """Through it and off it, to rounding: amplitude, phase, delay, TE and TM."""
    results = []
    for make in WALLS.values():
        scene = wall_scene(make(0.2), angle, 0.2, polarization="V")
        lean = scene.transmitters[0].position[1].item()
        other = radio("/r2", -2.0, -lean - 1.0, 0.3, polarization="V")
        scene = Scene(scene.nodes, scene.transmitters, (*scene.receivers, other))
        results.append(simulate(scene, f, Quality(depth=1, diffraction=0, floor_db=-300.0)))
    slab, solid = (r.channel for r in results)
    assert len(slab.delay) == len(solid.delay) == 3
    torch.testing.assert_close(solid.delay, slab.delay, rtol=1e-13, atol=0)
    size = slab.jones.abs().amax((2, 3), keepdim=True)
    # 2 pi f d n / c is up to 500 rad, each known to 1e-16 of itself and the cosine that it came with
    assert float(((solid.jones - slab.jones).abs() / size).max()) < 1e-12 * max(1.0, f / 2.4e9)


@pytest.mark.parametrize("f", [2.4e9, 5.8e9, 28e9])
@pytest.mark.parametrize("angle", [0.0, 40.0, 65.0])
def test_wall_against_the_field_of_a_point_source(angle, f):
    """A wall's plane-wave T is the first term of a point source's field. What it leaves out is the
    second, of order 1 / (k r) times T's curvature (some d / r): with it, the integral is met."""
    d, half_way = 0.1, 6.0
    rho, height, r = seen_at(angle, half_way)
    assert abs(sommerfeld(f, 0.0, rho, height) - 1.0) < 1e-9  # the quadrature's own error
    exact = sommerfeld(f, d, rho, height)
    second = second_term(math.radians(angle), f, d, r)
    for make in WALLS.values():
        found = through(make(d), angle, f, d, half_way)
        assert abs(found - exact) < 1.1 * abs(second)
        assert abs(found + second - exact) < 2.0 * abs(second) ** 2 / abs(exact) + 1e-6


def test_no_reflection_at_brewsters_angle():
    """Off a wall and off the ground at tan(theta) = n the wave polarised within the plane of
    incidence is not reflected (Born and Wolf, section 1.5.3); the other is, by the textbook's share."""
    n = 2.0
    for shape, tx, rx in (
        (Box([0.1, 9.0, 9.0]), (-2.1, -4.0, 0.0), (-2.1, 4.0, 0.0)),
        (HalfSpace(), (-4.0, 0.0, 2.0), (4.0, 0.0, 2.0)),
    ):
        node = Node("/s", Body(shape, Solid(eps_r=n * n)), Pose.identity())
        radios = tuple(radio(p, *x, polarization="V") for p, x in (("/t", tx), ("/r", rx)))
        quality = Quality(depth=1, diffraction=0, floor_db=-600.0)
        channel = simulate(Scene((node,), radios[:1], radios[1:]), 2.4e9, quality).channel
        jones = (channel.jones[:, 0].abs() * channel.delay[:, None, None] * C).amax((1, 2))
        both = torch.linalg.svdvals(channel.jones[1, 0])
        assert float(both[1] / jones[0]) < 1e-12
        if shape.kind == "halfspace":
            angle = math.atan(n)
            te = abs(math.cos(2 * angle))  # (n cos i - cos r)/(...) with i + r = 90 degrees
            found = both[0] * channel.delay[1] * C * 4 * math.pi / (C / 2.4e9)
            assert float(found) == pytest.approx(te, rel=1e-9)


# prisms and balls, against rays traced by hand


def traced(tx, direction, n, faces):
    """Points and directions of a ray through two faces: (where it meets one, its outward normal)."""
    points, d, ratio = [np.array(tx, float)], np.array(direction, float), 1.0 / n
    for meet, outward in faces:
        x = meet(points[-1], d)
        normal = outward(x)
        normal = normal if d @ normal < 0 else -normal
        cosine = -d @ normal
        d = ratio * d + (ratio * cosine - math.sqrt(1 - ratio**2 * (1 - cosine**2))) * normal
        points.append(x)
        ratio = n
    return points, d


def ball(radius):
    def meet(o, d):
        half = math.sqrt((o @ d) ** 2 - o @ o + radius**2)
        near = -(o @ d) - half
        return o + (near if near > 1e-9 else near + 2 * half) * d

    return [(meet, lambda x: x / radius)] * 2


def wedge(size):
    """The upper two faces of a box of half size ``size``, standing on its edge along z."""
    faces = []
    for side in (-1.0, 1.0):
        normal = np.array([side, 1.0, 0.0]) / math.sqrt(2)
        faces.append(
            (
                lambda o, d, n=normal: o + (size - o @ n) / (d @ n) * d,
                lambda x, n=normal: n,
            )
        )
    return faces


def numerical_spreading(tx, direction, n, faces, distance):
    """sqrt(dOmega / dA): how far rays a little apart at the transmitter land from each other."""
    points, out = traced(tx, direction, n, faces)
    rx = points[-1] + distance * out

    def frame(v):
        a = np.cross(v, [0.3, -0.5, 0.8])
        a /= np.linalg.norm(a)
        return np.array([a, np.cross(v, a)])

    h, across, columns = 1e-6, frame(out), []
    for axis in frame(np.array(direction)):
        landed = []
        for sign in (h, -h):
            d = np.array(direction) + sign * axis
            last, u = traced(tx, d / np.linalg.norm(d), n, faces)
            landed.append(last[-1] + ((rx - last[-1]) @ out) / (u @ out) * u)
        columns.append(across @ (landed[0] - landed[1]) / (2 * h))
    return 1.0 / math.sqrt(abs(np.linalg.det(np.array(columns))))


def face_power(cosine, n):
    """Mean power transmittance of TE and TM at the cosine outside (Born and Wolf, 1.5.2)."""
    inner = math.sqrt(1 - (1 - cosine**2) / n**2)
    te = ((cosine - n * inner) / (cosine + n * inner)) ** 2
    tm = ((n * cosine - inner) / (n * cosine + inner)) ** 2
    return 1 - 0.5 * (te + tm)


def check_path(node, tx, direction, n, faces, distance, f=5e9):
    """The path through the points of a ray traced by hand: its vertices, delay, amplitude."""
    points, out = traced(tx, direction, n, faces)
    rx = points[-1] + distance * out
    scene = Scene((node,), (radio("/t", *tx),), (radio("/r", *rx),))
    result = simulate(scene, f, DIRECT)
    inner = result.paths.vertices[:, 1:3].numpy()
    gap = np.abs(inner - np.array(points[1:])).max((1, 2))
    k = int(gap.argmin())
    assert gap[k] < 1e-9
    lengths = [np.linalg.norm(b - a) for a, b in zip(points, [*points[1:], rx], strict=True)]
    optical = lengths[0] + n * lengths[1] + lengths[2]
    assert float(result.channel.delay[k]) == pytest.approx(optical / C, rel=1e-12)
    spread = numerical_spreading(tx, direction, n, faces, distance)
    assert float(result.paths.spread[k]) == pytest.approx(spread, rel=1e-6)
    power = 1.0
    for (_, outward), x, d in zip(faces, points[1:], (np.array(direction), out), strict=True):
        power *= face_power(abs(d @ outward(x)), n)
    expected = C / f / (4 * math.pi) * spread * math.sqrt(power)
    assert float(result.channel.gain[k, 0].abs()) == pytest.approx(expected, rel=1e-6)
    return result, k


def prism(n, size=1.0):
    return Node("/p", Body(Box([size, size, 2.0]), Solid(eps_r=n * n)), Pose.at(0, 0, 0, 45.0))


def least_deviation(n, level=0.8, size=1.0, away=1.5):
    """(tx, direction, rx) of a ray that crosses a right-angled prism level: it deviates by
    2 arcsin(n sin 45) - 90 degrees, the least (Born and Wolf, section 4.7.2)."""
    turn = math.asin(n * math.sin(math.pi / 4)) - math.pi / 4
    side = size * math.sqrt(2) - level
    d = np.array([math.cos(turn), math.sin(turn), 0.0])
    tx = np.array([-side, level, 0.0]) - away * d
    return tx, d, tx * [-1, 1, 1]


def test_prism_deviates_by_snells_law():
    n = 1.3
    tx, d, rx = least_deviation(n)
    result, k = check_path(prism(n), tx, d, n, wedge(1.0), 1.5)
    assert len(result.paths.tx) == 1
    np.testing.assert_allclose(result.scene.receivers[0].position.numpy(), rx, atol=1e-12)
    bent = -(result.channel.departure[k] @ result.channel.arrival[k])
    deviation = 2 * math.asin(n * math.sin(math.pi / 4)) - math.pi / 2
    assert math.acos(float(bent)) == pytest.approx(deviation, rel=1e-9)


def test_prism_passes_each_polarisation_by_its_own_share():
    """Level through a prism on edge: V is TE at both faces, H is TM, and nothing is exchanged."""
    n, f = 1.3, 5e9
    tx, d, rx = least_deviation(n)
    radios = tuple(radio(p, *x, polarization="V") for p, x in (("/t", tx), ("/r", rx)))
    channel = simulate(Scene((prism(n),), radios[:1], radios[1:]), f, DIRECT).channel
    cosine = abs(d @ np.array([-1.0, 1.0, 0.0])) / math.sqrt(2)
    inner = math.sqrt(1 - (1 - cosine**2) / n**2)
    te = 4 * n * cosine * inner / (cosine + n * inner) ** 2
    tm = 4 * n * cosine * inner / (n * cosine + inner) ** 2
    spread = numerical_spreading(tx, d, n, wedge(1.0), 1.5)
    free = C / f / (4 * math.pi) * spread
    jones = channel.jones[0, 0].numpy() / free
    np.testing.assert_allclose(jones, [[te, 0.0], [0.0, -tm]], rtol=1e-6, atol=1e-9)


def test_a_faint_lens_is_nearly_nothing():
    """As n goes to 1 each bent path becomes the straight one: field vectors, phase, spreading."""
    radios = (
        radio("/t", -2.0, 0.1, 0.3, polarization="V"),
        radio("/r", 1.5, 0.2, -0.2, polarization="V"),
    )
    turned = Pose.at(0, 0, 0, 30.0)
    bodies = (Sphere(0.5), Box([0.4, 0.3, 0.5]))
    free = simulate(Scene((), radios[:1], radios[1:]), 2e9, DIRECT).channel
    for shape in bodies:
        node = Node("/s", Body(shape, Solid(eps_r=1.0 + 1e-6)), turned)
        result = simulate(Scene((node,), radios[:1], radios[1:]), 2e9, DIRECT)
        assert result.status_counts["REFRACTED"] == 1  # the straight one is gone
        close = (result.channel.delay - free.delay).abs().argmin()
        size = free.jones.abs().max()
        gap = (result.channel.jones[close] - free.jones[0]).abs().max() / size
        assert float(gap) < 1e-4  # k (n - 1) L is 2e-5


@pytest.mark.parametrize("lean", [(0.3, 0.1), (0.5, -0.2), (0.35, 0.2)])
def test_prism_off_its_axis(lean):
    tx = np.array([-1.9, 0.35, 0.1])
    d = np.array([1.0, *lean])
    check_path(prism(1.3), tx, d / np.linalg.norm(d), 1.3, wedge(1.0), 1.7)


def test_total_reflection_in_a_prism():
    """Nothing passes two faces at right angles when n > sqrt 2; just below it something does (and
    something else by opposite faces, close to the corners)."""
    for n, passes in ((1.40, True), (1.43, False)):
        tx, d, rx = least_deviation(min(n, 1.41))
        scene = Scene((prism(n),), (radio("/t", *tx),), (radio("/r", *rx),))
        result = simulate(scene, 2.4e9, DIRECT)
        assert result.status_counts["REFRACTED"] == 1
        adjacent = result.paths.item[:, 0] // 2 != result.paths.item[:, 1] // 2
        assert int(adjacent.sum()) == passes


def lens_matrix(before, radius, n, after, gap=0.0, balls=1):
    """B of the ray matrix (Siegman, Lasers, section 15.1) from source to receiver, through balls."""
    way = lambda t: np.array([[1.0, t], [0.0, 1.0]])  # noqa: E731
    face = np.array([[1.0, 0.0], [-(n - 1) / radius, 1.0]])
    one = face @ way(2 * radius / n) @ face
    system = one if balls == 1 else one @ way(gap) @ one
    return float((way(after) @ system @ way(before))[0, 1])


def ball_node(path, radius, n, x=0.0, surface=None):
    return Node(path, Body(Sphere(radius), surface or Solid(eps_r=n * n)), Pose.at(x, 0, 0))


@pytest.mark.parametrize("n", [1.2, 1.9])
@pytest.mark.parametrize("after", [0.03, 0.4, 5.0])
def test_ball_lens_on_its_axis(n, after):
    """Exact there: S = 1 / |B|; delay by the optical length; each focus passed turns both planes, and
    the wave, by 90 degrees each."""
    radius, before, f = 0.5, 3.5, 10e9
    scene = Scene(
        (ball_node("/b", radius, n),),
        (radio("/t", -radius - before, 0, 0),),
        (radio("/r", radius + after, 0, 0),),
    )
    result = simulate(scene, f, DIRECT)
    vertices = result.paths.vertices[:, 1:3, 0].tolist()
    k = vertices.index(pytest.approx([-radius, radius], abs=1e-9))
    b = lens_matrix(before, radius, n, after)
    assert float(result.paths.spread[k]) == pytest.approx(1 / abs(b), rel=1e-9)
    assert int(result.paths.caustics[k]) == (0 if b > 0 else 2)
    assert float(result.channel.delay[k]) == pytest.approx(
        (before + after + 2 * n * radius) / C, rel=1e-12
    )
    t = 4 * n / (n + 1) ** 2
    expected = C / f / (4 * math.pi * abs(b)) * t * (1 if b > 0 else -1)
    assert complex(result.channel.gain[k, 0]) == pytest.approx(expected, rel=1e-9)


def test_two_balls_in_a_row():
    radius, n = 0.3, 1.4
    nodes = (ball_node("/a", radius, n), ball_node("/b", radius, n, 1.1))
    scene = Scene(nodes, (radio("/t", -2.3, 0, 0),), (radio("/r", 3.0, 0, 0),))
    result = simulate(scene, 5e9, DIRECT)
    depth = (result.paths.which >= 0).sum(1)
    k = int(torch.nonzero((depth == 4) & (result.paths.vertices[:, 1:5, 1].abs().amax(1) < 1e-9)))
    b = lens_matrix(2.0, radius, n, 3.0 - 1.4, gap=0.5, balls=2)
    assert float(result.paths.spread[k]) == pytest.approx(1 / abs(b), rel=1e-9)


@pytest.mark.parametrize("height", [0.1, 0.4, 0.48])
@pytest.mark.parametrize("distance", [0.2, 8.0])
def test_ball_off_its_axis(height, distance):
    """Skew rays, before and behind their foci, up to nearly grazing."""
    tx, radius, n = np.array([-3.0, 0.2, -0.1]), 0.5, 1.5
    d = np.array([0.0, 0.6 * height, 0.8 * height]) - tx
    result, k = check_path(
        ball_node("/b", radius, n), tx, d / np.linalg.norm(d), n, ball(radius), distance
    )
    assert int(result.paths.caustics[k]) in (0, 1, 2)


def test_ball_passes_no_more_than_falls_on_it():
    """From far away: power through a sphere of receivers is the integral of T(h)^2 over the ball's
    disc, T the power share of one face; and less than falls on the disc."""
    n, radius, far, f = 1.5, 0.5, 5000.0, 10e9
    most = math.pi - 2 * math.asin(1 / n)
    x, w = np.polynomial.legendre.leggauss(24)
    angle, weight = (x + 1) * most / 2, w * most / 2
    rx = tuple(
        radio(f"/r{i}", far * math.cos(a), far * math.sin(a), 0.0) for i, a in enumerate(angle)
    )
    scene = Scene((ball_node("/b", radius, n),), (radio("/t", -far, 0, 0),), rx)
    result = simulate(scene, f, DIRECT)
    bent = (result.paths.which >= 0).any(1)
    assert bent.sum() == len(angle)
    power = torch.zeros(len(angle), dtype=torch.float64)
    power[result.paths.rx[bent]] = result.channel.gain[bent, 0].abs() ** 2
    density = power.numpy() * (4 * math.pi * f / C) ** 2  # per 1 / (4 pi), as 1/r^2 is
    passed = np.sum(weight * 2 * math.pi * np.sin(angle) * density) * far**2
    falling = math.pi * radius**2 / far**2
    # h = R sin i, deviation 2 (i - r): one ray for each deviation
    h = [brentq(lambda s, a=a: 2 * (math.asin(s) - math.asin(s / n)) - a, 0.0, 1.0) for a in angle]
    slope = [2 / math.sqrt(1 - s * s) - 2 / math.sqrt(n * n - s * s) for s in h]
    share = [face_power(math.sqrt(1 - s * s), n) ** 2 for s in h]
    expected = np.sum(weight * 2 * math.pi * np.array(h) * share / slope) * radius**2 / far**2
    assert passed == pytest.approx(expected, rel=2e-3)  # the far, but not infinitely far radios
    assert passed < falling


def test_mirrored_behind_a_ball():
    """Through a ball and off a metal floor: the path to the receiver's image without the floor, both
    mirrors of which turn the sign."""
    n, radius = 1.5, 0.5
    floor = Node("/f", Body(HalfSpace(), Conductor()), Pose.at(0, 0, -1.5))
    tx, rx, image = (-3.0, 0.1, 1.6), (3.5, 0.2, -0.6), (3.5, 0.2, -2.4)
    alone = ball_node("/b", radius, n)
    want = simulate(Scene((alone,), (radio("/t", *tx),), (radio("/r", *image),)), 5e9, DIRECT)
    quality = Quality(depth=1, diffraction=0, floor_db=-300.0)
    scene = Scene((alone, floor), (radio("/t", *tx),), (radio("/r", *rx),))
    found = simulate(scene, 5e9, quality)
    mine = (found.paths.which == 0).any(1) & (found.paths.which == 1).any(1)
    mine &= (found.paths.which >= 0).sum(1) == 3
    through = (want.paths.which >= 0).any(1)
    assert int(through.sum()) >= 1
    for k in torch.nonzero(through).flatten().tolist():
        gap = (found.channel.delay - want.channel.delay[k]).abs() + (~mine).double()
        j = int(gap.argmin())
        assert float(gap[j]) < 1e-17
        expected = -complex(want.channel.gain[k, 0])
        assert complex(found.channel.gain[j, 0]) == pytest.approx(expected, rel=1e-9)


# radios inside


def test_two_radios_in_one_solid_see_its_own_friis():
    """gain = lambda_n / (4 pi d): wavelength, phase and delay are the medium's."""
    n, f = 1.7, 3e9
    scene = Scene(
        (ball_node("/b", 5.0, n),), (radio("/t", -1.0, 0.3, 0),), (radio("/r", 1.5, 0.3, 0.2),)
    )
    result = simulate(scene, f, DIRECT)
    d = math.hypot(2.5, 0.2)
    assert float(result.channel.gain[0, 0].abs()) == pytest.approx(
        C / f / n / (4 * math.pi * d), rel=1e-12
    )
    assert float(result.channel.delay[0]) == pytest.approx(n * d / C, rel=1e-12)


@pytest.mark.parametrize("swap", [False, True])
def test_one_radio_in_a_solid(swap):
    """Across its face: S = 1 / (a + n b), a inside and b outside (an image at a / n behind the face,
    and an antenna matched to its medium)."""
    n, a, b, f = 1.6, 0.7, 2.2, 3e9
    node = box_node("/w", (-2.0, 0.0, 0.0), (2.0, 30.0, 30.0), Solid(eps_r=n * n))
    ends = (radio("/in", -a, 0.2, 0.1), radio("/out", b, 0.2, 0.1))
    ends = ends[::-1] if swap else ends
    result = simulate(Scene((node,), ends[:1], ends[1:]), f, DIRECT)
    assert len(result.paths.tx) == 1
    expected = C / f / (4 * math.pi * (a + n * b)) * math.sqrt(4 * n) / (n + 1)
    assert float(result.channel.gain[0, 0].abs()) == pytest.approx(expected, rel=1e-9)
    assert float(result.channel.delay[0]) == pytest.approx((n * a + b) / C, rel=1e-12)
