"""What an importer finds: parts of triangles in metres, z up, and the materials that they name."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.objects.shapes import topology
from rfsg.scene.errors import SceneError
from rfsg.scene.materials import Material

MAX_PARTS = 100_000
MAX_TRIANGLES = 5_000_000  # of a whole scene
PIECE = 400  # triangles of one object: it asks each at every point; a larger sheet is divided


@dataclass(frozen=True)
class Part:
    """One object: triangles in the world, or a ball. ``sheet``: a surface without an inside."""

    name: str
    vertices: Float[ndarray, "v 3"]
    triangles: Int[ndarray, "t 3"]
    material: str
    sheet: bool = True
    ball: tuple[tuple[float, float, float], float] | None = None  # centre and radius [m]


@dataclass(frozen=True)
class Imported:
    """A scene as read: parts, materials by name, and what to keep in mind."""

    parts: tuple[Part, ...]
    materials: dict[str, Material]
    warnings: tuple[str, ...] = ()
    source: str = ""
    triangles: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "triangles", sum(len(p.triangles) for p in self.parts))
        faults = [
            f"{self.source}: {what} {count}; expected {most} at most"
            for what, count, most in (
                ("objects:", len(self.parts), MAX_PARTS),
                ("triangles:", self.triangles, MAX_TRIANGLES),
            )
            if count > most
        ]
        faults += [
            f"{self.source}: material {name!r}: {fault}"
            for name, material in self.materials.items()
            for fault in material.faults()
        ]
        if faults:
            raise SceneError(faults)


def is_closed(vertices: Float[ndarray, "v 3"], triangles: Int[ndarray, "t 3"]) -> bool:
    """Whether triangles enclose something: every edge joins two, corners at one place taken as one."""
    _, index = np.unique(vertices, axis=0, return_inverse=True)
    corner = index.reshape(-1)[triangles]
    corner = corner[(corner != np.roll(corner, 1, 1)).all(1)]
    return len(corner) >= 4 and not len(topology.neighbours(corner)[1])


def divided(part: Part, most: int = PIECE) -> list[Part]:
    """A sheet in pieces of at most ``most`` triangles that lie together: terrain, mostly. What encloses
    something is one piece."""
    if not part.sheet or len(part.triangles) <= most:
        return [part]
    middle = part.vertices[part.triangles].mean(1)
    groups, todo = [], [np.arange(len(middle))]
    while todo:
        some = todo.pop()
        if len(some) <= most:
            groups.append(some)
            continue
        axis = int(np.ptp(middle[some], axis=0).argmax())
        order = some[np.argsort(middle[some, axis], kind="stable")]
        half = len(order) // 2
        todo += [order[half:], order[:half]]
    return [_piece(part, k, some) for k, some in enumerate(groups)]


def _piece(part: Part, number: int, which: Int[ndarray, "k"]) -> Part:
    used, index = np.unique(part.triangles[np.sort(which)], return_inverse=True)
    corners = index.reshape(-1, 3)
    return Part(f"{part.name}_piece{number}", part.vertices[used], corners, part.material)
