"""What is computed once of a learned shape, so that rays need not ask its network for it.

- the zero mesh (f = 0) with the gradient at its vertices: where a ray hits, nearly, and how steeply f
  falls there;
- a closed shell outside it, f = level: a ray that misses it misses the object. Marching cubes keeps
  every cell whose corners are below the level, so none of the surface is lost when that is
  sqrt(3) L h (h the grid step, L a bound on |grad f| near the surface), or, which is less, more than
  interpolated values err by wherever the surface may be;
- values of f on a grid near the surface, in blocks, with a bound on the error of interpolation in
  each: far enough from the surface they tell the sign of f and a step that skips nothing.

Both bounds are tested, not proven: formal ones are useless for such a network at any practical size.
"""

import hashlib
import json
import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import BLOCK, Baked, Surface
from rfsg.objects.shapes.proxy import (
    FINEST,
    Sampled,
    field_at,
    level_set,
    sample_field,
    simplified,
)
from rfsg.objects.shapes.refined import newton, refined

VERSION = 1  # of the extraction: part of the key
COARSEST = 0.005  # [m]
CELLS = 200  # along the longest side, unless that makes them coarser or finer than allowed
SHELL_MOVED = 0.25  # [grid steps] that the shell may be moved by to save triangles
SAFETY = 1.25  # of the slope bound over the steepest found, as in ``compute_lipschitz``
CHORD, SPLITS = 5e-5, 3  # [m] edges of the zero mesh further from the surface are split; times
ROUNDING = 1e-6  # [m] of a network in float32
CREASE = 2e-4  # [m] errors above this are measured
MIDDLE_SAFETY = 2.5  # of the error at the middles of a cell and its neighbours,
OFF_MIDDLE = 0.1  # and the share of the bound that stays all the same
BEND_SAFETY = 1.5  # of the error bound of interpolation over what second differences say
TESTED = 16_384  # points that slope and error bounds are tested on
MOST_NODES = 20_000_000  # of a grid, before its step grows


def default_step(shape: Shape) -> float:
    """Grid step [m]: 5 mm, finer for small objects, coarser where memory would not hold it."""
    low, high = shape.bounds().detach().to("cpu", torch.float64)
    side = high - low
    step = min(max(float(side.max()) / CELLS, FINEST), COARSEST)
    return max(step, float(side.prod() / MOST_NODES) ** (1 / 3))


@torch.no_grad()
def bake(shape: Shape, step: float | None = None) -> Baked:
    """Sample a learned shape and extract what ``Baked`` holds.

    step: grid step [m], by default ``default_step``. Thinner things than the step may be missing
    from the zero mesh, not from the shell. Raises ValueError as ``proxy.extract_mesh`` does.
    """
    step = step or default_step(shape)
    slope = SAFETY * _steepest(shape, 4.0 * step)
    margin = slope * (math.sqrt(3.0) + SHELL_MOVED) * step
    sampled = sample_field(shape, step, margin)
    number, values, error = _blocks(sampled)
    vertices, triangles = (torch.from_numpy(x) for x in level_set(sampled, 0.0))
    point, triangles, gradient = refined(shape, vertices.float(), triangles, step, CHORD, SPLITS)
    found = Baked(
        key_of(shape, step),
        step,
        margin,
        margin,
        slope,
        float(getattr(shape, "lipschitz", slope)),
        Surface(point, triangles),
        gradient,
        Surface(point, triangles),
        sampled.low.float(),
        number,
        sampled.middle.float(),
        values,
        error,
    )
    return _in_shell(sampled, _tested(shape, _measured(shape, found)))


def _in_shell(sampled: Sampled, found: Baked) -> Baked:
    """The same in the tightest shell that its errors allow, in place of the one it came with."""
    moved = SHELL_MOVED * found.step
    least = _corners(found).abs().amin(0)
    worst = found.error[least <= found.error]
    level = SAFETY * float(worst.max()) + found.slope * moved if len(worst) else found.margin
    level = min(level, found.margin)
    vertices, triangles = simplified(*level_set(sampled, level), moved)
    shell = Surface(torch.from_numpy(vertices).float(), torch.from_numpy(triangles).int())
    return replace(found, level=level, shell=shell)


def key_of(shape: Shape, step: float) -> str:
    """sha256 of the architecture, the weights and the extraction's settings, hexadecimal."""
    head = {"kind": shape.kind, "config": shape.config(), "step": step, "version": VERSION}
    head |= {"safety": SAFETY, "bend": BEND_SAFETY, "block": BLOCK}
    digest = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
    for name, tensor in sorted(getattr(shape, "state_dict", dict)().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _steepest(shape: Shape, reach: float) -> float:
    """The largest |grad f| found within ``reach`` [m] of the surface, and on it."""
    low, high = shape.bounds().float()
    generator = torch.Generator().manual_seed(0)
    point = low + (high - low) * torch.rand(TESTED, 3, generator=generator).to(low)
    for _ in range(2):
        move = newton(*shape.value_and_gradient(point), 0.1 * float((high - low).max()))
        point = (point - move).clamp(low, high)
    jitter = reach * F.normalize(torch.randn(TESTED, 3, generator=generator), dim=-1).to(low)
    jitter = jitter * torch.rand(TESTED, 1, generator=generator).to(low)
    point = torch.cat([point, (point + jitter).clamp(low, high)])
    return float(shape.value_and_gradient(point)[1].norm(dim=-1).max())


def _blocks(sampled: Sampled) -> tuple[Tensor, Tensor, Tensor]:
    """Number of each busy block, its nodes' values, and the error of interpolating them."""
    counts, side = sampled.busy.shape, BLOCK + 1
    values = sampled.values.astype(np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(values, (side,) * 3)
    busy = sampled.busy.numpy()
    nodes = windows[::BLOCK, ::BLOCK, ::BLOCK][busy]
    number = torch.full(counts, -1, dtype=torch.int32)
    number[sampled.busy] = torch.arange(len(nodes), dtype=torch.int32)
    cells = _bend(values).reshape([n for count in counts for n in (count, BLOCK)])
    cells = cells.transpose(0, 2, 4, 1, 3, 5)[busy].reshape(len(nodes), -1)
    bend = torch.from_numpy(cells)
    smooth = BEND_SAFETY / 8.0 * bend
    # at a crease linear interpolation may err by half a second difference, not by an eighth
    error = torch.where(smooth < CREASE, smooth, 0.5 * bend).add_(ROUNDING)
    return number, torch.from_numpy(nodes.reshape(len(nodes), -1)), error


def _bend(values: Float[ndarray, "x y z"]) -> Float[ndarray, "x-1 y-1 z-1"]:
    """Sum over axes of the largest second difference at a cell's corners [m]. An eighth of it is what
    linear interpolation in each axis errs by; the mixed second derivatives it has right."""
    total = np.zeros([n - 1 for n in values.shape], dtype=np.float32)
    for axis in range(3):
        ends = [(1, 1) if k == axis else (0, 0) for k in range(3)]
        bend = np.pad(np.abs(np.diff(values, 2, axis)), ends, "edge")
        for along in range(3):
            one, other = (np.moveaxis(bend, along, 0)[part] for part in (slice(-1), slice(1, None)))
            bend = np.moveaxis(np.maximum(one, other), 0, along)
        total += bend
    return total


def _measured(shape: Shape, found: Baked) -> Baked:
    """The same, with errors at creases, which second differences overstate, measured at the middles of
    cells instead: of those that the surface may be in."""
    k, corners = len(found.values), _corners(found)
    mean, least = corners.mean(0), corners.abs().amin(0)
    some = (found.error > CREASE) & (least < 2.0 * found.error)
    block, cell = torch.nonzero(some, as_tuple=True)
    home = torch.empty(k, 3)
    home[found.block[found.block >= 0].long()] = torch.nonzero(found.block >= 0).float()
    offset = torch.cartesian_prod(*[torch.arange(BLOCK)] * 3)[cell]
    point = found.low + found.step * (BLOCK * home[block] + offset + 0.5)
    off = torch.zeros_like(found.error)
    off[block, cell] = (field_at(shape, point).float() - mean[block, cell]).abs()
    # a crease may be at its worst beside the middle: the worst of the neighbours, and a margin
    spread = F.max_pool3d(off.view(k, 1, BLOCK, BLOCK, BLOCK), 3, 1, 1).view(k, -1)
    measured = MIDDLE_SAFETY * spread + OFF_MIDDLE * found.error
    return replace(found, error=torch.where(some, measured, found.error))


def _corners(found: Baked) -> Float[Tensor, "8 k c"]:
    """Values at the corners of all cells."""
    k, side = len(found.values), BLOCK + 1
    nodes = found.values.view(k, side, side, side)
    ends = (slice(0, BLOCK), slice(1, side))
    return torch.stack([nodes[:, x, y, z].reshape(k, -1) for x in ends for y in ends for z in ends])


def _tested(shape: Shape, found: Baked) -> Baked:
    """The same, its errors raised to what points at the surface need, should they not hold there."""
    generator = torch.Generator().manual_seed(1)
    count = min(TESTED, len(found.zero.vertices))
    some = torch.randperm(len(found.zero.vertices), generator=generator)[:count]
    jitter = (2.0 * torch.rand(count, 3, generator=generator) - 1.0) * found.margin
    low, high = shape.bounds().float().cpu()
    point = (found.zero.vertices[some] + jitter).clamp(low, high)
    value, doubt = found.look(point)
    off = (shape.sdf(point.to(shape.bounds().device)).cpu() - value).abs()
    short, uneven = off / doubt, doubt > CREASE
    worst = [float(short[some].max()) if bool(some.any()) else 0.0 for some in (~uneven, uneven)]
    even, rough = (SAFETY * w if w > 1.0 else 1.0 for w in worst)
    return replace(found, error=found.error * torch.where(found.error > CREASE, rough, even))
