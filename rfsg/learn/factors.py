"""Shares of paths as a number times the coefficients of the learned objects they meet.

Where a path has no vertex on what moves, its vertices stand still, and with them everything but these
coefficients. What a learned surface asks of a shape that stands still is remembered (``remembered``).
Where a path goes through an object whose shape or pose is learned, the ends of the crossing slide
along the path with the surface: one Newton step from where they were found, and its gradient is that
of the implicit function theorem.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.learn.remembered import MOST_POINTS, Memory
from rfsg.objects.body import Body
from rfsg.objects.contract import Contact, Crossing
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.world import World, unit
from rfsg.tracer.acting import Acting, scalar
from rfsg.tracer.edges import Edges
from rfsg.tracer.field import slots
from rfsg.tracer.implicit import segments
from rfsg.tracer.mechanisms import COEFFICIENT
from rfsg.tracer.passages import Passages
from rfsg.tracer.records import Act, Paths

Met = TypeVar("Met", bound=Contact | Crossing)
Ask = Callable[[Tensor, World], Tensor]  # rows of a part, the world now -> [k f], complex128
STEEP = 1e-3  # cosine below which a path runs along a surface, and its crossing's end is held


@dataclass(frozen=True)
class Part:
    """Encounters of one kind: of which path each is, in order, and what they answer."""

    path: Int[Tensor, "m"]
    begin: Int[Tensor, "p1"]  # of each path's encounters
    ask: Ask


class Factors:
    """p paths: ``rest`` [p f] times the coefficients of what ``learned`` nodes do to them."""

    def __init__(
        self,
        world: World,
        paths: Paths,
        through: Passages,
        rest: Complex[Tensor, "p f"],
        frequency: Float[Tensor, "f"],
        edges: Edges | None,
        learned: Bool[Tensor, "n"],
        moving: Bool[Tensor, "n"],
        dtype: torch.dtype,
    ):
        self.world, self.paths, self.through, self.rest = world, paths, through, rest
        self.frequency, self.edges, self.dtype = frequency, edges, dtype
        self.moving = moving
        _, self.u = segments(paths.vertices)
        self.parts: list[Part] = []
        for level in range(paths.which.shape[1]):
            met = (paths.which[:, level] >= 0) & learned[paths.which[:, level].clamp(min=0)]
            for act in torch.unique(paths.act[met, level]).tolist():
                i = torch.nonzero(met & (paths.act[:, level] == act)).squeeze(-1)
                if act == int(Act.REFLECT):
                    self._mirrors(i, level)
                else:
                    self._add(i, self._acting(i, level, Act(act)))
        self._crossings(torch.nonzero(learned[through.which]).squeeze(-1))

    def shares(self, rows: Int[Tensor, "q"], world: World) -> Complex[Tensor, "q f"]:
        """Shares of h(f) of some of the paths, each once. world: with the poses as they are now."""
        product = self.rest[rows]
        for part in self.parts:
            count = part.begin[rows + 1] - part.begin[rows]
            place = torch.repeat_interleave(torch.arange(len(rows)), count)
            if not len(place):
                continue
            first = torch.cumsum(count, 0) - count
            entry = torch.arange(len(place)) - first[place] + part.begin[rows][place]
            factor = part.ask(entry, world)
            for slot in slots(place):
                i = place[slot]
                product = product * torch.ones_like(product).index_copy(0, i, factor[slot])
        return product

    def _add(self, path: Int[Tensor, "m"], ask: Ask) -> None:
        begin = torch.searchsorted(path, torch.arange(len(self.rest) + 1))
        self.parts.append(Part(path, begin, ask))

    def _acting(self, i: Tensor, level: int, act: Act) -> Ask:
        """Vertices other than mirrors, by the tracer's own rule.

        A wedge is crossed within a micron of its edge: one interval of it is as good as many.
        """
        world = _thin(self.world)

        def ask(rows: Tensor, _: World) -> Tensor:
            some = i[rows]
            at = Acting(world, self.paths.take(some), self.u[some], self.frequency, self.edges)
            return COEFFICIENT[act](at, torch.arange(len(some)), level)

        return ask

    def _mirrors(self, i: Tensor, level: int) -> None:
        paths, world = self.paths, self.world
        which = paths.which[i, level]
        contact = Contact(
            paths.vertices[i, level + 1],
            self.u[i, level],
            self.u[i, level + 1],
            paths.normal[i, level],
        )
        for body, k in world.surface_groups(which):
            if isinstance(body.surface, StochasticSurface):
                local = Contact(
                    world.point_object(which[k], contact.point[k]),
                    *(
                        world.direction_object(which[k], d[k])
                        for d in (contact.incoming, contact.outgoing, contact.normal)
                    ),
                )
                ask = self._remembered(body, local, body.surface.reflection, which[k])
                self._add(i[k], ask)
            else:
                self._add(i[k], self._known_mirrors(which[k], _rows(contact, k)))

    def _crossings(self, i: Tensor) -> None:
        through, world = self.through, self.world
        order = torch.argsort(through.path[i], stable=True)
        i = i[order]
        for moving in (False, True):
            some = i[self.moving[through.which[i]] == moving]
            for body, k in world.surface_groups(through.which[some]):
                j = some[k]
                which, crossing = through.which[j], _rows(through.crossing, j)
                learned = isinstance(body.surface, StochasticSurface)
                if learned and not moving:
                    local = _crossing_object(world, which, crossing)
                    ask = self._remembered(body, local, body.surface.transmission, which)
                elif learned:
                    ask = self._moved(body, which, crossing)
                else:
                    ask = self._known_crossings(which, crossing, through.last[j], moving)
                self._add(through.path[j], ask)

    def _remembered(
        self, body: Body, met: Contact | Crossing, question: Callable, which: Tensor
    ) -> Ask:
        """A learned surface whose shape's answers are kept, where they are not too many."""
        points = len(which) * (body.surface.samples + 1)  # type: ignore[attr-defined]
        local = _cast(met, self.dtype)
        shape: Callable[[Tensor], Any] = lambda _: body.shape  # noqa: E731
        if points <= MOST_POINTS and not bool(self.moving[which].any()):
            shape = Memory.of(body.surface, body.shape, met, self.dtype).at
        return lambda rows, _: _scalar(question(shape(rows), _rows(local, rows), self.frequency))

    def _moved(self, body: Body, which: Tensor, crossing: Crossing) -> Ask:
        """A learned surface on a shape that changes, or stands elsewhere now."""

        def ask(rows: Tensor, world: World) -> Tensor:
            slid = slide(world, which[rows], _rows(crossing, rows), dtype=self.dtype)
            local = _cast(_crossing_object(world, which[rows], slid), self.dtype)
            return _scalar(body.surface.transmission(body.shape, local, self.frequency))

        return ask

    def _known_mirrors(self, which: Tensor, contact: Contact) -> Ask:
        world, frequency = self.world, self.frequency
        return lambda rows, _: scalar(
            world.reflection(which[rows], _rows(contact, rows), frequency)
        )

    def _known_crossings(
        self, which: Tensor, crossing: Crossing, last: Tensor, moving: bool
    ) -> Ask:
        def ask(rows: Tensor, world: World) -> Tensor:
            here = _rows(crossing, rows)
            if moving:
                here = slide(world, which[rows], here, last[rows], dtype=self.dtype)
            return scalar(world.transmission(which[rows], here, self.frequency, last[rows]))

        return ask


def slide(
    world: World,
    which: Int[Tensor, "m"],
    crossing: Crossing,
    last: Int[Tensor, "m"] | None = None,
    dtype: torch.dtype = torch.float64,
) -> Crossing:
    """Crossings whose ends lie on the surfaces as they are now, moved along the path.

    Shapes are asked in ``dtype``, frames stay float64: in float32 an end is off by less than half a
    micrometre.

    t' = t - f / (grad f . d): one Newton step, and the derivative of t by all that f depends on. An
    end inside the object, or where the path runs along the surface, stays. Normals turn with them.
    """
    direction = unit(crossing.end - crossing.start)
    nodes = torch.cat([which, which if last is None else last])
    point = torch.cat([crossing.start, crossing.end])
    normal = torch.cat([crossing.normal_start, crossing.normal_end])
    along = torch.cat([direction, direction])
    value, gradient = world.value_and_gradient(nodes, point, dtype)
    slope = (gradient * along).sum(-1)
    steep = (slope.detach().abs() >= STEEP) & (normal != 0).any(-1)
    move = torch.where(steep, value / torch.where(steep, slope, 1.0), 0.0)
    point = point - move[:, None] * along
    turning = unit(world.value_and_gradient(nodes, point, dtype)[1])
    alike = (turning * normal).sum(-1, keepdim=True) > 0.5  # on an edge it may be another face's
    normal = torch.where(alike, turning, normal)
    half = len(which)
    return Crossing(point[:half], point[half:], normal[:half], normal[half:])


def _thin(world: World) -> World:
    """The same world, crossings of learned surfaces integrated over one interval."""
    thin = copy.copy(world)
    thin.surfaces = [
        Body(b.shape, b.surface.with_numerics(1, b.surface.integral, b.surface.splits))
        if isinstance(b.surface, StochasticSurface)
        else b
        for b in world.surfaces
    ]
    return thin


def _crossing_object(world: World, which: Tensor, crossing: Crossing) -> Crossing:
    return Crossing(
        world.point_object(which, crossing.start),
        world.point_object(which, crossing.end),
        world.direction_object(which, crossing.normal_start),
        world.direction_object(which, crossing.normal_end),
    )


def _scalar(pair: Tensor) -> Tensor:
    """In double precision: the powers of dark coefficients are below what float32 holds."""
    return scalar(pair.to(torch.complex128))


def _cast(met: Met, dtype: torch.dtype) -> Met:
    return type(met)(**{n: t.to(dtype) for n, t in vars(met).items()})


def _rows(met: Met, i: Tensor) -> Met:
    return type(met)(**{n: t[i] for n, t in vars(met).items()})
