"""A learned shape, sketched: f and its gradient on a grid, for answers that will be checked.

The network has the last word on where a path rests, but most candidates are given up on the way, and a
sketch tells which at a tenth of the price. From the values f and gradients g at the corners x of a
cell, with w their trilinear weights at p,

    f(p) = sum w (f + g.(p - x) / 2),    grad f(p) = sum w g.

The sum of w f errs by half the second derivatives times the spread of the corners about p, the corners'
planes by as much the other way: of a quadratic f nothing is left of either. The grid is fine near the
surface, in blocks, and coarse elsewhere; beyond the bounds, where a network says nothing, f grows with
the distance to them.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.kept import state_of

BLOCK = 4  # fine cells along a coarse one
STEP = 0.012  # [m] of the fine grid, unless the shape is large
MOST_NODES = 1 << 15  # of the coarse grid
REACH = 1.1  # of half a block's diagonal: |f| less than this at its middle is near the surface
CHUNK = 1 << 13  # points at a time: what they need stays in the cache
TESTED = 4096  # points near the surface, at which the error is measured
MOST = 0.99  # of them err by less than ``error``
MOST_KEPT = 16


@dataclass(frozen=True)
class Table:
    """f [m] and its gradient [1] at nodes: a column each. ``offsets`` lead from the lowest corner of a
    cell to all eight, z first, then y."""

    step: float
    columns: Float[Tensor, "4 n"]
    offsets: tuple[int, ...]

    def blend(
        self, corner: Int[Tensor, "m"], within: list[Tensor]
    ) -> tuple[Float[Tensor, "m"], list[Tensor]]:
        """The sums above, of cells by their lowest corner and places in them from 0 to 1."""
        x, y, z = within
        at = [corner + n for n in self.offsets]
        means, planes = [], []
        for axis, column in enumerate(self.columns, -1):
            c = [column.index_select(0, i) for i in at]
            lines = [torch.lerp(c[i], c[i + 1], z) for i in (0, 2, 4, 6)]
            sides = [torch.lerp(lines[i], lines[i + 1], y) for i in (0, 2)]
            means.append(torch.lerp(sides[0], sides[1], x))
            if axis == 0:
                planes.append((sides[0] - sides[1]) * (x - x * x))
            elif axis == 1:
                planes.append(torch.lerp(lines[0] - lines[1], lines[2] - lines[3], x) * (y - y * y))
            elif axis == 2:
                d = [torch.lerp(c[i] - c[i + 1], c[i + 2] - c[i + 3], y) for i in (0, 4)]
                planes.append(torch.lerp(d[0], d[1], x) * (z - z * z))
        value, *gradient = means
        return value + (planes[0] + planes[1] + planes[2]) * (0.5 * self.step), gradient


@dataclass(frozen=True)
class Sketch:
    """See the module. block: a block's number in ``fine``, -1 far from the surface. error: what ``MOST``
    of the values near the surface err by at most [m], as tested."""

    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]
    step: float
    block: Int[Tensor, "bx by bz"]
    coarse: Table
    fine: Table
    error: float = math.inf

    def value_and_gradient(
        self, point: Float[Tensor, "m 3"]
    ) -> tuple[Float[Tensor, "m"], Float[Tensor, "m 3"]]:
        """f [m] and its gradient [1], nearly, in float32."""
        parts = [self._chunk(some) for some in point.float().split(CHUNK)]
        value, gradient = (torch.cat(column) for column in zip(*parts, strict=True))
        return value, gradient

    def _chunk(self, point: Tensor) -> tuple[Tensor, Tensor]:
        inside = torch.minimum(torch.maximum(point, self.low), self.high)
        place = ((inside - self.low) * (1.0 / (BLOCK * self.step))).unbind(-1)
        counts = self.block.shape
        home = [u.long().clamp_(max=n - 1) for u, n in zip(place, counts, strict=True)]
        local = [u - h for u, h in zip(place, home, strict=True)]
        number = self.block.view(-1).index_select(0, _flat(home, *counts[1:]))
        near = torch.nonzero(number >= 0).squeeze(-1)
        if len(near) == len(number):
            value, gradient = self._fine(number, local)
        else:
            corner = _flat(home, counts[1] + 1, counts[2] + 1)
            value, gradient = self.coarse.blend(corner, local)
            found = self._fine(number[near], [u[near] for u in local])
            value[near] = found[0]
            for slope, finer in zip(gradient, found[1], strict=True):
                slope[near] = finer
        away = point - inside
        far = away.norm(dim=-1)
        return value + far, torch.stack(gradient, -1) + away / far.clamp(min=TINY)[:, None]

    def _fine(self, number: Tensor, local: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        place = [u * BLOCK for u in local]
        cell = [u.long().clamp_(max=BLOCK - 1) for u in place]
        side = BLOCK + 1
        corner = _flat([number.long() * side + cell[0], *cell[1:]], side, side)
        return self.fine.blend(corner, [u - c for u, c in zip(place, cell, strict=True)])


TINY = 1e-12  # [m] beyond the bounds: no direction


def _flat(index: list[Tensor], y: int, z: int) -> Int[Tensor, "m"]:
    return (index[0] * y + index[1]) * z + index[2]


@torch.no_grad()
def sketch(shape: Shape, step: float | None = None) -> Sketch:
    """Sketch a shape with finite bounds. step: of the fine grid [m], by default ``STEP`` or what keeps
    the coarse one below ``MOST_NODES``."""
    low, high = shape.bounds().float()
    side = high - low
    least = float((side / BLOCK).double().prod() / MOST_NODES) ** (1 / 3)
    step = step or max(STEP, least)
    big = BLOCK * step
    counts = [math.ceil(n) for n in (side / big).tolist()]
    coarse = _grid([n + 1 for n in counts], low)
    middle = shape.sdf(low + big * (_grid(counts, low) + 0.5)).reshape(counts)
    near = middle.abs() <= REACH * (0.5 * 3**0.5) * big
    block = torch.full(counts, -1, dtype=torch.int32, device=low.device)
    block[near] = torch.arange(int(near.sum()), dtype=torch.int32, device=low.device)
    fine = _fine(shape, low, step, torch.nonzero(near), [BLOCK * n + 1 for n in counts])
    sides = counts[1] + 1, counts[2] + 1
    found = Sketch(
        low,
        low + big * torch.tensor(counts).to(low),
        step,
        block,
        Table(big, _columns(shape, low + big * coarse), _offsets(*sides)),
        Table(step, fine, _offsets(BLOCK + 1, BLOCK + 1)),
    )
    return replace(found, error=_error(shape, found))


def _error(shape: Shape, found: Sketch) -> float:
    """What ``MOST`` of the points within a step of the surface err by at most [m]."""
    generator = torch.Generator().manual_seed(0)
    share = torch.rand(TESTED, 3, generator=generator).to(found.low)
    low, high = shape.bounds().float()
    point = low + share * (high - low)
    for _ in range(TO_SURFACE):
        value, gradient = found.value_and_gradient(point)
        square = (gradient * gradient).sum(-1).clamp(min=LEAST_SLOPE)
        point = torch.minimum(
            torch.maximum(point - (value / square)[:, None] * gradient, low), high
        )
    off = (found.value_and_gradient(point)[0] - shape.sdf(point)).abs()
    return float(torch.quantile(off, MOST))


TO_SURFACE, LEAST_SLOPE = 3, 0.1  # Newton steps from anywhere, with slopes of at least (squared)


class Sketched:
    """A shape whose values and gradients are its sketch's, in float32, and all else its own."""

    def __init__(self, shape: Shape, found: Sketch):
        self.shape, self.value_and_gradient = shape, found.value_and_gradient

    def __getattr__(self, name: str) -> Any:
        return getattr(self.shape, name)


_KEPT: dict[int, tuple[object, Sketch]] = {}


def sketch_of(shape: Shape) -> Sketch | None:
    """The sketch of a network, kept while its parameters stay as they are; None of any other shape."""
    if shape.kind != "neural":
        return None
    state, kept = state_of(shape), _KEPT.get(id(shape))
    if kept is None or kept[0] != state:
        if len(_KEPT) >= MOST_KEPT:
            _KEPT.clear()
        kept = _KEPT[id(shape)] = (state, sketch(shape))
    return kept[1]


def _fine(
    shape: Shape, low: Tensor, step: float, home: Int[Tensor, "b 3"], counts: list[int]
) -> Float[Tensor, "4 n"]:
    """Columns of the blocks at ``home``; the nodes that neighbours share are asked for once."""
    node = (BLOCK * home[:, None] + _grid([BLOCK + 1] * 3, low).long()).reshape(-1, 3)
    number = (node[:, 0] * counts[1] + node[:, 1]) * counts[2] + node[:, 2]
    wanted = torch.zeros(counts, dtype=torch.bool, device=low.device)
    wanted.view(-1)[number] = True
    row = torch.cumsum(wanted.view(-1), 0, dtype=torch.int32) - 1
    return _columns(shape, low + step * torch.nonzero(wanted))[:, row[number]]


def _grid(counts: list[int], like: Tensor) -> Float[Tensor, "n 3"]:
    return torch.cartesian_prod(*[torch.arange(n, device=like.device) for n in counts]).to(like)


def _offsets(y: int, z: int) -> tuple[int, ...]:
    return tuple((i * y + j) * z + k for i in (0, 1) for j in (0, 1) for k in (0, 1))


def _columns(shape: Shape, point: Float[Tensor, "n 3"]) -> Float[Tensor, "4 n"]:
    value, gradient = shape.value_and_gradient(point)
    return torch.cat([value[None], gradient.T]).contiguous()
