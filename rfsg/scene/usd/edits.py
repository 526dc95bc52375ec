"""Edits of a scene as a layer over its source: what changed since it was read, and nothing else.

The layer sublayers the source, which stays as it is to the byte. It says the difference between the
scene and its source, whatever steps led there: what is gone is inactive, what was swapped has another
reference, what moved another transform, what is new is a prim with a reference.
"""

import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd, UsdUtils

from rfsg.objects.body import unstretched
from rfsg.scene import files
from rfsg.scene.materials import material_of
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError, at_or_below, merged
from rfsg.scene.usd.authoring import Author
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.kept import Kept, alike
from rfsg.scene.usd.reading import scene_of
from rfsg.scene.usd.source import Options, Source, opened
from rfsg.scene.weights import refuse_overwrite, same_bits

# what USD takes from the root layer alone: a layer over another must say it again
_OF_THE_ROOT = (
    "metersPerUnit", "upAxis", "defaultPrim", "timeCodesPerSecond", "framesPerSecond",
    "startTimeCode", "endTimeCode",
)  # fmt: skip
AGREED = 1e-9  # how exactly poses and sizes must be read back: metres, or of their size


def with_variant(scene: Scene, path: str, variant_set: str, name: str) -> Scene:
    """The scene read again with one variant chosen, its edits kept. Raises SceneError."""
    source = Source.of(scene, f"{path}: {variant_set}={name}")
    chosen = {prim: dict(sets) for prim, sets in source.options.variants.items()}
    chosen.setdefault(path, {})[variant_set] = name
    options = replace(source.options, variants=chosen)
    new = scene_of(source.given or source.path, options, source.kept.copy())
    return merged(scene, source.base, new)


def save_edits(scene: Scene, path: str | Path, overwrite: bool = False) -> Path:
    """Write what was changed since a scene was read as text USD, a layer over its source; returns
    the path.

    Objects without a file of their own are saved beside it, in NAME_assets/. Radios, materials and
    chosen variants are kept too; not kept are a time code and folders that were given for reading.
    The layer is read back before it takes its name: it is the same scene, or SceneError says where
    not. A warning tells of folders that its readers must be given.

    Raises SceneError for a scene that is not from a file, when a file is there and ``overwrite`` is
    False, and always when it is one that the scene is read from.
    """
    path = Path(path).absolute()
    source = Source.of(scene, str(path))
    if path.suffix != ".usda":
        raise SceneError([f"{path}: edits are written as text; expected the ending .usda"])
    if not Path(source.path).is_file():
        raise SceneError(
            [f"{path}: the stage that the scene was read from has no file ({source.path}); save it "
             "first"]
        )  # fmt: skip
    refuse_overwrite([path], overwrite)
    with quiet(path):
        edits = _Edits(scene, source, path, overwrite)
        try:
            edits.write()
        except BaseException:
            edits.author.undo()
            raise
    if edits.foreign:
        folders = ", ".join(str(root) for root in edits.foreign)
        warnings.warn(f"{path}: to be read it must be given asset_roots {folders}", stacklevel=3)
    return path


class _Edits:
    """One layer of edits on its way to disk."""

    def __init__(self, scene: Scene, source: Source, path: Path, overwrite: bool):
        self.scene, self.path = scene, path
        self.options = replace(source.options, device="cpu")
        self.below = Path(source.path).absolute()
        self.kept = Kept()  # not the source's: what a fit changed in place counts as an edit
        self.base = scene_of(self.below, self.options, self.kept)
        self.opened = opened(self.below, self.options)
        self._refuse_itself()
        self.layer = Sdf.Layer.CreateAnonymous("edits.usda")
        self._head()
        stage = Usd.Stage.Open(self.layer, Sdf.Layer.CreateAnonymous("session.usda"))
        for prim, sets in self.options.variants.items():
            for name, choice in sets.items():
                stage.GetPrimAtPath(prim).GetVariantSet(name).SetVariantSelection(choice)
        time = self.options.code(self.opened.stage)
        self.author = Author(stage, time, self.base, path, overwrite)

    def write(self) -> None:
        self._author()
        UsdUtils.ModifyAssetPaths(self.layer, self._relative)
        beside = self.path.with_name(f".{self.path.stem}.{os.getpid()}.part.usda")
        if not beside.parent.is_dir():
            raise SceneError(
                [f"{self.path}: the folder {beside.parent} does not exist; make it first"]
            )
        try:
            beside.write_text(self.layer.ExportToString(), encoding="utf-8")
            self._verify(beside)
            os.replace(beside, self.path)
        finally:
            beside.unlink(missing_ok=True)

    def _refuse_itself(self) -> None:
        used = self.opened.stage.GetUsedLayers()
        read = {os.path.realpath(layer.realPath) for layer in used if layer.realPath}
        if os.path.realpath(self.path) in read:
            raise SceneError(
                [
                    f"{self.path}: the scene is read from this file; save its edits under another name"
                ]
            )

    def _head(self) -> None:
        below = self.opened.stage.GetRootLayer().pseudoRoot
        self.layer.subLayerPaths.append(str(self.below))
        for name in _OF_THE_ROOT:
            if below.HasInfo(name):
                self.layer.pseudoRoot.SetInfo(name, below.GetInfo(name))

    def _author(self) -> None:
        things, before = _by_path(self.scene), _by_path(self.base)
        gone = [path for path in before if path not in things]
        for path in gone:
            if kept := next((p for p in things if at_or_below(p, path)), None):
                raise SceneError([f"{path}: cannot be taken out while {kept} below it stays"])
            if not any(at_or_below(path, other) and path != other for other in gone):
                self.author.remove(path)  # with all below it
        ordered = sorted(things, key=lambda path: path.count("/"))  # what is above comes first
        for path in ordered:
            thing, old = things[path], before.get(path)
            if isinstance(thing, Node):
                self.author.node(thing, old if isinstance(old, Node) else None)
            else:
                self.author.radio(_role(self.scene, thing), thing, old)
        for path in ordered:
            self.author.place(things[path], before.get(path))
        if self.scene.frequency != self.base.frequency:
            self.author.frequency(self.scene.frequency)

    def _relative(self, path: str) -> str:
        """Relative with a leading dot: USD searches for a bare name elsewhere too."""
        relative = os.path.relpath(os.path.realpath(path), os.path.realpath(self.path.parent))
        relative = relative.replace(os.sep, "/")
        return relative if relative.startswith(".") else f"./{relative}"

    def _verify(self, file: Path) -> None:
        """Read the layer back: the same scene, or SceneError."""
        own = files.default_root(self.path)
        roots = [*self.opened.roots, *self.author.folders]
        self.foreign = sorted({r for r in roots if files.outside(str(r), [own])})
        options = Options({}, [*roots, own], self.options.time)
        read, meant = _by_path(scene_of(file, options, self.kept)), _by_path(self.scene)
        faults = [f"{p}: is not read back" for p in meant if p not in read]
        faults += [
            f"{p}: is read back, though it is not in the scene" for p in read if p not in meant
        ]
        for path in meant.keys() & read.keys():
            faults += [
                f"{path}: {why} is not read back" for why in _differences(meant[path], read[path])
            ]
        if faults:
            raise SceneError(
                [f"{f}; write the whole scene with to_usd instead" for f in sorted(faults)]
            )


def _by_path(scene: Scene) -> dict[str, Node | Radio]:
    return {t.path: t for t in (*scene.nodes, *scene.transmitters, *scene.receivers)}


def _role(scene: Scene, radio: Radio) -> str:
    return "tx" if any(r is radio for r in scene.transmitters) else "rx"


def _differences(meant: Any, read: Any) -> Iterator[str]:
    """What a thing was meant to be and is not, when it was read back."""
    if type(meant) is not type(read):
        yield "what it is"
        return
    if isinstance(meant, Node):
        if not (_near(meant.pose.rotation, read.pose.rotation)
                and _near(meant.pose.translation, read.pose.translation)):  # fmt: skip
            yield "its place"
        if not _same_shape(meant, read):
            yield "its shape"
        if not _same_surface(meant.body.surface, read.body.surface):
            yield "its surface"
        if meant.body.band != read.body.band:
            yield "its band"
    else:
        exact = replace(
            meant, position=read.position, rotation=read.rotation, velocity=read.velocity
        )
        if not (_near(meant.position, read.position) and _near(meant.rotation, read.rotation)):
            yield "its place"
        if not alike(exact, read):
            yield "what it sends or hears"
    if not _near(meant.velocity, read.velocity):
        yield "its velocity"


def _same_shape(meant: Node, read: Node) -> bool:
    """Bit by bit, or, for known shapes, sizes in the world: those absorb a scale when they are read."""
    (body, scales), (also, others) = unstretched(meant.body), unstretched(read.body)
    one, other = body.shape, also.shape
    if same_bits(one, other):
        return _near(meant.pose.scale * scales, read.pose.scale * others)
    left, right = _lengths(one, meant.pose), _lengths(other, read.pose)
    return (
        one.kind == other.kind != "neural"
        and left.keys() == right.keys()
        and all(_near(value, right[name]) for name, value in left.items())
    )


def _same_surface(one: Any, other: Any) -> bool:
    """Bit by bit, or one material, as thick: a wall's thickness may be one of its sides."""
    left, right = material_of(one), material_of(other)
    if same_bits(one, other) or left is None or right is None or left.thickness is None:
        return same_bits(one, other)
    near = right.thickness is not None and abs(left.thickness - right.thickness) <= AGREED
    return near and replace(left, thickness=right.thickness) == right


def _lengths(shape: Any, pose: Pose) -> dict[str, Any]:
    return {
        name: value.detach().cpu() * pose.scale.detach().cpu()
        for name, value in shape.named_parameters()
    }


def _near(a: Any, b: Any) -> bool:
    a, b = a.detach().cpu().double(), b.detach().cpu().double()
    size = max(1.0, float(a.abs().max())) if a.numel() else 1.0
    return a.shape == b.shape and bool(((a - b).abs() <= AGREED * size).all())
