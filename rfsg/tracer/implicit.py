"""Stationary paths: the Lagrangian's Newton step, and the spreading from the same matrix.

A specular path with D reflections is a stationary point of L = sum |x_{i+1} - x_i| subject to
f_i(x_i) = 0 (Fermat). With K the KKT matrix of that problem at its solution, the implicit function
theorem gives the mixed second derivative of the path length,
    M = d2L / dx_tx dx_rx = -B_tx^T K^-1 B_rx,
and M restricted to the planes across departure and arrival gives the spreading S = sqrt|det M| [1/m]:
1/length for planar mirrors, the divergence factor of geometrical optics for curved ones. S is
symmetric in transmitter and receiver by construction.

A path that is refracted is stationary in its optical length: L = sum n_i |x_{i+1} - x_i|, with n_i
the ``index`` of what segment i runs in. -dL/dx_tx = n_tx u_tx, so M = -d(n_tx u_tx)/dx_rx, and a
solid angle at the transmitter spreads over dA / dOmega = n_tx^2 / |det M| at the receiver: with both
ends in free space S = sqrt|det M| as before, whatever lies between. A radio in a medium sends into it,
and hears with an aperture of (lambda / n_rx)^2 / 4 pi: S = sqrt|det M| / (n_tx n_rx), which makes
Friis' law of the medium's own wavelength between two radios in it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.contract import Jet
from rfsg.scene.world import unit


@dataclass(frozen=True)
class Kkt:
    """One Newton system: matrix [c 4D 4D], residual [c 4D] (3D of position, then D of surface)."""

    matrix: Float[Tensor, "c n n"]
    residual: Float[Tensor, "c n"]


def segments(vertices: Float[Tensor, "c k 3"]) -> tuple[Tensor, Tensor]:
    """Lengths [c k-1] and unit directions [c k-1 3] of a polyline; zero directions where it stands."""
    delta = vertices[:, 1:] - vertices[:, :-1]
    direction = unit(delta)
    return (delta * direction).sum(-1), direction


def multipliers(
    directions: Float[Tensor, "c s 3"],
    gradient: Float[Tensor, "c d 3"],
    index: Float[Tensor, "c s"] | None = None,
) -> Tensor:
    """lambda_i that best balance (n_i u_i - n_{i+1} u_{i+1}) + lambda_i grad f_i = 0 [c d]."""
    directions = directions if index is None else index[..., None] * directions
    bend = directions[:, :-1] - directions[:, 1:]
    square = (gradient * gradient).sum(-1)
    return -(bend * gradient).sum(-1) / torch.where(square == 0, 1.0, square)


def kkt(
    vertices: Float[Tensor, "c k 3"],
    jet: Jet,
    lam: Float[Tensor, "c d"],
    index: Float[Tensor, "c s"] | None = None,
) -> Kkt:
    """Assemble the Newton system of chains with D = k - 2 >= 1 vertices; index: 1 where None."""
    c, depth = lam.shape
    length, u = segments(vertices)
    index = torch.ones_like(length) if index is None else index
    eye = torch.eye(3, dtype=vertices.dtype, device=vertices.device)
    inverse = 1.0 / torch.where(length > 0, length, torch.ones_like(length))
    across = (eye - u[..., :, None] * u[..., None, :]) * (index * inverse)[..., None, None]
    n = 4 * depth
    matrix = vertices.new_zeros(c, n, n)
    for i in range(depth):
        a, row = slice(3 * i, 3 * i + 3), 3 * depth + i
        matrix[:, a, a] = (
            across[:, i] + across[:, i + 1] + lam[:, i, None, None] * jet.hessian[:, i]
        )
        matrix[:, a, row] = jet.gradient[:, i]
        matrix[:, row, a] = jet.gradient[:, i]
        if i + 1 < depth:
            b = slice(3 * i + 3, 3 * i + 6)
            matrix[:, a, b] = -across[:, i + 1]
            matrix[:, b, a] = -across[:, i + 1]
    pull = index[..., None] * u
    bend = pull[:, :-1] - pull[:, 1:] + lam[..., None] * jet.gradient
    return Kkt(matrix, torch.cat([bend.reshape(c, 3 * depth), jet.value], 1))


def solve_regular(
    matrix: Float[Tensor, "c n n"], right: Float[Tensor, "c n m"]
) -> tuple[Float[Tensor, "c n m"], Bool[Tensor, "c"]]:
    """matrix^-1 right, and which systems were regular; zeros stand where one was not."""
    answer, info = torch.linalg.solve_ex(matrix, right)
    good = (info == 0) & torch.isfinite(answer).all(-1).all(-1)
    return torch.where(good[:, None, None], answer, torch.zeros_like(answer)), good


def spreading(
    vertices: Float[Tensor, "c k 3"],
    jet: Jet,
    lam: Float[Tensor, "c d"],
    cap: Float[Tensor, ""],
    index: Float[Tensor, "c s"] | None = None,
) -> tuple[Float[Tensor, "c"], Bool[Tensor, "c"], Bool[Tensor, "c"]]:
    """S [1/m] of chains with vertices, which were capped at a caustic, and which were regular.

    Each singular value of the transverse M is held below ``cap`` [1/m], the inverse of a wavelength:
    a focus is never brighter than a source one wavelength away.
    """
    length, u = segments(vertices)
    eye = torch.eye(3, dtype=vertices.dtype, device=vertices.device)
    # each end's index, by which S is divided, is left out of its side of M instead
    first = (eye - u[:, 0, :, None] * u[:, 0, None, :]) / length[:, 0, None, None]
    last = (eye - u[:, -1, :, None] * u[:, -1, None, :]) / length[:, -1, None, None]
    system = kkt(vertices, jet, lam, index)
    depth = lam.shape[1]
    right = vertices.new_zeros(len(vertices), 4 * depth, 3)
    right[:, 3 * depth - 3 : 3 * depth] = -last
    answer, good = solve_regular(system.matrix, right)
    mixed = first @ answer[:, :3]  # -B_tx^T K^-1 B_rx with B_tx = -first
    departing, arriving = transverse(u[:, 0]), transverse(u[:, -1])
    m = departing @ mixed @ arriving.transpose(-1, -2)
    spread, capped = _capped_root_determinant(m, cap)
    return spread, capped, good


def caustics(
    vertices: Float[Tensor, "c k 3"],
    jet: Jet,
    lam: Float[Tensor, "c d"],
    index: Float[Tensor, "c s"] | None = None,
) -> Int[Tensor, "c"]:
    """How many caustics each path has passed through: the Morse index of its length.

    The length is a minimum of its neighbours' where no caustic lies between the ends; each one passed
    turns a direction into a maximum (Morse index theorem; Milnor, Morse Theory, section 15), and each
    such direction turns e^{-j pi/4} of stationary phase into e^{+j pi/4}. The bordered matrix has one
    negative eigenvalue more for every surface that holds a vertex.
    """
    system = kkt(vertices, jet, lam, index).matrix
    return (torch.linalg.eigvalsh(system) < 0).sum(1) - lam.shape[1]


def transverse(direction: Float[Tensor, "c 3"]) -> Float[Tensor, "c 2 3"]:
    """Two unit vectors across a direction, as rows."""
    helper = torch.zeros_like(direction)
    helper.scatter_(1, direction.abs().argmin(1, keepdim=True), 1.0)
    a = unit(torch.linalg.cross(direction, helper))
    return torch.stack([a, torch.linalg.cross(direction, a)], 1)


def _capped_root_determinant(
    m: Float[Tensor, "c 2 2"], cap: Float[Tensor, ""]
) -> tuple[Tensor, Tensor]:
    """sqrt of the product of the two singular values, each at most ``cap``."""
    det = (m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]).abs()
    # |m|_F^2 = s1^2 + s2^2 and det = s1 s2 give both singular values without an SVD's gradients
    square = (m * m).sum((1, 2))
    plus = torch.sqrt(torch.clamp(square + 2 * det, min=0.0) + TINY)
    minus = torch.sqrt(torch.clamp(square - 2 * det, min=0.0) + TINY)
    s1, s2 = 0.5 * (plus + minus), 0.5 * (plus - minus)
    capped = s1 > cap
    both = torch.where(s2 > cap, cap * cap, cap * s2.clamp(min=0.0))
    product = torch.where(capped, both, det)
    return torch.sqrt(product + TINY), capped


TINY = 1e-300  # keeps sqrt differentiable at zero; far below any spreading of a real path
