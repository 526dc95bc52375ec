"""Sequences of planar mirrors that meet something new, found without following all the others to their end.

Nearly all sequences are of the greatest length d, and nearly all of the work goes into them. One that
meets a new face has it last, after d - 1 old ones, or earlier. So the beginnings of d - 1 faces are
looked at as ever, but an old one is lengthened by new faces only. One that ends at a new receiver and
meets no new face is found from its end: its beginning must lead to the receiver's image in the last
face, which says so of all faces and a few receivers without a beam being looked at. Where all receivers
are few, so the whole is found.

``sequences.enumerate_chains`` with the same ``Only`` is the plain twin.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.scene.world import World
from rfsg.tracer.bounds import Floor
from rfsg.tracer.faces import Planes, planes_of
from rfsg.tracer.launch import turned
from rfsg.tracer.plan import Quality
from rfsg.tracer.prefixes import Budget, Prefixes, TooMany, in_beam, levels, mirror
from rfsg.tracer.reached import reached
from rfsg.tracer.records import Chains, Only
from rfsg.tracer.sequences import MOST_PAIRS

BLOCK = 1 << 21  # (beginning, face) tests at a time: bounds memory
FEW = 4  # receivers that came and are looked at from their end


@torch.no_grad()
def new_chains(
    world: World,
    tx_position: Float[Tensor, "t 3"],
    rx_position: Float[Tensor, "r 3"],
    frequency: Float[Tensor, "f"],
    quality: Quality,
    only: Only,
) -> Chains | None:
    """The chains of ``launch.search`` that are asked for, direct ones included; None where that must
    be asked itself: no faces or some that are not planar, a power floor that drops sequences, sources or many
    receivers among what is new, a depth of less than 2, or so many sequences that it may give up."""
    planar = all(n.body.shape.faceted for n in world.scene.nodes)
    if not len(world) or quality.depth < 2 or quality.search == "rays" or not planar:
        return None
    planes = planes_of(world)
    if Floor.of(world, planes, frequency, quality) is not None:
        return None
    back = len(rx_position) < len(tx_position)  # as the whole search begins
    ends = (rx_position, tx_position) if back else (tx_position, rx_position)
    mine = replace(only, tx=only.rx, rx=only.tx) if back else only
    if bool(mine.tx.any()) or int(mine.rx.sum()) > FEW:
        return None
    budget = Budget(MOST_PAIRS)
    parts = [_direct(ends, mine, quality.depth)]
    try:
        for t in range(len(ends[0])):
            parts += _from(planes, ends[0][t], t, ends[1], quality.depth, mine, budget)
    except TooMany:
        return None
    chains = Chains.joined(parts)
    return turned(chains) if back else chains


def _from(
    planes: Planes, source: Tensor, t: int, target: Tensor, depth: int, only: Only, budget: Budget
) -> list[Chains]:
    """What is asked for from one source; spends no less than the whole enumeration would."""
    begun = levels(planes, source, depth - 1, budget)
    for level in begun[1:]:
        budget.spend(len(level.image) * len(target))
    _spend_last(planes, begun[-1], len(target), budget)
    every = torch.arange(len(target), device=target.device)
    came = torch.nonzero(only.rx).squeeze(-1)
    new = only.node[planes.node]
    parts = []
    for level in begun[1:]:
        meets = new[level.faces].any(1)
        parts.append(_between(planes, level.take(meets), t, every, target, depth))
        parts.append(_between(planes, level.take(~meets), t, came, target, depth))
    meets = new[begun[-1].faces].any(1)
    old = begun[-1].take(~meets)
    faces = torch.arange(len(planes), device=new.device)
    for some, last in ((begun[-1].take(meets), faces), (old, faces[new])):
        longer = _lengthened(planes, some, last)
        parts.append(_between(planes, longer, t, every, target, depth))
    for r in came[:, None]:
        longer = _towards(planes, old, faces[~new], target[r])
        parts.append(_between(planes, longer, t, r, target, depth))
    return parts


def _spend_last(planes: Planes, begun: Prefixes, targets: int, budget: Budget) -> None:
    """What the longest sequences may cost: counted as beginnings times faces or, where that is too
    many, times the faces that lie before each."""
    most = len(begun.image) * len(planes)
    budget.spend(most)
    if most * targets > budget.left:
        step = max(1, BLOCK // max(1, len(planes)))
        most = sum(int(_before(planes, some).sum()) for some in begun.image.split(step))
    budget.spend(most * targets)


def _before(planes: Planes, image: Float[Tensor, "p 3"]) -> Bool[Tensor, "p k"]:
    """Faces that have a point in front of them."""
    return image @ planes.normal.T - planes.offset > 0


def _lengthened(planes: Planes, begun: Prefixes, faces: Int[Tensor, "m"]) -> Prefixes:
    """Beginnings with one more of some faces each, where it may lie in their beam."""
    normal, offset = planes.normal[faces], planes.offset[faces]
    parts = [(begun.image[:0], begun.faces.new_zeros(0, begun.faces.shape[1] + 1))]
    step = max(1, BLOCK // max(1, len(faces)))
    for i in torch.arange(len(begun.image), device=faces.device).split(step):
        some = begun.take(i)
        row, column = torch.nonzero(some.image @ normal.T - offset > 0, as_tuple=True)
        lit = in_beam(planes, some, row, faces[column])
        parts.append(_longer(planes, some, row[lit], faces[column[lit]]))
    image, sequence = (torch.cat(x) for x in zip(*parts, strict=True))
    return Prefixes(image, sequence)


def _towards(
    planes: Planes, begun: Prefixes, faces: Int[Tensor, "m"], target: Float[Tensor, "1 3"]
) -> Prefixes:
    """Beginnings with one more of some faces each, where they lead to a point's image in it."""
    faces = faces[_before(planes, target)[0, faces]]
    row, column = reached(
        planes, begun.image, begun.faces, mirror(planes, target.expand(len(faces), 3), faces)
    )
    face = faces[column]
    height = (begun.image[row] * planes.normal[face]).sum(-1) - planes.offset[face]
    lit = height > 0
    image, sequence = _longer(planes, begun, row[lit], face[lit])
    return Prefixes(image, sequence)


def _longer(planes: Planes, begun: Prefixes, row: Tensor, face: Tensor) -> tuple[Tensor, Tensor]:
    """Images and faces of beginnings with one more face each."""
    image = mirror(planes, begun.image[row], face)
    return image, torch.cat([begun.faces[row], face[:, None]], 1)


def _between(
    planes: Planes,
    some: Prefixes,
    t: int,
    receivers: Int[Tensor, "m"],
    target: Float[Tensor, "r 3"],
    depth: int,
) -> Chains:
    """Chains of sequences that lead from a source to some of the receivers."""
    row, column = reached(planes, some.image, some.faces, target[receivers])
    face = some.faces[row]
    missing = depth - face.shape[1]
    which, patch = (
        torch.nn.functional.pad(x[face], (0, missing), value=-1)
        for x in (planes.node, planes.patch)
    )
    seed = target.new_zeros(len(row), depth, 3)
    return Chains(torch.full_like(row, t), receivers[column], which, patch, seed)


def _direct(ends: tuple[Tensor, Tensor], only: Only, depth: int) -> Chains:
    """From every source to every receiver that came."""
    came = torch.nonzero(only.rx).squeeze(-1)
    t = torch.arange(len(ends[0]), device=came.device).repeat_interleave(len(came))
    none = came.new_full((len(t), depth), -1)
    seed = ends[0].new_zeros(len(t), depth, 3)
    return Chains(t, came.repeat(len(ends[0])), none, none, seed)
