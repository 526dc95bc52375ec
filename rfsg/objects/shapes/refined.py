"""Splitting the edges of a zero mesh until it follows the surface: marching cubes cuts off edges at
the scale of its grid, and a chord cuts a curve."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Shape

# Corners 0 1 2 and midpoints 3 (of side 01), 4 (12), 5 (20). For the sides that are split, as bits
# 1, 2 and 4, the triangles that come instead; with two split sides the first cut is at a corner.
_TEMPLATES: dict[int, list[tuple[int, int, int]]] = {
    0: [(0, 1, 2)],
    1: [(0, 3, 2), (3, 1, 2)],
    2: [(0, 1, 4), (0, 4, 2)],
    4: [(0, 1, 5), (5, 1, 2)],
    3: [(3, 1, 4), (0, 3, 4), (0, 4, 2)],
    6: [(4, 2, 5), (0, 1, 4), (0, 4, 5)],
    5: [(0, 3, 5), (3, 1, 2), (3, 2, 5)],
    7: [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
}


@torch.no_grad()
def refined(
    shape: Shape,
    vertices: Float[Tensor, "v 3"],
    triangles: Int[Tensor, "t 3"],
    step: float,
    tolerance: float,
    rounds: int,
) -> tuple[Float[Tensor, "w 3"], Int[Tensor, "s 3"], Float[Tensor, "w 3"]]:
    """(vertices, triangles, gradient of f at the vertices) of a closed mesh whose vertices are
    polished by a Newton step of at most ``step`` [m], and whose edges are split in their middle, at
    most ``rounds`` times, where that is further than ``tolerance`` [m] from the surface."""
    point, gradient = polished(shape, vertices, step)
    triangles = triangles.long()
    asked = torch.ones(len(triangles), dtype=torch.bool)
    for k in range(rounds):
        ends, side = _edges(triangles, len(point))
        open_edges = torch.zeros(len(ends), dtype=torch.bool)
        open_edges[side[asked].flatten()] = True
        i = torch.nonzero(open_edges).squeeze(-1)
        middle = 0.5 * (point[ends[i, 0]] + point[ends[i, 1]])
        moved, slope = polished(shape, middle, step / 2 ** (k + 1))
        far = (moved - middle).norm(dim=-1) > tolerance
        if not bool(far.any()):
            break
        number = torch.full((len(ends),), -1, dtype=torch.int64)
        number[i[far]] = len(point) + torch.arange(int(far.sum()))
        point, gradient = torch.cat([point, moved[far]]), torch.cat([gradient, slope[far]])
        triangles, asked = _split(triangles, number[side])
    return point, triangles.int(), gradient


def polished(
    shape: Shape, vertices: Float[Tensor, "v 3"], most: float
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "v 3"]]:
    """Vertices after a Newton step of at most ``most`` [m], and the gradient where they came from,
    which is a fraction of a grid step away."""
    low, high = shape.bounds().float()
    point = vertices.to(low).clamp(low, high)
    value, gradient = shape.value_and_gradient(point)
    return (point - newton(value, gradient, most)).cpu(), gradient.cpu()


def newton(
    value: Float[Tensor, "v"], gradient: Float[Tensor, "v 3"], most: float
) -> Float[Tensor, "v 3"]:
    """What to take from points to come to the surface, at most ``most`` [m]."""
    square = (gradient * gradient).sum(-1).clamp(min=torch.finfo(gradient.dtype).tiny)
    length = value.abs() / square.sqrt()
    short = (most / length.clamp(min=most)) if most else torch.ones_like(length)
    return gradient * (value / square * short)[:, None]


def _edges(triangles: Tensor, vertices: int) -> tuple[Int[Tensor, "e 2"], Int[Tensor, "t 3"]]:
    """Ends of the edges, and the edges of each triangle's sides 01, 12, 20."""
    first, second = triangles, triangles.roll(-1, 1)
    code = torch.minimum(first, second) * vertices + torch.maximum(first, second)
    code, side = torch.unique(code, return_inverse=True)
    return torch.stack([code // vertices, code % vertices], -1), side


def _split(
    triangles: Int[Tensor, "t 3"], middle: Int[Tensor, "t 3"]
) -> tuple[Int[Tensor, "s 3"], Bool[Tensor, "s"]]:
    """Triangles with those of their sides split that have a middle (not -1), and which are new."""
    corner = torch.cat([triangles, middle], 1)
    kind = ((middle >= 0) * torch.tensor([1, 2, 4])).sum(1)
    parts, new = [], []
    for bits, template in _TEMPLATES.items():
        some = corner[kind == bits]
        made = some[:, torch.tensor(template)].reshape(-1, 3)
        parts.append(made)
        new.append(torch.full((len(made),), bits > 0))
    return torch.cat(parts), torch.cat(new)
