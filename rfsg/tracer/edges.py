"""The edges of a scene's objects, in the world, and what a diffracting wave asks of them."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.shapes.edges import edges_of
from rfsg.scene.world import World, unit

LEAST = 1.0  # [wavelengths] length of an edge that diffracts
LOOKS = 9  # places along an edge at which to see whether anything of it is free
ACROSS = (0.01, 0.25, 0.5, 0.75, 0.99)  # of the exterior angle: where the wedge must be free
PAIRS = 1 << 19  # (point, node) tests at a time: bounds memory
WIDER = 1e-9  # by so much [m, and of its size] is an upright box wider than what it holds
NEARBY = (5e-2, 5e-5)  # wavelengths: what is closer than this to a wedge is part of it


@dataclass(frozen=True)
class Edges:
    """Convex edges of every node: straight ones, and the rims of cylinders.

    Arc length t runs along an edge from its start. Of a rim, ``normal0`` is that of its flat face, and
    the other face is the round one, whose normal points away from ``centre``; ``radius`` is inf where
    the edge is straight. The wave is outside, within an angle of n pi from face 0 to face 1.
    """

    node: Int[Tensor, "e"]
    patch0: Int[Tensor, "e"]
    patch1: Int[Tensor, "e"]
    start: Float[Tensor, "e 3"]
    along: Float[Tensor, "e 3"]  # unit vector, at the start
    length: Float[Tensor, "e"]
    normal0: Float[Tensor, "e 3"]
    normal1: Float[Tensor, "e 3"]  # at the start
    centre: Float[Tensor, "e 3"]
    radius: Float[Tensor, "e"]

    def __len__(self) -> int:
        return len(self.node)

    def take(self, i: Tensor) -> "Edges":
        return Edges(*(getattr(self, n)[i] for n in self.__dataclass_fields__))

    @property
    def straight(self) -> Bool[Tensor, "e"]:
        return torch.isinf(self.radius)

    @property
    def opening(self) -> Float[Tensor, "e"]:
        """n: the exterior angle over pi; 3/2 on a box, 2 on a half-plane."""
        cosine = (self.normal0 * self.normal1).sum(-1)
        across = torch.linalg.cross(self.normal0, self.normal1).norm(dim=-1)
        return 1.0 + torch.atan2(across, cosine) / math.pi

    def point(self, t: Float[Tensor, "e"]) -> tuple[Tensor, Tensor, Tensor]:
        """Place, tangent and second derivative by arc length [m, 1, 1/m] at t, each [e 3]."""
        turn = torch.where(self.straight, torch.zeros_like(t), t / self.radius)[:, None]
        cosine, sine = torch.cos(turn), torch.sin(turn)
        straight = self.straight[:, None]
        out = torch.where(straight, self.normal1, unit(self.start - self.centre))
        here = cosine * out + sine * self.along
        radius = torch.where(self.straight, torch.ones_like(self.radius), self.radius)[:, None]
        place = torch.where(
            straight, self.start + t[:, None] * self.along, self.centre + radius * here
        )
        tangent = torch.where(straight, self.along, cosine * self.along - sine * out)
        bend = torch.where(straight, torch.zeros_like(here), -here / radius)
        return place, tangent, bend

    def arc_length(self, point: Float[Tensor, "e 3"]) -> Float[Tensor, "e"]:
        """t of points on the edges."""
        away = point - self.start
        ahead = (away * self.along).sum(-1)
        straight = self.straight
        out = unit(self.start - self.centre)
        across = ((point - self.centre) * out).sum(-1)
        turn = torch.atan2(
            torch.where(straight, torch.zeros_like(ahead), ahead),
            torch.where(straight, torch.ones_like(across), across),
        )
        radius = torch.where(straight, torch.ones_like(self.radius), self.radius)
        return torch.where(straight, ahead, radius * turn)

    def normals(self, t: Float[Tensor, "e"]) -> tuple[Tensor, Tensor]:
        """Outward normals of the two faces at t."""
        _, _, bend = self.point(t)
        return self.normal0, torch.where(self.straight[:, None], self.normal1, -unit(bend))

    def angle(self, t: Float[Tensor, "e"], away: Float[Tensor, "e 3"]) -> Float[Tensor, "e"]:
        """Angle [rad], from face 0 through the outside, of directions away from the edge at t."""
        normal0, normal1 = self.normals(t)
        face0 = along_face(normal0, normal1)
        turn = torch.atan2((away * normal0).sum(-1), (away * face0).sum(-1))
        # what points a hair below face 0 is on face 0, not a whole turn away
        middle = 0.5 * math.pi * self.opening.detach() - math.pi
        return torch.where(turn < middle, turn + 2 * math.pi, turn)


def along_face(normal0: Tensor, normal1: Tensor) -> Tensor:
    """Unit vectors in face 0, away from the edge."""
    return unit((normal0 * normal1).sum(-1, keepdim=True) * normal0 - normal1)


def edges_in(world: World, wavelength: float) -> Edges:
    """Every edge of the world that stands free somewhere and is a wavelength long or more: what is
    shorter sends no wave of its own that UTD knows. Differentiable in poses and sizes."""
    every = long_edges(world, wavelength)
    return every.take(torch.nonzero(stands_free(world, every, wavelength)).squeeze(-1))


def long_edges(world: World, wavelength: float) -> Edges:
    """Every edge a wavelength long or more, free or not, node by node."""
    parts = []
    for k, node in enumerate(world.scene.nodes):
        own = edges_of(node.body.shape)
        if own is None or not len(own.start):
            continue
        which = torch.full((len(own.start),), k, dtype=torch.int64, device=world.device)
        start = world.point_world(which, own.start)
        delta = own.end - own.start
        rim = torch.isfinite(own.radius)[:, None]
        first = torch.where(rim, torch.linalg.cross(own.axis, own.start - own.centre), delta)
        radius = own.radius * world.scale[which]
        around = 2 * math.pi * torch.where(rim[:, 0], radius, torch.ones_like(radius))
        straight = torch.sqrt(torch.where(rim, torch.ones_like(delta), delta).square().sum(-1))
        parts.append(
            Edges(
                which,
                own.patch0,
                own.patch1,
                start,
                unit(world.direction_world(which, first)),
                torch.where(rim[:, 0], around, straight * world.scale[which]),
                world.direction_world(which, own.normal0),
                world.direction_world(which, own.normal1),
                world.point_world(which, torch.where(rim, own.centre, own.start)),
                radius,
            )
        )
    if not parts:
        return _none(world)
    every = Edges(*(torch.cat([getattr(p, n) for p in parts]) for n in Edges.__dataclass_fields__))
    return every.take(torch.nonzero(every.length >= LEAST * wavelength).squeeze(-1))


@torch.no_grad()
def stands_free(world: World, every: Edges, wavelength: float) -> Bool[Tensor, "e"]:
    """Which edges are free somewhere."""
    share = (torch.arange(LOOKS, dtype=torch.float64, device=world.device) + 0.5) / LOOKS
    look = every.take(torch.arange(len(every), device=world.device).repeat_interleave(LOOKS))
    free = is_free(world, look, (every.length[:, None] * share).reshape(-1), wavelength)
    return free.reshape(-1, LOOKS).any(1)


def _none(world: World) -> Edges:
    none = torch.zeros(0, dtype=torch.int64, device=world.device)
    zero = torch.zeros(0, dtype=torch.float64, device=world.device)
    flat = zero.reshape(0, 3)
    return Edges(none, none, none, flat, flat, zero, flat, flat, flat, zero)


@torch.no_grad()
def is_free(
    world: World, edges: Edges, t: Float[Tensor, "e"], wavelength: float
) -> Bool[Tensor, "e"]:
    """Whether all of the outside of a wedge is free of other objects close to a place on its edge.

    A wall's edge in the corner of a room, or flush with the next wall, is no edge to a wave.
    """
    place, _, _ = edges.point(t)
    normal0, normal1 = edges.normals(t)
    face0 = along_face(normal0, normal1)
    free = torch.ones(len(edges), dtype=torch.bool, device=t.device)
    for share in ACROSS:
        turn = (share * math.pi * edges.opening)[:, None]
        away = torch.cos(turn) * face0 + torch.sin(turn) * normal0
        for step in NEARBY:
            free &= ~_inside_another(world, edges.node, place + step * wavelength * away)
    return free


def _inside_another(world: World, node: Tensor, point: Tensor) -> Bool[Tensor, "m"]:
    """Points inside an object other than their own."""
    inside = torch.zeros(len(point), dtype=torch.bool, device=point.device)
    low, high = upright(world, torch.arange(len(world), device=node.device))
    for i in torch.arange(len(point), device=node.device).split(max(1, PAIRS // max(1, len(low)))):
        near = node[i, None] != torch.arange(len(low), device=node.device)
        for axis in range(3):
            place = point[i, axis, None]
            near &= (place > low[:, axis]) & (place < high[:, axis])
        row, which = torch.nonzero(near, as_tuple=True)
        row = i[row]
        local = world.point_object(which, point[row])
        bounds = world.bounds_object[which]
        held = ((local > bounds[:, 0]) & (local < bounds[:, 1])).all(-1)
        row, which = row[held], which[held]
        inside[row[world.sdf(which, point[row]) < 0]] = True
    return inside


def upright(world: World, which: Int[Tensor, "k"]) -> tuple[Float[Tensor, "k 3"], Tensor]:
    """Lowest and highest corners, in the world, of nodes' bounds; infinite where those are."""
    low, high = world.bounds_object[which].detach().unbind(1)
    bounded = (torch.isfinite(low) & torch.isfinite(high)).all(-1)[:, None]
    middle = torch.where(bounded, 0.5 * (low + high), 0.0)
    half = torch.where(bounded, 0.5 * (high - low), 0.0)
    centre = world.point_world(which, middle).detach()
    turned = torch.einsum("nij,nj->ni", world.rotation[which].detach().abs(), half)
    reach = turned * world.scale[which, None].detach() * (1 + WIDER) + WIDER
    reach = torch.where(bounded, reach, torch.inf)
    return centre - reach, centre + reach
