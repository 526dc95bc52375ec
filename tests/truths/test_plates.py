"""Trained and rippled metal plates against physical optics at 2.4, 28 and 140 GHz: one path per
mirror, within half a decibel in the mean."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.channel import coefficients
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, radio

ASSETS = Path(__file__).resolve().parents[2] / "assets"
C = 299_792_458.0
FACE = 0.225  # [m] the cabinet's broad face is x = 0.225, |y| < 0.45, 0.06 < z < 1.40
TX = (1.15, -0.21, 0.86)
RECEIVERS = [(1.0 + 0.05 * k, 0.2 - 0.03 * k, 0.56 + 0.04 * k) for k in range(5)]
# half-width of the patch that is summed, and its step, fine against the wave over that patch
PATCHES = {2.4e9: (0.42, 6e-3), 28e9: (0.35, 1.6e-3), 140e9: (0.18, 7e-4)}


def _heights(shape, y, z):
    """x of the trained face at (y, z): one Newton step from the plane, which is near enough."""
    flat = [torch.from_numpy(a.reshape(-1)).float() for a in (y, z)]
    x = torch.full_like(flat[0], FACE)
    points = torch.stack([x, *flat], -1)
    parts = []
    for some in points.split(65536):
        value, gradient = shape.value_and_gradient(some)
        parts.append((some[:, 0] - value / gradient[:, 0]).detach().double())
    return torch.cat(parts).numpy().reshape(y.shape)


def _physical_optics(x, y, z, tx, rx, k, window):
    """Kirchhoff integral of a nearly flat metal face (Balanis 2012, section 7.9), up to a constant."""
    d1 = np.sqrt((tx[0] - x) ** 2 + (tx[1] - y) ** 2 + (tx[2] - z) ** 2)
    d2 = np.sqrt((rx[0] - x) ** 2 + (rx[1] - y) ** 2 + (rx[2] - z) ** 2)
    slope = (tx[0] - x) / d1 + (rx[0] - x) / d2
    return (window * slope * np.exp(-1j * k * (d1 + d2)) / (d1 * d2)).sum()


@pytest.mark.parametrize("frequency", PATCHES)
def test_a_trained_face_reflects_as_physical_optics_says(frequency):
    """What training left of error changes the reflection by what it changes the integral by."""
    cabinet = load_asset(ASSETS / "objects" / "cabinet" / "cabinet.usda").body.shape
    k, (half, step) = 2 * math.pi * frequency / C, PATCHES[frequency]
    tx, rx = radio("/t", *TX), [radio(f"/r{i}", *p) for i, p in enumerate(RECEIVERS)]
    found = {}
    for name, node in (
        ("trained", Node("/c", Body(cabinet, Conductor()), Pose.identity())),
        ("flat", box_node("/c", (0, 0, 0.73), (FACE, 0.45, 0.67), Conductor())),
    ):
        result = simulate(Scene((node,), (tx,), tuple(rx)), frequency, Quality(depth=1))
        bounced = torch.nonzero((result.paths.which >= 0).any(1)).squeeze(-1)
        assert result.paths.rx[bounced].tolist() == list(range(len(rx)))  # one path per mirror
        found[name] = coefficients(result.channel)[bounced, 0].numpy()
    errors = []
    for i, place in enumerate(RECEIVERS):
        # the patch about the mirror point of the flat face
        share = (TX[0] - FACE) / (TX[0] + place[0] - 2 * FACE)
        centre = [TX[a] + share * (place[a] - TX[a]) for a in (1, 2)]
        side = np.arange(-half, half + step / 2, step)
        y, z = np.meshgrid(centre[0] + side, centre[1] + side, indexing="ij")
        taper = np.cos(0.5 * np.pi * np.clip(side / half, -1, 1)) ** 2
        window = taper[:, None] * taper[None]
        inside = (np.abs(y) < 0.44) & (np.abs(z - 0.73) < 0.66)
        args = (TX, place, k, window * inside)
        truth = _physical_optics(_heights(cabinet, y, z), y, z, *args)
        truth = truth / _physical_optics(np.full_like(y, FACE), y, z, *args)
        errors.append(20 * math.log10(abs(found["trained"][i] / found["flat"][i] / truth)))
    assert abs(np.mean(errors)) < 0.5
    assert np.mean(np.abs(errors)) < 0.5
