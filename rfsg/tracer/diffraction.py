"""Edge diffraction: paths that bend round convex edges, and what an edge does to the wave.

Keller's law is Fermat's: the point on an edge is where the length of the path is stationary along it.
Planar mirrors before the first edge and after the last are unfolded into images of the two ends, so a
path is a source, one or two edges, and a destination. With t the arc lengths of its edge points,

    S = prod_i 1/s_i  prod_k sin(beta_k)  / sqrt|det H|,     H = d2L / dt2,

s_i the stretches between ends and edges: the stationary phase of waves that every point of the edges
sends out. For one straight edge it is 1 / sqrt(s s' (s + s')) (Kouyoumjian and Pathak 1974, Eq. 21);
for two parallel ones 1 / sqrt(s0 s1 s2 (s0 + s1 + s2)); for a rim it holds the edge's own curvature.
The rest of the field is the coefficient that ``wedge`` gives, in metres^(1/2) for each edge.
"""

import math
from collections import Counter
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import World, unit
from rfsg.tracer.edges import Edges, is_free
from rfsg.tracer.faces import Planes, planes_of
from rfsg.tracer.images import fold, images_of
from rfsg.tracer.implicit import segments
from rfsg.tracer.plan import Quality
from rfsg.tracer.prefixes import Budget, Prefixes, TooMany, levels
from rfsg.tracer.records import Act, Failed, Found, Only, Paths, Status
from rfsg.tracer.solve import COINCIDENT

ROUNDS = 30  # Newton steps; the length is convex along straight edges
HALVINGS = 12
SETTLED = 1e-12  # of the path's length: the last step of a converged edge point
RIM_LOOKS = 90  # places round a rim at which stationary points are looked for
SAME = 1e-9  # of the length: closer than this to an edge's end still belongs to it
MOST_PAIRS = 300_000_000  # sources x edges x destinations: a minute of closed forms
MOST_TWICE = 3_000_000  # pairs of edges between pairs of radios: a minute of Newton steps


@dataclass(frozen=True)
class Bends:
    """Candidate paths: mirrors before the edges, the edges with a first guess, mirrors after."""

    tx: Int[Tensor, "c"]
    rx: Int[Tensor, "c"]
    fore: Int[Tensor, "c i"]  # rows of Planes, from the transmitter on
    edge: Int[Tensor, "c k"]
    t: Float[Tensor, "c k"]
    aft: Int[Tensor, "c j"]  # rows of Planes, from the receiver back

    def take(self, i: Tensor) -> "Bends":
        return Bends(*(getattr(self, n)[i] for n in self.__dataclass_fields__))


def paths_of(
    world: World,
    edges: Edges,
    tx: Float[Tensor, "t 3"],
    rx: Float[Tensor, "r 3"],
    wavelength: float,
    quality: Quality,
    only: Only | None = None,
) -> Found:
    """Every path round one edge, with up to ``diffraction_depth - 1`` planar mirrors before and after
    it, and with ``diffraction=2`` round two straight edges without mirrors. only: which of them, if
    not all.

    Differentiable in poses, sizes and positions.
    """
    if not len(edges):
        return Found(left_out=("edge diffraction: no object has an edge that stands free",))
    said = f"edge diffraction round up to {quality.diffraction} of {len(edges)} edges"
    if only is not None and not any(
        bool(x.any()) for x in (only.node, only.tx, only.rx, only.edge)
    ):
        return Found(modelled=(said,))
    planes = planes_of(world)
    found: list[Paths] = []
    failed: list[Failed] = []
    counts: Counter[Status] = Counter()
    left_out: list[str] = []
    for stage in (_one_edge, _mirrors_and_an_edge, _two_edges):
        try:
            for bends in stage(planes, edges, tx, rx, quality, only):
                for i in torch.arange(len(bends.tx), device=tx.device).split(quality.chunk):
                    paths = _exact(world, planes, edges, bends.take(i), tx, rx, wavelength)
                    number = torch.bincount(paths.status, minlength=len(Status)).tolist()
                    counts.update({s: number[s] for s in Status if number[s]})
                    good = paths.status <= int(Status.CAUSTIC_CAPPED)
                    found.append(paths.take(torch.nonzero(good).squeeze(-1)))
                    failed.append(Failed.of(paths))
        except TooMany:
            left_out.append(
                f"diffraction, {_WHAT[stage]}: {len(edges)} edges, {len(tx)} transmitters and "
                f"{len(rx)} receivers have too many combinations; ask for fewer receivers at a time"
            )
    return Found(tuple(found), dict(counts), (said,), tuple(left_out), tuple(failed))


# the search: which mirrors and edges, without gradients. Each stage is done whole or not at all, so
# that what is followed does not depend on which end transmits.


@torch.no_grad()
def _one_edge(
    planes: Planes, edges: Edges, tx: Tensor, rx: Tensor, quality: Quality, only: Only | None
) -> list[Bends]:
    """Round one edge, no mirrors."""
    if not (len(edges) and quality.diffraction):
        return []
    budget = Budget(MOST_PAIRS)
    (fore,), (aft,) = (_prefixes(planes, ends, 0, budget) for ends in (tx, rx))
    return _bends(planes, edges, fore, aft, budget, only)


@torch.no_grad()
def _mirrors_and_an_edge(
    planes: Planes, edges: Edges, tx: Tensor, rx: Tensor, quality: Quality, only: Only | None
) -> list[Bends]:
    """Round one edge, with planar mirrors before it and after it."""
    mirrors = max(0, min(quality.depth, quality.diffraction_depth) - 1)
    if not (len(edges) and quality.diffraction and mirrors):
        return []
    budget = Budget(MOST_PAIRS)
    ahead, behind = (_prefixes(planes, ends, mirrors, budget) for ends in (tx, rx))
    found: list[Bends] = []
    for i in range(mirrors + 1):
        for j in range(mirrors + 1 - i):
            if i + j:
                found += _bends(planes, edges, ahead[i], behind[j], budget, only)
    return found


def _prefixes(
    planes: Planes, points: Float[Tensor, "n 3"], mirrors: int, budget: Budget
) -> list[tuple[Prefixes, Int[Tensor, "p"]]]:
    """Sequences of 0, 1, ... mirrors seen from points, and whose each is; up to one of all at a time."""
    if mirrors > 1:
        each = [levels(planes, p, mirrors, budget) for p in points]
        return [_stack([level[i] for level in each]) for i in range(mirrors + 1)]
    owner = torch.arange(len(points), device=points.device)
    found = [(Prefixes(points, owner[:, None][:, :0]), owner)]
    if mirrors:
        budget.spend(len(points) * len(planes))
        front = points @ planes.normal.T - planes.offset > 0
        owner, face = torch.nonzero(front, as_tuple=True)
        height = (points[owner] * planes.normal[face]).sum(-1) - planes.offset[face]
        image = points[owner] - 2.0 * height[:, None] * planes.normal[face]
        found.append((Prefixes(image, face[:, None]), owner))
    return found


def _stack(parts: list[Prefixes]) -> tuple[Prefixes, Int[Tensor, "p"]]:
    owner = [torch.full((len(p.image),), k, device=p.image.device) for k, p in enumerate(parts)]
    whole = Prefixes(torch.cat([p.image for p in parts]), torch.cat([p.faces for p in parts]))
    return whole, torch.cat(owner)


def _bends(
    planes: Planes,
    edges: Edges,
    ends: tuple[Prefixes, Int[Tensor, "p"]],
    others: tuple[Prefixes, Int[Tensor, "q"]],
    budget: Budget,
    only: Only | None,
) -> list[Bends]:
    """Images at both ends of every edge: in closed form where it is straight, looked up on a rim.

    ends, others: prefixes of the transmitters and of the receivers, and whose each is.
    """
    (fore, t), (aft, r) = ends, others
    found = []
    budget.spend(len(t) * len(r) * len(edges))
    for each, ahead, behind in _wanted(planes, edges, ends, others, only):
        most = max(1, 2_000_000 // (64 * max(len(behind), 1)))
        for some in each.split(64):
            own = edges.take(some)
            for a in ahead.split(most):
                row, column, e, place = _stationary(own, fore.image[a], aft.image[behind])
                i, j, edge = a[row], behind[column], some[e][:, None]
                found.append(Bends(t[i], r[j], fore.faces[i], edge, place[:, None], aft.faces[j]))
    return found


def _wanted(
    planes: Planes,
    edges: Edges,
    ends: tuple[Prefixes, Tensor],
    others: tuple[Prefixes, Tensor],
    only: Only | None,
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Blocks (edges, prefixes, prefixes) that hold all that is asked for, each once."""
    device = edges.node.device
    every = [torch.arange(len(x), device=device) for x in (edges.node, ends[1], others[1])]
    if only is None:
        return [(every[0], every[1], every[2])]
    fore, aft = (
        radio[owner] | only.node[planes.node[prefixes.faces]].any(1)
        for (prefixes, owner), radio in ((ends, only.tx), (others, only.rx))
    )
    known = torch.nonzero(~only.edge).squeeze(-1)
    blocks = [(torch.nonzero(only.edge).squeeze(-1), every[1], every[2])]
    blocks += [(known, i, j) for i, j in Only.pairs(fore, aft)]
    return [block for block in blocks if all(map(len, block))]


def _stationary(edges: Edges, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(row of a, row of b, edge, t) of all stationary points that both ends see from outside."""
    straight = torch.nonzero(edges.straight).squeeze(-1)
    own = edges.take(straight)
    za, ra, seen_a = _cylindrical(own, a)
    zb, rb, seen_b = _cylindrical(own, b)
    both = ra[:, None] + rb[None]
    z = (za[:, None] * rb[None] + zb[None] * ra[:, None]) / both.clamp(min=1e-300)
    slack = SAME * own.length
    on = (z >= -slack) & (z <= own.length + slack) & seen_a[:, None] & seen_b[None] & (both > 0)
    i, j, e = torch.nonzero(on, as_tuple=True)
    found = [(i, j, straight[e], z[i, j, e])]
    rims = torch.nonzero(~edges.straight).squeeze(-1)
    if len(rims):
        i, j, e, t = _on_rims(edges.take(rims), a, b)
        found.append((i, j, rims[e], t))
    i, j, e, t = (torch.cat(x) for x in zip(*found, strict=True))
    return i, j, e, t


def _cylindrical(edges: Edges, p: Float[Tensor, "p 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Height along, distance from, and whether outside of, every straight edge [p e]."""
    away = p[:, None] - edges.start[None]
    z = (away * edges.along).sum(-1)
    across = away - z[..., None] * edges.along
    n, e = len(p), len(edges)
    flat = edges.take(torch.arange(e, device=p.device).repeat(n))
    turn = flat.angle(z.reshape(-1), across.reshape(-1, 3)).reshape(n, e)
    return z, across.norm(dim=-1), _outside(edges, turn)


def _outside(edges: Edges, turn: Tensor) -> Bool[Tensor, "*b"]:
    """Angles within the exterior of their wedge; a hair below a face is on it."""
    return (turn >= -GRAZING) & (turn <= math.pi * edges.opening + GRAZING)


GRAZING = 1e-9  # [rad]


def _on_rims(edges: Edges, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where the slope of the length changes sign between looks around each rim."""
    e = len(edges)
    share = torch.arange(RIM_LOOKS, dtype=a.dtype, device=a.device) / RIM_LOOKS
    look = edges.take(torch.arange(e, device=a.device).repeat_interleave(RIM_LOOKS))
    t = (edges.length[:, None] * share).reshape(-1)
    place, tangent, _ = look.point(t)
    pull = [
        (unit(place[None] - end[:, None]) * tangent).sum(-1).reshape(-1, e, RIM_LOOKS)
        for end in (a, b)
    ]
    slope = pull[0][:, None] + pull[1][None]
    following = slope.roll(-1, -1)
    turns = (slope == 0) | (slope * following < 0)
    i, j, k, s = torch.nonzero(turns, as_tuple=True)
    here, after = slope[i, j, k, s], following[i, j, k, s]
    gone = here / torch.where(here == after, torch.ones_like(here), here - after)
    return i, j, k, edges.length[k] * (share[s] + gone / RIM_LOOKS)


@torch.no_grad()
def _two_edges(
    planes: Planes, edges: Edges, tx: Tensor, rx: Tensor, quality: Quality, only: Only | None
) -> list[Bends]:
    """Ordered pairs of straight edges: of one object with a face in common, or of two objects."""
    straight = torch.nonzero(edges.straight).squeeze(-1)
    if quality.diffraction < 2 or len(straight) < 2:
        return []
    own = edges.take(straight)
    n = len(own)
    Budget(MOST_PAIRS).spend(n * n)
    share = torch.zeros(n, n, dtype=torch.bool, device=tx.device)
    for first in (own.patch0, own.patch1):
        for second in (own.patch0, own.patch1):
            share |= first[:, None] == second[None]
    same = own.node[:, None] == own.node[None]
    pairs = (share | ~same) & _face_each_other(own)
    pairs.fill_diagonal_(False)
    seen = [_cylindrical(own, end)[2] for end in (tx, rx)]
    budget, found = Budget(MOST_TWICE), []
    for t in range(len(tx)):
        for r in range(len(rx)):
            a, b = torch.nonzero(pairs & seen[0][t][:, None] & seen[1][r][None], as_tuple=True)
            budget.spend(len(a))
            if only is not None and not bool(only.tx[t] | only.rx[r]):
                marked = (only.edge[straight[a]] | only.edge[straight[b]]).nonzero().squeeze(-1)
                a, b = a[marked], b[marked]
            edge = torch.stack([straight[a], straight[b]], 1)
            none = torch.zeros(len(a), 0, dtype=torch.int64, device=tx.device)
            ends = (torch.full_like(a, t), torch.full_like(a, r))
            found.append(Bends(*ends, none, edge, 0.5 * edges.length[edge], none))
    return found


def _face_each_other(edges: Edges) -> Bool[Tensor, "e e"]:
    """Edges of which some end lies outside of the other's wedge, and the other way about."""
    ends = [edges.point(share * edges.length)[0] for share in (0.0, 1.0)]
    outside = _cylindrical(edges, ends[0])[2] | _cylindrical(edges, ends[1])[2]
    return outside & outside.T


_WHAT = {
    _one_edge: "one edge",
    _mirrors_and_an_edge: "mirrors before or after an edge",
    _two_edges: "two edges",
}


# the exact path, with gradients


def _exact(
    world: World,
    planes: Planes,
    edges: Edges,
    bends: Bends,
    tx: Tensor,
    rx: Tensor,
    wavelength: float,
) -> Paths:
    fore = [(planes.node[f], planes.patch[f]) for f in bends.fore.unbind(1)]
    aft = [(planes.node[f], planes.patch[f]) for f in bends.aft.unbind(1)]
    before = images_of(world, fore, tx[bends.tx])
    behind = images_of(world, aft, rx[bends.rx])
    some = edges.take(bends.edge.reshape(-1))
    c, k = bends.edge.shape
    with torch.no_grad():
        t, settled = _newton(some, bends.t, before.image, behind.image)
    t = _implicit_step(some, t, before.image, behind.image)
    line = _Line(some, t, before.image, behind.image)
    first, first_on = fold(world, before, fore, line.place[:, 0])
    last, last_on = fold(world, behind, aft, line.place[:, -1])
    ends = tx[bends.tx][:, None], rx[bends.rx][:, None]
    vertices = torch.cat([ends[0], first, line.place, last.flip(1), ends[1]], 1)
    hessian, sine = line.hessian, line.sine
    rim = ~some.straight.reshape(c, k)
    floor = torch.where(rim, wavelength / some.length.reshape(c, k) ** 2, 0.0).amax(1)
    bent, capped, caustics = _held(hessian, floor)
    spread = sine.prod(1) / (line.length.clamp(min=1e-300).prod(1) * bent)
    which = torch.cat(
        [_column(fore, 0, c, some), some.node.reshape(c, k), _column(aft, 0, c, some).flip(1)], 1
    )
    item = torch.cat([_column(fore, 1, c, some), bends.edge, _column(aft, 1, c, some).flip(1)], 1)
    act = torch.zeros_like(which)
    act[:, len(fore) : len(fore) + k] = int(Act.DIFFRACT)
    normal0, normal1 = some.normals(t.reshape(-1))
    middle = unit(normal0 + normal1).reshape(c, k, 3)
    normal = torch.cat([before.normal, middle, behind.normal.flip(1)], 1)
    length = segments(vertices)[0]
    with torch.no_grad():
        status = torch.where(capped, int(Status.CAUSTIC_CAPPED), int(Status.OK))
        inside = line.within() & first_on & last_on
        i = torch.nonzero(inside[:, None].expand(c, k).reshape(-1)).squeeze(-1)
        free = torch.ones(c * k, dtype=torch.bool, device=t.device)
        free[i] = is_free(world, some.take(i), t.reshape(-1)[i], wavelength)
        inside &= free.reshape(c, k).all(1)
        status = torch.where(inside, status, int(Status.OFF_SURFACE))
        status = torch.where(settled, status, int(Status.NOT_CONVERGED))
        degenerate = (length <= COINCIDENT).any(1) | (sine <= 0).any(1) | ~torch.isfinite(spread)
        status = torch.where(degenerate, int(Status.DEGENERATE), status)
    return Paths(
        bends.tx, bends.rx, which, act, item, vertices, normal, length.sum(1), spread,
        caustics, status,
    )  # fmt: skip


def _column(faces: list[tuple[Tensor, Tensor]], k: int, c: int, some: Edges) -> Tensor:
    none = torch.zeros(c, 0, dtype=torch.int64, device=some.node.device)
    return torch.stack([f[k] for f in faces], 1) if faces else none


class _Line:
    """Source, edge points, destination at given arc lengths: lengths, slope and Hessian of L(t)."""

    def __init__(self, some: Edges, t: Tensor, a: Tensor, b: Tensor):
        c, k = t.shape
        self.some, self.t = some, t
        place, tangent, bend = (x.reshape(c, k, 3) for x in some.point(t.reshape(-1)))
        self.place, self.tangent = place, tangent
        self.length, self.u = segments(torch.cat([a[:, None], place, b[:, None]], 1))
        turn = self.u[:, :-1] - self.u[:, 1:]
        self.slope = (turn * tangent).sum(-1)
        # |u x p'|^2: what a step along the edge moves across a segment
        before = (self.u[:, :-1] * tangent).sum(-1)
        after = (self.u[:, 1:] * tangent).sum(-1)
        inverse = 1.0 / self.length.clamp(min=1e-300)
        h = torch.zeros(c, k, k, dtype=t.dtype, device=t.device)
        diagonal = (
            (1 - before**2) * inverse[:, :-1]
            + (1 - after**2) * inverse[:, 1:]
            + (turn * bend).sum(-1)
        )
        h = h + torch.diag_embed(diagonal)
        if k == 2:
            mixed = (tangent[:, 0] * tangent[:, 1]).sum(-1) - after[:, 0] * before[:, 1]
            swap = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=t.dtype, device=t.device)
            h = h - (mixed * inverse[:, 1])[:, None, None] * swap
        self.hessian = h
        self.sine = torch.linalg.cross(self.u[:, :-1], tangent).norm(dim=-1)

    def within(self) -> Bool[Tensor, "c"]:
        """Edge points on their edges, met and left from outside of their wedges."""
        c, k = self.t.shape
        length = self.some.length.reshape(c, k)
        slack = SAME * length
        rim = ~self.some.straight.reshape(c, k)
        on = ((self.t >= -slack) & (self.t <= length + slack)) | rim
        flat = self.t.reshape(-1)
        for away in (-self.u[:, :-1], self.u[:, 1:]):
            turn = self.some.angle(flat, away.reshape(-1, 3))
            on &= _outside(self.some, turn).reshape(c, k)
        return on.all(1)


def _newton(some: Edges, t: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Bool[Tensor, "c"]]:
    """dL/dt = 0 from t; each step is halved until the slope falls, which Newton's direction allows."""
    line = _Line(some, t, a, b)
    settled = torch.zeros(len(t), dtype=torch.bool, device=t.device)
    for _ in range(ROUNDS):
        step = _solve(line.hessian, line.slope)
        share = torch.ones_like(t[:, :1])
        for _ in range(HALVINGS):
            ahead = _Line(some, t - share * step, a, b)
            rises = ahead.slope.square().sum(1) > line.slope.square().sum(1)
            if not bool(rises.any()):
                break
            share = torch.where(rises[:, None], 0.5 * share, share)
        # what no halving mends has come to rest: its slope is rounding
        share = torch.where(rises[:, None], torch.zeros_like(share), share)
        t = t - share * step
        line = _Line(some, t, a, b)
        rounding = 64 * 2.0**-52 * line.place.abs().amax((1, 2))
        least = SETTLED * line.length.sum(1) + rounding
        settled = step.abs().amax(1) <= least
        if bool((settled | rises).all()):
            break
    return t, settled


def _implicit_step(some: Edges, t: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """The same arc lengths, now carrying gradients: t - H^-1 dL/dt with H held fixed."""
    line = _Line(some, t, a, b)
    return t - _solve(line.hessian.detach(), line.slope)


def _solve(hessian: Float[Tensor, "c k k"], right: Float[Tensor, "c k"]) -> Float[Tensor, "c k"]:
    if hessian.shape[1] == 1:
        h = hessian[:, :, 0]
        return torch.where(h == 0, torch.zeros_like(right), right / torch.where(h == 0, 1.0, h))
    det = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    safe = torch.where(det == 0, torch.ones_like(det), det)
    first = (hessian[:, 1, 1] * right[:, 0] - hessian[:, 0, 1] * right[:, 1]) / safe
    second = (hessian[:, 0, 0] * right[:, 1] - hessian[:, 0, 1] * right[:, 0]) / safe
    return torch.where(det[:, None] == 0, 0.0, torch.stack([first, second], 1))


TINY = 1e-200  # keeps the root of nothing differentiable


def _held(
    hessian: Float[Tensor, "c k k"], floor: Float[Tensor, "c"]
) -> tuple[Tensor, Bool[Tensor, "c"], Int[Tensor, "c"]]:
    """sqrt|det H|, which were held, and how many directions are maxima (caustics passed).

    On a rim no bend below lambda / length^2: the stretch that acts is never longer than the rim. A
    straight edge has no caustic.
    """
    if hessian.shape[1] == 1:
        bend = hessian[:, 0, 0]
        capped = bend.abs() < floor
        return (
            torch.sqrt(torch.where(capped, floor, bend.abs()).clamp(min=TINY)),
            capped,
            ((bend < 0) & ~capped).long(),
        )
    det = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    capped = det <= floor**2
    down = torch.linalg.eigvalsh(hessian.detach()) < 0
    held = torch.where(capped, floor**2, det).clamp(min=TINY)
    return torch.sqrt(held), capped, (down & ~capped[:, None]).sum(1)
