"""The image method for whole chains of planar mirrors, many at a time; differentiable.

The planes of a scene are few and the chains many, so the planes are laid out once in the world and
each chain looks its own up. Everything runs in columns (``columns``).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import World
from rfsg.tracer.columns import Columns, at, columns, dot, minus, moved


@dataclass(frozen=True)
class Mirrors:
    """Every planar patch of a world, n.x = offset; ``first``: the row of each node's first one."""

    normal: Columns
    offset: Float[Tensor, "k"]
    first: Int[Tensor, "n"]


@dataclass(frozen=True)
class Folded:
    """Paths by the image method, by vertex: transmitter, mirrors, receiver. length [m] is that of the
    line from the last image, whose square root has no gradient where it is 0."""

    vertices: tuple[Columns, ...]
    normals: tuple[Columns, ...]
    length: Float[Tensor, "c"]


def mirrors_of(world: World) -> Mirrors:
    """The planes in the world; differentiable in poses and sizes."""
    count = world.planar_patches
    first = torch.cumsum(count, 0) - count
    node = torch.repeat_interleave(torch.arange(len(count), device=world.device), count)
    patch = torch.arange(len(node), device=world.device) - first[node]
    normal, offset, _ = world.plane(node, patch)
    return Mirrors(columns(normal), offset, first)


def folded(
    mirrors: Mirrors,
    which: Int[Tensor, "c d"],
    patch: Int[Tensor, "c d"],
    tx: Float[Tensor, "c 3"],
    rx: Float[Tensor, "c 3"],
) -> Folded:
    """Where paths meet the planes of their mirrors, from the first to the last."""
    image, target = columns(tx), columns(rx)
    ends, steps = (image, target), []
    for level in range(which.shape[1]):
        row = mirrors.first[which[:, level]] + patch[:, level]
        normal = at(mirrors.normal, row)
        height = dot(image, normal) - mirrors.offset[row]
        image = moved(image, -2.0 * height, normal)
        steps.append((image, normal, height))
    line = minus(target, image)
    square = dot(line, line)
    length = torch.sqrt(torch.where(square == 0, 1.0, square))
    points = []
    for image, normal, height in reversed(steps):
        # the image lies as far behind the plane as its original lay before it
        ray = minus(target, image)
        slope = dot(ray, normal)
        target = moved(image, height / torch.where(slope == 0, 1.0, slope), ray)
        points.append(target)
    normals = tuple(normal for _, normal, _ in steps)
    vertices = (ends[0], *reversed(points), ends[1])
    return Folded(vertices, normals, torch.where(square == 0, 0.0, length))


def stacked(points: tuple[Columns, ...]) -> Float[Tensor, "c k 3"]:
    """Columns as rows of points."""
    flat = torch.stack([x for point in points for x in point], -1)
    return flat.reshape(len(flat), len(points), 3)


@torch.no_grad()
def within_sides(
    world: World,
    which: Int[Tensor, "c"],
    patch: Int[Tensor, "c"],
    point: Columns,
    tolerance: Float[Tensor, "c"],
) -> Bool[Tensor, "c"]:
    """Whether points in the planes of rectangular faces are on those faces, to within ``tolerance``
    [m]: what the distance to the box would say, asked of the two sides that can say no."""
    low, high = world.bounds_object.unbind(1)
    bounded = torch.isfinite(low).all(-1) & torch.isfinite(high).all(-1)
    middle = torch.where(bounded[:, None], 0.5 * (low + high), 0.0)
    half = torch.where(bounded[:, None], 0.5 * (high - low), torch.inf) * world.scale[:, None]
    every = torch.arange(len(world), device=world.device)
    centre = columns(world.point_world(every, middle))
    away = minus(point, at(centre, which))
    square = torch.zeros_like(point[0])
    for axis in range(3):
        along = dot(at(columns(world.rotation[:, :, axis]), which), away)
        beyond = (along.abs() - half[which, axis]).clamp(min=0.0)
        across = torch.div(patch, 2, rounding_mode="floor") == axis
        square += torch.where(across, 0.0, beyond) ** 2
    return square <= tolerance**2
