"""Scene: which objects stand where, and which radios there are. Structure is immutable.

Parameter values change in place, as torch optimisers do; structure never does: moved / replaced /
without / added / with_variant / with_receivers return a new Scene that shares the objects. As in
USD, what stands below a path goes where that goes.
"""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.displayed import Displayed
from rfsg.scene.errors import SceneError as SceneError
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio

SHOWN = 12  # paths named in an error before "and more"


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
class Scene(Displayed):
    nodes: tuple[Node, ...] = ()
    transmitters: tuple[Radio, ...] = ()
    receivers: tuple[Radio, ...] = ()
    frequency: float | None = None  # [Hz], the stage's default
    warnings: tuple[str, ...] = ()
    source: Any = field(default=None, compare=False, repr=False)  # USD origin; scene/usd only

    def __repr__(self) -> str:
        return (
            f"Scene of {len(self.nodes)} objects, {len(self.transmitters)} transmitters "
            f"and {len(self.receivers)} receivers"
        )

    @staticmethod
    def from_usd(path: Any, *, untrusted: Any = False, **options: Any) -> "Scene":
        """Read a USD scene from its file or from an open ``Usd.Stage``; a SceneError lists every
        fault at once. See ``rfsg.scene.usd.read``.

        untrusted: read a stranger's file in a limited child process, which alone crashes, hangs or
        runs out of memory; True or ``rfsg.scene.sandbox.Limits``. See ``rfsg.scene.sandbox.read``."""
        if untrusted:
            from rfsg.scene.sandbox import read as read_apart

            return read_apart(path, None if untrusted is True else untrusted, **options)
        from rfsg.scene.usd import read

        return read(path, **options)

    def to_usd(self, path: str | Path, **options: Any) -> Path:
        """Write this scene as text USD; see ``rfsg.scene.usd.write``."""
        from rfsg.scene.usd import write

        return write(self, path, **options)

    def save_edits(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write what was changed since the scene was read, as a layer over its source, which stays
        as it is; see ``rfsg.scene.usd.save_edits``."""
        from rfsg.scene.usd import save_edits

        return save_edits(self, path, overwrite)

    def node(self, path: str) -> Node:
        return self.nodes[self.index(path)]

    def index(self, path: str) -> int:
        """Position of the object at a prim path. Raises SceneError naming what is there instead."""
        for i, node in enumerate(self.nodes):
            if node.path == path:
                return i
        raise SceneError([f"{path}: no object at this path; {_there(self.nodes, path)}"])

    def moved(
        self,
        path: str,
        translate: Sequence[float] | Tensor | None = None,
        *,
        to: Sequence[float] | Tensor | None = None,
        yaw_deg: float = 0.0,
        pose: Pose | None = None,
    ) -> "Scene":
        """A scene with an object or a radio moved, and what stands below its path: by ``translate``
        [m], to a position, turned about its own origin by ``yaw_deg`` about world +z, or to a whole
        ``pose``. A path with nothing of its own moves all below it, by ``translate`` alone.

        Raises SceneError for a path with nothing at it or below."""
        self._refuse_empty(path)
        here = next((_pose(t) for t in self._things() if t.path == path), None)
        if here is None and (to is not None or pose is not None or yaw_deg):
            raise SceneError(
                [f"{path}: a group has no place of its own; move it by translate alone"]
            )
        old = here or Pose.identity()
        if pose is None:
            turn = Pose.at(0.0, 0.0, 0.0, yaw_deg).rotation
            place = old.translation if to is None else _vector(to, f"{path}: move target")
            if translate is not None:
                place = place + _vector(translate, f"{path}: move")
            pose = Pose(turn @ old.rotation, place, old.scale)
        new = pose

        def carried(thing: Node | Radio) -> Node | Radio:
            if thing.path == path:
                return _placed(thing, new)
            return _placed(thing, new.compose(_seen_from(old, _pose(thing))))

        return self._changed(path, carried)

    def replaced(self, path: str, asset: Any) -> "Scene":
        """A scene in which another object stands at the same pose: a Body, an asset's USD file, or an
        asset that was loaded. Raises SceneError, for a file that cannot be read too."""
        i = self.index(path)
        body, file = self._body(asset)
        node = replace(self.nodes[i], body=body, asset=file)
        return replace(self, nodes=self.nodes[:i] + (node,) + self.nodes[i + 1 :])

    def without(self, path: str) -> "Scene":
        """A scene without what stands at a path or below it, objects and radios."""
        self._refuse_empty(path)
        return self._changed(path, lambda thing: None)

    def added(
        self,
        asset: Any,
        path: str,
        *,
        at: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        yaw_deg: float = 0.0,
        pose: Pose | None = None,
    ) -> "Scene":
        """A scene with one more object: a Body, an asset's USD file, or an asset that was loaded.

        path: the prim it becomes, /World/Desk_2. at: where its origin stands [m], turned about +z
        by ``yaw_deg``; or a whole ``pose``. Objects of one asset share one body.

        Raises SceneError for a path that is taken, or that no prim can have."""
        names = path.split("/")[1:]
        if not path.startswith("/") or not all(name.isidentifier() for name in names):
            raise SceneError([f"{path}: no path of a prim; expected one like /World/Desk_2"])
        if any(thing.path == path for thing in self._things()):
            raise SceneError([f"{path}: is taken; {_there(self._things(), path)}"])
        if pose is None:
            x, y, z = _vector(at, f"{path}: place").tolist()
            pose = Pose.at(x, y, z, yaw_deg)
        body, file = self._body(asset)
        return replace(self, nodes=(*self.nodes, Node(path, body, pose, asset=file)))

    def with_variant(self, path: str, variant_set: str, name: str) -> "Scene":
        """A scene with a variant of a prim chosen: read from USD again, what was edited since stays
        edited. Raises SceneError naming the variants that there are."""
        from rfsg.scene.usd import with_variant

        return with_variant(self, path, variant_set, name)

    def with_receivers(self, receivers: Sequence[Radio]) -> "Scene":
        return replace(self, receivers=tuple(receivers))

    def with_transmitters(self, transmitters: Sequence[Radio]) -> "Scene":
        return replace(self, transmitters=tuple(transmitters))

    def _things(self) -> "tuple[Node | Radio, ...]":
        return (*self.nodes, *self.transmitters, *self.receivers)

    def _refuse_empty(self, path: str) -> None:
        if not any(at_or_below(thing.path, path) for thing in self._things()):
            raise SceneError([f"{path}: nothing at this path; {_there(self._things(), path)}"])

    def _changed(self, path: str, change: "Callable[[Any], Any]") -> "Scene":
        """The scene with what stands at or below a path changed, or left out where that is None."""

        def of(things: tuple[Any, ...]) -> tuple[Any, ...]:
            new = [change(t) if at_or_below(t.path, path) else t for t in things]
            return tuple(t for t in new if t is not None)

        nodes, tx, rx = of(self.nodes), of(self.transmitters), of(self.receivers)
        return replace(self, nodes=nodes, transmitters=tx, receivers=rx)

    def _body(self, asset: Any) -> tuple[Body, str | None]:
        """(body, asset file) of what somebody gives for an object; the body of a node that has the
        same already."""
        if isinstance(asset, Body):
            return asset, None
        from rfsg.scene.assets import LoadedAsset, load_asset
        from rfsg.scene.usd.composition import refuse_foreign_units
        from rfsg.scene.weights import same_bits

        loaded = asset if isinstance(asset, LoadedAsset) else load_asset(asset)
        file = str(Path(loaded.path).absolute())
        refuse_foreign_units(file)
        for node in self.nodes:
            parts = ("shape", "surface")
            pairs = [(getattr(node.body, p), getattr(loaded.body, p)) for p in parts]
            if node.asset == file and all(same_bits(*pair) for pair in pairs):
                return node.body, file
        return loaded.body, file

    def export(self, path: str, out: str | Path, **options: Any) -> Path:
        """Write the object at a path as an asset: a folder, NAME.usda or NAME.usdz; returns the USD
        file. See ``rfsg.scene.export.export``; ``rfsg.export`` draws its picture, too."""
        from rfsg.scene.export import export

        return export(self, path, out, **options)


def at_or_below(path: str, top: str) -> bool:
    """Whether a prim path is another one or lies below it."""
    return path == top or (top != "" and path.startswith(f"{top}/" if top != "/" else top))


def merged(mine: Scene, old: Scene, new: Scene) -> Scene:
    """``new`` with the edits that made ``mine`` of ``old``, as a stronger layer lies over a weaker.

    What was taken out stays out, what was added stays; of what was changed, the changed fields stay
    and the others follow ``new``. An edit of what ``new`` no longer has is lost with it."""
    nodes = _merged(mine.nodes, old.nodes, new.nodes)
    tx = _merged(mine.transmitters, old.transmitters, new.transmitters)
    rx = _merged(mine.receivers, old.receivers, new.receivers)
    frequency = new.frequency if mine.frequency == old.frequency else mine.frequency
    return replace(new, nodes=nodes, transmitters=tx, receivers=rx, frequency=frequency)


def _merged(mine: Sequence[Any], old: Sequence[Any], new: Sequence[Any]) -> tuple[Any, ...]:
    edited, before = {t.path: t for t in mine}, {t.path: t for t in old}
    there = {t.path for t in new}
    kept = []
    for thing in new:
        if thing.path in edited:
            kept.append(_over(edited[thing.path], before.get(thing.path), thing))
        elif thing.path not in before:
            kept.append(thing)
    return (*kept, *(t for t in mine if t.path not in before and t.path not in there))


def _over(mine: Any, old: Any, new: Any) -> Any:
    if old is None:
        return mine
    changes = {k: v for k, v in vars(mine).items() if v is not vars(old)[k]}
    if "body" in changes:
        changes["asset"] = mine.asset
    return replace(new, **changes) if changes else new


def _pose(thing: Node | Radio) -> Pose:
    if isinstance(thing, Node):
        return thing.pose
    return Pose(thing.rotation, thing.position, torch.ones((), dtype=torch.float64))


def _placed(thing: Node | Radio, pose: Pose) -> Node | Radio:
    if isinstance(thing, Node):
        return replace(thing, pose=pose)
    return replace(thing, position=pose.translation, rotation=pose.rotation)


def _seen_from(outer: Pose, pose: Pose) -> Pose:
    """outer_from_pose, of two poses in the world."""
    rotation = outer.rotation.T @ pose.rotation
    return Pose(rotation, outer.point_object(pose.translation), pose.scale / outer.scale)


def _there(things: Sequence[Any], path: str) -> str:
    """What the scene has, the paths most like the given one first."""
    paths = [thing.path for thing in things]
    near = difflib.get_close_matches(path, paths, 3)
    shown = list(dict.fromkeys([*near, *paths]))[:SHOWN]
    more = f" and {len(paths) - len(shown)} more" if len(paths) > len(shown) else ""
    return f"the scene has {', '.join(shown)}{more}" if paths else "the scene has nothing at all"


def _vector(value: Sequence[float] | Tensor, what: str) -> Tensor:
    vector = torch.as_tensor(value, dtype=torch.float64)
    if vector.shape != (3,) or not bool(torch.isfinite(vector).all()):
        raise SceneError([f"{what}: expected three finite numbers in metres, got {value!r}"])
    return vector
