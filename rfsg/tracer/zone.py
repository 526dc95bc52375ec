"""The surface that a wave sees: a learned face measured over the first Fresnel zone.

A trained face ripples by half a millimetre; geometrical optics believes every ripple and finds false
glints and wrong curvatures. A wave of 12 cm does not see them. So the normal and curvature that steer
and spread a path are those of a least-squares quadric through the zero set around the vertex,
sampled within the zone where the path length stays within half a wavelength of the stationary one:

    rho^2 = lambda / (1/d1 + 1/d2 + 2 |curvature| cos theta),

which is the flat zone sqrt(lambda d1 d2 / (d1 + d2)) with the bend of the surface taken in. The zone
is clipped at the object's edges (samples that find no surface, or one that faces elsewhere, carry no
weight, smoothly) and shrinks where the relief leaves the quadric by more than lambda / 16, so real
relief survives. Planes and spheres of radius large against rho come out unchanged.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Jet
from rfsg.scene.world import World, unit
from rfsg.tracer.feet import Asked, Feet

RELIEF = 1.0 / 16.0  # of a wavelength: what a mirror may depart from its quadric (Rayleigh's half)
SKETCHED = 1.0 / 64.0  # of a wavelength: what sketches of networks may err by
ALIGNED = (0.64, 0.87)  # cosines of 50 and 30 degrees: below the first a sample is another face
SHRINKS = (1.0, 0.5, 0.25)  # zone radii tried, largest first
HELD = (
    0.2,
    0.45,
)  # share of a full zone's weight on the face: below the first a zone is not believed
SHEET = 0.25  # wavelengths: what lies further off the tangent plane within a zone is another sheet
LEAST_WEIGHT = 0.3  # between the two: less of a face than this is not a mirror


@dataclass(frozen=True)
class Facets:
    """Local quadrics n.(x - x0) = c + a.uv + uv.P.uv / 2 in the world, one per vertex.

    ``frame`` rows are e1, e2, n. ``residual`` is the rms departure of the samples [m]; ``weight``
    the share of the zone that lies on the face; ``radius`` the zone's [m].
    """

    centre: Float[Tensor, "m 3"]
    frame: Float[Tensor, "m 3 3"]
    offset: Float[Tensor, "m"]
    slope: Float[Tensor, "m 2"]
    bend: Float[Tensor, "m 2 2"]
    residual: Float[Tensor, "m"]
    weight: Float[Tensor, "m"]
    radius: Float[Tensor, "m"]

    def jet(self, point: Float[Tensor, "m 3"]) -> Jet:
        """The quadric as an implicit function, exact to second order."""
        local = torch.einsum("mij,mj->mi", self.frame, point - self.centre)
        uv, height = local[:, :2], local[:, 2]
        pull = torch.einsum("mij,mj->mi", self.bend, uv)
        value = height - self.offset - (self.slope * uv).sum(-1) - 0.5 * (pull * uv).sum(-1)
        tilt = torch.cat([-(self.slope + pull), torch.ones_like(height)[:, None]], -1)
        gradient = torch.einsum("mji,mj->mi", self.frame, tilt)
        tangent = self.frame[:, :2]
        hessian = -tangent.transpose(-1, -2) @ self.bend @ tangent
        return Jet(value, gradient, hessian)

    def curvature(self) -> Float[Tensor, "m"]:
        """Largest absolute principal curvature [1/m]."""
        half_trace = 0.5 * (self.bend[:, 0, 0] + self.bend[:, 1, 1])
        det = self.bend[:, 0, 0] * self.bend[:, 1, 1] - self.bend[:, 0, 1] ** 2
        root = torch.sqrt(torch.clamp(half_trace**2 - det, min=0.0))
        return half_trace.abs() + root

    def resolved(self, wavelength: float, margin: float = 1.0) -> Bool[Tensor, "m"]:
        """True where the zone holds enough of the face, and the face is a mirror to the wave; either
        by a margin less if that is not 1."""
        held = margin * self.weight >= LEAST_WEIGHT
        return held & (self.residual <= margin * RELIEF * wavelength)


def zone_radius(
    d1: Float[Tensor, "*b"],
    d2: Float[Tensor, "*b"],
    cosine: Float[Tensor, "*b"],
    curvature: Float[Tensor, "*b"],
    wavelength: float,
) -> Float[Tensor, "*b"]:
    """Radius of the first Fresnel zone on a bent surface [m]."""
    tiny = torch.finfo(d1.dtype).tiny
    bend = 1.0 / d1.clamp(min=tiny) + 1.0 / d2.clamp(min=tiny) + 2.0 * curvature * cosine
    return torch.sqrt(wavelength / bend)


def measure(
    world: World,
    which: Int[Tensor, "m"],
    centre: Float[Tensor, "m 3"],
    normal: Float[Tensor, "m 3"],
    radius: Float[Tensor, "m"],
    wavelength: float,
    rings: int,
    dtype: torch.dtype = torch.float64,
) -> Facets:
    """Fit the quadric of each vertex's zone: of the zones tried, largest first, those that are mirrors.

    ``dtype`` is the precision of the network's evaluation; in float32 its sketch will do, where that is
    good enough. Frames are laid out in the object's own frame, so moving the whole scene moves the
    answer and changes nothing else.
    """
    if dtype == torch.float32:
        world = world.sketched(SKETCHED * wavelength)
    zones = Zones(world, which, centre, normal, radius, wavelength, rings)
    return zones.fitted(Asked(world, which, dtype))


@dataclass(frozen=True)
class Zones:
    """Zones about vertices, to be fitted to what their samples find: see ``measure``."""

    world: World
    which: Int[Tensor, "m"]
    centre: Float[Tensor, "m 3"]
    normal: Float[Tensor, "m 3"]
    radius: Float[Tensor, "m"]
    wavelength: float
    rings: int

    def measured(self, dtype: torch.dtype, before: Feet | None) -> tuple[Facets, Feet]:
        """Quadrics by the network, and the samples' feet; ``before``: those of zones close by."""
        asked = Asked(self.world, self.which, dtype, before)
        return self.fitted(asked), asked.feet

    def fitted(self, source: Asked) -> Facets:
        normal_object = self.world.direction_object(self.which, self.normal)
        axes = torch.cat([_tangents(normal_object), normal_object[:, None]], 1)
        axes = [self.world.direction_world(self.which, axes[:, k]) for k in range(3)]
        frame, rows = torch.stack(axes, 1), torch.arange(len(self.which), device=self.which.device)
        whole = self._fit(source, 0, rows, frame)
        left = 1.0 - _trust(whole, self.wavelength)  # what smaller zones still have to say
        whole = _scaled(whole, 1.0 - left)
        for level in range(1, len(SHRINKS)):
            kept = torch.nonzero(left[rows] > 0).squeeze(-1)
            if not len(kept):
                break
            rows = rows[kept]
            smaller = self._fit(source, level, rows, frame[rows])
            # the smallest takes what is left, trusted or not: ``resolved`` has the last word
            trust = _trust(smaller, self.wavelength)
            last = level == len(SHRINKS) - 1
            share = left[rows] * (torch.ones_like(trust) if last else trust)
            whole = _added(whole, rows, smaller, share)
            left = left.index_copy(0, rows, left[rows] - share)
        return whole

    def _fit(self, source: Asked, level: int, rows: Tensor, frame: Tensor) -> Facets:
        """Quadrics of one size of zone."""
        radius, centre = SHRINKS[level] * self.radius[rows], self.centre[rows]
        uv, normal = disc(self.rings, centre), frame[:, 2]
        plane = torch.einsum("qk,mkj->mqj", uv, frame[:, :2]) * radius[:, None, None]
        base = centre[:, None] + plane
        drop = source.drop(level, rows, base, normal, radius)
        taper = torch.exp(-2.0 * (uv * uv).sum(-1))
        weight = taper * _smoothstep(drop.aligned(normal), *ALIGNED)
        weight = weight * torch.exp(-((drop.missed / (0.02 * radius[:, None])) ** 2))
        weight = weight * torch.exp(-((drop.height / (SHEET * self.wavelength)) ** 4))
        return _least_squares(centre, frame, radius, uv, drop.height, weight, taper.sum())


def _tangents(normal: Float[Tensor, "m 3"]) -> Float[Tensor, "m 2 3"]:
    """Two tangents as rows that turn as little as the normal does.

    Not about the least component of the normal: on a flat face two components are ripple, and the
    pattern of samples would turn by a right angle from one round to the next.
    """
    steep = normal[:, 2].abs() > 0.9
    axis = torch.zeros_like(normal)
    axis[:, 2] = (~steep).to(normal.dtype)
    axis[:, 0] = steep.to(normal.dtype)
    first = unit(torch.linalg.cross(axis, normal))
    return torch.stack([first, torch.linalg.cross(normal, first)], 1)


def _trust(facets: Facets, wavelength: float) -> Float[Tensor, "m"]:
    """From 0 to 1, smoothly: does the zone hold enough of the face, and is that a mirror?

    Smooth, because a zone that switched its radius at a threshold would send a vertex back and forth.
    """
    held = _smoothstep(facets.weight, *HELD)
    flat = _smoothstep(-facets.residual / (RELIEF * wavelength), -1.0, -0.5)
    return held * flat


BLENDED = ("offset", "slope", "bend", "residual", "weight", "radius")


def _scaled(facets: Facets, share: Tensor) -> Facets:
    return replace(facets, **{n: _times(getattr(facets, n), share) for n in BLENDED})


def _added(whole: Facets, i: Tensor, part: Facets, share: Tensor) -> Facets:
    added = {n: getattr(whole, n).index_add(0, i, _times(getattr(part, n), share)) for n in BLENDED}
    return replace(whole, **added)


def _times(x: Tensor, share: Tensor) -> Tensor:
    return x * share.reshape(-1, *([1] * (x.dim() - 1)))


def disc(rings: int, like: Tensor) -> Float[Tensor, "q 2"]:
    """A centre and ``rings`` rings of 6 j points in the unit disc."""
    points = [torch.zeros(1, 2, dtype=torch.float64)]
    for j in range(1, rings + 1):
        angle = torch.arange(6 * j, dtype=torch.float64) * (2 * torch.pi / (6 * j))
        points.append(torch.stack([angle.cos(), angle.sin()], -1) * (j / rings))
    return torch.cat(points).to(like)


def _smoothstep(x: Tensor, low: float, high: float) -> Tensor:
    t = ((x - low) / (high - low)).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _least_squares(
    centre: Tensor,
    frame: Tensor,
    radius: Tensor,
    uv: Tensor,
    height: Tensor,
    weight: Tensor,
    full: Tensor,
) -> Facets:
    """Weighted quadric in units of the zone radius; a hair of ridge keeps lone samples solvable."""
    u, v = uv[:, 0], uv[:, 1]
    columns = torch.stack([torch.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], -1)
    scaled = height / radius[:, None]
    normal_matrix = torch.einsum("mq,qi,qj->mij", weight, columns, columns)
    right = torch.einsum("mq,qi,mq->mi", weight, columns, scaled)
    # flat where nothing says otherwise: the ridge weighs a thousandth of one sample, not on offset
    ridge = torch.diag(torch.tensor([0.0, 1.0, 1.0, 1.0, 1.0, 1.0], dtype=torch.float64)) * RIDGE
    floor = torch.eye(6, dtype=torch.float64) * RIDGE * RIDGE
    matrix = normal_matrix + (ridge + floor).to(normal_matrix.device)
    coefficient = torch.linalg.solve(matrix, right)
    left = (scaled - coefficient @ columns.T) * radius[:, None]
    total = weight.sum(-1)
    residual = torch.sqrt((weight * left**2).sum(-1) / total.clamp(min=1e-12))
    c, r = coefficient, radius
    bend = torch.stack([c[:, 3], c[:, 4], c[:, 4], c[:, 5]], -1).reshape(-1, 2, 2)
    return Facets(
        centre,
        frame,
        c[:, 0] * r,
        c[:, 1:3],
        bend / r[:, None, None],
        residual,
        total / full,
        r,
    )


RIDGE = 1e-6


def take(facets: Facets, i: Tensor) -> Facets:
    """The facets of a selection of vertices."""
    return Facets(*(getattr(facets, name)[i] for name in Facets.__dataclass_fields__))


def joined(*parts: Facets) -> Facets:
    """Facets after one another."""
    columns = ([getattr(p, name) for p in parts] for name in Facets.__dataclass_fields__)
    return Facets(*(torch.cat(column) for column in columns))
