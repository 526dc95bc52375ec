"""Radio maps of boxes and half-spaces by the exact image method: power, and no path kept.

The same paths and powers as the path solver's at the same points (``method="paths"``, the plain
twin), found the other way round: ``beams`` says which points each sequence of mirrors lights, the
straight lines from its image are folded back onto the mirrors, and what stands in their way is asked
of every box at once. Lines that come close to the face of another object than their mirrors, and
those that go through something, are left to the path solver's own tracing.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Crossing
from rfsg.scene.radios import Radio
from rfsg.scene.scene import SceneError
from rfsg.scene.world import World
from rfsg.tracer import field
from rfsg.tracer.beams import Lit, Rows, lit_by
from rfsg.tracer.embree import Proxies
from rfsg.tracer.faces import Planes, planes_of
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.passages import Passages
from rfsg.tracer.plan import Quality
from rfsg.tracer.prefixes import Budget, Prefixes, TooMany, levels
from rfsg.tracer.records import Chains, Paths
from rfsg.tracer.seams import coincident
from rfsg.tracer.sequences import MOST_PAIRS
from rfsg.tracer.settle import ON_SURFACE
from rfsg.tracer.solve import COINCIDENT, GRAZING
from rfsg.tracer.traced import in_threads

HAIR = 1e-3  # [m] nearer to a face than this, the path solver's own rules decide, in float64
AT_ONCE = 16  # batches of lines among threads
STILL = 1e-12  # [m] along an axis: such a segment is beside a box, or between its faces, as a whole


def refusal(world: World, quality: Quality) -> str:
    """Why a scene is none for this method, or nothing."""
    if not bool(world.rectangular.all()):
        k = int(torch.nonzero(~world.rectangular)[0])
        return f"{world.scene.nodes[k].path} is neither a box nor a half-space"
    if bool(world.solid.any()) and quality.refraction:
        k = int(torch.nonzero(world.solid)[0])
        return f"{world.scene.nodes[k].path} is a solid, which bends waves (refraction=True)"
    if quality.diffuse:
        return "diffuse reflection is asked for (diffuse)"
    return ""


@torch.no_grad()
def power_by_images(
    world: World,
    transmitters: tuple[Radio, ...],
    position: Float[Tensor, "t 3"],
    rows: Rows,
    point: Float[Tensor, "c 3"],
    frequency: Float[Tensor, "1"],
    quality: Quality,
) -> Float[Tensor, "t c"]:
    """Incoherent path gain of every transmitter at points in rows, to an isotropic receiver.

    Raises SceneError for a scene that the method does not hold for, or of too many sequences.
    """
    reason = refusal(world, quality)
    if reason:
        raise SceneError([f"map by images: {reason}; 'rays' and 'paths' can"])
    gain = torch.zeros(len(position), len(point), dtype=torch.float64, device=point.device)
    search = _Search(world, planes_of(world), transmitters, position, point, frequency, quality)
    budget = Budget(MOST_PAIRS)
    try:
        found = [levels(search.planes, x, quality.depth, budget) for x in position]
    except TooMany:
        raise SceneError(
            ["map by images: too many sequences of faces; take fewer reflections, or 'rays'"]
        ) from None
    dark = search.within_opaque()
    batches = (
        (t, some, lit)
        for t, sequences in enumerate(found)
        for some in sequences
        for lit in lit_by(search.planes, some, rows, quality.chunk)
    )

    def work(batch: tuple[int, Prefixes, Lit]) -> tuple[Tensor, Tensor]:
        t, some, lit = batch
        i = torch.nonzero(~dark[lit.point]).squeeze(-1)
        return search.heard(t, some, Lit(lit.sequence[i], lit.point[i]))

    # a few batches at a time, for memory; added in their order, so that threads change nothing
    while now := list(islice(batches, AT_ONCE)):
        for (t, *_), (here, power) in zip(now, in_threads(work, now), strict=True):
            gain[t].index_add_(0, here, power)
    return gain


@dataclass(frozen=True)
class _Ways:
    """Lines from images to points, folded: coordinates first, then vertices, then lines.

    length: of the whole, as the straight line from the image [m].
    """

    point: Int[Tensor, "m"]
    faces: Int[Tensor, "d m"]
    vertices: Float[Tensor, "3 v m"]
    length: Float[Tensor, "m"]

    def take(self, i: Int[Tensor, "k"]) -> "_Ways":
        return _Ways(self.point[i], self.faces[:, i], self.vertices[..., i], self.length[i])


@dataclass(frozen=True)
class _Search:
    """What does not change from one batch of lines to the next."""

    world: World
    planes: Planes
    transmitters: tuple[Radio, ...]
    position: Float[Tensor, "t 3"]
    point: Float[Tensor, "c 3"]
    frequency: Float[Tensor, "1"]
    quality: Quality

    @cached_property
    def proxies(self) -> Proxies:
        return Proxies(self.world)

    def within_opaque(self) -> Bool[Tensor, "c"]:
        """Points well inside what lets nothing through."""
        world, dark = self.world, torch.zeros_like(self.point[:, 0], dtype=torch.bool)
        for node in torch.nonzero(world.opaque).squeeze(-1).tolist():
            turn = world.rotation[node] / world.scale[node]
            where = (self.point - world.translation[node]) @ turn
            (low, high), hair = world.bounds_object[node], HAIR / world.scale[node]
            dark |= ((where > low + hair) & (where < high - hair)).all(-1)
        return dark

    def heard(
        self, t: int, sequences: Prefixes, lit: Lit
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"]]:
        """(point, path gain) of the true paths among a batch."""
        ways = self.folded(self.position[t], sequences, lit)
        ways = ways.take(self.mirrored(ways))
        ways, near = self.unhindered(ways)
        paths = self.paths(t, ways)
        clear, close = paths.take(~near), paths.take(near)
        found = [self.gains(clear, _nothing(clear))]
        if len(close.tx):  # twins on coinciding faces are close to one another's objects
            found.append(self.gains(self.once(close), None))
        points, powers = zip(*found, strict=True)
        return torch.cat(points), torch.cat(powers)

    def folded(self, source: Tensor, sequences: Prefixes, lit: Lit) -> "_Ways":
        """The straight lines from images to points, folded back onto the mirrors."""
        planes, faces, i = self.planes, sequences.faces, lit.sequence
        images = [source[:, None].expand(3, len(faces))]
        normal, offset = planes.normal[faces].permute(1, 2, 0), planes.offset[faces].T
        for n, d in zip(normal, offset, strict=True):
            images.append(images[-1] - 2.0 * (_dot(images[-1], n) - d) * n)
        target = self.point[lit.point].T.contiguous()
        line, vertices = target - images[-1][:, i], [target]
        for n, d, image in zip(normal.flip(0), offset.flip(0), images[:0:-1], strict=True):
            near = (d - _dot(image, n))[i]
            image = image[:, i]
            ray = vertices[0] - image
            slope = _dot(ray, n[:, i])
            t = near / torch.where(slope == 0, 1.0, slope)
            vertices.insert(0, image + t * ray)
        vertices.insert(0, source[:, None].expand_as(target))
        return _Ways(lit.point, faces[i].T, torch.stack(vertices, 1), _dot(line, line).sqrt())

    def mirrored(self, ways: "_Ways") -> Int[Tensor, "k"]:
        """Lines that meet each of their mirrors within its rectangle, from the front."""
        planes, good = self.planes, ways.length > COINCIDENT
        run = ways.vertices[:, 1:] - ways.vertices[:, :-1]
        length = _dot(run, run).sqrt()
        good &= (length > COINCIDENT).all(0) & torch.isfinite(length).all(0)
        tolerance = ON_SURFACE * self.world.size[planes.node].clamp(min=1.0)
        for k, face in enumerate(ways.faces):
            normal, place = planes.normal.T[:, face], ways.vertices[:, k + 1]
            for s, sign in ((k, -1.0), (k + 1, 1.0)):
                good &= sign * _dot(run[:, s], normal) > GRAZING * length[s]
            aways, square = place - planes.centre.T[:, face], torch.zeros_like(ways.length)
            for edge in (0, 1):
                reach = _dot(aways, planes.edges[:, edge].T[:, face]).abs()
                square += (reach - planes.half[:, edge][face]).clamp(min=0.0) ** 2
            good &= square <= tolerance[face] ** 2
        return torch.nonzero(good).squeeze(-1)

    def unhindered(self, ways: "_Ways") -> tuple["_Ways", Bool[Tensor, "k"]]:
        """Lines that nothing surely stops, and which of them come near more than their own mirrors.

        The last segments are asked first: most of what is stopped is stopped on the ways down to the
        map, and need not be asked for the rest.
        """
        near, open_ = self._met(ways, slice(-2, None))
        ways = ways.take(i := torch.nonzero(open_).squeeze(-1))
        if not len(ways.faces):
            return ways, near[i]
        before, open_ = self._met(ways, slice(None, -1))
        near = near[i] | before
        return ways.take(j := torch.nonzero(open_).squeeze(-1)), near[j]

    def _met(self, ways: "_Ways", part: slice) -> tuple[Bool[Tensor, "m"], Bool[Tensor, "m"]]:
        """Whether some segments of each line come near a node; and whether they are open."""
        near = torch.zeros_like(ways.point, dtype=torch.bool)
        open_ = ~near
        # float32, about the middle of all: twice as fast, and whatever is close is looked at again
        vertices = (ways.vertices[:, part] - self.middle[:, None, None]).float()
        none = torch.full_like(ways.point, -1)[None]
        mirrors = torch.cat([none, self.planes.node[ways.faces], none])[part]
        for node in range(len(self.world)):
            touched, entered = _met(self.world, node, self.middle, self.hair, vertices)
            other = mirrors != node
            other = other[:-1] & other[1:]
            near |= (touched & other).any(0)
            if bool(self.world.opaque[node]):
                open_ &= ~(entered & other).any(0)
        return near, open_

    @cached_property
    def middle(self) -> Float[Tensor, "3"]:
        """Of all points and bounded nodes [m]."""
        return 0.5 * (self._corners.amin(0) + self._corners.amax(0))

    @cached_property
    def hair(self) -> float:
        """How near a face float32 leaves it open on which side a segment is [m]."""
        return max(HAIR, 64.0 * 2.0**-23 * float((self._corners - self.middle).abs().max()))

    @cached_property
    def _corners(self) -> Float[Tensor, "k 3"]:
        bounded = torch.isfinite(self.world.bounds_object).all(-1).all(-1)
        corners = self.proxies.corners(torch.nonzero(bounded).squeeze(-1)).reshape(-1, 3)
        return torch.cat([self.position, self.point, corners])

    def paths(self, t: int, ways: "_Ways") -> Paths:
        """Lines as the path solver writes its paths."""
        faces, planes = ways.faces.T, self.planes
        none = torch.zeros_like(ways.point)
        return Paths(
            none + t,
            ways.point,
            planes.node[faces],
            torch.zeros_like(faces),  # all of them reflections
            planes.patch[faces],
            ways.vertices.permute(2, 1, 0).contiguous(),
            planes.normal[faces],
            ways.length,
            1.0 / ways.length,
            none,
            none,
        )

    def once(self, paths: Paths) -> Paths:
        """Of paths on faces that coincide, one."""
        every = torch.ones_like(paths.tx, dtype=torch.bool)
        x = paths.vertices[:, 1:-1]
        chains = Chains(paths.tx, paths.rx, paths.which, paths.item, x)
        return paths.take(~coincident(self.world, chains, paths.vertices, paths.normal, every))

    def gains(
        self, paths: Paths, through: Passages | None
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"]]:
        """(point, path gain) of paths above the floor; through: what they go through, where known."""
        if not len(paths.tx):
            return paths.rx, paths.length
        # one isotropic receiver stands for all: thousands of equal ones only cost time
        ear, heard = Radio.at("cell", 0.0, 0.0, 0.0), replace(paths, rx=torch.zeros_like(paths.rx))
        found = field.channel(self.world, self.proxies, heard, self.transmitters, (ear,),
                              self.frequency, self.quality, through=through)  # fmt: skip
        free = SPEED_OF_LIGHT / self.frequency / (4 * torch.pi) / paths.length
        strength = found.gain.abs() if found.jones is None else found.jones.abs().amax((2, 3))
        loud = strength[:, 0] >= free * 10.0 ** (self.quality.floor_db / 20.0)
        keep = loud & ~found.blocked
        return paths.rx[keep], found.gain[keep, 0].abs() ** 2


def _nothing(paths: Paths) -> Passages:
    """What clear paths go through."""
    index, place = paths.tx[:0], paths.vertices[:0, 0]
    crossing = Crossing(place, place, place, place)
    return Passages(index, index, index, index, crossing, index.reshape(0, 3))


def _met(
    world: World, node: int, middle: Tensor, hair: float, vertices: Float[Tensor, "3 v m"]
) -> tuple[Bool[Tensor, "s m"], Bool[Tensor, "s m"]]:
    """Segments that come within a hair of a box, and those that go deeper into it than a hair.

    vertices: from ``middle`` on, in float32.
    """
    # columns lie side by side in memory: a sum over three of a row's numbers is slow in torch
    turn = world.rotation[node] / world.scale[node]
    moved = ((world.translation[node] - middle) @ turn).to(vertices)
    where = (turn.T.to(vertices) @ vertices.flatten(1)).reshape(vertices.shape)
    low, high = world.bounds_object[node].to(vertices) + moved
    hair = hair / float(world.scale[node])
    enter = torch.zeros_like(where[0, 1:])
    touch, leave = enter.clone(), torch.ones_like(enter)
    off = leave.clone()
    for axis in range(3):
        a, run = where[axis, :-1], where[axis, 1:] - where[axis, :-1]
        run = torch.where(run.abs() < STILL, STILL, run)
        slow = 1.0 / run
        one, other, wide = (low[axis] - a) * slow, (high[axis] - a) * slow, hair * slow.abs()
        near, far = torch.minimum(one, other), torch.maximum(one, other)
        touch, off = torch.maximum(touch, near - wide), torch.minimum(off, far + wide)
        enter, leave = torch.maximum(enter, near + wide), torch.minimum(leave, far - wide)
    return touch <= off, enter < leave


def _dot(a: Float[Tensor, "3 *m"], b: Float[Tensor, "3 *m"]) -> Float[Tensor, "*m"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
