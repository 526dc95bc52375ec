"""Everything of a scene that can be learned, by name: see ``selection`` for the table of names."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rfsg.objects.body import Body
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Dielectric
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.scene import Scene

HEADS = ("m", "alpha", "phi", "bulk")
POWER = "power.offset_db"
# Steps of a rate of 1e-4 (the paper's, for weights) in each quantity's own unit: a logarithm moves by
# 0.1 %, eps_r by 0.01, a pose by 1 mm or 1 mrad, an offset by 0.01 dB. The heads of a field add up 128
# features of one sign: what Adam moves each weight by moves the field by a hundred times that, so their
# step falls with the width (G. Yang et al., Tensor Programs V, 2022, Table 3). With the full one some fits
# ran to the ends of their ranges, where no slope is left; others did better (docs/learning-ablations.md).
RATES = {
    "weights": 1.0,
    "m": 0.1,
    "alpha": 0.1,
    "phi": 0.1,
    "bulk": 0.1,
    "s": 10.0,
    "interaction_length": 10.0,
    "eps_r": 100.0,
    "sigma": 1.0,
    "translation": 10.0,
    "rotation": 10.0,
    "gain_db": 100.0,
    "offset_db": 100.0,
}


@dataclass(frozen=True)
class Leaf:
    """Tensors with one meaning: ``names`` of all who share them. rows: of each tensor, None for all."""

    names: tuple[str, ...]
    tensors: tuple[nn.Parameter, ...]
    rows: slice | None = None
    note: str = ""

    @property
    def kind(self) -> str:
        """What it is, without whose: "weights", "eps_r", "translation"."""
        return self.names[0].rsplit(".", 1)[-1]

    @property
    def owners(self) -> tuple[str, ...]:
        """Prim paths of all that are changed by it."""
        return tuple(name.split(".", 1)[0] for name in self.names)

    @property
    def count(self) -> int:
        return sum(int(t[self.rows].numel() if self.rows else t.numel()) for t in self.tensors)


def leaves_of(scene: Scene, moves: dict[int, tuple[nn.Parameter, nn.Parameter]]) -> list[Leaf]:
    """All leaves of all objects; those of shared bodies and materials once, with all their names."""
    found: dict[tuple[object, ...], Leaf] = {}
    for i, node in enumerate(scene.nodes):
        for name, tensors, rows, note in (*_of_body(node.body), *_of_pose(moves[i])):
            key = (*(id(t) for t in tensors), rows.start if rows else None)
            have = found.get(key)
            names = (*(have.names if have else ()), f"{node.path}.{name}")
            found[key] = Leaf(names, tensors, rows, note)
    return list(found.values())


_Entry = tuple[str, tuple[nn.Parameter, ...], slice | None, str]


def _of_body(body: Body) -> Iterator[_Entry]:
    shape, surface = body.shape, body.surface
    if isinstance(shape, NeuralShape):
        yield "shape.weights", tuple(shape.parameters()), None, ""
    if isinstance(surface, StochasticSurface):
        yield "surface.weights", tuple(surface.layers.parameters()), None, ""
        for i, head in enumerate(HEADS[: len(surface.head_weight)]):
            yield f"surface.{head}", (surface.head_weight, surface.head_bias), slice(i, i + 1), ""
        yield "surface.s", (surface.log_sharpness,), None, ""
        yield "surface.interaction_length", (surface.log_interaction_length,), None, ""
    medium = getattr(surface, "medium", None)
    if isinstance(medium, Dielectric) and medium.itu is None:
        note = getattr(medium, "began_as", "")
        yield "surface.eps_r", (medium.eps_r,), None, note
        yield "surface.sigma", (medium.sigma,), None, note


def _of_pose(move: tuple[nn.Parameter, nn.Parameter]) -> Iterator[_Entry]:
    yield "pose.translation", (move[0],), None, ""
    yield "pose.rotation", (move[1],), None, ""


def offsets(gains: dict[str, nn.Parameter], power: nn.Parameter) -> list[Leaf]:
    leaves = [Leaf((f"{path}.gain_db",), (p,)) for path, p in gains.items()]
    return [*leaves, Leaf((POWER,), (power,))]


def rotation(turn: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """exp of the cross-product matrix: a turn by |turn| radians about it (world axes)."""
    x, y, z = turn.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return torch.matrix_exp(cross)
