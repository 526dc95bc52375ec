"""The three contracts of rfsg: a Shape, a Surface, and the RadioObject that joins them.

Everything here is in the object's own frame, in metres. Positions are float64; networks may hold
float32 weights, and the dtype of the *points* decides the precision of an answer: ask with float32
points to search, with float64 points to evaluate.

Sign conventions: ``sdf < 0`` inside; normals point outward; a direction is a direction of travel.
Coefficients come in pairs (TE, TM) on a last axis of 2: TE is the electric field across the plane of
incidence, TM within it; at normal incidence the two are equal (ITU-R P.2040-3 section 2.2, with the
reflected TM reference chosen so that R_TE = R_TM at normal incidence). Time convention exp(+j 2 pi f t).
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.objects.physics.lobes import Scattering


@dataclass(frozen=True)
class Jet:
    """A field to second order at points: value [m], gradient [1], hessian [1/m]."""

    value: Float[Tensor, "*b"]
    gradient: Float[Tensor, "*b 3"]
    hessian: Float[Tensor, "*b 3 3"]


@dataclass(frozen=True)
class Contact:
    """A wave meets a boundary from outside: arrives along ``incoming``, leaves along ``outgoing``."""

    point: Float[Tensor, "*b 3"]
    incoming: Float[Tensor, "*b 3"]
    outgoing: Float[Tensor, "*b 3"]
    normal: Float[Tensor, "*b 3"]


@dataclass(frozen=True)
class Crossing:
    """A straight stretch inside an object, from ``start`` to ``end``.

    ``normal_start`` and ``normal_end`` are the outward normals where the stretch enters and leaves;
    a zero vector says that this end lies inside the object (the segment begins or ends there), so no
    boundary is crossed.
    """

    start: Float[Tensor, "*b 3"]
    end: Float[Tensor, "*b 3"]
    normal_start: Float[Tensor, "*b 3"]
    normal_end: Float[Tensor, "*b 3"]


@runtime_checkable
class Shape(Protocol):
    """Where a thing is. A ``torch.nn.Module`` (its parameters are what a fit may change)."""

    kind: (
        str  # token in files: "box", "sphere", "cylinder", "capsule", "halfspace", "mesh", "neural"
    )
    lipschitz: float  # |sdf(p) - sdf(q)| <= lipschitz * |p - q| within bounds: a computed bound
    convex: bool  # a line meets it in at most one stretch, and ``interval`` gives it in closed form
    faceted: bool  # every patch is a plane
    exact: bool  # True: jets are the true surface. False: learned; it ripples, measure at the wave's scale

    def config(self) -> dict[str, object]:
        """What the constructor needs, as plain numbers, for files."""
        ...

    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lowest and highest corner [m]; infinite for an unbounded shape."""
        ...

    def sdf(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Mean implicit function f [m], negative inside."""
        ...

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """f [m] and its gradient [1], in one sweep, differentiable."""
        ...

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        """f to second order, differentiable."""
        ...

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Where the line origin + t direction is inside: (enter, leave) [m], (inf, -inf) for a miss.

        Only for ``convex`` shapes; others raise NotImplementedError.
        """
        ...

    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        """Which smooth piece of the surface a surface point belongs to (0, 1, ...)."""
        ...

    def planes(self) -> Float[Tensor, "k 4"]:
        """The planar patches as rows (nx, ny, nz, d): n.x = d on patch 0..k-1; k = 0 if none.

        Planar patches are numbered first: patch i < k is the plane in row i.
        """
        ...


@runtime_checkable
class Surface(Protocol):
    """What a boundary and an interior do to a wave. A ``torch.nn.Module``."""

    kind: str  # token in files: "conductor", "halfspace", "slab", "solid", "stochastic"
    opaque: bool  # True: nothing ever comes through; the tracer stops there

    def config(self) -> dict[str, object]:
        """What the constructor needs, as plain numbers, for files."""
        ...

    def reflection(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """Reflection coefficients (TE, TM) at contacts; |R| <= 1."""
        ...

    def transmission(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """Transmission (TE, TM) of whole crossings, boundaries included, *relative to free space*
        over the same straight stretch (the path length already counts the stretch); |T| <= 1."""
        ...

    def excess_delay(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]:
        """Group delay of a crossing beyond free space over the same stretch [s]."""
        ...


@runtime_checkable
class Scatters(Protocol):
    """A Surface that may be rough. ``reflection`` is then the mirror's share alone."""

    @property
    def scattering(self) -> Scattering | None:
        """Where to it scatters; None for a smooth surface."""
        ...

    def diffuse(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """Amplitude (TE, TM) of the diffuse wave in all directions together: the square is the
        share of the arriving power that scatters. Asked with ``outgoing`` in mirror direction."""
        ...


@runtime_checkable
class RadioObject(Protocol):
    """A shape with a surface: the unit that is trained, moved, swapped, exported and reused."""

    shape: Shape
    surface: Surface

    def reflection(
        self, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]: ...

    def transmission(
        self, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]: ...

    def excess_delay(
        self, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]: ...
