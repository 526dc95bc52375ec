"""Where a scene comes from: a file or an open stage, and how it is to be read."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from pxr import Sdf, Usd

from rfsg.objects.contract import Surface
from rfsg.scene import files
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.usd.composition import is_prim_path
from rfsg.scene.usd.kept import Kept
from rfsg.scene.usd.layers import open_stage

Variants = Mapping[str, Mapping[str, str]]  # {prim path: {variant set: choice}}


@dataclass(frozen=True)
class Options:
    """How a stage is to be read; see ``rfsg.scene.usd.read``."""

    variants: Variants = field(default_factory=dict)
    asset_roots: Sequence[str | Path] = ()
    time: int | float | None = None
    device: torch.device | str = "cpu"

    def code(self, stage: Usd.Stage) -> Usd.TimeCode:
        if self.time is not None:
            if not math.isfinite(self.time):
                raise SceneError([f"time is {self.time}; expected a finite time code"])
            return Usd.TimeCode(float(self.time))
        if stage.HasAuthoredTimeCodeRange():
            return Usd.TimeCode(stage.GetStartTimeCode())
        return Usd.TimeCode.EarliestTime()


@dataclass(frozen=True)
class Source:
    """What a scene was read from, how, and as what; and what the next reading need not make again.

    path: the file, or the name of a stage that has none. given: the open stage that was read, if it
    was one. base: the scene as it was read, before any edit. material_names: what its surfaces were
    called there."""

    path: str
    options: Options
    given: Any
    base: Scene
    kept: Kept
    material_names: tuple[tuple[Surface, str], ...] = ()

    @staticmethod
    def of(scene: Scene, wanted: str) -> "Source":
        if not isinstance(scene.source, Source):
            raise SceneError(
                [f"{wanted}: this scene was made in Python, not read from USD; write it with "
                 "to_usd and read that"]
            )  # fmt: skip
        return scene.source


@dataclass(frozen=True)
class Opened:
    """A stage that may be read: ``roots`` are the folders that its assets may lie in."""

    path: Path
    stage: Usd.Stage
    roots: tuple[Path, ...]
    faults: tuple[str, ...]  # of the variants that were asked for


def opened(source: "str | Path | Usd.Stage", options: Options) -> Opened:
    """The stage of a file, opened safely, or an open stage, with the variants chosen.

    Variants are chosen in a session layer of our own: neither the file nor the caller's stage is
    touched. Raises SceneError for files that may not be opened."""
    extra = tuple(Path(root) for root in options.asset_roots)
    if isinstance(source, (str, Path)):
        path = Path(source)
        roots = (files.default_root(path), *extra)
        stage = open_stage(path, roots)
    else:
        layer = source.GetRootLayer()
        path = Path(layer.realPath or layer.identifier)
        roots = (files.default_root(path), *extra) if layer.realPath else extra
        stage = _beneath(source) if options.variants else source
    return Opened(path, stage, roots, tuple(_choose(stage, options.variants)))


def _beneath(stage: Usd.Stage) -> Usd.Stage:
    """The same layers under a session layer of our own, which the caller's own session is part of."""
    session = Sdf.Layer.CreateAnonymous("session.usda")
    session.subLayerPaths.append(stage.GetSessionLayer().identifier)
    return Usd.Stage.Open(stage.GetRootLayer(), session)


def _choose(stage: Usd.Stage, variants: Variants) -> list[str]:
    """Choose variants in the session layer; what cannot be chosen is returned as faults."""
    faults: list[str] = []
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for path, choices in variants.items():
            prim = stage.GetPrimAtPath(path) if is_prim_path(path) else None
            if not prim:
                faults.append(f"{path}: no prim here to choose variants on")
                continue
            for name, choice in choices.items():
                known = {
                    s: prim.GetVariantSet(s).GetVariantNames()
                    for s in prim.GetVariantSets().GetNames()
                }
                if choice in known.get(name, ()):
                    prim.GetVariantSet(name).SetVariantSelection(choice)
                else:
                    faults.append(f"{path}: no variant {name}={choice}; it has {known}")
    return faults
