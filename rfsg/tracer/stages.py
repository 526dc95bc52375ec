"""The stages that find paths, each with or without something kept of an earlier simulation.

Without, a stage finds all paths. With something kept it finds those that visit what is new, and takes
the others from there; why it may is said in ``incremental``.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.scene.world import World
from rfsg.tracer import diffraction, refract, scatter
from rfsg.tracer.bounds import least_product
from rfsg.tracer.changes import Seen
from rfsg.tracer.edges import Edges, long_edges, stands_free
from rfsg.tracer.embree import Proxies
from rfsg.tracer.kept import Since, matched
from rfsg.tracer.known import KnownEdges, known_edges
from rfsg.tracer.launch import SearchReport, search
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act, Chains, Failed, Found, Only, Paths, Status
from rfsg.tracer.renewed import new_chains
from rfsg.tracer.seams import coincident
from rfsg.tracer.solve import solve_each

SPECULAR, DIFFRACTED, DIFFUSE = range(3)  # which stage brought a path


@dataclass(frozen=True)
class Run:
    """One question: a scene, its radios' places, and how hard to look."""

    world: World
    proxies: Proxies
    tx: Float[Tensor, "t 3"]
    rx: Float[Tensor, "r 3"]
    frequency: Float[Tensor, "f"]
    quality: Quality

    @property
    def wavelength(self) -> float:
        """At the first frequency, where geometry is measured [m]."""
        return SPEED_OF_LIGHT / float(self.frequency[0])

    def none(self) -> Int[Tensor, "0"]:
        """No rows of anything."""
        return torch.zeros(0, dtype=torch.int64, device=self.world.device)

    @cached_property
    def seen(self) -> Seen:
        """The scene as it is now."""
        return Seen(self.world, self.tx, self.rx, self.frequency, self.quality)


# candidates


@dataclass(frozen=True)
class Candidates:
    """Chains to be solved, and the rows of those kept that need not be."""

    fresh: Chains
    rows: Int[Tensor, "k"]
    report: SearchReport
    searched: bool


def candidates(run: Run, since: Since | None) -> Candidates:
    """All candidate chains: those of an earlier search that this one would find, and new ones."""
    if since is None:
        return _searched(run, None)
    kept, c = since.kept, since.changes
    stays = torch.nonzero(since.stays(kept.chains)).squeeze(-1)
    least = least_of(run)
    if kept.report.enumerated:
        unlike = kept.report.pruned > 0 and least < kept.least
    else:  # what a ray meets, and how many are launched, hangs on everything
        unlike = least != kept.least or c.radios or bool(c.gone.any() | (c.came | c.asked).any())
    if unlike:
        return _beside(since, stays[:0], stays, _searched(run, None))
    wanted = since.only
    if kept.report.pruned:  # another material may lift a sequence above the floor
        wanted = replace(wanted, node=wanted.node | c.asked)
    # with other radios an enumeration may begin from the other side, and cost too much there
    if not c.radios and not bool(wanted.node.any()):
        report = replace(kept.report, candidates=len(stays))
        return Candidates(kept.chains.take(stays[:0]), stays, report, False)
    found = _searched(run, wanted)
    if not found.report.restricted:
        return _beside(since, stays[:0], stays, found)
    which = since.chains(kept.chains.take(stays)).which
    again = ((which >= 0) & wanted.node[which]).any(1)
    return _beside(since, stays[~again], stays[again], found)


def _searched(run: Run, only: Only | None) -> Candidates:
    ends = (run.tx, run.rx, run.frequency, run.quality)
    # to a few receivers it is quicker to find the whole as if all of them had just come
    chains = new_chains(run.world, *ends, _receivers(run) if only is None else only)
    if chains is not None:
        report = SearchReport(candidates=len(chains.tx), complete=True, enumerated=True)
        report.restricted = only is not None
    else:
        chains, report = search(run.world, run.proxies, *ends, only)
    return Candidates(chains, run.none(), report, True)


def _receivers(run: Run) -> Only:
    """All that ends at a receiver; or at a transmitter, where those are more and so looked at last."""
    back = len(run.rx) < len(run.tx)
    none, every = (torch.zeros(len(x), dtype=torch.bool, device=x.device) for x in (run.tx, run.rx))
    node = torch.zeros(len(run.world), dtype=torch.bool, device=every.device)
    return Only(node, none | back, every | (not back), none[:0])


def _beside(since: Since, rows: Tensor, perhaps: Tensor, found: Candidates) -> Candidates:
    """What a search found, the kept rows that it was not asked for, and those ``perhaps`` that it found
    again, to the bit of their seeds, which are not solved again.

    Chains of one sequence are solved together, so they are known together or not at all.
    """
    chains = found.fresh
    same = torch.full_like(chains.tx, -1)
    if len(perhaps) and since.kept.chains.which.shape[1] == chains.which.shape[1]:
        before = since.chains(since.kept.chains.take(perhaps))
        old, new = (
            torch.cat(
                [
                    *(x.tx[:, None], x.rx[:, None], x.which, x.patch),
                    x.seed.flatten(1).view(torch.int64),
                ],
                1,
            )
            for x in (before, chains)
        )
        same = matched(old, new, 2 + chains.which.shape[1])
        same = torch.where(same >= 0, perhaps[same], -1)
    rows = torch.cat([rows, same[same >= 0]])
    chains = chains.take(torch.nonzero(same < 0).squeeze(-1))
    report = replace(found.report, candidates=len(rows) + len(chains.tx))
    return Candidates(chains, rows, report, True)


def least_of(run: Run) -> float:
    """What sequences of mirrors must carry to be followed, as ``bounds.Floor`` has it."""
    bends = run.quality.refraction and bool(run.world.solid.any())
    return 0.0 if bends else least_product(run.world, run.quality)


# mirrors


@dataclass(frozen=True)
class Mirrored:
    """Every candidate and how it ended; the paths among them, the row of the kept path that each is (-1
    for a new one), and which of them lie over a face that coincides with another's."""

    chains: Chains
    status: Int[Tensor, "c"]
    paths: Paths
    source: Int[Tensor, "m"]
    twin: Bool[Tensor, "m"]

    def counts(self) -> dict[Status, int]:
        """How many candidates came to nothing, and why."""
        number = torch.bincount(self.status, minlength=len(Status)).tolist()
        number[Status.DUPLICATE] += int(self.twin.sum())
        return {s: number[s] for s in Status if number[s] and s > Status.CAUSTIC_CAPPED}


def mirrored(run: Run, found: Candidates, since: Since | None) -> Mirrored:
    """Exact paths of the candidates."""
    ends = (run.tx, run.rx, run.wavelength, run.quality)
    chains = found.fresh
    paths, status = solve_each(run.world, chains, *ends)
    source = torch.full_like(paths.tx, -1)
    if since is not None and len(found.rows):
        kept, rows = since.kept, found.rows
        chains = Chains.joined([since.chains(kept.chains.take(rows)), chains])
        place = torch.cumsum(kept.status <= int(Status.CAUSTIC_CAPPED), 0) - 1
        status = torch.cat([kept.status[rows], status])
        rows = place[rows[_good(kept.status[rows])]]
        paths = Paths.joined([since.paths(kept.mirrored.take(rows)), paths])
        source = torch.cat([rows, source])
    good = chains.take(_good(status))
    every = torch.ones_like(good.tx, dtype=torch.bool)
    if since is not None and len(source) == len(since.kept.twin) and not bool((source < 0).any()):
        twin = since.kept.twin[source]  # the same paths as before
    else:
        twin = coincident(run.world, good, paths.vertices, paths.normal, every)
    return Mirrored(chains, status, paths, source, twin)


def _good(status: Int[Tensor, "c"]) -> Int[Tensor, "k"]:
    return torch.nonzero(status <= int(Status.CAUSTIC_CAPPED)).squeeze(-1)


# the stages that end in paths


@dataclass(frozen=True)
class Stage:
    """The paths of one mechanism and, of each, the row of the kept path that it is, -1 for a new one.

    origin: the row of the mirrored path that each is, -1 for others. counts: candidates that came to
    nothing. tried: how many candidates were new.
    """

    paths: Paths
    source: Int[Tensor, "p"]
    origin: Int[Tensor, "p"]
    counts: dict[Status, int] = field(default_factory=dict)
    modelled: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    tried: int = 0


def specular(run: Run, found: Mirrored, since: Since | None) -> Stage:
    """Mirrored paths, those that solids bend replaced by bent ones."""
    origin = torch.nonzero(~found.twin).squeeze(-1)
    paths, before = found.paths.take(origin), torch.full_like(origin, -1)
    known = torch.zeros_like(origin, dtype=torch.bool)
    bends = run.quality.refraction and bool(run.world.solid.any())
    if since is not None:
        before = _as_before(since, found.source[origin])
        if bends and _bends_as_before(since, found):
            known = found.source[origin] >= 0
    if not bends:
        return Stage(paths, before, origin, found.counts())
    fresh = torch.nonzero(~known).squeeze(-1)
    bent = refract.bend(run.world, run.proxies, paths.take(fresh), run.frequency, run.quality)
    replaced = torch.zeros_like(fresh, dtype=torch.bool) if bent.replaced is None else bent.replaced
    stays = torch.cat([torch.nonzero(known & (before >= 0)).squeeze(-1), fresh[~replaced]])
    new = bent.paths[0].take(slice(int((~replaced).sum()), None))
    parts, source = [paths.take(stays), new], [before[stays], torch.full_like(new.tx, -1)]
    left_out = bent.left_out
    if since is not None and bool(known.any()):
        rows = _bent_before(since)
        parts.append(since.paths(since.kept.paths.take(rows)))
        source.append(rows)
        left_out = since.kept.left_out[0]
    whole, source = Paths.joined(parts), torch.cat(source)
    origins = torch.full_like(source, -1)
    origins[: len(stays)] = origin[stays]
    counts = found.counts()
    if len(stays) < len(origin):
        counts[Status.REFRACTED] = len(origin) - len(stays)
    return Stage(whole, source, origins, counts, (), left_out, len(fresh))


def _as_before(since: Since, source: Int[Tensor, "m"]) -> Int[Tensor, "m"]:
    """The row among all kept paths of mirrored ones, -1 where there is none: new, twins, or bent."""
    kept = since.kept
    rows = torch.nonzero(kept.origin >= 0).squeeze(-1)
    place = torch.full((len(kept.twin) + 1,), -1, dtype=torch.int64, device=source.device)
    place[kept.origin[rows]] = rows
    return place[source]


def _bends_as_before(since: Since, found: Mirrored) -> bool:
    """Whether solids do to kept straight paths what they did: none has changed, the same links are
    looked beside, and the straight paths are the same."""
    kept, same = since.kept, found.source >= 0
    twins = torch.equal(kept.twin[found.source[same]], found.twin[same])
    changed = since.changes.solids or since.changes.radios
    return kept.report.enumerated and twins and not changed


def _bent_before(since: Since) -> Int[Tensor, "k"]:
    kept = since.kept
    bent = (kept.stage == SPECULAR) & (kept.origin < 0)
    return torch.nonzero(bent & since.stays(kept.paths)).squeeze(-1)


@dataclass(frozen=True)
class Around:
    """Every long edge, which of them are free, and the candidates round those that came to nothing."""

    every: Edges | None
    standing: Bool[Tensor, "e"]
    failed: Failed | None

    @property
    def edges(self) -> Edges | None:
        """The free ones."""
        if self.every is None:
            return None
        return self.every.take(torch.nonzero(self.standing).squeeze(-1))


def diffracted(run: Run, since: Since | None) -> tuple[Stage, Around]:
    """Paths round edges."""
    if not run.quality.diffraction:
        return _stage(run, Found()), Around(None, run.none() > 0, None)
    every = long_edges(run.world, run.wavelength)
    known = None
    if since is not None and since.kept.edges is not None:
        known = known_edges(run.world, every, since, run.wavelength)
    standing = stands_free(run.world, every, run.wavelength) if known is None else known.standing
    edges = every.take(torch.nonzero(standing).squeeze(-1))
    question = (run.world, edges, run.tx, run.rx, run.wavelength, run.quality)
    blank = Failed.of(_no_paths(run))
    # what was left out, or is now, is so as a whole
    if since is not None and known is not None and not since.kept.left_out[1]:
        assert since.kept.failed is not None
        only = replace(since.only, edge=~known.same[standing])
        found = diffraction.paths_of(*question, only)
        if not found.left_out:
            failed = since.failed(since.kept.failed, known.number)
            failed = Failed.joined([failed, blank, *found.failed])
            stage = _with_kept(run, found, since, known)
            return stage, Around(every, standing, failed)
    found = diffraction.paths_of(*question)
    failed = Failed.joined([blank, *found.failed])
    return _stage(run, found), Around(every, standing, failed)


def _with_kept(run: Run, found: Found, since: Since, known: KnownEdges) -> Stage:
    """New paths round edges, and the kept ones whose edges are known."""
    paths = since.kept.paths
    rows = torch.nonzero((since.kept.stage == DIFFRACTED) & since.stays(paths)).squeeze(-1)
    some = paths.take(rows)
    bent = some.act == int(Act.DIFFRACT)
    stays = (~bent | (known.number[torch.where(bent, some.item, 0)] >= 0)).all(1)
    rows, some = rows[stays], some.take(stays)
    new = _stage(run, found)
    whole = Paths.joined([since.paths(some, known.number), new.paths])
    source = torch.cat([rows, new.source])
    return replace(new, paths=whole, source=source, origin=torch.full_like(source, -1))


def diffuse(run: Run, since: Since | None) -> Stage:
    """Paths over tiles of rough faces."""
    if not bool(scatter.rough_nodes(run.world).any()):
        return _stage(run, Found())
    stage = _stage(run, scatter.paths_of(run.world, run.tx, run.rx, run.quality))
    if since is None:
        return stage
    paths = since.kept.paths
    rows = torch.nonzero((since.kept.stage == DIFFUSE) & since.stays(paths)).squeeze(-1)
    before = since.paths(paths.take(rows))
    depth = max(before.which.shape[1], stage.paths.which.shape[1])
    old, new = (_bits(p.padded(depth)) for p in (before, stage.paths))
    same = matched(old, new, new.shape[1])
    return replace(stage, source=torch.where(same >= 0, rows[same], -1) if len(rows) else same)


def _bits(paths: Paths) -> Int[Tensor, "p k"]:
    """All that says which path it is, and how strong its tile."""
    numbers = torch.cat([paths.vertices.flatten(1), paths.spread[:, None]], 1)
    names = [paths.tx[:, None], paths.rx[:, None], paths.which, paths.act, paths.item]
    return torch.cat([*names, numbers.detach().view(torch.int64)], 1)


def _stage(run: Run, found: Found) -> Stage:
    """All new."""
    whole = Paths.joined([_no_paths(run), *found.paths])
    none = torch.full_like(whole.tx, -1)
    counts = {s: n for s, n in found.counts.items() if s > Status.CAUSTIC_CAPPED}
    tried = sum(found.counts.values())
    return Stage(whole, none, none, counts, found.modelled, found.left_out, tried)


def _no_paths(run: Run) -> Paths:
    none = run.none()
    wide, flat = none.reshape(0, 0), run.tx.new_zeros(0)
    points = flat.reshape(0, 2, 3)
    return Paths(
        none, none, wide, wide, wide, points, flat.reshape(0, 0, 3), flat, flat, none, none
    )
