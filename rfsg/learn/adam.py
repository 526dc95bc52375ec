"""Adam (Kingma and Ba 2014), with a rate of its own for every tensor and plain tensors as state."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

FIRST, SECOND = 0.9, 0.999  # the paper's reference values, as are torch's
TINY = 1e-8


class Adam:
    """Minimises over ``parameters``; ``rates`` multiply the rate of a step, one for each."""

    def __init__(self, parameters: Sequence[nn.Parameter], rates: Sequence[float]):
        self.parameters, self.rates = list(parameters), list(rates)
        self.steps = 0
        self.first = [torch.zeros_like(p) for p in self.parameters]
        self.second = [torch.zeros_like(p) for p in self.parameters]

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], rate: float) -> None:
        """One update by finite ``gradients``, each shaped as its parameter."""
        self.steps += 1
        grown = math.sqrt(1 - SECOND**self.steps) / (1 - FIRST**self.steps)
        given = list(gradients)
        torch._foreach_lerp_(self.first, given, 1 - FIRST)
        torch._foreach_mul_(self.second, SECOND)
        torch._foreach_addcmul_(self.second, given, given, value=1 - SECOND)
        spread = torch._foreach_sqrt(self.second)
        torch._foreach_add_(spread, TINY)
        strides = [-rate * own * grown for own in self.rates]
        tensors: list[Tensor] = [*self.parameters]
        torch._foreach_addcdiv_(tensors, self.first, spread, strides)

    def tensors(self) -> dict[str, Tensor]:
        """The whole state, by name."""
        named = {f"first.{i}": t for i, t in enumerate(self.first)}
        named |= {f"second.{i}": t for i, t in enumerate(self.second)}
        return named | {"steps": torch.tensor(self.steps)}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from ``tensors()``. Raises KeyError or RuntimeError where they do not fit."""
        for name, state in (("first", self.first), ("second", self.second)):
            for i, value in enumerate(state):
                value.copy_(tensors[f"{name}.{i}"])
        self.steps = int(tensors["steps"])
