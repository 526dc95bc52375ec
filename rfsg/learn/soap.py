"""SOAP: Adam in the eigenbasis of Shampoo's preconditioner (Vyas et al. 2024, arXiv:2409.11321).

For matrices as small as ours (64 x 64) a step costs little more than Adam's, and a distance is
learned several times better in the same time. Small on purpose: no weight decay, state as plain
tensors that a safetensors file can hold.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

MOMENTUM, MEMORY = 0.95, 0.95
REFRESH = 10  # steps between updates of the eigenbases
TINY = 1e-8  # directions without gradient yet must not move: they would undo the start


class Soap:
    """Minimises over ``parameters`` (vectors by Adam, matrices in their eigenbasis)."""

    def __init__(self, parameters: Sequence[nn.Parameter]):
        self.parameters = list(parameters)
        self.steps = 0
        self.state = [_fresh(p) for p in self.parameters]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """One update with the gradients that are there; clears them."""
        self.steps += 1
        for p, state in zip(self.parameters, self.state, strict=True):
            if p.grad is not None:
                self._update(p, p.grad, state, rate)
            p.grad = None

    def tensors(self) -> dict[str, Tensor]:
        """The whole state, by name."""
        named = {f"{i}.{k}": v for i, s in enumerate(self.state) for k, v in s.items()}
        return named | {"steps": torch.tensor(self.steps)}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from ``tensors()``. Raises KeyError or RuntimeError where they do not fit."""
        for i, state in enumerate(self.state):
            for name, value in state.items():
                value.copy_(tensors[f"{i}.{name}"])
        self.steps = int(tensors["steps"])

    def _update(self, p: Tensor, gradient: Tensor, state: dict[str, Tensor], rate: float) -> None:
        matrix = gradient.ndim == 2
        state["first"].lerp_(gradient, 1 - MOMENTUM)
        if matrix:
            state["left"].lerp_(gradient @ gradient.mT, 1 - MEMORY)
            state["right"].lerp_(gradient.mT @ gradient, 1 - MEMORY)
            if self.steps == 1:
                for side in ("left", "right"):
                    state[f"{side}_basis"].copy_(torch.linalg.eigh(state[side])[1])
        here = _rotate(gradient, state) if matrix else gradient
        state["second"].mul_(MEMORY).addcmul_(here, here, value=1 - MEMORY)
        mean = _rotate(state["first"], state) if matrix else state["first"]
        grown = math.sqrt(1 - MEMORY**self.steps) / (1 - MOMENTUM**self.steps)
        move = mean / (state["second"].sqrt() + TINY)
        if matrix:
            move = state["left_basis"] @ move @ state["right_basis"].mT
        p.sub_(move, alpha=rate * grown)
        if matrix and self.steps % REFRESH == 0:
            # One step of orthogonal iteration follows the slowly turning eigenvectors.
            for side in ("left", "right"):
                basis = state[f"{side}_basis"]
                basis.copy_(torch.linalg.qr(state[side] @ basis)[0])


def _fresh(p: Tensor) -> dict[str, Tensor]:
    state = {"first": torch.zeros_like(p), "second": torch.zeros_like(p)}
    if p.ndim == 2:
        for side, size in zip(("left", "right"), p.shape, strict=True):
            state[side] = p.new_zeros(size, size)
            state[f"{side}_basis"] = p.new_zeros(size, size)
    return {name: value.detach() for name, value in state.items()}


def _rotate(matrix: Tensor, state: dict[str, Tensor]) -> Tensor:
    return state["left_basis"].mT @ matrix @ state["right_basis"]
