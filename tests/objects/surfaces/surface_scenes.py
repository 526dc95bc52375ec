"""Random contacts and crossings of simple shapes, shared by the surface tests."""

import torch

from rfsg.objects.contract import Contact, Crossing
from rfsg.objects.shapes.analytic import Box, HalfSpace, Sphere

F64 = torch.float64


def unit(n: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator, dtype=F64), dim=-1)


def contacts(n: int = 1000, radius: float = 0.7, seed: int = 0) -> tuple[Sphere, Contact]:
    """Specular contacts all over a sphere, at every angle."""
    normal, incoming = unit(n, seed), unit(n, seed + 1)
    along = (incoming * normal).sum(-1, keepdim=True)
    incoming = incoming - 2 * along.clamp(min=0) * normal  # from outside
    outgoing = incoming - 2 * (incoming * normal).sum(-1, keepdim=True) * normal
    return Sphere(radius), Contact(radius * normal, incoming, outgoing, normal)


def chords(n: int = 1000, radius: float = 0.7, seed: int = 0) -> tuple[Sphere, Crossing]:
    """Chords of a sphere, from boundary to boundary."""
    start, end = unit(n, seed), unit(n, seed + 1)
    return Sphere(radius), Crossing(radius * start, radius * end, start, end)


def through_wall(depth: float, cosine: float = 1.0, dtype=F64) -> tuple[Box, Crossing]:
    """One crossing of a wide wall ``depth`` thick, across x, at an angle."""
    box = Box([depth / 2, 50.0, 50.0])
    lean = depth / 2 * (1 / cosine**2 - 1) ** 0.5
    end = torch.tensor([[depth / 2, lean, 0.0]], dtype=dtype)
    normal = torch.tensor([[1.0, 0.0, 0.0]], dtype=dtype)
    return box, Crossing(-end, end, -normal, normal)


def reverse(crossing: Crossing) -> Crossing:
    return Crossing(crossing.end, crossing.start, crossing.normal_end, crossing.normal_start)


def ground() -> HalfSpace:
    return HalfSpace()
