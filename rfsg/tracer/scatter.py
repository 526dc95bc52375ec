"""Diffuse reflection: paths from a transmitter over a tile of a rough face to a receiver.

The power that a tile dA sends on, for 1 W from a transmitter of gain G_t at distance d1: density
G_t / (4 pi d1^2), on cos(theta_i) dA of it, of which |c|^2 = S^2 |R(theta_i)|^2 scatters, by a lobe
p [1/sr] that integrates to 1 over the hemisphere. At distance d2 that is a density p / d2^2 on a
receiver of aperture G_r lambda^2 / 4 pi. In all

    |gain|^2 = (lambda / 4 pi)^2 G_t G_r S^2 |R(theta_i)|^2 * spread^2,
    spread^2 = integral over the tile of cos(theta_i) p / (d1^2 d2^2) dA   [1/m^2],

so that what crosses a hemisphere about the tile is S^2 |R|^2 of what arrives, whatever the lobe. R and
antennas are taken at the tile's centre. A planar mirror before or after the tile makes d1 or d2 the
distance to an image.

The phase of a tile is random and a matter of its number and of ``Quality.phase_seed`` alone: a link
sees speckle, and the mean over seeds is the sum of the tiles' powers (``channel.power``). Field vectors
are reflected as by a mirror, with Fresnel's coefficients at theta_i, and turned from the mirror
direction to the tile's by the least rotation; the share K_x of their power leaves turned by 90 degrees,
with a phase of its own (K_x as in the primer on electromagnetics of Sionna RT, which keeps the arriving
polarisation where this one reflects and turns it).
"""

import math
import zlib
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact
from rfsg.objects.physics.lobes import mirrored
from rfsg.scene.world import World, unit
from rfsg.tracer.acting import Acting, dyad_of, scalar
from rfsg.tracer.faces import Planes, moving_planes_of
from rfsg.tracer.images import fold, images_of
from rfsg.tracer.implicit import segments
from rfsg.tracer.march import FORWARD
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act, Found, Paths, Status
from rfsg.tracer.tiles import (
    Tiles,
    TooManyTiles,
    curved_tiles,
    cut,
    grounds_of,
    hashed,
    nearest,
    planar_tiles,
)

MOST_TILES = 1_000_000  # tiles x links of one simulation: about a gigabyte
MOST_PAIRS = 100_000_000  # (source, target, face) looked at
COARSEST = 8.0  # a planar tile's diagonal is at most min(1, COARSEST / diffuse) of its distance to
# the nearer end, and less for narrow lobes
PATCH_BITS = 16  # of a SCATTER vertex' item: the patch below, the tile's number above
FAINTEST = 1e-200  # [1/m2] a tile that gathers less gathers nothing


@dataclass(frozen=True)
class Ends:
    """Radios, or their images in a planar mirror each. face: rows of the mirrors, none for radios."""

    radio: Int[Tensor, "e"]
    face: Int[Tensor, "e d"]
    image: Float[Tensor, "e 3"]

    def __len__(self) -> int:
        return len(self.radio)


@dataclass(frozen=True)
class Lit:
    """Tiles, each with the source and the target it lies between (rows of two ``Ends``)."""

    source: Int[Tensor, "k"]
    target: Int[Tensor, "k"]
    tiles: Tiles

    def take(self, i: Tensor) -> "Lit":
        return Lit(self.source[i], self.target[i], self.tiles.take(i))


def rough_nodes(world: World) -> Bool[Tensor, "n"]:
    """Which nodes scatter."""
    rough = torch.tensor([b.scattering is not None for b in world.surfaces], dtype=torch.bool)
    return rough.to(world.device)[world.surface_of_node]


def paths_of(
    world: World, tx: Float[Tensor, "t 3"], rx: Float[Tensor, "r 3"], quality: Quality
) -> Found:
    """Scattered paths: one tile on each, and up to one planar mirror before or after it where
    ``quality.depth`` allows a second interaction.

    Raises ValueError when tiles times links exceed ``MOST_TILES``; mirrors beside the tile are left
    out first. Differentiable in poses, shapes, positions and materials.
    """
    if not (quality.diffuse and quality.depth and len(tx) and len(rx)):
        return Found()
    rough = rough_nodes(world)
    planes = moving_planes_of(world)
    curved = [
        curved_tiles(world, n, quality.diffuse)
        for n in torch.nonzero(rough & ~world.rectangular).squeeze(-1).tolist()
    ]
    scene = _Scene(world, planes, rough, curved, tx, rx, quality)
    here, there = (_ends(planes, x, mirrored=False) for x in (tx, rx))
    try:
        found = [_scattered(scene, here, there, MOST_TILES)]
    except TooManyTiles:
        raise ValueError(
            f"diffuse={quality.diffuse}: the tiles between {len(tx)} transmitters and {len(rx)} "
            f"receivers are more than {MOST_TILES}; lower diffuse, or ask for fewer receivers"
        ) from None
    beside, left_out = "", ()
    if quality.depth > 1:
        before, after = (_ends(planes, x, mirrored=True) for x in (tx, rx))
        left = MOST_TILES - len(found[0].tx)
        try:
            one = _scattered(scene, before, there, left)
            two = _scattered(scene, here, after, left - len(one.tx))
            found, beside = [*found, one, two], " and up to one planar mirror before or after it"
        except TooManyTiles:
            left_out = (f"mirrors beside a scattering tile: more than {MOST_TILES} paths",)
    count = sum(len(p.tx) for p in found)
    said = f"diffuse reflection: {count} paths over one tile each{beside}"
    return Found(tuple(found), {Status.OK: count}, (said,), left_out)


@dataclass(frozen=True)
class _Scene:
    """What every order of paths needs."""

    world: World
    planes: Planes
    rough: Bool[Tensor, "n"]
    curved: list[Tiles]
    tx: Float[Tensor, "t 3"]
    rx: Float[Tensor, "r 3"]
    quality: Quality


def _ends(planes: Planes, point: Float[Tensor, "n 3"], *, mirrored: bool) -> Ends:
    """The points themselves, or their images in every plane that they stand in front of."""
    radio = torch.arange(len(point), device=point.device)
    if not mirrored:
        return Ends(radio, radio[:, None][:, :0], point)
    height = point @ planes.normal.T - planes.offset
    radio, face = torch.nonzero(height > 0, as_tuple=True)
    image = point[radio] - 2.0 * height[radio, face][:, None] * planes.normal[face]
    return Ends(radio, face[:, None], image)


def _scattered(scene: _Scene, sources: Ends, targets: Ends, most: int) -> Paths:
    """Paths of one order: so many mirrors before the tile, so many after."""
    parts = [_planar(scene, sources, targets, most)]
    for tiles in scene.curved:
        left = most - sum(len(p.source) for p in parts)
        parts.append(_every(tiles, sources, targets, left))
    return Paths.joined(
        [
            _paths(scene, part.take(i), sources, targets)
            for part in parts
            for i in torch.arange(len(part.source), device=scene.tx.device).split(
                scene.quality.chunk
            )
        ]
    )


def _planar(scene: _Scene, sources: Ends, targets: Ends, most: int) -> Lit:
    """Tiles of rough rectangles between every source and every target in front of them."""
    world, planes, count = scene.world, scene.planes, scene.quality.diffuse
    row = torch.nonzero((scene.rough & world.rectangular)[planes.node]).squeeze(-1)
    if len(sources) * len(targets) * len(row) > MOST_PAIRS:
        raise TooManyTiles
    with torch.no_grad():
        lit = _facing(planes, sources, row)[:, None] & _facing(planes, targets, row)[None]
        s, t, f = torch.nonzero(lit, as_tuple=True)
        source, target, face = sources.image[s], targets.image[t], row[f]
    grounds = grounds_of(planes, face, source, target)
    coarsest = min(1.0, COARSEST / count) * _widths(world)[planes.node[face]]
    cells = cut(planes, grounds, source, target, coarsest, count, most)
    tiles = planar_tiles(planes, grounds, cells, count)
    return Lit(s[cells.row], t[cells.row], tiles)


def _widths(world: World) -> Float[Tensor, "n"]:
    """Angle over which each node's lobe changes [rad]."""
    widths = [1.0 if b.scattering is None else b.scattering.width for b in world.surfaces]
    return torch.tensor(widths, dtype=torch.float64, device=world.device)[world.surface_of_node]


def _facing(planes: Planes, ends: Ends, row: Int[Tensor, "f"]) -> Bool[Tensor, "e f"]:
    """Which faces an end stands in front of; of an image, those with a corner before its mirror."""
    facing = ends.image @ planes.normal[row].T - planes.offset[row] > 0
    if ends.face.shape[1]:
        mirror = ends.face[:, 0]
        corners = planes.corners()[row].reshape(-1, 3)
        height = corners @ planes.normal[mirror].T - planes.offset[mirror]
        beyond = (height > 0).reshape(len(row), 4, len(mirror)).any(1)
        facing &= beyond.T & (mirror[:, None] != row[None])
    return facing


def _every(tiles: Tiles, sources: Ends, targets: Ends, most: int) -> Lit:
    """All tiles of an object between every source and every target."""
    shape = (len(sources), len(targets), len(tiles))
    if math.prod(shape) > most:
        raise TooManyTiles
    each = [torch.arange(n, device=tiles.node.device) for n in shape]
    s, t, k = (x.reshape(-1) for x in torch.meshgrid(*each, indexing="ij"))
    return Lit(s, t, tiles.take(k))


def _paths(scene: _Scene, lit: Lit, sources: Ends, targets: Ends) -> Paths:
    """The paths over tiles that are lit from both ends, their mirrors met on their faces."""
    world, planes, tx, rx = scene.world, scene.planes, scene.tx, scene.rx
    with torch.no_grad():
        gathered = gather(world, lit.tiles, sources.image[lit.source], targets.image[lit.target])
    lit = lit.take(torch.nonzero(gathered > FAINTEST).squeeze(-1))
    centre, upright = _met(lit.tiles, sources.image[lit.source], targets.image[lit.target])
    sent, heard = sources.radio[lit.source], targets.radio[lit.target]
    fore = _mirrors(planes, sources.face[lit.source])
    aft = _mirrors(planes, targets.face[lit.target])
    ahead, behind = images_of(world, fore, tx[sent]), images_of(world, aft, rx[heard])
    first, on_first = fold(world, ahead, fore, centre)
    last, on_last = fold(world, behind, aft, centre)
    i = torch.nonzero(on_first & on_last).squeeze(-1)
    tiles = lit.tiles.take(i)
    vertices = torch.cat(
        [tx[sent[i], None], first[i], centre[i, None], last[i].flip(1), rx[heard[i], None]], 1
    )
    which, item = (
        torch.stack([*(m[n][i] for m in fore), own, *(m[n][i] for m in reversed(aft))], 1)
        for n, own in ((0, tiles.node), (1, _items(world, tiles, scene.quality.phase_seed)))
    )
    act = torch.full_like(which, int(Act.REFLECT))
    act[:, len(fore)] = int(Act.SCATTER)
    length, _ = segments(vertices)
    spread = torch.sqrt(gather(world, tiles, ahead.image[i], behind.image[i]))
    zero = torch.zeros_like(i)
    return Paths(
        sent[i],
        heard[i],
        which,
        act,
        item,
        vertices,
        torch.cat([ahead.normal[i], upright[i, None], behind.normal[i].flip(1)], 1),
        length.sum(1),
        spread,
        zero,
        zero + int(Status.OK),
    )


def _mirrors(planes: Planes, face: Int[Tensor, "k d"]) -> list[tuple[Tensor, Tensor]]:
    return [(planes.node[f], planes.patch[f]) for f in face.unbind(1)]


def _met(tiles: Tiles, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Where the paths meet their tiles, and the normal there: a lit point, as near the centre as may
    be (a tile of a curved face may lie across the edge of the shadow)."""
    with torch.no_grad():
        seen = [
            _height(x, tiles.centre[:, None], tiles.upright[:, None]) > 0 for x in (source, target)
        ]
        whole = (seen[0] & seen[1])[:, 0]
        lit = tiles.area > 0
        for end in (source, target):
            lit &= _height(end, tiles.point, tiles.normal) > 0
        best = nearest(tiles.point, lit, tiles.centre)
    each = torch.arange(len(tiles), device=best.device)
    centre = torch.where(whole[:, None], tiles.centre, tiles.point[each, best])
    return centre, torch.where(whole[:, None], tiles.upright, tiles.normal[each, best])


def _height(end: Tensor, point: Tensor, normal: Tensor) -> Float[Tensor, "k q"]:
    return ((end[:, None] - point) * normal).sum(-1)


def gather(
    world: World, tiles: Tiles, source: Float[Tensor, "k 3"], target: Float[Tensor, "k 3"]
) -> Float[Tensor, "k"]:
    """spread^2 [1/m2]: the integral of cos(theta_i) p / (d1^2 d2^2) over each tile."""
    before, after = tiles.point - source[:, None], target[:, None] - tiles.point
    incoming, outgoing = unit(before), unit(after)
    density = torch.zeros_like(tiles.area)
    for body, i in world.surface_groups(tiles.node):
        assert body.scattering is not None
        lobe = body.scattering.density(incoming[i], outgoing[i], tiles.normal[i])
        density = density.index_copy(0, i, lobe)
    cosine = -(incoming * tiles.normal).sum(-1)
    near, far = (before * before).sum(-1), (after * after).sum(-1)
    there = (tiles.area > 0) & (density > 0)  # not the points that only fill up the record
    weight = torch.where(there, tiles.area, 0.0) / torch.where(there, near * far, 1.0)
    return (weight * cosine * density).sum(1)


# phases


def _items(world: World, tiles: Tiles, seed: int) -> Int[Tensor, "k"]:
    """The patch in the low bits, above it a number drawn for the seed, the object, and the tile."""
    names = [zlib.crc32(n.path.encode()) for n in world.scene.nodes]
    name = torch.tensor(names, dtype=torch.int64, device=world.device)
    key = [torch.full_like(tiles.number, seed), name[tiles.node], tiles.number]
    number = hashed(torch.stack(key, 1))
    return number << PATCH_BITS | (tiles.patch & ((1 << PATCH_BITS) - 1))


def _phase(at: Acting, i: Tensor, level: int, which: int) -> Complex[Tensor, "m"]:
    """exp(j chi) of tiles: chi uniform over the circle, the same from both ends."""
    number = at.paths.item[i, level] >> PATCH_BITS
    key = torch.stack([torch.full_like(number, which), number], 1)
    chi = hashed(key).to(torch.float64) * (2.0 * math.pi / 2.0**47)
    return torch.polar(torch.ones_like(chi), chi)


def together(paths: Paths, loss: Float[Tensor, "p"]) -> Float[Tensor, "p"]:
    """Amplitudes of paths, where those over the tiles of one object count as one: the root of the
    sum of their squares. A tile is a share of what an object scatters, smaller the finer it is cut."""
    scattered = torch.nonzero((paths.act == int(Act.SCATTER)).any(1)).squeeze(-1)
    if not len(scattered):
        return loss
    ends = torch.stack([paths.tx, paths.rx], 1)
    mirror = torch.where(paths.act == int(Act.SCATTER), -1, paths.item)
    key = torch.cat([ends, paths.which, paths.act, mirror], 1)[scattered]
    _, group = torch.unique(key, dim=0, return_inverse=True)
    power = torch.zeros_like(loss[scattered]).index_add(0, group, loss[scattered] ** 2)
    return loss.index_copy(0, scattered, torch.sqrt(power[group]))


# what a tile does to the wave


def coefficient(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f"]:
    """S |R| of the mean power of both polarisations, with the tile's phase."""
    which, contact = _contact(at, i, level)
    amplitude = scalar(at.world.diffuse(which, contact, at.frequency))
    return amplitude * _phase(at, i, level, 0)[:, None]


def dyad(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f 3 3"]:
    """The mirror's dyad times S, turned to where the tile scatters, and its cross-polar share."""
    which, contact = _contact(at, i, level)
    pair = at.world.diffuse(which, contact, at.frequency)
    mirror = dyad_of(pair, contact.incoming, contact.outgoing, contact.normal)
    out = at.u[i, level + 1]
    turn = _least_rotation(contact.outgoing, out)
    share = _cross_shares(at.world)[which]
    co = torch.sqrt(1.0 - share) * _phase(at, i, level, 0)
    cross = torch.sqrt(share) * _phase(at, i, level, 1)
    cross = cross * _forwards(at.world, which, contact.incoming, out)
    eye = torch.eye(3, dtype=turn.dtype, device=turn.device)
    both = co[:, None, None] * eye + cross[:, None, None] * _cross_matrix(out)
    return (both @ turn.to(both.dtype))[:, None] @ mirror


def _contact(at: Acting, i: Tensor, level: int) -> tuple[Tensor, Contact]:
    """As a mirror would have it: reflected at the angle of incidence."""
    which, met = at.contact(i, level)
    out = mirrored(met.incoming, met.normal)
    return which, Contact(met.point, met.incoming, out, met.normal)


def _cross_shares(world: World) -> Float[Tensor, "n"]:
    shares = [0.0 if b.scattering is None else b.scattering.cross_share for b in world.surfaces]
    return torch.tensor(shares, dtype=torch.float64, device=world.device)[world.surface_of_node]


def _forwards(
    world: World, which: Tensor, incoming: Float[Tensor, "m 3"], outgoing: Float[Tensor, "m 3"]
) -> Float[Tensor, "m"]:
    """+1 for one way over a tile and -1 for the other, told apart in the object's own frame: a
    quarter turn changes its sign under reversal, and this makes up for it, so that a tile that is
    reciprocal without cross-polarisation stays so with it."""
    way = world.direction_object(which, incoming + outgoing).detach()
    return torch.where(way @ way.new_tensor(FORWARD) < 0, -1.0, 1.0).to(way)


def _least_rotation(
    start: Float[Tensor, "m 3"], end: Float[Tensor, "m 3"]
) -> Float[Tensor, "m 3 3"]:
    """The rotation in the plane of two unit vectors (Rodrigues); they never oppose each other here,
    since both leave the same side of a face."""
    axis = torch.linalg.cross(start, end)
    cosine = (start * end).sum(-1)
    around = _cross_matrix(axis)
    eye = torch.eye(3, dtype=start.dtype, device=start.device)
    return eye + around + around @ around / (1.0 + cosine).clamp(min=1e-12)[:, None, None]


def _cross_matrix(v: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3 3"]:
    """[v]_x, with [v]_x w = v x w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).reshape(-1, 3, 3)
