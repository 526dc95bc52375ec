"""Refraction: paths that bend at the faces of solids.

A straight path through a solid whose faces are not parallel does not exist; in its place stand paths
that are stationary in their optical length sum n_i |x_{i+1} - x_i| (Fermat), with a vertex where they
enter and one where they leave: Snell's law at each, found as mirrors are, by Newton on the Lagrangian.

Power in a ray tube changes at each face by the power transmittance 1 - |R|^2 alone, and what the tube
does to the field is in S, for S^2 = dOmega / dA holds whatever bends the rays (``implicit``). So with
R the half-space's reflection at the angle outside, each face is sqrt(1 - R^2), TE and TM, and the way
between them exp(-j k (n_c - 1) L) relative to free space, whose delay the path's length counts. For
parallel faces that is the first term of the slab's series. Geometry uses n = Re sqrt(eps_c) at the
first frequency; at others the path's first-order change costs no phase (Fermat again).

Found: for every straight path that a solid bends, the path that it turns into as the index grows from
1; and, because paths may vanish, multiply and begin on that way (past a focus none of them is the one
we started from), what a lattice of rays through the solid finds (``pencils``). Direct links look
beside the straight line, too. Not followed: echoes inside a solid, and what leaves it after them.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.scene.world import FLUSH, World, unit
from rfsg.tracer import pencils
from rfsg.tracer.acting import Acting, dyad_of, scalar
from rfsg.tracer.embree import Proxies
from rfsg.tracer.implicit import caustics, multipliers, segments, spreading
from rfsg.tracer.march import FORWARD
from rfsg.tracer.newton import Batch, newton, surfaces_of
from rfsg.tracer.passages import Runs
from rfsg.tracer.pencils import Sights, parallel, solid_runs
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act, Found, Paths, Rays, Status, runs_in
from rfsg.tracer.solve import GRAZING, duplicates, implicit_step, on_faces

STEPS = 4  # of the index, from 1 to what it is
ROUNDS = 6  # of Newton's method at each but the last: near enough for the next
MOST_SIGHTS = 20_000  # lattices of rays: some minutes' worth
SAME = 1e-5  # of the solids' size: paths nearer to each other are one


@dataclass(frozen=True)
class Chain:
    """Candidates of one number of vertices; ``row`` is the straight path that each belongs to."""

    row: Int[Tensor, "c"]
    which: Int[Tensor, "c d"]
    act: Int[Tensor, "c d"]
    patch: Int[Tensor, "c d"]
    x: Float[Tensor, "c d 3"]

    def take(self, i: Tensor) -> "Chain":
        return Chain(*(getattr(self, n)[i] for n in self.__dataclass_fields__))

    @staticmethod
    def joined(parts: "list[Chain]") -> "Chain":
        """All candidates of several records of one depth."""
        return Chain(
            *(torch.cat([getattr(p, n) for p in parts]) for n in Chain.__dataclass_fields__)
        )


@dataclass(frozen=True)
class Bender:
    """What all steps need: which nodes bend, and every node's index (1 where it is no solid)."""

    world: World
    proxies: Proxies
    bending: Bool[Tensor, "n"]
    index: Float[Tensor, "n"]
    wavelength: float
    quality: Quality

    def along(self, which: Tensor, act: Tensor) -> Float[Tensor, "c s"]:
        """Index of refraction of each segment."""
        solid = runs_in(which, act)
        return torch.where(solid >= 0, self.index[solid.clamp(min=0)], 1.0)

    def runs(self, vertices: Float[Tensor, "c v 3"]) -> tuple[Tensor, Tensor, Rays, Runs]:
        """Stretches of polylines in bending solids: (row, segment) of every ray, rays, stretches."""
        length, u = segments(vertices)
        row, segment = torch.nonzero(length > 0, as_tuple=True)
        rays = Rays(vertices[row, segment], u[row, segment], length[row, segment])
        found = solid_runs(self.world, self.proxies, rays, self.bending, self.quality)
        return row, segment, rays, found


def bend(
    world: World,
    proxies: Proxies,
    paths: Paths,
    frequency: Float[Tensor, "f"],
    quality: Quality,
) -> Found:
    """The same paths, those that solids bend replaced by bent ones; differentiable as they are.

    Straight paths on which every mirror is known exactly are bent by solids whose shape is; others
    stay straight, as approximations. ``counts`` has how many went, as REFRACTED.
    """
    index = torch.ones(len(world), dtype=torch.float64, device=world.device)
    solid = torch.nonzero(world.solid).squeeze(-1)
    if len(solid):
        index = index.index_copy(0, solid, world.index(solid, frequency[:1])[:, 0])
    bending = world.solid & world.exact & world.convex & (index.detach() > 1.0 + 1e-9)
    if not bool(bending.any()) or not len(paths.tx):
        return Found((paths,))
    wavelength = SPEED_OF_LIGHT / float(frequency[0])
    bender = Bender(world, proxies, bending, index, wavelength, quality)
    met = paths.which >= 0
    able = ((world.exact[paths.which] & (paths.act == Act.REFLECT)) | ~met).all(1)
    gone, bent, left_out = torch.zeros_like(able), [], []
    depth_of = met.sum(1)
    for depth in torch.unique(depth_of[able]).tolist():
        row = torch.nonzero(able & (depth_of == depth)).squeeze(-1)
        straight = _unpadded(paths.take(row), depth)
        crossed, found, unseen = _bent(bender, straight)
        gone[row[crossed]] = True
        bent.extend(found)
        left_out.extend(unseen)
    whole = Paths.joined([paths.take(~gone), *bent])
    counts = {s: int((whole.status == int(s)).sum()) for s in (Status.OK, Status.CAUSTIC_CAPPED)}
    counts[Status.REFRACTED] = int(gone.sum())
    counts = {s: n for s, n in counts.items() if n}
    return Found((whole,), counts, left_out=tuple(left_out), replaced=gone)


def _unpadded(paths: Paths, depth: int) -> Paths:
    return replace(
        paths,
        which=paths.which[:, :depth],
        act=paths.act[:, :depth],
        item=paths.item[:, :depth],
        vertices=paths.vertices[:, : depth + 2],
        normal=paths.normal[:, :depth],
    )


def _bent(bender: Bender, paths: Paths) -> tuple[Bool[Tensor, "p"], list[Paths], list[str]]:
    """Which straight paths of one depth give way, and the bent ones.

    All are read from the same end, whichever end transmits: the same bits both ways.
    """
    ends = paths.vertices[:, -1] - paths.vertices[:, 0]
    back = ends.detach() @ ends.new_tensor(FORWARD) < 0
    forward = _turned(paths, back)
    with torch.no_grad():
        row, segment, rays, runs = bender.runs(forward.vertices)
        runs = runs.take(~parallel(bender.world, rays, runs))
        crossed, grown = _grown(bender, forward, row, segment, rays, runs)
        sights, rows, at, left_out = _sights(bender, forward, crossed, row, segment, runs)
        candidates = [_raised(bender, forward, chain) for chain in grown]
        candidates += _looked_up(bender, forward, sights, rows, at)
        depths = sorted({c.which.shape[1] for c in candidates})
        chains = [Chain.joined([c for c in candidates if c.which.shape[1] == d]) for d in depths]
        solved = [_solved(bender, forward, chain) for chain in chains]
    return crossed, [_evaluated(bender, forward, chain, back) for chain in solved], left_out


def _turned(paths: Paths, back: Bool[Tensor, "p"]) -> Paths:
    """Paths without padding, those in ``back`` read from the receiver."""
    act = paths.act.flip(1)
    entering = torch.where(act == Act.LEAVE, int(Act.ENTER), act)
    swapped = torch.where(act == Act.ENTER, int(Act.LEAVE), entering)
    row, deep = back[:, None], back[:, None, None]
    return replace(
        paths,
        which=torch.where(row, paths.which.flip(1), paths.which),
        act=torch.where(row, swapped, paths.act),
        item=torch.where(row, paths.item.flip(1), paths.item),
        vertices=torch.where(deep, paths.vertices.flip(1), paths.vertices),
        normal=torch.where(deep, paths.normal.flip(1), paths.normal),
    )


# candidates


def _grown(
    bender: Bender, paths: Paths, row: Tensor, segment: Tensor, rays: Rays, runs: Runs
) -> tuple[Bool[Tensor, "p"], list[Chain]]:
    """Straight paths that are bent, and their chains: mirrors and faces met, in order.

    Where solids of two media touch or overlap, so that faces do not come by turns, a path stays
    straight.
    """
    depth, device = paths.which.shape[1], paths.which.device
    mirror = torch.arange(len(paths.tx), device=device).repeat_interleave(depth)
    level = torch.arange(depth, device=device).repeat(len(paths.tx))
    parts = [
        (
            mirror,
            (level + 1).double(),
            paths.which.reshape(-1),
            paths.act.reshape(-1),
            paths.item.reshape(-1),
            paths.vertices[:, 1:-1].reshape(-1, 3),
        )
    ]
    for act, node, t, normal in (
        (Act.ENTER, runs.which, runs.enter, runs.normal_enter),
        (Act.LEAVE, runs.last, runs.leave, runs.normal_leave),
    ):
        i = torch.nonzero(normal.abs().sum(-1) > 0).squeeze(-1)
        ray = runs.ray[i]
        x = rays.origin[ray] + t[i, None] * rays.direction[ray]
        place = segment[ray] + t[i] / rays.limit[ray]
        patch = bender.world.patch(node[i], x)
        parts.append((row[ray], place, node[i], torch.full_like(ray, int(act)), patch, x))
    owner, place, *vertices = (torch.cat(column) for column in zip(*parts, strict=True))
    order = torch.argsort(place, stable=True)
    order = order[torch.argsort(owner[order], stable=True)]
    owner = owner[order]
    which, act, patch, x = (column[order] for column in vertices)
    crossed = torch.zeros(len(paths.tx), dtype=torch.bool, device=device)
    face = torch.nonzero(act != Act.REFLECT).squeeze(-1)
    crossed[owner[face]] = True
    a, b = face[:-1], face[1:]
    touching = (x[b] - x[a]).norm(dim=-1) <= FLUSH
    crossed[owner[a[(owner[a] == owner[b]) & ((act[a] == act[b]) | touching)]]] = False
    return crossed, _by_depth(owner, which, act, patch, x, crossed)


def _by_depth(
    owner: Tensor, which: Tensor, act: Tensor, patch: Tensor, x: Tensor, wanted: Tensor
) -> list[Chain]:
    """Flat vertices, in order along their paths, as chains of equal depth."""
    count = torch.bincount(owner, minlength=len(wanted))
    begin = torch.cumsum(count, 0) - count
    chains = []
    for depth in torch.unique(count[wanted]).tolist():
        row = torch.nonzero(wanted & (count == depth)).squeeze(-1)
        i = begin[row, None] + torch.arange(depth, device=row.device)
        chains.append(Chain(row, which[i], act[i], patch[i], x[i]))
    return chains


def _sights(
    bender: Bender,
    paths: Paths,
    crossed: Bool[Tensor, "p"],
    row: Tensor,
    segment: Tensor,
    runs: Runs,
) -> tuple[Sights, Int[Tensor, "q"], Int[Tensor, "q"], list[str]]:
    """Where to look for bent paths: (row, segment, solid) of straight paths that one segment of goes
    through solids, from outside; on direct links every solid that may send something aside."""
    world, device = bender.world, row.device
    whole = (runs.normal_enter.abs().sum(-1) > 0) & (runs.normal_leave.abs().sum(-1) > 0)
    per_row = torch.zeros(len(paths.tx), paths.which.shape[1] + 1, dtype=torch.bool, device=device)
    per_row[row[runs.ray], segment[runs.ray]] = True
    simple = crossed & (per_row.sum(1) == 1)
    simple[row[runs.ray[~whole]]] = False
    finite = torch.isfinite(world.bounds_object).all(-1).all(-1)
    i = torch.nonzero(simple[row[runs.ray]] & finite[runs.which]).squeeze(-1)
    rows, at, aim = row[runs.ray[i]], segment[runs.ray[i]], runs.which[i]
    left_out = []
    if not paths.which.shape[1]:
        # a box sends rays between neighbouring faces only if its index is below sqrt(2)
        aside = torch.nonzero(
            bender.bending & finite & ~(world.rectangular & (bender.index >= 2**0.5))
        )
        aside = aside.squeeze(-1)
        if len(aside) * len(paths.tx) <= MOST_SIGHTS:
            free = torch.ones_like(crossed)
            free[row[runs.ray[~whole]]] = False  # a radio inside
            free = torch.nonzero(free).squeeze(-1)
            rows = torch.cat([rows, free.repeat_interleave(len(aside))])
            aim = torch.cat([aim, aside.repeat(len(free))])
            at = torch.cat([at, at.new_zeros(len(rows) - len(at))])
        else:
            left_out.append(
                "refraction beside the straight line: too many pairs of links and solids to look at"
            )
    if len(rows):
        rows, at, aim = torch.stack([rows, at, aim], 1).unique(dim=0).unbind(1)
    length, u = segments(paths.vertices)
    before = torch.cumsum(length, 1) - length
    direction, start = u[rows, at], paths.vertices[rows, at]
    image = start - before[rows, at, None] * direction
    target = image + length.sum(1)[rows, None] * direction
    plane = torch.zeros_like(start)
    mirrored = torch.nonzero(at > 0).squeeze(-1)
    plane[mirrored] = paths.normal[rows[mirrored], at[mirrored] - 1]
    return Sights(image, target, aim, plane, (plane * start).sum(-1)), rows, at, left_out


def _looked_up(
    bender: Bender, paths: Paths, sights: Sights, rows: Tensor, at: Tensor
) -> list[Chain]:
    """What the lattices of rays find, with the straight path's mirrors before and behind it."""
    chains = []
    found = pencils.seeds(
        bender.world, bender.proxies, sights, bender.bending, bender.index, bender.quality
    )
    for some in found:
        for level in torch.unique(at[some.question]).tolist():
            i = torch.nonzero(at[some.question] == level).squeeze(-1)
            row = rows[some.question[i]]
            faces = torch.arange(some.which.shape[1], device=row.device) % 2
            act = torch.where(faces == 0, int(Act.ENTER), int(Act.LEAVE)).expand(len(i), -1)
            mine = (some.which[i], act, some.patch[i], some.x[i])
            mirrors = (paths.which, paths.act, paths.item, paths.vertices[:, 1:-1])
            which, act, patch, x = (
                torch.cat([m[row, :level], s, m[row, level:]], 1)
                for m, s in zip(mirrors, mine, strict=True)
            )
            chains.append(Chain(row, which, act, patch, x))
    return chains


# exact paths


def _raised(bender: Bender, paths: Paths, chain: Chain) -> Chain:
    """Straight paths, followed while the index grows by steps to just below what it is."""
    batch, along = _batch(paths, chain), bender.along(chain.which, chain.act)
    surfaces = surfaces_of(bender.world, batch, None)
    for step in range(1, STEPS):
        index = 1.0 + (along - 1.0) * step / STEPS
        batch.x, _ = newton(batch, surfaces, ROUNDS, index)
    return replace(chain, x=batch.x)


def _solved(bender: Bender, paths: Paths, chain: Chain) -> Chain:
    """The candidates that come to rest as true paths, each once."""
    kept = []
    for i in torch.arange(len(chain.row), device=chain.row.device).split(bender.quality.chunk):
        part = chain.take(i)
        batch, along = _batch(paths, part), bender.along(part.which, part.act)
        surfaces = surfaces_of(bender.world, batch, None)
        batch.x, settled = newton(batch, surfaces, 3 * bender.quality.newton, along)
        kept.append(replace(part, x=batch.x).take(torch.nonzero(settled).squeeze(-1)))
    chain = Chain.joined(kept)
    return chain.take(_true(bender, paths, chain))


def _batch(paths: Paths, chain: Chain) -> Batch:
    ends = paths.vertices[chain.row]
    link = (paths.tx * (paths.rx.amax() + 1) + paths.rx)[chain.row] if len(paths.rx) else chain.row
    return Batch(link, ends[:, 0], ends[:, -1], chain.which, chain.patch, chain.x)


def _true(bender: Bender, paths: Paths, chain: Chain) -> Int[Tensor, "k"]:
    """Chains whose vertices lie on their faces and are met from the right sides, that stay in the
    solids they entered, and that no other solid bends; without repeats."""
    world, batch = bender.world, _batch(paths, chain)
    vertices = batch.polyline()
    length, u = segments(vertices)
    normal = unit(surfaces_of(world, batch, None).jet(chain.x).gradient)
    into = torch.where(chain.act == Act.LEAVE, 1.0, -1.0)
    out = torch.where(chain.act == Act.ENTER, -1.0, 1.0)
    good = (into * (u[:, :-1] * normal).sum(-1) > GRAZING).all(1)
    good &= (out * (u[:, 1:] * normal).sum(-1) > GRAZING).all(1)
    good &= (length > 0).all(1) & torch.isfinite(vertices).all(-1).all(-1)
    good &= on_faces(world, batch, vertices, normal, bender.wavelength).all(1)
    i = torch.nonzero(good).squeeze(-1)
    status = torch.full_like(i, int(Status.OK))
    reach = SAME * world.size[chain.which[i]]
    i = i[duplicates(batch.take(i), vertices[i], reach, status) == int(Status.OK)]
    return i[_in_order(bender, chain.take(i), vertices[i])]


def _in_order(bender: Bender, chain: Chain, vertices: Tensor) -> Bool[Tensor, "c"]:
    """Whether refracted segments run within their medium, and all others through nothing that bends."""
    world = bender.world
    solid = runs_in(chain.which, chain.act)
    row, segment, rays, runs = bender.runs(vertices)
    slack = FLUSH + 1e-10 * segments(vertices)[0].sum(1)  # to which Newton's vertices are at rest
    good = torch.ones_like(chain.row, dtype=torch.bool)
    mine, of = solid[row[runs.ray], segment[runs.ray]], row[runs.ray]
    same = (mine >= 0) & (world.medium[mine.clamp(min=0)] == world.medium[runs.which])
    long = runs.leave - runs.enter > slack[of]
    good[of[long & ~same & ~parallel(world, rays, runs)]] = False
    whole = same & (runs.enter <= slack[of])
    whole &= runs.leave >= rays.limit[runs.ray] - slack[of]
    filled = torch.zeros_like(solid, dtype=torch.bool)
    filled[of[whole], segment[runs.ray][whole]] = True
    return good & (filled | (solid < 0)).all(1)


def _evaluated(bender: Bender, paths: Paths, chain: Chain, back: Tensor) -> Paths:
    """Exact paths with gradients, turned back to where they came from."""
    batch, along = _batch(paths, chain), bender.along(chain.which, chain.act)
    surfaces = surfaces_of(bender.world, batch, None)
    vertices = batch.polyline(implicit_step(batch, surfaces, along))
    jet = surfaces.jet(vertices[:, 1:-1])
    cap = torch.tensor(1.0 / bender.wavelength, dtype=torch.float64, device=vertices.device)
    length, u = segments(vertices)
    lam = multipliers(u, jet.gradient, along)
    spread, capped, regular = spreading(vertices, jet, lam, cap, along)
    with torch.no_grad():
        passed = caustics(vertices, jet, lam, along)
        optical = (along * length).sum(1)
        keep = regular & ~_rings(bender, chain, optical, capped)
    whole = Paths(
        paths.tx[chain.row],
        paths.rx[chain.row],
        chain.which,
        chain.act,
        chain.patch,
        vertices,
        unit(jet.gradient),
        length.sum(1),
        spread,
        passed,
        torch.where(capped, int(Status.CAUSTIC_CAPPED), int(Status.OK)),
    )
    return _turned(whole, back[chain.row]).take(keep)


def _rings(
    bender: Bender, chain: Chain, optical: Float[Tensor, "c"], capped: Bool[Tensor, "c"]
) -> Bool[Tensor, "c"]:
    """Capped paths of one sequence and one length but the first: a whole ring of rays meets in its
    focus, of which the lattice finds some."""
    turn = torch.round(optical / (1e-3 * bender.wavelength)).long()
    key = torch.cat([chain.row[:, None], chain.which, turn[:, None]], 1)
    _, same = torch.unique(key, dim=0, return_inverse=True)
    number = torch.arange(len(same), device=same.device)
    first = torch.full_like(number, len(same)).scatter_reduce(
        0, same[capped], number[capped], "amin"
    )
    return capped & (number > first[same])


# what refraction does to the field


def _faces(at: Acting, i: Tensor, level: int):
    which, contact = at.contact(i, level)
    entering = (at.paths.act[i, level] == Act.ENTER)[:, None]
    outside = torch.where(entering, contact.incoming, contact.outgoing)
    cosine = (outside * contact.normal).sum(-1).abs().clamp(max=1.0)
    return at.world.face(which, cosine, at.frequency), contact


def coefficient(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f"]:
    """Scalar coefficient of faces passed."""
    return scalar(_faces(at, i, level)[0])


def dyad(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f 3 3"]:
    """What faces passed do to world field vectors, their ray tubes' change of width left out."""
    pair, contact = _faces(at, i, level)
    return dyad_of(pair, contact.incoming, contact.outgoing, contact.normal)


def inside(
    world: World, paths: Paths, frequency: Float[Tensor, "f"]
) -> tuple[Complex[Tensor, "p f"], Float[Tensor, "p"]]:
    """What the refracted segments of paths add to free space: a factor, and a group delay [s] at the
    first frequency."""
    factor = torch.ones(len(paths.tx), len(frequency), dtype=torch.complex128, device=world.device)
    delay = torch.zeros(len(paths.tx), dtype=torch.float64, device=world.device)
    solid, (length, _) = runs_in(paths.which, paths.act), segments(paths.vertices)
    for level in range(solid.shape[1]):
        i = torch.nonzero(solid[:, level] >= 0).squeeze(-1)
        if len(i):
            which, way = solid[i, level], length[i, level]
            here = torch.ones_like(factor).index_copy(0, i, world.inside(which, way, frequency))
            factor = factor * here
            delay = delay.index_add(0, i, world.inside_delay(which, way, frequency[:1])[:, 0])
    return factor, delay


def indices(world: World, paths: Paths, frequency: Float[Tensor, "1"]) -> Float[Tensor, "p s"]:
    """Index of refraction that each segment of paths runs in."""
    solid = runs_in(paths.which, paths.act)
    index = torch.ones(solid.shape, dtype=torch.float64, device=world.device)
    row, segment = torch.nonzero(solid >= 0, as_tuple=True)
    if not len(row):
        return index
    mine = world.index(solid[row, segment], frequency)[:, 0]
    return index.index_put((row, segment), mine)
