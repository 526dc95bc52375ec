"""What rays ask of a baked shape (see ``baked``): its meshes, and values near its surface."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

WAYS = ("certain", "newton", "mesh", "grid")  # to meet a baked shape, dearest first
BLOCK = 4  # cells per side of a coarse block: one value decides about 64 cells
LEAST_TURN = 0.5  # [grid steps] f may turn as much in less: a crease has no length
BEYOND = 1e-6  # [m] past a cell's end, so that rounding leaves no ray on it


@dataclass(frozen=True)
class Surface:
    """A closed triangle mesh in the object's frame: vertices [m], outward triangles."""

    vertices: Float[Tensor, "v 3"]
    triangles: Int[Tensor, "t 3"]


@dataclass(frozen=True)
class Off:
    """How far off its face a way places hits, along the normal, of 99 % and at most [m]; and the share
    of the surface that it may lack."""

    usual: float
    most: float
    lost: float


@dataclass(frozen=True)
class Baked:
    """See the module. ``slope`` bounds |grad f| where |f| <= margin, ``lipschitz`` in all the bounds.

    gradient: grad f at the vertices of ``zero``. block: number of a block in ``values``, or -1 where
    only ``middle``, f at the block's middle, is known. error: of interpolated values [m], by cell.
    turn: how much the slope of f along a line may change within a length of one ``step`` [1], in a
    cell and those about it. offs: what each way to meet the shape errs by, see ``offs``.
    """

    key: str
    step: float
    margin: float
    slope: float
    lipschitz: float
    zero: Surface
    gradient: Float[Tensor, "v 3"]
    shell: Surface
    low: Float[Tensor, "3"]
    block: Int[Tensor, "bx by bz"]
    middle: Float[Tensor, "bx by bz"]
    values: Float[Tensor, "k n"]
    error: Float[Tensor, "k c"]
    turn: Float[Tensor, "k c"]
    offs: dict[str, "Off"]

    def look(self, point: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
        """(value, doubt): |f - value| <= doubt [m] at points within the bounds, in float32."""
        value, doubt, _ = self._look(point, 0.0, None)
        return value, doubt

    def look_ahead(
        self, point: Float[Tensor, "m 3"], direction: Float[Tensor, "m 3"]
    ) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"], Float[Tensor, "m"]]:
        """The same, and how far [m] f certainly keeps its sign along unit directions: to the end of the
        point's cell, or 0 where that is not known."""

        def ahead(near: Tensor, at: "At", value: Tensor, error: Tensor) -> Tensor:
            return self._way(at, direction.index_select(0, near).unbind(-1), value, error)

        return self._look(point, 0.0, ahead)

    def look_about(
        self, point: Float[Tensor, "m 3"]
    ) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"], Float[Tensor, "m"]]:
        """The same as ``look``, and ``turn`` there, endless where that is not known."""
        turn = self.turn.view(-1)
        return self._look(point, math.inf, lambda _near, at, *_: turn.index_select(0, at.cell))

    def _look(
        self, point: Tensor, unknown: float, more: Callable[..., Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        place = (point.float() - self.low).div_(self.step)
        x, y, z = place.unbind(-1)
        counts = self.block.shape
        home = [
            (u * (1.0 / BLOCK)).to(torch.int32).clamp_(0, n - 1)
            for u, n in zip((x, y, z), counts, strict=True)
        ]
        flat = (home[0] * counts[1] + home[1]).mul_(counts[2]).add_(home[2])
        number = self.block.view(-1).index_select(0, flat)
        value, doubt, third = torch.empty_like(x), torch.empty_like(x), torch.full_like(x, unknown)
        near, far = (torch.nonzero(c).squeeze(-1) for c in (number >= 0, number < 0))
        if len(near):
            within = [
                (u - BLOCK * h).index_select(0, near) for u, h in zip((x, y, z), home, strict=True)
            ]
            at = At.of(number.index_select(0, near), *within)
            found = self._linear(at.corner, at.within)
            error = self.error.view(-1).index_select(0, at.cell).float()
            value[near], doubt[near] = found, error
            if more is not None:
                third[near] = more(near, at, found, error).float()
        if len(far):
            middle = torch.stack([h.index_select(0, far) for h in home], -1).float().add_(0.5)
            away = (place.index_select(0, far) - BLOCK * middle).norm(dim=-1)
            value[far] = self.middle.view(-1).index_select(0, flat.index_select(0, far))
            # beyond the bounds the distance to them was added
            doubt[far] = away * (self.step * math.hypot(self.lipschitz, 1.0))
        return value, doubt, third

    def _linear(self, corner: Tensor, within: Sequence[Tensor]) -> Float[Tensor, "m"]:
        """Trilinear between the corners of cells, the lowest of which is given."""
        side, flat = BLOCK + 1, self.values.view(-1)
        x, y, z = within
        lines = []
        for offset in (0, side, side * side, side * side + side):
            one, other = (flat.index_select(0, corner + (offset + n)) for n in (0, 1))
            lines.append(torch.lerp(one, other, z))
        return torch.lerp(torch.lerp(lines[0], lines[1], y), torch.lerp(lines[2], lines[3], y), x)

    def _way(
        self, at: "At", direction: Sequence[Tensor], value: Tensor, error: Tensor
    ) -> Float[Tensor, "m"]:
        """How far to the cell's end [m], where f keeps its sign until there, else 0.

        Along a ray the interpolant g bends by |g''| <= 2 (|x y| + |y z| + |z x|) twist <= 2 twist, x, y,
        z its direction, so between two ends it is no nearer to 0 than both less twist s^2 / 4.
        """
        ends = [
            torch.where(d == 0, torch.inf, ((d > 0).float() - u) / d)
            for u, d in zip(at.within, direction, strict=True)
        ]
        s = torch.minimum(torch.minimum(ends[0], ends[1]), ends[2]).clamp_(min=0.0)
        there = [torch.addcmul(u, s, d) for u, d in zip(at.within, direction, strict=True)]
        last = self._linear(at.corner, there)
        bend = (s * s).mul_(self.twist.view(-1).index_select(0, at.cell)).mul_(0.25)
        least = torch.minimum(value.abs(), last.abs()) - error - bend
        keeps = (least > 0) & ((value < 0) == (last < 0))
        return torch.where(keeps, s * self.step + BEYOND, 0.0)

    @cached_property
    def twist(self) -> Float[Tensor, "k c"]:
        """The largest mixed second difference of a cell's corners [m], over pairs of axes."""
        side = BLOCK + 1
        nodes = self.values.view(-1, side, side, side)
        most = []
        for along in (1, 2, 3):
            one, other = (axis for axis in (1, 2, 3) if axis != along)
            mixed = nodes.diff(dim=one).diff(dim=other).abs_()
            ends = (mixed.narrow(along, n, BLOCK) for n in (0, 1))
            most.append(torch.maximum(*ends).reshape(self.error.shape))
        return torch.stack(most).amax(0)


class At(NamedTuple):
    """Cells of points: number, that of its lowest corner, and where in it [cells]."""

    cell: Int[Tensor, "m"]
    corner: Int[Tensor, "m"]
    within: tuple[Float[Tensor, "m"], ...]

    @staticmethod
    def of(number: Tensor, x: Tensor, y: Tensor, z: Tensor) -> "At":
        """Of points x, y, z cells from the lowest corner of their blocks."""
        side = BLOCK + 1
        i, j, k = (u.to(torch.int32).clamp_(0, BLOCK - 1) for u in (x, y, z))
        cell = (number * BLOCK + i).mul_(BLOCK).add_(j).mul_(BLOCK).add_(k)
        corner = (number * side + i).mul_(side).add_(j).mul_(side).add_(k)
        return At(cell, corner, (x - i, y - j, z - k))
