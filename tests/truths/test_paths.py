"""Path amplitudes and phases against closed forms."""

import itertools
import math

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.channel import coefficients, power
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import ROOM, box_node, radio, room, vector

C = 299_792_458.0
EPS0 = 8.8541878128e-12  # [F/m], CODATA 2018


@pytest.mark.parametrize("distance", [1e-3, 0.1, 1.0, 123.456, 1e4, 1e5])
@pytest.mark.parametrize("frequency", [1e8, 2.44e9, 28e9, 300e9])
def test_friis(distance, frequency):
    """Friis (1946): h = lambda / (4 pi d) exp(-j k d), relative error 1e-9 in amplitude and phase."""
    scene = Scene((), (radio("/t", 0.1, 0.2, 0.3),), (radio("/r", 0.1 + distance, 0.2, 0.3),))
    h = complex(simulate(scene, frequency).transfer()[0, 0, 0])
    d = (0.1 + distance) - 0.1  # the separation that float64 coordinates really hold
    turns = frequency * d / C
    expected = C / frequency / (4 * math.pi * d) * np.exp(-2j * math.pi * (turns % 1.0))
    assert abs(h - expected) <= 1e-9 * abs(expected)


def _scalar(te, tm):
    """The documented scalar coefficient: mean power of the two, phase of TE."""
    return np.sqrt((abs(te) ** 2 + abs(tm) ** 2) / 2) * te / abs(te)


def _fresnel(cosine, eps):
    """Textbook Fresnel coefficients (Balanis 2012, section 5.3.1), TM by the magnetic field's sign."""
    root = np.sqrt(eps - (1 - cosine**2) + 0j)
    te = (cosine - root) / (cosine + root)
    tm = (eps * cosine - root) / (eps * cosine + root)
    return te, -tm  # the contract's TM reference: equal to TE at normal incidence


@pytest.mark.parametrize("distance", [1.0, 17.0, 300.0, 5000.0])
def test_two_ray_ground(distance):
    eps = 5.0 - 1j * 0.01 / (2 * math.pi * 1e9 * EPS0)
    ground = Node(
        "/ground", Body(HalfSpace(), DielectricHalfSpace(eps_r=5.0, sigma=0.01)), Pose.identity()
    )
    tx, rx = (0.0, 0.0, 10.0), (distance, 0.0, 1.5)
    result = simulate(Scene((ground,), (radio("/t", *tx),), (radio("/r", *rx),)), 1e9)
    direct, bounced = math.hypot(distance, 8.5), math.hypot(distance, 11.5)
    te, tm = _fresnel(11.5 / bounced, eps)
    expected = [1 / direct, _scalar(te, tm) / bounced]
    expected = np.array(expected) * C / 1e9 / (4 * math.pi)
    phase = np.exp(-2j * np.pi * (1e9 / C * np.array([direct, bounced]) % 1.0))
    found = coefficients(result.channel)[:, 0].numpy()
    assert len(found) == 2
    np.testing.assert_allclose(found, expected * phase, rtol=1e-6)


@pytest.mark.parametrize("polarization", ["V", "H"])
def test_two_ray_polarised(polarization):
    """Over flat ground a vertical antenna pair sees the TM coefficient, a horizontal pair TE."""
    ground = Node(
        "/ground", Body(HalfSpace(), DielectricHalfSpace(eps_r=4.0, sigma=0.0)), Pose.identity()
    )
    tx = radio("/t", 0.0, 0.0, 2.0, polarization=polarization)
    rx = radio("/r", 30.0, 0.0, 3.0, polarization=polarization)
    result = simulate(Scene((ground,), (tx,), (rx,)), 1e9)
    bounced = math.hypot(30.0, 5.0)
    te, tm = _fresnel(5.0 / bounced, 4.0)
    found = result.channel.gain[:, 0].numpy() * 4 * math.pi / (C / 1e9)
    # theta-hat at departure (down) and at arrival (up) are mirror images of each other; the
    # mirrored TM reference keeps the coefficient's sign, and phi-hat of the receiver, which looks
    # back along the wave, is minus that of the transmitter
    direct = 1.0 / math.hypot(30.0, 1.0)
    sign = np.sign(found[0].real)
    expected_bounce = (tm if polarization == "V" else te) / bounced
    assert abs(found[0]) == pytest.approx(direct, rel=1e-6)
    assert found[1] * sign == pytest.approx(
        -expected_bounce if polarization == "V" else expected_bounce, rel=1e-6
    )


def _room_images(tx, rx, size, depth):
    """Allen & Berkley (1979): all images of a source in a box, by reflections on each axis."""
    paths = []
    for n in itertools.product(range(-depth, depth + 1), repeat=3):
        if sum(abs(k) for k in n) > depth:
            continue
        image = [size[a] * n[a] + (tx[a] if n[a] % 2 == 0 else size[a] - tx[a]) for a in range(3)]
        delta = np.array(rx) - np.array(image)
        paths.append((np.linalg.norm(delta), np.abs(delta) / np.linalg.norm(delta), np.abs(n)))
    return paths


def _slab_reflection(cosine, eps, thickness, frequency):
    """Scalar reflection of a single layer: characteristic matrix, Born & Wolf 1.6."""
    k0 = 2 * math.pi * frequency / C
    kz = np.sqrt(eps - (1 - cosine**2) + 0j)
    out = []
    for p0, p1 in ((cosine, kz), (cosine, kz / eps)):
        delta = k0 * thickness * kz
        m = np.array(
            [[np.cos(delta), 1j * np.sin(delta) / p1], [1j * p1 * np.sin(delta), np.cos(delta)]]
        )
        b, c = m @ np.array([1.0, p0])
        out.append((p0 * b - c) / (p0 * b + c))
    return _scalar(*out)


def test_box_room_to_depth_three():
    """63 paths per receiver (1 + 6 + 18 + 38), each amplitude to 1e-6 and each phase to 1e-6 rad."""
    scene = room()
    result = simulate(scene, 2.4e9, Quality(depth=3, floor_db=-200.0))
    found = coefficients(result.channel)[:, 0].numpy()
    eps = 5.24 - 1j * 0.05 / (2 * math.pi * 2.4e9 * EPS0)
    tx = scene.transmitters[0].position.tolist()
    for r, receiver in enumerate(scene.receivers):
        images = _room_images(tx, receiver.position.tolist(), ROOM, 3)
        expected = []
        for length, cosines, bounces in images:
            gain = C / 2.4e9 / (4 * math.pi * length)
            for axis in range(3):
                gain = gain * _slab_reflection(cosines[axis], eps, 0.2, 2.4e9) ** bounces[axis]
            expected.append((length, gain * np.exp(-2j * math.pi * (2.4e9 * length / C % 1.0))))
        mine = np.nonzero(result.channel.rx.numpy() == r)[0]
        assert len(mine) == len(expected) == 63
        lengths = result.paths.length.numpy()[mine]
        for length, value in expected:
            k = mine[np.argmin(np.abs(lengths - length))]
            assert found[k] == pytest.approx(value, rel=1e-6)


def test_sphere_divergence_factor():
    """Reflection on a metal sphere: S^2 = |divergence| of geometrical optics (Balanis 2012, 13.3)."""
    node = Node("/s", Body(Sphere(1.0), Conductor()), Pose.at(0.5, -0.25, 0.125))
    angles = np.radians(np.arange(20, 110, 7.5))
    centre = np.array([0.5, -0.25, 0.125])
    tx = centre + np.array([5.0, 0.0, 0.0])
    rxs = [centre + 6.5 * np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]
    scene = Scene(
        (node,), (radio("/t", *tx),), tuple(radio(f"/r{i}", *p) for i, p in enumerate(rxs))
    )
    result = simulate(scene, 2.4e9, "draft")
    bounced = (result.paths.which >= 0).any(1).numpy()
    assert bounced.sum() == len(angles)
    for k in np.nonzero(bounced)[0]:
        v = result.paths.vertices[k].numpy()
        x, rx = v[1], v[2]
        s1, s2 = np.linalg.norm(x - tx), np.linalg.norm(rx - x)
        n = (x - centre) / np.linalg.norm(x - centre)
        cosine = (tx - x) @ n / s1
        # Kouyoumjian & Pathak (1974) eqs. 25-27, sphere of radius 1, in the plane of incidence and
        # across it: 1/rho = 1/s1 + 2/(r cos) and 1/s1 + 2 cos / r
        rho_a = 1 / (1 / s1 + 2 / cosine)
        rho_b = 1 / (1 / s1 + 2 * cosine)
        expected = np.sqrt(rho_a * rho_b / ((rho_a + s2) * (rho_b + s2))) / s1
        assert float(result.paths.spread[k]) == pytest.approx(expected, rel=1e-6)


def test_cylinder_divergence_factor():
    """A long metal cylinder bends one plane only: rho_b = s1 across it at right angles."""
    node = Node("/c", Body(Cylinder(0.3, 10.0), Conductor()), Pose.identity())
    scene = Scene((node,), (radio("/t", 4.0, 0.5, 0.0),), (radio("/r", 1.5, 3.0, 0.0),))
    result = simulate(scene, 5e9, "draft")
    k = int(torch.nonzero((result.paths.which >= 0).any(1))[0])
    v = result.paths.vertices[k].numpy()
    s1, s2 = np.linalg.norm(v[1] - v[0]), np.linalg.norm(v[2] - v[1])
    cosine = (v[0] - v[1]) @ (v[1] / np.linalg.norm(v[1])) / s1
    rho = 1 / (1 / s1 + 2 / (0.3 * cosine))
    expected = np.sqrt(rho / (rho + s2) * s1 / (s1 + s2)) / s1
    assert float(result.paths.spread[k]) == pytest.approx(expected, rel=1e-6)


def _slab_transmission(cosine, eps, thickness, frequency):
    """(TE, TM) transmission of a single layer, face to face: characteristic matrix, Born & Wolf 1.6."""
    k0 = 2 * math.pi * frequency / C
    kz = np.sqrt(eps - (1 - cosine**2) + 0j)
    out = []
    for p0, p1 in ((cosine, kz), (cosine, kz / eps)):
        delta = k0 * thickness * kz
        b = np.cos(delta) + 1j * np.sin(delta) / p1 * p0
        c = 1j * p1 * np.sin(delta) + np.cos(delta) * p0
        out.append(2 * p0 / (p0 * b + c))
    return np.array(out)


@pytest.mark.parametrize("angle", [0.0, 30.0, 60.0])
def test_slab_transmission_and_delay(angle):
    """Through a wall: the layer's T, its phase referenced to the faces so the thickness counts once."""
    frequency, thickness = 2.4e9, 0.1
    wall = Slab(thickness, eps_r=5.24, sigma=0.05)
    node = box_node("/wall", (0, 0, 0), (thickness / 2, 50.0, 50.0), wall)
    far = 3.0 * math.tan(math.radians(angle))
    scene = Scene((node,), (radio("/t", -3.0, -far, 0.0),), (radio("/r", 3.0, far, 0.0),))
    result = simulate(scene, frequency, Quality(depth=0))
    cosine, length = math.cos(math.radians(angle)), 6.0 / math.cos(math.radians(angle))

    def crossing(f):
        eps = 5.24 - 1j * 0.05 / (2 * math.pi * f * EPS0)
        t = _scalar(*_slab_transmission(cosine, eps, thickness, f))
        return t * np.exp(2j * math.pi * f / C * thickness * cosine)

    free = np.exp(-2j * math.pi * (frequency * length / C % 1.0))
    expected = crossing(frequency) * free * C / frequency / (4 * math.pi * length)
    assert complex(result.transfer()[0, 0, 0]) == pytest.approx(expected, rel=1e-6)
    h = 1e4  # [Hz]
    group = -(np.angle(crossing(frequency + h) / crossing(frequency - h))) / (4 * math.pi * h)
    assert float(result.channel.delay[0]) - length / C == pytest.approx(group, rel=1e-4, abs=1e-15)


def test_powers_of_both_estimators_agree():
    """The paper's Monte Carlo and the path solver converge to the same power, within its error."""
    from rfsg.tracer.montecarlo import estimate_power

    scene = room()
    quality = Quality(depth=1, rays=5_000, map_rays=24_000, floor_db=-200.0)
    exact = power(simulate(scene, 2.4e9, quality).channel, 1, 4)[..., 0]
    for branching in ("enumerate", "draw"):
        estimate, error = estimate_power(scene, 2.4e9, quality, radius=0.2, branching=branching)
        assert bool((error < 0.2 * exact).all())  # enough rays for the comparison to mean something
        # four standard errors, and the mean of 1/r^2 over a 0.2 m sphere about the centre
        assert bool(((estimate - exact).abs() < 4 * error + 0.02 * exact).all())


def test_polarised_waves_through_a_ball_do_not_know_the_axes():
    """A chord through a thin-walled ball, off its centre: turning everything changes nothing, and the
    co-polar wave lies between what TE and TM alone would keep."""
    gains = []
    for turn in (0.0, 33.0):
        pose = Pose.at(0.0, 0.0, 0.0, turn)
        rotation = pose.rotation @ _about_x(turn)
        pose = Pose(rotation, pose.translation, pose.scale)
        ball = Node("/s", Body(Sphere(1.0), Slab(0.02, eps_r=6.0, sigma=0.02)), pose)
        tx, rx = (
            Radio(p, rotation @ vector(*x), rotation, vector(0, 0, 0), polarization=q)
            for p, x, q in (("/t", (-4.0, 0.5, 0.4), "+45"), ("/r", (4.0, 0.5, 0.4), "V"))
        )
        result = simulate(Scene((ball,), (tx,), (rx,)), 2.4e9, Quality(depth=0))
        gains.append(complex(result.transfer()[0, 0, 0]))
    assert abs(gains[0] - gains[1]) <= 1e-12 * abs(gains[0]) > 0


def _about_x(degrees: float):
    a = math.radians(degrees)
    c, s = math.cos(a), math.sin(a)
    return torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64)
