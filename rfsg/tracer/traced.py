"""Meshes of a baked shape in Embree: which triangle a ray meets, where on it, and from which side."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.objects.shapes.band import Surface
from rfsg.tracer.triangles import Triangles

THREADED = 16_384  # rays from which two threads of Embree pay


@dataclass(frozen=True)
class Met:
    """Embree's answer: triangle (-1 where none), t [m], weights of corners 1 and 2, and whether the
    triangle is seen from behind."""

    triangle: Int[Tensor, "m"]
    t: Float[Tensor, "m"]
    u: Float[Tensor, "m"]
    v: Float[Tensor, "m"]
    behind: Bool[Tensor, "m"]


class Traced(Triangles):
    """A triangle mesh that Embree traces, and where on its triangles it was met."""

    def __init__(self, surface: Surface):
        super().__init__(surface.vertices[surface.triangles.long()])

    def met(self, origin: Float[Tensor, "m 3"], direction: Float[Tensor, "m 3"]) -> Met:
        """The first triangle on each ray from t = 0."""
        o, d = (x.contiguous().numpy() for x in (origin - self.middle, direction))
        threads = min(torch.get_num_threads(), 1 + len(o) // THREADED)
        if threads > 1:
            parts = zip(np.array_split(o, threads), np.array_split(d, threads), strict=True)
            with ThreadPoolExecutor(threads) as pool:  # embreex lets go of the interpreter's lock
                found = list(pool.map(lambda part: self.shot(*part), parts))
            out = {key: np.concatenate([f[key] for f in found]) for key in found[0]}
        else:
            out = self.shot(o, d)
        facing = (torch.from_numpy(out["Ng"]) * direction).sum(-1)
        triangle = torch.from_numpy(out["primID"].astype(np.int32))
        t, u, v = (torch.from_numpy(out[key]) for key in ("tfar", "u", "v"))
        return Met(triangle, t, u, v, facing > 0)


def in_threads(work: Callable[[Any], Any], pieces: Sequence[Any]) -> list[Any]:
    """What ``work`` makes of each piece, several at a time, each with one thread of torch: its threads
    meet after each operation, which costs more than operations on a few thousand rays."""
    threads = torch.get_num_threads()
    if min(threads, len(pieces)) < 2:
        return [work(piece) for piece in pieces]
    torch.set_num_threads(1)  # of this thread, and of those begun from now on
    try:
        with ThreadPoolExecutor(min(threads, len(pieces))) as pool:
            return list(pool.map(torch.no_grad()(work), pieces))
    finally:
        torch.set_num_threads(threads)
