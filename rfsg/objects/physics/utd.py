"""Diffraction at an edge: the uniform theory of diffraction (UTD) for a wedge.

Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly
conducting surface", Proc. IEEE 62(11), 1974 [KP]; finite conductivity heuristically after Luebbers,
IEEE Trans. AP 32(1), 1984, as in Recommendation ITU-R P.526-15 section 4.3.

**Geometry.** A wedge fills the angle (2 - n) pi; the space outside it has the angle n pi. Azimuths
about the edge are counted from face 0 (phi = 0) through that space to face n (phi = n pi): phi_in
points to where the wave comes from, phi_out to where it goes. beta0 is the angle between ray and
edge, equal for both rays (Keller's cone). Time exp(+j w t).

**Four terms.** With delta the angle from a shadow boundary, positive on its lit side,

    1  delta = pi + (phi_out - phi_in)            direct ray, shadow next to face 0
    2  delta = pi - (phi_out - phi_in)            direct ray, shadow next to face n
    3  delta = pi - (phi_out + phi_in)            reflection on face 0
    4  delta = pi + (phi_out + phi_in) - 2 pi n   reflection on face n

each of [KP] (25) is -e^{-j pi/4} / (2 n sqrt(2 pi k) sin beta0) cot(delta / 2n) F(2 k L sin^2(delta
/ 2)), L = l sin^2 beta0, l = s_in s_out / (s_in + s_out). As F(x) = sqrt(pi x) e^{j pi/4} G(sqrt x)
with G(z) = erfcx(e^{j pi/4} z), an entire function, this is

    -(sqrt(l) / 2n) sign(delta) h(delta) G(sqrt(2 k L) |sin(delta/2)|),
    h(delta) = |sin(delta/2)| cot(|delta| / 2n),   h(0) = n.

Nothing is divided by nothing: the term steps by -sqrt(l) where the geometrical ray it belongs to
appears, and is smooth on either side, also for rays along the edge. At delta = 0 the sign is +1:
there the ray counts as lit.

**Components.** Soft: the electric field along the edge (E_z, boundary value 0 on a conductor);
hard: the magnetic field along the edge. With phi_hat towards growing azimuth at each ray and
beta_hat = s x phi_hat (s the direction of travel), world field vectors go by

    E_out = -(D_soft beta_out beta_in + D_hard phi_out phi_in) . E_in(edge) spread e^{-j k s_out}.

Reflection coefficients here multiply the soft and the hard field: a conductor has (-1, +1). Those of
``rfsg.objects.contract`` are (TE, TM) with R_TE = R_TM at normal incidence, a conductor (-1, -1). For
rays across the edge (beta0 = 90 deg) the plane of incidence of both faces is the plane across the
edge, and R_soft = R_TE, R_hard = -R_TM; T_soft = T_TE, T_hard = T_TM. For other beta0 a conductor
keeps (-1, +1), while a dielectric mixes the two components: ``wedge_terms`` are weighed with 2 x 2
matrices there.

**What a penetrable wedge transmits** (Burnside and Burgener, IEEE Trans. AP 31(1), 1983): where the
direct ray goes on behind the edge with a factor T, terms 1 and 2 carry 1 - T.

**Reciprocity** needs coefficients that do not change when in and out change places. Evaluate R at
the mean of the two rays' cosines to the face normal, each weighted by its own distance
(``mean_cosine``): on a reflection boundary this is the ray's own angle, to first order beside it too,
so that the total field has no kink there.

**Grazing incidence.** At phi_in = 0 (or n pi) the direct ray and the reflection are one. The terms
are the limit phi_in -> 0 where both rays count, as they do for a radio just above the face. A wave
that arrives along a face *from another edge of it* is already their sum: there the factor is 1/2.

**Two edges of one face**, the ray of length d between them along it: the wave from edge 1 varies across
edge 2, by dE/dn per metre, and adds (1 / (j k sin beta0)) dD/d phi_in . dE/dn (slope diffraction: Hwang
and Kouyoumjian 1974; Andersen, IEEE Trans. AP 45(7), 1997). So

    D = (1/2) [D_2 D_1 + D_2' D_1' / (j k d sin beta_1 sin beta_2)]  [m],

D_1' = dD_1/d phi_out, D_2' = dD_2/d phi_in, azimuths counted *from the common face* at both edges. The
soft field over a conductor goes by the slopes alone. The incident wave of edge 2 has its caustic at edge
1 across the edges: s_in of edge 2 is d, and s_out of edge 1 too. R is held in the slopes: right for
conductors, for other faces as heuristic as R at an edge is. Against a boundary integral, on a conducting
screen of 2.3 wavelengths, within 0.6 % (soft) and 2 % (hard) of the free field, less at higher frequency;
but 2 to 3 dB low where source, face and receiver lie in one plane, for transition zones then overlap.

**Validity.** Exact for a conducting half plane and plane waves (n = 2). On conducting wedges lit by a
line source the worst error about the edge is 1 % of the free field at L of half a wavelength (1.7 % on
one of 135 degrees), 8 % at 0.05, and falls as 1 / (k L) (eigenfunction series, docs/accuracy.md). The
edge must be long, and other edges far, against those lengths; R of lossy faces is a heuristic away
from its boundaries.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

_ROOT_J = complex(math.sqrt(0.5), math.sqrt(0.5))  # e^{j pi/4}
_SLOPE = 2.0 / math.sqrt(math.pi) * _ROOT_J
# Beyond this |z| the asymptotic series of G leaves 1e-14, while recurrences lose digits as z^2
# and the rational form is no better.
_FAR = 7.0
_FAR_TERMS = 20
_DEGREE = 40  # of Weideman's rational form: 1e-15 of relative error
_NEAR = 0.1  # |delta|/2 below which even functions of it are their power series


def wedge_terms(
    phi_in: Float[Tensor, "*#b"],
    phi_out: Float[Tensor, "*#b"],
    beta0: Float[Tensor, "*#b"],
    n: Float[Tensor, "*#b"],
    s_in: Float[Tensor, "*#b"],
    s_out: Float[Tensor, "*#b"],
    k: Float[Tensor, "*#b"],
) -> Complex[Tensor, "*b 4"]:
    """The four terms of the diffraction coefficient [sqrt(m)], unweighted, for spherical waves.

    Angles [rad], distances along the rays [m], wavenumber k [rad/m]; arguments broadcast. The field
    at the receiver is E_in(edge) . sum(weights terms) . sqrt(s_in / (s_out (s_in + s_out))) .
    exp(-j k s_out), with weights 1 - T, 1 - T, R_0, R_n ([KP] eqs. 21, 25; ITU-R P.526-15 4.3).
    """
    delta, _, n, scale, sharpness = _boundaries(phi_in, phi_out, beta0, n, s_in, s_out, k)
    value, _ = _term(delta, n, sharpness)
    return scale * value


def clearance(
    phi_in: Float[Tensor, "*#b"],
    phi_out: Float[Tensor, "*#b"],
    beta0: Float[Tensor, "*#b"],
    n: Float[Tensor, "*#b"],
    s_in: Float[Tensor, "*#b"],
    s_out: Float[Tensor, "*#b"],
    k: Float[Tensor, "*#b"],
) -> Float[Tensor, "*b"]:
    """How far from all shadow boundaries: the product of |F|^2 of the four terms, 0 (with slope 0) on
    a boundary and 1 where Keller's non-uniform theory holds."""
    delta, _, _, _, sharpness = _boundaries(phi_in, phi_out, beta0, n, s_in, s_out, k)
    z = sharpness * torch.sin(0.5 * delta).abs()
    g = erfcx_diagonal(z)
    square = math.pi * z * z * (g.real**2 + g.imag**2)  # |F|^2 of F = sqrt(pi) e^{j pi/4} z G(z)
    return square.clamp(max=1.0).prod(-1)


def slope_terms(
    phi_in: Float[Tensor, "*#b"],
    phi_out: Float[Tensor, "*#b"],
    beta0: Float[Tensor, "*#b"],
    n: Float[Tensor, "*#b"],
    s_in: Float[Tensor, "*#b"],
    s_out: Float[Tensor, "*#b"],
    k: Float[Tensor, "*#b"],
) -> Complex[Tensor, "*b 4"]:
    """Derivatives d/d phi_in of ``wedge_terms`` [sqrt(m) / rad], all else held.

    Of the uniform terms themselves and so exact for the half plane; the customary csc^2 F_s form is
    this to leading order near and far from a boundary. d/d phi_out is the same function with in and
    out exchanged. Slopes serve where the amplitude is about linear over the width sqrt(L / k) of the
    transition zone.
    """
    delta, turn, n, scale, sharpness = _boundaries(phi_in, phi_out, beta0, n, s_in, s_out, k)
    _, slope = _term(delta, n, sharpness)
    return scale * turn * slope


def mean_cosine(
    cos_in: Float[Tensor, "*#b"],
    cos_out: Float[Tensor, "*#b"],
    s_in: Float[Tensor, "*#b"],
    s_out: Float[Tensor, "*#b"],
) -> Float[Tensor, "*b"]:
    """Cosine of incidence at which to evaluate a face's R: (s_in c_in + s_out c_out)/(s_in + s_out).

    cos_in, cos_out: |direction . face normal| of the two rays. Unchanged when in and out change
    places; on and, to first order, about a reflection boundary it is that of the reflected ray.
    """
    return (s_in * cos_in + s_out * cos_out) / (s_in + s_out)


# the terms


def _boundaries(
    phi_in: Tensor,
    phi_out: Tensor,
    beta0: Tensor,
    n: Tensor,
    s_in: Tensor,
    s_out: Tensor,
    k: Tensor,
) -> tuple[Tensor, ...]:
    """delta [*b 4], d delta / d phi_in, n, -sqrt(l)/2n and sqrt(2 k L) with a last axis of 1."""
    difference, total = torch.broadcast_tensors(phi_out - phi_in, phi_out + phi_in)
    angle = math.pi + torch.stack([difference, -difference, -total, total], -1)
    period = 2.0 * math.pi * n[..., None]
    delta = angle - period * torch.round(angle / period).detach()
    length = s_in * s_out / (s_in + s_out)
    scale = -torch.sqrt(length) / (2.0 * n)
    sharpness = torch.sqrt(2.0 * k * length) * torch.sin(beta0)
    turn = delta.new_tensor([-1.0, 1.0, -1.0, 1.0])
    return delta, turn, n[..., None], scale[..., None], sharpness[..., None]


def _term(delta: Tensor, n: Tensor, sharpness: Tensor) -> tuple[Tensor, Tensor]:
    """P = sign(delta) h(delta) G(sharpness |sin(delta/2)|) and dP/d delta."""
    sign = torch.where(delta < 0, -torch.ones_like(delta), torch.ones_like(delta))
    half = 0.5 * sign * delta
    z = sharpness * torch.sin(half)
    # |delta| <= n pi <= 2 pi; rounding at 2 pi may leave sin a hair below 0
    z = torch.where(z < 0, torch.zeros_like(z), z)
    h, h_slope = _half_angle(half, n)
    g, g_slope = erfcx_diagonal(z), erfcx_diagonal(z, 1)
    slope = 0.5 * (h_slope * g + h * g_slope * (sharpness * torch.cos(half)))
    return sign * h * g, slope


def _half_angle(x: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """sin(x) cot(x / n) and its derivative for 0 <= x <= n pi / 2; n and 0 at x = 0."""
    near = x < _NEAR
    small = torch.where(near, x, torch.zeros_like(x))
    large = torch.where(near, torch.ones_like(x), x)
    y = large / n
    cot = torch.cos(y) / torch.sin(y)
    value = torch.sin(large) * cot
    slope = torch.cos(large) * cot - torch.sin(large) * (1.0 + cot * cot) / n
    square, ratio = small * small, 1.0 / (n * n)
    sinc, sinc_slope = _series(_SINC, square)
    bend, bend_slope = _series(_X_COT_X, square * ratio)
    value = torch.where(near, n * sinc * bend, value)
    rise = 2.0 * small * n * (sinc_slope * bend + ratio * sinc * bend_slope)
    return value, torch.where(near, rise, slope)


# sin x / x and x cot x in powers of x^2
_SINC = (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)
_X_COT_X = (1.0, -1 / 3, -1 / 45, -2 / 945, -1 / 4725, -2 / 93555, -1382 / 638512875)


def _series(coefficients: tuple[float, ...], w: Tensor) -> tuple[Tensor, Tensor]:
    """A polynomial and its derivative (Horner)."""
    value, slope = torch.zeros_like(w), torch.zeros_like(w)
    for c in reversed(coefficients):
        slope = value + w * slope
        value = c + w * value
    return value, slope


def erfcx_diagonal(z: Float[Tensor, "*b"], order: int = 0) -> Complex[Tensor, "*b"]:
    """G(z) = e^{j z^2} erfc(e^{j pi/4} z) for z >= 0, or its derivative of an order; 1e-14 relative.

    Weideman's rational form of the Faddeeva function (SIAM J. Numer. Anal. 31(5), 1994) and G' = 2 j
    z G - (2 / sqrt pi) e^{j pi/4}; far out the asymptotic series (DLMF 7.12.1), term by term.
    """
    return _Diagonal.apply(z, order)


class _Diagonal(torch.autograd.Function):
    """The derivative of every order is the next order: no graph through the series."""

    generate_vmap_rule = True

    @staticmethod
    def forward(z: Tensor, order: int) -> Tensor:
        far = z > _FAR
        near = _near(torch.where(far, torch.ones_like(z), z), order)
        return torch.where(far, _far(torch.where(far, z, torch.full_like(z, _FAR)), order), near)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        z, ctx.order = inputs
        ctx.save_for_backward(z)

    @staticmethod
    def backward(ctx, *grad_outputs):
        (z,) = ctx.saved_tensors
        slope = _Diagonal.apply(z, ctx.order + 1)
        return (grad_outputs[0] * slope.conj()).real, None


def _near(z: Tensor, order: int) -> Tensor:
    reach, coefficients = _weideman()
    y = _ROOT_J * z
    below = 1.0 / (reach + y)
    ratio = (reach - y) * below
    p = torch.zeros_like(ratio)
    for c in reversed(coefficients):
        p = c + ratio * p
    before = torch.zeros_like(p)
    value = 2.0 * p * below * below + below / math.sqrt(math.pi)
    for m in range(order):
        before, value = value, 2j * (m * before + z * value) - (_SLOPE if m == 0 else 0.0)
    return value


def _far(z: Tensor, order: int) -> Tensor:
    """(e^{-j pi/4} / sqrt pi) sum over m of (2m - 1)!! (j/2)^m z^(-2m - 1), differentiated."""
    w = 1.0 / (z * z)
    total = torch.zeros_like(w, dtype=_complex(w.dtype))
    for m in reversed(range(_FAR_TERMS)):
        total = math.prod(range(2 * m + 1, 2 * m + 1 + order)) + (2 * m + 1) * 0.5j * w * total
    # each factor carries the next (2m + 1) j / 2 of the series; falling powers bring (2m + 1) ...
    return (-1) ** order * _ROOT_J.conjugate() / math.sqrt(math.pi) * total / z ** (1 + order)


def _complex(dtype: torch.dtype) -> torch.dtype:
    return torch.complex64 if dtype == torch.float32 else torch.complex128


@lru_cache(maxsize=1)
def _weideman() -> tuple[float, tuple[float, ...]]:
    """L and a_1 .. a_N of w(z) = 2 p(Z) / (L - j z)^2 + 1 / (sqrt pi (L - j z))."""
    reach = math.sqrt(_DEGREE / math.sqrt(2.0))
    m = 2 * _DEGREE
    t = reach * np.tan(np.arange(-m + 1, m) * math.pi / (2 * m))
    f = np.concatenate([[0.0], np.exp(-t * t) * (reach * reach + t * t)])
    a = np.real(np.fft.fft(np.fft.fftshift(f))) / (2 * m)
    return reach, tuple(a[1 : _DEGREE + 1].tolist())
