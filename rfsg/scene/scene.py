"""Scene: which objects stand where, and which radios there are. Structure is immutable.

Parameter values change in place, as torch optimisers do; structure never does: moved / replaced /
without / with_receivers return a new Scene that shares the objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.scene.errors import SceneError as SceneError
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio


@dataclass(frozen=True)
class Node:
    """One object standing in the world. Nodes of one asset share the same ``body``."""

    path: str
    body: Body
    pose: Pose
    velocity: Float[Tensor, "3"] = field(
        default_factory=lambda: torch.zeros(3, dtype=torch.float64)
    )
    asset: str | None = None  # where it came from, for reports


@dataclass(frozen=True)
class Scene:
    nodes: tuple[Node, ...] = ()
    transmitters: tuple[Radio, ...] = ()
    receivers: tuple[Radio, ...] = ()
    frequency: float | None = None  # [Hz], the stage's default
    warnings: tuple[str, ...] = ()
    source: Any = field(default=None, compare=False, repr=False)  # USD origin; scene/usd only

    @staticmethod
    def from_usd(path: str | Path, **options: Any) -> "Scene":
        """Read a USD scene; a SceneError lists every fault at once. See ``rfsg.scene.usd.read``."""
        from rfsg.scene.usd import read

        return read(path, **options)

    def to_usd(self, path: str | Path, **options: Any) -> Path:
        """Write this scene as text USD; see ``rfsg.scene.usd.write``."""
        from rfsg.scene.usd import write

        return write(self, path, **options)

    def node(self, path: str) -> Node:
        return self.nodes[self.index(path)]

    def index(self, path: str) -> int:
        """Position of the object at a prim path. Raises SceneError naming what is there instead."""
        for i, node in enumerate(self.nodes):
            if node.path == path:
                return i
        known = ", ".join(n.path for n in self.nodes) or "no objects at all"
        raise SceneError([f"{path}: no object at this path; the scene has {known}"])

    def moved(
        self,
        path: str,
        translate: Sequence[float] | Tensor | None = None,
        *,
        to: Sequence[float] | Tensor | None = None,
        yaw_deg: float = 0.0,
        pose: Pose | None = None,
    ) -> "Scene":
        """A scene with one object moved: by ``translate`` [m], to a position, turned about its own
        origin by ``yaw_deg`` about world +z, or to a whole ``pose``."""
        i = self.index(path)
        old = self.nodes[i].pose
        if pose is None:
            turn = Pose.at(0.0, 0.0, 0.0, yaw_deg).rotation
            place = old.translation if to is None else _vector(to, f"{path}: move target")
            if translate is not None:
                place = place + _vector(translate, f"{path}: move")
            pose = Pose(turn @ old.rotation, place, old.scale)
        return self._with_node(i, replace(self.nodes[i], pose=pose))

    def replaced(self, path: str, asset: "str | Path | Body") -> "Scene":
        """A scene in which another object stands at the same pose: a Body, or an asset file."""
        i = self.index(path)
        if isinstance(asset, Body):
            return self._with_node(i, replace(self.nodes[i], body=asset, asset=None))
        from rfsg.scene.assets import load_asset

        return self._with_node(
            i, replace(self.nodes[i], body=load_asset(asset).body, asset=str(asset))
        )

    def without(self, path: str) -> "Scene":
        i = self.index(path)
        return replace(self, nodes=self.nodes[:i] + self.nodes[i + 1 :])

    def with_receivers(self, receivers: Sequence[Radio]) -> "Scene":
        return replace(self, receivers=tuple(receivers))

    def with_transmitters(self, transmitters: Sequence[Radio]) -> "Scene":
        return replace(self, transmitters=tuple(transmitters))

    def _with_node(self, i: int, node: Node) -> "Scene":
        return replace(self, nodes=self.nodes[:i] + (node,) + self.nodes[i + 1 :])


def _vector(value: Sequence[float] | Tensor, what: str) -> Tensor:
    vector = torch.as_tensor(value, dtype=torch.float64)
    if vector.shape != (3,) or not bool(torch.isfinite(vector).all()):
        raise SceneError([f"{what}: expected three finite numbers in metres, got {value!r}"])
    return vector
