"""Rough faces cut into tiles, each with the points that integrate over it.

Planar faces: a grid, of which a tile is halved while it is large against its distance to either end of
the path, so that the four Gauss points of each tile integrate what a lobe and two distances make of
it. The grid and its halves are the face's own, so both ends cut it alike; a face without an end is cut
about the point between the two ends.

Curved and learned faces: straight lines on a lattice, along each axis of the object's own frame, meet
the surface at points with normal n. On a face seen along axis a a line stands for cell / |n_a| of area,
and n_x^2 + n_y^2 + n_z^2 = 1 shares every bit of surface among the three lattices without seam:

    integral of g dA = sum over lattices a and their meetings of g cell |n_a|.

Meetings in one cell of a coarser lattice, on one sheet, are a tile.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.scene.world import World, unit
from rfsg.tracer.faces import COARSE, Planes
from rfsg.tracer.march import march

GAUSS = 3.0**-0.5  # the two Gauss-Legendre points on [-1, 1], of equal weight
SUB = 4  # lines per tile and direction on curved faces
TIE = 1e-6  # relative: points of a lattice lie as near as each other but for rounding
CUT_OFF = 1e-6  # of the bounds' size
FINEST = 60  # halvings of a planar tile: a radio a nanometre above a kilometre of ground
UNBOUNDED = 32.0  # a face without an end reaches this many times the path's own size


class TooManyTiles(Exception):
    """More tiles than the budget."""


@dataclass(frozen=True)
class Tiles:
    """point, normal, area: what integrates over a tile. centre, upright: where a path meets it, and
    the normal there. number: which tile of its face, whichever radios ask."""

    node: Int[Tensor, "k"]
    patch: Int[Tensor, "k"]
    number: Int[Tensor, "k"]
    point: Float[Tensor, "k q 3"]
    normal: Float[Tensor, "k q 3"]
    area: Float[Tensor, "k q"]  # [m2]
    centre: Float[Tensor, "k 3"]
    upright: Float[Tensor, "k 3"]

    def __len__(self) -> int:
        return len(self.node)

    def take(self, i: Tensor) -> "Tiles":
        return Tiles(*(getattr(self, n)[i] for n in self.__dataclass_fields__))


@dataclass(frozen=True)
class Cells:
    """Tiles of planar faces before they have points: cell i of count 2^level along each edge."""

    row: Int[Tensor, "k"]  # which (face, source, target) asked
    level: Int[Tensor, "k 2"]
    index: Int[Tensor, "k 2"]

    def take(self, i: Tensor) -> "Cells":
        return Cells(*(getattr(self, n)[i] for n in self.__dataclass_fields__))


@dataclass(frozen=True)
class Grounds:
    """What is cut, for each (face, source, target): the rectangle about its centre, by its edges."""

    face: Int[Tensor, "m"]
    middle: Float[Tensor, "m 2"]  # of the rectangle, along the edges from the face's centre [m]
    half: Float[Tensor, "m 2"]  # [m]


def grounds_of(
    planes: Planes,
    face: Int[Tensor, "m"],
    source: Float[Tensor, "m 3"],
    target: Float[Tensor, "m 3"],
) -> Grounds:
    """Whole faces; of those without an end as much as matters between two points."""
    half = planes.half[face]
    between = 0.5 * (source + target) - planes.centre[face]
    foot = torch.einsum("mij,mj->mi", planes.edges[face], between)
    normal, offset = planes.normal[face], planes.offset[face]
    height = (source * normal).sum(-1) + (target * normal).sum(-1) - 2.0 * offset
    reach = UNBOUNDED * (height.abs() + (source - target).norm(dim=-1))
    bounded = torch.isfinite(half)
    return Grounds(
        face,
        torch.where(bounded, torch.zeros_like(foot), foot).detach(),
        torch.where(bounded, half, reach[:, None].detach()),
    )


@torch.no_grad()
def cut(
    planes: Planes,
    grounds: Grounds,
    source: Float[Tensor, "m 3"],
    target: Float[Tensor, "m 3"],
    coarsest: Float[Tensor, "m"],
    count: int,
    most: int,
) -> Cells:
    """Cells no larger than ``coarsest`` times their distance to the nearer end.

    count: cells along each edge to begin with. Raises TooManyTiles beyond ``most`` of them.
    """
    m, device = len(grounds.face), source.device
    if m * count * count > most:
        raise TooManyTiles
    line = torch.arange(count, device=device)
    grid = torch.cartesian_prod(line, line).reshape(-1, 2).repeat(m, 1)
    row = torch.arange(m, device=device).repeat_interleave(count * count)
    cells = Cells(row, torch.zeros_like(grid), grid)
    done, total = [], 0
    while len(cells.row):
        centre, half = _place(planes, grounds, cells, count)
        i = cells.row
        away = torch.minimum((source[i] - centre).norm(dim=-1), (target[i] - centre).norm(dim=-1))
        large = 2.0 * half.norm(dim=-1) > coarsest[i] * away
        large &= cells.level.sum(1) < FINEST
        done.append(cells.take(torch.nonzero(~large).squeeze(-1)))
        i = torch.nonzero(large).squeeze(-1)
        cells = _halved(cells.take(i), half[i])
        total += len(done[-1].row)
        if total + len(cells.row) > most:
            raise TooManyTiles
    empty = cells
    return Cells(
        *(torch.cat([getattr(c, n) for c in [*done, empty]]) for n in Cells.__dataclass_fields__)
    )


def _halved(cells: Cells, half: Tensor) -> Cells:
    """Every cell cut in two across its longer side."""
    longer = torch.nn.functional.one_hot(half.argmax(1), 2)
    level = cells.level + longer
    index = cells.index * (1 + longer)
    return Cells(cells.row.repeat(2), level.repeat(2, 1), torch.cat([index, index + longer]))


def _place(
    planes: Planes, grounds: Grounds, cells: Cells, count: int
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 2"]]:
    """Centres, and halves of the sides [m]."""
    i = cells.row
    number = count * torch.exp2(cells.level.to(grounds.half.dtype))
    along = (2.0 * cells.index + 1.0) / number - 1.0
    local = grounds.middle[i] + along * grounds.half[i]
    face = grounds.face[i]
    centre = planes.centre[face] + torch.einsum("ki,kij->kj", local, planes.edges[face])
    return centre, grounds.half[i] / number


def planar_tiles(planes: Planes, grounds: Grounds, cells: Cells, count: int) -> Tiles:
    """The cells as tiles of four Gauss points; differentiable where ``planes`` is."""
    centre, half = _place(planes, grounds, cells, count)
    face = grounds.face[cells.row]
    sign = torch.tensor([[-1, -1], [-1, 1], [1, -1], [1, 1]], dtype=half.dtype, device=half.device)
    reach = GAUSS * sign[None] * half[:, None]
    point = centre[:, None] + torch.einsum("kci,kij->kcj", reach, planes.edges[face])
    normal = planes.normal[face]
    return Tiles(
        planes.node[face],
        planes.patch[face],
        hashed(torch.cat([planes.patch[face][:, None], cells.level, cells.index], 1)),
        point,
        normal[:, None].expand_as(point),
        (half[:, 0] * half[:, 1])[:, None].expand(-1, 4),
        centre,
        normal,
    )


def curved_tiles(world: World, node: int, count: int) -> Tiles:
    """Tiles of a bounded object of any shape: about 6 count^2 of them on a convex one.

    Differentiable in pose and shape. Lines keep their place in the bounds of a shape with a closed
    form; the points of a learned one move along its normals.
    """
    place, slope, area, key = _meetings(world.scene.nodes[node].body.shape, count, world.device)
    tile, slot, keys, q = _slots(key)
    k = len(keys)
    which = torch.full((len(tile),), node, device=world.device)

    def laid_out(values: Tensor) -> Tensor:
        out = values.new_zeros(k, q, *values.shape[1:])
        return out.index_put((tile, slot), values)

    points = laid_out(world.point_world(which, place))
    normals = laid_out(world.direction_world(which, slope))
    areas = laid_out(area * world.scale[node] ** 2)
    each = torch.arange(k, device=world.device)
    middle = nearest(points, areas > 0, mean(points, areas))
    centre = points[each, middle]
    whose = torch.full((k,), node, device=world.device)
    with torch.no_grad():
        patch = world.patch(whose, centre)
    return Tiles(whose, patch, hashed(keys), points, normals, areas, centre, normals[each, middle])


def mean(point: Float[Tensor, "k q 3"], weight: Float[Tensor, "k q"]) -> Float[Tensor, "k 3"]:
    """Weighted mean; the origin where nothing weighs."""
    total = weight.sum(1).clamp(min=1e-300)
    return (point * weight[..., None]).sum(1) / total[:, None]


@torch.no_grad()
def nearest(
    point: Float[Tensor, "k q 3"], allowed: Bool[Tensor, "k q"], place: Float[Tensor, "k 3"]
) -> Int[Tensor, "k"]:
    """Which of a tile's allowed points lies nearest to a place; the first of those that tie."""
    away = (point - place[:, None]).norm(dim=-1)
    order = torch.arange(point.shape[1], device=point.device)
    return torch.where(allowed, away * (1.0 + TIE * order), torch.inf).argmin(1)


def hashed(key: Int[Tensor, "k c"]) -> Int[Tensor, "k"]:
    """A number from 0 to 2^47 - 1 for each row, without pattern (Steele et al. 2014, SplitMix64)."""
    rows = key.cpu().numpy().astype(np.uint64)
    state = np.zeros(len(rows), dtype=np.uint64)
    for column in rows.T:
        state = (state ^ column) + np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return torch.from_numpy((state >> np.uint64(17)).astype(np.int64)).to(key.device)


def _meetings(
    shape: Shape, count: int, device: torch.device
) -> tuple[Tensor, Tensor, Tensor, Int[Tensor, "m 5"]]:
    """Point, normal and area in the object's frame of every meeting, and the key of its tile."""
    parts = []
    low, high = shape.bounds().to(device=device, dtype=torch.float64)
    fine = count * SUB
    for axis in range(3):
        across = [a for a in range(3) if a != axis]
        side = (high - low)[across] / fine
        line = torch.arange(fine, device=device)
        grid = torch.cartesian_prod(line, line)
        origin = low.expand(len(grid), 3).clone()
        origin[:, across] += (grid + 0.5) * side
        for row, sheet, point in _ends(shape, origin, axis, float((high - low).detach()[axis])):
            point, grown = (point, 1.0) if shape.convex else _carried(shape, point)
            normal = _normal(shape, point)
            facing = normal[:, axis] if shape.convex else normal[:, axis].detach()
            label = torch.stack(
                [
                    torch.full_like(row, axis),
                    sheet,
                    (facing > 0).long(),
                    *(grid[row] // SUB).unbind(1),
                ],
                1,
            )
            parts.append((point, normal, side.prod() * facing.abs() * grown, label))
    point, normal, area, key = (torch.cat(c) for c in zip(*parts, strict=True))
    keep = area > 0
    return point[keep], normal[keep], area[keep], key[keep]


def _ends(
    shape: Shape, origin: Tensor, axis: int, length: float
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """(line, which stretch of the line, point) where lines along an axis enter, and where they leave."""
    direction = torch.zeros_like(origin)
    direction[:, axis] = 1.0
    with torch.no_grad():
        if shape.convex:
            enter, leave = shape.interval(origin, direction)
            row = torch.nonzero(leave > enter).squeeze(-1)
            enter, leave = enter[row], leave[row]
        else:
            whole = torch.full_like(origin[:, 0], length)
            row, enter, leave = march(shape, origin, direction, whole, COARSE)
            order = torch.argsort(row, stable=True)
            row, enter, leave = row[order], enter[order], leave[order]
        number = torch.arange(len(row), device=row.device)
        fresh = torch.ones_like(row, dtype=torch.bool)
        fresh[1:] = row[1:] != row[:-1]
        start = torch.where(fresh, number, torch.zeros_like(number))
        sheet = number - (torch.cummax(start, 0).values if len(row) else start)
    if shape.convex:
        enter, leave = shape.interval(origin[row], direction[row])  # of hits alone, with gradients
    for t in (enter, leave):
        i = torch.arange(len(row), device=row.device)
        if not shape.convex:  # where its bounds cut a shape off there is no surface
            i = torch.nonzero((t > CUT_OFF * length) & (t < (1 - CUT_OFF) * length)).squeeze(-1)
        here = row[i]
        yield here, sheet[i], origin[here] + t[i].to(origin)[:, None] * direction[here]


def _carried(shape: Shape, point: Tensor) -> tuple[Tensor, Tensor]:
    """Searched points of a marched shape put on the surface, and by what the area about them grows:
    both move with the surface, along its normal, and area grows by div n on the way."""
    with torch.no_grad():
        for _ in range(2):
            value, gradient = shape.value_and_gradient(point)
            slope = (gradient * gradient).sum(-1).clamp(min=1e-12)
            point = point - (value / slope)[:, None] * gradient
        one = torch.ones_like(point[:, 0])
    if not torch.is_grad_enabled():
        return point, one
    jet = shape.jet(point)
    steep = jet.gradient.norm(dim=-1).clamp(min=1e-6).detach()
    normal, bend = unit(jet.gradient).detach(), jet.hessian.detach()
    along = torch.einsum("mi,mij,mj->m", normal, bend, normal)
    spread = (bend.diagonal(dim1=1, dim2=2).sum(-1) - along) / steep
    move = -shape.sdf(point) / steep
    move = move - move.detach()
    return point + move[:, None] * normal, one + move * spread


def _normal(shape: Shape, point: Tensor) -> Tensor:
    own = getattr(shape, "normal_at", None)
    return own(point) if own else unit(shape.value_and_gradient(point)[1])


def _slots(key: Int[Tensor, "m 5"]) -> tuple[Tensor, Tensor, Int[Tensor, "k 5"], int]:
    """Tile of every meeting, its place in the tile, the tiles' keys, and the most places."""
    if not len(key):
        return key[:, 0], key[:, 0], key, 1
    keys, tile, size = torch.unique(key, dim=0, return_inverse=True, return_counts=True)
    order = torch.argsort(tile, stable=True)
    first = torch.cumsum(size, 0) - size
    slot = torch.empty_like(tile)
    slot[order] = torch.arange(len(tile), device=tile.device) - first[tile[order]]
    return tile, slot, keys, int(size.max())
