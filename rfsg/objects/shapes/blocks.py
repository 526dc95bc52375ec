"""A sampled grid as ``Baked`` holds it: blocks of values, and what these say of f between them."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from rfsg.objects.shapes.band import BLOCK, Baked
from rfsg.objects.shapes.proxy import Sampled

ROUNDING = 1e-6  # [m] of a network in float32
CREASE = 2e-4  # [m] errors above this are those of a crease
BEND_SAFETY = 1.5  # of bounds by second differences over what these say


def blocks(
    sampled: Sampled,
) -> tuple[
    Int[Tensor, "bx by bz"], Float[Tensor, "k n"], Float[Tensor, "k c"], Float[Tensor, "k c"]
]:
    """Number of each busy block, its nodes' values [m], the errors of interpolating them [m], and how
    much the slope of f may change within a cell's length (``Baked.turn``)."""
    counts, side = sampled.busy.shape, BLOCK + 1
    values = sampled.values.astype(np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(values, (side,) * 3)
    busy = sampled.busy.numpy()
    nodes = windows[::BLOCK, ::BLOCK, ::BLOCK][busy]
    number = torch.full(counts, -1, dtype=torch.int32)
    number[sampled.busy] = torch.arange(len(nodes), dtype=torch.int32)
    straight = _bend(values)
    smooth = BEND_SAFETY / 8.0 * straight
    # at a crease linear interpolation may err by half a second difference, not by an eighth
    error = np.where(smooth < CREASE, smooth, 0.5 * straight) + ROUNDING
    turn = BEND_SAFETY / sampled.step * (straight + 2.0 * _twist(values))
    near = F.max_pool3d(torch.from_numpy(turn)[None], 3, 1, 1)[0]
    return (
        number,
        torch.from_numpy(nodes.reshape(len(nodes), -1)),
        torch.from_numpy(_in_blocks(error, busy)),
        torch.from_numpy(_in_blocks(near.numpy(), busy)),
    )


def corners(found: Baked) -> Float[Tensor, "8 k c"]:
    """Values at the corners of all cells."""
    k, side = len(found.values), BLOCK + 1
    nodes = found.values.view(k, side, side, side)
    ends = (slice(0, BLOCK), slice(1, side))
    return torch.stack([nodes[:, x, y, z].reshape(k, -1) for x in ends for y in ends for z in ends])


def places(found: Baked, block: Int[Tensor, "m"], cell: Int[Tensor, "m"]) -> Float[Tensor, "m 3"]:
    """The lowest corner of cells of blocks [m]."""
    home = torch.empty(len(found.values), 3)
    home[found.block[found.block >= 0].long()] = torch.nonzero(found.block >= 0).float()
    offset = torch.cartesian_prod(*[torch.arange(BLOCK)] * 3)[cell]
    return found.low + found.step * (BLOCK * home[block] + offset)


def rounded_up(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The least float16 numbers that are no smaller, in half the memory; at most their largest."""
    half = x.clamp(max=torch.finfo(torch.float16).max).half()
    return torch.where(half < x, torch.nextafter(half, torch.full_like(half, torch.inf)), half)


def _in_blocks(cells: Float[ndarray, "x y z"], busy: ndarray) -> Float[ndarray, "k c"]:
    split = cells.reshape([n for count in busy.shape for n in (count, BLOCK)])
    return split.transpose(0, 2, 4, 1, 3, 5)[busy].reshape(-1, BLOCK**3).astype(np.float32)


def _bend(values: Float[ndarray, "x y z"]) -> Float[ndarray, "x-1 y-1 z-1"]:
    """Sum over axes of the largest second difference at a cell's corners [m]. An eighth of it is what
    linear interpolation in each axis errs by; the mixed second derivatives it has right."""
    total = np.zeros([n - 1 for n in values.shape], dtype=np.float32)
    for axis in range(3):
        ends = [(1, 1) if k == axis else (0, 0) for k in range(3)]
        bend = np.pad(np.abs(np.diff(values, 2, axis)), ends, "edge")
        for along in range(3):
            bend = _larger_end(bend, along)
        total += bend
    return total


def _twist(values: Float[ndarray, "x y z"]) -> Float[ndarray, "x-1 y-1 z-1"]:
    """The largest mixed second difference on a cell's faces [m]."""
    most = np.zeros([n - 1 for n in values.shape], dtype=np.float32)
    for along in range(3):
        one, other = (axis for axis in range(3) if axis != along)
        mixed = np.abs(np.diff(np.diff(values, axis=one), axis=other))
        most = np.maximum(most, _larger_end(mixed, along))
    return most


def _larger_end(nodes: ndarray, axis: int) -> ndarray:
    """The larger of what stands at the two ends of each cell along an axis."""
    along = np.moveaxis(nodes, axis, 0)
    return np.moveaxis(np.maximum(along[:-1], along[1:]), 0, axis)
