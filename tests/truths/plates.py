"""Trained and rippled metal plates: the tracer's reflection against physical optics."""

import math
from dataclasses import dataclass

import numpy as np
import torch

from rfsg.objects.body import Body
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.channel import coefficients
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests import shipped
from tests.scenes import box_node, radio
from tests.tracer.shapes import Field, rippled

C = 299_792_458.0


@dataclass(frozen=True)
class Compared:
    """mirrors: which receiver each reflected path leads to, for every plate traced; one path per mirror
    is 0, 1, 2 and so on. errors: the tracer over physical optics, for each receiver [dB]."""

    mirrors: tuple[list[int], ...]
    errors: np.ndarray


def _reflected(node, tx, places, frequency, quality):
    """(receivers, coefficients) of the reflected paths."""
    rx = tuple(radio(f"/r{i}", *p) for i, p in enumerate(places))
    result = simulate(Scene((node,), (radio("/t", *tx),), rx), frequency, quality)
    bounced = torch.nonzero((result.paths.which >= 0).any(1)).squeeze(-1)
    return result.paths.rx[bounced].tolist(), coefficients(result.channel)[bounced, 0].numpy()


# the cabinet's broad face

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


def trained(frequency) -> Compared:
    """The cabinet's face over a flat one: by the tracer, and by the integral over either."""
    cabinet = shipped.shape("cabinet")
    k, (half, step) = 2 * math.pi * frequency / C, PATCHES[frequency]
    mirrors, found = zip(
        *(
            _reflected(node, TX, RECEIVERS, frequency, Quality(depth=1))
            for node in (
                Node("/c", Body(cabinet, Conductor()), Pose.identity()),
                box_node("/c", (0, 0, 0.73), (FACE, 0.45, 0.67), Conductor()),
            )
        ),
        strict=True,
    )
    truths = []
    for place in RECEIVERS:
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
        truths.append(truth / _physical_optics(np.full_like(y, FACE), y, z, *args))
    return Compared(mirrors, 20 * np.log10(np.abs(found[0] / found[1] / np.array(truths))))


# a plate with a ripple of 20 cm

PERIOD, HALF = 0.2, 5.0  # [m]
AMPLITUDES = {2.4e9: 5e-4, 28e9: 2e-4, 140e9: 5e-5}  # [m]
ABOVE = (-1.0, 0.0, 2.0)
PLACES = [(0.6 + 0.07 * k, 0.0, 1.5 + 0.05 * k) for k in range(8)]


def _physical_optics_in_plane(amplitude, tx, rx, wavelength):
    """Kirchhoff integral of a metal plate's reflection in the plane of incidence (Balanis 2012,
    section 7.9): scalar, stationary phase across, so one dimension along the ripple is summed."""
    k = 2 * np.pi / wavelength
    x = np.linspace(-HALF, HALF, 400_001)
    z = amplitude * np.sin(2 * np.pi * x / PERIOD)
    r1 = np.hypot(x - tx[0], z - tx[2])
    r2 = np.hypot(x - rx[0], z - rx[2])
    # across the ripple the zone is that of a straight line: exact stationary phase in y
    across = np.sqrt(2 * np.pi / k * r1 * r2 / (r1 + r2)) * np.exp(-1j * np.pi / 4)
    slope = (tx[2] - z) / r1 + (rx[2] - z) / r2
    integrand = slope * np.exp(-1j * k * (r1 + r2)) / (r1 * r2) * across
    return np.trapezoid(integrand, x) * k / (4 * np.pi) * wavelength / (4 * np.pi)


def with_ripple(frequency) -> Compared:
    """The rippled plate: the tracer's |h| over the integral's."""
    amplitude = AMPLITUDES[frequency]
    shape = Field(rippled(amplitude, PERIOD), [HALF, HALF, 0.2])
    plate = Node("/p", Body(shape, Conductor()), Pose.identity())
    mirrors, found = _reflected(plate, ABOVE, PLACES, frequency, Quality(depth=1, rays=4000))
    truth = [_physical_optics_in_plane(amplitude, ABOVE, p, C / frequency) for p in PLACES]
    return Compared((mirrors,), 20 * np.log10(np.abs(found) / np.abs(truth)))
