"""A shape that answers from memory, for fields learned on a shape that stands still.

A crossing of a learned surface asks its shape for f, gradient and features at the same points at
every step of a fit. Where the shape does not change, they are asked once.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.objects.contract import Contact, Crossing, Shape, Surface

MOST_POINTS = 1 << 20  # with 128 features in float32: 0.5 GB; beyond, shapes are asked every time


@dataclass(frozen=True)
class Memory:
    """What a shape said at the points of m crossings or contacts, k points each."""

    shape: Shape
    f: Float[Tensor, "m k"]
    gradient: Float[Tensor, "m k 3"]
    feature: Float[Tensor, "m k h"] | None

    @staticmethod
    @torch.no_grad()
    def of(surface: Surface, shape: Shape, met: Contact | Crossing, dtype: torch.dtype) -> "Memory":
        """Let the surface ask once, in float64, and keep the answers in ``dtype``."""
        said: list[tuple[Any, ...]] = []
        fused = getattr(shape, "value_gradient_feature", None)

        def ask(point: Tensor) -> tuple[Any, ...]:
            said.append(fused(point) if fused else (*shape.value_and_gradient(point), None))
            return said[-1]

        frequency = torch.ones(1, dtype=torch.float64)  # of no matter: the points are the same
        if isinstance(met, Crossing):
            surface.transmission(_standing_in(shape, ask), met, frequency)
        else:
            surface.reflection(_standing_in(shape, ask), met, frequency)
        f, gradient, feature = zip(*said, strict=True)
        m = len(next(iter(vars(met).values())))
        kept = torch.cat(f).reshape(m, -1).to(dtype)
        count = kept.shape[1]
        features = None
        if feature[0] is not None:
            features = torch.cat(feature).reshape(m, count, -1).to(dtype)
        return Memory(shape, kept, torch.cat(gradient).reshape(m, count, 3).to(dtype), features)

    def at(self, i: Tensor) -> Shape:
        """The shape as it answers for some of the crossings: their points in order, once each,
        however many are asked at a time."""
        f, gradient = self.f[i].flatten(), self.gradient[i].flatten(0, 1)
        feature = None if self.feature is None else self.feature[i].flatten(0, 1)
        done = 0

        def replay(point: Tensor) -> tuple[Any, ...]:
            nonlocal done
            part = slice(done, done + len(point))
            done += len(point)
            return f[part], gradient[part], None if feature is None else feature[part]

        return _standing_in(self.shape, replay)


def _standing_in(shape: Shape, answer: Callable[[Tensor], tuple[Any, ...]]) -> Shape:
    """The same shape, parameters shared, but for one answer."""
    other: Any = copy.copy(shape)
    other.value_gradient_feature = answer
    return other
