"""What travels between the stages of the tracer: frozen struct-of-arrays records.

Index -1 pads short chains. Positions, lengths and delays are float64, in the world frame, SI units.
"""

from dataclasses import dataclass
from enum import IntEnum

from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor


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

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Status.OK: "an exact path was found",
    Status.CAUSTIC_CAPPED: "the receiver lies near a focus; spreading was capped at the wavelength scale",
    Status.NOT_CONVERGED: "Newton did not settle on a stationary path within its iterations",
    Status.OFF_SURFACE: "the stationary point lies outside the object's surface (its edge was passed)",
    Status.WRONG_SIDE: "a vertex would be met from behind: no reflection there",
    Status.DUPLICATE: "the same path was already found from another beginning",
    Status.BELOW_FLOOR: "the path is weaker than the power floor of this quality",
    Status.UNRESOLVED: "the reflecting piece is too small or too rough at the wave's scale to act as a mirror",
    Status.OPAQUE: "an opaque object stands on the path",
    Status.DEGENERATE: "transmitter, receiver or vertices coincide: no direction is defined",
}


@dataclass(frozen=True)
class Rays:
    origin: Float[Tensor, "r 3"]
    direction: Float[Tensor, "r 3"]
    limit: Float[Tensor, "r"]  # [m], inf for none


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


@dataclass(frozen=True)
class Paths:
    """Exact paths. vertices holds transmitter, reflections, receiver; after the last true point the
    receiver is repeated, so every consecutive pair is a segment (of length zero in the padding)."""

    tx: Int[Tensor, "p"]
    rx: Int[Tensor, "p"]
    which: Int[Tensor, "p d"]
    vertices: Float[Tensor, "p v 3"]
    normal: Float[Tensor, "p d 3"]
    length: Float[Tensor, "p"]  # [m]
    spread: Float[Tensor, "p"]  # [1/m], 1/length in free space
    status: Int[Tensor, "p"]


@dataclass(frozen=True)
class Channel:
    """h(f) = sum_l gain_l(f) exp(-j 2 pi f delay_l) between the given antennas, 1 W in.

    ``gain`` leaves out the propagation phase of ``delay``; path gain is |gain|^2. ``crossed`` lists
    (path, node, segment) of objects that a path goes through, in order along each path.
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
