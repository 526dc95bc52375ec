"""Adam (Kingma and Ba 2014) by torch, with a rate of its own for every tensor and a state without pickle."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

BETAS = (0.9, 0.999)  # the paper's reference values, as are torch's
TINY = 1e-8
STATE = {"first": "exp_avg", "second": "exp_avg_sq"}  # the moments: our name, torch's


class Adam:
    """Minimises over ``parameters``; ``rates`` multiply the rate of a step, one for each."""

    def __init__(self, parameters: Sequence[nn.Parameter], rates: Sequence[float]):
        self.parameters = list(parameters)
        groups = [
            {"params": [p for p, own in zip(self.parameters, rates, strict=True) if own == rate],
             "own": rate}
            for rate in dict.fromkeys(rates)
        ]  # fmt: skip
        self.optimizer = torch.optim.Adam(groups, betas=BETAS, eps=TINY, fused=True)
        for p in self.parameters:
            moments = {theirs: torch.zeros_like(p) for theirs in STATE.values()}
            step = torch.zeros((), dtype=torch.float32, device=p.device)
            self.optimizer.state[p] = {"step": step, **moments}

    def step(self, gradients: Sequence[Tensor], rate: float) -> None:
        """One update by finite ``gradients``, each shaped as its parameter."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["own"]
        for p, gradient in zip(self.parameters, gradients, strict=True):
            p.grad = gradient
        self.optimizer.step()
        self.optimizer.zero_grad()

    def tensors(self) -> dict[str, Tensor]:
        """The whole state, by name."""
        state = [self.optimizer.state[p] for p in self.parameters]
        named = {
            f"{ours}.{i}": one[theirs]
            for ours, theirs in STATE.items()
            for i, one in enumerate(state)
        }
        return named | {"steps": torch.tensor(int(state[0]["step"]) if state else 0)}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from ``tensors()``. Raises KeyError or RuntimeError where they do not fit."""
        for i, p in enumerate(self.parameters):
            for ours, theirs in STATE.items():
                self.optimizer.state[p][theirs].copy_(tensors[f"{ours}.{i}"])
            self.optimizer.state[p]["step"].fill_(int(tensors["steps"]))
