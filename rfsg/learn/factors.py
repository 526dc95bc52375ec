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
from rfsg.objects.contract import Contact, Crossing, Shape
from rfsg.objects.surfaces.interface import Known, Slid, at_boundary, turned
from rfsg.objects.surfaces.solid import Solid
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.world import World, unit
from rfsg.tracer.acting import Acting, scalar
from rfsg.tracer.edges import Edges
from rfsg.tracer.implicit import segments
from rfsg.tracer.mechanisms import COEFFICIENT
from rfsg.tracer.passages import Passages
from rfsg.tracer.records import Act, Paths

Met = TypeVar("Met", bound=Contact | Crossing)
Ask = Callable[[Tensor, World], Tensor]  # rows of a part, the world now -> its coefficients
STEEP = 1e-3  # cosine below which a path runs along a surface, and its crossing's end is held


@dataclass(frozen=True)
class Part:
    """Encounters of one kind: of which path each is, in order, and what they answer.

    pairs: whether they answer by TE and TM [k f 2], complex128, or by one coefficient for both [k f].
    """

    path: Int[Tensor, "m"]
    begin: Int[Tensor, "p1"]  # of each path's encounters
    ask: Ask
    pairs: bool = False

    def of(self, rows: Int[Tensor, "q"]) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
        """The encounters of some paths, and of which of them each is."""
        count = self.begin[rows + 1] - self.begin[rows]
        place = torch.repeat_interleave(torch.arange(len(rows)), count)
        first = torch.cumsum(count, 0) - count
        return torch.arange(len(place)) + (self.begin[rows] - first)[place], place


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
        met = (paths.which >= 0) & learned[paths.which.clamp(min=0)]
        mirror = paths.act == int(Act.REFLECT)
        self._mirrors(*torch.nonzero(met & mirror, as_tuple=True))
        for level in range(paths.which.shape[1]):
            other = met[:, level] & ~mirror[:, level]
            for act in torch.unique(paths.act[other, level]).tolist():
                i = torch.nonzero(other & (paths.act[:, level] == act)).squeeze(-1)
                self._add(i, self._acting(i, level, Act(act)))
        self._crossings(torch.nonzero(learned[through.which]).squeeze(-1))

    def shares(self, rows: Int[Tensor, "q"], world: World) -> Complex[Tensor, "q f"]:
        """Shares of h(f) of some of the paths, each once. world: with the poses as they are now."""
        places: dict[bool, list[Tensor]] = {False: [], True: []}
        answers: dict[bool, list[Tensor]] = {False: [], True: []}
        for part in self.parts:
            entry, place = part.of(rows)
            if len(entry):
                places[part.pairs].append(place)
                answers[part.pairs].append(part.ask(entry, world))
        if answers[True]:
            answers[False].append(scalar(torch.cat(answers[True])))
        if not answers[False]:
            return self.rest[rows]
        place = torch.cat(places[False] + places[True])
        return multiplied(self.rest[rows], place, torch.cat(answers[False]))

    def _add(self, path: Int[Tensor, "m"], ask: Ask, pairs: bool = False) -> None:
        begin = torch.searchsorted(path, torch.arange(len(self.rest) + 1))
        self.parts.append(Part(path, begin, ask, pairs))

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

    def _mirrors(self, i: Int[Tensor, "m"], level: Int[Tensor, "m"]) -> None:
        """Vertices on mirrors, of which paths (in order) and at which of their levels."""
        paths, world = self.paths, self.world
        which = paths.which[i, level]
        contact = Contact(
            paths.vertices[i, level + 1],
            self.u[i, level],
            self.u[i, level + 1],
            paths.normal[i, level],
        )
        for body, k in _materials(world, which):
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
                ask = self._known_mirrors(body, which[k], _rows(contact, k))
                self._add(i[k], ask, pairs=True)

    def _crossings(self, i: Tensor) -> None:
        through, world = self.through, self.world
        order = torch.argsort(through.path[i], stable=True)
        i = i[order]
        for moving in (False, True):
            some = i[self.moving[through.which[i]] == moving]
            for body, k in _materials(world, through.which[some]):
                j = some[k]
                which, crossing = through.which[j], _rows(through.crossing, j)
                learned = isinstance(body.surface, StochasticSurface)
                if learned and not moving:
                    local = _crossing_object(world, which, crossing)
                    ask = self._remembered(body, local, body.surface.transmission, which)
                elif learned:
                    ask = self._moved(body, which, crossing)
                else:
                    ask = self._known_crossings(body, which, crossing, through.last[j], moving)
                self._add(through.path[j], ask, pairs=not learned)

    def _remembered(
        self, body: Body, met: Contact | Crossing, question: Callable, which: Tensor
    ) -> Ask:
        """A learned surface whose shape's answers are kept, where they are not too many."""
        points = len(which) * (body.surface.samples + 1)  # type: ignore[attr-defined]
        local = _cast(met, self.dtype)
        shape: Callable[[Tensor], Any] = lambda _: body.shape  # noqa: E731
        if points <= MOST_POINTS and not bool(self.moving[which].any()):
            shape = Memory.of(body.surface, body.shape, met, self.dtype).at
        return lambda rows, _: _either(question(shape(rows), _rows(local, rows), self.frequency))

    def _moved(self, body: Body, which: Tensor, crossing: Crossing) -> Ask:
        """A learned surface on a shape that changes, or stands elsewhere now."""

        begun = _crossing_object(self.world, which, crossing)

        def ask(rows: Tensor, world: World) -> Tensor:
            if world is self.world:  # no pose is learned
                here = _rows(begun, rows)
            else:
                here = _crossing_object(world, which[rows], _rows(crossing, rows))
            slid = _cast(slide_object(body.shape, here, dtype=self.dtype), self.dtype)
            return _either(body.surface.transmission(body.shape, slid, self.frequency))

        return ask

    def _known_mirrors(self, body: Body, which: Tensor, contact: Contact) -> Ask:
        world, frequency = self.world, self.frequency
        if not _by_angle(body):
            return lambda rows, _: world.reflection(which[rows], _rows(contact, rows), frequency)
        return lambda rows, _: body.reflection(_rows(contact, rows), frequency)

    def _known_crossings(
        self, body: Body, which: Tensor, crossing: Crossing, last: Tensor, moving: bool
    ) -> Ask:
        if _by_angle(body) and not moving:
            return lambda rows, _: body.transmission(_rows(crossing, rows), self.frequency)

        def ask(rows: Tensor, world: World) -> Tensor:
            here = _rows(crossing, rows)
            if moving:
                here = slide(world, which[rows], here, last[rows], dtype=self.dtype)
            return world.transmission(which[rows], here, self.frequency, last[rows])

        return ask


def _materials(world: World, which: Int[Tensor, "m"]) -> list[tuple[Body, Int[Tensor, "k"]]]:
    """``World.surface_groups``, those as one whose answer is the same whatever the shape."""
    groups: dict[int, tuple[Body, list[Tensor]]] = {}
    for body, k in world.surface_groups(which):
        key = id(body.surface) if _by_angle(body) else id(body)
        groups.setdefault(key, (body, []))[1].append(k)
    return [(body, torch.cat(k).sort().values) for body, k in groups.values()]


def _by_angle(body: Body) -> bool:
    """Whether a surface answers to angles alone, which are the same in every frame and on every shape."""
    return isinstance(body.surface, Known) and not isinstance(body.surface, Solid)


def multiplied(
    value: Complex[Tensor, "q f"], place: Int[Tensor, "k"], factor: Complex[Tensor, "k f"]
) -> Complex[Tensor, "q f"]:
    """Rows of ``value`` times all factors whose ``place`` they are."""
    order = torch.argsort(place, stable=True)
    count = torch.bincount(place, minlength=len(value))
    first = torch.cumsum(count, 0) - count
    row = place[order]
    rank = torch.arange(len(row)) - first[row]
    table = place.new_full((len(value), int(count.max())), len(place))  # past the end: nothing more
    table[row, rank] = order
    every = torch.cat([factor, torch.ones_like(factor[:1])])
    for column in every[table].unbind(1):
        value = value * column
    return value


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
    nodes = torch.cat([which, which if last is None else last])
    point, normal, along = _both_ends(crossing)
    value, gradient = world.value_and_gradient(nodes, point, dtype)
    point = point - _newton(value, gradient, normal, along)[:, None] * along
    gradient = world.value_and_gradient(nodes, point, dtype)[1]
    normal = turned(normal, gradient, torch.linalg.vector_norm(gradient, dim=-1))
    half = len(which)
    return Crossing(point[:half], point[half:], normal[:half], normal[half:])


def slide_object(shape: Shape, crossing: Crossing, *, dtype: torch.dtype) -> Slid:
    """``slide`` of one shape in its own frame; to turn the normals is left to its surface, which asks
    for the slope at the ends anyway."""
    point, normal, along = _both_ends(crossing)
    value, gradient = shape.value_and_gradient(point.to(dtype))
    point = point - _newton(value.to(point), gradient.to(point), normal, along)[:, None] * along
    half = len(crossing.start)
    return Slid(point[:half], point[half:], crossing.normal_start, crossing.normal_end)


def _both_ends(crossing: Crossing) -> tuple[Tensor, Tensor, Tensor]:
    """Points, normals and directions of travel, those where it leaves after those where it enters."""
    direction = unit(crossing.end - crossing.start)
    return (
        torch.cat([crossing.start, crossing.end]),
        torch.cat([crossing.normal_start, crossing.normal_end]),
        torch.cat([direction, direction]),
    )


def _newton(value: Tensor, gradient: Tensor, normal: Tensor, along: Tensor) -> Float[Tensor, "m"]:
    """How far ends stand beyond f = 0 along the path [m]; 0 inside the object, or along a face."""
    slope = (gradient * along).sum(-1)
    steep = (slope.detach().abs() >= STEEP) & at_boundary(normal)
    return torch.where(steep, value / torch.where(steep, slope, 1.0), 0.0)


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


def _either(pair: Complex[Tensor, "k f 2"]) -> Complex[Tensor, "k f"]:
    """The coefficient of a learned surface, which is the same for TE and TM."""
    return pair[..., 0].to(torch.complex128)


def _cast(met: Met, dtype: torch.dtype) -> Met:
    return type(met)(**{n: t.to(dtype) for n, t in vars(met).items()})


def _rows(met: Met, i: Tensor) -> Met:
    return type(met)(**{n: t[i] for n, t in vars(met).items()})
