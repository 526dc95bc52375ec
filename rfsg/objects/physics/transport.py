"""Exponential transport through a stochastic object (paper section 4, Eqs. 13-19 and 23).

With the mean implicit function f [m] (negative inside), the sharpness s [1/m] and u = s f, a law
gives

    occupancy o = Psi(-u),  vacancy v = Psi(u),  hazard H(u) = psi(u) / Psi(-u) = -d ln o / du.

The attenuation coefficient a = sigma e^{j phi} [1/m] of a wave travelling along omega is

    inside   sigma_in  = (m o + 1) s H(u)  |grad f| sigma_mix      (Eqs. 13, 15, 19)
    outside  sigma_out = (m v + 1) s H(-u) |grad f| sigma_mix      (Eq. 14)
    sigma_mix = alpha |omega . n| + (1 - alpha) / 2                (Eq. 16)

and a straight stretch transmits exp(-integral of a dt).

**Telescoping.** Along a stretch du/dt = s omega . grad f, so s H |grad f| |omega . n| dt = |d ln o|
and s H o |grad f| |omega . n| dt = |do|. The anisotropic share of an interval between two samples
is therefore alpha (m |delta o| + |delta ln o|): exact on every monotone stretch for one alpha and
m, whatever s, the step or the angle, and free of any division. The isotropic share needs the means
of H and o H over the interval; with u linear in between they are the divided differences of -ln o
and of v, which again do not care how steep the boundary is.

Pure functions, no state. Real inputs of one dtype; complex results of the matching precision.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor
from torch.nn.functional import logsigmoid

# From here on the Gaussian tail is its asymptotic series: eight terms leave 3e-15 of relative
# error, while the gradient of torch's log_ndtr has lost all digits by u = 1e3 in float32.
GAUSSIAN_TAIL = 20.0
_TAIL_SERIES = (-1.0, 3.0, -15.0, 105.0, -945.0, 10395.0, -135135.0)  # (-1)^n (2n - 1)!!
# Below this |u1 - u0| a divided difference loses digits, and three Gauss nodes are exact to 1e-13.
DIVIDED_DIFFERENCE_MIN = 0.125
_GAUSS_NODE = 0.5 * math.sqrt(3 / 5)  # three nodes on [-1/2, 1/2], weights 5/18, 8/18, 5/18


@dataclass(frozen=True)
class Law:
    """A symmetric distribution of the implicit field (Eqs. 17-18), elementwise in u = s f."""

    name: str
    log_occupancy: Callable[[Tensor], Tensor]  # ln Psi(-u), the log-survival
    hazard: Callable[[Tensor], Tensor]  # psi(u) / Psi(-u), never formed as that quotient

    def occupancy(self, u: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """o = Psi(-u), with full relative precision outside (u > 0)."""
        return self.log_occupancy(u).exp()

    def vacancy(self, u: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """v = Psi(u), with full relative precision inside (u < 0)."""
        return self.log_occupancy(-u).exp()


def _logistic_log_occupancy(u: Tensor) -> Tensor:
    return logsigmoid(-u)


def _logistic_hazard(u: Tensor) -> Tensor:
    # exp(logsigmoid) and not sigmoid: the gradient of torch's sigmoid is 0 from u = 17 in float32.
    return logsigmoid(u).exp()


def _tail(u: Tensor) -> Tensor:
    """Psi(-u) u / psi(u) - 1 of the Gaussian for u >= GAUSSIAN_TAIL, by its asymptotic series."""
    w = u.reciprocal().square()
    series = torch.zeros_like(w)
    for coefficient in reversed(_TAIL_SERIES):
        series = w * (coefficient + series)
    return series


def _gaussian_log_occupancy(u: Tensor) -> Tensor:
    near = torch.special.log_ndtr(-u.clamp(max=GAUSSIAN_TAIL))
    x = u.clamp(min=GAUSSIAN_TAIL)
    far = -0.5 * x.square() - (x * math.sqrt(2 * math.pi)).log() + _tail(x).log1p()
    return torch.where(u < GAUSSIAN_TAIL, near, far)


def _gaussian_hazard(u: Tensor) -> Tensor:
    x = u.clamp(max=GAUSSIAN_TAIL)
    log_density = -0.5 * x.square() - 0.5 * math.log(2 * math.pi)
    near = (log_density - torch.special.log_ndtr(-x)).exp()
    x = u.clamp(min=GAUSSIAN_TAIL)
    return torch.where(u < GAUSSIAN_TAIL, near, x / (1 + _tail(x)))


def _laplace_log_occupancy(u: Tensor) -> Tensor:
    inside = torch.log1p(-0.5 * u.clamp(max=0.0).exp())
    return torch.where(u < 0, inside, -u - math.log(2.0))


def _laplace_hazard(u: Tensor) -> Tensor:
    e = u.clamp(max=0.0).exp()
    return torch.where(u < 0, e / (2 - e), torch.ones_like(u))


LAWS = {
    law.name: law
    for law in (
        Law("logistic", _logistic_log_occupancy, _logistic_hazard),
        Law("gaussian", _gaussian_log_occupancy, _gaussian_hazard),
        Law("laplace", _laplace_log_occupancy, _laplace_hazard),
    )
}


def law_named(name: str) -> Law:
    """The law of a name; ValueError naming the known ones otherwise."""
    if name not in LAWS:
        raise ValueError(f"law: expected one of {', '.join(LAWS)}; got {name!r}")
    return LAWS[name]


def gradient_norm(gradient: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """|grad f|, with gradient 0 instead of NaN where it vanishes."""
    return torch.linalg.vector_norm(gradient, dim=-1)


def sigma_mix(alpha: Float[Tensor, "*b"], cosine: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Projected share alpha |omega . n| + (1 - alpha)/2 (Eq. 16); ``cosine`` = omega . n."""
    return alpha * cosine.abs() + 0.5 * (1 - alpha)


def sigma_inside(
    law: Law,
    f: Float[Tensor, "*b"],
    slope: Float[Tensor, "*b"],
    m: Float[Tensor, "*b"],
    mix: Float[Tensor, "*b"],
    sharpness: Float[Tensor, ""],
) -> Float[Tensor, "*b"]:
    """sigma_in [1/m] (Eqs. 13, 15, 19) of points inside, f <= 0.

    ``slope`` = |grad f|, ``mix`` = sigma_mix. Evaluated outside it tends to s, an opaque free
    space: the sign of f is for the caller to heed.
    """
    return _sigma(law, sharpness * f, slope, m, mix, sharpness)


def sigma_outside(
    law: Law,
    f: Float[Tensor, "*b"],
    slope: Float[Tensor, "*b"],
    m: Float[Tensor, "*b"],
    mix: Float[Tensor, "*b"],
    sharpness: Float[Tensor, ""],
) -> Float[Tensor, "*b"]:
    """sigma_out [1/m] (Eq. 14) of points outside, f >= 0: sigma_inside with f mirrored."""
    return _sigma(law, -sharpness * f, slope, m, mix, sharpness)


def sigma_at_face(
    law: Law,
    slope: Float[Tensor, "*b"],
    m: Float[Tensor, "*b"],
    mix: Float[Tensor, "*b"],
    sharpness: Float[Tensor, ""],
) -> Float[Tensor, "*b"]:
    """sigma_in and sigma_out [1/m] where f = 0, and they are the same."""
    return _sigma(law, sharpness.new_zeros(()), slope, m, mix, sharpness)


def _sigma(law: Law, u: Tensor, slope: Tensor, m: Tensor, mix: Tensor, sharpness: Tensor) -> Tensor:
    return (m * law.occupancy(u) + 1) * (sharpness * law.hazard(u)) * slope * mix


def phasor(phi: Float[Tensor, "*b"]) -> Complex[Tensor, "*b"]:
    """e^{j phi} for phi in [-pi/2, pi/2], its real part kept from rounding below 0 (passivity)."""
    return torch.complex(in_phase(phi), phi.sin())


def in_phase(phi: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The real part of ``phasor``."""
    return phi.cos().clamp(min=0.0)


IN_FACE = 1e-9  # [m] a stretch that runs in a face, but for rounding, is inside


def telescoped(
    law: Law,
    f: Float[Tensor, "*b n"],
    gradient: Float[Tensor, "*b n 3"],
    m: Float[Tensor, "*b n"],
    alpha: Float[Tensor, "*b n"],
    phi: Float[Tensor, "*b n"],
    sharpness: Float[Tensor, ""],
    direction: Float[Tensor, "*b 3"],
    step: Float[Tensor, "*b"],
    kappa: Float[Tensor, "*b n"] | None = None,
) -> Complex[Tensor, "*b"]:
    """Integral of a = (sigma_in + kappa o) e^{j phi} along stretches, telescoped in occupancy [Np].

    ``n`` samples stand ``step`` [m] apart, the first and last at the ends. Only the inside (f < 0)
    is counted. Exact for alpha = 1 and one m on monotone stretches; second order in the step else.
    The bits are the same with the samples reversed. ``direction`` is not needed (that is the
    point); it is there to share one signature with ``riemann``.
    """
    u = sharpness * f
    inside = u.clamp(max=0.0)
    log_o, v = law.log_occupancy(inside), law.vacancy(inside)
    du, d_log_o, d_v = _difference(torch.stack([u, log_o, v])).unbind()
    mean_hazard, mean_density = _means(law, _mean(u), du, d_log_o, d_v)
    fields = torch.stack([m, alpha, phi, gradient_norm(gradient)])
    m_bar, alpha_bar, phi_bar, slope = _mean(fields).unbind()
    across = alpha_bar * (m_bar * d_v.abs() + d_log_o.abs())
    isotropic = (m_bar * mean_density + mean_hazard) * sharpness * slope
    along = 0.5 * (1 - alpha_bar) * isotropic
    if kappa is not None:
        along = along + _mean(kappa * torch.where(f <= IN_FACE, log_o.exp(), 0.0))
    depth = across + along * step[..., None]
    turned = depth * torch.stack([in_phase(phi_bar), phi_bar.sin()])
    return torch.complex(*_symmetric_sum(turned).unbind())


def riemann(
    law: Law,
    f: Float[Tensor, "*b n"],
    gradient: Float[Tensor, "*b n 3"],
    m: Float[Tensor, "*b n"],
    alpha: Float[Tensor, "*b n"],
    phi: Float[Tensor, "*b n"],
    sharpness: Float[Tensor, ""],
    direction: Float[Tensor, "*b 3"],
    step: Float[Tensor, "*b"],
    kappa: Float[Tensor, "*b n"] | None = None,
) -> Complex[Tensor, "*b"]:
    """The same integral by the paper's left Riemann sum over the first n - 1 samples (Eq. 23).

    Literal: first order in the step, wrong by any amount once s * step is large, and different for
    a reversed stretch by the ends' difference. Kept for comparison.
    """
    slope = gradient_norm(gradient)
    projected = (gradient * direction[..., None, :]).sum(-1)
    cosine = projected / torch.where(slope == 0, 1.0, slope)
    sigma = sigma_inside(law, f.clamp(max=0.0), slope, m, sigma_mix(alpha, cosine), sharpness)
    if kappa is not None:
        sigma = sigma + kappa * law.occupancy(sharpness * f.clamp(max=0.0))
    a = torch.where(f <= IN_FACE, sigma, 0.0) * phasor(phi)
    return a[..., :-1].sum(-1) * step


INTEGRALS = {"telescoped": telescoped, "riemann": riemann}


def _difference(x: Tensor) -> Tensor:
    return x[..., 1:] - x[..., :-1]


def _mean(x: Tensor) -> Tensor:
    return 0.5 * (x[..., 1:] + x[..., :-1])


def _means(
    law: Law, middle: Tensor, du: Tensor, d_log_o: Tensor, d_v: Tensor
) -> tuple[Tensor, Tensor]:
    """Means of H(u) and o H = psi(u) over each interval, u linear, the part outside as 0."""
    near = du.abs() < DIVIDED_DIFFERENCE_MIN
    divided = torch.stack([-d_log_o, d_v]) / torch.where(near, 1.0, du)
    hazard, density = torch.where(near, _gauss(law, middle, du), divided).unbind()
    return hazard, density


def _gauss(law: Law, middle: Tensor, du: Tensor) -> Tensor:
    """Both by three Gauss nodes of each interval, stacked."""
    offset = _GAUSS_NODE * du
    nodes = torch.stack([middle - offset, middle, middle + offset])
    counted = nodes <= 0
    nodes = nodes.clamp(max=0.0)
    hazard = torch.where(counted, law.hazard(nodes), 0.0)
    first, middle, last = torch.stack([hazard, law.occupancy(nodes) * hazard], 1).unbind()
    return (5 / 18) * (first + last) + (8 / 18) * middle  # the same bits either way round


def _symmetric_sum(x: Tensor) -> Tensor:
    """Sum over the last axis whose bits do not depend on its direction."""
    return 0.5 * (x + x.flip(-1)).sum(-1)
