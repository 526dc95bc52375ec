"""A closed shell close about a baked shape: a ray that misses it misses the object.

f > 0 wherever the interpolated values exceed their error. So the shell is the zero set of g = values
less errors: an error at a node is the largest of the cells it belongs to, hence no smaller anywhere in
them than their own. Marching cubes keeps all cells one of whose corners is below zero and is exact on
their edges; within a cell it errs by what the corners are twisted by, which is taken off too, as is
what the shell is moved by to save triangles. On a smooth face the shell is a few hundredths of a
millimetre off, at a crease it keeps away by what the values may err by there.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from rfsg.objects.shapes.band import BLOCK, Baked, Surface
from rfsg.objects.shapes.proxy import Sampled, level_set, simplified

MOVED = 0.01  # [grid steps] that the shell may be moved by to save triangles
SAFETY = 1.25  # of errors over those that were tested


def shelled(sampled: Sampled, found: Baked) -> Baked:
    """The same in its shell, in place of the one it came with."""
    moved = MOVED * found.step
    # half a twist: a quarter in each of the two ways that a cell's triangles may cut a saddle
    cells = SAFETY * found.error.float() + 0.5 * found.twist
    away = _at_nodes(_whole(found, cells)) + np.float32(found.slope * moved)
    lowered = replace(sampled, values=_closed(sampled.values - away, found.margin))
    vertices, triangles = simplified(*level_set(lowered, 0.0), moved)
    shell = Surface(torch.from_numpy(vertices).float(), torch.from_numpy(triangles).int())
    return replace(found, shell=shell)


def _closed(values: Float[ndarray, "x y z"], margin: float) -> Float[ndarray, "x y z"]:
    """The same, outside at the ends of the grid, which are a margin beyond the bounds."""
    for axis in range(3):
        along = np.moveaxis(values, axis, 0)  # a view
        for end in (0, -1):
            np.maximum(along[end], margin, out=along[end])
    return values


def _whole(found: Baked, cells: Float[torch.Tensor, "k c"]) -> Float[ndarray, "x y z"]:
    """Cells of blocks on the whole grid, 0 where there is no block."""
    busy, side = found.block >= 0, (BLOCK,) * 3
    grid = torch.zeros(*found.block.shape, *side)
    grid[busy] = cells.view(-1, *side)[found.block[busy].long()]
    size = [n * BLOCK for n in found.block.shape]
    return grid.permute(0, 3, 1, 4, 2, 5).reshape(size).numpy()


def _at_nodes(cells: Float[ndarray, "x y z"]) -> Float[ndarray, "x+1 y+1 z+1"]:
    """The largest of the cells that meet at each node."""
    for axis in range(3):
        ends = [(1, 1) if k == axis else (0, 0) for k in range(3)]
        along = np.moveaxis(np.pad(cells, ends), axis, 0)
        cells = np.moveaxis(np.maximum(along[:-1], along[1:]), 0, axis)
    return cells
