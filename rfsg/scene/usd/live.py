"""A stage that is followed: edits by pxr calls and by other programs are seen at the next look."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from pxr import Sdf, Tf, Usd

from rfsg.scene.scene import Scene, SceneError, at_or_below
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.kept import Kept, Stamp, stamp_of
from rfsg.scene.usd.layers import composed_again, reload
from rfsg.scene.usd.objects import WEIGHTS
from rfsg.scene.usd.reading import Reader
from rfsg.scene.usd.source import Opened, Options, opened


class LiveScene:
    """Follows a USD file, or a stage that is open: ``scene`` is what stands there now.

        live = rfsg.LiveScene("lab.usda")
        rfsg.simulate(live.scene)
        UsdGeom.XformCommonAPI(live.stage.GetPrimAtPath("/World/Cabinet")).SetTranslate((1, 2, 0))
        rfsg.simulate(live.scene)  # with the cabinet where it is now

    Seen are edits of the stage, and files that another program has written since: layers, weights
    and patterns. Layers with edits that are not saved yet are left alone. While nothing changed,
    ``scene`` is the same object. Otherwise what did not change keeps its identity, and no weights
    file is read again that did not change; if only transforms did, only what they carry is looked at.

    Options are those of ``rfsg.scene.usd.read``; variants are chosen beside the stage that is given.
    Not for several threads at once. Raises SceneError as ``read`` does, here and from ``scene``.
    """

    def __init__(
        self,
        source: "str | Path | Usd.Stage",
        *,
        variants: Mapping[str, Mapping[str, str]] | None = None,
        asset_roots: Sequence[str | Path] = (),
        time: int | float | None = None,
        device: torch.device | str = "cpu",
    ):
        self._source = source
        self._options = Options(dict(variants or {}), tuple(asset_roots), time, device)
        self._kept = Kept()
        self._changed: list[Sdf.Path] = []
        self._scene: Scene | None = None  # None: to be read as a whole
        self._stamps: dict[str, Stamp | None] = {}
        with quiet(str(source)):
            self._follow(opened(source, self._options))
        self._scene = self._whole()

    @property
    def stage(self) -> Any:
        """The ``Usd.Stage`` that is followed, to be edited by pxr calls. What is edited and not
        saved changes no file."""
        return self._opened.stage

    @property
    def scene(self) -> Scene:
        """What stands on the stage now."""
        self._reload()
        if self._scene is None:
            self._compose()
        changed, self._changed = self._changed, []
        try:
            if self._scene is None or self._kept.stale():
                self._scene = self._whole()
            elif changed:
                moved = all(_placement(path) for path in changed)
                part = self._moved(self._scene, changed) if moved else None
                self._scene = part or self._whole()
        except BaseException:
            self._scene = None
            raise
        return self._scene

    def _follow(self, stage: Opened) -> None:
        self._opened = stage
        notice = Usd.Notice.ObjectsChanged
        self._key = Tf.Notice.Register(notice, self._note, stage.stage)  # as long as it is held

    def _note(self, notice: Any, stage: Any) -> None:
        """Runs in the middle of the caller's edit: notes and does nothing."""
        self._changed += notice.GetResyncedPaths()
        self._changed += notice.GetChangedInfoOnlyPaths()

    def _reload(self) -> None:
        """Take over what other programs wrote."""
        layers = [layer for layer in self._layers() if not layer.dirty]
        stale = [
            layer
            for layer in layers
            if stamp_of(layer.realPath) != self._stamps.get(layer.realPath)
        ]
        if not stale:
            return
        stamps = {layer.realPath: stamp_of(layer.realPath) for layer in stale}
        self._scene = None  # a fault below must not be forgotten
        with quiet(str(self._opened.path)):
            reload(stale, self._opened.roots)
        self._stamps |= stamps

    def _compose(self) -> None:
        """Look again for files that were missing."""
        with quiet(str(self._opened.path)):
            if self._opened.stage.GetCompositionErrors():
                stage = composed_again(self._opened.stage, self._opened.roots)
                self._follow(replace(self._opened, stage=stage))

    def _layers(self) -> list[Sdf.Layer]:
        return [layer for layer in self._opened.stage.GetUsedLayers() if layer.realPath]

    def _whole(self) -> Scene:
        """Everything read, with what is known from before."""
        self._changed = []
        for layer in self._layers():
            self._stamps.setdefault(layer.realPath, stamp_of(layer.realPath))
        with quiet(str(self._opened.path)):
            reader = Reader(self._opened, self._options, self._kept)
            scene, faults = reader.scene(self._source), reader.faults
            del reader
        if faults:
            raise SceneError(faults)
        return scene

    def _moved(self, scene: Scene, changed: Sequence[Sdf.Path]) -> Scene | None:
        """The scene with what the changed transforms carry read again; None if that is not all."""
        new: dict[str, Any] = {}
        for top in self._tops(changed):
            with quiet(str(self._opened.path)):
                reader = Reader(self._opened, self._options, self._kept)
                part, faults = reader.below(top), reader.faults
                del reader
            if faults:
                raise SceneError(faults)
            things = {t.path: t for t in _things(part)}
            here = str(top.GetPath())
            if things.keys() != {t.path for t in _things(scene) if at_or_below(t.path, here)}:
                return None
            new |= things
        nodes, tx, rx = (
            tuple(new.get(t.path, t) for t in group)
            for group in (scene.nodes, scene.transmitters, scene.receivers)
        )
        base = Scene(nodes, tx, rx, scene.frequency, scene.warnings)
        return replace(base, source=replace(scene.source, base=base))

    def _tops(self, changed: Sequence[Sdf.Path]) -> list[Usd.Prim]:
        """The prims to be walked, none below another; a neural object is walked as a whole."""
        tops: set[Sdf.Path] = set()
        for path in changed:
            prim = self._opened.stage.GetPrimAtPath(path.GetPrimPath())
            if not (prim and prim.IsActive() and prim.IsDefined() and prim.IsLoaded()):
                continue
            above = [p for p in path.GetPrimPath().GetPrefixes() if self._neural(p)]
            tops.add(above[0] if above else path.GetPrimPath())
        first = Sdf.Path.RemoveDescendentPaths(list(tops))
        return [self._opened.stage.GetPrimAtPath(path) for path in first]

    def _neural(self, path: Sdf.Path) -> bool:
        return self._opened.stage.GetPrimAtPath(path).GetAttribute(WEIGHTS).HasAuthoredValue()


def _placement(path: Sdf.Path) -> bool:
    """Whether a change there is one of a transform: it carries what stands below, and no more."""
    inside = str(path).startswith("/__Prototype")
    return path.IsPropertyPath() and path.name.startswith("xformOp") and not inside


def _things(scene: Scene) -> tuple[Any, ...]:
    return (*scene.nodes, *scene.transmitters, *scene.receivers)
