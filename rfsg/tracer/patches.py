"""Where a radio map is read: triangles just off the surface of an object, or of a mesh."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.mesh import Mesh
from rfsg.scene.scene import SceneError
from rfsg.scene.world import World, unit
from rfsg.tracer.beams import Rows
from rfsg.tracer.cells import GRAZING, MOST_CELLS, Meeting
from rfsg.tracer.records import Rays

SMOOTH = 0.05  # of a cell: how far a mesh may be off the true surface
POLISH = 4  # Newton steps that bring a cell's middle onto the true surface
LARGEST = 3**0.5 / 4  # area of the largest triangle with sides of at most 1
TESTS = 1 << 21  # ray-triangle tests at a time


@dataclass(frozen=True)
class Patches:
    """Triangles just off a surface, on its outer side, and the cell that each belongs to (``owner``).

    name: what the surface belongs to, for titles and files. point: a place in each cell, just as far
    off the surface, for the path solver; normal: outward there.
    """

    name: str
    triangle: Float[Tensor, "k 3 3"]
    owner: Int[Tensor, "k"]
    point: Float[Tensor, "c 3"]
    normal: Float[Tensor, "c 3"]

    @property
    def shape(self) -> tuple[int]:
        return (len(self.point),)

    @property
    def subarea(self) -> Float[Tensor, "k"]:
        """Areas of the triangles [m^2]."""
        return 0.5 * _cross(self.triangle).norm(dim=-1)

    @property
    def rows(self) -> Rows:
        """The places, each a row of its own."""
        return Rows(self.point, torch.zeros_like(self.point[:1]).sum(0), 1)

    @property
    def area(self) -> Float[Tensor, "c"]:
        zero = torch.zeros(len(self.point), dtype=torch.float64, device=self.owner.device)
        return zero.index_add(0, self.owner, self.subarea)

    def meet(self, rays: Rays) -> Meeting:
        """Every crossing of a ray and a triangle."""
        triangle = self.triangle.to(rays.origin)
        middle = triangle.mean((0, 1))  # about it, far-off origins cost no digits
        triangle, origin = triangle - middle, rays.origin - middle
        near = _near(origin, rays.direction, triangle)
        parts = []
        for i in near.split(max(1, TESTS // len(triangle))):
            ray, *rest = _pierced(origin[i], rays.direction[i], triangle)
            parts.append((i[ray], *rest))
        return Meeting(*(torch.cat(column) for column in zip(*parts, strict=True)))


@torch.no_grad()
def patches_of(world: World, path: str, cell: float, offset: float) -> Patches:
    """Cells of about ``cell`` [m] over an object's surface, ``offset`` [m] before it.

    A box gives its faces, cut into triangles no longer than a cell. Other shapes give their mesh: its
    triangles within one cube of that size that face the same way are one cell, and the cell's point
    is the middle one, brought onto the true surface. Raises SceneError for an object without bounds,
    and for sizes that make no map.
    """
    _check_sizes(path, cell, offset)
    which, node = world.scene.index(path), world.scene.node(path)
    shape, scale = node.body.shape, float(node.pose.scale)
    if isinstance(shape, (Box, Mesh)):
        vertices, faces = _box_mesh(shape) if isinstance(shape, Box) else _own_mesh(shape)
        triangle, owner, middle = _quartered(_cut(vertices[faces], cell / scale, path))
    else:
        from rfsg.objects.shapes.proxy import extract_mesh  # brings scikit-image along

        try:
            vertices, faces, _ = extract_mesh(shape, simplify=SMOOTH * cell / scale)
        except ValueError as error:
            raise SceneError([f"{path}: no surface to map: {error}"]) from error
        triangle = _cut(torch.from_numpy(vertices[faces]), cell / scale, path)
        triangle = triangle[_cross(triangle).norm(dim=-1) > 0]
        owner, chosen = _grouped(triangle, cell / scale)
        middle = triangle[chosen].mean(1)
        middle = _settled(shape, middle.to(world.device), SMOOTH * cell / scale)
    triangle, owner = triangle.to(world.device), owner.to(world.device)
    many, few = (torch.full((len(x),), which, device=world.device) for x in (triangle, middle))
    corners = world.point_world(many.repeat_interleave(3), triangle.reshape(-1, 3))
    lift = offset * world.direction_world(many, unit(_cross(triangle)))
    point = world.point_world(few, middle.to(world.device))
    normal = world.normal(few, point)
    lifted = corners.reshape(-1, 3, 3) + lift[:, None]
    return Patches(path, lifted, owner, point + offset * normal, normal)


def _settled(shape: Shape, point: Float[Tensor, "m 3"], most: float) -> Float[Tensor, "m 3"]:
    """Points brought onto a shape by Newton steps of at most ``most`` [m] each, in its own frame."""
    for _ in range(POLISH):
        value, gradient = shape.value_and_gradient(point)
        square = (gradient * gradient).sum(-1, keepdim=True)
        step = value[:, None] * gradient / torch.where(square > 0, square, 1.0)
        point = point - step * (most / step.norm(dim=-1, keepdim=True).clamp(min=most))
    return point


def _grouped(triangle: Float[Tensor, "k 3 3"], cell: float) -> tuple[Tensor, Tensor]:
    """Cell of each triangle: its cube and which way it faces; and the middle triangle of each cell."""
    normal, middle = unit(_cross(triangle)), triangle.mean(1)
    axis = normal.abs().argmax(-1, keepdim=True)
    facing = 2 * axis + (normal.gather(1, axis) > 0)
    key = torch.cat([torch.floor(middle / cell).long(), facing], 1)
    cells, owner = torch.unique(key, dim=0, return_inverse=True)
    weight = _cross(triangle).norm(dim=-1, keepdim=True)
    total = weight.new_zeros(len(cells), 1).index_add(0, owner, weight)
    centre = weight.new_zeros(len(cells), 3).index_add(0, owner, weight * middle) / total
    away = (middle - centre[owner]).norm(dim=-1)
    nearest = away.new_full((len(cells),), torch.inf).scatter_reduce(0, owner, away, "amin")
    number = torch.arange(len(owner))
    chosen = torch.full((len(cells),), len(owner)).scatter_reduce(
        0, owner, torch.where(away == nearest[owner], number, len(owner)), "amin"
    )
    return owner, chosen


@torch.no_grad()
def patches_from(vertices: Any, faces: Any, cell: float, offset: float) -> Patches:
    """The same over a mesh: vertices [v 3] m, world; faces [k 3], counter-clockwise from outside.

    Each face is a cell, or cut into triangles no longer than one. Raises SceneError for a mesh that is not one.
    """
    _check_sizes("mesh", cell, offset)
    corner = torch.as_tensor(vertices, dtype=torch.float64)
    index = torch.as_tensor(faces)
    if corner.ndim != 2 or corner.shape[1] != 3 or not bool(torch.isfinite(corner).all()):
        raise SceneError([f"mesh: expected finite vertices [v 3], got {tuple(corner.shape)}"])
    whole = not (index.is_floating_point() or index.is_complex())
    if index.ndim != 2 or index.shape[1] != 3 or not len(index) or not whole:
        raise SceneError([f"mesh: expected faces [k 3] of whole numbers, got {tuple(index.shape)}"])
    if not bool(((index >= 0) & (index < len(corner))).all()):
        raise SceneError([f"mesh: faces name vertices beyond the {len(corner)} there are"])
    triangle = corner[index.long()]
    triangle = _cut(triangle[_cross(triangle).norm(dim=-1) > 0], cell, "mesh")
    if not len(triangle):
        raise SceneError(["mesh: no face has an area"])
    normal = unit(_cross(triangle))
    quarters, owner, middle = _quartered(triangle)
    lifted = quarters + offset * normal[owner][:, None]
    return Patches("mesh", lifted, owner, middle + offset * normal, normal)


def _check_sizes(name: str, cell: float, offset: float) -> None:
    if not (0.0 < cell < math.inf and 0.0 <= offset < math.inf):
        raise SceneError([f"{name}: cell {cell} m, offset {offset} m: expected > 0 and >= 0"])


def _box_mesh(box: Box) -> tuple[Tensor, Tensor]:
    """Corners, and two triangles for each side."""
    low, high = box.bounds().detach()
    bit = torch.tensor([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], dtype=torch.bool)
    side = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]]
    faces = [[s[0], s[i], s[i + 1]] for s in side for i in (1, 2)]
    return torch.where(bit, high.cpu(), low.cpu()), torch.tensor(faces)


def _own_mesh(mesh: Mesh) -> tuple[Tensor, Tensor]:
    return mesh.vertices.detach().cpu(), mesh.triangles.cpu()


def _cut(triangle: Float[Tensor, "c 3 3"], cell: float, name: str) -> Float[Tensor, "k 3 3"]:
    """Halve triangles across their longest side until none is longer than ``cell``."""
    most = float(0.5 * _cross(triangle).norm(dim=-1).sum()) / LARGEST / cell / cell
    while most <= MOST_CELLS:
        side = (triangle.roll(-1, 1) - triangle).norm(dim=-1)
        longest, where = side.max(-1)
        long = longest > cell * (1 + 1e-9)
        if not bool(long.any()):
            return triangle
        most = len(triangle) + int(long.sum())
        split = triangle[long]
        turn = (where[long, None] + torch.arange(3, device=triangle.device)) % 3
        a, b, c = split.gather(1, turn[..., None].expand_as(split)).unbind(1)
        middle = 0.5 * (a + b)
        halves = [torch.stack([a, middle, c], 1), torch.stack([middle, b, c], 1)]
        triangle = torch.cat([triangle[~long], *halves])
    raise SceneError([f"{name}: cells of {cell} m would be more than {MOST_CELLS}"])


def _quartered(triangle: Float[Tensor, "c 3 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles cut at the middles of their sides [4c 3 3], whose each quarter is, and the middles."""
    a, b, c = triangle.unbind(1)
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    cut = torch.stack([torch.stack(quarter, 1) for quarter in quarters], 1).reshape(-1, 3, 3)
    owner = torch.arange(len(triangle), device=triangle.device).repeat_interleave(4)
    return cut, owner, triangle.mean(1)


def _cross(triangle: Float[Tensor, "c 3 3"]) -> Float[Tensor, "c 3"]:
    a, b, c = triangle.unbind(1)
    return torch.linalg.cross(b - a, c - a)


def _near(
    origin: Float[Tensor, "r 3"], direction: Float[Tensor, "r 3"], triangle: Float[Tensor, "c 3 3"]
) -> Int[Tensor, "k"]:
    """Rays that pass through the ball about the origin that holds all triangles."""
    radius = triangle.norm(dim=-1).max()
    along = -(origin * direction).sum(-1)
    across = (origin + along[:, None] * direction).norm(dim=-1)
    return torch.nonzero((across <= radius) & (along >= -radius)).squeeze(-1)


def _pierced(
    o: Float[Tensor, "r 3"], d: Float[Tensor, "r 3"], triangle: Float[Tensor, "c 3 3"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(ray, distance, triangle, cosine) of all rays against all triangles.

    With n the normal, and b and c dual to the two sides from the corner a within the plane, a point
    p has the barycentric coordinates (p - a).b and (p - a).c: for p = o + t d all are products of
    matrices.
    """
    a, first, second = triangle.unbind(1)
    ab, ac = first - a, second - a
    normal = torch.linalg.cross(ab, ac)
    size = normal.norm(dim=-1)
    n = normal / size[:, None]
    dual = [torch.linalg.cross(ac, n) / size[:, None], torch.linalg.cross(n, ab) / size[:, None]]
    slope = d @ n.T  # [r c]
    flat = slope.abs() < GRAZING
    t = ((a * n).sum(-1) - o @ n.T) / torch.where(flat, torch.ones_like(slope), slope)
    beta, gamma = (o @ g.T + t * (d @ g.T) - (a * g).sum(-1) for g in dual)
    hit = ~flat & (t > 0) & (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1)
    ray, cell = torch.nonzero(hit, as_tuple=True)
    return ray, t[hit], cell, slope[hit].abs()
