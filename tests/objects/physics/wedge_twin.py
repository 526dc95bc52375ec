"""Diffraction at one edge and at two of one face, as the articles write it: (soft, hard) by pairs.

The tracer (``rfsg.tracer.wedge``) weighs the same terms with 2 x 2 matrices. Against exact fields it is
these plain forms that are tried; that the tracer does the same is a test of its own.
"""

import cmath
import math

import torch

from rfsg.objects.physics import utd

ROOT_J = cmath.exp(0.25j * math.pi)


def transition(x):
    """F(x) = 2j sqrt(x) e^{jx} int_{sqrt x}^inf e^{-j u^2} du for x >= 0 (Kouyoumjian, Pathak eq. 26)."""
    root = torch.sqrt(x)
    return math.sqrt(math.pi) * ROOT_J * root * utd.erfcx_diagonal(root)


def cotangent_transition(delta, n, kl):
    """cot(delta / 2n) F(2 kl sin^2(delta / 2)), also at delta = 0, where its sign is +1 (eq. 33)."""
    value, _ = utd._term(delta, n, torch.sqrt(2.0 * kl))
    return torch.sqrt(2.0 * math.pi * kl) * ROOT_J * value


def wedge_coefficients(phi_in, phi_out, beta0, n, s_in, s_out, k, r0, rn, t):
    """D (soft, hard) [sqrt(m)] (eq. 25). r0, rn: reflection of the faces, -1 and +1 on metal; t: what
    the direct ray keeps through the wedge, 0 if opaque."""
    return _weigh(utd.wedge_terms(phi_in, phi_out, beta0, n, s_in, s_out, k), r0, rn, t)


def slope_coefficients(phi_in, phi_out, beta0, n, s_in, s_out, k, r0, rn, t):
    """dD/d phi_in (soft, hard) [sqrt(m) / rad], with the distances, R and T held."""
    return _weigh(utd.slope_terms(phi_in, phi_out, beta0, n, s_in, s_out, k), r0, rn, t)


def _weigh(terms, r0, rn, t):
    direct = (terms[..., 0] + terms[..., 1])[..., None]
    return (1.0 - t) * direct + r0 * terms[..., 2:3] + rn * terms[..., 3:4]


def along_face(first, second, first_slope, second_slope, beta_first, beta_second, distance, k):
    """D (soft, hard) [m] of two edges with a face in common, the ray between them along that face.

    D = (1/2) [D_1 D_2 + D_1' D_2' / (j k distance sin beta_1 sin beta_2)]: ``first_slope`` is
    dD_1/d phi_out, ``second_slope`` dD_2/d phi_in, azimuths counted from the common face.
    """
    b1, b2 = torch.sin(beta_first), torch.sin(beta_second)
    reach = (k * distance * b1 * b2)[..., None]
    return 0.5 * (first * second - 1j * first_slope * second_slope / reach)


def spreading(s_in, s_out):
    """sqrt(s_in / (s_out (s_in + s_out))) [1/sqrt(m)]: straight edge, spherical wave (eq. 21)."""
    return torch.sqrt(s_in / (s_out * (s_in + s_out)))
