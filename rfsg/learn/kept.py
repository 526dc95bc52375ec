"""Paths kept between two searches, and what they carry as the learned parameters change.

The search is the dear part and has no gradients. Of the paths that it finds, most do not meet what is
learned: their shares of h(f) are numbers. The others, the *live* ones, are evaluated at every step,
for the links of a batch only, in one of two ways:

- **factored**, where no vertex moves: a share is a number times the coefficients of the learned
  objects that the path meets (``factors``);
- **traced**, where a mirror moves, a radio is polarised or a delay is compared: vertices follow from
  where they rested (``tracks``), crossings slide along, and the whole field is evaluated. Lengths,
  vertices and crossings carry gradients (envelope and implicit function theorems).
"""

import copy
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.learn.factors import Factors
from rfsg.learn.links import Links
from rfsg.learn.tracks import Tracks, carried
from rfsg.objects.contract import Crossing
from rfsg.objects.shapes.neural import NeuralShape, compute_lipschitz
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.scene import Scene
from rfsg.scene.world import World
from rfsg.tracer.channel import coefficients
from rfsg.tracer.edges import Edges, edges_in
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT, channel
from rfsg.tracer.passages import Passages, passages
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act, Channel, Paths
from rfsg.tracer.simulate import positions, simulate, world_for

DEEPER_DB = 40.0  # below the floor: what a learned object hides today may matter when it is learned
AT_ONCE = 16_384  # paths evaluated together where no gradient is asked for
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Shares:
    """What paths carry: of which of the links asked for, their share of h(f), delay [s], directions.

    path: their numbers among all that are kept.
    """

    path: Int[Tensor, "p"]
    link: Int[Tensor, "p"]
    value: Complex[Tensor, "p f"]
    delay: Float[Tensor, "p"]
    departure: Float[Tensor, "p 3"]
    arrival: Float[Tensor, "p 3"]


class Kept:
    """The paths of all links after one search.

    surface, moving: numbers of the nodes whose surface, and whose shape or pose, is learned.
    exact: evaluate learned fields in float64 too (their networks hold float32; 1e-6 of a gain).
    delays: whether delays must follow the parameters, as they do when they are compared.
    """

    def __init__(
        self,
        scene: Scene,
        links: Links,
        quality: Quality,
        surface: list[int],
        moving: list[int],
        *,
        exact: bool = False,
        delays: bool = False,
        progress: Progress | None = None,
    ):
        measure_shapes(scene, moving)
        self.links, self.quality = links, quality
        self.counts: Counter[str] = Counter()
        self.tx = positions(links.transmitters, "cpu")
        self.rx = positions(links.receivers, "cpu")
        everyone = replace(
            scene, transmitters=links.transmitters, receivers=links.receivers, source=None
        )
        with torch.no_grad():
            self.world = world_for(everyone, quality, "cpu")
            self.wavelength = SPEED_OF_LIGHT / float(links.frequency[0])
            self.edges: Edges | None = None
            if quality.diffraction:
                self.edges = edges_in(self.world, self.wavelength)
            self.paths = self._search(scene, progress or (lambda _: None))
            self.moving = _flags(len(scene.nodes), moving)
            self.learned = _flags(len(scene.nodes), surface) | self.moving
            self._keep()
        radios = (*links.transmitters, *links.receivers)
        polarised = any(r.polarization != "none" for r in radios)
        bends = any(isinstance(scene.nodes[i].body.surface, Solid) for i in surface)
        moved = self._on(self.moving) & _mirrors(self.paths)
        self.traced = self.live if delays or bends or polarised else moved
        rows = torch.nonzero(moved).squeeze(-1)
        self.tracks = Tracks(self.world, self.paths, rows, self.wavelength, quality)
        self.factors = self._factored(torch.float64 if exact else torch.float32)

    # the search

    @torch.no_grad()
    def _search(self, scene: Scene, tell: Progress) -> Paths:
        """Exact paths of every link, in order of link."""
        links, parts = self.links, []
        deep = replace(self.quality, floor_db=self.quality.floor_db - DEEPER_DB)
        for tx, rx in links.groups():
            some = replace(
                scene,
                transmitters=tuple(links.transmitters[i] for i in tx),
                receivers=tuple(links.receivers[i] for i in rx),
                source=None,
            )
            found = simulate(some, links.frequency, deep, progress=tell)
            self.counts.update(found.status_counts)
            at_tx, at_rx = torch.tensor(tx)[found.paths.tx], torch.tensor(rx)[found.paths.rx]
            parts.append(replace(found.paths, tx=at_tx, rx=at_rx))
        paths = Paths.joined(parts)
        link = links.find(paths.tx, paths.rx)
        order = torch.argsort(link, stable=True)
        self.link = link[order]
        self.begin = torch.searchsorted(self.link, torch.arange(len(links) + 1))
        return paths.take(order)

    @torch.no_grad()
    def _keep(self) -> None:
        """What the paths go through, which of them are live, and the shares of all as they are."""
        self.proxies = Proxies(self.world)
        shortest = SPEED_OF_LIGHT / float(self.links.frequency.max())
        rows = torch.arange(len(self.link)).split(AT_ONCE)
        through, channels = [], []
        for i in rows:
            some = self.paths.take(i)
            passed = passages(self.world, self.proxies, some, shortest, self.quality)
            channels.append(self._channel(self.world, self.proxies, some, passed))
            through.append(_shifted(passed, int(i[0])))
        self.through = _joined(through) if through else _nothing(self.paths)
        self.live = self._on(self.learned)
        crossed = self.through.crossed
        self.live[crossed[self.learned[crossed[:, 1]], 0]] = True
        self.value, self.delay, self.departure, self.arrival = (
            torch.cat([_field(name, c) for c in channels])
            if channels
            else _field(name, self._channel(self.world, self.proxies, self.paths, self.through))
            for name in _FIELDS
        )

    def _channel(
        self,
        world: World,
        proxies: Proxies,
        paths: Paths,
        through: Passages | None,
        without: Bool[Tensor, "n"] | None = None,
    ) -> Channel:
        links = self.links
        radios = links.transmitters, links.receivers
        return channel(
            world,
            proxies,
            paths,
            *radios,
            links.frequency,
            self.quality,
            self.edges,
            through,
            without,
        )

    def _factored(self, dtype: torch.dtype) -> Factors:
        """The live paths that are not traced: shares without what is learned, and how it is met."""
        rows = torch.nonzero(self.live & ~self.traced).squeeze(-1)
        self.number = torch.full((len(self.link),), -1, dtype=torch.int64)
        self.number[rows] = torch.arange(len(rows))
        some = self.paths.take(rows)
        through = _passages_of(self.through, rows, len(self.link))
        with torch.no_grad():
            found = self._channel(self.world, self.proxies, some, through, self.learned)
        return Factors(
            self.world,
            some,
            through,
            coefficients(found),
            self.links.frequency,
            self.edges,
            self.learned,
            self.moving,
            dtype,
        )

    def _on(self, nodes: Bool[Tensor, "n"]) -> Bool[Tensor, "p"]:
        """Paths with a vertex on one of some nodes."""
        return (nodes[self.paths.which.clamp(min=0)] & (self.paths.which >= 0)).any(1)

    # what is asked

    def says(self) -> Bool[Tensor, "l"]:
        """Which links have a path that meets what is learned."""
        says = torch.zeros(len(self.links), dtype=torch.bool)
        says[self.link[self.live]] = True
        return says

    def held(self) -> int:
        """Paths whose vertices would move with what is learned, and do not between searches."""
        followed = sum(len(group.rows) for group in self.tracks.groups)
        return int(self._on(self.moving).sum()) - followed

    def shares(self, asked: Int[Tensor, "b"], scene: Scene) -> Shares:
        """What the paths of some links (each once) carry with the parameters as they are now.

        scene: with the poses as they are now. Differentiable where grad mode is on.
        """
        rows, link = _ranges(self.begin, asked)
        world = _posed(self.world, scene)
        still = ~self.live[rows]
        parts: list[tuple[Tensor, ...]] = []
        i = rows[still]
        parts.append((i, link[still], self.value[i], *self._way(i)))
        traced = self.traced[rows]
        factored = ~still & ~traced
        if bool(factored.any()):
            i = rows[factored]
            value = self.factors.shares(self.number[i], world)
            parts.append((i, link[factored], value, *self._way(i)))
        if bool(traced.any()):
            i = rows[traced]
            found = self._traced(i, world)
            parts.append((i, link[traced], *(_field(name, found) for name in _FIELDS)))
        return Shares(*(torch.cat(column) for column in zip(*parts, strict=True)))

    @torch.no_grad()
    def values(self, scene: Scene) -> Complex[Tensor, "p f"]:
        """The share of h(f) of every path, with the parameters as they are now."""
        total = torch.zeros_like(self.value)
        for asked in torch.arange(len(self.links)).split(AT_ONCE):
            shares = self.shares(asked, scene)
            total[shares.path] = shares.value
        return total

    def _way(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.delay[rows], self.departure[rows], self.arrival[rows]

    def _traced(self, rows: Tensor, world: World) -> Channel:
        """The channel of paths as they are now."""
        before = self.paths.take(rows)
        through = _passages_of(self.through, rows, len(self.link))
        after = self.tracks.followed(before, rows, world)
        if bool(self.moving.any()):
            through = carried(world, before, after, through)
        return self._channel(world, self.proxies, after, through)


def measure_shapes(scene: Scene, moving: list[int]) -> None:
    """Bounds on the slope of learned shapes, which a march relies on, after their weights changed."""
    for shape in {id(s): s for i in moving if (s := scene.nodes[i].body.shape)}.values():
        if isinstance(shape, NeuralShape) and any(p.requires_grad for p in shape.parameters()):
            shape.lipschitz = compute_lipschitz(shape)


# rows of paths


_FIELDS = ("value", "delay", "departure", "arrival")


def _field(name: str, found: Channel) -> Tensor:
    """A column of ``Shares``. What is stopped by an opaque object has a value of 0 already."""
    return coefficients(found) if name == "value" else getattr(found, name)


def _mirrors(paths: Paths) -> Bool[Tensor, "p"]:
    """Paths of mirrors alone."""
    return ((paths.act == int(Act.REFLECT)) | (paths.which < 0)).all(1)


def _flags(count: int, which: list[int]) -> Bool[Tensor, "n"]:
    flags = torch.zeros(count, dtype=torch.bool)
    flags[which] = True
    return flags


def _ranges(
    begin: Int[Tensor, "l1"], asked: Int[Tensor, "b"]
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """The rows of each group asked for, and the place of their group among those asked for."""
    count = begin[asked + 1] - begin[asked]
    place = torch.repeat_interleave(torch.arange(len(asked)), count)
    first = torch.cumsum(count, 0) - count
    row = torch.arange(len(place)) - first[place] + begin[asked][place]
    return row, place


def _passages_of(through: Passages, rows: Int[Tensor, "m"], count: int) -> Passages:
    """What some of ``count`` paths go through, numbered as they stand in ``rows``."""
    number = torch.full((count,), -1, dtype=torch.int64)
    number[rows] = torch.arange(len(rows))
    i = torch.nonzero(number[through.path] >= 0).squeeze(-1)
    crossed = through.crossed[number[through.crossed[:, 0]] >= 0]
    crossed = torch.cat([number[crossed[:, :1]], crossed[:, 1:]], -1)
    crossing = Crossing(**{n: t[i] for n, t in vars(through.crossing).items()})
    return Passages(
        number[through.path[i]],
        through.segment[i],
        through.which[i],
        through.last[i],
        crossing,
        crossed,
    )


def _shifted(through: Passages, by: int) -> Passages:
    crossed = through.crossed.clone()
    crossed[:, 0] += by
    return replace(through, path=through.path + by, crossed=crossed)


def _joined(parts: list[Passages]) -> Passages:
    crossings = [vars(p.crossing) for p in parts]
    crossing = Crossing(**{n: torch.cat([c[n] for c in crossings]) for n in crossings[0]})
    names = ("path", "segment", "which", "last")
    plain = {n: torch.cat([getattr(p, n) for p in parts]) for n in names}
    return Passages(crossing=crossing, crossed=torch.cat([p.crossed for p in parts]), **plain)


def _nothing(paths: Paths) -> Passages:
    none, zero = paths.tx, paths.vertices[:0, 0]
    crossing = Crossing(zero, zero, zero, zero)
    return Passages(none, none, none, none, crossing, none.new_zeros(0, 3))


def _posed(world: World, scene: Scene) -> World:
    """The same world with the poses as they are in ``scene``."""
    poses = [node.pose for node in scene.nodes]
    if not any(p.translation.requires_grad or p.rotation.requires_grad for p in poses):
        return world
    posed = copy.copy(world)
    posed.rotation = torch.stack([p.rotation for p in poses])
    posed.translation = torch.stack([p.translation for p in poses])
    return posed
