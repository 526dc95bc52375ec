"""Gaussian processes with a linear trend and a covariance fitted by maximum likelihood (kriging).

C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, MIT Press 2006 ("GPML"):
section 2.7 for the trend, 2.2 for the posterior, 5.4.1 for the gradient of the likelihood.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

# A covariance matrix gets this share of its mean variance on the diagonal: two readings of one place
# without noise make it singular, and rounding then makes it indefinite. The square of 1e-5 dB in a
# 1 dB field is far below any reading.
JITTER = 1e-10
GROWN_JITTER = (1.0, 1e2, 1e4, 1e6)


@dataclass(frozen=True)
class Sites:
    """Where a reading is taken: positions [m] of both ends, and the number of the receiver."""

    tx: Float[Tensor, "n 3"]
    rx: Float[Tensor, "n 3"]
    gateway: Int[Tensor, "n"]


@dataclass(frozen=True)
class Pairs:
    """What a covariance may depend on, for each of some pairs of sites.

    Distances [m] between the transmitters and between the receivers, and whether the receiver is the
    same one. So every covariance is invariant to rigid motions.
    """

    tx: Float[Tensor, "*p"]
    rx: Float[Tensor, "*p"]
    same_gateway: Bool[Tensor, "*p"]

    @staticmethod
    def between(a: Sites, b: Sites) -> "Pairs":
        """Every site of ``a`` with every site of ``b``: arrays of shape [a, b]."""
        # By differences: torch's shortcut through a matrix product loses the small distances.
        exact = "donot_use_mm_for_euclid_dist"
        return Pairs(
            torch.cdist(a.tx, b.tx, compute_mode=exact),
            torch.cdist(a.rx, b.rx, compute_mode=exact),
            a.gateway[:, None] == b.gateway[None, :],
        )

    @staticmethod
    def diagonal(sites: Sites) -> "Pairs":
        """Every site with itself: arrays of shape [n]."""
        none = torch.zeros(len(sites.gateway), dtype=torch.float64)
        return Pairs(none, none, torch.ones(len(none), dtype=torch.bool))


@dataclass(frozen=True)
class Covariance:
    """A covariance function of pairs, with positive parameters that are fitted as logarithms.

    ``of(parameters, pairs)`` [dB^2] is the covariance of the field without noise. The first
    parameter is the standard deviation of the noise [dB] and is not used by ``of``. ``start`` holds
    the values to start from, ``least`` and ``most`` the bounds.
    """

    of: Callable[[Float[Tensor, "q"], Pairs], Tensor]
    names: tuple[str, ...]
    start: tuple[float, ...]
    least: tuple[float, ...]
    most: tuple[float, ...]


@dataclass(frozen=True)
class Block:
    """Readings that depend on each other: sites, trend basis [n p] and values [dB]."""

    sites: Sites
    basis: Float[Tensor, "n p"]
    values: Float[Tensor, "n"]


@dataclass(frozen=True)
class Trend:
    """Gaussian prior of the coefficients of the basis: ``mean`` and standard deviations ``std``."""

    mean: Float[Tensor, "p"]
    std: Float[Tensor, "p"]


def exponential(apart: Float[Tensor, "*p"], length: Float[Tensor, ""]) -> Float[Tensor, "*p"]:
    """exp(-d / length), the Matern covariance of order 1/2 (GPML 4.18)."""
    return torch.exp(-apart / length)


def matern32(apart: Float[Tensor, "*p"], length: Float[Tensor, ""]) -> Float[Tensor, "*p"]:
    """(1 + r) exp(-r), r = sqrt(3) d / length: the Matern covariance of order 3/2 (GPML 4.17)."""
    r = math.sqrt(3.0) * apart / length
    return (1.0 + r) * torch.exp(-r)


def covariance_of(
    covariance: Covariance,
    parameters: Float[Tensor, "q"],
    trend: Trend,
    a: tuple[Sites, Float[Tensor, "n p"]],
    b: tuple[Sites, Float[Tensor, "m p"]],
) -> Float[Tensor, "n m"]:
    """Field plus uncertain trend (GPML 2.40): k(a, b) + basis(a) diag(std^2) basis(b)^T [dB^2]."""
    field = covariance.of(parameters, Pairs.between(a[0], b[0]))
    return field + (a[1] * trend.std**2) @ b[1].T


def factor(matrix: Float[Tensor, "n n"]) -> Float[Tensor, "n n"]:
    """Lower Cholesky factor, with the least jitter that makes one possible.

    Raises FloatingPointError when no jitter does, as with NaN in the matrix.
    """
    size = float(matrix.diagonal().mean()) * JITTER
    for growth in GROWN_JITTER:
        padded = matrix.clone()
        padded.diagonal().add_(size * growth)
        lower, status = torch.linalg.cholesky_ex(padded)
        if status == 0:
            return lower
    raise FloatingPointError("covariance matrix: not positive definite; expected finite entries")


def negative_log_likelihood(
    covariance: Covariance, trend: Trend, block: Block, parameters: Float[Tensor, "q"]
) -> tuple[float, Float[Tensor, "q"]]:
    """-log p(values) of one block, and its gradient for the logarithms of the parameters.

    GPML 5.8 and 5.9: with W = (C^-1 - C^-1 r r^T C^-1) / 2 the gradient is sum(W * dC). Only the
    covariance is differentiated automatically, not its factor, which costs several times as much.
    """
    log = parameters.log().requires_grad_()
    values = log.exp()
    site = (block.sites, block.basis)
    matrix = covariance_of(covariance, values, trend, site, site)
    matrix = matrix + values[0] ** 2 * torch.eye(len(matrix), dtype=matrix.dtype)
    rest = block.values - block.basis @ trend.mean
    with torch.no_grad():
        lower = factor(matrix)
        weight = torch.cholesky_solve(rest[:, None], lower)[:, 0]
        fit = rest @ weight + len(rest) * math.log(2.0 * math.pi)
        value = 0.5 * fit + lower.diagonal().log().sum()
        slope = 0.5 * (torch.cholesky_inverse(lower) - torch.outer(weight, weight))
    (gradient,) = torch.autograd.grad((slope * matrix).sum(), log)
    return float(value), gradient


def most_likely(
    covariance: Covariance, trend: Trend, blocks: Sequence[Block], iterations: int = 100
) -> Float[Tensor, "q"]:
    """Parameters of the greatest likelihood of all ``blocks`` together, independent of each other.

    L-BFGS-B on the logarithms, from ``covariance.start``, within its bounds.
    """

    def cost(log: np.ndarray) -> tuple[float, np.ndarray]:
        parameters = torch.as_tensor(log).exp()
        parts = [negative_log_likelihood(covariance, trend, b, parameters) for b in blocks]
        slope = torch.stack([p[1] for p in parts]).sum(0)
        return sum(p[0] for p in parts), slope.numpy()

    end = scipy.optimize.minimize(
        cost,
        np.log(covariance.start),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(np.log(covariance.least), np.log(covariance.most), strict=True)),
        options={"maxiter": iterations},
    )
    return torch.as_tensor(end.x).exp()


@dataclass(frozen=True)
class Posterior:
    """A field and trend given the values of one block (GPML 2.22 to 2.26)."""

    covariance: Covariance
    trend: Trend
    parameters: Float[Tensor, "q"]
    block: Block
    lower: Float[Tensor, "n n"]
    weight: Float[Tensor, "n"]

    @staticmethod
    def given(
        covariance: Covariance, trend: Trend, parameters: Float[Tensor, "q"], block: Block
    ) -> "Posterior":
        """Of one block under given parameters. Raises FloatingPointError as ``factor`` does."""
        site = (block.sites, block.basis)
        matrix = covariance_of(covariance, parameters, trend, site, site)
        matrix.diagonal().add_(parameters[0] ** 2)
        lower = factor(matrix)
        rest = block.values - block.basis @ trend.mean
        weight = torch.cholesky_solve(rest[:, None], lower)[:, 0]
        return Posterior(covariance, trend, parameters, block, lower, weight)

    def at(
        self, sites: Sites, basis: Float[Tensor, "m p"]
    ) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
        """Mean [dB] and variance [dB^2] of the field with its trend, without noise."""
        known = (self.block.sites, self.block.basis)
        cross = covariance_of(self.covariance, self.parameters, self.trend, known, (sites, basis))
        mean = basis @ self.trend.mean + cross.T @ self.weight
        prior = self.covariance.of(self.parameters, Pairs.diagonal(sites))
        prior = prior + (basis**2) @ self.trend.std**2
        told = torch.linalg.solve_triangular(self.lower, cross, upper=False)
        # Rounding leaves a variance that is nearly all explained a little below zero.
        return mean, (prior - (told**2).sum(0)).clamp_min(0.0)
