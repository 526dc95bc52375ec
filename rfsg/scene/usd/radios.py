"""Radios: prims with a role, their measured patterns and arrays, read and written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pxr import Sdf, Usd, Vt

from rfsg.scene.arrays import Array
from rfsg.scene.fields import RADIO
from rfsg.scene.patterns import MAX_PATTERN_BYTES, Pattern, parse
from rfsg.scene.radios import Radio
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import RADIO_API, as_numpy, author, values_of
from rfsg.scene.usd.faults import attempt
from rfsg.scene.usd.kept import Kept
from rfsg.scene.usd.layers import asset_bytes, asset_path
from rfsg.scene.usd.placements import Places

PATTERN_FILE = "rfsg:radio:patternFile"
ARRAY = ("rows", "columns", "spacingVertical", "spacingHorizontal", "offsets", "unit")


@dataclass
class Radios:
    """The radios of a stage found so far, by role, and the patterns read for them."""

    places: Places
    roots: Sequence[Path]
    device: torch.device
    warnings: list[str]  # the scene's, which those of radios join
    kept: Kept
    found: dict[str, list[Radio]] = field(default_factory=lambda: {"tx": [], "rx": []})
    patterns: dict[str, Pattern] = field(default_factory=dict)  # by resolved path

    def read(self, prim: Usd.Prim) -> None:
        """Find the radio of a prim that has a role. Raises SceneError."""
        if not prim.GetAttribute("rfsg:radio:role").HasAuthoredValue():
            return
        faults: list[str] = []
        said = attempt(faults, lambda: values_of(prim, self.places.time, *RADIO))
        pose = attempt(faults, lambda: self.places.placement(prim).pose())
        velocity = attempt(faults, lambda: self.places.velocity(prim))
        if faults or said is None or pose is None or velocity is None:
            raise SceneError(faults)
        pattern = attempt(faults, lambda: self._pattern(prim))
        array = attempt(faults, lambda: _array(prim, said))
        if faults:
            raise SceneError(faults)
        if pattern is not None and pattern.vector and said["rfsg:radio:polarization"] == "none":
            self.warnings.append(
                f"{prim.GetPath()}: the pattern's field is measured, but rfsg:radio:polarization is "
                "none: where no radio is polarised only its magnitude counts; V takes it as it is"
            )
        radio = Radio(
            str(prim.GetPath()),
            pose.translation.to(self.device),
            pose.rotation.to(self.device),
            velocity.to(self.device),
            said["rfsg:radio:powerDbm"],
            said["rfsg:radio:frequencyHz"],
            pattern or said["rfsg:radio:pattern"],
            said["rfsg:radio:polarization"],
            array,
        )
        role = said["rfsg:radio:role"]
        self.found[role].append(self.kept.same((role, radio.path), radio))

    def _pattern(self, prim: Usd.Prim) -> Pattern | None:
        """The measured pattern of a radio, read once for all radios with the same file."""
        where = str(prim.GetPath())
        said = prim.GetAttribute(PATTERN_FILE).Get()
        if not (said.path if isinstance(said, Sdf.AssetPath) else said):
            return None
        resolved, given = asset_path(prim, PATTERN_FILE, self.roots, where)
        if resolved not in self.patterns:
            what = f"{where}: patternFile {given!r}"

            def parsed() -> Pattern:
                data = asset_bytes(resolved, what, MAX_PATTERN_BYTES)
                return parse(data, f"{where}: {given}", resolved)

            pattern = self.kept.of(("pattern", resolved, self.kept.stamp(resolved)), parsed)
            self.patterns[resolved] = pattern
            self.warnings += [f"{where}: {warning}" for warning in pattern.warnings()]
        return self.patterns[resolved]


def _array(prim: Usd.Prim, said: Mapping[str, Any]) -> Array | None:
    """The array that a radio's attributes describe, or None where they say nothing."""
    rows, columns, vertical, horizontal, offsets, unit = (
        said[f"rfsg:radio:array:{name}"] for name in ARRAY
    )
    planar = rows is not None or columns is not None
    where = prim.GetPath()
    if planar and offsets is not None:
        raise SceneError(
            [f"{where}: rfsg:radio:array has offsets as well as rows or columns; say one of them"]
        )
    try:
        if offsets is not None:
            return Array(torch.from_numpy(offsets), unit)
        return Array.planar(rows or 1, columns or 1, vertical, horizontal, unit) if planar else None
    except SceneError as error:
        raise SceneError([f"{where}: {fault}" for fault in error.faults]) from error


def author_radio(prim: Usd.Prim, role: str, radio: Radio, file: Sdf.AssetPath | None) -> None:
    """Author all that a radio is besides its pose; ``file`` holds its pattern if that is measured."""
    values = (
        role,
        radio.power_dbm,
        radio.frequency,
        None if isinstance(radio.pattern, Pattern) else radio.pattern,
        file,
        radio.polarization,
        *_array_values(radio.array),
    )
    author(prim, dict(zip(RADIO, values, strict=True)), RADIO_API)


def _array_values(array: Array | None) -> tuple[Any, ...]:
    """An array as the attributes of ``ARRAY``."""
    if array is None:
        return (None,) * len(ARRAY)
    if array.layout is not None:
        return (*array.layout, None, array.unit)
    offsets = Vt.Vec3dArray.FromNumpy(np.ascontiguousarray(as_numpy(array.offsets)))
    return (None, None, None, None, offsets, array.unit)
