"""Edges of learned shapes.

A learned shape has no edges of its own: its network rounds them, and its mesh cuts them off at the
grid step. So they are made from its faces, which are learned far better: flat pieces of the mesh, a
plane through each, lines where neighbouring planes meet, and of these what the network confirms to
have both faces beside it. They carry no gradients.
"""

import hashlib
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from numpy import ndarray

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.edges.record import Edges, no_edges, straight_edges
from rfsg.objects.shapes.topology import components, facets, neighbours

MOST_PIECES = 1000  # flat pieces looked for in a learned surface
TURN = math.cos(math.radians(6.0))  # of the network's normals from the plane of their piece
EVEN = math.cos(math.radians(0.75))  # and of one triangle from its neighbours, to begin from
FAN = math.cos(math.radians(2.75))  # root mean square turn of the normals within a piece
RIPPLE = 0.15  # of the grid step: how far a piece may depart from its plane
SMALLEST = 12.0  # of the grid step squared: area of the least piece
SHORTEST = (
    3.0  # of the grid step: what an edge is at least, and how far its ends reach for a corner
)
BESIDE = (1.0, 2.0)  # of the grid step: where the network is asked for the faces of an edge

_FOUND: dict[bytes, Edges] = {}
MOST_KEPT = 256


def learned_edges(shape: Shape, angle_deg: float = 30.0) -> Edges:
    """Straight convex edges between flat pieces of a learned surface that meet by ``angle_deg``.

    Patches number the flat pieces (they are not ``Shape.patch``). Kept while the parameters stay as
    they are. Raises ValueError for a shape without a surface, as ``proxy.extract_mesh`` does.
    """
    key = _digest(shape, angle_deg)
    if key is None:
        return _find(shape, angle_deg)
    if key not in _FOUND:
        if len(_FOUND) >= MOST_KEPT:
            _FOUND.clear()
        _FOUND[key] = _find(shape, angle_deg)
    return _FOUND[key]


def _digest(shape: Shape, angle_deg: float) -> bytes | None:
    """What a learned shape is, whichever copy of it is asked; None without parameters to tell by."""
    state = getattr(shape, "state_dict", dict)()
    if not state:
        return None
    content = hashlib.sha256(
        f"{shape.kind} {shape.config()} {shape.bounds().tolist()} {angle_deg}".encode()
    )
    for name, value in state.items():
        content.update(f"{name} {value.dtype} {value.device}".encode())
        content.update(value.detach().cpu().contiguous().numpy().tobytes())
    return content.digest()


@dataclass(frozen=True)
class _Piece:
    """A flat piece: n . x = offset, and the centres of its triangles."""

    normal: ndarray
    offset: float
    point: ndarray


def _find(shape: Shape, angle_deg: float) -> Edges:
    # brings scikit-image and manifold3d along
    from rfsg.objects.shapes.proxy import DEFAULT_STEPS, FINEST, extract_mesh

    low, high = shape.bounds().tolist()
    step = max(max(b - a for a, b in zip(low, high, strict=True)) / DEFAULT_STEPS, FINEST)
    vertices, faces, _ = extract_mesh(shape, step)
    pieces = _pieces(shape, vertices, faces, step)
    found = []
    for i, j in _meetings(pieces, math.cos(math.radians(angle_deg)), step):
        found += [(*ends, i, j) for ends in _confirmed(shape, pieces, i, j, step)]
    device = shape.bounds().device
    if not found:
        return no_edges(device)
    start, end = (torch.tensor(np.stack([f[c] for f in found])).to(device) for c in (0, 1))
    patch0, patch1 = (torch.tensor([f[c] for f in found], device=device) for c in (2, 3))
    normal = torch.tensor(np.stack([p.normal for p in pieces])).to(device)
    return straight_edges(start, end, normal[patch0], normal[patch1], patch0, patch1)


def _pieces(shape: Shape, vertices: ndarray, faces: ndarray, step: float) -> list[_Piece]:
    """Flat pieces of the surface, grown from the flattest triangles of its mesh."""
    centre, normal = _drawn(shape, vertices[faces].mean(1), step)
    _, area = facets(vertices, faces)
    pairs = neighbours(faces)[0][:, 2:]
    bend = 1.0 - (normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(1)
    rough = np.full(len(faces), 2.0)  # the evenest neighbour: on a strip the others turn the corner
    for side in (0, 1):
        np.minimum.at(rough, pairs[:, side], bend)
    free = np.ones(len(faces), dtype=bool)
    found: list[_Piece] = []
    for seed in np.argsort(rough, kind="stable")[: int((rough < 1.0 - EVEN).sum())].tolist():
        if len(found) == MOST_PIECES or not free[seed]:
            continue
        inside, plane = _grown(seed, free, centre, normal, area, faces, step)
        free[inside] = False
        # a strip of a round limb fits a plane too, but its normals fan out
        even = (normal[inside] @ plane[0]).mean() > FAN
        if even and area[inside].sum() >= SMALLEST * step * step:
            found.append(_Piece(*plane, centre[inside]))
    return found


def _drawn(shape: Shape, point: ndarray, step: float) -> tuple[ndarray, ndarray]:
    """Points drawn to the surface, off the chords that cut edges, and normals there."""
    for _ in range(2):
        value, normal = _asked(shape, point)
        point = point - np.clip(value, -step, step)[:, None] * normal
    return point, normal


def _grown(
    seed: int,
    free: ndarray,
    centre: ndarray,
    normal: ndarray,
    area: ndarray,
    faces: ndarray,
    step: float,
) -> tuple[ndarray, tuple[ndarray, float]]:
    """The piece about a seed: triangles that belong to a plane, and the plane fitted to them."""
    direction, offset = normal[seed], float(normal[seed] @ centre[seed])
    inside = np.array([seed])
    for _ in range(8):
        close = np.abs(centre @ direction - offset) < RIPPLE * step
        mine = free & close & (normal @ direction > TURN)
        if not mine[seed] or area[mine].sum() < SMALLEST * step * step:
            break
        now = _around(seed, mine, faces)
        if len(now) < 4 or np.array_equal(now, inside):
            break
        inside = now
        direction, offset = _plane(centre[inside], area[inside], normal[inside])
    return inside, (direction, offset)


def _around(seed: int, mine: ndarray, faces: ndarray) -> ndarray:
    """The triangles of ``mine`` that hang together with the seed, by corners at least."""
    some = np.flatnonzero(mine)
    _, corner = np.unique(faces[some], return_inverse=True)
    owner = np.repeat(np.arange(len(some)), 3)
    link = np.stack([owner, len(some) + corner.reshape(-1)], 1)
    group = components(len(some) + int(corner.max()) + 1, link)[: len(some)]
    return some[group == group[np.searchsorted(some, seed)]]


def _plane(point: ndarray, weight: ndarray, normal: ndarray) -> tuple[ndarray, float]:
    """Least squares by area, to points on the zero set; outward."""
    middle = weight @ point / weight.sum()
    away = (point - middle) * np.sqrt(weight)[:, None]
    direction = np.linalg.svd(away, full_matrices=False)[2][2]
    direction = direction * np.sign(direction @ (weight @ normal) or 1.0)
    return direction, float(direction @ middle)


def _meetings(pieces: list[_Piece], most: float, step: float) -> list[tuple[int, int]]:
    """Pairs of pieces that come close to each other, at an angle."""
    if not pieces:
        return []
    from scipy.spatial import KDTree  # a third of a second: only learned shapes pay it

    trees = [KDTree(p.point) for p in pieces]
    low, high = (np.stack([f(p.point, 0) for p in pieces]) for f in (np.min, np.max))
    normal = np.stack([p.normal for p in pieces])
    reach = SHORTEST * step
    near = ((low[:, None] - reach < high[None]) & (low[None] - reach < high[:, None])).all(-1)
    angled = normal @ normal.T < most
    out = []
    for i, j in np.argwhere(np.triu(near & angled, 1)).tolist():
        # beyond this angle two faces are the two sides of a sheet, and no line is well defined
        if normal[i] @ normal[j] > -TURN and trees[i].count_neighbors(trees[j], reach):
            out.append((i, j))
    return out


def _confirmed(
    shape: Shape, pieces: list[_Piece], i: int, j: int, step: float
) -> list[tuple[ndarray, ndarray]]:
    """Stretches of the line in which two planes meet that have both faces beside them."""
    a, b = pieces[i], pieces[j]
    along = np.cross(a.normal, b.normal)
    along = along / np.linalg.norm(along)
    origin = np.linalg.solve(np.stack([a.normal, b.normal, along]), [a.offset, b.offset, 0.0])
    reach = np.array([[f(p.point @ along) for f in (np.min, np.max)] for p in (a, b)])
    low, high = reach[:, 0].max() - step, reach[:, 1].min() + step
    if high - low < SHORTEST * step:
        return []
    t = np.arange(low, high, 0.5 * step)
    place = origin + t[:, None] * along
    good = np.ones(len(t), dtype=bool)
    for own, other in ((a, b), (b, a)):
        inward = (own.normal @ other.normal) * own.normal - other.normal
        inward = inward / np.linalg.norm(inward)
        good &= np.any([_lies_on(shape, place + x * step * inward, own, step) for x in BESIDE], 0)
        good &= _asked(shape, place - BESIDE[0] * step * inward)[0] > 0.5 * step
    corners = _corners(pieces, (i, j), origin, along, step)
    found = []
    for run in _runs(good):
        ends = [_to_corner(float(t[k]), corners, step) for k in (run[0], run[-1])]
        if ends[1] - ends[0] >= SHORTEST * step:
            found.append((origin + ends[0] * along, origin + ends[1] * along))
    return found


def _lies_on(shape: Shape, point: ndarray, piece: _Piece, step: float) -> Bool[ndarray, "m"]:
    """Whether the network has a surface there that looks where the piece does."""
    value, normal = _asked(shape, point)
    return (np.abs(value) < RIPPLE * step) & (normal @ piece.normal > TURN)


def _asked(shape: Shape, point: ndarray) -> tuple[ndarray, ndarray]:
    """Distance to the surface to first order and unit normal, by the network; far outside bounds."""
    with torch.no_grad():
        box = shape.bounds().float()  # finding asks for no more than the precision of the weights
        where = torch.from_numpy(point).to(box)
        inside = ((where >= box[0]) & (where <= box[1])).all(-1)
        value, gradient = shape.value_and_gradient(where)
        slope = gradient.norm(dim=-1).clamp(min=1e-12)
        distance = torch.where(inside, value / slope, torch.full_like(value, torch.inf))
        normal = gradient / slope[:, None]
    return distance.double().cpu().numpy(), normal.double().cpu().numpy()


def _corners(
    pieces: list[_Piece], pair: tuple[int, int], origin: ndarray, along: ndarray, step: float
) -> ndarray:
    """Where other pieces' planes cut the line, close to those pieces."""
    found = []
    for k, piece in enumerate(pieces):
        slope = float(piece.normal @ along)
        if k in pair or abs(slope) < 0.3:
            continue
        t = (piece.offset - float(piece.normal @ origin)) / slope
        gap = np.linalg.norm(piece.point - (origin + t * along), axis=1).min()
        if gap < SHORTEST * step:
            found.append(t)
    return np.array(found)


def _to_corner(t: float, corners: ndarray, step: float) -> float:
    """The corner next to an end: faces are cut off before it by about the grid step."""
    if not len(corners):
        return t
    nearest = corners[np.abs(corners - t).argmin()]
    return float(nearest) if abs(nearest - t) < SHORTEST * step else t


def _runs(good: ndarray) -> list[ndarray]:
    """Runs of True, gaps of up to two steps closed."""
    on = np.flatnonzero(good)
    return [r for r in np.split(on, np.flatnonzero(np.diff(on) > 4) + 1) if len(r) > 1]
