"""A neural shape's value, gradient and features as one node of autograd (see ``objects.sweeps``)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import linear

from rfsg.objects.sweeps import (
    Layers,
    Level,
    Plain,
    ascend,
    by_autograd,
    cast_back,
    descend,
    in_precision,
    pull,
)

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


@torch.no_grad()
def answer(
    asked: Question, point: Float[Tensor, "n 3"], weights: Sequence[Tensor], chunk: int
) -> Answers:
    """What is asked, without a graph, ``chunk`` points at a time.

    weights: (weight, bias) of each hidden layer in turn, of the value and of the features.
    """
    folded = Folded.of(weights, asked, point)
    answers = _empty(asked, folded, point)
    room = Room.of(folded, point[:chunk])
    for begin in range(0, len(point), chunk):
        piece = slice(begin, begin + chunk)
        _fill(
            asked,
            folded,
            room.of_rows(len(point[piece])),
            point[piece],
            [a[piece] for a in answers],
        )
    return tuple(a.squeeze(-1) if asked.value and i == 0 else a for i, a in enumerate(answers))


@dataclass(frozen=True)
class Folded:
    """Weights for y = z + root = 2 x in place of x, so that no pass over the activations halves them:
    those that y enters are halved instead, and dy/dz = y / root. The skip's share, its weights on the
    encoding (``again``) and the reach are folded in too. Cast and transposed once for all chunks."""

    down: list[Float[Tensor, "width _"]]
    up: list[Float[Tensor, "_ width"]]
    bias: list[Float[Tensor, "width"]]
    again: Float[Tensor, "width c"]
    again_up: Float[Tensor, "c width"]
    value: tuple[Tensor, Tensor]
    feature: tuple[Tensor, Tensor]
    softness: Float[Tensor, ""]

    @staticmethod
    def of(weights: Sequence[Tensor], asked: Question, like: Tensor) -> "Folded":
        *hidden, value, value_bias, feature, feature_bias = in_precision(weights, like)
        width = len(hidden[0])
        first, *rest = hidden[::2]
        again = SHARE * rest[asked.skip - 1][:, width:]
        rest[asked.skip - 1] = SHARE * rest[asked.skip - 1][:, :width]
        down = [first, *(0.5 * weight for weight in rest)]
        return Folded(
            down,
            [weight.t().contiguous() for weight in down],
            hidden[1::2],
            again,
            again.t().contiguous(),
            (0.5 * asked.reach * value, asked.reach * value_bias),
            (0.5 * feature, feature_bias),
            like.new_tensor(asked.softness),
        )


@dataclass(frozen=True)
class Room:
    """Memory of one chunk, used again by the next: encoding, its adjoints, y, root, y / root by layer."""

    encoded: Float[Tensor, "n c"]
    adjoint: Float[Tensor, "n c"]
    y: tuple[Float[Tensor, "n width"], Float[Tensor, "n width"]]
    root: Float[Tensor, "n width"]
    slope: list[Float[Tensor, "n width"]]

    @staticmethod
    def of(folded: Folded, point: Tensor) -> "Room":
        width, encoded = folded.down[0].shape

        def room(columns: int) -> Tensor:
            return point.new_empty(len(point), columns)

        return Room(
            room(encoded),
            room(encoded),
            (room(width), room(width)),
            room(width),
            [room(width) for _ in folded.down],
        )

    def of_rows(self, n: int) -> "Room":
        """Its first rows: the last chunk is a smaller one."""
        if n == len(self.root):
            return self
        one, other = self.y
        return Room(
            self.encoded[:n],
            self.adjoint[:n],
            (one[:n], other[:n]),
            self.root[:n],
            [s[:n] for s in self.slope],
        )


def _empty(asked: Question, folded: Folded, point: Tensor) -> list[Tensor]:
    columns = ((asked.value, 1), (asked.gradient, 3), (asked.feature, len(folded.feature[1])))
    return [point.new_empty(len(point), n) for wanted, n in columns if wanted]


def _fill(
    asked: Question, folded: Folded, room: Room, point: Tensor, answers: Sequence[Tensor]
) -> None:
    """The answers of one chunk."""
    sine, cosine = _encode(asked, room.encoded, point)
    y, other = room.y
    for i, (weight, bias) in enumerate(zip(folded.up, folded.bias, strict=True)):
        torch.addmm(bias, room.encoded if i == 0 else y, weight, out=other)
        y, other = other, y
        if i == asked.skip:
            y.addmm_(room.encoded, folded.again_up)
        torch.addcmul(folded.softness, y, y, out=room.root).sqrt_()
        y.add_(room.root)
        if asked.gradient:
            torch.div(y, room.root, out=room.slope[i])
    each = iter(answers)
    if asked.value:
        torch.addmm(folded.value[1], y, folded.value[0].t(), out=next(each))
    gradient = next(each) if asked.gradient else None
    if asked.feature:
        torch.addmm(folded.feature[1], y, folded.feature[0].t(), out=next(each))
    if gradient is not None:
        adjoint = _fall(asked, folded, room)
        own, to_sine, to_cosine = adjoint.split([3, sine.shape[1], sine.shape[1]], -1)
        turned = (to_sine * cosine).sub_(to_cosine * sine).view(-1, len(asked.octaves))
        along = torch.mv(turned, asked.octaves).view(-1, 3)
        torch.add(own, along, out=gradient).div_(asked.reach)


def _encode(asked: Question, encoded: Tensor, point: Tensor) -> tuple[Tensor, Tensor]:
    """Fill the encoding; its sines and cosines [n, 3 k]."""
    own = torch.sub(point, asked.centre, out=encoded[:, :3]).div_(asked.reach)
    phase = (own[..., None] * asked.octaves).flatten(1)
    sine, cosine = phase.sin(), phase.cos_()
    encoded[:, 3 : 3 + sine.shape[1]] = sine
    encoded[:, 3 + sine.shape[1] :] = cosine
    return sine, cosine


def _fall(asked: Question, folded: Folded, room: Room) -> Float[Tensor, "n c"]:
    """Adjoint of the encoding where that of the value is 1."""
    (free, other), adjoint = room.y, room.slope[-1].mul_(folded.value[0])
    again = room.adjoint.zero_()
    for i in reversed(range(1, len(folded.down))):
        if i == asked.skip:
            torch.mm(adjoint, folded.again, out=again)
        torch.mm(adjoint, folded.down[i], out=free)
        adjoint = free.mul_(room.slope[i - 1])
        free, other = other, free
    return again.addmm_(adjoint, folded.down[0])


def _answer(asked: Question, point: Tensor, weights: tuple[Tensor, ...]) -> tuple[Answers, tuple]:
    """The answers by way of all that the way back needs, which comes with them."""
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
    """The same, differentiable in points and weights."""

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
