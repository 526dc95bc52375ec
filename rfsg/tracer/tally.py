"""What turned lattices of rays bring to the cells of a map: running mean and error, round by round.

Each round is one turned lattice, an unbiased estimate of every cell's mean power. The tally keeps the
mean over rounds and what its error is made of (Welford 1962), so that a map may be looked at after any
round, and its memory does not grow with them.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass
class Tally:
    """Sub-cells of areas [m^2], owned by cells 0 ... count - 1; rounds added one after the other."""

    area: Float[Tensor, "s"]
    owner: Int[Tensor, "s"]
    count: int
    rounds: int = 0
    fine: Float[Tensor, "s"] = field(init=False)  # mean over rounds, of sub-cells
    mean: Float[Tensor, "c"] = field(init=False)  # the same, of cells
    scatter: Float[Tensor, "c"] = field(init=False)  # squares about it, summed over rounds
    noise: Float[Tensor, "c"] = field(init=False)  # the same of sub-cells, the mean over a cell's

    def __post_init__(self) -> None:
        self.fine = torch.zeros_like(self.area)
        zero = self.area.new_zeros(self.count)
        self._whole = zero.index_add(0, self.owner, self.area)
        self.mean, self.scatter, self.noise = zero, zero.clone(), zero.clone()

    def add(self, collected: Float[Tensor, "s"]) -> None:
        """One round: what every sub-cell collected; per area it is a power density."""
        self.rounds += 1
        density = collected / self.area
        off = density - self.fine
        self.fine += off / self.rounds
        density -= self.fine
        self.noise += self._over_cells(density.mul_(off))
        now = self.mean.new_zeros(self.count).index_add(0, self.owner, collected) / self._whole
        off = now - self.mean
        self.mean = self.mean + off / self.rounds
        self.scatter += off * (now - self.mean)

    def standard_error(self) -> Float[Tensor, "c"]:
        """Of the cells' means, from how rounds scatter: what more rounds bring down. Needs two."""
        return torch.sqrt(self.scatter / ((self.rounds - 1) * self.rounds))

    def deviation(self) -> Float[Tensor, "c"]:
        """That, and the spread of power within a cell, as one standard deviation."""
        # the spread between sub-cells, less what their own scatter already explains
        noise = self.noise / ((self.rounds - 1) * self.rounds)
        spread = self._over_cells((self.fine - self.mean[self.owner]) ** 2) - noise
        return torch.sqrt(self.standard_error() ** 2 + spread.clamp(min=0.0))

    def _over_cells(self, value: Float[Tensor, "s"]) -> Float[Tensor, "c"]:
        """Means of sub-cells by area."""
        total = value.new_zeros(self.count).index_add(0, self.owner, value * self.area)
        return total / self._whole


def in_db(deviation: Float[Tensor, "*c"], mean: Float[Tensor, "*c"]) -> Float[Tensor, "*c"]:
    """10 log10(1 + deviation / mean) [dB]; inf where nothing arrives."""
    safe = torch.where(mean > 0, mean, torch.ones_like(mean))
    error = 10.0 * torch.log10(1.0 + deviation / safe)
    return torch.where(mean > 0, error, torch.full_like(error, torch.inf))
