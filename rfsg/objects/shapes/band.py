"""What rays ask of a baked shape (see ``baked``): its meshes, and values near its surface."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

BLOCK = 4  # cells per side of a coarse block: one value decides about 64 cells


@dataclass(frozen=True)
class Surface:
    """A closed triangle mesh in the object's frame: vertices [m], outward triangles."""

    vertices: Float[Tensor, "v 3"]
    triangles: Int[Tensor, "t 3"]


@dataclass(frozen=True)
class Baked:
    """See the module. ``slope`` bounds |grad f| where |f| <= margin, ``lipschitz`` in all the bounds.

    level: f on the shell [m], at most the margin.

    gradient: grad f at the vertices of ``zero``. block: number of a block in ``values``, or -1 where
    only ``middle``, f at the block's middle, is known. error: of interpolated values [m], by cell.
    """

    key: str
    step: float
    margin: float
    level: float
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

    def look(self, point: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
        """(value, doubt): |f - value| <= doubt [m] at points within the bounds, in float32."""
        place = (point.float() - self.low).div_(self.step)
        x, y, z = place.unbind(-1)
        counts = self.block.shape
        home = [
            (u * (1.0 / BLOCK)).to(torch.int32).clamp_(0, n - 1)
            for u, n in zip((x, y, z), counts, strict=True)
        ]
        flat = (home[0] * counts[1] + home[1]).mul_(counts[2]).add_(home[2])
        number = self.block.view(-1).index_select(0, flat)
        value, doubt = torch.empty_like(x), torch.empty_like(x)
        near, far = (torch.nonzero(c).squeeze(-1) for c in (number >= 0, number < 0))
        if len(near):
            within = [
                (u - BLOCK * h).index_select(0, near) for u, h in zip((x, y, z), home, strict=True)
            ]
            value[near], doubt[near] = self._near(number.index_select(0, near), *within)
        if len(far):
            middle = torch.stack([h.index_select(0, far) for h in home], -1).float().add_(0.5)
            away = (place.index_select(0, far) - BLOCK * middle).norm(dim=-1)
            value[far] = self.middle.view(-1).index_select(0, flat.index_select(0, far))
            # beyond the bounds the distance to them was added
            doubt[far] = away * (self.step * math.hypot(self.lipschitz, 1.0))
        return value, doubt

    def _near(self, number: Tensor, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Of points at x, y, z cells from the lowest corner of their blocks: trilinear."""
        i, j, k = (u.to(torch.int32).clamp_(0, BLOCK - 1) for u in (x, y, z))
        x, y, z = x - i, y - j, z - k
        side, flat = BLOCK + 1, self.values.view(-1)
        corner = (number * side + i).mul_(side).add_(j).mul_(side).add_(k)
        lines = []
        for offset in (0, side, side * side, side * side + side):
            one, other = (flat.index_select(0, corner + (offset + n)) for n in (0, 1))
            lines.append(torch.lerp(one, other, z))
        value = torch.lerp(torch.lerp(lines[0], lines[1], y), torch.lerp(lines[2], lines[3], y), x)
        cell = (number * BLOCK + i).mul_(BLOCK).add_(j).mul_(BLOCK).add_(k)
        return value, self.error.view(-1).index_select(0, cell)
