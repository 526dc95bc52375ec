"""What rough surfaces scatter: by the tracer, in closed form, and by plain quadrature."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.physics import fresnel, media
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import HalfSpace
from rfsg.objects.surfaces.interface import DielectricHalfSpace
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act
from rfsg.tracer.simulate import Result, simulate
from tests.scenes import radio

FREQUENCY = 2.4e9
FREE = (299_792_458.0 / FREQUENCY / (4.0 * math.pi)) ** 2  # (lambda / 4 pi)^2
QUALITY = Quality(depth=1, diffuse=8, diffraction=0, floor_db=-300.0)
LOBES = {
    "lambertian": Scattering(1.0),
    "directive": Scattering(1.0, "directive", alpha_r=4),
    "narrow": Scattering(1.0, "directive", alpha_r=40),
    "backscattering": Scattering(1.0, "backscattering", alpha_r=6, alpha_i=3, forward_share=0.6),
}


def real(value) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


# by the tracer


def of_one(body: Body, tx, rx, quality: Quality = QUALITY, **options) -> Result:
    """One object at the origin, one transmitter, receivers."""
    pose, gradients = options.pop("pose", Pose.identity()), options.pop("gradients", False)
    receivers = tuple(radio(f"/r{i}", *p, **options) for i, p in enumerate(rx))
    scene = Scene((Node("/it", body, pose),), (radio("/t", *tx, **options),), receivers, FREQUENCY)
    return simulate(scene, quality=quality, gradients=gradients)


def ground(rough: Scattering | None = None) -> Body:
    return Body(HalfSpace(), DielectricHalfSpace(eps_r=5.24, sigma=0.05, scattering=rough))


def diffuse(result: Result) -> Tensor:
    """Sum of |gain|^2 of the scattered paths of every link [t r], over (lambda / 4 pi)^2."""
    t, r = len(result.scene.transmitters), len(result.scene.receivers)
    i = torch.nonzero((result.paths.act == int(Act.SCATTER)).any(1)).squeeze(-1)
    link = (result.paths.tx * r + result.paths.rx)[i]
    gain = result.channel.gain[i, 0]
    square = (gain.real**2 + gain.imag**2) / FREE
    return torch.zeros(t * r, dtype=torch.float64).index_add(0, link, square).reshape(t, r)


def at_phase_angles(body: Body, angles: Sequence[float], quality: Quality = QUALITY) -> Tensor:
    """What it scatters to receivers at these phase angles, very far away, times distance^4."""
    far = 1e4
    u = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) / math.sqrt(14.0)
    v = torch.tensor([2.0, -1.0, 0.0], dtype=torch.float64) / math.sqrt(5.0)
    rx = [(far * (math.cos(b) * u + math.sin(b) * v)).tolist() for b in angles]
    return diffuse(of_one(body, (far * u).tolist(), rx, quality))[0] * far**4


# closed forms, of conductors that scatter everything by Lambert's law


def lambert_plane(low: float, high: float) -> float:
    """One above the other: int h1 h2 / (pi d1^3 d2^3) dA = 2 / (h1 + h2)^2, twice the mirror's."""
    return 2.0 / (low + high) ** 2


def lambert_disc(h: float, a: float) -> float:
    """Both on the axis at h above a disc of radius a: (h^2 / 2) (1 / h^4 - 1 / (a^2 + h^2)^2)."""
    return 0.5 * h**2 * (h**-4 - (a * a + h * h) ** -2)


def lambert_sphere(a: float, b: float) -> float:
    """Far away at a phase angle b: (2 a^2 / 3 pi) (sin b + (pi - b) cos b) / D^4 (Lambert 1760)."""
    return 2 * a * a / (3 * math.pi) * (math.sin(b) + (math.pi - b) * math.cos(b))


# plain quadrature: everything at every point


def plain_sum(rough: Scattering, tx, rx, half, count: int = 500) -> float:
    """The plain twin of a dielectric rectangle z = 0: midpoints."""
    x, y = (h * ((2 * np.arange(count) + 1) / count - 1) for h in half)
    return _gathered(rough, tx, rx, (x, y), [np.full(count, 2.0 * h / count) for h in half])


def endless_sum(rough: Scattering, tx, rx, count: int = 500) -> float:
    """The plain twin of the whole dielectric plane z = 0: midpoints in u, x = h sinh(u) about the middle,
    to some 4000 h. The midpoint rule of what fades to nothing at both ends converges faster than any
    power of the step."""
    height, reach = 0.5 * (tx[2] + rx[2]), 9.0
    u = reach * ((2 * np.arange(count) + 1) / count - 1)
    places = [0.5 * (tx[a] + rx[a]) + height * np.sinh(u) for a in (0, 1)]
    return _gathered(rough, tx, rx, places, [2.0 * reach / count * height * np.cosh(u)] * 2)


def _gathered(rough: Scattering, tx, rx, places, weights) -> float:
    px, py = np.meshgrid(*places, indexing="ij")
    point = torch.from_numpy(np.stack([px.ravel(), py.ravel(), 0 * px.ravel()], -1))
    n = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(point)
    a, b = point - real(tx), real(rx) - point
    d1, d2 = a.norm(dim=-1), b.norm(dim=-1)
    k, out = a / d1[:, None], b / d2[:, None]
    cosine = -k[:, 2]
    eps = media.from_constants(real(5.24), real(0.05), real(FREQUENCY))
    te, tm = fresnel.interface(cosine, eps.expand(len(cosine)))
    reflected = 0.5 * (te.abs() ** 2 + tm.abs() ** 2)
    area = torch.from_numpy(np.outer(*weights).ravel())
    return float((cosine * reflected * rough.density(k, out, n) / (d1 * d2) ** 2 * area).sum())
