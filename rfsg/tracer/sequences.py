"""The complete search: every sequence of planar faces, and one curved or learned face among them.

Rays may miss a beam thinner than their spacing, and miss it from one end only; then a path is lost
without a word and reciprocity with it. Where a scene is small enough, sequences are enumerated
instead. A planar mirror turns the transmitter into an image, so whatever a prefix of planar faces
sends out seems to come from one point through one rectangle: the next face must have that point in
front of it and lie, at least in part, in that beam. With one curved face in the sequence, the planar
prefix and suffix give an image at either end, and the glints between the two images are looked up on
samples of the face: the same from both ends, whatever the spacing of any rays.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import World
from rfsg.tracer.bounds import Floor
from rfsg.tracer.faces import Planes, Samples, looks_at, planes_of, samples_of
from rfsg.tracer.glances import astray
from rfsg.tracer.glints import NEAR, glints
from rfsg.tracer.plan import Quality
from rfsg.tracer.prefixes import Budget, Prefixes, levels, mirror
from rfsg.tracer.reached import reached
from rfsg.tracer.records import Chains, Only

MOST_PAIRS = 300_000_000  # beam tests and image solves an enumeration may take: a minute or two
PORTION = 1 << 16  # pairs of images at a time
BLOCK = 1 << 20  # (node, prefix) tests at a time: bounds memory


@torch.no_grad()
def enumerate_chains(
    world: World,
    tx_position: Float[Tensor, "t 3"],
    rx_position: Float[Tensor, "r 3"],
    wavelength: float,
    quality: Quality,
    only: Only | None = None,
    floor: Floor | None = None,
) -> Chains:
    """All candidate chains with at most one curved or learned face, direct ones left out.

    wavelength: [m] what learned faces are measured at. only: which of them, if not all. floor: planar
    chains that are proven to lie below it are left out; it counts them. A curved face may focus, so
    no chain with one is. Raises TooMany when the scene is too large for it.
    """
    planes, samples = planes_of(world), samples_of(world)
    if not quality.curved:
        samples = []
    budget = Budget(MOST_PAIRS)
    parts, fore = [], []
    inner = min(quality.depth, quality.curved_depth) - 1 if samples else 0
    for t in range(len(tx_position)):
        ahead = levels(planes, tx_position[t], quality.depth, budget, floor, inner)
        for level in ahead[1:]:
            strong = level.above(floor)
            if floor is not None:
                floor.pruned += len(level.image) - len(strong.image)
            parts.append(_planar_chains(planes, strong, t, rx_position, quality, budget, only))
        fore.append(ahead[: inner + 1])
    if samples:
        behind = [levels(planes, source, inner, budget) for source in rx_position]
        ends = _by_level(fore), _by_level(behind)
        for item in samples:
            parts += _glint_chains(world, planes, item, ends, wavelength, quality, budget, only)
    return _join(parts, quality.depth, world.device)


def _planar_chains(
    planes: Planes,
    prefixes: Prefixes,
    t: int,
    rx_position: Tensor,
    quality: Quality,
    budget: Budget,
    only: Only | None,
) -> Chains:
    """Prefixes that mirror the transmitter onto a receiver, through the rectangles of all faces."""
    budget.spend(len(prefixes.image) * len(rx_position))
    wanted = [tuple(torch.arange(len(x), device=x.device) for x in (prefixes.image, rx_position))]
    if only is not None:
        wanted = Only.pairs(only.tx[t] | _marked(planes, prefixes.faces, only), only.rx)
    parts = []
    for some, receivers in wanted:
        mine = prefixes.take(some)
        row, rx = reached(planes, mine.image, mine.faces, rx_position[receivers])
        face = mine.faces[row]
        seed = torch.zeros(*face.shape, 3, dtype=torch.float64, device=face.device)
        parts.append(_chains(planes, t, receivers[rx], face, seed, quality.depth))
    return Chains.joined(parts)


def _marked(planes: Planes, faces: Int[Tensor, "p d"], only: Only) -> Bool[Tensor, "p"]:
    """Sequences that hold a face of a marked node."""
    return only.node[planes.node[faces]].any(1)


@dataclass(frozen=True)
class Ends:
    """The prefixes of one length of all radios at one end of the links, and whose each is."""

    prefixes: Prefixes
    owner: Int[Tensor, "p"]

    def take(self, i: Tensor) -> "Ends":
        return Ends(self.prefixes.take(i), self.owner[i])


def _by_level(radios: list[list[Prefixes]]) -> list[Ends]:
    """Prefixes of each length, of all radios together."""
    out = []
    for level in zip(*radios, strict=True):
        image = torch.cat([p.image for p in level])
        count = torch.tensor([len(p.image) for p in level], device=image.device)
        owner = torch.arange(len(level), device=image.device).repeat_interleave(count)
        out.append(Ends(Prefixes(image, torch.cat([p.faces for p in level])), owner))
    return out


def _reaching(
    world: World, planes: Planes, prefixes: Prefixes, item: Samples
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """(node, prefix) where the prefix's beam may touch the ball about the node, node by node."""
    nodes, p = item.nodes, len(prefixes.image)
    if not prefixes.faces.shape[1]:
        every = torch.arange(p, device=nodes.device)
        return nodes.repeat_interleave(p), every.repeat(len(nodes))
    centre = world.point_world(nodes, item.centre.expand(len(nodes), 3))
    radius = item.radius * world.scale[nodes]
    none = nodes[:0]
    found = [(none, none)]
    for some in torch.arange(len(nodes), device=nodes.device).split(max(1, BLOCK // max(p, 1))):
        meets = _meets(planes, prefixes, centre[some], radius[some])
        meets &= planes.node[prefixes.faces[:, -1]] != nodes[some, None]
        row, prefix = torch.nonzero(meets, as_tuple=True)
        found.append((nodes[some[row]], prefix))
    node, prefix = (torch.cat(c) for c in zip(*found, strict=True))
    return node, prefix


def _meets(
    planes: Planes, prefixes: Prefixes, centre: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]
) -> Bool[Tensor, "n p"]:
    """Balls that a prefix's beam may touch."""
    last = prefixes.faces[:, -1]
    normal, offset = planes.normal[last], planes.offset[last]
    near = (prefixes.image * normal).sum(-1) - offset
    height = centre @ normal.T - offset
    along = (height - near).clamp(min=1e-12)
    away = centre[:, None] - prefixes.image
    hit = prefixes.image + (-near / along)[..., None] * away
    uv = torch.einsum("npj,pij->npi", hit - planes.centre[last], planes.edges[last])
    # the ball's shadow on the face, cast from the image by the ball's nearest point
    close = (along - radius[:, None]).clamp(min=1e-12)
    shadow = radius[:, None] * (-near) / close * away.norm(dim=-1) / along
    within = (uv.abs() <= planes.half[last] + shadow[..., None]).all(-1)
    return (height > -radius[:, None]) & (within | (along <= radius[:, None]))


def _glint_chains(
    world: World,
    planes: Planes,
    item: Samples,
    links: tuple[list[Ends], list[Ends]],
    wavelength: float,
    quality: Quality,
    budget: Budget,
    only: Only | None,
) -> list[Chains]:
    """(planar..., an object of this shape, planar...) between all transmitters and receivers."""
    ahead, behind = (
        [_reaching(world, planes, ends.prefixes, item) for ends in side] for side in links
    )
    parts = []
    for i, before in enumerate(links[0]):
        for j, after in enumerate(links[1]):
            if i + j + 1 > min(quality.depth, quality.curved_depth):
                continue
            marked = None
            if only is not None:
                marked = (
                    only.node[ahead[i][0]] | _begins(planes, before, only, only.tx)[ahead[i][1]],
                    _begins(planes, after, only, only.rx)[behind[j][1]],
                )
            for node, a, b in _paired(len(world), ahead[i], behind[j], item, budget, marked):
                images = (
                    world.point_object(node, before.prefixes.image[a]),
                    world.point_object(node, after.prefixes.image[b]),
                )
                pair, sample = glints(item, *images)
                ends = images[0][pair], images[1][pair]
                look = wavelength, quality.newton, i + j == 0
                stays = _promising(world, node[pair], sample, ends, *look)
                pair, sample = pair[stays], sample[stays]
                ends = before.take(a[pair]), after.take(b[pair])
                parts.append(_glint_part(world, planes, item, node[pair], sample, ends, quality))
    return parts


def _begins(planes: Planes, ends: Ends, only: Only, radio: Bool[Tensor, "r"]) -> Bool[Tensor, "p"]:
    """Prefixes that meet something marked, their own radio included."""
    return radio[ends.owner] | _marked(planes, ends.prefixes.faces, only)


def _promising(
    world: World,
    node: Int[Tensor, "m"],
    sample: Int[Tensor, "m"],
    ends: tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]],
    wavelength: float,
    steps: int,
    lone: bool,
) -> Int[Tensor, "k"]:
    """Candidates on nodes of one shape that a first look at the face, if it is learned, leaves.

    ends: the images in the nodes' frames. steps, lone: see ``glances.astray``."""
    stays = torch.ones_like(node, dtype=torch.bool)
    for scale in torch.unique(world.scale[node[~world.exact[node]]]).tolist():
        i = torch.nonzero(world.scale[node] == scale).squeeze(-1)
        shape = world.scene.nodes[int(node[i[0]])].body.shape
        looks = looks_at(shape, world.device, wavelength / scale)
        stays[i] = ~astray(looks, sample[i], ends[0][i], ends[1][i], steps, lone)
    return torch.nonzero(stays).squeeze(-1)


def _paired(
    nodes: int,
    ahead: tuple[Tensor, Tensor],
    behind: tuple[Tensor, Tensor],
    item: Samples,
    budget: Budget,
    marked: tuple[Bool[Tensor, "a"], Bool[Tensor, "b"]] | None,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Every (node, prefix before it, prefix after it), in portions; both lists lie in order of nodes.

    marked: of either list; then those of which either is.
    """
    many = [torch.bincount(node, minlength=nodes) for node, _ in (ahead, behind)]
    # samples of clusters that stay are a few times more
    budget.spend(int((many[0] * many[1]).sum()) * len(item.clusters))
    blocks = [(ahead, behind)]
    if marked is not None:
        blocks = [
            ((ahead[0][i], ahead[1][i]), (behind[0][j], behind[1][j]))
            for i, j in Only.pairs(*marked)
        ]
    for fore, aft in blocks:
        yield from _portions(nodes, fore, aft)


def _portions(
    nodes: int, ahead: tuple[Tensor, Tensor], behind: tuple[Tensor, Tensor]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    many = [torch.bincount(node, minlength=nodes) for node, _ in (ahead, behind)]
    count = many[0] * many[1]
    last = torch.cumsum(count, 0)
    start = [torch.cumsum(m, 0) - m for m in many]
    total = int(last[-1]) if nodes else 0
    for begin in range(0, total, PORTION):
        number = torch.arange(begin, min(total, begin + PORTION), device=count.device)
        node = torch.searchsorted(last, number, right=True)
        within = number - (last - count)[node]
        a = ahead[1][start[0][node] + within // many[1][node]]
        b = behind[1][start[1][node] + within % many[1][node]]
        yield node, a, b


def _glint_part(
    world: World,
    planes: Planes,
    item: Samples,
    node: Int[Tensor, "c"],
    sample: Int[Tensor, "c"],
    ends: tuple[Ends, Ends],
    quality: Quality,
) -> Chains:
    """Chains of one length, seeded by the image method on either side of the sample."""
    before, after = ends[0].prefixes, ends[1].prefixes
    x = world.point_world(node, item.point[sample])
    # the glint may lie a few samples away, and its mirror images as far along their faces
    slack = 2.0 * NEAR * item.reach[sample] * world.scale[node]
    fore, on_fore = _unfold(planes, before, x, slack)
    aft, on_aft = _unfold(planes, after, x, slack)
    back = after.faces.flip(1)
    which = torch.cat([planes.node[before.faces], node[:, None], planes.node[back]], 1)
    patch = torch.cat(
        [planes.patch[before.faces], item.patch[sample][:, None], planes.patch[back]], 1
    )
    seed = torch.cat([fore, x[:, None], aft.flip(1)], 1)
    good = on_fore & on_aft & torch.isfinite(seed).all(-1).all(-1)
    chains = Chains(ends[0].owner, ends[1].owner, which, patch, seed)
    return _padded(chains.take(torch.nonzero(good).squeeze(-1)), quality.depth)


def _unfold(
    planes: Planes, prefixes: Prefixes, target: Tensor, slack: Float[Tensor, "c"]
) -> tuple[Float[Tensor, "c d 3"], Bool[Tensor, "c"]]:
    """Where the path from a source through its mirrors to a target meets them, and whether it meets
    each within its rectangle, give or take ``slack`` [m]."""
    image, points = prefixes.image, []
    on = torch.ones(len(image), dtype=torch.bool, device=image.device)
    for level in range(prefixes.faces.shape[1] - 1, -1, -1):
        face = prefixes.faces[:, level]
        near = (image * planes.normal[face]).sum(-1) - planes.offset[face]
        far = (target * planes.normal[face]).sum(-1) - planes.offset[face]
        slope = near - far
        share = near / torch.where(slope == 0, torch.ones_like(slope), slope)
        target = image + share[:, None] * (target - image)
        uv = torch.einsum("cj,cij->ci", target - planes.centre[face], planes.edges[face]).abs()
        on &= (near < 0) & (far > -slack) & (uv <= planes.half[face] + slack[:, None]).all(-1)
        points.insert(0, target)
        image = mirror(planes, image, face)
    if not points:
        return image.new_zeros(len(image), 0, 3), on
    return torch.stack(points, 1), on


def _chains(planes: Planes, t: int, rx: Tensor, face: Tensor, seed: Tensor, depth: int) -> Chains:
    tx = torch.full_like(rx, t)
    return _padded(Chains(tx, rx, planes.node[face], planes.patch[face], seed), depth)


def _padded(chains: Chains, depth: int) -> Chains:
    missing = depth - chains.which.shape[1]
    pad = torch.nn.functional.pad
    return Chains(
        chains.tx,
        chains.rx,
        pad(chains.which, (0, missing), value=-1),
        pad(chains.patch, (0, missing), value=-1),
        pad(chains.seed, (0, 0, 0, missing)),
    )


def _join(parts: list[Chains], depth: int, device: torch.device) -> Chains:
    if not parts:
        none = torch.zeros(0, dtype=torch.int64, device=device)
        empty = none.reshape(0, depth)
        seed = torch.zeros(0, depth, 3, dtype=torch.float64, device=device)
        return Chains(none, none, empty, empty, seed)
    return Chains.joined(parts)
