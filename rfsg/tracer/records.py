"""What travels between the stages of the tracer: frozen struct-of-arrays records.

Index -1 pads short chains. Positions, lengths and delays are float64, in the world frame, SI units.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.displayed import Displayed


class Act(IntEnum):
    """What a path does at a vertex."""

    REFLECT = 0
    DIFFRACT = 1
    SCATTER = 2
    ENTER = 3  # refracted into a solid
    LEAVE = 4  # refracted out of it

    @property
    def word(self) -> str:
        """For tables: ``reflection(PRIM)`` and so on."""
        return _WORDS[self]


_WORDS = {
    Act.REFLECT: "reflection",
    Act.DIFFRACT: "diffraction",
    Act.SCATTER: "scattering",
    Act.ENTER: "refraction_in",
    Act.LEAVE: "refraction_out",
}


class Status(IntEnum):
    """How the evaluation of one candidate chain ended. Only OK and CAUSTIC_CAPPED reach the channel."""

    OK = 0
    CAUSTIC_CAPPED = 1
    NOT_CONVERGED = 2
    OFF_SURFACE = 3
    WRONG_SIDE = 4
    DUPLICATE = 5
    BELOW_FLOOR = 6
    UNRESOLVED = 7
    OPAQUE = 8
    DEGENERATE = 9
    REFRACTED = 10

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Status.OK: "an exact path was found",
    Status.CAUSTIC_CAPPED: "the receiver lies near a focus; spreading was capped at the wavelength scale",
    Status.NOT_CONVERGED: "Newton did not settle on a stationary path within its iterations",
    Status.OFF_SURFACE: "the stationary point lies outside the object's surface (its edge was passed)",
    Status.WRONG_SIDE: "a vertex would be met from behind: no reflection there",
    Status.DUPLICATE: "the same path was already found, from another beginning or on a face that coincides",
    Status.BELOW_FLOOR: "the path is weaker than the power floor of this quality",
    Status.UNRESOLVED: "the reflecting piece is too small or too rough at the wave's scale to act as a mirror",
    Status.OPAQUE: "an opaque object stands on the path",
    Status.DEGENERATE: "transmitter, receiver or vertices coincide: no direction is defined",
    Status.REFRACTED: "a solid bends the wave off this straight line, or reflects it totally",
}


@dataclass(frozen=True)
class Rays:
    origin: Float[Tensor, "r 3"]
    direction: Float[Tensor, "r 3"]
    limit: Float[Tensor, "r"]  # [m], inf for none

    def take(self, i: Int[Tensor, "m"] | Bool[Tensor, "r"] | slice) -> "Rays":
        """Some of the rays."""
        return Rays(self.origin[i], self.direction[i], self.limit[i])


@dataclass(frozen=True)
class Spans:
    """Candidate stretches of rays in objects' proxies: flat, sorted by ray, then by enter."""

    ray: Int[Tensor, "m"]
    which: Int[Tensor, "m"]
    enter: Float[Tensor, "m"]
    leave: Float[Tensor, "m"]


@dataclass(frozen=True)
class Crossings:
    """True stretches of rays inside objects: flat, sorted by ray, then by enter.

    Normals are outward, in the world; zero where the ray begins or ends inside the object.
    """

    ray: Int[Tensor, "m"]
    which: Int[Tensor, "m"]
    enter: Float[Tensor, "m"]
    leave: Float[Tensor, "m"]
    normal_enter: Float[Tensor, "m 3"]
    normal_leave: Float[Tensor, "m 3"]


@dataclass(frozen=True)
class Chains:
    """Candidate paths: who reflects, in order, and where to begin solving. -1 pads short chains."""

    tx: Int[Tensor, "c"]
    rx: Int[Tensor, "c"]
    which: Int[Tensor, "c d"]
    patch: Int[Tensor, "c d"]
    seed: Float[Tensor, "c d 3"]

    def take(self, i: Int[Tensor, "m"] | Bool[Tensor, "c"]) -> "Chains":
        """Some of the chains."""
        return Chains(*(getattr(self, n)[i] for n in self.__dataclass_fields__))

    @staticmethod
    def joined(parts: Sequence["Chains"]) -> "Chains":
        """All chains of some records of one depth, in order."""
        names = Chains.__dataclass_fields__
        return Chains(*(torch.cat([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True)
class Only:
    """Which candidates are asked for: those that visit a marked node or edge, or that begin or end at
    a marked radio. ``edge`` numbers rows of ``Edges``.

    A stage that takes one gives what it would give without it, less the candidates that meet nothing
    marked. What it may cost is counted for all of them, so that it gives up where the whole would.
    """

    node: Bool[Tensor, "n"]
    tx: Bool[Tensor, "t"]
    rx: Bool[Tensor, "r"]
    edge: Bool[Tensor, "e"]

    @staticmethod
    def pairs(
        row: Bool[Tensor, "n"], column: Bool[Tensor, "m"]
    ) -> list[tuple[Int[Tensor, "a"], Int[Tensor, "b"]]]:
        """The pairs of which either is marked, as two blocks: (rows, columns) of each."""
        every = torch.arange(len(column), device=column.device)
        marked, rest = torch.nonzero(row).squeeze(-1), torch.nonzero(~row).squeeze(-1)
        return [(marked, every), (rest, torch.nonzero(column).squeeze(-1))]


@dataclass(frozen=True)
class Paths(Displayed):
    """Exact paths. vertices holds transmitter, interactions, receiver; after the last true point the
    receiver is repeated, so every consecutive pair is a segment (of length zero in the padding).

    act: what happens at each vertex (``Act``; 0 in the padding). item: the patch of its object's
    surface, or the edge (its row in ``Edges``), where that says something; -1 elsewhere.
    caustics: how many the wave has passed through, each of which advances its phase by pi/2.
    """

    tx: Int[Tensor, "p"]
    rx: Int[Tensor, "p"]
    which: Int[Tensor, "p d"]
    act: Int[Tensor, "p d"]
    item: Int[Tensor, "p d"]
    vertices: Float[Tensor, "p v 3"]
    normal: Float[Tensor, "p d 3"]
    length: Float[Tensor, "p"]  # [m]
    spread: Float[Tensor, "p"]  # [1/m], 1/length in free space
    caustics: Int[Tensor, "p"]
    status: Int[Tensor, "p"]

    def __repr__(self) -> str:
        return f"{len(self.tx)} paths of at most {self.which.shape[1]} interactions"

    def take(self, i: Int[Tensor, "m"] | Bool[Tensor, "p"] | slice) -> "Paths":
        """Some of the paths."""
        return Paths(*(getattr(self, n)[i] for n in self.__dataclass_fields__))

    def padded(self, depth: int) -> "Paths":
        """The same paths with room for ``depth`` interactions."""
        more = depth - self.which.shape[1]
        if more <= 0:
            return self
        none = self.which.new_full((len(self.tx), more), -1)
        zero = self.normal.new_zeros(len(self.tx), more, 3)
        return replace(
            self,
            which=torch.cat([self.which, none], 1),
            act=torch.cat([self.act, torch.zeros_like(none)], 1),
            item=torch.cat([self.item, none], 1),
            vertices=torch.cat([self.vertices, self.vertices[:, -1:].expand(-1, more, 3)], 1),
            normal=torch.cat([self.normal, zero], 1),
        )

    @staticmethod
    def joined(parts: "Sequence[Paths]") -> "Paths":
        """All paths of several records, padded to the longest."""
        depth = max(p.which.shape[1] for p in parts)
        parts = [p.padded(depth) for p in parts if len(p.tx)] or [parts[0].padded(depth)]
        if len(parts) == 1:
            return parts[0]
        return Paths(
            *(torch.cat([getattr(p, n) for p in parts]) for n in Paths.__dataclass_fields__)
        )


def runs_in(which: Int[Tensor, "p d"], act: Int[Tensor, "p d"]) -> Int[Tensor, "p s"]:
    """The solid that each segment runs in, refracted; -1 in free space and along straight paths.

    From an ENTER to the next LEAVE; before a first LEAVE, and after a last ENTER, a radio is inside.
    """
    depth, none = which.shape[1], which.new_full((len(which),), -1)

    def past(level: int, enter: Act, leave: Act, inside: Tensor) -> Tensor:
        met = which[:, level] >= 0
        inside = torch.where(met & (act[:, level] == leave), -1, inside)
        return torch.where(met & (act[:, level] == enter), which[:, level], inside)

    after, before = [none], [none]
    for k in range(depth):
        after.append(past(k, Act.ENTER, Act.LEAVE, after[-1]))
        before.append(past(depth - 1 - k, Act.LEAVE, Act.ENTER, before[-1]))
    return torch.maximum(torch.stack(after, 1), torch.stack(before[::-1], 1))


@dataclass(frozen=True)
class Failed:
    """Candidates that came to nothing: whose they are, what they visit and how they ended, in 32 bits.

    edge: the edge at each vertex (its row in ``Edges``), -1 where there is none.
    """

    tx: Int[Tensor, "c"]
    rx: Int[Tensor, "c"]
    which: Int[Tensor, "c d"]
    edge: Int[Tensor, "c d"]
    status: Int[Tensor, "c"]

    @staticmethod
    def of(paths: Paths) -> "Failed":
        """Those of the paths that are none."""
        some = paths.take(torch.nonzero(paths.status > int(Status.CAUSTIC_CAPPED)).squeeze(-1))
        edge = torch.where(some.act == int(Act.DIFFRACT), some.item, -1)
        columns = (some.tx, some.rx, some.which, edge, some.status)
        return Failed(*(x.to(torch.int32) for x in columns))

    def take(self, i: Int[Tensor, "m"] | Bool[Tensor, "c"]) -> "Failed":
        """Some of them."""
        return Failed(*(getattr(self, n)[i] for n in self.__dataclass_fields__))

    @staticmethod
    def joined(parts: "Sequence[Failed]") -> "Failed":
        """All of several records, padded to the longest."""
        depth = max(p.which.shape[1] for p in parts)
        pad = torch.nn.functional.pad
        wide = [
            replace(p, **{n: pad(x, (0, depth - x.shape[1]), value=-1) for n, x in p._wide()})
            for p in parts
        ]
        names = Failed.__dataclass_fields__
        return Failed(*(torch.cat([getattr(p, n) for p in wide]) for n in names))

    def _wide(self) -> list[tuple[str, Tensor]]:
        return [("which", self.which), ("edge", self.edge)]

    def counts(self) -> dict[Status, int]:
        """How many ended in each status."""
        numbers = torch.bincount(self.status, minlength=len(Status)).tolist()
        return {s: numbers[s] for s in Status if numbers[s]}


@dataclass(frozen=True)
class Found:
    """What one mechanism adds to a simulation: paths, how many candidates ended in each status, and
    sentences on what was modelled and what was left out. ``failed``: the candidates that came to
    nothing, and ``replaced``: those of the paths it was given that its own take the place of, where the
    mechanism says so."""

    paths: tuple[Paths, ...] = ()
    counts: dict[Status, int] = field(default_factory=dict)
    modelled: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    failed: tuple[Failed, ...] = ()
    replaced: Bool[Tensor, "p"] | None = None


@dataclass(frozen=True)
class Channel:
    """h(f) = sum_l gain_l(f) exp(-j 2 pi f delay_l) between the given antennas, 1 W in.

    ``gain`` leaves out the propagation phase of ``delay``; path gain is |gain|^2. ``crossed`` lists
    (path, node, segment) of objects that a path goes through, in order along each path.

    ``gain`` is between the reference ports of the two radios. ``jones``, where a radio is polarised,
    holds the transfer without antennas from (theta, phi) of the transmitter's own frame (columns) to
    (theta, phi) of the receiver's (rows), spreading and lambda / 4 pi included; else None.
    """

    tx: Int[Tensor, "p"]
    rx: Int[Tensor, "p"]
    frequency: Float[Tensor, "f"]  # [Hz]
    delay: Float[Tensor, "p"]  # [s]
    gain: Complex[Tensor, "p f"]
    doppler: Float[Tensor, "p"]  # [Hz] at frequency[0]
    departure: Float[Tensor, "p 3"]  # unit vector, world, leaving the transmitter
    arrival: Float[Tensor, "p 3"]  # unit vector, world, from the receiver back towards the wave
    crossed: Int[Tensor, "x 3"]
    blocked: Bool[Tensor, "p"]
    jones: Complex[Tensor, "p f 2 2"] | None = None

    @staticmethod
    def joined(parts: "Sequence[Channel]") -> "Channel":
        """The channel of all paths of several channels at the same frequencies, in order."""
        if len(parts) == 1:
            return parts[0]
        first, before, crossed = parts[0], 0, []
        for part in parts:
            crossed.append(part.crossed + part.crossed.new_tensor([before, 0, 0]))
            before += len(part.tx)
        same = {"frequency": first.frequency, "crossed": torch.cat(crossed), "jones": None}
        if first.jones is not None:
            same["jones"] = torch.cat([p.jones for p in parts if p.jones is not None])
        rest = [n for n in Channel.__dataclass_fields__ if n not in same]
        return Channel(**{n: torch.cat([getattr(p, n) for p in parts]) for n in rest}, **same)
