"""Marching a learned shape some steps at a time, on what was baked of it or by the network alone.

The steps are those of the plain march, |f| / L and not below the floor. On what was baked the network
is asked only next to the surface: |f| is first bounded from the baked grid, and where its value exceeds
its doubt the sign is known, and the bound is what is left. A cell at whose two ends, on the ray, it does
so by more than the values bend between is crossed at once. Elsewhere, a fraction of a millimetre from
the surface, the network answers. Without anything baked it answers everywhere. Either way a few rays
look several least steps ahead, as a call costs more than the points in it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import Baked

AT_ONCE = 2_048  # points looked at at once, of which the network is asked a part
ASKED_AT_ONCE = 256  # the same where it is asked of all: as many again cost as much as a call
DOUBLED = 4  # steps after which those left look twice as far ahead, once most have arrived
MOST_AHEAD = 32
WIDER = 2e-6  # [m] more than float32 rounds a length of 10 m by
RESTING = 0.85  # compact the march when this share of its rays, or less, is still under way


@dataclass(frozen=True)
class Brackets:
    """Sign changes of f along rays, in order of their slot: between t = a and b [m], with f (or about
    it, of the right sign) there; ``inside``: rays that begin where f < 0; ``count``: per ray."""

    row: Int[Tensor, "k"]
    slot: Int[Tensor, "k"]
    a: Float[Tensor, "k"]
    b: Float[Tensor, "k"]
    fa: Float[Tensor, "k"]
    fb: Float[Tensor, "k"]
    inside: Bool[Tensor, "m"]
    count: Int[Tensor, "m"]


def bracketed(
    shape: Shape,
    baked: Baked | None,
    start: Float[Tensor, "m 3"],
    direction: Float[Tensor, "m 3"],
    end: Float[Tensor, "m"],
    floor: float,
    most: int,
    ahead: int = 0,
) -> Brackets:
    """The first ``most`` sign changes on each ray, 0 <= t <= end [m], searched in float32.

    ahead: least steps looked ahead, at first; if given, what is found on a ray does not depend on how
    many others there are, which suits short stretches.
    """
    start, direction, end = start.float(), direction.float(), end.float()
    count = torch.zeros(len(end), dtype=torch.int64, device=end.device)
    at_once = ASKED_AT_ONCE if baked is None else AT_ONCE
    value, reach = signed(shape, baked, start, direction)
    inside = value < 0
    found: list[tuple[Tensor, ...]] = []
    row = torch.nonzero(end > 0).squeeze(-1)
    state = _take((start, direction, end, torch.zeros_like(end), value, reach), row)
    steps = 0
    while len(row):
        p0, d, last, t, value, reach = state
        first = t + reach.clamp(min=floor)
        more = ahead * 2 ** max(steps // DOUBLED - 2, 0) or max(at_once // len(row), 1)
        more, steps = min(more, MOST_AHEAD), steps + 1
        along = first[:, None] + floor * torch.arange(more, device=t.device)
        along = torch.minimum(along, last[:, None])
        point = torch.addcmul(p0[:, None], along[..., None], d[:, None])
        looked = signed(shape, baked, point.view(-1, 3), d.repeat_interleave(more, 0))
        there, reaches = (x.view(along.shape) for x in looked)
        t, value = torch.cat([t[:, None], along], 1), torch.cat([value[:, None], there], 1)
        flip = (value[:, 1:] < 0) != (value[:, :-1] < 0)
        i, k = torch.nonzero(flip, as_tuple=True)
        if len(i):
            slot = count[row[i]] + flip.cumsum(1)[i, k] - 1
            parts = (row[i], slot, t[i, k], t[i, k + 1], value[i, k], value[i, k + 1])
            found.append(_take(parts, torch.nonzero(slot < most).squeeze(-1)))
            count[row] = (count[row] + flip.sum(1)).clamp_(max=most)
        going = (t[:, -1] < last) & (count[row] < most)
        last = torch.where(going, last, t[:, -1])  # a ray that is done rests where it is
        state = (p0, d, last, t[:, -1], value[:, -1], reaches[:, -1])
        moving = torch.nonzero(going).squeeze(-1)
        if len(moving) <= RESTING * len(row):
            row, state = row[moving], _take(state, moving)
    if not found:
        none = end.new_zeros(0)
        return Brackets(row[:0], row[:0], none, none, none, none, inside, count)
    row, slot, a, b, fa, fb = (torch.cat(column) for column in zip(*found, strict=True))
    return Brackets(row, slot, a, b, fa, fb, inside, count)


def signed(
    shape: Shape, baked: Baked | None, point: Float[Tensor, "m 3"], direction: Float[Tensor, "m 3"]
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """(value, reach): f or about it, never of the wrong sign, and how far f certainly keeps its sign
    along the direction [m]."""
    if baked is None:
        value = shape.sdf(point)
        return value, value.abs() / shape.lipschitz
    value, doubt, way = baked.look_ahead(point, direction)
    bound = value.abs() - doubt
    near = torch.nonzero(bound <= 0).squeeze(-1)
    if len(near):
        exact = shape.sdf(point[near])
        value[near], bound[near] = exact, exact.abs()
    return value, torch.maximum(_step(baked, bound), way)


def _step(baked: Baked, bound: Tensor) -> Tensor:
    """How far f keeps its sign by its lower bound [m]: slower in the band near the surface."""
    near = bound.clamp(max=baked.margin)
    return near / baked.slope + (bound - near) / max(baked.lipschitz, baked.slope)


def _take(columns: tuple[Tensor, ...], i: Tensor) -> tuple[Tensor, ...]:
    return tuple(c.index_select(0, i) for c in columns)


def polished(
    shape: Shape,
    p0: Float[Tensor, "k 3"],
    d: Float[Tensor, "k 3"],
    found: Brackets,
    rounds: int,
    tolerance: float,
) -> Float[Tensor, "k"]:
    """Where f = 0 within each bracket, by the Illinois method (regula falsi that cannot stall), in
    the precision of ``p0``; each until |f| is within ``tolerance`` [m]."""
    a, b, fa, fb = (x.to(p0.dtype) for x in (found.a, found.b, found.fa, found.fb))
    if p0.dtype == torch.float64 and len(a):
        a, b, fa, fb = _widened(shape, p0, d, a, b, fa, fb)
    root, active = b.clone(), torch.arange(len(a), device=a.device)
    for _ in range(rounds):
        slope = fb - fa
        level = slope == 0
        c = torch.where(level, 0.5 * (a + b), (a * fb - b * fa) / torch.where(level, 1.0, slope))
        fc = shape.sdf(torch.addcmul(p0, c[:, None], d))
        crossed = (fc < 0) != (fb < 0)
        a, fa = torch.where(crossed, b, a), torch.where(crossed, fb, 0.5 * fa)
        b, fb = c, fc
        root[active] = b
        left = torch.nonzero(fc.abs() > tolerance).squeeze(-1)
        if not len(left):
            break
        if len(left) <= RESTING * len(a):
            active, a, b, fa, fb, p0, d = _take((active, a, b, fa, fb, p0, d), left)
    return root


def _widened(
    shape: Shape, p0: Tensor, d: Tensor, a: Tensor, b: Tensor, fa: Tensor, fb: Tensor
) -> tuple[Tensor, ...]:
    """Brackets found in float32, made to hold in float64, where they may lack what rounding took."""
    low, high = a - WIDER, b + WIDER
    ends = torch.cat([torch.addcmul(p0, t[:, None], d) for t in (low, high)])
    f_low, f_high = shape.sdf(ends).chunk(2)
    holds = ((f_low < 0) == (fa < 0)) & ((f_high < 0) == (fb < 0))
    pairs = ((low, a), (high, b), (f_low, fa), (f_high, fb))
    return tuple(torch.where(holds, new, old) for new, old in pairs)
