"""What a wave sees of a learned face, against exact surfaces and a physical-optics integral."""

import math

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer import zone
from rfsg.tracer.channel import coefficients
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import radio, vector
from tests.tracer.shapes import Field, ball, rippled
from tests.truths.plates import PLACES, with_ripple


def _measure(shape, centre, normal, radius, wavelength, pose=None):
    world = World(Scene((Node("/a", Body(shape, Conductor()), pose or Pose.identity()),)))
    which = torch.zeros(1, dtype=torch.int64)
    reach = torch.tensor([radius], dtype=torch.float64)
    return zone.measure(world, which, centre[None], normal[None], reach, wavelength, 3)


def test_a_plane_comes_out_a_plane():
    plate = Field(rippled(0.0, 1.0), [2.0, 2.0, 0.3])
    found = _measure(plate, vector(0.3, 0.2, 0.004), vector(0, 0, 1.0), 0.4, 0.12)
    jet = found.jet(vector(0.35, 0.1, 0.05)[None])
    assert float(jet.value) == pytest.approx(0.05, abs=1e-12)
    torch.testing.assert_close(jet.gradient[0], vector(0, 0, 1.0), atol=1e-12, rtol=0)
    assert float(jet.hessian.abs().max()) < 1e-10
    assert float(found.weight) == pytest.approx(1.0, abs=1e-3)  # it stands 4 mm off the face


def test_a_large_ball_keeps_its_curvature():
    radius = 2.0
    found = _measure(
        Field(ball(radius), [2.1] * 3), vector(0, 0, radius), vector(0, 0, 1.0), 0.1, 0.12
    )
    # the fit's fourth-order remainder on a sphere is of the order of (zone / radius)^2
    assert float(found.curvature()) == pytest.approx(1 / radius, rel=2 * (0.1 / radius) ** 2)
    assert abs(float(found.offset)) < 1e-6


def test_a_ripple_smaller_than_the_wave_is_not_believed():
    """0.5 mm at 20 cm: a curvature of 0.49 per metre to a ray, a flat plate to a 12.5 cm wave."""
    plate = Field(rippled(5e-4, 0.2), [2.0, 2.0, 0.3])
    found = _measure(plate, vector(0.05, 0.0, 5e-4), vector(0, 0, 1.0), 0.4, 0.125)
    assert float(found.curvature()) < 0.02
    assert float(found.slope.abs().max()) < 2e-3
    assert bool(found.resolved(0.125))


def test_relief_survives():
    """A wave of 6 cm on 2 m is relief, not ripple: its crest keeps its curvature."""
    plate = Field(rippled(0.06, 2.0), [2.0, 2.0, 0.3], lipschitz=1.2)
    crest = 0.06 * (2 * math.pi / 2.0) ** 2
    one = torch.ones(1, dtype=torch.float64)
    zone_radius = float(zone.zone_radius(2 * one, 2 * one, one, crest * one, 0.01))
    found = _measure(plate, vector(0.5, 0.0, 0.06), vector(0, 0, 1.0), zone_radius, 0.01)
    assert float(found.curvature()) == pytest.approx(crest, rel=0.2)


def test_the_answer_moves_with_the_object():
    plate = Field(rippled(5e-4, 0.2), [2.0, 2.0, 0.3])
    pose = Pose.at(1e5, -3e4, 12.0, 33.0)
    here = _measure(plate, vector(0.05, 0.1, 5e-4), vector(0, 0, 1.0), 0.4, 0.125)
    there = _measure(
        plate, pose.point_world(vector(0.05, 0.1, 5e-4)), vector(0, 0, 1.0), 0.4, 0.125, pose
    )
    torch.testing.assert_close(here.bend, there.bend, atol=1e-7, rtol=0)
    torch.testing.assert_close(here.offset, there.offset, atol=1e-9, rtol=0)


@pytest.mark.parametrize("frequency", [2.4e9, 28e9, 140e9])
def test_rippled_plate_reflects_as_physical_optics_says(frequency):
    """A ripple of 20 cm on a metal plate, 0.5 mm high at 2.4 GHz, where it is not seen, and 0.2 mm and
    0.05 mm at 28 and 140 GHz, where it bends the wave: one path per mirror, its power within half a
    decibel in the mean over receivers."""
    found = with_ripple(frequency)
    assert found.mirrors == (list(range(len(PLACES))),)
    assert abs(found.errors.mean()) < 0.5
    assert np.abs(found.errors).max() < (0.6 if frequency < 1e10 else 1.5)


def test_learned_ball_reflects_as_the_exact_one():
    tx, rx = radio("/t", 4.0, 0.3, 0.2), radio("/r", 1.0, 3.5, -0.4)
    gains = []
    for shape in (Field(ball(1.0), [1.05] * 3), Sphere(1.0)):
        scene = Scene((Node("/s", Body(shape, Conductor()), Pose.at(0.1, -0.1, 0)),), (tx,), (rx,))
        result = simulate(scene, 10e9, Quality(depth=1, rays=4000))
        reflected = (result.paths.which >= 0).any(1)
        assert int(reflected.sum()) == 1
        gains.append(coefficients(result.channel)[reflected, 0][0])
    assert abs(20 * math.log10(float(gains[0].abs() / gains[1].abs()))) < 0.1
    assert abs(float(torch.angle(gains[0] / gains[1]))) < 0.1


def test_reciprocity_on_learned_faces():
    """Swapping the ends changes no path gain: the zone is measured where the path rests, not where
    the search came from."""
    plate = Node(
        "/p", Body(Field(rippled(5e-4, 0.2), [1.5, 1.5, 0.2]), Conductor()), Pose.at(0, 0, 0, 20.0)
    )
    ends = (radio("/a", -0.8, 0.1, 1.7), radio("/b", 0.7, -0.2, 1.1))
    gains = []
    for tx, rx in (ends, ends[::-1]):
        result = simulate(Scene((plate,), (tx,), (rx,)), 2.4e9, Quality(depth=1, rays=4000))
        gains.append(result.transfer()[0, 0, 0])
    assert abs(complex(gains[0] - gains[1])) <= 1e-6 * abs(complex(gains[0]))
