"""What one simulation leaves for the next, and its records in the next one's numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from rfsg.objects.contract import Crossing
from rfsg.tracer.changes import Changes, Seen
from rfsg.tracer.edges import Edges
from rfsg.tracer.launch import SearchReport
from rfsg.tracer.passages import Passages
from rfsg.tracer.records import Act, Chains, Channel, Failed, Only, Paths


@dataclass(frozen=True)
class Kept:
    """All that was found, what came to nothing and what is too weak to count included.

    report: of the search; least: what its sequences had to carry. chains, status: every candidate, and
    how it ended. mirrored: the paths among them; twin: those of them over a face that coincides with
    another's. edges: all long ones, free or not; standing: which are free; failed: candidates round
    those that came to nothing. paths, channel, through: of all stages, before the weak are dropped;
    stage: which brought each; origin: the row of the mirrored path that each is, -1 for others.
    left_out: what refraction and diffraction left out.
    """

    seen: Seen
    report: SearchReport
    least: float
    chains: Chains
    status: Int[Tensor, "c"]
    mirrored: Paths
    twin: Bool[Tensor, "m"]
    edges: Edges | None
    standing: Bool[Tensor, "e"]
    failed: Failed | None
    stage: Int[Tensor, "p"]
    origin: Int[Tensor, "p"]
    paths: Paths
    channel: Channel
    through: Passages
    left_out: tuple[tuple[str, ...], tuple[str, ...]]


@dataclass(frozen=True)
class Since:
    """What is kept of an earlier simulation, what has changed since, and so what is to be found."""

    kept: Kept
    changes: Changes

    @property
    def only(self) -> Only:
        """What paths to look for; edges are not known yet."""
        c = self.changes
        return Only(c.came, c.tx_came, c.rx_came, torch.zeros_like(c.came[:0]))

    def stays(self, some: Chains | Paths | Failed) -> Bool[Tensor, "c"]:
        """Whether the ends and all that is visited are as they were."""
        node, tx, rx = self._numbers()
        which = some.which.long()
        visited = ((which < 0) | (node[which] >= 0)).all(1)
        return visited & (tx[some.tx.long()] >= 0) & (rx[some.rx.long()] >= 0)

    def chains(self, some: Chains) -> Chains:
        """Chains that stay, in the new numbers."""
        node, tx, rx = self._numbers()
        return replace(some, tx=tx[some.tx], rx=rx[some.rx], which=node[some.which])

    def paths(self, some: Paths, edge: Int[Tensor, "e"] | None = None) -> Paths:
        """Paths that stay, in the new numbers; edge: the new number of each of the old edges."""
        node, tx, rx = self._numbers()
        item = some.item
        if edge is not None:
            bent = some.act == int(Act.DIFFRACT)
            item = torch.where(bent, edge[torch.where(bent, item, 0)], item)
        return replace(some, tx=tx[some.tx], rx=rx[some.rx], which=node[some.which], item=item)

    def failed(self, some: Failed, edge: Int[Tensor, "e"]) -> Failed:
        """Candidates whose things and edges stay, in the new numbers."""
        node, tx, rx = self._numbers()
        there = some.edge >= 0
        edge = torch.where(there, edge[torch.where(there, some.edge, 0).long()], -1)
        stays = self.stays(some) & ((edge >= 0) | ~there).all(1)
        which = node[some.which.long()]
        ends = tx[some.tx.long()], rx[some.rx.long()]
        columns = (x.to(torch.int32) for x in (*ends, which, edge, some.status))
        return Failed(*columns).take(stays)

    def channel(self, some: Channel) -> Channel:
        """The channel of paths that stay, in the new numbers."""
        node, tx, rx = self._numbers()
        crossed = some.crossed.clone()
        crossed[:, 1] = node[crossed[:, 1]]
        return replace(some, tx=tx[some.tx], rx=rx[some.rx], crossed=crossed)

    def through(self, some: Passages) -> Passages:
        """What paths that stay go through, in the new numbers."""
        node, _, _ = self._numbers()
        crossed = some.crossed.clone()
        crossed[:, 1] = node[crossed[:, 1]]
        return replace(some, which=node[some.which], last=node[some.last], crossed=crossed)

    def _numbers(self) -> tuple[Tensor, Tensor, Tensor]:
        """Old numbers to new ones; the last entry is for the padding's -1."""
        c = self.changes
        return torch.cat([c.node, c.node.new_full((1,), -1)]), c.tx, c.rx


# records that lie flat behind their paths


def of_paths(through: Passages, rows: Int[Tensor, "k"], count: int) -> Passages:
    """What some of ``count`` paths go through, numbered by their places among ``rows``."""
    number = torch.full((count,), -1, dtype=torch.int64, device=rows.device)
    number[rows] = torch.arange(len(rows), device=rows.device)
    i, path = _numbered(number, through.path)
    j, owner = _numbered(number, through.crossed[:, 0])
    crossing = Crossing(*(getattr(through.crossing, n)[i] for n in _CROSSING))
    crossed = torch.cat([owner[:, None], through.crossed[j, 1:]], 1)
    columns = (through.segment[i], through.which[i], through.last[i])
    return Passages(path, *columns, crossing, crossed)


def channel_of(channel: Channel, rows: Int[Tensor, "k"]) -> Channel:
    """The channel of some paths, numbered by their places among ``rows``."""
    number = torch.full_like(channel.tx, -1)
    number[rows] = torch.arange(len(rows), device=rows.device)
    i, path = _numbered(number, channel.crossed[:, 0])
    names = [n for n in Channel.__dataclass_fields__ if n not in ("frequency", "crossed", "jones")]
    columns = {n: getattr(channel, n)[rows] for n in names}
    columns["crossed"] = torch.cat([path[:, None], channel.crossed[i, 1:]], 1)
    columns["jones"] = None if channel.jones is None else channel.jones[rows]
    return replace(channel, **columns)


def _numbered(number: Tensor, path: Tensor) -> tuple[Tensor, Tensor]:
    """(entries whose path has a number, that number), in its order."""
    mine = number[path]
    i = torch.nonzero(mine >= 0).squeeze(-1)
    i = i[torch.argsort(mine[i], stable=True)]
    return i, mine[i]


def joined(parts: Sequence[Passages], counts: Sequence[int]) -> Passages:
    """What the paths of several records of so many paths go through, in order."""
    before = [sum(counts[:k]) for k in range(len(counts))]
    segment, which, last = (
        torch.cat([getattr(p, n) for p in parts]) for n in ("segment", "which", "last")
    )
    crossing = Crossing(*(torch.cat([getattr(p.crossing, n) for p in parts]) for n in _CROSSING))
    path = torch.cat([p.path + k for p, k in zip(parts, before, strict=True)])
    crossed = [
        p.crossed + p.crossed.new_tensor([k, 0, 0]) for p, k in zip(parts, before, strict=True)
    ]
    return Passages(path, segment, which, last, crossing, torch.cat(crossed))


_CROSSING = tuple(Crossing.__dataclass_fields__)


# equal records


def matched(old: Int[Tensor, "n k"], new: Int[Tensor, "m k"], group: int) -> Int[Tensor, "m"]:
    """For each new row the old row that equals it, -1 for none, and for all rows of a group (rows alike
    in their first ``group`` columns) unless old and new hold the same rows of it, each once."""
    if not len(old):
        return torch.full_like(new[:, 0], -1)
    both = torch.cat([old, new])
    _, row = torch.unique(_hashed(both), return_inverse=True)
    _, owner = torch.unique(_hashed(both[:, :group]), return_inverse=True)
    n, kinds = len(old), int(row.max()) + 1 if len(row) else 0
    source = torch.full((kinds,), -1, dtype=torch.int64, device=old.device)
    source[row[:n]] = torch.arange(n, device=old.device)
    found = source[row[n:]]
    found = torch.where((old[found] == new).all(1) & (found >= 0), found, -1)
    once = torch.bincount(row[n:], minlength=kinds)[row[n:]] == 1
    once &= torch.bincount(row[:n], minlength=kinds)[row[n:]] == 1
    good = (found >= 0) & once
    count = [torch.bincount(x, minlength=kinds) for x in (owner[:n], owner[n:], owner[n:][good])]
    whole = (count[0] == count[1]) & (count[1] == count[2])
    return torch.where(whole[owner[n:]] & good, found, -1)


def _hashed(rows: Int[Tensor, "n k"]) -> Int[Tensor, "n"]:
    """One number for a row, as in ``seams.coincident``."""
    odd = torch.cumprod(torch.full((rows.shape[1],), 0x1E3779B97F4A7C15, device=rows.device), 0)
    return (rows * odd).sum(1)
