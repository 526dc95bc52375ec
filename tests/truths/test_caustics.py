"""Phase of a wave that has passed a focus: the Morse index against a physical-optics integral."""

import math

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.channel import coefficients
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import radio
from tests.tracer.shapes import Field

F = 28e9
K = 2 * math.pi * F / 299_792_458.0


def trough(radius_x: float, radius_y: float):
    """A dish z = x^2/(2 radius_x) + y^2/(2 radius_y), as a distance to first order."""

    def f(p):
        x, y, z = p.unbind(-1)
        slope = torch.sqrt(1 + (x / radius_x) ** 2 + (y / radius_y) ** 2)
        top = (z - x**2 / (2 * radius_x) - y**2 / (2 * radius_y)) / slope
        return torch.maximum(top, -(z + 0.15))

    return f


def _physical_optics(radius_x, radius_y, tx, rx, half):
    """Kirchhoff integral over a metal dish (Balanis 2012, section 7.9), scalar, a smooth window at
    the rim so that the edge sends nothing: h of the reflected wave."""
    n = 1401
    x = np.linspace(-half, half, n)
    gx, gy = np.meshgrid(x, x, indexing="ij")
    z = gx**2 / (2 * radius_x) + gy**2 / (2 * radius_y)
    window = (np.cos(np.pi * gx / (2 * half)) * np.cos(np.pi * gy / (2 * half))) ** 2
    normal = np.stack([-gx / radius_x, -gy / radius_y, np.ones_like(gx)], -1)  # times dx dy: area
    r1 = np.stack([tx[0] - gx, tx[1] - gy, tx[2] - z], -1)
    r2 = np.stack([rx[0] - gx, rx[1] - gy, rx[2] - z], -1)
    d1, d2 = np.linalg.norm(r1, axis=-1), np.linalg.norm(r2, axis=-1)
    slope = (normal * r1).sum(-1) / d1 + (normal * r2).sum(-1) / d2
    integrand = window * slope * np.exp(-1j * K * (d1 + d2)) / (d1 * d2)
    area = (x[1] - x[0]) ** 2
    # R = -1 of a conductor; j k / 4 pi of Kirchhoff's formula; lambda / 4 pi of the antennas
    return -1j * K / (4 * np.pi) * integrand.sum() * area / (2 * K)


@pytest.mark.parametrize(
    "radius_x, radius_y, passed", [(6.0, 6.0, 0), (0.55, 6.0, 1), (0.55, 0.6, 2)]
)
def test_phase_and_amplitude_behind_a_focus(radius_x, radius_y, passed):
    """Radios 1 m above a metal dish: focal lengths of 3 m (no focus between) and of about 0.28 m
    (one line focus for each direction of bending)."""
    tx, rx = (-0.15, 0.02, 1.0), (0.12, -0.03, 1.1)
    dish = Node(
        "/d", Body(Field(trough(radius_x, radius_y), [0.3, 0.3, 0.2]), Conductor()), Pose.identity()
    )
    scene = Scene((dish,), (radio("/t", *tx),), (radio("/r", *rx),))
    result = simulate(scene, F, Quality(depth=1, rays=4000))
    reflected = torch.nonzero((result.paths.which >= 0).any(1)).squeeze(-1)
    assert len(reflected) == 1
    assert int(result.paths.caustics[reflected]) == passed
    found = complex(coefficients(result.channel)[reflected, 0])
    truth = complex(_physical_optics(radius_x, radius_y, tx, rx, 0.29))
    assert abs(20 * math.log10(abs(found / truth))) < 0.5
    assert abs(math.degrees(np.angle(found / truth))) < 10.0
