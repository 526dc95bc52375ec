"""Newton on the Lagrangian of a batch of chains: planes, exact shapes and measured facets alike."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Jet
from rfsg.scene.world import World
from rfsg.tracer.implicit import kkt, multipliers, segments, solve_regular
from rfsg.tracer.zone import Facets, take

NEWTON_SETTLED = 1e-11  # of the path's length: the last Newton step of a converged chain
ROUNDING = 64 * 2.0**-52  # of the coordinates: float64's own, through a Newton system


@dataclass
class Batch:
    """Chains of one depth on their way to paths; every field has the chain axis first.

    link: a number for each pair of radios, of which two may stand in the same places.
    """

    link: Int[Tensor, "c"]
    tx: Float[Tensor, "c 3"]
    rx: Float[Tensor, "c 3"]
    which: Int[Tensor, "c d"]
    patch: Int[Tensor, "c d"]
    x: Float[Tensor, "c d 3"]

    def take(self, i: Tensor) -> "Batch":
        return Batch(*(getattr(self, n)[i] for n in self.__dataclass_fields__))

    def turned(self, back: Bool[Tensor, "c"]) -> "Batch":
        """The same chains, those in ``back`` read from the receiver."""
        row, deep = back[:, None], back[:, None, None]
        return Batch(
            self.link,
            torch.where(row, self.rx, self.tx),
            torch.where(row, self.tx, self.rx),
            torch.where(row, self.which.flip(1), self.which),
            torch.where(row, self.patch.flip(1), self.patch),
            torch.where(deep, self.x.flip(1), self.x),
        )

    def polyline(self, x: Tensor | None = None) -> Float[Tensor, "c v 3"]:
        x = self.x if x is None else x
        return torch.cat([self.tx[:, None], x, self.rx[:, None]], 1)


@dataclass(frozen=True)
class Surfaces:
    """The local models of a batch's vertices: planes, exact shapes, or measured facets (flat [c d])."""

    world: World
    which: Int[Tensor, "m"]
    planar: Bool[Tensor, "m"]
    plane_normal: Float[Tensor, "m 3"]
    plane_offset: Float[Tensor, "m"]
    learned: Bool[Tensor, "m"]
    facets: Facets | None

    def take(self, chains: Int[Tensor, "k"], depth: int) -> "Surfaces":
        """Those of some chains of a batch."""
        i = (depth * chains[:, None] + torch.arange(depth, device=chains.device)).reshape(-1)
        facets = self.facets
        if facets is not None:
            row = torch.cumsum(self.learned, 0) - 1
            facets = take(facets, row[i[self.learned[i]]])
        return Surfaces(
            self.world,
            self.which[i],
            self.planar[i],
            self.plane_normal[i],
            self.plane_offset[i],
            self.learned[i],
            facets,
        )

    def jet(self, x: Float[Tensor, "c d 3"]) -> Jet:
        flat = x.reshape(-1, 3)
        value = (flat * self.plane_normal).sum(-1) - self.plane_offset
        gradient, hessian = self.plane_normal, flat.new_zeros(len(flat), 3, 3)
        i = torch.nonzero(~self.planar & ~self.learned).squeeze(-1)
        if len(i):
            j = self.world.jet(self.which[i], flat[i])
            value, gradient = value.index_copy(0, i, j.value), gradient.index_copy(0, i, j.gradient)
            hessian = hessian.index_copy(0, i, j.hessian)
        if self.facets is not None:
            i = torch.nonzero(self.learned).squeeze(-1)
            j = self.facets.jet(flat[i])
            value, gradient = value.index_copy(0, i, j.value), gradient.index_copy(0, i, j.gradient)
            hessian = hessian.index_copy(0, i, j.hessian)
        c, d = x.shape[:2]
        return Jet(value.reshape(c, d), gradient.reshape(c, d, 3), hessian.reshape(c, d, 3, 3))


def surfaces_of(world: World, batch: Batch, facets: Facets | None) -> Surfaces:
    which, patch = batch.which.reshape(-1), batch.patch.reshape(-1)
    normal, offset, planar = world.plane(which, patch)
    return Surfaces(world, which, planar, normal, offset, ~world.exact[which], facets)


def newton(
    batch: Batch, surfaces: Surfaces, rounds: int, index: Float[Tensor, "c s"] | None = None
) -> tuple[Tensor, Tensor]:
    """Newton on the Lagrangian from batch.x, steps held to half the shortest neighbouring segment.

    index: of refraction, of what each segment runs in; 1 where None.
    """
    x = batch.x.clone()
    c, depth = batch.which.shape
    settled = torch.zeros(c, dtype=torch.bool, device=x.device)
    going = torch.arange(c, device=x.device)
    for _ in range(rounds):
        moved, now = _step(batch, surfaces, index)
        x[going], settled[going] = moved, now
        # most chains settle in a few steps, and a few never do
        left = torch.nonzero(~now).squeeze(-1)
        if not len(left):
            break
        if 2 * len(left) < len(going):
            batch, surfaces, going = batch.take(left), surfaces.take(left, depth), going[left]
            moved, index = moved[left], None if index is None else index[left]
        batch = replace(batch, x=moved)
    return x, settled


def _step(
    batch: Batch, surfaces: Surfaces, index: Float[Tensor, "c s"] | None
) -> tuple[Float[Tensor, "c d 3"], Bool[Tensor, "c"]]:
    """One step of each chain, and whether it was its last."""
    x = batch.x
    c, depth = batch.which.shape
    vertices = batch.polyline(x)
    length, u = segments(vertices)
    jet = surfaces.jet(x)
    system = kkt(vertices, jet, multipliers(u, jet.gradient, index), index)
    step, regular = solve_regular(system.matrix, system.residual[..., None])
    dx = -step[:, : 3 * depth, 0].reshape(c, depth, 3)
    # no further than half a segment, nor than half a radius of curvature: Newton's model ends there
    bend = jet.hessian.flatten(2).norm(dim=-1).clamp(min=1e-300)
    reach = 0.5 * torch.minimum(torch.minimum(length[:, :-1], length[:, 1:]), 1.0 / bend)
    size = dx.norm(dim=-1)
    shrink = torch.where(size > reach, reach / size.clamp(min=1e-300), 1.0).amin(1)
    # coordinates far from the origin round coarser than the path is long
    rounding = ROUNDING * vertices.abs().amax((1, 2))
    settled = regular & (size.amax(1) <= NEWTON_SETTLED * length.sum(1) + rounding)
    return x + shrink[:, None, None] * dx, settled
