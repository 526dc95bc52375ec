"""Diffuse reflection of known materials: how much of a reflected wave scatters, and where to.

The effective roughness model of Degli-Esposti, Fuschini, Vitucci and Falciasecca, "Measurement and
modelling of scattering from buildings", IEEE Trans. Antennas Propag. 55(1), 2007. A share S^2 of the
reflected power |R|^2 leaves diffusely and the mirror keeps 1 - S^2; the diffuse power leaves by a lobe
p [1/sr] about the outward normal n:

    lambertian      p = cos(theta_s) / pi
    directive       p = ((1 + cos psi_R) / 2)^alpha_R / F
    backscattering  p = [L ((1 + cos psi_R) / 2)^alpha_R + (1 - L) ((1 + cos psi_i) / 2)^alpha_i] / F

psi_R is the angle to the mirror direction, psi_i the angle back to where the wave came from. F makes
the integral of p over the hemisphere 1 at every incidence: L F_alphaR + (1 - L) F_alphai with

    F_alpha = 2^-alpha sum_k C(alpha, k) I_k,
    I_k = 2 pi / (k + 1) * { 1 (k even);  cos(theta_i) sum_{w <= (k-1)/2} C(2w, w) (sin(theta_i) / 2)^2w }.

Only the Lambertian lobe is reciprocal (Vitucci et al., "A reciprocal heuristic model for diffuse
scattering from walls and surfaces", 2023, arXiv:2209.12685), and that only where |R| is the same at
both angles.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

LOBES = {
    "lambertian": (),
    "directive": ("alpha_r",),
    "backscattering": ("alpha_r", "alpha_i", "forward_share"),
}
STEEPEST = 128  # greatest alpha; a lobe of 7 degrees
MIRROR_FLOOR = 1e-12  # power 1 - S^2 below which its root goes on as a line, with a finite slope


class Scattering(nn.Module):
    """How a rough surface scatters: S, the lobe, and K_x.

    coefficient: S in [0, 1], a frozen parameter until someone asks for its gradient. lobe: a key of
    ``LOBES``, with the numbers it takes: alpha_r and alpha_i, whole and >= 1 (greater is narrower),
    forward_share L in [0, 1]. cross_share: K_x in [0, 1], the share of the diffuse power that leaves
    in the orthogonal polarisation, so that XPD = 10 log10((1 - K_x) / K_x). Raises ValueError naming
    the argument at fault.
    """

    def __init__(
        self,
        coefficient: float,
        lobe: str = "lambertian",
        alpha_r: int | None = None,
        alpha_i: int | None = None,
        forward_share: float | None = None,
        cross_share: float = 0.0,
    ):
        super().__init__()
        _require(_is_share(coefficient), "coefficient", coefficient, "a number in [0, 1]")
        _require(lobe in LOBES, "lobe", lobe, f"one of {', '.join(LOBES)}")
        _require(_is_share(cross_share), "cross_share", cross_share, "a number in [0, 1]")
        numbers = {"alpha_r": alpha_r, "alpha_i": alpha_i, "forward_share": forward_share}
        for name, value in numbers.items():
            if name not in LOBES[lobe]:
                _require(value is None, name, value, f"nothing with a {lobe} lobe")
            elif name == "forward_share":
                _require(_is_share(value), name, value, "a number in [0, 1]")
            else:
                fine = isinstance(value, int) and 1 <= value <= STEEPEST
                _require(fine, name, value, f"a whole number from 1 to {STEEPEST}")
        self.lobe, self.cross_share = lobe, float(cross_share)
        self._numbers = {n: v for n, v in numbers.items() if v is not None}
        forward = 1.0 if forward_share is None else float(forward_share)
        # (share, alpha, +1 about the mirror direction or -1 back towards the source)
        pieces = [(forward, alpha_r, 1.0), (1.0 - forward, alpha_i, -1.0)]
        self._pieces = [(s, a, d) for s, a, d in pieces if a is not None and s > 0]
        value = torch.tensor(float(coefficient), dtype=torch.float64)
        self.coefficient = nn.Parameter(value, requires_grad=False)

    @staticmethod
    def of(given: "Scattering | Mapping[str, Any] | None") -> "Scattering | None":
        """As it is, or made from what ``config`` wrote."""
        return Scattering(**given) if isinstance(given, Mapping) else given

    def config(self) -> dict[str, Any]:
        """Constructor arguments, JSON-able, as they are now."""
        return {
            "coefficient": self.coefficient.item(),
            "lobe": self.lobe,
            **self._numbers,
            "cross_share": self.cross_share,
        }

    @property
    def active(self) -> bool:
        """Whether anything scatters, or may come to in a fit."""
        return self.coefficient.requires_grad or self.coefficient.item() > 0

    @property
    def width(self) -> float:
        """Angle over which the lobe changes [rad]: 1 for Lambertian, sqrt(2 / alpha) for narrow ones."""
        return min([1.0, *(math.sqrt(2.0 / alpha) for _, alpha, _ in self._pieces)])

    def diffuse_amplitude(self) -> Float[Tensor, ""]:
        """S. A fit may step over the edge of what is passive; the surface does not."""
        return self.coefficient.clamp(0.0, 1.0)

    def mirror_amplitude(self) -> Float[Tensor, ""]:
        """sqrt(1 - S^2), what the mirror keeps; its slope stays finite at S = 1."""
        return share_amplitude(1.0 - self.diffuse_amplitude().square())

    def density(
        self,
        incoming: Float[Tensor, "*b 3"],
        outgoing: Float[Tensor, "*b 3"],
        normal: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b"]:
        """p [1/sr] of unit directions of travel; 0 for what arrives or leaves behind the surface."""
        height = (outgoing * normal).sum(-1)
        cosine = -(incoming * normal).sum(-1)
        lit = (height > 0) & (cosine > 0)
        if not self._pieces:
            return torch.where(lit, height / math.pi, torch.zeros_like(height))
        total, norm = torch.zeros_like(height), torch.zeros_like(height)
        for share, alpha, way in self._pieces:
            total = total + share * _lobe(self._axis(incoming, normal, way), outgoing, alpha)
            norm = norm + share * normalisation(alpha, cosine.clamp(0.0, 1.0))
        return torch.where(lit, total / norm, torch.zeros_like(total))

    def draw(
        self,
        incoming: Float[Tensor, "m 3"],
        normal: Float[Tensor, "m 3"],
        uniform: Float[Tensor, "m 4"],
    ) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m"]]:
        """Directions drawn from the lobe by numbers in [0, 1), and the weight p / q of each draw.

        Lambertian: the cosine law, weight 1 (the unit sphere set on the surface). Others: q is the
        lobe over the whole sphere, so what falls below the surface weighs 0; the mean weight is 1.
        """
        z = 2.0 * uniform[:, 0] - 1.0
        r, angle = torch.sqrt((1.0 - z) * (1.0 + z)), 2.0 * math.pi * uniform[:, 1]
        ball = torch.stack([r * torch.cos(angle), r * torch.sin(angle), z], -1)
        if not self._pieces:
            out = _unit(normal + ball)
            return out, ((out * normal).sum(-1) > 0).to(out.dtype)
        axis, alpha = self._choose(incoming, normal, uniform[:, 2])
        height = 2.0 * uniform[:, 3] ** (1.0 / (alpha + 1.0)) - 1.0
        around = _unit(ball - (ball * axis).sum(-1, keepdim=True) * axis)
        wide = torch.sqrt(((1.0 - height) * (1.0 + height)).clamp(min=0.0))
        out = height[:, None] * axis + wide[:, None] * around
        drawn = torch.zeros_like(height)
        for share, a, way in self._pieces:
            law = (a + 1) / (4.0 * math.pi) * _lobe(self._axis(incoming, normal, way), out, a)
            drawn = drawn + share * law
        return out, self.density(incoming, out, normal) / drawn.clamp(min=1e-300)

    def _choose(self, incoming: Tensor, normal: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """Axis and alpha of one of the lobes, each by its share."""
        share, alpha, way = self._pieces[0]
        axis, power = self._axis(incoming, normal, way), torch.full_like(uniform, float(alpha))
        if len(self._pieces) > 1:
            _, alpha, way = self._pieces[1]
            other = uniform >= share
            axis = torch.where(other[:, None], self._axis(incoming, normal, way), axis)
            power = torch.where(other, float(alpha), power)
        return axis, power

    @staticmethod
    def _axis(incoming: Tensor, normal: Tensor, way: float) -> Tensor:
        return mirrored(incoming, normal) if way > 0 else -incoming


def mirrored(
    direction: Float[Tensor, "*b 3"], normal: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 3"]:
    """The direction after a mirror."""
    return direction - 2.0 * (direction * normal).sum(-1, keepdim=True) * normal


def share_amplitude(power: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """sqrt of a share of power in [0, 1], with a finite slope at 0."""
    line = power / math.sqrt(MIRROR_FLOOR)
    return torch.where(power < MIRROR_FLOOR, line, power.clamp(min=MIRROR_FLOOR).sqrt())


def normalisation(alpha: int, cosine: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """F_alpha: the integral of ((1 + cos psi) / 2)^alpha over the hemisphere [sr], of a lobe whose
    axis stands at ``cosine`` in [0, 1] to the normal."""
    even, odd = _series(alpha)
    square = (1.0 - cosine) * (1.0 + cosine)
    total = torch.zeros_like(cosine)
    for term in reversed(odd):
        total = total * square + term
    return even + cosine * total


@lru_cache(maxsize=64)
def _series(alpha: int) -> tuple[float, tuple[float, ...]]:
    """F_alpha = even + cos(theta) sum_w odd_w sin^2w(theta): every term positive, nothing cancels."""
    term = [2.0 * math.pi / (k + 1) * math.comb(alpha, k) / 2.0**alpha for k in range(alpha + 1)]
    odd = tuple(
        math.comb(2 * w, w) / 4.0**w * sum(term[2 * w + 1 :: 2]) for w in range((alpha + 1) // 2)
    )
    return sum(term[::2]), odd


def _lobe(axis: Tensor, outgoing: Tensor, alpha: int) -> Tensor:
    return (0.5 * (1.0 + (axis * outgoing).sum(-1)).clamp(min=0.0)) ** alpha


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm(dim=-1, keepdim=True).clamp(min=1e-300)


def _is_share(value: Any) -> bool:
    return isinstance(value, (int, float)) and 0 <= value <= 1


def _require(condition: bool, name: str, got: object, expected: str) -> None:
    if not condition:
        raise ValueError(f"scattering: {name}: expected {expected}, got {got!r}")
