"""What a picture in space needs of a result: paths as polylines, a map as coloured faces."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.objects.plain import array
from rfsg.tracer.cells import Grid
from rfsg.tracer.pathtable import arriving, crossed_by_path
from rfsg.tracer.records import Act

if TYPE_CHECKING:
    from rfsg.tracer.radiomap import RadioMap
    from rfsg.tracer.simulate import Result

# A path is called after the first of these that it does.
KINDS = (
    "diffuse",
    "diffracted",
    "refracted",
    "reflected",
    "through objects",
    "line of sight",
)
_ACTS = {
    "diffuse": {Act.SCATTER},
    "diffracted": {Act.DIFFRACT},
    "refracted": {Act.ENTER, Act.LEAVE},
    "reflected": {Act.REFLECT},
}


@dataclass(frozen=True)
class Line:
    """An arriving path: where it goes [m], what it does, and its share of the channel."""

    tx: int
    rx: int
    kind: str
    gain_db: float
    delay_ns: float
    points: Float[ndarray, "k 3"]


def path_lines(result: "Result") -> list[Line]:
    """The arriving paths, link by link, strongest first, at the first frequency."""
    paths, channel = result.paths, result.channel
    which, act, vertices = (array(x) for x in (paths.which, paths.act, paths.vertices))
    tx, rx = array(channel.tx), array(channel.rx)
    gain_db = 20.0 * np.log10(np.abs(array(channel.gain)[:, 0]).clip(1e-300))
    delay_ns = 1e9 * array(channel.delay)
    through = crossed_by_path(channel)
    lines = []
    for p in arriving(channel):
        acts = {Act(int(a)) for a, i in zip(act[p], which[p], strict=True) if i >= 0}
        corners = int((which[p] >= 0).sum()) + 2
        kind = next((k for k, those in _ACTS.items() if acts & those), None)
        kind = kind or ("through objects" if int(p) in through else "line of sight")
        numbers = (float(gain_db[p]), float(delay_ns[p]))
        lines.append(Line(int(tx[p]), int(rx[p]), kind, *numbers, vertices[p, :corners]))
    return lines


@dataclass(frozen=True)
class Faces:
    """A map's cells as faces of ``corners`` corners each; ``cell``: whose each face is."""

    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "k corners"]
    cell: Int[ndarray, "k"]


def map_faces(found: "RadioMap") -> Faces:
    """Cells of a map in the world [m]: squares of a plane that share corners, or triangles."""
    cells = found.cells
    if not isinstance(cells, Grid):
        triangle = array(cells.triangle)
        own = np.arange(3 * len(triangle)).reshape(-1, 3)
        return Faces(triangle.reshape(-1, 3), own, array(cells.owner))
    half = cells.cell / 2
    x, y = array(cells.x), array(cells.y)
    x, y = np.append(x - half, x[-1] + half), np.append(y - half, y[-1] + half)
    across, up = np.meshgrid(x, y)
    flat = np.stack([across, up, np.zeros_like(across)], -1).reshape(-1, 3)
    turn, place = array(cells.plane.rotation), array(cells.plane.translation)
    row, column = np.indices(cells.shape)
    first = (row * len(x) + column).reshape(-1)
    faces = np.stack([first, first + 1, first + len(x) + 1, first + len(x)], -1)
    return Faces(flat @ turn.T + place, faces, np.arange(len(first)))
