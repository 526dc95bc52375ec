"""Where refracted paths may lie: pencils of rays through solids, looked up for receivers.

From a source a lattice of rays is sent at one solid and followed through every solid that bends it.
What leaves is a map from the lattice to the plane across each ray at a receiver, and a path is a zero
of that map. Looked for by linear interpolation in every triangle of the lattice whose rays meet the
same smooth faces; and, since a zero may hide beside the last ray that meets a face, wherever a ray
passes the receiver nearer than its neighbours. Between plane faces that is enough: sums of distances
to planes are convex, and any ray through the same faces leads Newton to the only path there is.
Complete up to the lattice's spacing; no gradients.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.surfaces.solid import PARALLEL
from rfsg.scene.world import FLUSH, World, unit
from rfsg.tracer.embree import Proxies
from rfsg.tracer.implicit import transverse
from rfsg.tracer.passages import Runs, every_crossing, merged
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Rays

LATTICE = 48  # rays along either side of the lattice that is sent at a solid
MOST_SOLIDS = 3  # that a ray is followed through
MARGIN = 0.5  # of a triangle's size: how far beyond its sides a zero is still taken
AT_ONCE = 512  # questions: bounds memory
BESIDE = 0.02  # of a lattice's size, by which it is wider than the solid


@dataclass(frozen=True)
class Sights:
    """Questions: which paths lead from ``source`` through the solid ``aim`` to ``target``?

    A source may be an image in a mirror: its rays begin at the plane n.x = offset (n = 0: at itself).
    """

    source: Float[Tensor, "q 3"]
    target: Float[Tensor, "q 3"]
    aim: Int[Tensor, "q"]
    normal: Float[Tensor, "q 3"]
    offset: Float[Tensor, "q"]

    def take(self, i: Tensor) -> "Sights":
        return Sights(*(getattr(self, n)[i] for n in self.__dataclass_fields__))


@dataclass(frozen=True)
class Seeds:
    """Candidates: where paths enter and leave solids, by turns, and the question they answer."""

    question: Int[Tensor, "c"]
    which: Int[Tensor, "c d"]
    patch: Int[Tensor, "c d"]
    x: Float[Tensor, "c d 3"]


@dataclass(frozen=True)
class Beams:
    """Rays of lattices as they leave a solid; ``lattice`` and ``place`` say whose and which."""

    lattice: Int[Tensor, "r"]
    place: Int[Tensor, "r"]
    rays: Rays
    which: Int[Tensor, "r d"]
    patch: Int[Tensor, "r d"]
    x: Float[Tensor, "r d 3"]

    def take(self, i: Tensor) -> "Beams":
        rays = self.rays.take(i)
        rest = (self.which[i], self.patch[i], self.x[i])
        return Beams(self.lattice[i], self.place[i], rays, *rest)


def solid_runs(
    world: World, proxies: Proxies, rays: Rays, bending: Bool[Tensor, "n"], quality: Quality
) -> Runs:
    """Stretches of rays inside bending solids, but for what a ray touches by rounding."""
    runs = merged(world, every_crossing(world, proxies, rays, quality, bending))
    return runs.take(runs.leave - runs.enter > FLUSH)


def parallel(world: World, rays: Rays, runs: Runs) -> Bool[Tensor, "m"]:
    """Stretches from one plane face to another that is parallel to it: they are slabs, and bend
    nothing."""
    o, d = rays.origin[runs.ray], rays.direction[runs.ray]
    through = (runs.normal_enter.abs().sum(-1) > 0) & (runs.normal_leave.abs().sum(-1) > 0)
    through &= torch.isfinite(runs.leave)
    start = o + runs.enter[:, None] * d
    end = o + torch.where(through, runs.leave, runs.enter)[:, None] * d
    opposite = (runs.normal_enter + runs.normal_leave).norm(dim=-1) <= PARALLEL
    flat = world.is_flat(runs.which, start) & world.is_flat(runs.last, end)
    return through & opposite & flat


@torch.no_grad()
def seeds(
    world: World,
    proxies: Proxies,
    sights: Sights,
    bending: Bool[Tensor, "n"],
    index: Float[Tensor, "n"],
    quality: Quality,
) -> Iterator[Seeds]:
    """Candidates for every question, by how many solids they lead through."""
    if not len(sights.aim):
        return
    key = torch.cat(
        [sights.source, sights.aim[:, None].double(), sights.normal, sights.offset[:, None]], 1
    )
    _, of_question = torch.unique(key, dim=0, return_inverse=True)
    count = int(of_question.max()) + 1
    one = torch.zeros(count, dtype=torch.int64, device=world.device)
    one[of_question] = torch.arange(len(key), device=world.device)  # any question of each lattice
    block = max(1, quality.chunk // LATTICE**2)
    for some in torch.arange(count, device=world.device).split(block):
        asked = torch.nonzero((of_question >= some[0]) & (of_question <= some[-1])).squeeze(-1)
        beams = _launch(world, sights.take(one[some]))
        for _ in range(MOST_SOLIDS):
            beams = _through_next(world, proxies, beams, bending, index, quality)
            if not len(beams.lattice):
                break
            for part in asked.split(AT_ONCE):
                mine, targets = of_question[part] - some[0], sights.target[part]
                for found in (_nearest, _by_triangles):
                    q, x, ray = found(world, beams, mine, targets)
                    if len(q):
                        yield Seeds(part[q], beams.which[ray], beams.patch[ray], x)


def _launch(world: World, sights: Sights) -> Beams:
    """Rays on a lattice of equal solid angles (Lambert's azimuthal projection) that covers a solid."""
    centre, box, longest, around = _outline(world, sights)
    c = unit(centre - sights.source)
    e1 = longest - (longest * c).sum(-1, keepdim=True) * c
    along = (e1 * e1).sum(-1, keepdim=True) < 1e-6
    e1 = torch.where(along, transverse(c)[:, 0], unit(e1))
    e2 = torch.linalg.cross(c, e1)
    to = unit(box - sights.source[:, None])
    stretch = torch.sqrt(2.0 / (1.0 + (to * c[:, None]).sum(-1)).clamp(min=1e-3))
    flat = torch.stack([(to * e[:, None]).sum(-1) * stretch for e in (e1, e2)], -1)
    low, high = flat.amin(1), flat.amax(1)
    low = torch.where(around[:, None], -2.0, low - BESIDE * (high - low))
    high = torch.where(around[:, None], 2.0, high + BESIDE * (high - low))
    step = torch.linspace(0.0, 1.0, LATTICE, dtype=torch.float64, device=world.device)
    place = torch.cartesian_prod(step, step)
    ab = low[:, None] + place * (high - low)[:, None]
    square = (ab * ab).sum(-1)
    sine = torch.sqrt((1.0 - 0.25 * square).clamp(min=0.0))
    d = (1.0 - 0.5 * square)[..., None] * c[:, None] + sine[..., None] * (
        ab[..., :1] * e1[:, None] + ab[..., 1:] * e2[:, None]
    )
    start, within = _from_mirror(sights, d, square < 4.0)
    lattice, number = torch.nonzero(within, as_tuple=True)
    o, d = start[lattice, number], d[lattice, number]
    none = lattice[:, None][:, :0]
    rays = Rays(o, d, torch.full_like(o[:, 0], torch.inf))
    return Beams(lattice, number, rays, none, none, o[:, None][:, :0])


def _outline(world: World, sights: Sights) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centre, points of the bounding box, its longest axis, and whether the source is in the box."""
    low, high = world.bounds_object[sights.aim].unbind(1)
    fifth = torch.linspace(0.0, 1.0, 5, dtype=torch.float64, device=world.device)
    share = torch.cartesian_prod(fifth, fifth, fifth)
    local = low[:, None] + share * (high - low)[:, None]
    aim = sights.aim.repeat_interleave(len(share))
    box = world.point_world(aim, local.reshape(-1, 3)).reshape(local.shape)
    axis = torch.zeros_like(low).scatter(1, (high - low).argmax(1, keepdim=True), 1.0)
    source = world.point_object(sights.aim, sights.source)
    around = ((source > low) & (source < high)).all(-1)
    return box.mean(1), box, world.direction_world(sights.aim, axis), around


def _from_mirror(sights: Sights, d: Tensor, within: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays from a source or an image begin, and which do."""
    slope = torch.einsum("lrj,lj->lr", d, sights.normal)
    height = (sights.offset - (sights.source * sights.normal).sum(-1))[:, None]
    itself = (sights.normal == 0).all(-1)[:, None]
    ahead = itself | (height * slope > 0)
    t = torch.where(itself | ~ahead, 0.0, height / torch.where(ahead & ~itself, slope, 1.0))
    return sights.source[:, None] + t[..., None] * d, within & ahead


def _through_next(
    world: World,
    proxies: Proxies,
    beams: Beams,
    bending: Bool[Tensor, "n"],
    index: Float[Tensor, "n"],
    quality: Quality,
) -> Beams:
    """Rays through the next solid that bends them; those that meet none, or stay in, end."""
    runs = solid_runs(world, proxies, beams.rays, bending, quality)
    outside = (runs.normal_enter.abs().sum(-1) > 0) & ~parallel(world, beams.rays, runs)
    runs = _first(runs.take(outside))
    beams = beams.take(runs.ray)
    n = index[runs.which]
    into = beams.rays.origin + runs.enter[:, None] * beams.rays.direction
    d, _ = snell(beams.rays.direction, runs.normal_enter, 1.0 / n)
    inside = Rays(into, d, torch.full_like(n, torch.inf))
    beams = _met(world, beams, runs.which, into)
    rest = solid_runs(world, proxies, inside, bending, quality)
    mine = (world.medium[rest.which] == world.medium[runs.which[rest.ray]]) & (rest.enter <= FLUSH)
    rest = _first(rest.take(mine & torch.isfinite(rest.leave)))
    beams, n = beams.take(rest.ray), n[rest.ray]
    out = into[rest.ray] + rest.leave[:, None] * d[rest.ray]
    u, passes = snell(d[rest.ray], -rest.normal_leave, n)
    beams = _met(world, beams, rest.last, out)
    leaving = Rays(out, u, beams.rays.limit)
    everything = (beams.lattice, beams.place, leaving, beams.which, beams.patch, beams.x)
    return Beams(*everything).take(torch.nonzero(passes).squeeze(-1))


def _first(runs: Runs) -> Runs:
    """The first stretch of every ray (they come sorted)."""
    first = torch.ones(len(runs.ray), dtype=torch.bool, device=runs.ray.device)
    first[1:] = runs.ray[1:] != runs.ray[:-1]
    return runs.take(first)


def snell(
    u: Float[Tensor, "r 3"], normal: Float[Tensor, "r 3"], ratio: Float[Tensor, "r"]
) -> tuple[Float[Tensor, "r 3"], Bool[Tensor, "r"]]:
    """Directions behind an interface, and which are not totally reflected; the normal looks towards
    where u comes from, and ratio is the index there over that behind (Born and Wolf, section 3.2.2)."""
    cosine = -(u * normal).sum(-1)
    square = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    behind = torch.sqrt(square.clamp(min=0.0))
    return unit(ratio[:, None] * u + (ratio * cosine - behind)[:, None] * normal), square > 0


def _met(world: World, beams: Beams, which: Tensor, x: Tensor) -> Beams:
    patch = world.patch(which, x)
    return Beams(
        beams.lattice,
        beams.place,
        beams.rays,
        torch.cat([beams.which, which[:, None]], 1),
        torch.cat([beams.patch, patch[:, None]], 1),
        torch.cat([beams.x, x[:, None]], 1),
    )


def _faces(world: World, beams: Beams) -> tuple[Int[Tensor, "r d"], Bool[Tensor, "r"]]:
    """What tells the faces of rays apart (smooth pieces of one object are one), and which rays pass
    plane faces only."""
    flat = world.plane(beams.which.reshape(-1), beams.patch.reshape(-1))[2]
    flat = flat.reshape(beams.which.shape)
    most = int(beams.patch.max()) + 2
    return beams.which * most + torch.where(flat, beams.patch + 1, 0), flat.all(1)


def _miss(beams: Beams, ray: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """From rays to targets, across the rays; and which targets lie ahead."""
    o, d = beams.rays.origin[ray], beams.rays.direction[ray]
    along = ((target - o) * d).sum(-1)
    return target - o - along[:, None] * d, along > 0


def _nearest(
    world: World, beams: Beams, lattice: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Rays that pass targets nearer than all their neighbours on the lattice through the same faces."""
    face, _ = _faces(world, beams)
    _, sequence = torch.unique(face, dim=0, return_inverse=True)
    row = _grid(beams, int(lattice.max()) + 1)[lattice]
    there = row >= 0
    ray, side = row.clamp(min=0), LATTICE + 2
    aim = target[:, None, None].expand(*row.shape, 3)
    away, ahead = _miss(beams, ray.reshape(-1), aim.reshape(-1, 3))
    square = (away * away).sum(-1).reshape(row.shape)
    there &= ahead.reshape(row.shape)
    pad = torch.nn.functional.pad
    square, code = pad(square, (1, 1, 1, 1)), torch.where(there, sequence[ray], -1)
    code = pad(code, (1, 1, 1, 1), value=-1)
    middle = slice(1, side - 1)
    least = there
    for i in range(3):
        for j in range(3):
            beside = (slice(None), slice(i, i + LATTICE), slice(j, j + LATTICE))
            nearer = square[beside] < square[:, middle, middle]
            least = least & ~(nearer & (code[beside] == code[:, middle, middle]))
    q, i, j = torch.nonzero(least, as_tuple=True)
    best = row[q, i, j]
    return q, beams.x[best], best


def _by_triangles(
    world: World, beams: Beams, lattice: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Zeros of the rays' miss, interpolated in the triangles whose rays meet the same faces."""
    face, flat = _faces(world, beams)
    corners = _triangles(beams)
    same = (face[corners] == face[corners[:, :1]]).all(-1).all(-1) & ~flat[corners[:, 0]]
    corners = corners[same]
    q, tri = _pairs(lattice, beams.lattice[corners[:, 0]])
    away, ahead = _miss(beams, corners[tri].reshape(-1), target[q].repeat_interleave(3, 0))
    ahead = ahead.reshape(-1, 3).all(1)
    q, tri, away = q[ahead], tri[ahead], away.reshape(-1, 3, 3)[ahead]
    across = transverse(unit(beams.rays.direction[corners[tri]].sum(1)))
    weight, regular = _zero(away @ across.mT)
    hit = torch.nonzero(regular & (weight.amin(1) >= -MARGIN)).squeeze(-1)
    inner = weight[hit].clamp(min=0.0)
    ray = corners[tri[hit]]
    x = torch.einsum("hk,hkdj->hdj", inner / inner.sum(1, keepdim=True), beams.x[ray])
    return q[hit], x, ray[:, 0]


def _zero(miss: Float[Tensor, "t 3 2"]) -> tuple[Float[Tensor, "t 3"], Bool[Tensor, "t"]]:
    """Weights of a triangle's corners for which the interpolated miss is zero. Where all rays meet
    in one point there is nothing to solve: the middle, if that point is the target."""
    a, b = miss[:, 1] - miss[:, 0], miss[:, 2] - miss[:, 0]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    size = (a * a).sum(-1) + (b * b).sum(-1)
    regular = det.abs() > 1e-9 * size
    safe = torch.where(regular, det, 1.0)
    c = -miss[:, 0]
    w1 = (c[:, 0] * b[:, 1] - c[:, 1] * b[:, 0]) / safe
    w2 = (a[:, 0] * c[:, 1] - a[:, 1] * c[:, 0]) / safe
    middle = torch.full_like(w1, 1.0 / 3.0)
    met = ~regular & ((c * c).sum(-1) <= size)
    w1, w2 = torch.where(met, middle, w1), torch.where(met, middle, w2)
    return torch.stack([1.0 - w1 - w2, w1, w2], 1), regular | met


def _grid(beams: Beams, count: int) -> Int[Tensor, "l n n"]:
    """The row in ``beams`` of every ray of the lattices; -1 where it is not there."""
    row = torch.full((count * LATTICE**2,), -1, dtype=torch.int64, device=beams.lattice.device)
    mine = beams.lattice < count
    number = torch.arange(len(beams.lattice), device=row.device)
    row[(beams.lattice * LATTICE**2 + beams.place)[mine]] = number[mine]
    return row.reshape(count, LATTICE, LATTICE)


def _triangles(beams: Beams) -> Int[Tensor, "t 3"]:
    """Triangles of the lattices of which all three rays are there, as rows of ``beams``."""
    grid = _grid(beams, int(beams.lattice.max()) + 1)
    a, b = grid[:, :-1, :-1], grid[:, 1:, :-1]
    c, d = grid[:, :-1, 1:], grid[:, 1:, 1:]
    corners = torch.cat([torch.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (d, b, c))])
    corners = corners[(corners >= 0).all(1)]
    return corners[torch.argsort(beams.lattice[corners[:, 0]], stable=True)]


def _pairs(
    lattice: Int[Tensor, "q"], owner: Int[Tensor, "m"]
) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """(question, item) for all items of each question's lattice; owners come sorted."""
    count = int(max(lattice.max(), owner.max())) + 1 if len(owner) and len(lattice) else 0
    number = torch.bincount(owner, minlength=count)
    begin = torch.cumsum(number, 0) - number
    mine = number[lattice] if count else torch.zeros_like(lattice)
    q = torch.repeat_interleave(torch.arange(len(lattice), device=lattice.device), mine)
    if not len(q):
        return q, q
    within = torch.arange(len(q), device=q.device) - (torch.cumsum(mine, 0) - mine)[q]
    return q, begin[lattice[q]] + within
