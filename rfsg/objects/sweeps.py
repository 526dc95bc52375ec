"""Squareplus networks swept by hand: forwards, the slope backwards, and the derivatives of both.

Batches of a fit are small, and there autograd costs more in bookkeeping than in arithmetic: a node
for every operation, one more on the way back. Here whole sweeps are one node, with a backward in few
operations. Pure functions of tensors, below autograd; the two ``autograd.Function`` that use them are
``Heads`` here and ``ShapeSweep`` (``shapes.sweeps``). Each of them knows a plain sweep, which autograd
can differentiate any number of times: it serves those who want derivatives of derivatives, and is
what tests compare with.

Notation of layer i: z = a W^T + b, root = sqrt(z^2 + softness), x = (z + root) / 2, x' = x / root.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import linear

Plain = Callable[..., tuple[Tensor, ...]]  # (inputs, *weights) -> answers, by autograd's own means


class Layers(NamedTuple):
    """Hidden layers of one width. Layer ``skip`` also sees the inputs; both are scaled by ``share``."""

    weight: list[Float[Tensor, "width _"]]
    bias: list[Float[Tensor, "width"]]
    skip: int
    share: float
    softness: float

    @staticmethod
    def of(flat: Sequence[Tensor], like: Tensor, skip: int, share: float, softness: float):
        """From (weight, bias, weight, bias, ...), in the precision of ``like``."""
        cast = in_precision(flat, like)
        return Layers(cast[::2], cast[1::2], skip, share, softness)


class Level(NamedTuple):
    """What a layer leaves for the way back: what entered it, x' and root."""

    entered: Float[Tensor, "n _"]
    slope: Float[Tensor, "n width"]
    root: Float[Tensor, "n width"]


class Descent(NamedTuple):
    """What the slope's sweep leaves of a layer: adjoints of its x, and of its z."""

    above: Float[Tensor, "#n width"]
    below: Float[Tensor, "n width"]


class Pulled(NamedTuple):
    """Adjoints: of the inputs, of weights and biases in turn, of where the slope's sweep began."""

    inputs: Float[Tensor, "n c"]
    weights: list[Tensor]
    seed: Float[Tensor, "n width"] | None


def ascend(
    layers: Layers, inputs: Float[Tensor, "n c"], tape: list[Level] | None = None
) -> Float[Tensor, "n width"]:
    """The last activations; ``tape`` receives what the way back needs."""
    softness = inputs.new_tensor(layers.softness)
    x = inputs
    for i, (weight, bias) in enumerate(zip(layers.weight, layers.bias, strict=True)):
        entered = _joined(layers, x, inputs) if i == layers.skip else x
        x = linear(entered, weight, bias)
        root = torch.addcmul(softness, x, x).sqrt_()
        x.lerp_(root, 0.5)
        if tape is not None:
            tape.append(Level(entered, x / root, root))
    return x


def descend(
    layers: Layers, tape: list[Level], seed: Float[Tensor, "1 width"]
) -> tuple[Float[Tensor, "n c"], list[Descent]]:
    """Adjoint of the inputs where that of the last activations is ``seed``, and of all between."""
    adjoint, again, below = seed, None, []
    for i in reversed(range(len(tape))):
        below.append(Descent(adjoint, adjoint * tape[i].slope))
        adjoint = below[-1].below @ layers.weight[i]
        if i == layers.skip:
            adjoint, again = _parted(layers, adjoint, seed.shape[-1])
    return adjoint if again is None else adjoint + again, below[::-1]


def pull(
    layers: Layers,
    tape: list[Level],
    last: Float[Tensor, "n width"] | None,
    descent: list[Descent],
    tangent: Float[Tensor, "n c"] | None,
) -> Pulled:
    """Adjoints of all that went into the last activations and, by ``descent``, into their slope.

    last: adjoint of the last activations. tangent: adjoint of the inputs' adjoint, which travels
    forwards through the layers as a tangent does; on its way it bends each layer by x'' =
    softness / (2 root^3).
    """
    entering: list[Tensor] = []
    bent: list[Tensor] = []
    way = tangent
    if tangent is not None and way is not None:
        for i, (level, down) in enumerate(zip(tape, descent, strict=True)):
            entering.append(_joined(layers, way, tangent) if i == layers.skip else way)
            way = linear(entering[-1], layers.weight[i])
            bend = (0.5 * layers.softness) / (level.root * level.root).mul_(level.root)
            bent.append(bend.mul_(way).mul_(down.above))
            way.mul_(level.slope)
    adjoint, again = last, None
    weights: list[Tensor] = []
    for i in reversed(range(len(tape))):
        if adjoint is None:
            at = bent[i]
        elif bent:
            at = torch.addcmul(bent[i], adjoint, tape[i].slope)
        else:
            at = adjoint * tape[i].slope
        weight = at.t() @ tape[i].entered
        if entering:
            weight.addmm_(descent[i].below.t(), entering[i])
        weights += [at.sum(0), weight]
        adjoint = at @ layers.weight[i]
        if i == layers.skip:
            adjoint, again = _parted(layers, adjoint, at.shape[-1])
    assert adjoint is not None
    return Pulled(adjoint if again is None else adjoint + again, weights[::-1], way)


def _joined(layers: Layers, x: Tensor, inputs: Tensor) -> Tensor:
    both = torch.cat([x, inputs], -1)
    return both if layers.share == 1.0 else both.mul_(layers.share)


def _parted(layers: Layers, adjoint: Tensor, width: int) -> tuple[Tensor, Tensor]:
    adjoint = adjoint if layers.share == 1.0 else adjoint.mul_(layers.share)
    return adjoint[:, :width], adjoint[:, width:]


def in_precision(tensors: Iterable[Tensor], like: Tensor) -> list[Tensor]:
    """The same in the precision of ``like``."""
    return [t if t.dtype == like.dtype else t.to(like.dtype) for t in tensors]


def by_autograd(
    plain: Plain,
    inputs: Sequence[Tensor],
    needed: Sequence[bool],
    gradients: Sequence[Tensor | None],
) -> tuple[Tensor | None, ...]:
    """Derivatives that can themselves be differentiated, by a graph of the plain sweep.

    The inputs are taken as if they did not depend on each other, as a node's derivatives must.
    """
    own = [t.view_as(t) for t in inputs]
    pairs = zip(plain(*own), gradients, strict=True)
    answers = [(a, g) for a, g in pairs if g is not None and a.requires_grad]
    wanted = [i for i, need in enumerate(needed) if need]
    found = torch.autograd.grad(
        [a for a, _ in answers],
        [own[i] for i in wanted],
        [g for _, g in answers],
        create_graph=True,
        allow_unused=True,
    )
    at = dict(zip(wanted, found, strict=True))
    return tuple(at.get(i) for i in range(len(own)))


def cast_back(
    gradients: Sequence[Tensor | None], inputs: Sequence[Tensor]
) -> tuple[Tensor | None, ...]:
    """Each gradient in the precision of what it is of."""
    pairs = zip(gradients, inputs, strict=True)
    return tuple(g if g is None or g.dtype == t.dtype else g.to(t.dtype) for g, t in pairs)


class Heads(torch.autograd.Function):
    """Linear heads [n, k] on a network with softness 1 whose skip is not scaled."""

    @staticmethod
    def forward(ctx, skip: int, inputs: Tensor, *weights: Tensor) -> Tensor:
        """weights: (weight, bias) of each layer in turn, and last those of the heads."""
        *hidden, weight, bias = weights
        ctx.layers = Layers.of(hidden, inputs, skip, 1.0, 1.0)
        ctx.skip, ctx.tape, ctx.head = skip, [], weight.to(inputs.dtype)
        ctx.last = ascend(ctx.layers, inputs, ctx.tape)
        ctx.save_for_backward(inputs, *weights)
        return torch.addmm(bias.to(inputs.dtype), ctx.last, ctx.head.t())

    @staticmethod
    def backward(ctx, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (heads,) = gradients
        given = ctx.saved_tensors
        if torch.is_grad_enabled():

            def plain(*own: Tensor) -> tuple[Tensor]:
                return (plain_heads(ctx.skip, *own),)

            return None, *by_autograd(plain, given, ctx.needs_input_grad[1:], gradients)
        pulled = pull(ctx.layers, ctx.tape, heads @ ctx.head, [], None)
        own = [pulled.inputs, *pulled.weights, heads.t() @ ctx.last, heads.sum(0)]
        return None, *cast_back(own, given)


def swept_heads(
    skip: int, inputs: Float[Tensor, "*b c"], *weights: Float[Tensor, "..."]
) -> Float[Tensor, "*b k"]:
    """Linear heads of the network: as one node where a graph is recorded."""
    flat = inputs.reshape(-1, inputs.shape[-1])
    recorded = flat.requires_grad or any(w.requires_grad for w in weights)
    if recorded and torch.is_grad_enabled():
        heads = Heads.apply(skip, flat, *weights)
    else:
        *hidden, weight, bias = (w.to(flat.dtype) for w in weights)
        last = ascend(Layers.of(hidden, flat, skip, 1.0, 1.0), flat)
        heads = torch.addmm(bias, last, weight.t())
    return heads.reshape(inputs.shape[:-1] + heads.shape[1:])


def plain_heads(skip: int, inputs: Tensor, *weights: Tensor) -> Tensor:
    """The same, every operation by itself."""
    *hidden, weight, bias = (w.to(inputs.dtype) for w in weights)
    x = inputs
    for i, (w, b) in enumerate(zip(hidden[::2], hidden[1::2], strict=True)):
        x = torch.cat([x, inputs], -1) if i == skip else x
        x = linear(x, w, b)
        x = 0.5 * (x + (x.square() + 1.0).sqrt())
    return linear(x, weight, bias)
