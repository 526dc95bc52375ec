"""The paper's learned surface (section 4): a network gives m, alpha, phi; transport gives the rest.

One scalar model for TE and TM, without dispersion. What the paper leaves open is closed as follows:
R = exp(-a_out * interaction_length), so the gain of a reflection does not depend on a numerical
step; phi in [-pi/2, pi/2] and Re a >= 0, so nothing amplifies; every boundary crossed carries
sqrt(1 - |R|^2) ("conserving"), unless the paper's literal form is asked for ("paper").

Where diffuse reflection is followed, the share 1 - alpha of |R|^2 leaves by Lambert's law and the
mirror keeps sqrt(alpha) R. Where it is not, the mirror carries the whole of R, as in the paper.
"""

import copy
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor, nn

from rfsg.objects.contract import Contact, Crossing, Shape
from rfsg.objects.physics import transport
from rfsg.objects.physics.lobes import Scattering, share_amplitude
from rfsg.objects.surfaces.interface import (
    Slid,
    at_boundary,
    contact_cosine,
    crossing_direction,
    turned,
)
from rfsg.objects.sweeps import swept_heads

WIDTH = 128  # of the material network, and of the shape's feature h (paper section 5.1)
LAYERS = 8
SKIP = 4  # the layer that sees the inputs again
CHUNK = 16384  # points per network sweep without gradients: bounds memory, and fits a cache
# Heads start at given values; beyond +-40 sigmoid and softplus are at their ends to float64
# rounding.
SATURATION = 40.0
# sqrt(1 - |R|^2) has no slope at |R| = 1; below -120 dB it continues as a line.
PASSED_POWER_FLOOR = 1e-12
INTERFACES = ("conserving", "paper")
_LAMBERT = Scattering(1.0)


class Fields(NamedTuple):
    """What the network says at points: m >= 0, alpha in [0, 1], phi [rad], kappa [Np/m] or None."""

    m: Float[Tensor, "*b"]
    alpha: Float[Tensor, "*b"]
    phi: Float[Tensor, "*b"]
    kappa: Float[Tensor, "*b"] | None

    def each(self, change: Callable[[Tensor], Tensor]) -> "Fields":
        """The same change made to every field there is."""
        kappa = None if self.kappa is None else change(self.kappa)
        return Fields(change(self.m), change(self.alpha), change(self.phi), kappa)


class _Samples(NamedTuple):
    f: Tensor
    gradient: Tensor
    fields: Fields


class _Ends(NamedTuple):
    """Where a crossing enters and leaves: whether it does, its normals (zero where not), |grad f|."""

    boundary: Bool[Tensor, "*b 2"]
    normal: Float[Tensor, "*b 2 3"]
    slope: Float[Tensor, "*b 2"]


class StochasticSurface(nn.Module):
    """A learned material on any shape.

    The fields start constant at ``m``, ``alpha``, ``phi`` [rad] and, if given, ``bulk`` = kappa
    [Np/m] (a true bulk loss, which the paper's sigma lacks; None leaves it out). ``sharpness`` s
    [1/m] and ``interaction_length`` [m] belong to the object and are kept as logarithms.
    ``samples`` is the number of intervals of a crossing. ``law``, ``interface`` and ``integral``
    name the variants. Weights are cast to the dtype of the points: float32 to search, float64 to
    evaluate. Raises ValueError naming the argument at fault.
    """

    kind = "stochastic"
    opaque = False
    splits = False  # whether the diffuse share is followed apart from the mirror's

    def __init__(
        self,
        m: float = 1.0,
        alpha: float = 0.9,
        phi: float = 0.0,
        sharpness: float = 40.0,
        interaction_length: float = 0.05,
        bulk: float | None = None,
        law: str = "logistic",
        interface: str = "conserving",
        integral: str = "telescoped",
        samples: int = 32,
    ):
        super().__init__()
        _require(0 <= m < math.inf, "m", m, "a number >= 0")
        _require(0 <= alpha <= 1, "alpha", alpha, "a number in [0, 1]")
        _require(abs(phi) <= math.pi / 2, "phi", phi, "an angle in [-pi/2, pi/2] rad")
        _require(0 < sharpness < math.inf, "sharpness", sharpness, "a number > 0 [1/m]")
        _require(
            0 < interaction_length < math.inf,
            "interaction_length",
            interaction_length,
            "metres > 0",
        )
        _require(bulk is None or 0 <= bulk < math.inf, "bulk", bulk, "None or Np/m >= 0")
        _require(interface in INTERFACES, "interface", interface, "conserving or paper")
        _require(integral in transport.INTEGRALS, "integral", integral, "telescoped or riemann")
        _require(samples >= 1, "samples", samples, "a number of intervals >= 1")
        self.law = transport.law_named(law)
        self.interface, self.integral, self.samples = interface, integral, samples
        self._start = {"m": m, "alpha": alpha, "phi": phi, "bulk": bulk}
        self.log_sharpness = _scalar(math.log(sharpness))
        self.log_interaction_length = _scalar(math.log(interaction_length))
        self.layers = nn.ModuleList(_layers())
        heads = [_inverse_softplus(m), _logit(alpha), _inverse_phase(phi)]
        heads += [] if bulk is None else [_inverse_softplus(bulk)]
        self.head_weight = nn.Parameter(torch.zeros(len(heads), WIDTH))
        self.head_bias = nn.Parameter(torch.tensor(heads, dtype=torch.float64))

    @property
    def sharpness(self) -> Float[Tensor, ""]:
        """s [1/m]."""
        return self.log_sharpness.exp()

    @property
    def interaction_length(self) -> Float[Tensor, ""]:
        """Length over which a reflection interacts with the object [m]."""
        return self.log_interaction_length.exp()

    def with_numerics(
        self, samples: int, integral: str, diffuse: bool = False
    ) -> "StochasticSurface":
        """The same surface (parameters shared) integrated with so many intervals, by that rule.

        How finely a crossing is integrated is the asker's business, not the material's, and so is
        whether the diffuse share is followed apart from the mirror's.
        """
        _require(integral in transport.INTEGRALS, "integral", integral, "telescoped or riemann")
        _require(samples >= 1, "samples", samples, "a number of intervals >= 1")
        other = copy.copy(self)
        other.samples, other.integral = samples, integral
        other.splits = diffuse
        return other

    def config(self) -> dict:
        """Constructor arguments, JSON-able, without the weights."""
        return {
            **self._start,
            "sharpness": self.sharpness.item(),
            "interaction_length": self.interaction_length.item(),
            "law": self.law.name,
            "interface": self.interface,
            "integral": self.integral,
            "samples": self.samples,
        }

    def fields(
        self,
        shape: Shape,
        point: Float[Tensor, "*b 3"],
        feature: Float[Tensor, "*b h"] | None = None,
    ) -> Fields:
        """m, alpha, phi and kappa at points [m], for reports and regularisation.

        feature: what the shape says of the points, where it has been asked already.
        """
        ask = getattr(shape, "feature", None)
        if feature is None and ask is not None:
            feature = ask(point)
        return self._network(shape, point, feature)

    def reflection(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """R = exp(-a_out * interaction_length), the same for TE and TM; sqrt(alpha) R where the
        diffuse share is followed.

        A vertex a hair inside counts as on the boundary: a_out is taken at max(f, 0).
        """
        whole, alpha = self._whole(shape, contact)
        if self.splits:
            whole = whole * share_amplitude(alpha)
        return _expand(whole, frequency)

    @property
    def scattering(self) -> Scattering | None:
        """Lambert's law for the share 1 - alpha, where that is followed."""
        return _LAMBERT if self.splits else None

    def diffuse(
        self, shape: Shape, contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """sqrt(1 - alpha) R: the amplitude of the diffuse wave in all directions together."""
        whole, alpha = self._whole(shape, contact)
        return _expand(whole * share_amplitude(1.0 - alpha), frequency)

    def _whole(self, shape: Shape, contact: Contact) -> tuple[Tensor, Tensor]:
        """R of all that is reflected, and alpha there."""
        at = self._sample(shape, contact.point)
        m, alpha, phi, _ = at.fields
        slope = transport.gradient_norm(at.gradient)
        mix = transport.sigma_mix(alpha, contact_cosine(contact))
        s = self.sharpness.to(at.f)
        sigma = transport.sigma_outside(self.law, at.f.clamp(min=0.0), slope, m, mix, s)
        a = sigma * transport.phasor(phi)
        return (-self.interaction_length.to(at.f) * a).exp(), alpha

    def transmission(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "*b f 2"]:
        """Whole crossings: boundary, exp(-integral of a), boundary; the same for TE and TM.

        An end whose normal is given lies on f = 0, and f is put to 0 there: that is its value, and
        (the vertex moves with the surface) also its derivative. The same bits from end to start.
        """
        at = self._sample(shape, self._points(crossing))
        ends = _ends(crossing, at.gradient[..., :: self.samples, :])
        pinned = torch.zeros_like(at.f, dtype=torch.bool)
        pinned[..., :: self.samples] = ends.boundary
        at = at._replace(f=at.f.masked_fill(pinned, 0.0))
        direction, sharpness = crossing_direction(crossing), self.sharpness.to(at.f)
        through = (-self._integral(at, crossing, direction, sharpness)).exp()
        if self.interface == "conserving":
            through = through * self._passed(at, ends, direction, sharpness)
        return _expand(through, frequency)

    def excess_delay(
        self, shape: Shape, crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "*b f"]:
        """Zero [s]: the model has no dispersion."""
        point = crossing.start
        return point.new_zeros(*point.shape[:-1], len(frequency))

    def _points(self, crossing: Crossing) -> Tensor:
        """Sample points along crossings; from end to start they are the same, to the bit."""
        weight = torch.linspace(0, 1, self.samples + 1, dtype=torch.float64)
        weight = weight.to(crossing.start)[:, None]
        start, end = crossing.start[..., None, :], crossing.end[..., None, :]
        return start * weight.flip(0) + end * weight

    def _integral(
        self, at: _Samples, crossing: Crossing, direction: Tensor, sharpness: Tensor
    ) -> Tensor:
        length = ((crossing.end - crossing.start) * direction).sum(-1)
        return transport.INTEGRALS[self.integral](
            self.law,
            at.f,
            at.gradient,
            at.fields.m,
            at.fields.alpha,
            at.fields.phi,
            sharpness,
            direction,
            length / self.samples,
            at.fields.kappa,
        )

    def _passed(self, at: _Samples, ends: _Ends, direction: Tensor, sharpness: Tensor) -> Tensor:
        """Product of sqrt(1 - |R|^2) over the ends that lie on the boundary."""
        m, alpha, phi, _ = at.fields.each(lambda field: field[..., :: self.samples])
        cosine = (direction[..., None, :] * ends.normal).sum(-1).clamp(-1.0, 1.0)
        mix = transport.sigma_mix(alpha, cosine)
        sigma = transport.sigma_at_face(self.law, ends.slope, m, mix, sharpness)
        depth = sigma * self.interaction_length.to(sigma) * transport.in_phase(phi)
        amplitude = _amplitude(-torch.expm1(-2 * depth))
        first, last = amplitude.masked_fill(~ends.boundary, 1.0).unbind(-1)
        return first * last

    def _sample(self, shape: Shape, point: Tensor) -> _Samples:
        """f, its gradient and the fields at points; in chunks where no gradient is asked for."""
        flat = point.reshape(-1, 3)
        chunks = (flat,) if torch.is_grad_enabled() else flat.split(CHUNK)
        parts = [self._sweep(shape, chunk) for chunk in chunks]
        batch = point.shape[:-1]
        whole = parts[0] if len(parts) == 1 else _whole(parts)
        fields = whole.fields.each(lambda field: field.reshape(batch))
        return _Samples(whole.f.reshape(batch), whole.gradient.reshape(*batch, 3), fields)

    def _sweep(self, shape: Shape, point: Tensor) -> _Samples:
        fused = getattr(shape, "value_gradient_feature", None)
        if fused is not None:
            f, gradient, feature = fused(point)
            return _Samples(f, gradient, self._network(shape, point, feature))
        f, gradient = shape.value_and_gradient(point)
        return _Samples(f, gradient, self.fields(shape, point))

    def _network(self, shape: Shape, point: Tensor, feature: Tensor | None) -> Fields:
        """The heads at points; a shape without features counts as h = 0, and costs nothing."""
        inputs = _normalised(shape, point)
        if feature is not None:
            if feature.shape[-1] != WIDTH:
                raise ValueError(
                    f"stochastic surface: expected {WIDTH} features from the {shape.kind} shape, "
                    f"got {feature.shape[-1]}: it was made with another number of features"
                )
            inputs = torch.cat([inputs, feature.to(point.dtype)], -1)
        weights = [*_weights(self.layers, inputs.shape[-1]), self.head_weight, self.head_bias]
        heads = swept_heads(SKIP, inputs, *weights).unbind(-1)
        m, alpha = nn.functional.softplus(heads[0]), torch.sigmoid(heads[1])
        phi = 0.5 * math.pi * torch.tanh(heads[2])
        return Fields(m, alpha, phi, None if len(heads) < 4 else nn.functional.softplus(heads[3]))


def _layers() -> list[nn.Linear]:
    """Eight layers of 128; inputs (x, h), given again at the skip. Spread kept by He's rule."""
    inputs = 3 + WIDTH
    widths = [inputs] + [WIDTH + inputs if i == SKIP else WIDTH for i in range(1, LAYERS)]
    layers = [nn.Linear(width, WIDTH) for width in widths]
    for layer in layers:
        nn.init.normal_(layer.weight, std=math.sqrt(2 / layer.in_features))
        nn.init.zeros_(layer.bias)
    return layers


def _weights(layers: nn.ModuleList, inputs: int) -> Iterator[Tensor]:
    """(weight, bias) of each layer in turn; what a missing h, which stands last, would have met is
    left out."""
    for i, layer in enumerate(layers):
        assert isinstance(layer, nn.Linear)
        seen = inputs + WIDTH * (i == SKIP) if i in (0, SKIP) else WIDTH
        yield layer.weight if layer.in_features == seen else layer.weight[:, :seen]
        yield layer.bias


def _normalised(shape: Shape, point: Tensor) -> Tensor:
    """Points in half diagonals of the object about its middle; metres if it has no bounds."""
    low, high = shape.bounds().to(point)
    half = 0.5 * (high - low).norm()
    return (point - 0.5 * (low + high)) / half if 0 < float(half.detach()) < math.inf else point


def _whole(parts: list[_Samples]) -> _Samples:
    fields = [part.fields for part in parts]
    m, alpha, phi = (torch.cat([field[:3][i] for field in fields]) for i in range(3))
    kappa = [field.kappa for field in fields if field.kappa is not None]
    return _Samples(
        torch.cat([part.f for part in parts]),
        torch.cat([part.gradient for part in parts]),
        Fields(m, alpha, phi, torch.cat(kappa) if kappa else None),
    )


def _ends(crossing: Crossing, gradient: Float[Tensor, "*b 2 3"]) -> _Ends:
    """Where a crossing enters and leaves; gradient: of f there."""
    normal = torch.stack([crossing.normal_start, crossing.normal_end], -2)
    boundary, slope = at_boundary(normal), transport.gradient_norm(gradient)
    if isinstance(crossing, Slid):
        normal = turned(normal, gradient, slope)
    return _Ends(boundary, normal, slope)


def _amplitude(power: Tensor) -> Tensor:
    """sqrt of a power in [0, 1], with a finite slope at 0."""
    line = power / math.sqrt(PASSED_POWER_FLOOR)
    return torch.where(power < PASSED_POWER_FLOOR, line, power.clamp(min=PASSED_POWER_FLOOR).sqrt())


def _expand(x: Tensor, frequency: Tensor) -> Tensor:
    return x[..., None, None].expand(*x.shape, len(frequency), 2)


def _scalar(value: float) -> nn.Parameter:
    return nn.Parameter(torch.tensor(value, dtype=torch.float64))


def _inverse_softplus(value: float) -> float:
    if value > SATURATION:
        return value
    return math.log(math.expm1(value)) if value > math.exp(-SATURATION) else -SATURATION


def _logit(value: float) -> float:
    if value in (0.0, 1.0):
        return SATURATION if value else -SATURATION
    return min(max(math.log(value / (1 - value)), -SATURATION), SATURATION)


def _inverse_phase(value: float) -> float:
    ratio = value / (math.pi / 2)
    return math.atanh(ratio) if abs(ratio) < 1 else math.copysign(0.5 * SATURATION, ratio)


def _require(condition: bool, name: str, got: object, expected: str) -> None:
    if not condition:
        raise ValueError(f"stochastic surface: {name}: expected {expected}, got {got!r}")
