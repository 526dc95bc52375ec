"""Mirrors that move with what is learned: their paths followed from where a search left them.

Between searches the charts on which learned faces are measured (``tracer.zone``) stay where they
came to rest, and vertices follow by Newton steps on the quadrics measured there anew. The last step
carries the gradient (implicit function theorem); lengths have theirs by the envelope theorem. To
come to rest again on charts of its own is a search's business.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from rfsg.learn.factors import slide
from rfsg.objects.contract import Crossing
from rfsg.scene.world import World, unit
from rfsg.tracer import zone
from rfsg.tracer.implicit import multipliers, segments, spreading
from rfsg.tracer.newton import Batch, surfaces_of
from rfsg.tracer.passages import Passages
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Paths, Status
from rfsg.tracer.settle import Charts, settle
from rfsg.tracer.solve import implicit_step

NEWTON = 2  # steps to where the vertices are now, before the one with gradients


@dataclass(frozen=True)
class Group:
    """Chains of one depth: which rows of the kept paths they are, and where they came to rest."""

    rows: Int[Tensor, "c"]
    batch: Batch
    charts: Charts


class Tracks:
    """``rows`` of paths, all of mirrors. Those that do not come to rest stay where they are."""

    def __init__(
        self,
        world: World,
        paths: Paths,
        rows: Int[Tensor, "m"],
        wavelength: float,
        quality: Quality,
    ):
        self.wavelength, self.rings = wavelength, quality.zone_rings
        self.groups: list[Group] = []
        depth = (paths.which[rows] >= 0).sum(1)
        for d in torch.unique(depth).tolist():
            i = rows[depth == d]
            batch = Batch(
                torch.arange(len(i)),
                paths.vertices[i, 0],
                paths.vertices[i, d + 1],
                paths.which[i, :d],
                paths.item[i, :d],
                paths.vertices[i, 1 : d + 1],
            )
            group = self._rested(world, i, batch, quality)
            self.groups.append(group)

    def _rested(self, world: World, rows: Tensor, batch: Batch, quality: Quality) -> Group:
        learned = (~world.exact[batch.which]).any(1)
        x = batch.x.clone()
        charts = Charts(x.clone(), torch.zeros_like(x), torch.zeros_like(x[..., 0]))
        keep = ~learned
        i = torch.nonzero(learned).squeeze(-1)
        if len(i):
            with torch.no_grad():
                x[i], status, found = settle(world, batch.take(i), self.wavelength, quality)
            for name in ("centre", "normal", "radius"):
                getattr(charts, name)[i] = getattr(found, name)
            keep[i] = status == int(Status.OK)
        batch.x = x
        kept = torch.nonzero(keep).squeeze(-1)
        return Group(rows[kept], batch.take(kept), charts.take(kept))

    def followed(self, paths: Paths, rows: Int[Tensor, "q"], world: World) -> Paths:
        """``paths``, which are ``rows`` of those kept, with their vertices where they are now."""
        number = torch.full((int(rows.max()) + 1,), -1, dtype=torch.int64)
        number[rows] = torch.arange(len(rows))
        for group in self.groups:
            inside = group.rows < len(number)
            place = torch.where(inside, number[group.rows.clamp(max=len(number) - 1)], -1)
            j = torch.nonzero(place >= 0).squeeze(-1)
            if len(j):
                part, charts = group.batch.take(j), group.charts.take(j)
                paths = self._moved(paths, place[j], part, charts, world)
        return paths

    def _moved(
        self, paths: Paths, place: Tensor, batch: Batch, charts: Charts, world: World
    ) -> Paths:
        facets = None
        which = batch.which.reshape(-1)
        i = torch.nonzero(~world.exact[which]).squeeze(-1)
        if len(i):
            facets = zone.measure(
                world,
                which[i],
                charts.centre.reshape(-1, 3)[i],
                charts.normal.reshape(-1, 3)[i],
                charts.radius.reshape(-1)[i],
                self.wavelength,
                self.rings,
            )
        surfaces = surfaces_of(world, batch, facets)
        with torch.no_grad():
            for _ in range(NEWTON):
                batch.x = implicit_step(batch, surfaces)
        vertices = batch.polyline(implicit_step(batch, surfaces))
        jet = surfaces.jet(vertices[:, 1:-1])
        length, u = segments(vertices)
        cap = vertices.new_tensor(1.0 / self.wavelength)
        spread, _, regular = spreading(vertices, jet, multipliers(u, jet.gradient), cap)
        spread = torch.where(regular, spread, paths.spread[place])
        depth, most = batch.which.shape[1], paths.which.shape[1]
        tail = vertices[:, -1:].expand(-1, most - depth, 3)
        normal = paths.normal[place]
        normal = torch.cat([unit(jet.gradient), normal[:, depth:]], 1)
        return replace(
            paths,
            vertices=paths.vertices.index_copy(0, place, torch.cat([vertices, tail], 1)),
            normal=paths.normal.index_copy(0, place, normal),
            length=paths.length.index_copy(0, place, length.sum(1)),
            spread=paths.spread.index_copy(0, place, spread),
        )


def carried(world: World, before: Paths, after: Paths, through: Passages) -> Passages:
    """What paths go through, moved along with their segments and slid to the surfaces as they are."""
    path, segment, crossing = through.path, through.segment, through.crossing
    old, origin = before.vertices[path, segment], after.vertices[path, segment]
    target = after.vertices[path, segment + 1]
    direction = unit(target - origin)
    enter = (crossing.start - old).norm(dim=-1, keepdim=True)
    leave = (crossing.end - old).norm(dim=-1, keepdim=True)
    starts, ends = (
        (n != 0).any(-1, keepdim=True) for n in (crossing.normal_start, crossing.normal_end)
    )
    moved = Crossing(
        torch.where(starts, origin + enter * direction, origin),
        torch.where(ends, origin + leave * direction, target),
        crossing.normal_start,
        crossing.normal_end,
    )
    if not len(path):
        return through
    return replace(through, crossing=slide(world, through.which, moved, through.last))
