"""The image method: a point mirrored in planes, and the path from it folded back onto them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rfsg.scene.world import World

Mirrors = list[tuple[Tensor, Tensor]]  # (node [c], patch [c]) of each mirror, from the source on


@dataclass(frozen=True)
class Images:
    """A source's images, itself first, and the mirrors' planes."""

    points: tuple[Float[Tensor, "c 3"], ...]
    normal: Float[Tensor, "c d 3"]
    offset: Float[Tensor, "c d"]

    @property
    def image(self) -> Float[Tensor, "c 3"]:
        """The last of them: where the wave seems to come from."""
        return self.points[-1]


def images_of(world: World, mirrors: Mirrors, source: Float[Tensor, "c 3"]) -> Images:
    """The source mirrored in one plane after the other; differentiable."""
    points, planes = [source], [world.plane(*m)[:2] for m in mirrors]
    for normal, offset in planes:
        height = (points[-1] * normal).sum(-1) - offset
        points.append(points[-1] - 2.0 * height[:, None] * normal)
    none = source[:, None][:, :0]
    normal = torch.stack([n for n, _ in planes], 1) if planes else none
    offset = torch.stack([d for _, d in planes], 1) if planes else none[..., 0]
    return Images(tuple(points), normal, offset)


def fold(
    world: World, images: Images, mirrors: Mirrors, target: Float[Tensor, "c 3"]
) -> tuple[Float[Tensor, "c d 3"], Bool[Tensor, "c"]]:
    """Where the path from the source to a target meets its mirrors, and whether it meets each of
    them, from the front, on its own face."""
    points = unfolded(images, target)
    on = torch.ones(len(target), dtype=torch.bool, device=target.device)
    with torch.no_grad():
        ends = [images.points[0], *points.unbind(1), target]
        for level, (which, patch) in enumerate(mirrors):
            normal, offset, here = images.normal[:, level], images.offset[:, level], ends[level + 1]
            for end in (ends[level], ends[level + 2]):
                on &= (end * normal).sum(-1) - offset > 0
            size = world.size[which]
            on &= world.sdf(which, here).abs() <= 1e-9 * (size + here.abs().amax(-1))
            on &= world.patch(which, here) == patch
    return points, on


def unfolded(images: Images, target: Float[Tensor, "c 3"]) -> Float[Tensor, "c d 3"]:
    """Vertices on the mirrors' planes of the straight line from the last image to a target."""
    vertices: list[Tensor] = []
    for level in range(images.normal.shape[1] - 1, -1, -1):
        normal, offset = images.normal[:, level], images.offset[:, level]
        ray = target - images.points[level + 1]
        slope = (ray * normal).sum(-1)
        parallel = slope == 0
        t = (offset - (images.points[level + 1] * normal).sum(-1)) / torch.where(
            parallel, 1.0, slope
        )
        target = images.points[level + 1] + t[:, None] * ray
        vertices.insert(0, target)
    return torch.stack(vertices, 1) if vertices else images.normal
