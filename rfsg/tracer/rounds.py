"""Radio maps by rays, a round at a time: turned lattices from every transmitter, tallied over cells."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.scene.world import World
from rfsg.tracer.cells import Grid
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.montecarlo import flights
from rfsg.tracer.patches import Patches
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import positions
from rfsg.tracer.tally import Tally, in_db


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
        self.generators = [torch.Generator().manual_seed(seed) for _ in radios]
        owner, area = cells.owner.to(world.device), cells.subarea.to(world.device)
        self.tallies = [Tally(area, owner, math.prod(cells.shape)) for _ in radios]
        self.count = 0

    def add(self) -> None:
        """One more turned lattice from every transmitter."""
        self.count += 1
        aperture = float((SPEED_OF_LIGHT / self.frequency) ** 2) / (4 * math.pi)
        asked = self.world, self.proxies
        for t, radio in enumerate(self.world.scene.transmitters):
            tally, generator = self.tallies[t], self.generators[t]
            collected = torch.zeros_like(tally.area)
            for flight in flights(*asked, radio, self.tx[t], self.frequency, self.quality,
                                  "enumerate", generator):  # fmt: skip
                met = self.cells.meet(flight.rays)
                share = flight.power_at(met.ray, met.distance) / met.cosine
                collected.index_add_(0, met.subcell, share)
            tally.add(collected.mul_(aperture))

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
