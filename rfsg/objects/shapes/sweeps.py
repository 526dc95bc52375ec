"""A neural shape's value, gradient and features as one node of autograd (see ``objects.sweeps``)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import linear

from rfsg.objects.sweeps import Layers, Level, Plain, ascend, by_autograd, cast_back, descend, pull

SHARE = math.sqrt(0.5)  # of what enters the skip's layer: two unit variances are one again


@dataclass(frozen=True)
class Question:
    """What is asked of which network: all but its weights. Tensors are in the points' precision."""

    skip: int
    softness: float
    centre: Float[Tensor, "3"]
    reach: Float[Tensor, ""]
    octaves: Float[Tensor, "k"]
    value: bool
    gradient: bool
    feature: bool


@dataclass(frozen=True)
class Encoding:
    """Coordinates, sines and cosines of points, and what derivatives along them need."""

    inputs: Float[Tensor, "n c"]
    sine: Float[Tensor, "n 3 k"]
    cosine: Float[Tensor, "n 3 k"]

    @staticmethod
    def of(point: Float[Tensor, "n 3"], asked: Question) -> "Encoding":
        own = (point - asked.centre).div_(asked.reach)
        phase = own[..., None] * asked.octaves
        sine, cosine = phase.sin(), phase.cos_()
        return Encoding(torch.cat([own, sine.flatten(1), cosine.flatten(1)], -1), sine, cosine)

    def slope(self, adjoint: Float[Tensor, "n c"], octaves: Tensor) -> Float[Tensor, "n 3"]:
        """Adjoint of the coordinates from that of the encoding."""
        own, to_sine, to_cosine = self._parts(adjoint)
        turned = (to_sine * self.cosine).sub_(to_cosine * self.sine)
        return own + turned.mul_(octaves).sum(-1)

    def bend(self, adjoint: Float[Tensor, "n c"], octaves: Tensor) -> Float[Tensor, "n 3"]:
        """Slope of ``slope``, which each coordinate has along itself alone."""
        _, to_sine, to_cosine = self._parts(adjoint)
        turned = (to_sine * self.sine).add_(to_cosine * self.cosine)
        return -(turned @ (octaves * octaves))

    def tangent(self, along: Float[Tensor, "n 3"], octaves: Tensor) -> Float[Tensor, "n c"]:
        """How the encoding changes as the coordinates do."""
        rate = along[..., None] * octaves
        return torch.cat(
            [along, (rate * self.cosine).flatten(1), (rate * self.sine).neg_().flatten(1)], -1
        )

    def _parts(self, adjoint: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        count = self.sine.shape[1] * self.sine.shape[2]
        own, to_sine, to_cosine = adjoint.split([3, count, count], -1)
        return own, to_sine.reshape(self.sine.shape), to_cosine.reshape(self.sine.shape)


Answers = tuple[Tensor, ...]  # value [n], gradient [n 3], feature [n h]: those that were asked


def answer(asked: Question, point: Float[Tensor, "n 3"], *weights: Tensor) -> Answers:
    """What is asked, without a graph.

    weights: (weight, bias) of each hidden layer in turn, of the value and of the features.
    """
    return _answer(asked, point, weights)[0]


def _answer(asked: Question, point: Tensor, weights: tuple[Tensor, ...]) -> tuple[Answers, tuple]:
    """The answers, and what the way back needs."""
    *hidden, value_weight, value_bias, feature_weight, feature_bias = weights
    layers = Layers.of(hidden, point, asked.skip, SHARE, asked.softness)
    seed = value_weight.to(point.dtype)
    encoding = Encoding.of(point, asked)
    tape: list[Level] = []
    last = ascend(layers, encoding.inputs, tape)
    answers: list[Tensor] = []
    adjoint, descent = None, []
    if asked.value:
        value = linear(last, seed, value_bias.to(point.dtype)).squeeze(-1)
        answers.append(value.mul_(asked.reach))
    if asked.gradient:
        adjoint, descent = descend(layers, tape, seed)
        answers.append(encoding.slope(adjoint, asked.octaves))
    if asked.feature:
        bias = feature_bias.to(point.dtype)
        answers.append(torch.addmm(bias, last, feature_weight.to(point.dtype).t()))
    return tuple(answers), (layers, seed, encoding, tape, last, adjoint, descent)


class ShapeSweep(torch.autograd.Function):
    """``answer``, differentiable in points and weights."""

    @staticmethod
    def forward(ctx, plain: Plain, asked: Question, point: Tensor, *weights: Tensor) -> Answers:
        answers, ctx.kept = _answer(asked, point, weights)
        ctx.plain, ctx.asked = plain, asked
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(point, *weights)
        return answers

    @staticmethod
    def backward(ctx, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        given, asked = ctx.saved_tensors, ctx.asked
        if all(g is None for g in gradients):
            return (None,) * (2 + len(given))
        if torch.is_grad_enabled():
            found = by_autograd(ctx.plain, given, ctx.needs_input_grad[2:], gradients)
            return None, None, *found
        each = iter(gradients)
        value, gradient, feature = (
            next(each) if wanted else None
            for wanted in (asked.value, asked.gradient, asked.feature)
        )
        return (
            None,
            None,
            *cast_back(_backward(asked, ctx.kept, given, value, gradient, feature), given),
        )


def _backward(
    asked: Question,
    kept: tuple,
    given: tuple[Tensor, ...],
    value: Tensor | None,
    gradient: Tensor | None,
    feature: Tensor | None,
) -> list[Tensor | None]:
    """Adjoints of points and weights from those of value, gradient and features."""
    layers, seed, encoding, tape, last, adjoint, descent = kept
    to_last: Tensor | None = None
    of_heads: list[Tensor | None] = [None] * 4
    if value is not None:
        value = value * asked.reach
        to_last = value[:, None] * seed
        of_heads[:2] = [(value @ last)[None], value.sum(0, keepdim=True)]
    if feature is not None:
        weight = given[-2].to(feature.dtype)
        to_last = feature @ weight if to_last is None else to_last.addmm_(feature, weight)
        of_heads[2:] = [feature.t() @ last, feature.sum(0)]
    tangent = None if gradient is None else encoding.tangent(gradient, asked.octaves)
    pulled = pull(layers, tape, to_last, descent, tangent)
    point = encoding.slope(pulled.inputs, asked.octaves)
    if pulled.seed is not None:
        point.addcmul_(gradient, encoding.bend(adjoint, asked.octaves))
        begun = pulled.seed.sum(0, keepdim=True)
        of_heads[0] = begun if of_heads[0] is None else of_heads[0] + begun
    return [point.div_(asked.reach), *pulled.weights, *of_heads]
