"""Where a radio map is read: square cells on a plane of any orientation.

Cells, here and in ``patches``, say where they are (``point``), how large (``area``), and for maps by
rays which rays meet which sub-cell (``meet``), with whose each is (``owner``) and how large
(``subarea``): the spread of power within a cell is read from them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.scene.pose import Pose
from rfsg.scene.scene import Scene, SceneError
from rfsg.tracer.beams import Rows
from rfsg.tracer.records import Rays

MOST_CELLS = 4_000_000  # more are a mistyped cell size: refuse before taking memory
SIDE = 4  # sub-cells along each side of a square
GRAZING = 1e-3  # rays flatter than a milliradian cross a cell where it no longer matters


@dataclass(frozen=True)
class Meeting:
    """Rays that cross sub-cells: flat, ``cosine`` [1] between ray and the cell's normal, above 0."""

    ray: Int[Tensor, "m"]
    distance: Float[Tensor, "m"]
    subcell: Int[Tensor, "m"]
    cosine: Float[Tensor, "m"]


@dataclass(frozen=True)
class Grid:
    """Square cells of side ``cell`` [m] on the plane of x and y of ``plane``'s frame.

    x, y: the cells' middles [m] in that frame; a level plane's x and y are the world's.
    """

    plane: Pose
    cell: float
    x: Float[Tensor, "nx"]
    y: Float[Tensor, "ny"]

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.y), len(self.x)

    @property
    def point(self) -> Float[Tensor, "c 3"]:
        """The cells' middles in the world [m], row by row."""
        y, x = torch.meshgrid(self.y, self.x, indexing="ij")
        return self.plane.point_world(torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3))

    @property
    def rows(self) -> Rows:
        """The middles as straight rows."""
        first, second = self.plane.direction_world(torch.eye(3, dtype=torch.float64))[:2]
        along = (self.x[:1, None] * first + self.y[:, None] * second) + self.plane.translation
        return Rows(along, self.cell * first, len(self.x))

    @property
    def area(self) -> Float[Tensor, "c"]:
        return torch.full((len(self.x) * len(self.y),), self.cell**2, dtype=torch.float64)

    @property
    def owner(self) -> Int[Tensor, "s"]:
        return torch.arange(len(self.x) * len(self.y)).repeat_interleave(SIDE * SIDE)

    @property
    def subarea(self) -> Float[Tensor, "s"]:
        return torch.full_like(self.owner, (self.cell / SIDE) ** 2, dtype=torch.float64)

    def meet(self, rays: Rays) -> Meeting:
        """Rays through the plane, each in one sub-cell at most."""
        plane = _to(self.plane, rays.origin)
        o, d = plane.point_object(rays.origin), plane.direction_object(rays.direction)
        slope = d[:, 2]
        flat = slope.abs() < GRAZING
        t = -o[:, 2] / torch.where(flat, torch.ones_like(slope), slope)
        ray = torch.nonzero(~flat & (t > 0)).squeeze(-1)
        place = o[ray] + t[ray, None] * d[ray]
        fine = self.cell / SIDE
        column = torch.floor((place[:, 0] - (float(self.x[0]) - 0.5 * self.cell)) / fine)
        row = torch.floor((place[:, 1] - (float(self.y[0]) - 0.5 * self.cell)) / fine)
        rows, columns = SIDE * len(self.y), SIDE * len(self.x)
        hit = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        ray, row, column = ray[hit], row[hit].long(), column[hit].long()
        cell = (row // SIDE) * len(self.x) + column // SIDE
        return Meeting(
            ray,
            t[ray],
            (cell * SIDE + row % SIDE) * SIDE + column % SIDE,
            slope[ray].abs(),
        )


def plane_through(
    origin: Sequence[float] | Tensor, u: Sequence[float] | Tensor, v: Sequence[float] | Tensor
) -> Pose:
    """The plane through ``origin`` [m] whose x runs along ``u``, and whose y towards ``v``.

    v need not stand square on u: its part along u is left out. Raises SceneError for directions that
    span no plane.
    """
    names = ("origin", "u", "v")
    given = [torch.as_tensor(a, dtype=torch.float64) for a in (origin, u, v)]
    for name, vector in zip(names, given, strict=True):
        if vector.shape != (3,) or not bool(torch.isfinite(vector).all()):
            raise SceneError([f"plane: {name}: expected three finite numbers, got {vector}"])
    place, along, towards = given
    x = along / along.norm().clamp(min=1e-300)
    across = towards - (towards @ x) * x
    if not (float(along.norm()) > 0 and float(across.norm()) > 1e-6 * float(towards.norm())):
        raise SceneError([f"plane: u {along.tolist()} and v {towards.tolist()} span no plane"])
    y = across / across.norm()
    rotation = torch.stack([x, y, torch.linalg.cross(x, y)], -1)
    return Pose(rotation, place, torch.ones((), dtype=torch.float64))


def grid_on(plane: Pose, bounds: tuple[float, float, float, float], cell: float) -> Grid:
    """Cells that cover ``bounds`` (x0, y0, x1, y1) [m] in the plane's frame.

    Raises SceneError for a plane that is stretched and for a map of no or of too many cells.
    """
    if float(plane.scale) != 1.0:
        raise SceneError([f"map: the plane's scale is {float(plane.scale)}; expected 1"])
    x0, y0, x1, y1 = bounds
    sides = (x1 - x0, y1 - y0)
    sensible = all(map(math.isfinite, (*bounds, cell))) and cell > 0 and min(sides) > 0
    sensible = sensible and max(sides) / cell <= MOST_CELLS
    nx, ny = (max(1, math.ceil(s / cell - 1e-9)) for s in sides) if sensible else (0, 0)
    if not 0 < nx * ny <= MOST_CELLS:
        raise SceneError(
            [f"map: {nx} x {ny} cells of {cell} m over {bounds}: expected 1 to {MOST_CELLS}"]
        )
    x, y = (
        low + cell * (torch.arange(n, dtype=torch.float64) + 0.5) for low, n in ((x0, nx), (y0, ny))
    )
    return Grid(plane, cell, x, y)


def extent(
    scene: Scene, corners: Float[Tensor, "k 3"], plane: Pose
) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) in the plane's frame of corners of objects and of all radios [m]."""
    radios = [r.position.detach().to(corners) for r in (*scene.transmitters, *scene.receivers)]
    every = torch.cat([corners, *(p[None] for p in radios)])
    if not len(every):
        raise SceneError(
            ["map: the scene is empty, so it has no extent; give bounds=(x0, y0, x1, y1)"]
        )
    flat = _to(plane, every).point_object(every)[:, :2]
    low, high = flat.amin(0).tolist(), flat.amax(0).tolist()
    return low[0], low[1], high[0], high[1]


def _to(plane: Pose, like: Tensor) -> Pose:
    return Pose(plane.rotation.to(like), plane.translation.to(like), plane.scale.to(like))
