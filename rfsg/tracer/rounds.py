"""Radio maps by rays, a round at a time: turned lattices from every transmitter, tallied over cells."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.scene.world import World
from rfsg.tracer.cells import Grid
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.montecarlo import Draws, Lattice, flights, per_round
from rfsg.tracer.patches import Patches
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import positions
from rfsg.tracer.tally import Tally, in_db

SUBCELLS = 4_000_000  # of all lattices that fly together: 32 MB


class Rounds:
    """The rounds so far. Round k is the same lattice whatever comes after it, so the map after n
    rounds is the mean of the n."""

    def __init__(
        self,
        world: World,
        frequency: Float[Tensor, "1"],
        quality: Quality,
        seed: int,
        cells: Grid | Patches,
    ):
        self.world, self.frequency, self.quality, self.cells = world, frequency, quality, cells
        self.proxies = Proxies(world)
        radios = world.scene.transmitters
        self.tx = positions(radios, world.device)
        owner, area = cells.owner.to(world.device), cells.subarea.to(world.device)
        self.draws, self.subcells = [Draws(seed) for _ in radios], len(owner)
        self.tallies = [Tally(area, owner, math.prod(cells.shape)) for _ in radios]
        self.count = 0

    def add(self, rounds: int = 1) -> None:
        """So many more turned lattices from every transmitter.

        As many fly together as memory allows: a search of few rays costs more in calls than in work.
        """
        lattices = [
            (t, Lattice(radio, self.tx[t], *self.draws[t].next()))
            for t, radio in enumerate(self.world.scene.transmitters)
            for _ in range(rounds)
        ]
        for begin in range(0, len(lattices), self._together()):
            some = lattices[begin : begin + self._together()]
            collected = self._collected([lattice for _, lattice in some])
            for (t, _), power in zip(some, collected, strict=True):
                self.tallies[t].add(power)
        self.count += rounds

    def _together(self) -> int:
        """Lattices that fly at once: about a chunk of rays."""
        rays = self.quality.chunk // per_round(self.quality)
        return max(1, min(rays, SUBCELLS // max(1, self.subcells)))

    def _collected(self, lattices: list[Lattice]) -> Float[Tensor, "k s"]:
        """What each lattice brings to every sub-cell [m^2]."""
        collected = self.tx.new_zeros(len(lattices) * self.subcells)
        asked = self.world, self.proxies, lattices, self.frequency, self.quality
        for flight in flights(*asked, "enumerate"):
            met = self.cells.meet(flight.rays)
            share = flight.power_at(met.ray, met.distance) / met.cosine
            collected.index_add_(0, flight.lattice[met.ray] * self.subcells + met.subcell, share)
        aperture = float((SPEED_OF_LIGHT / self.frequency) ** 2) / (4 * math.pi)
        return collected.mul_(aperture).reshape(len(lattices), self.subcells)

    def summary(self) -> tuple[Tensor, Tensor, Tensor]:
        """Mean path gain of cells, and one standard deviation [dB]: with the spread of power within a
        cell, and without; each [t c]."""
        none = torch.zeros(0, math.prod(self.cells.shape), dtype=torch.float64)
        none = none.to(self.world.device)
        mean = torch.cat([none, *(t.mean[None] for t in self.tallies)])
        whole = torch.cat([none, *(in_db(t.deviation(), t.mean)[None] for t in self.tallies)])
        error = torch.cat([none, *(in_db(t.standard_error(), t.mean)[None] for t in self.tallies)])
        return mean, whole, error

    def error_db(self) -> float:
        """Median standard error of the cells that hear something [dB]; 0 where none does."""
        return median_db([in_db(t.standard_error(), t.mean) for t in self.tallies])


def median_db(errors: list[Tensor]) -> float:
    """Median of the finite ones, 0 without any."""
    lit = torch.cat([e[torch.isfinite(e)] for e in errors] or [torch.zeros(0)])
    return float(lit.median()) if len(lit) else 0.0
