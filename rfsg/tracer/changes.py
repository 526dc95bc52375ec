"""What differs between the scene of one simulation and the next.

Things are told apart by value, as they were when the first simulation ran: poses, velocities and
positions were copied, and of what learns the parameters' versions were noted, so that a scene changed in
place, or by an optimiser's step, is seen to have changed. Objects and radios are known by their paths.
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from rfsg.objects.contract import Shape, Surface
from rfsg.objects.shapes.analytic import Analytic
from rfsg.objects.surfaces.interface import Known
from rfsg.scene.radios import Radio
from rfsg.scene.world import World
from rfsg.tracer.plan import Quality


class Seen:
    """A scene as a simulation saw it, and what was asked of it."""

    def __init__(
        self,
        world: World,
        tx_position: Float[Tensor, "t 3"],
        rx_position: Float[Tensor, "r 3"],
        frequency: Float[Tensor, "f"],
        quality: Quality,
    ):
        scene = world.scene
        self.world, self.quality = world, quality
        self.frequency = frequency.detach().clone()
        self.names = [n.path for n in scene.nodes]
        bodies = {id(n.body): n.body for n in scene.nodes}
        shapes = {key: _content(body.shape) for key, body in bodies.items()}
        surfaces = {key: _content(body.surface) for key, body in bodies.items()}
        self.shapes = [shapes[id(n.body)] for n in scene.nodes]
        self.surfaces = [surfaces[id(n.body)] for n in scene.nodes]
        # a stack is a copy
        self.place = torch.cat([world.rotation.flatten(1), world.translation], 1).detach()
        self.place = torch.cat([self.place, world.scale.detach()[:, None]], 1)
        self.velocity = world.velocity.detach()
        self.tx = Radios(scene.transmitters, tx_position)
        self.rx = Radios(scene.receivers, rx_position)

    @property
    def polarised(self) -> bool:
        """Whether field vectors travel the paths."""
        radios = (*self.tx.radios, *self.rx.radios)
        return any(radio.polarization != "none" for radio in radios)


class Radios:
    """The radios of one side: where they stand, and what else says what they send and hear."""

    def __init__(self, radios: Sequence[Radio], position: Float[Tensor, "n 3"]):
        self.radios = tuple(radios)
        self.names = [r.path for r in radios]
        self.position = position.detach().clone()
        turned = [torch.cat([r.rotation.flatten(), r.velocity]) for r in radios]
        flat = self.position.new_zeros(0, 12)
        self.turned = torch.stack(turned).detach().to(flat) if turned else flat

    def alike(self, i: int, other: "Radios", j: int) -> bool:
        """Whether radio i has the antennas that radio j of another list has."""
        a, b = self.radios[i], other.radios[j]
        named = isinstance(a.pattern, str) and a.pattern == b.pattern
        same = a.polarization == b.polarization and a.array is b.array
        return same and (named or a.pattern is b.pattern)


@dataclass(frozen=True)
class Changes:
    """What became of the things of a scene.

    node, tx, rx: for each of the old scene its number in the new one, -1 if there is none of the same
    shape at the same place. asked: the new nodes that stand as they did but answer otherwise (another
    material, another velocity), or whose neighbours may have a say in what they answer. tx_asked,
    rx_asked: radios at their old place with other antennas. came: new nodes that were not there.
    solids: whether anything that bends waves is among what changed.
    """

    node: Int[Tensor, "o"]
    tx: Int[Tensor, "ot"]
    rx: Int[Tensor, "or"]
    came: Bool[Tensor, "n"]
    tx_came: Bool[Tensor, "t"]
    rx_came: Bool[Tensor, "r"]
    asked: Bool[Tensor, "n"]
    tx_asked: Bool[Tensor, "t"]
    rx_asked: Bool[Tensor, "r"]
    solids: bool

    @property
    def gone(self) -> Bool[Tensor, "o"]:
        """Old nodes that are no more where they were."""
        return self.node < 0

    @property
    def radios(self) -> bool:
        """Whether any radio came, went or moved."""
        moved = bool((self.tx < 0).any() | (self.rx < 0).any())
        return moved or bool(self.tx_came.any() | self.rx_came.any())

    @property
    def geometry(self) -> bool:
        """Whether there are paths to look for."""
        return bool(self.came.any() | self.tx_came.any() | self.rx_came.any())


def question_changed(before: Seen, now: Seen) -> str | None:
    """Why nothing of the earlier simulation is of use, or None."""
    if before.world.device != now.world.device:
        return f"it ran on {before.world.device}, and this one on {now.world.device}"
    if not torch.equal(before.frequency, now.frequency):
        return "it was at other frequencies"
    if before.quality != now.quality:
        return "it was of another quality"
    for seen in (before, now):
        for names in (seen.names, seen.tx.names, seen.rx.names):
            twice = [name for name, count in Counter(names).items() if count > 1]
            if twice:
                return f"the path {twice[0]} names two things"
    return None


def changes(before: Seen, now: Seen) -> Changes:
    """What became of the things that were seen before."""
    device = now.world.device
    node = torch.full((len(before.names),), -1, dtype=torch.int64, device=device)
    asked = torch.zeros(len(now.names), dtype=torch.bool, device=device)
    number, solids = {name: i for i, name in enumerate(now.names)}, False
    for i, name in enumerate(before.names):
        j = number.get(name, -1)
        stands = j >= 0 and before.shapes[i] == now.shapes[j]
        stands = stands and torch.equal(before.place[i], now.place[j])
        answers = stands and before.surfaces[i] == now.surfaces[j]
        if stands:
            node[i] = j
            asked[j] = not (answers and torch.equal(before.velocity[i], now.velocity[j]))
        if not answers:
            solids |= bool(before.world.solid[i]) or (stands and bool(now.world.solid[j]))
    came = torch.ones_like(asked)
    came[node[node >= 0]] = False
    solids |= bool(now.world.solid[came].any())
    if solids:  # flush ones of one medium are one body
        asked |= now.world.solid & ~came
    sides = [_radios(a, b) for a, b in ((before.tx, now.tx), (before.rx, now.rx))]
    (tx, tx_came, tx_asked), (rx, rx_came, rx_asked) = sides
    if before.polarised != now.polarised:
        tx_asked = ~tx_came
    return Changes(node, tx, rx, came, tx_came, rx_came, asked, tx_asked, rx_asked, solids)


def _radios(before: Radios, now: Radios) -> tuple[Tensor, Tensor, Tensor]:
    """(number in the new list, new ones that came, new ones to be asked again)."""
    device = now.position.device
    number = {name: j for j, name in enumerate(now.names)}
    found = torch.tensor(
        [number.get(name, -1) for name in before.names], dtype=torch.int64, device=device
    )
    i = torch.nonzero(found >= 0).squeeze(-1)
    moved = (before.position[i] != now.position[found[i]]).any(1)
    turned = i[(before.turned[i] != now.turned[found[i]]).any(1) & ~moved]
    found[i[moved]] = -1
    came = torch.ones(len(now.names), dtype=torch.bool, device=device)
    came[found[found >= 0]] = False
    pairs = [(i, j) for i, j in enumerate(found.tolist()) if j >= 0]
    unlike = [j for i, j in pairs if not before.alike(i, now, j)]
    asked = torch.zeros_like(came)
    asked[unlike] = True
    asked[found[turned]] = True
    return found, came, asked


def _content(thing: Shape | Surface) -> object:
    """What a shape or a surface is: by value where it is known, else itself and the versions of its
    tensors. What was written through ``tensor.data`` has no version, and is not seen."""
    config = thing.config
    if isinstance(thing, (Analytic, Known)):
        return (type(thing), json.dumps(config(), sort_keys=True))
    tensors = [*thing.parameters(), *thing.buffers()] if isinstance(thing, nn.Module) else []
    return (thing, tuple((t.data_ptr(), t._version) for t in tensors))
