"""Newton's method for one vertex on a quadric between two points, in columns.

Most chains with a learned face have no other one, and most candidates for them lead nowhere. The steps
are those of ``newton``, whose system of four unknowns is brought down by hand to two: along the
quadric's normal a step is given by the quadric alone, and what is left is a system in its tangent
plane, spanned by t1 = (1, 0, s1) and t2 = (0, 1, s2) with the slopes s of the quadric there.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rfsg.tracer.columns import Columns, at, columns, dot, minus
from rfsg.tracer.zone import Facets

PORTION = 1 << 14  # vertices at a time: columns that stay in the cache
NO_LENGTH = 1e-300  # [m] nothing is divided by less


@dataclass(frozen=True)
class Quadrics:
    """Quadrics w = c + a.uv + uv.P.uv / 2 and two ends of a path, in the quadrics' frames, by column;
    ``floor``: of a step that is the last."""

    height: Tensor
    slope: tuple[Tensor, Tensor]
    bend: tuple[Tensor, Tensor, Tensor]  # P's uu, uv, vv
    fore: Columns
    aft: Columns
    floor: Tensor

    def take(self, i: Tensor) -> "Quadrics":
        u, v = self.slope
        uu, uv, vv = self.bend
        return Quadrics(
            self.height[i],
            (u[i], v[i]),
            (uu[i], uv[i], vv[i]),
            at(self.fore, i),
            at(self.aft, i),
            self.floor[i],
        )


def stationary(
    facets: Facets,
    start: Float[Tensor, "m 3"],
    fore: Float[Tensor, "m 3"],
    aft: Float[Tensor, "m 3"],
    steps: int,
    share: float,
    floor: Float[Tensor, "m"],
) -> tuple[Float[Tensor, "m 3"], Bool[Tensor, "m"]]:
    """Where on each quadric the path between two points is stationary, and whether Newton's method has
    got there in so many steps: whether its last was below ``share`` of the path's length + ``floor``.

    All in the units and the frame of the facets' centres. Without gradients.
    """
    some = torch.arange(len(start), device=start.device).split(PORTION)
    found = [
        _stationary(facets, i, start[i], (fore[i], aft[i]), steps, share, floor[i]) for i in some
    ]
    if not found:
        return start.clone(), torch.zeros(0, dtype=torch.bool, device=start.device)
    place, settled = (torch.cat(column) for column in zip(*found, strict=True))
    return place, settled


def _stationary(
    facets: Facets,
    i: Tensor,
    start: Tensor,
    ends: tuple[Tensor, Tensor],
    steps: int,
    share: float,
    floor: Tensor,
) -> tuple[Tensor, Tensor]:
    frame, centre, bend = facets.frame[i], facets.centre[i], facets.bend[i]
    x, fore, aft = (columns(torch.einsum("mij,mj->mi", frame, p - centre)) for p in (start, *ends))
    slope = facets.slope[i]
    quadrics = Quadrics(
        facets.offset[i],
        (slope[:, 0].contiguous(), slope[:, 1].contiguous()),
        (bend[:, 0, 0].contiguous(), bend[:, 0, 1].contiguous(), bend[:, 1, 1].contiguous()),
        fore,
        aft,
        floor,
    )
    rest = torch.stack(x, -1)
    settled = torch.zeros(len(start), dtype=torch.bool, device=start.device)
    going = torch.arange(len(start), device=start.device)
    for _ in range(steps):
        x, now = _step(quadrics, x, share)
        rest[going], settled[going] = torch.stack(x, -1), now
        left = torch.nonzero(~now).squeeze(-1)
        if not len(left):
            break
        if 2 * len(left) < len(going):
            quadrics, x, going = quadrics.take(left), at(x, left), going[left]
    return centre + torch.einsum("mji,mj->mi", frame, rest), settled


def _step(q: Quadrics, x: Columns, share: float) -> tuple[Columns, Tensor]:
    """One step of each vertex, and whether it was its last."""
    pull = q.bend[0] * x[0] + q.bend[1] * x[1], q.bend[1] * x[0] + q.bend[2] * x[1]
    s1, s2 = q.slope[0] + pull[0], q.slope[1] + pull[1]
    value = x[2] - q.height - (q.slope[0] + 0.5 * pull[0]) * x[0]
    value = value - (q.slope[1] + 0.5 * pull[1]) * x[1]
    near, u = _towards(minus(x, q.fore))
    far, w = _towards(minus(q.aft, x))
    turn = minus(u, w)
    square = 1.0 + s1 * s1 + s2 * s2
    multiplier = (s1 * turn[0] + s2 * turn[1] - turn[2]) / square
    # the step along the normal (-s1, -s2, 1) that the quadric itself asks for
    drop = value / square
    n = (-s1 * drop, -s2 * drop, drop)
    # what is left, along t1 and t2
    ut, wt = ((v[0] + s1 * v[2], v[1] + s2 * v[2]) for v in (u, w))
    inverse = 1.0 / near, 1.0 / far
    both = inverse[0] + inverse[1]
    ui, wi = (ut[0] * inverse[0], ut[1] * inverse[0]), (wt[0] * inverse[1], wt[1] * inverse[1])
    h11 = (1.0 + s1 * s1) * both - ui[0] * ut[0] - wi[0] * wt[0] - multiplier * q.bend[0]
    h12 = s1 * s2 * both - ui[0] * ut[1] - wi[0] * wt[1] - multiplier * q.bend[1]
    h22 = (1.0 + s2 * s2) * both - ui[1] * ut[1] - wi[1] * wt[1] - multiplier * q.bend[2]
    un, wn = dot(u, n), dot(w, n)
    bent = q.bend[0] * n[0] + q.bend[1] * n[1], q.bend[1] * n[0] + q.bend[2] * n[1]
    r1 = ut[0] - wt[0] + ui[0] * un + wi[0] * wn + multiplier * bent[0]
    r2 = ut[1] - wt[1] + ui[1] * un + wi[1] * wn + multiplier * bent[1]
    det = h11 * h22 - h12 * h12
    y1, y2 = (h22 * r1 - h12 * r2) / det, (h11 * r2 - h12 * r1) / det
    step = (n[0] + y1, n[1] + y2, n[2] + s1 * y1 + s2 * y2)
    size = torch.sqrt(dot(step, step))
    regular = torch.isfinite(size)
    # no further than half a segment, nor than half a radius of curvature: Newton's model ends there
    bend = torch.sqrt(q.bend[0] ** 2 + 2.0 * q.bend[1] ** 2 + q.bend[2] ** 2)
    reach = 0.5 / torch.maximum(torch.maximum(*inverse), bend)
    taken = torch.where(size > reach, reach / size, 1.0)
    moved = tuple(torch.where(regular, p - taken * d, p) for p, d in zip(x, step, strict=True))
    last = regular & (size <= share * (near + far) + q.floor)
    return moved, last  # type: ignore[return-value]


def _towards(by: Columns) -> tuple[Tensor, Columns]:
    """Lengths and unit vectors."""
    length = torch.sqrt(dot(by, by)).clamp(min=NO_LENGTH)
    inverse = 1.0 / length
    return length, (by[0] * inverse, by[1] * inverse, by[2] * inverse)
