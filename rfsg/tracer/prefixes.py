"""Sequences of planar faces as one source sees them: the image that they make of it, and its beam.

A planar mirror turns a source into an image, so whatever a sequence of them sends out seems to come
from one point through one rectangle: the next face must have that point in front of it and lie, at
least in part, in that beam.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.tracer.bounds import Carried, Floor
from rfsg.tracer.faces import Planes

EDGE = 1e-9  # of a face's extent: a path through a face's very edge belongs to it


class TooMany(Exception):
    """The scene has more sequences than an enumeration should take; search by rays instead."""


@dataclass(frozen=True)
class Prefixes:
    """Sequences of planar faces seen from one source: the image it makes and the faces, in order.

    carried: what they carry at most, where a floor is asked for.
    """

    image: Float[Tensor, "p 3"]
    faces: Int[Tensor, "p d"]
    carried: Carried | None = None

    def take(self, i: Tensor) -> "Prefixes":
        carried = None if self.carried is None else self.carried.take(i)
        return Prefixes(self.image[i], self.faces[i], carried)

    def above(self, floor: Floor | None) -> "Prefixes":
        """Those that nothing proves to lie below the floor, whatever follows."""
        if floor is None or self.carried is None:
            return self
        return self.take(torch.nonzero(self.carried.most >= floor.least).squeeze(-1))


class Budget:
    """Counts work and raises TooMany when it runs out."""

    def __init__(self, most: int):
        self.left = most

    def spend(self, amount: int) -> None:
        self.left -= amount
        if self.left < 0:
            raise TooMany


def levels(
    planes: Planes,
    source: Tensor,
    depth: int,
    budget: Budget,
    floor: Floor | None = None,
    whole: int = 0,
) -> list[Prefixes]:
    """Prefixes of 0, 1, ... depth faces from a source.

    floor: what lies below it is not extended, but for the first ``whole`` faces.
    """
    none = torch.zeros(1, 0, dtype=torch.int64, device=source.device)
    levels = [Prefixes(source[None], none, None if floor is None else floor.nothing())]
    for number in range(1, depth + 1):
        begun = levels[-1] if number <= whole else levels[-1].above(floor)
        levels.append(_extend(planes, begun, budget, floor))
    return levels


def _extend(planes: Planes, prefixes: Prefixes, budget: Budget, floor: Floor | None) -> Prefixes:
    p, k = len(prefixes.image), len(planes)
    budget.spend(p * k)
    parts = []
    block = max(1, 2_000_000 // max(k, 1))
    for begin in range(0, max(p, 1), block):
        some = prefixes.take(torch.arange(begin, min(p, begin + block), device=planes.node.device))
        front = some.image @ planes.normal.T - planes.offset > 0
        if prefixes.faces.shape[1]:
            front &= visible(planes, some)
        row, column = torch.nonzero(front, as_tuple=True)
        if prefixes.faces.shape[1]:
            kept = in_beam(planes, some, row, column)
            row, column = row[kept], column[kept]
        parts.append(_longer(planes, some.take(row), column, floor))
    if len(parts) == 1:
        return parts[0]
    carried = [p.carried for p in parts if p.carried is not None]
    return Prefixes(
        torch.cat([p.image for p in parts]),
        torch.cat([p.faces for p in parts]),
        Carried.joined(carried) if carried else None,
    )


def _longer(planes: Planes, some: Prefixes, face: Tensor, floor: Floor | None) -> Prefixes:
    """Prefixes with one more face each."""
    faces, carried = torch.cat([some.faces, face[:, None]], 1), None
    if floor is not None and some.carried is not None:
        carried = floor.extended(some.carried, some.image, faces)
    return Prefixes(mirror(planes, some.image, face), faces, carried)


def mirror(
    planes: Planes, point: Float[Tensor, "m 3"], face: Int[Tensor, "m"]
) -> Float[Tensor, "m 3"]:
    """Points mirrored in faces."""
    height = (point * planes.normal[face]).sum(-1) - planes.offset[face]
    return point - 2.0 * height[:, None] * planes.normal[face]


def visible(planes: Planes, prefixes: Prefixes) -> Bool[Tensor, "p k"]:
    """Faces with some corner on the outgoing side of the prefix's last face, and not that face."""
    last, row = torch.unique(prefixes.faces[:, -1], return_inverse=True)
    # only of the last faces at hand: of all faces at once it would be a table of gigabytes
    height = planes.normal[last] @ planes.corners().reshape(-1, 3).T
    highest = height.reshape(len(last), len(planes), 4).amax(-1)
    beyond = highest - planes.offset[last, None] > 0
    beyond[torch.arange(len(last), device=last.device), last] = False
    return beyond[row]


def in_beam(planes: Planes, prefixes: Prefixes, row: Tensor, face: Tensor) -> Bool[Tensor, "m"]:
    """Does the shadow of a face, cast from the image onto the last face, meet that face's rectangle?

    Corners behind the last face are pulled to just in front of it: the shadow then only grows.
    """
    last = prefixes.faces[row, -1]
    image, corner = prefixes.image[row], planes.corners()[face]
    normal, offset = planes.normal[last], planes.offset[last]
    near = (image * normal).sum(-1) - offset  # negative: images lie behind their mirror
    height = (corner * normal[:, None]).sum(-1) - offset[:, None]
    behind = height <= 0
    t = -near[:, None] / (height - near[:, None]).clamp(min=1e-12)
    shadow = image[:, None] + t[..., None] * (corner - image[:, None])
    local = shadow - planes.centre[last][:, None]
    uv = torch.einsum("mcj,mij->mci", local, planes.edges[last])
    half = planes.half[last] * (1 + EDGE)
    apart = (uv.amin(1) > half) | (uv.amax(1) < -half)
    return behind.any(1) | ~apart.any(1)
