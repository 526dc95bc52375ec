"""Simulating again after an edit: what nothing changed for is kept.

A full run is the same with nothing kept. Why a path may be kept, stage by stage:

- *Enumerated chains* are sequences of faces, and whether one is a candidate is a matter of its own
  faces and ends, whatever stands between (``sequences``); so is whether it is solved, and to what
  (``solve``). Chains without a changed node or radio stay; the others are searched anew. Where two faces
  coincide one path of two is taken: that is decided again over all paths.
- *Rays* are launched anew, all of them: what a ray meets first decides what it meets next. A chain
  that they find as before, with the same seed, is not solved again.
- *Refraction* replaces straight paths, one by one, by what the solids make of them. It is done for new
  straight paths, and for all of them where a solid has changed, for bent ones may go anywhere; so, too,
  where radios or coinciding faces have, or rays are launched.
- *Diffraction* is enumerated like mirrors. An edge counts where it is free, so one that comes near
  anything that changed is a changed edge. Where there are too many pairs, it is done as a whole.
- *Diffuse* tiles are cut anew, all of them; a tile that came out the same is the same path.
- *What a path goes through* depends on the boxes that its segments cross (``embree``), and on nothing
  else: a path across the box of a changed node, where it was or where it is, is traced again.
- *The field* of a path that visits or crosses another material is evaluated again on what is known of
  it; flush solids count as one body, so all solids where one has changed.
"""

from collections import Counter
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.tracer.changes import changes, question_changed
from rfsg.tracer.edges import Edges
from rfsg.tracer.field import AT_ONCE, channel
from rfsg.tracer.kept import Kept, Since, channel_of, joined, of_paths
from rfsg.tracer.known import crosses
from rfsg.tracer.passages import Passages, passages
from rfsg.tracer.records import Channel, Paths, Status
from rfsg.tracer.stages import (
    Around,
    Candidates,
    Mirrored,
    Run,
    Stage,
    diffracted,
    diffuse,
    least_of,
    mirrored,
    specular,
)


@dataclass(frozen=True)
class Redone:
    """How much of a simulation was done: whether paths were searched, chains and edge paths solved,
    straight paths bent; paths traced through the scene, and fields evaluated. kept: the paths of which
    nothing was done again."""

    searched: bool
    solved: int
    bent: int
    diffracted: int
    traced: int
    evaluated: int
    kept: int

    @staticmethod
    def of(done: "Solved", fields: "Fielded") -> "Redone":
        """What was done."""
        first, second, _ = done.stages
        numbers = (len(done.found.fresh.tx), first.tried, second.tried)
        return Redone(done.found.searched, *numbers, fields.traced, fields.evaluated, fields.kept)

    def sentence(self) -> str:
        """For the plan."""
        solved = f"{self.solved} chains and {self.diffracted} edge candidates solved"
        found = f"searched anew, {solved}" if self.searched else f"no search, {solved}"
        return (
            f"incremental: {self.kept} paths kept as they were; {found}, "
            f"{self.traced} paths traced, {self.evaluated} fields evaluated"
        )


def since(kept: Kept | None, run: Run) -> tuple[Since | None, str | None]:
    """What an earlier simulation has to offer to this one; and, if nothing, why."""
    if kept is None:
        return None, "it kept nothing: gradients were asked for, or chains were given"
    why = question_changed(kept.seen, run.seen)
    return (None, why) if why else (Since(kept, changes(kept.seen, run.seen)), None)


@dataclass(frozen=True)
class Solved:
    """Exact paths of every stage, before their fields are known."""

    found: Candidates
    mirrors: Mirrored
    around: Around
    stages: tuple[Stage, Stage, Stage]  # specular, diffracted, diffuse

    @property
    def counts(self) -> dict[Status, int]:
        """How every candidate ended."""
        total = Counter(self.stages[0].counts) + Counter(self.stages[2].counts)
        if self.around.failed is not None:
            total += Counter(self.around.failed.counts())
        for stage in self.stages:
            number = torch.bincount(stage.paths.status, minlength=len(Status)).tolist()
            total += Counter({s: number[s] for s in Status})
        return dict(total)


def solved(run: Run, found: Candidates, before: Since | None) -> Solved:
    """All stages that end in paths."""
    mirrors = mirrored(run, found, before)
    first = specular(run, mirrors, before)
    second, around = diffracted(run, before)
    return Solved(found, mirrors, around, (first, second, diffuse(run, before)))


@dataclass(frozen=True)
class Fielded:
    """Paths and their channel, what they go through, and where each comes from."""

    paths: Paths
    channel: Channel
    through: Passages
    stage: Int[Tensor, "p"]
    origin: Int[Tensor, "p"]
    traced: int
    evaluated: int
    kept: int


def fielded(
    run: Run, stages: tuple[Stage, ...], edges: Edges | None, before: Since | None
) -> Fielded:
    """The channel of all paths; kept ones first, then those that are evaluated again on what they were
    known to go through, then those that are traced."""
    paths = Paths.joined([s.paths for s in stages])
    source, origin = (torch.cat([getattr(s, n) for s in stages]) for n in ("source", "origin"))
    stage = torch.cat([torch.full_like(s.source, k) for k, s in enumerate(stages)])
    fresh, again = source < 0, torch.zeros_like(source, dtype=torch.bool)
    if before is not None:
        fresh = fresh | _crossed(run, before, paths, source)
        again = _asked(before, paths, source) & ~fresh
    known, again, fresh = (torch.nonzero(x).squeeze(-1) for x in (~fresh & ~again, again, fresh))
    parts = []
    if before is not None and len(known):
        parts.append(_known(before, source[known]))
    if before is not None and len(again):
        through = _known(before, source[again])[1]
        parts.append((_evaluated(run, paths.take(again), edges, through), through))
    if len(fresh) or not parts:
        parts.append(_traced(run, paths.take(fresh), edges))
    channels, throughs = zip(*parts, strict=True)
    order = torch.cat([known, again, fresh])
    return Fielded(
        paths if len(parts) == 1 else paths.take(order),
        Channel.joined(channels),
        joined(throughs, [len(c.tx) for c in channels]),
        stage[order],
        origin[order],
        traced=len(fresh),
        evaluated=len(again) + len(fresh),
        kept=len(known),
    )


def _known(before: Since, rows: Int[Tensor, "k"]) -> tuple[Channel, Passages]:
    """Rows of what was kept, in the new numbers."""
    kept = before.kept
    through = of_paths(kept.through, rows, len(kept.stage))
    return before.channel(channel_of(kept.channel, rows)), before.through(through)


def _crossed(run: Run, before: Since, paths: Paths, source: Tensor) -> Bool[Tensor, "p"]:
    """Kept paths that go through the box of something that changed, where it was or where it is."""
    rows = torch.nonzero(source >= 0).squeeze(-1)
    there, here = before.kept.seen.world, run.world
    hit = crosses(paths.vertices[rows], [(there, before.changes.gone), (here, before.changes.came)])
    out = torch.zeros_like(source, dtype=torch.bool)
    out[rows[hit]] = True
    return out


def _asked(before: Since, paths: Paths, source: Tensor) -> Bool[Tensor, "p"]:
    """Kept paths that visit or cross something that answers otherwise than it did."""
    c, kept = before.changes, before.kept
    out = c.tx_asked[paths.tx] | c.rx_asked[paths.rx]
    if bool(c.asked.any()):
        out |= ((paths.which >= 0) & c.asked[paths.which]).any(1)
        node = torch.where(c.gone, False, c.asked[c.node])
        crossing = torch.zeros(len(kept.stage) + 1, dtype=torch.bool, device=out.device)
        crossing[kept.through.crossed[node[kept.through.crossed[:, 1]], 0]] = True
        out |= crossing[source]
    return out


def _traced(run: Run, paths: Paths, edges: Edges | None) -> tuple[Channel, Passages]:
    wavelength = float((SPEED_OF_LIGHT / run.frequency).min())
    where = (run.world, run.proxies)
    parts = []
    for i in torch.arange(len(paths.tx)).split(min(AT_ONCE, run.quality.chunk)):
        some = paths.take(slice(int(i[0]), int(i[-1]) + 1)) if len(i) else paths
        through = passages(*where, some, wavelength, run.quality)
        parts.append((_evaluated(run, some, edges, through), through))
    channels, throughs = zip(*parts, strict=True)
    return Channel.joined(channels), joined(throughs, [len(c.tx) for c in channels])


def _evaluated(run: Run, paths: Paths, edges: Edges | None, through: Passages) -> Channel:
    scene = run.world.scene
    radios = (scene.transmitters, scene.receivers)
    return channel(
        run.world, run.proxies, paths, *radios, run.frequency, run.quality, edges, through
    )


def keep(run: Run, done: Solved, fields: Fielded) -> Kept:
    """What the next simulation may use."""
    first, second, _ = done.stages
    around = done.around
    return Kept(
        run.seen,
        done.found.report,
        least_of(run),
        done.mirrors.chains,
        done.mirrors.status,
        done.mirrors.paths,
        done.mirrors.twin,
        around.every,
        around.standing,
        around.failed,
        fields.stage,
        fields.origin,
        fields.paths,
        fields.channel,
        fields.through,
        (first.left_out, second.left_out),
    )
