"""Tubes of rays: a ray speaks for all about it, out to a half-width that mirrors bend wider.

At every boundary that a ray enters, its mirror image is a new ray; ``launch`` decides which boundaries.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact
from rfsg.scene.world import World
from rfsg.tracer.places import Cones
from rfsg.tracer.records import Crossings, Rays

WIDEST = 1.0  # [rad] a tube bent at a sharp edge diverges no further than this
STEEPEST = 0.1  # least cosine in the bending of tubes: grazing tubes would widen without end
LEARNED_LIFT = 1e-3  # [m] above a searched float32 root and the ripple next to it


@dataclass
class Tubes:
    """Rays under way from one radio: geometry, tube, amplitude bound, and their history."""

    rays: Rays
    width: Float[Tensor, "r"]  # half-width at the origin [m]
    spread: Float[Tensor, "r"]  # growth of the half-width [m per m]
    bound: Float[Tensor, "r"]  # amplitude, relative to free space over the same length, at most
    history: Int[Tensor, "r d 2"]  # (node, patch) of the reflections so far
    vertices: Float[Tensor, "r d 3"]

    def __len__(self) -> int:
        return self.width.shape[0]

    def take(self, i: Tensor | slice) -> "Tubes":
        rays = self.rays.take(i)
        return Tubes(
            rays, self.width[i], self.spread[i], self.bound[i], self.history[i], self.vertices[i]
        )

    @staticmethod
    def joined(parts: Sequence["Tubes"]) -> "Tubes":
        """All of some tubes of one depth, in order."""
        if len(parts) == 1:
            return parts[0]
        rays = Rays(
            *(torch.cat([getattr(p.rays, n) for p in parts]) for n in Rays.__dataclass_fields__)
        )
        names = ("width", "spread", "bound", "history", "vertices")
        return Tubes(rays, *(torch.cat([getattr(p, n) for p in parts]) for n in names))

    def cones(self) -> Cones:
        """Where the tubes run from here, if nothing stands in the way."""
        return Cones(self.rays.origin, self.rays.direction, self.width, self.spread)


def first_tubes(
    position: Float[Tensor, "3"], direction: Float[Tensor, "n 3"], spacing: float
) -> Tubes:
    """Tubes from one radio, as wide as the spacing of their directions [rad]."""
    n = len(direction)
    zero = torch.zeros(n, dtype=torch.float64, device=position.device)
    return Tubes(
        Rays(position.expand(n, 3).clone(), direction, zero + torch.inf),
        zero,
        zero + spacing,
        zero + 1.0,
        torch.zeros(n, 0, 2, dtype=torch.int64, device=position.device),
        torch.zeros(n, 0, 3, dtype=torch.float64, device=position.device),
    )


def mirrored(
    world: World,
    tubes: Tubes,
    inside: Crossings,
    i: Int[Tensor, "k"],
    bound: Float[Tensor, "k"],
    frequency: Float[Tensor, "f"],
    floor: float,
) -> Tubes:
    """The mirror images of tubes at chosen entries, less those that carry no more than ``floor``.

    bound: the amplitude that arrives at each entry, at most.
    """
    ray, which, t, normal = inside.ray[i], inside.which[i], inside.enter[i], inside.normal_enter[i]
    d = tubes.rays.direction[ray]
    cosine = -(d * normal).sum(-1)
    front = cosine > 0
    ray, which, t, normal, d, cosine, bound = (
        x[front] for x in (ray, which, t, normal, d, cosine, bound)
    )
    point = tubes.rays.origin[ray] + t[:, None] * d
    out = d + 2.0 * cosine[:, None] * normal
    bound = bound * _reflected_at_most(world, which, point, d, out, normal, frequency)
    width = tubes.width[ray] + tubes.spread[ray] * t
    bend = 2.0 * _curvature(world, which, point) * width / cosine.clamp(min=STEEPEST)
    spread = torch.clamp(tubes.spread[ray] + bend, max=WIDEST)
    patch = world.patch(which, point)
    step = torch.stack([which, patch], -1)[:, None]
    keep = bound > floor
    grown = Tubes(
        Rays(point, out, torch.full_like(t, torch.inf)),
        width,
        spread,
        bound,
        torch.cat([tubes.history[ray], step], 1),
        torch.cat([tubes.vertices[ray], point[:, None]], 1),
    )
    return _lifted(grown.take(torch.nonzero(keep).squeeze(-1)), normal[keep], world)


def _lifted(tubes: Tubes, normal: Tensor, world: World) -> Tubes:
    """Start reflected rays just off their surface: a rounding error must not find it again."""
    which = tubes.history[:, -1, 0]
    exact = world.exact[which]
    scale = torch.maximum(world.size[which], tubes.rays.origin.abs().amax(-1))
    lift = torch.where(exact, 1e-12 * scale, LEARNED_LIFT * torch.ones_like(scale))
    origin = tubes.rays.origin + lift[:, None] * normal
    tubes.rays = Rays(origin, tubes.rays.direction, tubes.rays.limit)
    return tubes


def _reflected_at_most(
    world: World,
    which: Tensor,
    point: Tensor,
    incoming: Tensor,
    outgoing: Tensor,
    normal: Tensor,
    frequency: Tensor,
) -> Tensor:
    """Largest |R| over frequency and polarisation."""
    out = torch.ones(len(which), dtype=torch.float64, device=world.device)
    i = torch.nonzero(~world.learned_surface[which]).squeeze(-1)
    if len(i):
        contact = Contact(point[i], incoming[i], outgoing[i], normal[i])
        out[i] = world.reflection(which[i], contact, frequency).abs().amax(-1).amax(-1)
    return out


def _curvature(world: World, which: Tensor, point: Tensor) -> Tensor:
    """Largest curvature of the surface at hits [1/m], up to the size of the tube's own worth."""
    bend = torch.zeros(len(which), dtype=torch.float64, device=world.device)
    flat = world.is_flat(which, point)
    i = torch.nonzero(~flat).squeeze(-1)
    if len(i):
        hessian = world.jet(which[i], point[i], torch.float32).hessian
        bend[i] = hessian.reshape(len(i), 9).norm(dim=-1)
    return bend
