"""The faces of a world: planar ones as rectangles, curved and learned ones as points with normals.

Both come from the objects' own contract: planes and bounds for the first, rays shot at the object
from all around for the second.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.contract import Shape
from rfsg.objects.recent import Recent
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.kept import state_of
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World, unit
from rfsg.tracer.lattice import fibonacci
from rfsg.tracer.march import MarchOptions, march
from rfsg.tracer.zone import Facets, joined, measure, take, zone_radius

SHOTS = 4096  # rays shot at an object from around it; a 1 m object is sampled every 3 cm
COARSE = MarchOptions(step_floor=5e-3)  # samples are only where to begin looking


@dataclass(frozen=True)
class Planes:
    """Planar faces: n.x = offset, a frame (two edges, normal) and half-extents; inf if unbounded."""

    node: Int[Tensor, "k"]
    patch: Int[Tensor, "k"]
    normal: Float[Tensor, "k 3"]
    offset: Float[Tensor, "k"]
    centre: Float[Tensor, "k 3"]
    edges: Float[Tensor, "k 2 3"]  # unit vectors in the face
    half: Float[Tensor, "k 2"]  # [m]

    def __len__(self) -> int:
        return len(self.node)

    def corners(self) -> Float[Tensor, "k 4 3"]:
        sign = torch.tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
        reach = sign.to(self.half)[None] * self.half[:, None].clamp(max=UNBOUNDED)
        return self.centre[:, None] + torch.einsum("kci,kij->kcj", reach, self.edges)


UNBOUNDED = 1e6  # [m] stands for the half-extent of a face without an end


@dataclass(frozen=True)
class Clusters:
    """Samples that lie together and look the same way: a ball about them, a cone of their normals."""

    members: Int[Tensor, "k m"]  # samples, -1 behind the last
    centre: Float[Tensor, "k 3"]
    radius: Float[Tensor, "k"]
    normal: Float[Tensor, "k 3"]  # axis of the cone
    cone: Float[Tensor, "k"]  # its half-angle [rad]
    reach: Float[Tensor, "k"]  # the samples' greatest
    bend: Float[Tensor, "k"]  # and their greatest 2 curvature reach

    def __len__(self) -> int:
        return len(self.centre)


@dataclass(frozen=True)
class Samples:
    """Points on the curved and learned faces of one shape, with normals and patch numbers, all in the
    object's frame, and the nodes that have the shape.

    reach: distance to the sixth nearest sample; curvature: how fast normals turn there; patch_column:
    the patches that occur, counted from 0; centre, radius: of a ball about the shape's bounds.
    """

    nodes: Int[Tensor, "n"]
    point: Float[Tensor, "s 3"]
    normal: Float[Tensor, "s 3"]
    patch: Int[Tensor, "s"]
    reach: Float[Tensor, "s"]
    curvature: Float[Tensor, "s"]
    patch_column: Int[Tensor, "s"]
    clusters: Clusters
    centre: Float[Tensor, "3"]
    radius: float


@torch.no_grad()
def planes_of(world: World) -> Planes:
    """Every planar face in the world, as a rectangle that holds it."""
    return moving_planes_of(world)


def moving_planes_of(world: World) -> Planes:
    """The same, differentiable in poses and sizes."""
    own = [n.body.shape for n in world.scene.nodes]
    shapes = {id(shape): shape for shape in own}
    number = {key: k for k, key in enumerate(shapes)}
    owner = torch.tensor([number[id(shape)] for shape in own], dtype=torch.int64).to(world.device)
    boxes = _box_rectangles(shapes)
    tables = [boxes[k] if k in boxes else _rectangles(s) for k, s in shapes.items()]
    zero = world.translation.new_zeros
    blank = (zero(0, 4), zero(0, 3), zero(0, 2, 3), zero(0, 2))
    columns = [torch.cat([x.to(zero(0)) for x in c]) for c in zip(blank, *tables, strict=True)]
    # each shape's faces stand once in the columns, and are looked up for every node that has it
    count = torch.tensor([len(table[0]) for table in tables], dtype=torch.int64).to(world.device)
    many = count[owner]
    node = torch.arange(len(own), device=world.device).repeat_interleave(many)
    patch = torch.arange(len(node), device=world.device) - (torch.cumsum(many, 0) - many)[node]
    row = (torch.cumsum(count, 0) - count)[owner[node]] + patch
    plane, centre, edges, half = (column[row] for column in columns)
    normal = world.direction_world(node, plane[:, :3])
    place = (normal * world.translation[node]).sum(-1)
    return Planes(
        node,
        patch,
        normal,
        plane[:, 3] * world.scale[node] + place,
        world.point_world(node, centre),
        torch.stack([world.direction_world(node, edges[:, k]) for k in (0, 1)], 1),
        half * world.scale[node, None],
    )


def _box_rectangles(shapes: dict[int, Shape]) -> dict[int, tuple[Tensor, ...]]:
    """``_rectangles`` of all boxes at once: a scene may have hundreds, each with a size of its own."""
    boxes = {key: shape for key, shape in shapes.items() if type(shape) is Box}
    if not boxes:
        return {}
    half = torch.stack([box.half_size for box in boxes.values()])
    axis = torch.arange(3, device=half.device).repeat_interleave(2)
    eye = torch.eye(3, dtype=half.dtype, device=half.device)
    normal = torch.stack([-eye, eye], 1).reshape(6, 3).expand(len(half), 6, 3)
    offset = half[:, axis, None]
    others = torch.tensor([[1, 2], [0, 2], [0, 1]], device=half.device)[axis]
    edges = eye[others].expand(len(half), 6, 2, 3)
    columns = (torch.cat([normal, offset], 2), offset * normal, edges, half[:, others])
    return dict(zip(boxes, zip(*columns, strict=True), strict=True))


def _rectangles(shape: Shape) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Planes [k 4] of a shape, and of a rectangle on each the centre [k 3], edges [k 2 3] and half
    sides [k 2]; inf where a face has no end.

    A shape says its own, or its faces lie across the axes and reach as far as its bounds.
    """
    planes, own = shape.planes(), getattr(shape, "rectangles", None)
    if own is not None:
        return planes, *own()
    (low, high), normal = shape.bounds().to(planes), planes[:, :3]
    middle = torch.where(torch.isfinite(low + high), 0.5 * (low + high), torch.zeros_like(low))
    centre = middle + (planes[:, 3] - normal @ middle)[:, None] * normal
    others = torch.tensor([[1, 2], [0, 2], [0, 1]], device=planes.device)
    others = others[normal.abs().argmax(-1)] if len(planes) else others[:0, :2]
    eye = torch.eye(3, dtype=planes.dtype, device=planes.device)
    return planes, centre, eye[others], (0.5 * (high - low))[others]


@torch.no_grad()
def samples_of(world: World) -> list[Samples]:
    """Sampled faces of every shape that has curved or learned ones: once for all nodes that have it."""
    nodes_of: dict[int, list[int]] = {}
    for node, item in enumerate(world.scene.nodes):
        if not item.body.shape.faceted:
            nodes_of.setdefault(id(item.body.shape), []).append(node)
    out = []
    for nodes in nodes_of.values():
        found = _sampled(world.scene.nodes[nodes[0]].body.shape, world.device)
        if len(found.point):
            out.append(replace(found, nodes=torch.tensor(nodes, device=world.device)))
    return out


MOST_CACHED = 64
_SAMPLES: Recent[Samples] = Recent(MOST_CACHED)


def _sampled(shape: Shape, device: torch.device) -> Samples:
    """Samples of a shape and of no node, kept while the shape's parameters stay as they are."""
    return _SAMPLES.get(id(shape), state_of(shape), lambda: _sample(shape, device))


@torch.no_grad()
def _sample(shape: Shape, device: torch.device) -> Samples:
    point, normal, patch = _shoot(shape, device)
    reach, curvature = _neighbourhood(point, normal)
    low, high = shape.bounds().to(device=device, dtype=torch.float64)
    column = torch.unique(patch, return_inverse=True)[1]
    clusters = clustered(point, normal, reach, curvature)
    centre, radius = 0.5 * (low + high), float((high - low).norm() * 0.5)
    return Samples(
        patch[:0], point, normal, patch, reach, curvature, column, clusters, centre, radius
    )


CLUSTER = 64  # samples in a cluster, at most: as many clusters of as many samples, of 4096


def clustered(
    point: Float[Tensor, "s 3"],
    normal: Float[Tensor, "s 3"],
    reach: Float[Tensor, "s"],
    curvature: Float[Tensor, "s"],
) -> Clusters:
    """Samples halved, and halved again, where they differ most in place, normal or bend."""
    # of few samples, with no neighbour to tell, reach is inf and curvature 0
    bend = torch.where(curvature > 0, 2.0 * curvature * reach, torch.zeros_like(curvature))
    size = (point - point.mean(0)).norm(dim=-1).mean().clamp(min=1e-300)
    traits = torch.cat([point / size, normal, bend.clamp(max=1.0)[:, None]], 1)
    pieces = [torch.arange(len(point), device=point.device)]
    while len(pieces[0]) > CLUSTER:
        pieces = [half for piece in pieces for half in _halves(traits, piece)]
    pieces = [p for p in pieces if len(p)]
    most = max((len(p) for p in pieces), default=1)
    members = torch.full((len(pieces), most), -1, dtype=torch.int64, device=point.device)
    for row, piece in enumerate(pieces):
        members[row, : len(piece)] = piece
    held = members >= 0
    none = torch.zeros_like(members, dtype=point.dtype)
    share = held / held.sum(1, keepdim=True)
    centre = (point[members] * share[..., None]).sum(1)
    axis = unit((normal[members] * share[..., None]).sum(1))
    away = torch.where(held, (point[members] - centre[:, None]).norm(dim=-1), none)
    # half the chord is the sine of half the angle: exact for small angles, where a cosine is not
    chord = torch.where(held, (normal[members] - axis[:, None]).norm(dim=-1), none)
    cone = 2.0 * torch.asin((0.5 * chord).clamp(max=1.0))
    reach, bend = (torch.where(held, x[members], none) for x in (reach, bend))
    return Clusters(members, centre, away.amax(1), axis, cone.amax(1), reach.amax(1), bend.amax(1))


def _halves(traits: Tensor, piece: Tensor) -> tuple[Tensor, Tensor]:
    """A piece in two, at the middle of the trait that varies most."""
    widest = traits[piece].var(0, unbiased=False).argmax()
    order = piece[torch.argsort(traits[piece, widest], stable=True)]
    return order[: (len(piece) + 1) // 2], order[(len(piece) + 1) // 2 :]


@torch.no_grad()
def nearest_facets(
    world: World, which: Int[Tensor, "m"], point: Float[Tensor, "m 3"], wavelength: float
) -> Facets:
    """The measured facet of the sample nearest to each point: a first look that asks no network.

    A sample is measured once for a shape and a wavelength, when it is first asked for, over a zone of
    a path of a few metres.
    """
    local = world.point_object(which, point)
    found = []
    for shape, i in world.groups(which):
        scale = world.scale[which[i]]
        looks = looks_at(shape, world.device, wavelength / float(scale[0]))
        found.append((i, looks.nearest(local[i])))
    order = torch.argsort(torch.cat([i for i, _ in found]))
    whole = take(joined(*(f for _, f in found)), order)
    scale = world.scale[which]
    rows = [world.direction_world(which, whole.frame[:, k]) for k in range(3)]
    return Facets(
        world.point_world(which, whole.centre),
        torch.stack(rows, 1),
        whole.offset * scale,
        whole.slope,
        whole.bend / scale[:, None, None],
        whole.residual * scale,
        whole.weight,
        whole.radius * scale,
    )


LOOK = 1.0  # [m] reduced distance d1 d2 / (d1 + d2) of the path that samples are measured for


class Looks:
    """The samples of a shape, and the facets of those that were asked for, in its own frame."""

    def __init__(self, shape: Shape, device: torch.device, wavelength: float):
        from scipy.spatial import KDTree  # loaded where a face is sampled

        samples = _sampled(shape, device)
        self.point, self.normal, curvature = samples.point, samples.normal, samples.curvature
        self.bounds = shape.bounds().to(device=device, dtype=torch.float64)
        self.wavelength = wavelength
        self.world = World(
            Scene((Node("/look", Body(shape, Conductor()), Pose.identity()),)), device
        )
        half = torch.full_like(curvature, 2.0 * LOOK)
        self.radius = zone_radius(half, half, torch.ones_like(half), curvature, wavelength)
        self.tree = KDTree(self.point.cpu().numpy())
        self.row = torch.full((len(self.point),), -1, dtype=torch.int64, device=device)
        self.facets: Facets | None = None

    def nearest(self, point: Float[Tensor, "m 3"]) -> Facets:
        """The facet of the sample nearest to each point."""
        return self.of(torch.from_numpy(self.tree.query(point.cpu().numpy())[1]).to(point.device))

    def of(self, sample: Int[Tensor, "m"]) -> Facets:
        """The facets of samples, measured when they are first asked for."""
        asked = torch.unique(sample)
        new = asked[self.row[asked] < 0]
        if len(new):
            self._measure(new)
        assert self.facets is not None
        return take(self.facets, self.row[sample])

    def _measure(self, new: Int[Tensor, "k"]) -> None:
        at = (torch.zeros_like(new), self.point[new], self.normal[new], self.radius[new])
        found = measure(self.world, *at, self.wavelength, 2, torch.float32)
        known = 0 if self.facets is None else len(self.facets.radius)
        self.row[new] = known + torch.arange(len(new), device=new.device)
        self.facets = found if self.facets is None else joined(self.facets, found)


_LOOKS: Recent[Looks] = Recent(MOST_CACHED)


def looks_at(shape: Shape, device: torch.device, wavelength: float) -> Looks:
    """Looks at a shape, kept like the samples themselves."""
    key = (id(shape), round(wavelength, 9))
    return _LOOKS.get(key, state_of(shape), lambda: Looks(shape, device, wavelength))


def _neighbourhood(point: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """(reach, curvature) of samples from their six nearest neighbours."""
    if len(point) <= NEIGHBOURS:
        far = torch.full_like(point[:, 0], torch.inf)
        return far, torch.zeros_like(far)
    from scipy.spatial import KDTree

    found = KDTree(point.cpu().numpy()).query(point.cpu().numpy(), k=NEIGHBOURS + 1)
    distance, index = (np.asarray(x) for x in found)
    away = torch.from_numpy(distance[:, 1:]).to(point)
    turn = (normal[torch.from_numpy(index[:, 1:]).to(point.device)] - normal[:, None]).norm(dim=-1)
    # a neighbour round a sharp edge is on another face and says nothing of how this one bends
    bend = torch.where(turn < SHARP, turn / away.clamp(min=1e-12), torch.zeros_like(turn))
    return away[:, -1], bend.amax(1)


NEIGHBOURS = 6
SHARP = 1.0  # normals this far apart (60 degrees) belong to different faces


def _shoot(shape: Shape, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Where rays from all around first meet the object, less its planar faces."""
    blank = torch.zeros(0, 3, dtype=torch.float64, device=device)
    nothing = (blank, blank, torch.zeros(0, dtype=torch.int64, device=device))
    bounds = shape.bounds().to(device=device, dtype=torch.float64)
    if shape.faceted or not bool(torch.isfinite(bounds).all()):
        return nothing
    origin, direction, length = _aim(bounds)
    if shape.convex:
        enter, leave = shape.interval(origin, direction)
        hit = leave > enter
    else:
        row, t, _ = march(shape, origin, direction, length, COARSE)
        enter = torch.full_like(length, torch.inf)
        enter = enter.scatter_reduce(0, row, t, "amin")
        hit = torch.isfinite(enter)
    point = origin[hit] + enter[hit, None] * direction[hit]
    normal_at = getattr(shape, "normal_at", None)
    normal = normal_at(point) if normal_at else unit(shape.value_and_gradient(point)[1])
    patch = shape.patch(point)
    flat = len(shape.planes())
    curved = torch.ones_like(patch, dtype=torch.bool) if not shape.exact else patch >= flat
    return point[curved], normal[curved], patch[curved]


def _aim(bounds: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rays from a sphere about the bounds to points spread through them (a Halton-like lattice)."""
    low, high = bounds
    centre, reach = 0.5 * (low + high), 1.05 * float((high - low).norm()) * 0.5
    k = torch.arange(SHOTS, dtype=torch.float64, device=bounds.device)
    # the plastic number's powers fill the cube evenly (Roberts 2018), the golden angle the sphere
    steps = torch.tensor([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])
    inside = low + torch.frac(0.5 + k[:, None] * steps.to(k)) * (high - low)
    origin = centre + reach * fibonacci(SHOTS, bounds.device)
    direction = unit(inside - origin)
    # begin at the bounds: a learned shape says nothing about the space outside them
    safe = torch.where(direction == 0, torch.full_like(direction, 1e-300), direction)
    ends = torch.stack([(low - origin) / safe, (high - origin) / safe])
    enter = ends.amin(0).amax(-1).clamp(min=0.0)
    leave = ends.amax(0).amin(-1)
    return origin + enter[:, None] * direction, direction, (leave - enter).clamp(min=0.0)
