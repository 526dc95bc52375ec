"""Points in a tree: which of them lie in which tubes?

The points are put in order along a Z-curve (Morton 1966), so that those next to each other in the
order are near each other in space; eight of them make a cell, eight cells a larger one, and so on up.
A cell that no part of a tube can reach is put aside with all that is in it.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.tracer.columns import Columns, at, columns, dot, minus

EIGHT = 8
TOP = 16  # cells at the top, at most
PIECE = 1 << 17  # (tube, cell) pairs at a time: what is known of them stays in the cache
BITS = 21  # of each coordinate: three of them fill 63
ROUNDING = 1e-7  # of a distance: half of a float64's digits are lost where squares cancel


class Places:
    """Points, their cells, the cells' cells: the balls of level 0 are the points themselves."""

    def __init__(self, point: Float[Tensor, "n 3"]):
        self.point = point
        self.number = torch.argsort(_along_a_curve(point), stable=True)
        low = high = point[self.number]
        self.centre, self.radius = [columns(low)], [torch.zeros_like(low[:, 0])]
        while len(low) > TOP:
            low, high = _eight(low).amin(1), _eight(high).amax(1)
            self.centre.append(columns(0.5 * (low + high)))
            self.radius.append(0.5 * (high - low).norm(dim=-1))

    def __len__(self) -> int:
        return len(self.number)

    def within(self, tubes: "Cones", most: float) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """(tube, point, miss) of every point that misses the axis of a tube by less than ``most``
        of its half-widths, in pieces of bounded size."""
        top = len(self.centre) - 1
        tube = torch.arange(len(tubes), device=tubes.width.device)
        cells = torch.arange(len(self.radius[top]), device=tube.device)
        step = max(1, PIECE // max(1, len(cells)))
        for some in tube.split(step) if len(cells) else ():
            left = [(top, some.repeat_interleave(len(cells)), cells.repeat(len(some)))]
            while left:
                level, i, cell = left.pop()
                if len(i) > PIECE:
                    left += [(level, *half) for half in zip(i.chunk(2), cell.chunk(2), strict=True)]
                    continue
                if level:
                    centre, radius = at(self.centre[level], cell), self.radius[level][cell]
                    kept = torch.nonzero(tubes.may_hold(i, centre, radius, most)).squeeze(-1)
                    left.append((level - 1, *self._inside(level, i[kept], cell[kept])))
                    continue
                miss = tubes.miss(i, at(self.centre[0], cell))
                kept = torch.nonzero(miss < most).squeeze(-1)
                yield i[kept], self.number[cell[kept]], miss[kept]

    def _inside(self, level: int, tube: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        """The cells of cells, each with its tube."""
        eight = torch.arange(EIGHT, device=cell.device)
        within = (EIGHT * cell[:, None] + eight).reshape(-1)
        tube = tube.repeat_interleave(EIGHT)
        if EIGHT * len(self.radius[level]) == len(self.radius[level - 1]):
            return tube, within
        there = torch.nonzero(within < len(self.radius[level - 1])).squeeze(-1)
        return tube[there], within[there]


class Cones:
    """Half-lines with a half-width that grows along them: ``width`` [m] and ``spread`` [m per m]."""

    def __init__(
        self,
        origin: Float[Tensor, "r 3"],
        direction: Float[Tensor, "r 3"],
        width: Float[Tensor, "r"],
        spread: Float[Tensor, "r"],
    ):
        self.origin, self.direction = columns(origin), columns(direction)
        self.width, self.spread = width, spread

    def __len__(self) -> int:
        return len(self.width)

    def miss(self, i: Int[Tensor, "m"], point: Columns) -> Float[Tensor, "m"]:
        """How far points lie from the axes of tubes, in half-widths there; inf for those behind."""
        along, across, _ = self._seen(i, point)
        width = self.width[i] + self.spread[i] * along
        return torch.where(along > 0, across / width.clamp(min=1e-300), torch.inf)

    def may_hold(
        self,
        i: Int[Tensor, "m"],
        centre: Columns,
        radius: Float[Tensor, "m"],
        most: float,
    ) -> Bool[Tensor, "m"]:
        """False where no point of a ball misses a tube by less than ``most``.

        From the ball's middle to any of its points neither coordinate changes by more than its radius.
        """
        along, across, distance = self._seen(i, centre)
        radius = radius + ROUNDING * distance
        widest = self.width[i] + self.spread[i] * (along + radius)
        return (along + radius > 0) & (across - radius <= most * widest)

    def _seen(self, i: Tensor, point: Columns) -> tuple[Tensor, Tensor, Tensor]:
        """Points along an axis, across it, and their distance."""
        away = minus(point, at(self.origin, i))
        along, square = dot(away, at(self.direction, i)), dot(away, away)
        return along, torch.sqrt((square - along**2).clamp(min=0.0)), square.sqrt()


def _eight(row: Float[Tensor, "n 3"]) -> Float[Tensor, "k 8 3"]:
    """Rows by eights; the last one fills up the last eight."""
    missing = -len(row) % EIGHT
    return torch.cat([row, row[-1:].expand(missing, 3)]).reshape(-1, EIGHT, 3)


def _along_a_curve(point: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Where points come on a Z-curve through the cube about them: the bits of their coordinates by
    turns."""
    if not len(point):
        return torch.zeros(0, dtype=torch.int64, device=point.device)
    low = point.amin(0)
    size = (point - low).amax().clamp(min=1e-300)
    cell = ((point - low) / size * (2**BITS - 1)).to(torch.int64)
    place = torch.zeros_like(cell[:, 0])
    for bit in range(BITS):
        for axis in range(3):
            place |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return place
