"""What is computed once of a learned shape, so that rays need not ask its network for it.

- the zero mesh (f = 0) with the gradient at its vertices: where a ray hits, nearly, and how steeply f
  falls there;
- values of f on a grid near the surface, in blocks, with a bound on the error of interpolation in
  each cell: far enough from the surface they tell the sign of f and a step that skips nothing; and
  with one on how much the slope of f changes nearby, which tells that a root is the only one;
- a closed shell outside it, as near as these errors allow: a ray that misses it misses the object;
- what hits of the stand-ins are wrong by (``offs``).

All bounds are tested, not proven: formal ones are useless for such a network at any practical size.
"""

import hashlib
import json
from dataclasses import replace

import torch
from torch.nn import functional as F

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import BLOCK, LEAST_TURN, Baked, Surface
from rfsg.objects.shapes.blocks import BEND_SAFETY, CREASE, blocks, corners, places, rounded_up
from rfsg.objects.shapes.offs import measured_offs
from rfsg.objects.shapes.proxy import FINEST, field_at, level_set, sample_field
from rfsg.objects.shapes.refined import newton, refined
from rfsg.objects.shapes.shell import SAFETY, shelled

VERSION = 2  # of the extraction: part of the key
COARSEST = 0.005  # [m]
CELLS = 200  # along the longest side, unless that makes them coarser or finer than allowed
BAND = 2.0  # [grid steps] that f, at its steepest, may change by where it is sampled finely
CHORD, SPLITS = 5e-5, 3  # [m] edges of the zero mesh further from the surface are split; times
MIDDLE_SAFETY = 2.5  # of the error at the middles of a cell and its neighbours,
OFF_MIDDLE = 0.1  # and the share of the bound that stays all the same
CLOSER = (0.1, 0.5, 0.9)  # of a cell's side, where errors at creases are measured again,
CLOSER_SAFETY = 1.5  # and of the largest of these
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
    margin = slope * BAND * step
    sampled = sample_field(shape, step, margin)
    number, values, error, turn = blocks(sampled)
    vertices, triangles = (torch.from_numpy(x) for x in level_set(sampled, 0.0))
    point, triangles, gradient = refined(shape, vertices.float(), triangles, step, CHORD, SPLITS)
    found = Baked(
        key_of(shape, step),
        step,
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
        turn,
        {},
    )
    found = _closer(shape, _measured(shape, found))
    found = _turned(shape, _tested(shape, found))
    found = replace(found, error=rounded_up(found.error), turn=rounded_up(found.turn))
    found = shelled(sampled, found)
    return replace(found, offs=measured_offs(shape, found))


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


def _measured(shape: Shape, found: Baked) -> Baked:
    """The same, with errors at creases, which second differences overstate, measured at the middles of
    cells instead: of those that the surface may be in."""
    k, ends = len(found.values), corners(found)
    some = (found.error > CREASE) & (ends.abs().amin(0) < 2.0 * found.error)
    block, cell = torch.nonzero(some, as_tuple=True)
    point = places(found, block, cell) + 0.5 * found.step
    off = torch.zeros_like(found.error)
    off[block, cell] = (field_at(shape, point).float() - ends.mean(0)[block, cell]).abs()
    # a crease may be at its worst beside the middle: the worst of the neighbours, and a margin
    spread = F.max_pool3d(off.view(k, 1, BLOCK, BLOCK, BLOCK), 3, 1, 1).view(k, -1)
    measured = MIDDLE_SAFETY * spread + OFF_MIDDLE * found.error
    return replace(found, error=torch.where(some, measured, found.error))


def _closer(shape: Shape, found: Baked) -> Baked:
    """The same, with errors at creases measured at 27 places of each cell that the surface may still be
    in: they decide how near the shell comes, and how often rays ask the network."""
    ends = corners(found)
    doubtful = (ends.amin(0) <= found.error) & (ends.amax(0) >= -found.error)
    block, cell = torch.nonzero(doubtful & (found.error > CREASE), as_tuple=True)
    if not len(block):
        return found
    share = torch.cartesian_prod(*[torch.tensor(CLOSER)] * 3)
    point = places(found, block, cell)[:, None] + found.step * share
    value = field_at(shape, point.reshape(-1, 3)).float().view(len(block), -1)
    sides = torch.stack([1.0 - share, share])  # weights of low and high corners, by axis
    x, y, z = sides.unbind(-1)
    weight = (x[:, None, None] * y[:, None] * z).flatten(0, 2)
    worst = (value - ends[:, block, cell].t() @ weight).abs().amax(1)
    error = found.error.clone()
    error[block, cell] = torch.minimum(
        CLOSER_SAFETY * worst + OFF_MIDDLE * error[block, cell], error[block, cell]
    )
    return replace(found, error=error)


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


def _turned(shape: Shape, found: Baked) -> Baked:
    """The same, ``turn`` raised to what lines from the surface need, should it not hold there."""
    generator = torch.Generator().manual_seed(5)
    count = min(TESTED, len(found.zero.vertices))
    some = torch.randperm(len(found.zero.vertices), generator=generator)[:count]
    direction = F.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    length = torch.rand(count, generator=generator)
    low, high = shape.bounds().float()
    ends = found.zero.vertices[some]
    ends = torch.stack([ends, ends + found.step * length[:, None] * direction]).to(low)
    slope = (shape.value_and_gradient(ends.clamp(low, high))[1].cpu() * direction).sum(-1)
    allowed = found.look_about(ends[0].cpu())[2] * length.clamp(min=LEAST_TURN)
    worst = float(((slope[1] - slope[0]).abs() / allowed).max())
    return replace(found, turn=found.turn * SAFETY * worst) if worst > 1.0 else found
