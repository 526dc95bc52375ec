"""The edges of a scene's objects, in the world."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Edges:
    """Straight edges and rims of every node. A rim is an arc about ``centre``; its radius is inf where
    the edge is straight."""

    node: Int[Tensor, "e"]
    start: Float[Tensor, "e 3"]
