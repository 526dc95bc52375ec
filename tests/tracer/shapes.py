"""Shapes that only tests need: closed forms that pretend to be learned."""

import torch
from torch import Tensor, nn

from rfsg.objects.contract import Jet


class Field(nn.Module):
    """Any closed-form f as a learned shape: gradients and Hessians by autograd, marched, measured."""

    kind = "field"
    convex = False
    faceted = False
    exact = False

    def __init__(self, f, half, lipschitz: float = 1.5):
        super().__init__()
        self.f, self.half, self.lipschitz = f, torch.tensor(half, dtype=torch.float64), lipschitz

    def config(self) -> dict[str, object]:
        return {}

    def bounds(self) -> Tensor:
        return torch.stack([-self.half, self.half])

    def sdf(self, point: Tensor) -> Tensor:
        return self.f(point)

    def value_and_gradient(self, point: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            p = point.detach().requires_grad_(True)
            value = self.f(p)
            (gradient,) = torch.autograd.grad(value.sum(), p)
        return value.detach(), gradient

    def jet(self, point: Tensor) -> Jet:
        with torch.enable_grad():
            p = point.detach().requires_grad_(True)
            value = self.f(p)
            (gradient,) = torch.autograd.grad(value.sum(), p, create_graph=True)
            rows = [
                torch.autograd.grad(
                    gradient[..., k].sum(), p, retain_graph=True, allow_unused=True
                )[0]
                if gradient.requires_grad
                else None
                for k in range(3)
            ]
        hessian = torch.stack([torch.zeros_like(p) if r is None else r for r in rows], -2)
        return Jet(value.detach(), gradient.detach(), hessian.detach())

    def patch(self, point: Tensor) -> Tensor:
        return torch.zeros(point.shape[:-1], dtype=torch.int64)

    def planes(self) -> Tensor:
        return torch.zeros(0, 4, dtype=torch.float64)

    def interval(self, origin: Tensor, direction: Tensor):
        raise NotImplementedError


def rippled(amplitude: float, period: float, thickness: float = 0.1):
    """f of a plate whose upper face z = 0 ripples along x."""

    def f(p: Tensor) -> Tensor:
        top = p[..., 2] - amplitude * torch.sin(2 * torch.pi * p[..., 0] / period)
        return torch.maximum(top, -(p[..., 2] + thickness))

    return f


def ball(radius: float):
    return lambda p: torch.sqrt((p * p).sum(-1) + 1e-30) - radius


def two_walls(gap: float, thickness: float):
    """Two plates across x, a thing that a ray meets twice."""
    return lambda p: (p[..., 0].abs() - gap / 2 - thickness / 2).abs() - thickness / 2
