"""The paper's neural shape: a network whose value is the mean implicit function f.

Section 5 of the paper: 3 coordinates, encoded with 6 frequencies, through 8 layers of 64 with a
skip connection, to f [m] and a 128-vector h that describes the neighbourhood to the material.

Two things differ from the usual code for such a network. The activation is squareplus,
(x + sqrt(x^2 + b)) / 2 (Barron 2021): smooth, so that curvature exists, and a third of the price of
softplus on a CPU. And value, gradient and Hessian are swept by hand instead of by autograd, so that
they cost about 1, 2 and 6 evaluations, work without a graph, and can still be differentiated: value,
gradient and features as one node (``sweeps``), the Hessian by a graph of all that it is made of.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from rfsg.objects.contract import Jet
from rfsg.objects.shapes.sweeps import SHARE, Question, ShapeSweep, answer

# Points of a core and sweep when no gradients are recorded: what 2048 leave on the way, 5 MB, stays in
# its cache; a GPU wants many more.
CPU_CHUNK, GPU_CHUNK = 2_048, 262_144


class NeuralShape(nn.Module):
    """f(x) by a network, in metres, trusted within ``bounds``.

    Weights are float32; the dtype of the points decides the precision of an answer. ``bounds`` is
    [[x, y, z] low, [x, y, z] high] in metres and also fixes the network's own coordinates, which
    reach from -1 to 1 along the longest side. A new network is about a sphere of half that reach.

    lipschitz: bound on |grad f| within bounds; measured (``compute_lipschitz``) when not given. It
    must be measured again after the weights have changed.
    Raises ValueError for bounds that are not a finite box, or sizes that are not a network.
    """

    kind = "neural"
    convex = False
    faceted = False
    exact = False
    folder: str | None = None  # that of the file it was read from
    _bounds: Tensor
    _centre: Tensor
    _reach: Tensor
    _octaves: Tensor

    def __init__(
        self,
        bounds: Sequence[Sequence[float]] | Tensor,
        *,
        width: int = 64,
        depth: int = 8,
        skip: int = 4,
        frequencies: int = 6,
        features: int = 128,
        softness: float = 1e-3,
        lipschitz: float | None = None,
        seed: int = 0,
    ):
        super().__init__()
        box = torch.as_tensor(bounds, dtype=torch.float64).detach().clone()
        if tuple(box.shape) != (2, 3) or not bool((box[0] < box[1]).all() & box.isfinite().all()):
            raise ValueError(
                f"NeuralShape bounds={bounds!r}: expected a finite box [[low], [high]]"
            )
        sizes = {"width": width, "features": features, "frequencies": frequencies}
        if min(sizes.values()) < 1 or not 0 < skip < depth or not softness > 0:
            raise ValueError(
                f"NeuralShape {sizes}, depth={depth}, skip={skip}, softness={softness}: expected "
                "positive sizes, 0 < skip < depth and softness > 0"
            )
        self.width, self.depth, self.skip = width, depth, skip
        self.frequencies, self.features, self.softness = frequencies, features, softness
        self.register_buffer("_bounds", box, persistent=False)
        self.register_buffer("_centre", box.mean(0), persistent=False)
        self.register_buffer("_reach", (box[1] - box[0]).max() / 2, persistent=False)
        octaves = math.pi * 2.0 ** torch.arange(frequencies, dtype=torch.float64)
        self.register_buffer("_octaves", octaves, persistent=False)
        encoded = 3 + 6 * frequencies
        inputs = [encoded] + [width + encoded * (i == skip) for i in range(1, depth)]
        self.hidden = nn.ModuleList([nn.Linear(n, width) for n in inputs])
        self.to_value = nn.Linear(width, 1)
        self.to_feature = nn.Linear(width, features)
        self._start_as_sphere(seed)
        self.lipschitz = compute_lipschitz(self) if lipschitz is None else float(lipschitz)

    def config(self) -> dict[str, object]:
        """Constructor arguments, ready for JSON."""
        names = "width depth skip frequencies features softness lipschitz".split()
        sizes: dict[str, object] = {name: getattr(self, name) for name in names}
        return {"bounds": self._bounds.tolist()} | sizes

    def bounds(self) -> Float[Tensor, "2 3"]:
        return self._bounds

    def sdf(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Mean implicit function f [m], negative inside."""
        (value,) = self._answers(point, value=True)
        return value

    def feature(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b h"]:
        """The vector h that describes the neighbourhood of a point to the material network."""
        (feature,) = self._answers(point, feature=True)
        return feature

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """f [m] and its gradient [1] by one reverse sweep."""
        value, gradient = self._answers(point, value=True, gradient=True)
        return value, gradient

    def value_gradient_feature(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"], Float[Tensor, "*b h"]]:
        """f [m], its gradient [1] and h in one sweep."""
        value, gradient, feature = self._answers(point, value=True, gradient=True, feature=True)
        return value, gradient, feature

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        """f to second order: Hessian = sum over layers of J^T diag(adjoint * activation'') J."""
        weights = self._parameters_in_turn()
        return Jet(*_in_chunks(lambda flat: self._jet(flat, _Weights(self, weights, flat)), point))

    def normal_at(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Unit vector along the gradient; zero where the gradient is zero."""
        _, gradient = self.value_and_gradient(point)
        square = (gradient * gradient).sum(-1, keepdim=True)
        flat = square == 0
        length = torch.where(flat, torch.ones_like(square), square).sqrt()
        return torch.where(flat, torch.zeros_like(gradient), gradient / length)

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        raise NotImplementedError(
            "a neural shape is not convex: march it within its bounds instead"
        )

    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        """Face of the normal (-x, +x, ... +z: 0 to 5) + 6 x cell of a 3x3x3 grid in the bounds."""
        _, gradient = self.value_and_gradient(point)
        axis = gradient.abs().argmax(-1, keepdim=True)
        face = (2 * axis + (gradient.gather(-1, axis) > 0)).squeeze(-1)
        low, high = self._bounds.to(point)
        x, y, z = (3 * (point - low) / (high - low)).long().clamp(0, 2).unbind(-1)
        return face + 6 * (9 * x + 3 * y + z)

    def planes(self) -> Float[Tensor, "0 4"]:
        return self._bounds.new_zeros(0, 4)

    def _start_as_sphere(self, seed: int) -> None:
        """Geometric start (Atzmon & Lipman 2020): norms pass through, the sines are silent."""
        generator = torch.Generator().manual_seed(seed)
        spread = math.sqrt(2 / self.width)
        sines = 6 * self.frequencies
        for i, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            nn.init.normal_(layer.weight, 0.0, spread, generator=generator)
            nn.init.zeros_(layer.bias)
            if i in (0, self.skip):
                nn.init.zeros_(layer.weight[:, -sines:])
        mean = math.sqrt(math.pi / self.width)
        nn.init.normal_(self.to_value.weight, mean, 1e-4, generator=generator)
        nn.init.zeros_(self.to_value.bias)
        nn.init.normal_(self.to_feature.weight, 0.0, 1 / math.sqrt(self.width), generator=generator)
        nn.init.zeros_(self.to_feature.bias)
        self._calibrate(generator)

    @torch.no_grad()
    def _calibrate(self, generator: torch.Generator) -> None:
        """Scale the last layer: on the sphere of half reach f is 0, its slope 1, on average.

        The initialisation above is exact for ReLU and endless width only.
        """
        outward = F.normalize(torch.randn(512, 3, generator=generator).to(self._bounds), dim=-1)
        value, gradient = self.value_and_gradient(self._centre + 0.5 * self._reach * outward)
        slope = (gradient * outward).sum(-1).mean()
        self.to_value.weight.div_(slope)
        self.to_value.bias.sub_(value.mean() / self._reach / slope)

    def _answers(
        self, point: Tensor, *, value: bool = False, gradient: bool = False, feature: bool = False
    ) -> tuple[Tensor, ...]:
        """What is asked of any batch of points: as one node where a graph is recorded."""
        weights = self._parameters_in_turn()
        asked = Question(
            self.skip,
            self.softness,
            self._centre.to(point.dtype),
            self._reach.to(point.dtype),
            self._octaves.to(point.dtype),
            value,
            gradient,
            feature,
        )
        flat = point.reshape(-1, 3)
        recorded = point.requires_grad or any(w.requires_grad for w in weights)
        if recorded and torch.is_grad_enabled():
            parts = ShapeSweep.apply(partial(self._plain, asked), asked, flat, *weights)
        else:
            parts = answer(asked, flat, weights, _chunk(flat))
        return _reshaped(parts, point)

    def _parameters_in_turn(self) -> list[Tensor]:
        """(weight, bias) of each hidden layer, of the value and of the features."""
        layers = [*self.hidden, self.to_value, self.to_feature]
        return [t for layer in layers for t in (layer.weight, layer.bias)]

    def _plain(self, asked: Question, point: Tensor, *weights: Tensor) -> tuple[Tensor, ...]:
        """What is asked, every operation by itself: ``answer`` for derivatives of any order."""
        w = _Weights(self, weights, point)
        encoded, sine, cosine = self._encode(point, w)
        tape: list[tuple[Tensor, Tensor]] = []
        last = self._forward(encoded, w, tape)
        answers = [w.value(last)] if asked.value else []
        if asked.gradient:
            adjoint, _ = self._reverse(tape, w)
            answers.append(_encoding_slope(adjoint, sine, cosine, w.octaves))
        if asked.feature:
            answers.append(F.linear(last, *w.feature))
        return tuple(answers)

    def _jet(self, point: Tensor, w: "_Weights") -> tuple[Tensor, Tensor, Tensor]:
        encoded, sine, cosine = self._encode(point, w)
        tape: list[tuple[Tensor, Tensor]] = []
        last = self._forward(encoded, w, tape)
        adjoint, back = self._reverse(tape, w)
        gradient = _encoding_slope(adjoint, sine, cosine, w.octaves)
        bend = _encoding_bend(adjoint, sine, cosine, w.octaves)
        tangent = first = _encoding_tangent(sine, cosine, w.octaves)
        for i, (weight, _) in enumerate(w.hidden):
            if i == self.skip:
                tangent = torch.cat([tangent, first], -1) * SHARE
            tangent = tangent @ weight.mT
            slope, root = tape[i]
            curved = back[i] * (0.5 * self.softness) / (root * root * root)
            bend = bend + (tangent * curved[:, None]) @ tangent.mT
            tangent = tangent * slope[:, None]
        return w.value(last), gradient, bend / w.reach

    def _encode(self, point: Tensor, w: "_Weights") -> tuple[Tensor, Tensor, Tensor]:
        """(coordinates, sines, cosines) [n, 3 + 6 k], and the sines and cosines [n, 3, k]."""
        own = (point - w.centre) / w.reach
        phase = own[..., None] * w.octaves
        sine, cosine = phase.sin(), phase.cos()
        return torch.cat([own, sine.flatten(1), cosine.flatten(1)], -1), sine, cosine

    def _forward(self, encoded: Tensor, w: "_Weights", tape: list[tuple[Tensor, Tensor]]) -> Tensor:
        """Last hidden activations; ``tape`` receives (activation', sqrt(x^2 + b)) of each layer."""
        x = encoded
        for i, (weight, bias) in enumerate(w.hidden):
            if i == self.skip:
                x = torch.cat([x, encoded], -1) * SHARE
            x = F.linear(x, weight, bias)
            root = torch.addcmul(w.softness, x, x).sqrt()
            x = torch.lerp(x, root, 0.5)
            tape.append((x / root, root))
        return x

    def _reverse(
        self, tape: list[tuple[Tensor, Tensor]], w: "_Weights"
    ) -> tuple[Tensor, list[Tensor]]:
        """Adjoint of the encoding, and of each layer's activations, for the value per reach."""
        adjoint = w.value_weight.expand(len(tape[0][0]), -1)
        encoded: Tensor | float = 0.0
        back: list[Tensor] = []
        for i in reversed(range(self.depth)):
            back.append(adjoint)
            adjoint = (adjoint * tape[i][0]) @ w.hidden[i][0]
            if i == self.skip:
                adjoint = adjoint * SHARE
                encoded = adjoint[:, self.width :]
                adjoint = adjoint[:, : self.width]
        return adjoint + encoded, back[::-1]


class _Weights:
    """A network's weights in the precision of the points, cast once per call."""

    def __init__(self, shape: NeuralShape, weights: Sequence[Tensor], like: Tensor):
        cast = [t.to(like.dtype) for t in weights]
        pairs = list(zip(cast[::2], cast[1::2], strict=True))
        *self.hidden, (self.value_weight, self.value_bias), self.feature = pairs
        self.centre, self.reach = shape._centre.to(like.dtype), shape._reach.to(like.dtype)
        self.octaves = shape._octaves.to(like.dtype)
        self.softness = like.new_tensor(shape.softness)

    def value(self, last: Tensor) -> Tensor:
        return F.linear(last, self.value_weight, self.value_bias).squeeze(-1) * self.reach


def _in_chunks(sweep: Callable[[Tensor], tuple[Tensor, ...]], point: Tensor) -> tuple[Tensor, ...]:
    """Run a sweep over any batch of points, in chunks where no graph is recorded."""
    flat = point.reshape(-1, 3)
    chunk = _chunk(flat)
    if torch.is_grad_enabled() or len(flat) <= chunk:
        parts = sweep(flat)
    else:
        pieces = [sweep(piece) for piece in flat.split(chunk)]
        parts = tuple(torch.cat(column) for column in zip(*pieces, strict=True))
    return _reshaped(parts, point)


def _chunk(flat: Tensor) -> int:
    return CPU_CHUNK * torch.get_num_threads() if flat.device.type == "cpu" else GPU_CHUNK


def _reshaped(parts: tuple[Tensor, ...], point: Tensor) -> tuple[Tensor, ...]:
    return tuple(part.reshape(point.shape[:-1] + part.shape[1:]) for part in parts)


def _split(adjoint: Tensor, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Adjoint of the encoding as that of its coordinates [n, 3], sines and cosines [n, 3, k]."""
    own, rest = adjoint[:, :3], adjoint[:, 3:]
    to_sine, to_cosine = rest.chunk(2, -1)
    return own, to_sine.reshape(like.shape), to_cosine.reshape(like.shape)


def _encoding_slope(adjoint: Tensor, sine: Tensor, cosine: Tensor, octaves: Tensor) -> Tensor:
    own, to_sine, to_cosine = _split(adjoint, sine)
    return own + ((to_sine * cosine - to_cosine * sine) * octaves).sum(-1)


def _encoding_bend(adjoint: Tensor, sine: Tensor, cosine: Tensor, octaves: Tensor) -> Tensor:
    _, to_sine, to_cosine = _split(adjoint, sine)
    return torch.diag_embed(-((to_sine * sine + to_cosine * cosine) * octaves * octaves).sum(-1))


def _encoding_tangent(sine: Tensor, cosine: Tensor, octaves: Tensor) -> Tensor:
    """Derivative of the encoding along each coordinate, [n, 3, 3 + 6 k]."""
    eye = torch.eye(3, dtype=sine.dtype, device=sine.device)
    along_sine = eye[..., None] * (cosine * octaves)[:, None]
    along_cosine = eye[..., None] * (-sine * octaves)[:, None]
    own = eye.expand(len(sine), 3, 3)
    return torch.cat([own, along_sine.flatten(2), along_cosine.flatten(2)], -1)


def compute_lipschitz(
    shape: NeuralShape,
    samples: int = 16_384,
    climb_steps: int = 24,
    margin: float = 1.25,
    seed: int = 0,
) -> float:
    """A tested bound on |grad f| within the bounds [1]: the steepest found, times ``margin``.

    Half the samples fill the box, half are drawn to the surface (one Newton step); the 128 steepest
    then climb |grad f| along its own gradient, H grad f / |grad f|. Not a proof: formal bounds of
    such a network are useless at practical cell sizes.
    """
    with torch.no_grad():
        low, high = shape.bounds().float()
        generator = torch.Generator().manual_seed(seed)
        point = low + (high - low) * torch.rand(samples, 3, generator=generator).to(low)
        value, gradient = shape.value_and_gradient(point)
        near = slice(0, samples // 2)
        square = (gradient[near] ** 2).sum(-1).clamp(min=torch.finfo(point.dtype).tiny)
        toward = value[near] / square
        step = (toward[:, None] * gradient[near]).clamp(low - high, high - low)
        point[near] = (point[near] - step).clamp(low, high)
        slope = shape.value_and_gradient(point)[1].norm(dim=-1)
        steepest, order = slope.topk(min(128, samples))
        best = steepest.max()
        point, stride = point[order], 0.01 * (high - low).max()
        for _ in range(climb_steps):
            jet = shape.jet(point)
            uphill = (jet.hessian @ jet.gradient[..., None]).squeeze(-1)
            point = (point + stride * F.normalize(uphill, dim=-1)).clamp(low, high)
            best = torch.maximum(best, shape.value_and_gradient(point)[1].norm(dim=-1).max())
            stride = stride * 0.8
    return margin * float(best)
