"""Which points does a source reach through sequences of planar mirrors?

A sequence of mirrors makes an image of the source, and the path to a point is a straight line from the
image, in the space that the mirrors unfold. It has to pass the rectangle of every mirror, and one after
the other. Points and images are looked at as the faces see them: a height over the face's plane, and
two coordinates along it, in which a line is a line. What is left is a path but for its obstacles.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.tracer.columns import Columns, at, columns, dot, moved
from rfsg.tracer.faces import Planes

SLACK = 1e-6  # of a face's extent, or [m]: wider than what ``solve``, which decides, lets pass
ORDER = 1e-9  # of a path: mirrors may meet in a corner, and rounding put the second first
PAIRS = 1 << 17  # (sequence, point) pairs at a time: columns that stay in the cache


def reached(
    planes: Planes,
    image: Float[Tensor, "p 3"],
    faces: Int[Tensor, "p d"],
    point: Float[Tensor, "n 3"],
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """(sequence, point) where the path from the source to the point meets all faces in order.

    image: of the source, in all mirrors of each sequence.
    """
    seen = Seen(planes, point)
    none = torch.zeros(0, dtype=torch.int64, device=point.device)
    found = [(none, none)]
    step = max(1, PAIRS // max(1, len(point)))
    for first in range(0, len(image), step):
        some = slice(first, first + step)
        row, column = _reached(seen, image[some], faces[some])
        found.append((row + first, column))
    row, column = (torch.cat(x) for x in zip(*found, strict=True))
    return row, column


class Seen:
    """Points as every face sees them, and the faces in columns."""

    def __init__(self, planes: Planes, point: Float[Tensor, "n 3"]):
        self.normal, self.offset = columns(planes.normal), planes.offset
        self.edges = [columns(planes.edges[:, k]) for k in (0, 1)]
        centre = columns(planes.centre)
        self.shift = [dot(edge, centre) for edge in self.edges]
        self.half = [h + SLACK * h.clamp(min=1.0) for h in planes.half.unbind(1)]
        self.point = columns(point)
        self.height = planes.normal @ point.T - self.offset[:, None]
        self.along = [
            planes.edges[:, k] @ point.T - self.shift[k][:, None] for k in (0, 1)
        ]  # each [k n]

    def over(self, face: Tensor, point: Columns) -> Tensor:
        """Heights of points over faces."""
        return dot(at(self.normal, face), point) - self.offset[face]

    def beside(self, face: Tensor, point: Columns, k: int) -> Tensor:
        """Coordinates of points along the k-th edge of faces, from the middle."""
        return dot(at(self.edges[k], face), point) - self.shift[k][face]

    def mirrored(self, face: Tensor, point: Columns) -> Columns:
        return moved(point, -2.0 * self.over(face, point), at(self.normal, face))


def _reached(seen: Seen, image: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    source, last = columns(image), faces[:, -1]
    row, column, when = _through_last(seen, source, last)
    point = at(seen.point, column)
    for level in range(faces.shape[1] - 2, -1, -1):
        # the line is the same one, seen from before its mirror: fold both of its ends back
        source = seen.mirrored(faces[:, level + 1], source)
        point = seen.mirrored(faces[row, level + 1], point)
        face = faces[:, level]
        near, far = seen.over(face, source)[row], seen.over(faces[row, level], point)
        sooner = -near / (far - near).clamp(min=1e-300)
        good = (near < 0) & (far > 0) & (sooner <= when + ORDER)
        for k in (0, 1):
            start = seen.beside(face, source, k)[row]
            end = seen.beside(faces[row, level], point, k)
            good &= (start + sooner * (end - start)).abs() <= seen.half[k][faces[row, level]]
        kept = torch.nonzero(good).squeeze(-1)
        row, column, when, point = row[kept], column[kept], sooner[kept], at(point, kept)
    return row, column


def _through_last(seen: Seen, source: Columns, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(sequence, point, place) of lines from the image that pass the last face, and which share of
    the line lies behind it."""
    near, far = seen.over(last, source)[:, None], seen.height[last]
    when = -near / (far - near).clamp(min=1e-300)
    good = (far > 0) & (near < 0)
    for k in (0, 1):
        start = seen.beside(last, source, k)[:, None]
        good &= (start + when * (seen.along[k][last] - start)).abs() <= seen.half[k][last, None]
    row, column = torch.nonzero(good, as_tuple=True)
    return row, column, when[row, column]
