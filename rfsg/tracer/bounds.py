"""What a path may carry at most, before it is known: where a search may stop without losing any.

The floor of ``Quality`` is relative to free space over the same length. A path of planar mirrors spreads
as free space does, and nothing that it goes through amplifies, so it carries no more than the product
of its mirrors' |R|, times what the antennas add. A beginning of which that product lies below the floor
has no end that lies above.

|R| of a mirror is bounded by its largest value between normal incidence and the most oblique at which
the path may meet it. Let c be the |cos| of incidence and kappa = a - jb = sqrt(eps_c - 1 + c^2), with
eps' >= 1 and eps'' >= 0.

- A half-space has |R_TE|^2 = (1 - x) / (1 + x), x = 2 c a / (|kappa|^2 + c^2). With y = a^2, which grows
  with c, x^2 = 1 - (A^2 + eps''^2) / (2 y - A)^2, A = eps' - 1: so |R_TE| falls as c grows.
- |R_TM| <= |R_TE|: their ratio is |c kappa - s^2| / |c kappa + s^2|, s = sin theta, and a >= 0.
- A layer has R = r (1 - e) / (1 - r^2 e), e = exp(-2 j k d kappa). Whatever its thickness, e lies in the
  unit disc, and the image of that has |R| <= 2 |r| |1 - r^2| / (1 - |r|^4), which for TE is
  2 |r| / (1 + |r|^2) |kappa| / a; both factors fall as c grows. For TM the second is
  1 / cos(arg eps_c - arg kappa), no more than for TE, since arg eps_c <= 2 arg kappa.
- Of a layer of known thickness the slope along c is bounded by those of r and e, so that its value in
  the middle of a short interval bounds it in the interval.
"""

import json
import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.physics import fresnel
from rfsg.objects.recent import Recent
from rfsg.objects.surfaces.interface import DielectricHalfSpace, Known
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene import antennas
from rfsg.scene.patterns import Pattern
from rfsg.scene.radios import Radio
from rfsg.scene.world import World, unit
from rfsg.tracer.faces import Planes
from rfsg.tracer.plan import Quality

CELLS = 1024  # of |cos| from 0 to 1
ROUNDING = 1e-9  # of a bound: what its own arithmetic and that of the path may differ by

# the largest sqrt(G) of each named pattern (``rfsg.scene.antennas``)
LARGEST = {
    "isotropic": 1.0,
    "short_dipole": math.sqrt(antennas.SHORT_DIPOLE_DIRECTIVITY),
    "half_wave_dipole": math.sqrt(antennas.HALF_WAVE_DIRECTIVITY),
    "tr38901": 10.0 ** (antennas.ELEMENT_GAIN_DB / 20.0),
}


def largest_amplitude(radio: Radio) -> float:
    """The largest sqrt(G) of a radio's antenna; inf for a pattern of which it is not known."""
    if isinstance(radio.pattern, Pattern):  # between samples it is interpolated, so no larger
        return float(radio.pattern.samples.detach().abs().square().sum(-1).sqrt().max())
    return LARGEST.get(radio.pattern, math.inf)


def least_product(world: World, quality: Quality) -> float:
    """The least product of coefficients that the antennas of the scene can lift to the floor."""
    lift = 1.0
    for radios in (world.scene.transmitters, world.scene.receivers):
        lift *= max([1.0, *(largest_amplitude(r) for r in radios)])
    return 10.0 ** (quality.floor_db / 20.0) / lift


@dataclass(frozen=True)
class Carried:
    """What sequences of planar mirrors carry, at most. normal: of each mirror, as the last image sees
    it in the others; cosine: the least |cos| at which a path may meet it; most: the product of the
    largest |R| there."""

    normal: Float[Tensor, "p d 3"]
    cosine: Float[Tensor, "p d"]
    most: Float[Tensor, "p"]

    def take(self, i: Tensor) -> "Carried":
        return Carried(self.normal[i], self.cosine[i], self.most[i])

    @staticmethod
    def joined(parts: "list[Carried]") -> "Carried":
        """All of some records of one depth, in order."""
        names = Carried.__dataclass_fields__
        return Carried(*(torch.cat([getattr(p, n) for p in parts]) for n in names))


class Floor:
    """The power floor of a search, and how many beginnings of sequences were dropped by it."""

    def __init__(
        self, world: World, planes: Planes, frequency: Float[Tensor, "f"], quality: Quality
    ):
        self.planes, self.corners = planes, planes.corners()
        self.surface = world.surface_of_node[planes.node]
        bodies = [_most_reflected(body, frequency) for body in world.surfaces]
        self.most = torch.stack(bodies).to(world.device) if bodies else torch.ones(0, CELLS)
        self.least = least_product(world, quality)
        self.pruned = 0

    @staticmethod
    def of(
        world: World, planes: Planes, frequency: Float[Tensor, "f"], quality: Quality
    ) -> "Floor | None":
        """The floor of a search; None where it cannot drop anything, and where solids bend waves:
        there the path meets its mirrors at other angles than the straight one it is sought from."""
        if quality.refraction and bool(world.solid.any()):
            return None
        floor = Floor(world, planes, frequency, quality)
        weakest = float(floor.most[floor.surface, -1].min()) if len(planes) else 1.0
        return floor if weakest**quality.depth < floor.least else None

    def nothing(self) -> Carried:
        """A wave that has met no mirror."""
        one = self.most.new_ones(1)
        return Carried(one.new_zeros(1, 0, 3), one[:, None][:, :0], one)

    def extended(
        self, carried: Carried, image: Float[Tensor, "m 3"], faces: Int[Tensor, "m d"]
    ) -> Carried:
        """What is left after one more mirror, the last of ``faces``, for waves from images in those
        before it.

        All directions through a face are sums of those to its corners, and those at no more than an
        angle to a normal are a convex cone: what holds at the corners holds between them.
        """
        mirror = self.planes.normal[faces[:, -1]]
        here = unit(self.corners[faces[:, -1]] - image[:, None])
        cosine = torch.maximum(carried.cosine, _least_cosine(here, carried.normal))
        last = _least_cosine(here, mirror[:, None])
        if faces.shape[1] > 1:
            there = unit(self.corners[faces[:, -2]] - image[:, None])
            last = torch.maximum(last, _least_cosine(there, mirror[:, None]))
        cosine = torch.cat([cosine, last], 1)
        along = (carried.normal * mirror[:, None]).sum(-1, keepdim=True)
        normal = torch.cat([carried.normal - 2.0 * along * mirror[:, None], mirror[:, None]], 1)
        cell = (cosine * CELLS).to(torch.int64).clamp(0, CELLS - 1)
        return Carried(normal, cosine, self.most[self.surface[faces], cell].prod(1))


def _least_cosine(
    direction: Float[Tensor, "m 4 3"], normal: Float[Tensor, "m d 3"]
) -> Float[Tensor, "m d"]:
    """The least |cos| between normals and any direction in the cone of four; 0 if it crosses a plane."""
    along = normal @ direction.mT
    return torch.maximum(along.amin(-1), -along.amax(-1)).clamp(min=0.0)


MOST_CACHED = 1024  # tables of ``CELLS`` numbers
_MOST: Recent[Tensor] = Recent(MOST_CACHED)


def _most_reflected(body: Body, frequency: Float[Tensor, "f"]) -> Float[Tensor, "cells"]:
    """``most_reflected``, kept by the constants of the material: a scene asks again after every edit."""
    if not isinstance(body.surface, Known):
        return most_reflected(body, frequency)
    constants = json.dumps(body.surface.config(), sort_keys=True)
    key = (body.surface.kind, constants, tuple(frequency.tolist()), str(frequency.device))
    return _MOST.get(key, None, lambda: most_reflected(body, frequency))


@torch.no_grad()
def most_reflected(body: Body, frequency: Float[Tensor, "f"]) -> Float[Tensor, "cells"]:
    """The largest |R| of a surface from the least |cos| of each cell to 1, at any frequency."""
    surface = body.surface
    low = torch.arange(CELLS, dtype=torch.float64, device=frequency.device)[:, None] / CELLS
    low = low.clamp(min=fresnel.GRAZING_COSINE)  # as the coefficients themselves
    out = torch.ones_like(low)
    if isinstance(surface, (DielectricHalfSpace, Slab, Solid)):
        frequency = frequency.to(torch.float64)
        eps = surface.medium.permittivity(frequency)
        kappa = torch.sqrt(eps - 1.0 + low * low)
        r = ((low - kappa) / (low + kappa)).abs()
        if isinstance(surface, DielectricHalfSpace):
            out = r
        else:
            out = 2.0 * r / (1.0 + r * r) * kappa.abs() / kappa.real
        if isinstance(surface, Slab):
            out = torch.minimum(out, _in_cells(low, eps, r, kappa, surface.thickness_m, frequency))
    # what is reflected less obliquely may be more
    most = out.amax(1).clamp(max=1.0).flip(0).cummax(0).values.flip(0)
    if isinstance(surface, Known) and surface.scattering is not None:
        most = most * surface.scattering.mirror_amplitude().to(most)
    return most * (1.0 + ROUNDING)


def _in_cells(
    low: Float[Tensor, "c 1"],
    eps: Complex[Tensor, "f"],
    r: Float[Tensor, "c f"],
    kappa: Complex[Tensor, "c f"],
    thickness: float,
    frequency: Float[Tensor, "f"],
) -> Float[Tensor, "c f"]:
    """The largest |R| of a layer in each cell: in its middle, and what its slope may add.

    r: |R_TE| of one face where the cell begins, no less than that of either polarisation anywhere in it;
    so do the slopes of r and of kappa fall from there.
    """
    width = 1.0 / CELLS
    middle, _ = fresnel.slab(low + 0.5 * width, eps, thickness, frequency)
    distance = (1.0 - r * r).clamp(min=1e-150) ** 2  # |1 - r^2 e|^2, at least
    k = 2.0 * math.pi * frequency / fresnel.SPEED_OF_LIGHT
    turn = 2.0 * k * thickness * (low + width) / kappa.abs()
    te = 2.0 * (eps - 1.0).abs() / (kappa.abs() * (low + kappa).abs() ** 2)
    tm = 2.0 * (eps * (eps - 1.0)).abs() / (kappa.abs() * (eps * low + kappa).abs() ** 2)
    slope = (1.0 + r * r) / distance * (2.0 * torch.maximum(te, tm) + r * turn)
    return middle.abs().amax(-1) + 0.5 * width * slope
