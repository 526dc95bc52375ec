"""The zero set of a shape as a mesh: what Embree searches and what other programs show.

The mesh is a picture of the shape, good to about a tenth of the grid step on smooth faces; edges
are cut off at the scale of the step. Whatever must be exact asks the shape itself.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from manifold3d import Manifold, Mesh64
from numpy import ndarray
from skimage.measure import marching_cubes
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import BLOCK

DEFAULT_STEPS = 100  # cells along the longest side, unless that makes them finer than FINEST
FINEST = 0.002  # [m]
MAX_NODES = 50_000_000  # 400 MB of float64; a finer grid is more likely a slip than a wish


def extract_mesh(
    shape: Shape, resolution: float | None = None, *, simplify: float | None = None
) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"], Float[ndarray, "v 3"]]:
    """Vertices [m], triangles (outward) and unit vertex normals of the surface sdf = 0.

    resolution: grid step [m], by default a hundredth of the longest side but not below 2 mm.
    Thinner things than the step may be lost. simplify: greatest distance [m] that vertices may be
    moved to save triangles (manifold3d); None keeps all. Vertices are polished by a Newton step.

    Only blocks that the shape's Lipschitz bound cannot rule out are sampled finely.
    Raises ValueError for an unbounded shape, a step that is not positive or makes too fine a grid,
    or a shape without a surface within its bounds.
    """
    sampled = sample_field(shape, resolution)
    vertices, faces = level_set(sampled, 0.0)
    vertices = _polish(shape, vertices, sampled.step)
    if simplify is not None:
        vertices, faces = simplified(vertices, faces, simplify)
    return vertices, faces, _normals(shape, vertices)


@dataclass(frozen=True)
class Sampled:
    """A shape's field on a grid: values [x y z] at the nodes low + index * step, [m].

    The grid is made of blocks of BLOCK cells a side. In those that are not ``busy`` the surface
    cannot be, and ``values`` repeat the field at the block's middle (``middle``).
    """

    low: Float[Tensor, "3"]
    step: float
    values: Float[ndarray, "x y z"]
    middle: Float[Tensor, "bx by bz"]
    busy: Bool[Tensor, "bx by bz"]


def sample_field(shape: Shape, resolution: float | None, band: float = 0.0) -> Sampled:
    """The field at all nodes where |f| may be ``band`` [m] or less, on a grid that reaches as far
    beyond the bounds. Raises ValueError as ``extract_mesh`` does."""
    low, step, blocks = _grid(shape, resolution, band)
    sampled = _sample(shape, low, step, blocks, band)
    if not (sampled.values.min() < 0 < sampled.values.max()):
        raise ValueError(
            f"{shape.kind} shape has no surface on a grid of {step:.4g} m within "
            f"{shape.bounds().tolist()}: it is empty, or thinner than the grid"
        )
    return sampled


def level_set(sampled: Sampled, level: float) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"]]:
    """Vertices [m] and triangles of the surface f = level, by marching cubes (Lewiner 2003)."""
    step = (sampled.step,) * 3
    vertices, faces, _, _ = marching_cubes(sampled.values, level, spacing=step)
    return vertices + sampled.low.numpy(), faces.astype(np.int64)


def simplified(
    vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "t 3"], tolerance: float
) -> tuple[Float[ndarray, "w 3"], Int[ndarray, "s 3"]]:
    """The closed mesh with fewer triangles, its surface moved by at most ``tolerance`` [m]; one that
    touches itself, as level sets through nodes of their grid may, stays as it is."""
    solid = Manifold(Mesh64(vertices.astype(np.float64), faces.astype(np.uint64)))
    if solid.is_empty():
        return vertices, faces
    raw = solid.simplify(tolerance).to_mesh64()
    return raw.vert_properties[:, :3].copy(), raw.tri_verts.astype(np.int64)


def _grid(
    shape: Shape, resolution: float | None, spare: float = 0.0
) -> tuple[Tensor, float, list[int]]:
    """Lowest node, step [m] and number of blocks of a grid with one cell and ``spare`` [m] or more
    beyond the bounds on each side."""
    low, high = shape.bounds().detach().to("cpu", torch.float64)
    if not bool((high - low).isfinite().all()):
        raise ValueError(f"{shape.kind} shape is unbounded: it has no mesh")
    step = resolution or max(float((high - low).max()) / DEFAULT_STEPS, FINEST)
    if not (step > 0 and math.isfinite(step)):
        raise ValueError(f"resolution={resolution!r}: expected a positive step in metres")
    low, high = low - spare, high + spare
    blocks = [math.ceil((side / step + 2) / BLOCK) for side in (high - low).tolist()]
    if math.prod(BLOCK * n + 1 for n in blocks) > MAX_NODES:
        raise ValueError(
            f"resolution={step:.3g} m needs more than {MAX_NODES} nodes: take a larger"
        )
    over = torch.tensor(blocks) * BLOCK * step - (high - low)
    return low - over / 2, step, blocks


def _sample(
    shape: Shape, low: Tensor, step: float, blocks: list[int], band: float = 0.0
) -> Sampled:
    """Field at all nodes; in blocks where |f| must exceed the band only its sign is right."""
    reach = band + shape.lipschitz * math.sqrt(3) * BLOCK * step / 2
    counts = torch.tensor(blocks)
    index = torch.cartesian_prod(*(torch.arange(n) for n in blocks)).reshape(-1, 3)
    middle = field_at(shape, low + (index + 0.5) * BLOCK * step).reshape(blocks)
    values = middle
    busy = middle.abs() <= reach
    for axis in range(3):
        values = values.repeat_interleave(BLOCK, axis)
        values = torch.cat([values, values.narrow(axis, values.shape[axis] - 1, 1)], axis)
    offsets = torch.cartesian_prod(*[torch.arange(BLOCK + 1)] * 3)
    nodes = (busy.nonzero()[:, None] * BLOCK + offsets).reshape(-1, 3)
    size = BLOCK * counts + 1
    flat = torch.unique((nodes[:, 0] * size[1] + nodes[:, 1]) * size[2] + nodes[:, 2])
    x, rest = flat // (size[1] * size[2]), flat % (size[1] * size[2])
    node = torch.stack([x, rest // size[2], rest % size[2]], -1)
    values = values.contiguous().reshape(-1)
    values[flat] = field_at(shape, low + node * step)
    return Sampled(low, step, values.reshape(tuple(size.tolist())).numpy(), middle, busy)


@torch.no_grad()
def field_at(shape: Shape, point: Tensor) -> Tensor:
    """sdf within the bounds; beyond them, where it means nothing, the distance to them is added."""
    box = shape.bounds().to(torch.float64)
    point = point.to(box.device)
    inside = point.clamp(box[0], box[1])
    # Searching needs no more than the precision of the weights.
    value = shape.sdf(inside.float()).double()
    return (value + (point - inside).norm(dim=-1)).cpu()


@torch.no_grad()
def _polish(shape: Shape, vertices: ndarray, step: float) -> ndarray:
    """One Newton step onto the zero set, by at most one grid step."""
    box = shape.bounds().to(torch.float64)
    point = torch.from_numpy(vertices).to(box).clamp(box[0], box[1])
    value, gradient = shape.value_and_gradient(point)
    square = (gradient * gradient).sum(-1)
    flat = square == 0
    move = gradient * (value / torch.where(flat, torch.ones_like(square), square))[:, None]
    length = move.norm(dim=-1, keepdim=True)
    move = move * torch.where(length > step, step / length.clamp(min=step), 1.0)
    return (point - move).cpu().numpy()


@torch.no_grad()
def _normals(shape: Shape, vertices: ndarray) -> ndarray:
    gradient = shape.value_and_gradient(torch.from_numpy(vertices).to(shape.bounds().device))[1]
    length = gradient.norm(dim=-1, keepdim=True)
    return (gradient / torch.where(length > 0, length, 1.0)).cpu().numpy()
