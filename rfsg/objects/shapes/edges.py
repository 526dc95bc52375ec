"""The convex edges of shapes, where waves diffract; in the object's own frame.

An edge is a straight segment or the circular rim of a cylinder, with the outward normals of the two
faces that meet there. Sizes of closed-form shapes stay differentiable.

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
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.analytic import Box, Cylinder
from rfsg.objects.shapes.proxy import DEFAULT_STEPS, FINEST, extract_mesh


@dataclass(frozen=True)
class Edges:
    """Convex edges: straight segments from ``start`` to ``end``, and whole circles [m].

    normal0, normal1: outward unit normals of the two faces at ``start`` (on a straight edge they are
    the same everywhere). patch0, patch1: the faces' numbers: patches of a closed-form shape, else
    those of the flat pieces that were found. Straight edges have radius inf, and centre and axis 0.
    A circle starts and ends at one point, runs about ``axis`` from there (right-handed), and its face
    0 is flat with normal0 = +-axis, its face 1 round with normal1 away from ``centre``.
    """

    start: Float[Tensor, "e 3"]
    end: Float[Tensor, "e 3"]
    normal0: Float[Tensor, "e 3"]
    normal1: Float[Tensor, "e 3"]
    patch0: Int[Tensor, "e"]
    patch1: Int[Tensor, "e"]
    centre: Float[Tensor, "e 3"]
    radius: Float[Tensor, "e"]
    axis: Float[Tensor, "e 3"]

    def __len__(self) -> int:
        return len(self.patch0)

    @property
    def opening(self) -> Float[Tensor, "e"]:
        """n: the exterior angle of the wedge over pi, 1 (flat) to 2 (a half plane)."""
        cosine = (self.normal0 * self.normal1).sum(-1)
        sine = torch.linalg.cross(self.normal0, self.normal1).norm(dim=-1)
        return 1.0 + torch.atan2(sine, cosine) / math.pi


def edges_of(shape: Shape) -> Edges:
    """The edges of a shape; none of spheres, capsules and half-spaces."""
    if isinstance(shape, Box):
        return box_edges(shape.half_size)
    if isinstance(shape, Cylinder):
        return cylinder_edges(shape.radius, shape.half_height)
    if not shape.exact:
        return learned_edges(shape)
    return no_edges(shape.bounds().device)


def no_edges(device: torch.device | None = None) -> Edges:
    """A record of length 0."""
    point = torch.zeros(0, 3, dtype=torch.float64, device=device)
    patch = torch.zeros(0, dtype=torch.int64, device=device)
    return straight_edges(point, point, point, point, patch, patch)


def straight_edges(
    start: Float[Tensor, "e 3"],
    end: Float[Tensor, "e 3"],
    normal0: Float[Tensor, "e 3"],
    normal1: Float[Tensor, "e 3"],
    patch0: Int[Tensor, "e"],
    patch1: Int[Tensor, "e"],
) -> Edges:
    """Edges without arcs."""
    zero = torch.zeros_like(start)
    radius = torch.full_like(start[:, 0], torch.inf)
    return Edges(start, end, normal0, normal1, patch0, patch1, zero, radius, zero)


def box_edges(half_size: Float[Tensor, "3"]) -> Edges:
    """The 12 edges of |x| <= half_size [m]: four along each axis; n = 3/2."""
    eye = torch.eye(3, dtype=half_size.dtype, device=half_size.device)
    rows, patches = [], []
    for axis in range(3):
        first, second = (a for a in range(3) if a != axis)
        for i in (0, 1):
            for j in (0, 1):
                normal0, normal1 = (2 * i - 1) * eye[first], (2 * j - 1) * eye[second]
                middle = half_size * (normal0 + normal1)
                along = half_size * eye[axis]
                rows.append(torch.stack([middle - along, middle + along, normal0, normal1]))
                patches.append((2 * first + i, 2 * second + j))
    start, end, normal0, normal1 = torch.stack(rows, 1)
    patch0, patch1 = torch.tensor(patches, device=half_size.device).unbind(1)
    return straight_edges(start, end, normal0, normal1, patch0, patch1)


def cylinder_edges(radius: Float[Tensor, ""], half_height: Float[Tensor, ""]) -> Edges:
    """The two rims |z| = half_height of a cylinder about z [m]: cap (patch 0, 1) and side (2)."""
    eye = torch.eye(3, dtype=radius.dtype, device=radius.device)
    normal0 = torch.stack([-eye[2], eye[2]])
    normal1 = eye[0].expand(2, 3)
    centre = half_height * normal0
    start = centre + radius * normal1
    patch0 = torch.arange(2, device=radius.device)
    return Edges(
        start,
        start,
        normal0,
        normal1,
        patch0,
        torch.full_like(patch0, 2),
        centre,
        radius.expand(2),
        eye[2].expand(2, 3),
    )


# meshes

MAX_TRIANGLES = 4_000_000
FLAT = math.cos(math.radians(1.0))  # triangles that turn less from one to the next make one face


def mesh_edges(
    vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "t 3"], angle_deg: float = 20.0
) -> Edges:
    """Convex edges of a triangle mesh [m] where it turns by more than ``angle_deg``.

    Triangles are wound outward (anticlockwise from outside). Vertices at one place are one vertex.
    Pieces of one straight edge are joined. A normal is the mean of the flat face that its triangle
    belongs to; patches number these faces. An edge of one triangle only, the rim of a sheet, is the
    edge of a half plane (n = 2), with both patches the same. Edges of three or more triangles and
    triangles without area are left out.

    Raises ValueError for arrays of another shape, indices out of range, values that are not finite,
    an angle outside (0, 180), or more than MAX_TRIANGLES.
    """
    _check_mesh(vertices, faces, angle_deg)
    place, index = np.unique(np.asarray(vertices, np.float64), axis=0, return_inverse=True)
    corner = index.reshape(-1)[faces]
    normal, area = _facets(place, corner)
    corner, normal, area = corner[area > 0], normal[area > 0], area[area > 0]
    pairs, rims = _neighbours(corner)
    face, mean = _flat_faces(pairs[:, 2:], normal, area)
    bend = (normal[pairs[:, 2]] * normal[pairs[:, 3]]).sum(1)
    apex = corner[pairs[:, 3]].sum(1) - pairs[:, 0] - pairs[:, 1]
    below = ((place[apex] - place[pairs[:, 0]]) * normal[pairs[:, 2]]).sum(1) < 0
    sharp = pairs[below & (bend < math.cos(math.radians(angle_deg)))]
    ends = np.concatenate([sharp[:, :2], rims[:, :2]])
    left, right = (np.concatenate([sharp[:, c], rims[:, 2]]) for c in (2, 3))
    flip = np.where(np.arange(len(ends)) < len(sharp), 1.0, -1.0)[:, None]
    start, end, piece = _joined(place, ends, face[left], face[right])
    rows = (start, end, mean[left[piece]], mean[right[piece]] * flip[piece])
    patches = (face[x[piece]].astype(np.int64) for x in (left, right))
    zero = np.zeros_like(start)
    radius = np.full(len(start), np.inf)
    return Edges(*(torch.from_numpy(x) for x in (*rows, *patches, zero, radius, zero)))


def _check_mesh(vertices: ndarray, faces: ndarray, angle_deg: float) -> None:
    if not 0 < angle_deg < 180:
        raise ValueError(f"angle_deg={angle_deg!r}: expected an angle between 0 and 180 degrees")
    if len(faces) > MAX_TRIANGLES:
        raise ValueError(f"a mesh of {len(faces)} triangles: expected {MAX_TRIANGLES} at most")
    if not np.isfinite(vertices).all():
        raise ValueError("a mesh with vertices that are not finite")
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(f"a mesh whose faces name vertices outside of 0 to {len(vertices) - 1}")


def _facets(place: ndarray, corner: ndarray) -> tuple[ndarray, ndarray]:
    """Unit normals and areas of triangles; 0 for those without area."""
    a, b, c = place[corner].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    return cross / np.where(size > 0, size, 1.0)[:, None], 0.5 * size


def _neighbours(corner: ndarray) -> tuple[ndarray, ndarray]:
    """Edges of two triangles [m 4] (vertex, vertex, triangle, triangle) and of one [r 3]."""
    ends = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    owner = np.tile(np.arange(len(corner)), 3)
    _, which, count = np.unique(np.sort(ends, 1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64)
    double, single = order[first[count == 2]], order[first[count == 1]]
    other = order[first[count == 2] + 1]
    pairs = np.concatenate([ends[double], owner[double, None], owner[other, None]], 1)
    return pairs, np.concatenate([ends[single], owner[single, None]], 1)


def _flat_faces(pairs: ndarray, normal: ndarray, area: ndarray) -> tuple[ndarray, ndarray]:
    """Face number of each triangle, and the mean normal of its face where that face is flat."""
    level = pairs[(normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(1) > FLAT]
    face = _components(len(normal), level)
    total = np.zeros((int(face.max(initial=-1)) + 1, 3))
    np.add.at(total, face, area[:, None] * normal)
    mean = total[face] / np.maximum(np.linalg.norm(total[face], axis=1), 1e-300)[:, None]
    # a finely divided round face never turns much from one triangle to the next
    return face, np.where(((mean * normal).sum(1) > FLAT)[:, None], mean, normal)


def _components(count: int, links: ndarray) -> ndarray:
    ones = np.ones(len(links), dtype=bool)
    return connected_components(coo_array((ones, links.T), shape=(count, count)), False)[1]


STRAIGHT = 1e-3  # sine of the angle between pieces of one straight edge


def _joined(
    place: ndarray, ends: ndarray, left: ndarray, right: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Maximal straight segments: (start, end, one of the pieces). Face 0 is that of the piece."""
    along = place[ends[:, 1]] - place[ends[:, 0]]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    faces = np.sort(np.stack([left, right], 1), 1)
    visits = np.concatenate([np.stack([ends[:, c], *faces.T], 1) for c in (0, 1)])
    owner = np.tile(np.arange(len(ends)), 2)
    order = np.lexsort(visits.T)
    same = (visits[order[1:]] == visits[order[:-1]]).all(1)
    link = np.stack([owner[order[:-1]], owner[order[1:]]], 1)[same]
    sine = np.linalg.norm(np.cross(along[link[:, 0]], along[link[:, 1]]), axis=1)
    group = _components(len(ends), link[sine < STRAIGHT])
    _, piece = np.unique(group, return_index=True)
    origin, axis = place[ends[piece, 0]][group], along[piece][group]
    reach = ((place[ends] - origin[:, None]) * axis[:, None]).sum(-1)
    low, high = np.full(len(piece), np.inf), np.full(len(piece), -np.inf)
    np.minimum.at(low, group, reach.min(1))
    np.maximum.at(high, group, reach.max(1))
    start = place[ends[piece, 0]]
    return start + low[:, None] * along[piece], start + high[:, None] * along[piece], piece


# learned shapes

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
    _, area = _facets(vertices, faces)
    pairs = _neighbours(faces)[0][:, 2:]
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
    group = _components(len(some) + int(corner.max()) + 1, link)[: len(some)]
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
