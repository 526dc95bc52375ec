"""The complete search: every sequence of planar faces, and one curved or learned face among them.

Rays may miss a beam thinner than their spacing, and miss it from one end only; then a path is lost
without a word and reciprocity with it. Where a scene is small enough, sequences are enumerated
instead. A planar mirror turns the transmitter into an image, so whatever a prefix of planar faces
sends out seems to come from one point through one rectangle: the next face must have that point in
front of it and lie, at least in part, in that beam. With one curved face in the sequence, the planar
prefix and suffix give an image at either end, and the glints between the two images are looked up on
samples of the face: the same from both ends, whatever the spacing of any rays.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import World, unit
from rfsg.tracer.faces import Planes, Samples, planes_of, samples_of
from rfsg.tracer.plan import Quality
from rfsg.tracer.reached import reached
from rfsg.tracer.records import Chains

MOST_PAIRS = 300_000_000  # beam tests and image solves an enumeration may take: a minute or two
NEAR = 3.0  # times the samples' spacing: how far a glint may lie from its nearest sample
EDGE = 1e-9  # of a face's extent: a path through a face's very edge belongs to it


class TooMany(Exception):
    """The scene has more sequences than an enumeration should take; search by rays instead."""


@dataclass(frozen=True)
class Prefixes:
    """Sequences of planar faces seen from one source: the image it makes and the faces, in order."""

    image: Float[Tensor, "p 3"]
    faces: Int[Tensor, "p d"]

    def take(self, i: Tensor) -> "Prefixes":
        return Prefixes(self.image[i], self.faces[i])


@torch.no_grad()
def enumerate_chains(
    world: World,
    tx_position: Float[Tensor, "t 3"],
    rx_position: Float[Tensor, "r 3"],
    quality: Quality,
) -> Chains:
    """All candidate chains with at most one curved or learned face, direct ones left out.

    Raises TooMany when the scene is too large for it.
    """
    planes, samples = planes_of(world), samples_of(world)
    if not quality.curved:
        samples = []
    budget = Budget(MOST_PAIRS)
    parts = []
    inner = min(quality.depth, quality.curved_depth) - 1 if samples else 0
    behind = [levels(planes, rx_position[r], inner, budget) for r in range(len(rx_position))]
    for t in range(len(tx_position)):
        ahead = levels(planes, tx_position[t], quality.depth, budget)
        for level in ahead[1:]:
            parts.append(_planar_chains(planes, level, t, rx_position, quality, budget))
        for item in samples:
            fore = [_reaching(planes, p, item) for p in ahead[: inner + 1]]
            for r in range(len(rx_position)):
                aft = [_reaching(planes, p, item) for p in behind[r]]
                parts.append(_glint_chains(planes, item, fore, aft, t, r, quality, budget))
    return _join(parts, quality.depth, world.device)


class Budget:
    """Counts work and raises TooMany when it runs out."""

    def __init__(self, most: int):
        self.left = most

    def spend(self, amount: int) -> None:
        self.left -= amount
        if self.left < 0:
            raise TooMany


def levels(planes: Planes, source: Tensor, depth: int, budget: Budget) -> list[Prefixes]:
    """Prefixes of 0, 1, ... depth faces from a source."""
    none = torch.zeros(1, 0, dtype=torch.int64, device=source.device)
    levels = [Prefixes(source[None], none)]
    for _ in range(depth):
        levels.append(_extend(planes, levels[-1], budget))
    return levels


def _extend(planes: Planes, prefixes: Prefixes, budget: Budget) -> Prefixes:
    p, k = len(prefixes.image), len(planes)
    budget.spend(p * k)
    image = [prefixes.image[:0]]
    face = [
        torch.zeros(0, prefixes.faces.shape[1] + 1, dtype=torch.int64, device=planes.node.device)
    ]
    block = max(1, 2_000_000 // max(k, 1))
    for begin in range(0, p, block):
        some = prefixes.take(torch.arange(begin, min(p, begin + block), device=planes.node.device))
        front = some.image @ planes.normal.T - planes.offset > 0
        if prefixes.faces.shape[1]:
            front &= _visible(planes, some)
        row, column = torch.nonzero(front, as_tuple=True)
        if prefixes.faces.shape[1]:
            kept = _in_beam(planes, some, row, column)
            row, column = row[kept], column[kept]
        image.append(_mirror(planes, some.image[row], column))
        face.append(torch.cat([some.faces[row], column[:, None]], 1))
    return Prefixes(torch.cat(image), torch.cat(face))


def _mirror(planes: Planes, point: Tensor, face: Tensor) -> Tensor:
    height = (point * planes.normal[face]).sum(-1) - planes.offset[face]
    return point - 2.0 * height[:, None] * planes.normal[face]


def _visible(planes: Planes, prefixes: Prefixes) -> Bool[Tensor, "p k"]:
    """Faces with some corner on the outgoing side of the prefix's last face, and not that face."""
    last, row = torch.unique(prefixes.faces[:, -1], return_inverse=True)
    # only of the last faces at hand: of all faces at once it would be a table of gigabytes
    height = planes.normal[last] @ planes.corners().reshape(-1, 3).T
    highest = height.reshape(len(last), len(planes), 4).amax(-1)
    beyond = highest - planes.offset[last, None] > 0
    beyond[torch.arange(len(last), device=last.device), last] = False
    return beyond[row]


def _in_beam(planes: Planes, prefixes: Prefixes, row: Tensor, face: Tensor) -> Bool[Tensor, "m"]:
    """Does the shadow of a face, cast from the image onto the last face, meet that face's rectangle?

    Corners behind the last face are pulled to just in front of it: the shadow then only grows.
    """
    last = prefixes.faces[row, -1]
    image, corner = prefixes.image[row], planes.corners()[face]
    normal, offset = planes.normal[last], planes.offset[last]
    near = (image * normal).sum(-1) - offset  # negative: images lie behind their mirror
    height = (corner * normal[:, None]).sum(-1) - offset[:, None]
    behind = height <= 0
    t = -near[:, None] / (height - near[:, None]).clamp(min=1e-12)
    shadow = image[:, None] + t[..., None] * (corner - image[:, None])
    local = shadow - planes.centre[last][:, None]
    uv = torch.einsum("mcj,mij->mci", local, planes.edges[last])
    half = planes.half[last] * (1 + EDGE)
    apart = (uv.amin(1) > half) | (uv.amax(1) < -half)
    return behind.any(1) | ~apart.any(1)


def _planar_chains(
    planes: Planes,
    prefixes: Prefixes,
    t: int,
    rx_position: Tensor,
    quality: Quality,
    budget: Budget,
) -> Chains:
    """Prefixes that mirror the transmitter onto a receiver, through the rectangles of all faces."""
    budget.spend(len(prefixes.image) * len(rx_position))
    row, rx = reached(planes, prefixes.image, prefixes.faces, rx_position)
    face = prefixes.faces[row]
    seed = torch.zeros(*face.shape, 3, dtype=torch.float64, device=face.device)
    return _chains(planes, t, rx, face, seed, quality.depth)


def _reaching(planes: Planes, prefixes: Prefixes, item: Samples) -> Prefixes:
    """Prefixes whose beam may touch the ball about an object."""
    if not prefixes.faces.shape[1]:
        return prefixes
    last = prefixes.faces[:, -1]
    normal, offset = planes.normal[last], planes.offset[last]
    near = (prefixes.image * normal).sum(-1) - offset
    height = item.centre @ normal.T - offset
    along = (height - near).clamp(min=1e-12)
    hit = prefixes.image + (-near / along)[:, None] * (item.centre - prefixes.image)
    uv = torch.einsum("pj,pij->pi", hit - planes.centre[last], planes.edges[last])
    # the ball's shadow on the face, cast from the image by the ball's nearest point
    close = (along - item.radius).clamp(min=1e-12)
    slant = (item.centre - prefixes.image).norm(dim=-1) / along
    shadow = item.radius * (-near) / close * slant
    meets = (uv.abs() <= planes.half[last] + shadow[:, None]).all(-1) | (along <= item.radius)
    keep = (height > -item.radius) & meets & (planes.node[last] != item.node)
    return prefixes.take(torch.nonzero(keep).squeeze(-1))


def _glint_chains(
    planes: Planes,
    item: Samples,
    fore: list[Prefixes],
    aft: list[Prefixes],
    t: int,
    r: int,
    quality: Quality,
    budget: Budget,
) -> Chains | None:
    """(planar..., this object, planar...) between one transmitter and one receiver."""
    parts = []
    for i, before in enumerate(fore):
        for j, after in enumerate(aft):
            if (
                i + j + 1 > min(quality.depth, quality.curved_depth)
                or not len(before.image)
                or not len(after.image)
            ):
                continue
            pair, sample = _glints(item, before.image, after.image, quality, budget)
            if not len(pair):
                continue
            n = len(after.image)
            parts.append(
                _glint_part(
                    planes,
                    item,
                    before.take(pair // n),
                    after.take(pair % n),
                    sample,
                    t,
                    r,
                    quality,
                )
            )
    return _join(parts, quality.depth, item.point.device) if parts else None


def _glints(
    item: Samples, fore: Tensor, aft: Tensor, quality: Quality, budget: Budget
) -> tuple[Tensor, Tensor]:
    """(pair of images, sample) where the path's length slopes least along the face, in each patch."""
    pairs, s = len(fore) * len(aft), len(item.point)
    budget.spend(pairs * s // 8)  # a glance at a sample is cheaper than a beam test
    none = torch.zeros(0, dtype=torch.int64, device=fore.device)
    found = [(none, none)]
    block = max(1, 2_000_000 // s)
    to_fore, to_aft = fore[:, None] - item.point[None], aft[:, None] - item.point[None]
    towards_fore, towards_aft = unit(to_fore), unit(to_aft)
    near_fore = 1.0 / to_fore.norm(dim=-1).clamp(min=1e-9)
    near_aft = 1.0 / to_aft.norm(dim=-1).clamp(min=1e-9)
    for begin in range(0, pairs, block):
        pair = torch.arange(begin, min(pairs, begin + block), device=fore.device)
        a, b = towards_fore[pair // len(aft)], towards_aft[pair % len(aft)]
        lit = ((a * item.normal).sum(-1) > 0) & ((b * item.normal).sum(-1) > 0)
        # the slope of the path's length along the face: zero where it reflects, small when it grazes
        both = a + b
        height = (both * item.normal).sum(-1)
        slope = torch.sqrt(torch.clamp((both * both).sum(-1) - height**2, min=0.0))
        # slope / bend of the length is how far away, at least, the glint is
        bend = near_fore[pair // len(aft)] + near_aft[pair % len(aft)] + 2.0 * item.curvature
        score = torch.where(lit, -slope / (bend * item.reach), torch.full_like(slope, -torch.inf))
        found.append(_best_of_patch(item, pair, score))
    pair, sample = (torch.cat(c) for c in zip(*found, strict=True))
    return pair, sample


def _best_of_patch(item: Samples, pair: Tensor, score: Tensor) -> tuple[Tensor, Tensor]:
    """In each patch the best sample, if it is good, and better than all samples near it elsewhere."""
    patches, column = torch.unique(item.patch, return_inverse=True)
    best = torch.full((len(pair), len(patches)), -torch.inf, dtype=score.dtype, device=score.device)
    best = best.scatter_reduce(1, column.expand(len(pair), -1), score, "amax")
    row, sample = torch.nonzero((score > -NEAR) & (score == best[:, column]), as_tuple=True)
    keep = ~_outdone(item, row, sample, score)
    return pair[row[keep]], sample[keep]


def _outdone(item: Samples, row: Tensor, sample: Tensor, score: Tensor) -> Bool[Tensor, "m"]:
    """A candidate with a better one of the same pair beside it (a flat face spans several patches)."""
    near = 0.12 * item.radius
    out = torch.zeros(len(row), dtype=torch.bool, device=row.device)
    order = torch.argsort(row, stable=True)
    r, s = row[order], sample[order]
    value = score[r, s]
    most = int(torch.bincount(r).max()) if len(r) else 0
    lost = torch.zeros_like(out)
    for shift in range(1, most):
        same = r[shift:] == r[:-shift]
        close = (item.point[s[shift:]] - item.point[s[:-shift]]).norm(dim=-1) < near
        alike = (item.normal[s[shift:]] * item.normal[s[:-shift]]).sum(-1) > 0.9
        rival = same & close & alike
        lost[shift:] |= rival & (value[shift:] <= value[:-shift])
        lost[:-shift] |= rival & (value[:-shift] < value[shift:])
    out[order] = lost
    return out


def _glint_part(
    planes: Planes,
    item: Samples,
    before: Prefixes,
    after: Prefixes,
    sample: Tensor,
    t: int,
    r: int,
    quality: Quality,
) -> Chains:
    """Chains of one length, seeded by the image method on either side of the sample."""
    x = item.point[sample]
    # the glint may lie a few samples away, and its mirror images as far along their faces
    slack = 2.0 * NEAR * item.reach[sample]
    fore, on_fore = _unfold(planes, before, x, slack)
    aft, on_aft = _unfold(planes, after, x, slack)
    aft = aft.flip(1)
    c = len(sample)
    node = torch.full((c, 1), item.node, dtype=torch.int64, device=x.device)
    back = after.faces.flip(1)
    which = torch.cat([planes.node[before.faces], node, planes.node[back]], 1)
    patch = torch.cat(
        [planes.patch[before.faces], item.patch[sample][:, None], planes.patch[back]], 1
    )
    seed = torch.cat([fore, x[:, None], aft], 1)
    good = on_fore & on_aft & torch.isfinite(seed).all(-1).all(-1)
    ends = torch.full((c,), t, device=x.device), torch.full((c,), r, device=x.device)
    chains = Chains(ends[0], ends[1], which, patch, seed)
    return _padded(_take(chains, torch.nonzero(good).squeeze(-1)), quality.depth)


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
        image = _mirror(planes, image, face)
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


def _take(chains: Chains, i: Tensor) -> Chains:
    return Chains(*(getattr(chains, n)[i] for n in Chains.__dataclass_fields__))


def _join(parts: list[Chains | None], depth: int, device: torch.device) -> Chains:
    some = [p for p in parts if p is not None]
    if not some:
        none = torch.zeros(0, dtype=torch.int64, device=device)
        empty = none.reshape(0, depth)
        seed = torch.zeros(0, depth, 3, dtype=torch.float64, device=device)
        return Chains(none, none, empty, empty, seed)
    return Chains(*(torch.cat([getattr(p, n) for p in some]) for n in Chains.__dataclass_fields__))
