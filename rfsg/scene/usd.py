"""USD <-> Scene: the only door to pxr.

Attributes are the truth (``rfsg:neural:*``, ``rfsg:material:*``, ``rfsg:radio:*``, ``rfsg:shape``,
``rfsg:velocity``, ``rfsg:frequencyHz``); the API schemas of ``schema/`` are a courtesy to other
programs, and the fallbacks are the tables below. All rfsg values are SI, whatever metersPerUnit
says: thickness in metres, velocity in m/s along the stage's axes. The loader converts places and
sizes to metres and turns the stage so that z is up.

Where USD leaves room: visibility does not make a thing vanish for waves (``active = false`` does);
purposes guide and proxy do; a material bound on an ancestor holds for all below it; the numbers of
a neural object are metres of the layer that brought its weights in.
"""

import difflib
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pxr import Ar, Gf, Kind, Pcp, Plug, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from rfsg.objects.body import Body
from rfsg.objects.catalogue import shape_class
from rfsg.objects.contract import Shape, Surface
from rfsg.scene import files
from rfsg.scene.arrays import Array
from rfsg.scene.fields import (
    FIELDS,
    FREQUENCY,
    MATERIAL,
    NEURAL,
    RADIO,
    SHAPE,
    VELOCITY,
    Field,
)
from rfsg.scene.materials import Material, material_of
from rfsg.scene.patterns import MAX_PATTERN_BYTES, Pattern, parse
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.transforms import TOLERANCE, Placement, broken, decompose
from rfsg.scene.weights import (
    FORMAT_VERSION,
    MAX_WEIGHTS_BYTES,
    digest,
    pack,
    refuse_overwrite,
    same_bits,
    unpack,
    write_beside,
)

NEURAL_API, MATERIAL_API, RADIO_API = "RfsgNeuralObjectAPI", "RfsgMaterialAPI", "RfsgRadioAPI"
SCHEMA_FOLDER = Path(__file__).with_name("schema")
WEIGHTS, PATTERN_FILE = "rfsg:neural:weights", "rfsg:radio:patternFile"
ARRAY = ("rows", "columns", "spacingVertical", "spacingHorizontal", "offsets", "unit")
MAX_PRIMS = 200_000
SHOWN = 12  # paths named in a warning before "and more"


_TYPES = Sdf.ValueTypeNames
USD_TYPES = {
    "asset": _TYPES.Asset,
    "int": _TYPES.Int,
    "bool": _TYPES.Bool,
    "string": _TYPES.String,
    "token": _TYPES.Token,
    "double": _TYPES.Double,
    "float3": _TYPES.Float3,
    "double3": _TYPES.Double3,
    "double3[]": _TYPES.Double3Array,
}


def _register_schema() -> None:
    """Late registration fails without a word, so the registry is asked and the user told once."""
    Plug.Registry().RegisterPlugins(str(SCHEMA_FOLDER))
    if not Usd.SchemaRegistry().IsAppliedAPISchema(NEURAL_API):
        warnings.warn(
            "rfsg's USD schema came too late: pxr's schema registry was already in use. Scenes are "
            "read and written all the same; import rfsg before using pxr to see the API schemas.",
            stacklevel=2,
        )


_register_schema()


# ---- the door ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Source:
    """Where a scene was read from, and what its materials were called there."""

    path: str
    material_names: tuple[tuple[Surface, str], ...] = ()


def read(
    path: str | Path,
    *,
    variants: Mapping[str, Mapping[str, str]] | None = None,
    asset_roots: Sequence[str | Path] = (),
    time: int | float | None = None,
    device: torch.device | str = "cpu",
) -> Scene:
    """Read a USD scene (usda, usdc, usd, usdz) into metres, z up.

    variants: {prim path: {variant set: choice}}, set in the session, the file stays as it is.
    asset_roots: folders that may be read besides the scene's root: its nearest ancestor folder that
    holds a file named ``rfsg-assets.toml``, else its own folder. time: a time code; by default the
    stage's start, else the earliest sample. device: where the tensors go.

    Raises SceneError listing all faults. Only files that may not be opened, or cannot be parsed,
    are listed on their own, before composition. Untrusted scenes belong into a child process with
    limits on time and memory: nothing in one process can bound what composition takes, and OpenUSD
    itself may print lines of its own about a damaged binary layer.
    """
    with _quiet(path):
        reader = _Reader.open(Path(path), variants or {}, asset_roots, time, device)
        scene, faults = reader.scene(), reader.faults
        del reader  # a traceback that somebody keeps must not keep the stage open
    if faults:
        raise SceneError(faults)
    return scene


def check(path: str | Path, **options: Any) -> list[str]:
    """Every fault of a scene, one line each: what ``read`` (same options) refuses, and what the
    validators that come with OpenUSD find. An empty list is a scene in order."""
    from pxr import UsdValidation

    options = {"variants": {}, "asset_roots": (), "time": None, "device": "cpu"} | options
    faults: list[str] = []
    try:
        with _quiet(path):
            reader = _Reader.open(Path(path), **options)
            reader.scene()
            faults += reader.faults
            validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
            found = UsdValidation.ValidationContext(validators).Validate(reader.stage)
            # what does not compose or resolve is among the reader's faults, with its prim
            own = {"CompositionError", "UnresolvableDependency"} if faults else set()
            faults += [_finding(e, str(path)) for e in found if e.GetName() not in own]
            del found
    except SceneError as error:
        faults += error.faults
    return list(dict.fromkeys(faults))


def _finding(error: Any, file: str) -> str:
    prims = [str(s.GetPrim().GetPath()) for s in error.GetSites() if s.GetPrim()]
    where = prims[0] if prims else file
    return f"{where}: {_one_line(error.GetMessage())} (OpenUSD {error.GetName()})"


@contextmanager
def _quiet(path: str | Path) -> Iterator[None]:
    """Hold pxr's diagnostics: what matters is said again as faults, with prim paths. What pxr
    raises where nobody expects it (a corrupt crate, say) becomes a fault of the file."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    except _PXR_ERRORS as error:
        raise SceneError([f"{path}: {_pxr_words(error)}"]) from error
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


# ---- opening ----------------------------------------------------------------------------------


def _open(path: Path, roots: Sequence[Path]) -> Usd.Stage:
    """Open a stage whose every layer was first found safe to open. Raises SceneError."""
    faults: list[str] = []
    layers = _safe_layers(path, roots, faults)
    if faults:
        raise SceneError(faults)
    return Usd.Stage.Open(layers[0], Sdf.Layer.CreateAnonymous("session.usda"))


def _safe_layers(path: Path, roots: Sequence[Path], faults: list[str]) -> list[Sdf.Layer]:
    """Open the layers that composition would open, each after a look at its file."""
    layers: list[Sdf.Layer] = []
    seen: set[str] = set()
    todo = [str(path.absolute())]
    while todo:
        file = todo.pop()
        reason = files.unsafe_layer(file)
        try:
            layer = None if reason else _current(file)
        except _PXR_ERRORS as error:
            layer, reason = None, _pxr_words(error)
        if layer is None:
            faults.append(f"{file}: {reason or 'cannot be opened'}")
            continue
        layers.append(layer)
        for given in layer.GetCompositionAssetDependencies():
            found, why = (
                _look_up(given, layer.ComputeAbsolutePath(given), roots) if given else ("", "")
            )
            if why:
                faults.append(f"{file}{_users(layer, given)}: {given!r} {why}")
            elif found and found not in seen:  # what is missing is among the composition errors
                todo.append(found)
            seen.add(found)
    return layers


def _current(file: str) -> Sdf.Layer | None:
    """The layer as the file is now: pxr hands out one that is open already, however old. Edits that
    somebody has not saved yet are left alone."""
    layer = Sdf.Layer.FindOrOpen(file)
    if layer and not layer.dirty:
        layer.Reload()
    return layer


def _look_up(given: str, anchored: str, roots: Sequence[Path]) -> tuple[str, str]:
    """(resolved path or "", why it is refused or "") of an asset path."""
    if files.is_url(given):
        return "", "is a URL; rfsg reads files only"
    found = str(Ar.GetResolver().Resolve(anchored))
    return found, (files.outside(found, roots) or "") if found else ""


def _users(layer: Sdf.Layer, given: str) -> str:
    """`` </World/Cabinet>`` when a prim of the layer references or loads the asset path."""
    users: list[str] = []

    def visit(path: Sdf.Path) -> None:
        prim = path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        spec = layer.GetPrimAtPath(path) if prim else None
        if spec:
            arcs = [*spec.referenceList.GetAddedOrExplicitItems()]
            arcs += spec.payloadList.GetAddedOrExplicitItems()
            users.extend(f" <{path}>" for arc in arcs if arc.assetPath == given)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return users[0] if users else ""


# the second comes of strings in binary layers that are not UTF-8
_PXR_ERRORS = (Tf.ErrorException, UnicodeDecodeError)


def _pxr_words(error: Exception) -> str:
    """The message of a pxr exception without the names of its C++ functions."""
    try:
        text = str(error).strip()
    except UnicodeDecodeError:
        return "OpenUSD refuses it, in words that are not UTF-8"
    return _one_line(text.split(" : '", 1)[-1].rstrip("'\n ") if " : '" in text else text)


def _one_line(text: str) -> str:
    return " ".join(text.split())


# ---- reading ----------------------------------------------------------------------------------


@dataclass
class _Reader:
    """The state of one read. Faults gather here: a prim at fault is left out, reading goes on."""

    path: Path
    stage: Usd.Stage
    roots: tuple[Path, ...]
    time: Usd.TimeCode
    device: torch.device
    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)
    radios: dict[str, list[Radio]] = field(default_factory=lambda: {"tx": [], "rx": []})
    decor: list[str] = field(default_factory=list)
    weights: dict[tuple[str, str], Body] = field(default_factory=dict)
    patterns: dict[str, Pattern] = field(default_factory=dict)  # by resolved path
    surfaces: dict[Any, Surface] = field(default_factory=dict)
    bodies: dict[Any, Body] = field(default_factory=dict)
    world: np.ndarray = field(default_factory=lambda: np.eye(4))  # world [m, z up] from stage
    cache: UsdGeom.XformCache = field(init=False)
    asset_root: Sdf.Path = Sdf.Path.emptyPath  # the neural object that the traversal is inside of

    @staticmethod
    def open(
        path: Path,
        variants: Mapping[str, Mapping[str, str]],
        asset_roots: Sequence[str | Path],
        time: int | float | None,
        device: torch.device | str,
    ) -> "_Reader":
        roots = (files.default_root(path), *(Path(r) for r in asset_roots))
        stage = _open(path, roots)
        code = Usd.TimeCode.EarliestTime()
        if stage.HasAuthoredTimeCodeRange():
            code = Usd.TimeCode(stage.GetStartTimeCode())
        if time is not None:
            code = Usd.TimeCode(float(time))
        reader = _Reader(path, stage, roots, code, torch.device(device))
        reader._choose(variants)
        return reader

    def scene(self) -> Scene:
        """Read everything; what is at fault is in ``faults`` afterwards."""
        self._composition()
        self._conventions()
        self.cache = UsdGeom.XformCache(self.time)
        for prim in self._prims():
            for step in (self._spelling, self._units, self._thing, self._antenna):
                try:
                    step(prim)
                except SceneError as error:
                    self.faults += error.faults
                except _PXR_ERRORS as error:
                    self.faults.append(f"{prim.GetPath()}: {_pxr_words(error)}")
        self.faults = list(dict.fromkeys(self.faults))
        if self.decor:
            self.warnings.append(
                _named("prim(s) without radio material, not seen by waves", self.decor)
            )
        names = tuple((s, Sdf.Path(where).name) for (where, _), s in self.surfaces.items())
        return Scene(
            tuple(self.nodes),
            tuple(self.radios["tx"]),
            tuple(self.radios["rx"]),
            self._frequency(),
            tuple(self.warnings),
            Source(str(self.path), names),
        )

    # the stage

    def _choose(self, variants: Mapping[str, Mapping[str, str]]) -> None:
        with Usd.EditContext(self.stage, self.stage.GetSessionLayer()):
            for path, choices in variants.items():
                prim = self.stage.GetPrimAtPath(path) if _prim_path(path) else None
                if not prim:
                    self.faults.append(f"{path}: no prim here to choose variants on")
                    continue
                for name, choice in choices.items():
                    known = {
                        s: prim.GetVariantSet(s).GetVariantNames()
                        for s in prim.GetVariantSets().GetNames()
                    }
                    if choice in known.get(name, ()):
                        prim.GetVariantSet(name).SetVariantSelection(choice)
                    else:
                        self.faults.append(f"{path}: no variant {name}={choice}; it has {known}")

    def _composition(self) -> None:
        for error in self.stage.GetCompositionErrors():
            self.faults.append(f"{error.rootSite.path}: {_one_line(str(error))}")
        for layer in self.stage.GetUsedLayers():
            if layer.realPath and (why := files.outside(layer.realPath, self.roots)):
                self.faults.append(f"{layer.realPath}: {why}")

    def _conventions(self) -> None:
        unit = UsdGeom.GetStageMetersPerUnit(self.stage)
        if not UsdGeom.StageHasAuthoredMetersPerUnit(self.stage):
            self.faults.append(
                f"{self.path}: metersPerUnit is missing; say 1 for metres, 0.01 for cm"
            )
        elif not (np.isfinite(unit) and unit > 0):
            self.faults.append(f"{self.path}: metersPerUnit is {unit}; expected a number > 0")
        else:
            self.world[:3, :3] *= unit
        up = self.stage.GetMetadata("upAxis")  # USD's own fallback is Y
        if up == "Y":
            self.world[:3, :3] = self.world[:3, :3] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
        elif up != "Z":
            self.faults.append(f"{self.path}: upAxis is {up!r}; expected Y or Z")

    def _frequency(self) -> float | None:
        root = self.stage.GetDefaultPrim()
        try:
            return self._values(root, FREQUENCY)[FREQUENCY.name] if root else None
        except SceneError as error:
            self.faults += error.faults
            return None

    def _prims(self) -> Iterator[Usd.Prim]:
        walk = iter(Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()))
        for count, prim in enumerate(walk):
            if count >= MAX_PRIMS:
                self.faults.append(f"{prim.GetPath()}: more than {MAX_PRIMS} prims in the scene")
                return
            if prim.IsA(UsdGeom.PointInstancer):
                self.faults.append(
                    f"{prim.GetPath()}: point instancers are not read; use instanceable references"
                )
                walk.PruneChildren()
                continue
            imageable = UsdGeom.Imageable(prim)
            purpose = imageable.ComputePurpose() if imageable else UsdGeom.Tokens.default_
            if purpose not in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
                yield prim

    # one prim

    def _spelling(self, prim: Usd.Prim) -> None:
        """An rfsg attribute that nobody reads is most likely a slip: a warning."""
        for prop in prim.GetAuthoredPropertiesInNamespace("rfsg"):
            name = prop.GetName()
            if name not in FIELDS and not name.startswith("rfsg:provenance:"):
                near = difflib.get_close_matches(name, FIELDS, 1)
                hint = f"; did you mean {near[0]}?" if near else ""
                self.warnings.append(f"{prim.GetPath()}: attribute {name} is unknown{hint}")

    def _units(self, prim: Usd.Prim) -> None:
        """USD converts neither units nor axes across references: refuse, naming what to add."""
        if not (prim.HasAuthoredReferences() or prim.HasAuthoredPayloads()):
            return
        if not any(p.IsA(UsdGeom.Xformable) for p in Usd.PrimRange(prim)):
            return  # a library of materials has no size and no up
        xform = UsdGeom.Xformable(prim)
        local = np.array(xform.GetLocalTransformation(self.time)).T if xform else np.eye(4)
        for arc in Usd.PrimCompositionQuery(_spec(prim)).GetCompositionArcs():
            if arc.IsAncestral() or arc.GetArcType() not in _REFERENCES:
                continue
            outer, inner = _layer(arc.GetIntroducingNode()), _layer(arc.GetTargetNode())
            if outer is None or inner is None or outer == inner:
                continue
            self._same_metre(prim, local, inner, outer)
            self._same_up(prim, local, inner, outer)

    def _same_metre(self, prim: Usd.Prim, local: Any, inner: Sdf.Layer, outer: Sdf.Layer) -> None:
        mine, theirs = _metre(outer), _metre(inner)
        if mine is None or theirs is None or mine <= 0 or np.isclose(mine, theirs, rtol=TOLERANCE):
            return
        ratio = theirs / mine
        scales = np.linalg.norm(local[:3, :3], axis=0)
        if not np.allclose(scales, ratio, rtol=TOLERANCE):
            self.faults.append(
                f"{prim.GetPath()}: references {inner.realPath}, whose metersPerUnit is {theirs:g} "
                f"(here {mine:g}); add the scale {ratio:g} on this prim"
            )

    def _same_up(self, prim: Usd.Prim, local: Any, inner: Sdf.Layer, outer: Sdf.Layer) -> None:
        mine, theirs = _up(outer), _up(inner)
        if mine is None or theirs is None or mine == theirs or {mine, theirs} - {"Y", "Z"}:
            return
        axis = {"Y": np.array([0, 1.0, 0]), "Z": np.array([0, 0, 1.0])}
        turned = local[:3, :3] @ axis[theirs]
        length = np.linalg.norm(turned)
        if not np.allclose(turned, length * axis[mine], atol=TOLERANCE * length):
            self.faults.append(
                f"{prim.GetPath()}: references {inner.realPath}, whose upAxis is {theirs} (here "
                f"{mine}); add rotateX = {90 if theirs == 'Y' else -90} on this prim"
            )

    def _thing(self, prim: Usd.Prim) -> None:
        """A neural object, a half-space, a known shape, or decor."""
        if prim.GetAttribute("rfsg:neural:weights").HasAuthoredValue():
            if not prim.GetPath().HasPrefix(self.asset_root):
                self.asset_root = prim.GetPath()
            self._neural(prim)
        elif prim.GetPath().HasPrefix(self.asset_root):
            return  # the extracted mesh of the neural object
        elif prim.GetAttribute(SHAPE.name).HasAuthoredValue():
            self._values(prim, SHAPE)
            self._known(prim, "halfspace", {}, self._material(prim))
        elif prim.IsA(UsdGeom.Gprim):
            self._gprim(prim)

    def _neural(self, prim: Usd.Prim) -> None:
        said = self._values(prim, *NEURAL[1:])
        where = str(prim.GetPath())
        if said["rfsg:neural:formatVersion"] != FORMAT_VERSION:
            raise SceneError(
                [f"{where}: rfsg:neural:formatVersion is {said['rfsg:neural:formatVersion']}; "
                 f"this rfsg reads {FORMAT_VERSION}"]
            )  # fmt: skip
        faults: list[str] = []
        body = _attempt(faults, lambda: self._trained(prim, where))
        override = _attempt(faults, lambda: self._material(prim))
        pose = _attempt(faults, lambda: self._uniform(prim, 1.0 / self._asset_metre(prim)))
        if faults or body is None or pose is None:
            raise SceneError(faults)
        if override is not None:
            surface = self._surface(prim, *override)
            key = (id(body), id(surface))
            body = self.bodies.setdefault(key, Body(body.shape, surface))
        self._stand(prim, body.to(self.device), pose, self._asset_file(prim))

    def _trained(self, prim: Usd.Prim, where: str) -> Body:
        """The body of a prim's weights, read once for all prims with the same file and hash."""
        resolved, given = _asset_path(prim, WEIGHTS, self.roots, where)
        key = (resolved, prim.GetAttribute("rfsg:neural:sha256").Get())
        if key not in self.weights:
            data = _weights_bytes(prim, resolved, given, where)
            self.weights[key] = unpack(data, f"{where}: {given}")
        return self.weights[key]

    def _gprim(self, prim: Usd.Prim) -> None:
        thin = prim.IsA(UsdGeom.Curves) or prim.IsA(UsdGeom.Points)
        said = None if thin else self._material(prim)
        if said is None:
            self.decor.append(str(prim.GetPath()))
            return
        kind = str(prim.GetTypeName())
        if kind not in _KNOWN:
            raise SceneError(
                [f"{prim.GetPath()}: a {kind} with a radio material; waves see {', '.join(_KNOWN)} "
                 "and neural objects. Make one of a closed mesh with `rfsg learn-shape`"]
            )  # fmt: skip
        sizes = {name: self._size(prim, name) for name in _KNOWN[kind]}
        self._known(prim, kind.lower(), sizes, said)

    def _known(
        self,
        prim: Usd.Prim,
        kind: str,
        sizes: dict[str, float],
        said: tuple[str, Material] | None,
    ) -> None:
        if said is None:
            raise SceneError([f"{prim.GetPath()}: a {kind} needs a radio material"])
        placement = self._placement(prim)
        turn = _AXES[str(prim.GetAttribute("axis").Get()) if "height" in sizes else "Z"]
        placement = Placement(
            placement.rotation @ turn, placement.translation, placement.scales @ turn
        )
        try:
            token, lengths = _measure(kind, sizes, placement)
        except ValueError as error:
            raise SceneError([f"{prim.GetPath()}: a {kind} cannot be {error}"]) from error
        thickness = 2 * min(lengths["half_size"]) if token == "box" else None
        surface = self._surface(prim, *said, thickness)
        key = (_shared(prim), token, str(lengths), id(surface))
        body = self.bodies.get(key) if key[0] else None
        if body is None:
            body = self.bodies[key] = Body(shape_class(token)(**lengths), surface).to(self.device)
        self._stand(prim, body, placement.pose(), None)

    def _stand(self, prim: Usd.Prim, body: Body, pose: Pose, asset: str | None) -> None:
        pose = Pose(*(t.to(self.device) for t in (pose.rotation, pose.translation, pose.scale)))
        velocity = self._velocity(prim)
        self.nodes.append(Node(str(prim.GetPath()), body, pose, velocity, asset))

    def _antenna(self, prim: Usd.Prim) -> None:
        if not prim.GetAttribute("rfsg:radio:role").HasAuthoredValue():
            return
        faults: list[str] = []
        said = _attempt(faults, lambda: self._values(prim, *RADIO))
        pose = _attempt(faults, lambda: self._placement(prim).pose())
        velocity = _attempt(faults, lambda: self._velocity(prim))
        if faults or said is None or pose is None or velocity is None:
            raise SceneError(faults)
        pattern = _attempt(faults, lambda: self._pattern(prim))
        array = _attempt(faults, lambda: self._array(prim, said))
        if faults:
            raise SceneError(faults)
        if pattern is not None and pattern.vector and said["rfsg:radio:polarization"] == "none":
            self.warnings.append(
                f"{prim.GetPath()}: the pattern's field is measured, but rfsg:radio:polarization is "
                "none: where no radio is polarised only its magnitude counts; V takes it as it is"
            )
        self.radios[said["rfsg:radio:role"]].append(
            Radio(
                str(prim.GetPath()),
                pose.translation.to(self.device),
                pose.rotation.to(self.device),
                velocity,
                said["rfsg:radio:powerDbm"],
                said["rfsg:radio:frequencyHz"],
                pattern or said["rfsg:radio:pattern"],
                said["rfsg:radio:polarization"],
                array,
            )
        )

    def _pattern(self, prim: Usd.Prim) -> Pattern | None:
        """The measured pattern of a radio, read once for all radios with the same file."""
        where = str(prim.GetPath())
        said = prim.GetAttribute(PATTERN_FILE).Get()
        if not (said.path if isinstance(said, Sdf.AssetPath) else said):
            return None
        resolved, given = _asset_path(prim, PATTERN_FILE, self.roots, where)
        if resolved not in self.patterns:
            data = _asset_bytes(resolved, f"{where}: patternFile {given!r}", MAX_PATTERN_BYTES)
            pattern = parse(data, f"{where}: {given}", resolved)
            self.patterns[resolved] = pattern
            self.warnings += [f"{where}: {warning}" for warning in pattern.warnings()]
        return self.patterns[resolved]

    def _array(self, prim: Usd.Prim, said: Mapping[str, Any]) -> Array | None:
        """The array that a radio's attributes describe, or None where they say nothing."""
        rows, columns, vertical, horizontal, offsets, unit = (
            said[f"rfsg:radio:array:{name}"] for name in ARRAY
        )
        planar = rows is not None or columns is not None
        where = prim.GetPath()
        if planar and offsets is not None:
            raise SceneError(
                [
                    f"{where}: rfsg:radio:array has offsets as well as rows or columns; say one of them"
                ]
            )
        try:
            if offsets is not None:
                return Array(torch.from_numpy(offsets), unit)
            return (
                Array.planar(rows or 1, columns or 1, vertical, horizontal, unit)
                if planar
                else None
            )
        except SceneError as error:
            raise SceneError([f"{where}: {fault}" for fault in error.faults]) from error

    # its values

    def _values(self, prim: Usd.Prim, *wanted: Field) -> dict[str, Any]:
        """The authored values, else the fallbacks. Raises SceneError with everything amiss."""
        values: dict[str, Any] = {}
        faults: list[str] = []
        for item in wanted:
            attribute = prim.GetAttribute(item.name)
            value = attribute.Get(self.time) if attribute.HasAuthoredValue() else None
            values[item.name] = item.fallback if value is None else _plain(value, item.kind)
            if value is not None and (amiss := item.amiss(values[item.name])):
                faults.append(f"{prim.GetPath()}: {item.name} is {_brief(value)}; expected {amiss}")
        if faults:
            raise SceneError(faults)
        return values

    def _size(self, prim: Usd.Prim, name: str) -> float:
        value = prim.GetAttribute(name).Get(self.time)
        if not isinstance(value, float) or not np.isfinite(value) or value <= 0:
            raise SceneError([f"{prim.GetPath()}: {name} is {value!r}; expected a number > 0"])
        return value

    def _matrix(self, prim: Usd.Prim, cache: UsdGeom.XformCache | None = None) -> np.ndarray:
        """World from local, metres, column vectors."""
        return self.world @ np.array((cache or self.cache).GetLocalToWorldTransform(prim)).T

    def _placement(self, prim: Usd.Prim) -> Placement:
        culprit = prim
        while reason := broken(self._matrix(culprit)):
            parent = culprit.GetParent()
            if not parent or parent.IsPseudoRoot() or not broken(self._matrix(parent)):
                raise SceneError([f"{culprit.GetPath()}: {reason}"])
            culprit = parent  # what an ancestor broke is told once, there
        try:
            return decompose(self._matrix(prim))
        except ValueError as error:
            raise SceneError([f"{prim.GetPath()}: {error}"]) from error

    def _uniform(self, prim: Usd.Prim, factor: float) -> Pose:
        placement = self._placement(prim)
        try:
            return placement.pose(placement.uniform() * factor)
        except ValueError as error:
            raise SceneError([f"{prim.GetPath()}: a neural object cannot be {error}"]) from error

    def _velocity(self, prim: Usd.Prim) -> torch.Tensor:
        """[m/s] in the world: as authored, else from the time samples of its transforms."""
        said = self._values(prim, VELOCITY)[VELOCITY.name]
        if said is not None:
            turn = self.world[:3, :3] / np.linalg.norm(self.world[:3, 0])
            velocity = turn @ np.array(said)
        else:
            velocity = self._sampled_velocity(prim)
        return torch.from_numpy(velocity.astype(np.float64)).to(self.device)

    def _sampled_velocity(self, prim: Usd.Prim) -> np.ndarray:
        times: set[float] = set()
        above = prim
        while above and not above.IsPseudoRoot():
            xform = UsdGeom.Xformable(above)
            if xform and xform.TransformMightBeTimeVarying():
                times.update(xform.GetTimeSamples())
            above = above.GetParent()
        if len(times) < 2:
            return np.zeros(3)
        first, last = min(times), max(times)
        now = first if self.time.IsEarliestTime() else self.time.GetValue()
        if not first <= now <= last:
            return np.zeros(3)  # held before the first and after the last sample
        # linear between samples, so any step gives the slope; at a sample the mean of both sides,
        # at the ends the one side that moves
        step = 0.5 * min(b - a for a, b in zip(sorted(times), sorted(times)[1:], strict=False))
        before, after = max(first, now - step), min(last, now + step)
        places = [self._matrix(prim, UsdGeom.XformCache(t))[:3, 3] for t in (before, after)]
        rate = self.stage.GetTimeCodesPerSecond() / (after - before)
        return (places[1] - places[0]) * rate

    # its material and its asset

    def _material(self, prim: Usd.Prim) -> tuple[str, Material] | None:
        """(where it is said, what is said), or None without radio material."""
        at = _spec(prim)
        if not prim.GetAttribute("rfsg:material:model").HasAuthoredValue():
            bound, relation = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("radio")
            at = bound.GetPrim() if bound else None
            if not at or not at.GetAttribute("rfsg:material:model").HasAuthoredValue():
                if at and relation.GetName().startswith("material:binding:radio"):
                    raise SceneError(
                        [f"{prim.GetPath()}: bound for radio to {at.GetPath()}, which has no "
                         "rfsg:material:model"]
                    )  # fmt: skip
                return None
            prim, at = at, _spec(at)
        material = Material(*self._values(prim, *MATERIAL).values())
        if faults := material.faults():
            raise SceneError([f"{prim.GetPath()}: {fault}" for fault in faults])
        return str(at.GetPath()), material

    def _surface(
        self, prim: Usd.Prim, where: str, material: Material, thickness: float | None = None
    ) -> Surface:
        """One surface for each material prim and thickness: what a fit learns of it, all share."""
        if material.model == "slab" and material.thickness is None:
            if thickness is None:
                raise SceneError([f"{prim.GetPath()}: slab needs rfsg:material:thickness here"])
            material = replace(material, thickness=thickness)
        key = (where, material)
        if key not in self.surfaces:
            try:
                self.surfaces[key] = material.surface().to(self.device)
            except (ValueError, TypeError) as error:
                raise SceneError([f"{where}: {error}"]) from error
        return self.surfaces[key]

    def _home(self, prim: Usd.Prim) -> tuple[Sdf.Layer, Sdf.Path]:
        """Root layer and path of the weakest opinion on the weights: where the object came in."""
        home = (self.stage.GetRootLayer(), prim.GetPath())
        for arc in Usd.PrimCompositionQuery(_spec(prim)).GetCompositionArcs():
            node = arc.GetTargetNode()
            at = node.path.AppendProperty("rfsg:neural:weights")
            if any(layer.GetAttributeAtPath(at) for layer in node.layerStack.layers):
                home = (_layer(node) or home[0], node.path)
        return home

    def _asset_metre(self, prim: Usd.Prim) -> float:
        layer, _ = self._home(prim)
        metre = _metre(layer)
        if metre is None or not (np.isfinite(metre) and metre > 0):
            raise SceneError(
                [f"{prim.GetPath()}: {layer.identifier} says metersPerUnit {metre}; expected > 0"]
            )
        return metre

    def _asset_file(self, prim: Usd.Prim) -> str | None:
        """The asset's USD file, when a reference to that file alone gives the object."""
        layer, path = self._home(prim)
        whole = path == Sdf.Path(f"/{layer.defaultPrim}") and layer != self.stage.GetRootLayer()
        return layer.realPath if whole and layer.realPath else None


_REFERENCES = (Pcp.ArcTypeReference, Pcp.ArcTypePayload)
# the prims that are known shapes, with the attributes that size them
_KNOWN = {
    "Cube": ("size",),
    "Sphere": ("radius",),
    "Cylinder": ("radius", "height"),
    "Capsule": ("radius", "height"),
}
# columns: where a shape's own x, y, z (axis along z) point in a prim with this axis
_AXES = {
    "X": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "Y": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "Z": np.eye(3),
}


def _measure(
    kind: str, sizes: Mapping[str, float], placement: Placement
) -> tuple[str, dict[str, Any]]:
    """Catalogue kind and lengths [m] of a known shape, the placement's scales absorbed.

    Raises ValueError for scales that the shape cannot absorb."""
    if kind == "cube":
        return "box", {"half_size": (sizes["size"] / 2 * placement.scales).tolist()}
    if kind == "cylinder":
        half_height = sizes["height"] / 2 * float(placement.scales[2])
        return kind, {
            "radius": sizes["radius"] * placement.uniform(0, 1),
            "half_height": half_height,
        }
    scale = placement.uniform()
    if kind == "sphere":
        return kind, {"radius": sizes["radius"] * scale}
    if kind == "capsule":
        return kind, {"radius": sizes["radius"] * scale, "half_height": sizes["height"] / 2 * scale}
    return kind, {}


def _attempt(faults: list[str], step: Callable[[], Any]) -> Any:
    """What the step gives, or None with its faults noted."""
    try:
        return step()
    except SceneError as error:
        faults += error.faults
        return None


def _plain(value: Any, kind: str) -> Any:
    """A USD value as Python's own: tuples for vectors, text for asset paths, float for double."""
    if isinstance(value, Sdf.AssetPath):
        return value.path
    if kind in ("float3", "double3") and hasattr(value, "__len__") and not isinstance(value, str):
        return tuple(float(v) for v in value)
    if kind == "double3[]" and isinstance(value, (Vt.Vec3dArray, Vt.Vec3fArray)):
        return np.array(value, dtype=np.float64)
    if kind == "double" and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value


def _brief(value: Any) -> str:
    """A value as a message shows it: an array by its length, for it may hold millions."""
    array = hasattr(value, "__len__") and not isinstance(value, str) and len(value) > 4
    return f"an array of {len(value)}" if array else repr(value)


def _spec(prim: Usd.Prim) -> Usd.Prim:
    """The prim that holds the opinions: for what lies in an instance, the prototype's."""
    return prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim


def _shared(prim: Usd.Prim) -> str:
    """A key that instances of one asset have in common; empty for a prim of its own."""
    if prim.IsInstanceProxy():
        return str(prim.GetPrimInPrototype().GetPath())
    return str(prim.GetPrototype().GetPath()) if prim.IsInstance() else ""


def _layer(node: Any) -> Sdf.Layer | None:
    return node.layerStack.identifier.rootLayer if node else None


def _metre(layer: Sdf.Layer) -> float | None:
    """metersPerUnit as the layer says it, None where it does not."""
    root = layer.pseudoRoot
    return float(root.GetInfo("metersPerUnit")) if root.HasInfo("metersPerUnit") else None


def _up(layer: Sdf.Layer) -> str | None:
    root = layer.pseudoRoot
    return str(root.GetInfo("upAxis")) if root.HasInfo("upAxis") else None


def _named(what: str, paths: Sequence[str]) -> str:
    more = f" and {len(paths) - SHOWN} more" if len(paths) > SHOWN else ""
    return f"{len(paths)} {what}: {', '.join(paths[:SHOWN])}{more}"


# ---- assets -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class AssetRecord:
    """What an asset's USD file says, and the object its weights hold.

    referable: a scene in metres, z up, may reference the file as it is. portable: the two files
    are the whole asset, side by side."""

    body: Body
    provenance: dict[str, Any]
    weights: str
    sha256: str
    referable: bool
    portable: bool


def read_asset(path: Path) -> AssetRecord:
    """Read the object of an asset's USD file: its default prim, or the only one with weights.

    Raises SceneError listing every fault."""
    roots = (files.default_root(path),)
    with _quiet(path):
        stage = _open(path, roots)
        root = stage.GetDefaultPrim()
        found = [p for p in stage.Traverse() if p.GetAttribute(NEURAL[0].name).HasAuthoredValue()]
        if root not in found and len(found) != 1:
            raise SceneError([f"{path}: holds {len(found)} neural objects; expected one"])
        prim = root if root in found else found[0]
        where = str(prim.GetPath())
        resolved, given = _asset_path(prim, WEIGHTS, roots, where)
        data = _weights_bytes(prim, resolved, given, where)
        story = prim.GetAttribute("rfsg:neural:provenance").Get() or "{}"
        layer = stage.GetRootLayer()
        referable = prim == root and (_metre(layer), _up(layer)) == (1.0, "Z")
    try:
        provenance = json.loads(story)
    except (ValueError, RecursionError) as error:
        raise SceneError([f"{where}: rfsg:neural:provenance is not JSON: {error}"]) from error
    beside = Path(resolved).parent == Path(os.path.realpath(path)).parent
    portable = beside and not any(layer.GetCompositionAssetDependencies())
    body = unpack(data, f"{path}: {given}")
    return AssetRecord(body, provenance, resolved, digest(data), referable, portable)


def write_asset(
    usda: Path,
    body: Body,
    name: str,
    mesh: Any | None,
    provenance: Mapping[str, Any],
    color: Sequence[float],
    overwrite: bool,
) -> None:
    """Write an asset's two files; see ``rfsg.scene.assets.save_asset``."""
    weights = usda.with_suffix(".safetensors")
    refuse_overwrite([usda, weights], overwrite)
    data = pack(body)
    layer = _asset_layer(name, weights.name, digest(data), body.shape, mesh, provenance, color)
    # weights first: an interruption in between leaves a hash that does not match, no mix
    write_beside(weights, data, overwrite)
    write_beside(usda, layer.encode(), overwrite)


def _asset_layer(
    name: str,
    weights: str,
    sha256: str,
    shape: Shape,
    mesh: Any | None,
    provenance: Mapping[str, Any],
    color: Sequence[float],
) -> str:
    name = Tf.MakeValidIdentifier(name)
    try:
        story = json.dumps(provenance, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SceneError([f"/{name}: the provenance is not JSON: {error}"]) from error
    stage = _new_stage()
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    low, high = shape.bounds().detach().cpu().tolist()
    values = (
        Sdf.AssetPath(f"./{weights}"),
        FORMAT_VERSION,
        sha256,
        Gf.Vec3f(*low),
        Gf.Vec3f(*high),
        float(shape.lipschitz),
        story,
    )
    _author(root, dict(zip(NEURAL, values, strict=True)), NEURAL_API)
    if mesh is not None:
        _define_mesh(stage, f"/{name}/Surface", mesh, color)
    return stage.GetRootLayer().ExportToString()


def _define_mesh(stage: Usd.Stage, path: str, mesh: Any, color: Sequence[float]) -> None:
    vertices, faces, normals = (np.asarray(part) for part in mesh)
    finite = np.isfinite(vertices).all() and np.isfinite(normals).all()
    inside = len(faces) > 0 and faces.min() >= 0 and faces.max() < len(vertices)
    if not (finite and inside and normals.shape == vertices.shape):
        raise SceneError([f"{path}: the mesh has bad indices, or normals or numbers amiss"])
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(_vectors(vertices))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    # faceVarying: Blender's importer takes custom normals from nothing else
    prim.CreateNormalsAttr(_vectors(normals[faces.ravel()]))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(_vectors(np.stack([vertices.min(0), vertices.max(0)])))
    prim.CreateDisplayColorAttr([Gf.Vec3f(*(float(c) for c in color))])


def _vectors(values: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def _asset_path(prim: Usd.Prim, name: str, roots: Sequence[Path], where: str) -> tuple[str, str]:
    """(resolved path, path as given) of the file that an attribute names, which may be read."""
    value = prim.GetAttribute(name).Get()
    if isinstance(value, Sdf.AssetPath):
        given, anchored = value.path, value.resolvedPath
    else:  # Blender's round trip turns asset paths into strings, without their anchor
        given = str(value or "")
        anchored = prim.GetStage().GetRootLayer().ComputeAbsolutePath(given) if given else ""
    if not given:
        raise SceneError([f"{where}: {name} is empty"])
    resolved, why = _look_up(given, anchored, roots)
    if why or not resolved:
        raise SceneError([f"{where}: {name.split(':')[-1]} {given!r} {why or 'not found'}"])
    return resolved, given


def _weights_bytes(prim: Usd.Prim, resolved: str, given: str, where: str) -> bytes:
    """The weights' bytes, of bounded size and the right hash."""
    data = _asset_bytes(resolved, f"{where}: weights {given!r}", MAX_WEIGHTS_BYTES)
    said, actual = prim.GetAttribute("rfsg:neural:sha256").Get(), digest(data)
    if said != actual:
        raise SceneError(
            [f"{where}: weights {given!r} hash to {actual}, but rfsg:neural:sha256 says {said!r}; "
             "the file was changed, or is not the one this asset was saved with"]
        )  # fmt: skip
    return data


def _asset_bytes(resolved: str, what: str, limit: int) -> bytes:
    """A file's bytes, of bounded size; through Ar, so packages work."""
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
    size = asset.GetSize() if asset else 0
    if not asset or size > limit:
        amiss = f"take {size} bytes; the limit is {limit}" if asset else "cannot be opened"
        raise SceneError([f"{what} {amiss}"])
    return bytes(asset.Read(size, 0)) if size else b""


# ---- writing ----------------------------------------------------------------------------------


def write(scene: Scene, path: str | Path, overwrite: bool = False) -> Path:
    """Write a scene as text USD in metres, z up, with every value explicit; returns the path.

    Known shapes become prims with their material. Other objects are referenced in their asset file,
    if that still holds the same bits; a file outside the folders that the new scene may read is
    copied beside it, and an object without a file is saved beside it, in NAME_assets/.

    Raises SceneError when a file is there and ``overwrite`` is False, and for paths that no prim
    can have.
    """
    path = Path(path).absolute()
    if path.suffix != ".usda":
        raise SceneError([f"{path}: scenes are written as text; expected the ending .usda"])
    refuse_overwrite([path], overwrite)
    with _quiet(path):
        writer = _Writer(scene, path, overwrite)
        writer.run()
        text = writer.stage.GetRootLayer().ExportToString()
        del writer
    write_beside(path, text.encode(), overwrite)
    return path


class _Writer:
    def __init__(self, scene: Scene, path: Path, overwrite: bool):
        self.scene, self.path, self.overwrite = scene, path, overwrite
        self.stage = _new_stage()
        self.placed: dict[str, np.ndarray] = {}  # world matrices of what stands in the stage
        self.materials: dict[int, UsdShade.Material] = {}  # by identity of the surface
        self.assets: dict[int | Path, Path] = {}  # by identity of the body, or by the original
        self.patterns: dict[int, Path] = {}  # by identity of the pattern
        self.records: dict[str, AssetRecord] = {}
        source = scene.source
        names = source.material_names if isinstance(source, Source) else ()
        self.names = {id(surface): name for surface, name in names}

    def run(self) -> None:
        things = [*self.scene.nodes, *self.scene.transmitters, *self.scene.receivers]
        _refuse_paths([t.path for t in things])
        tops = {t.path.split("/")[1] for t in things} or {"World"}
        self.root = f"/{tops.pop() if len(tops) == 1 else 'World'}"
        top = UsdGeom.Xform.Define(self.stage, self.root).GetPrim()
        self.stage.SetDefaultPrim(top)
        UsdGeom.Scope.Define(self.stage, f"{self.root}/Looks")
        if self.scene.frequency is not None:
            _author(top, {FREQUENCY: self.scene.frequency})
        bodies = [id(n.body) for n in self.scene.nodes]
        for node in self.scene.nodes:
            alone = not any(t.path.startswith(f"{node.path}/") for t in things)
            self._node(node, instance=alone and bodies.count(id(node.body)) > 1)
        for role, radios in (("tx", self.scene.transmitters), ("rx", self.scene.receivers)):
            for radio in radios:
                self._radio(role, radio)

    def _node(self, node: Node, instance: bool) -> None:
        shape, surface = node.body.shape, node.body.surface
        material = material_of(surface)
        stretch = np.ones(3)
        if shape.kind in _SHAPES and material is not None:
            prim, stretch = self._shape(node.path, shape)
            self._bind(prim, surface, material)
        else:
            asset, own = self._asset(node, material)
            prim = self._define(node.path, "Xform")
            prim.GetReferences().AddReference(_relative(asset, self.path.parent))
            prim.SetInstanceable(instance)
            if not own and material is not None:
                self._bind(prim, surface, material)
        self._place(prim, node.pose, stretch)
        self._velocity(prim, node.velocity)

    def _shape(self, path: str, shape: Any) -> tuple[Usd.Prim, np.ndarray]:
        """The prim of a known shape, and the stretch that its transform carries (boxes only)."""
        lengths = shape.config()
        prim = self._define(path, _SHAPES[shape.kind])
        if shape.kind == "halfspace":
            _author(prim, {SHAPE: "halfspace"})
        if "radius" in lengths:
            prim.GetAttribute("radius").Set(lengths["radius"])
        if "half_height" in lengths:
            prim.GetAttribute("height").Set(2 * lengths["half_height"])
            prim.GetAttribute("axis").Set("Z")
        if shape.kind == "box":
            prim.GetAttribute("size").Set(2.0)
        if prim.IsA(UsdGeom.Boundable):
            boundable = UsdGeom.Boundable(prim)
            time = Usd.TimeCode.Default()
            extent = UsdGeom.Boundable.ComputeExtentFromPlugins(boundable, time)
            boundable.CreateExtentAttr(extent)
        return prim, np.array(lengths.get("half_size", np.ones(3)), dtype=np.float64)

    def _asset(self, node: Node, material: Material | None) -> tuple[Path, bool]:
        """(asset file to reference, whether it carries the node's surface)."""
        if node.asset is not None and Path(node.asset).is_file():
            if node.asset not in self.records:
                self.records[node.asset] = read_asset(Path(node.asset))
            record = self.records[node.asset]
            own = same_bits(node.body.surface, record.body.surface)
            same = same_bits(node.body.shape, record.body.shape) and (own or material is not None)
            file = Path(node.asset).absolute()
            here = not files.outside(str(file), [files.default_root(self.path)])
            if same and record.referable and (here or record.portable):
                return file if here else self._copy(file, Path(record.weights)), own
        if id(node.body) not in self.assets:
            file = self._beside(node.path.split("/")[-1])
            write_asset(file, node.body, file.stem, None, {}, (), self.overwrite)
            self.assets[id(node.body)] = file
        return self.assets[id(node.body)], True

    def _copy(self, asset: Path, weights: Path) -> Path:
        """A copy beside the scene, which could not read the asset where it lies."""
        if asset not in self.assets:
            file = self._beside(asset.stem)
            copies = {file: asset, file.with_name(weights.name): weights}
            refuse_overwrite(list(copies), self.overwrite)
            for copy, original in copies.items():
                write_beside(copy, original.read_bytes(), self.overwrite)
            self.assets[asset] = file
        return self.assets[asset]

    def _beside(self, name: str) -> Path:
        folder = self.path.with_name(f"{self.path.stem}_assets")
        folder.mkdir(exist_ok=True)
        taken = {file.stem for file in self.assets.values()}
        return folder / f"{_unused(name, taken)}.usda"

    def _pattern_file(self, pattern: Pattern) -> Sdf.AssetPath:
        """The file that a pattern came from, if the new scene may read it and it still holds the
        same; else a copy beside the scene, as CSV."""
        if id(pattern) not in self.patterns:
            file = Path(pattern.file) if pattern.file else None
            root = files.default_root(self.path)
            here = file is not None and file.is_file() and not files.outside(str(file), [root])
            if file is None or not here or not _still(file, pattern):
                stem = Path(pattern.name).stem or "pattern"
                taken = {f.stem for f in self.patterns.values()}
                folder = self.path.with_name(f"{self.path.stem}_assets")
                folder.mkdir(exist_ok=True)
                file = folder / f"{_unused(stem, taken)}.csv"
                write_beside(file, pattern.csv(), self.overwrite)
            self.patterns[id(pattern)] = file
        return Sdf.AssetPath(_relative(self.patterns[id(pattern)], self.path.parent))

    def _bind(self, prim: Usd.Prim, surface: Surface, material: Material) -> None:
        if id(surface) not in self.materials:
            taken = {m.GetPrim().GetName() for m in self.materials.values()}
            plain = material.itu or material.model
            name = _unused(Tf.MakeValidIdentifier(self.names.get(id(surface), plain)), taken)
            self.materials[id(surface)] = _define_material(
                self.stage, f"{self.root}/Looks/{name}", material
            )
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(self.materials[id(surface)])

    def _radio(self, role: str, radio: Radio) -> None:
        prim = self._define(radio.path, "Xform")
        name, file = radio.pattern, None
        if isinstance(name, Pattern):
            name, file = None, self._pattern_file(name)
        values = (
            role,
            radio.power_dbm,
            radio.frequency,
            name,
            file,
            radio.polarization,
            *_array_values(radio.array),
        )
        _author(prim, dict(zip(RADIO, values, strict=True)), RADIO_API)
        one = torch.ones((), dtype=torch.float64)
        self._place(prim, Pose(radio.rotation, radio.position, one), np.ones(3))
        self._velocity(prim, radio.velocity)

    def _define(self, path: str, kind: str) -> Usd.Prim:
        for parent in Sdf.Path(path).GetParentPath().GetPrefixes():
            if not self.stage.GetPrimAtPath(parent):
                UsdGeom.Xform.Define(self.stage, parent)
        return self.stage.DefinePrim(path, kind)

    def _place(self, prim: Usd.Prim, pose: Pose, stretch: np.ndarray) -> None:
        rotation, translation = (_numpy(t) for t in (pose.rotation, pose.translation))
        scales = float(pose.scale) * stretch
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = rotation * scales, translation
        path = str(prim.GetPath())
        self.placed[path] = world
        above = [p for p in self.placed if path.startswith(f"{p}/")]
        xform = UsdGeom.Xformable(prim)
        if above or not np.array_equal(rotation, np.eye(3)):
            outer = self.placed[max(above, key=len)] if above else np.eye(4)
            local = np.linalg.solve(outer, world)
            local[3] = 0, 0, 0, 1
            xform.AddTransformOp().Set(Gf.Matrix4d(*local.T.ravel().tolist()))
            return
        double = UsdGeom.XformOp.PrecisionDouble
        xform.AddTranslateOp(double).Set(Gf.Vec3d(*translation.tolist()))
        if not np.array_equal(scales, np.ones(3)):
            xform.AddScaleOp(double).Set(Gf.Vec3d(*scales.tolist()))

    def _velocity(self, prim: Usd.Prim, velocity: torch.Tensor) -> None:
        if bool((velocity != 0).any()):
            _author(prim, {VELOCITY: Gf.Vec3d(*_numpy(velocity).tolist())})


_SHAPES = {
    "box": "Cube",
    "sphere": "Sphere",
    "cylinder": "Cylinder",
    "capsule": "Capsule",
    "halfspace": "Xform",
}


def _still(file: Path, pattern: Pattern) -> bool:
    """Whether a file holds the pattern that was once read from it."""
    try:
        return Pattern.from_file(file).same(pattern)
    except SceneError:
        return False


def _array_values(array: Array | None) -> tuple[Any, ...]:
    """An array as the attributes of ``ARRAY``."""
    if array is None:
        return (None,) * len(ARRAY)
    if array.layout is not None:
        return (*array.layout, None, array.unit)
    offsets = Vt.Vec3dArray.FromNumpy(np.ascontiguousarray(_numpy(array.offsets)))
    return (None, None, None, None, offsets, array.unit)


def _new_stage() -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    return stage


def _author(prim: Usd.Prim, values: Mapping[Field, Any], api: str | None = None) -> None:
    """Every value explicit and custom: other programs lose fallbacks and schema attributes."""
    for item, value in values.items():
        if value is not None:
            prim.CreateAttribute(item.name, USD_TYPES[item.kind], custom=True).Set(value)
    if api:  # last: what a schema already defines would not be authored as custom
        prim.AddAppliedSchema(api)


def _define_material(stage: Usd.Stage, path: str, material: Material) -> UsdShade.Material:
    look = UsdShade.Material.Define(stage, path)
    values = dict(zip(MATERIAL, astuple(material), strict=True))
    _author(look.GetPrim(), values, MATERIAL_API)
    color, opacity = material.look()
    shader = UsdShade.Shader.Define(stage, f"{path}/Preview")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", _TYPES.Color3f).Set(Gf.Vec3f(*color))
    shader.CreateInput("opacity", _TYPES.Float).Set(opacity)
    shader.CreateInput("metallic", _TYPES.Float).Set(float(material.model == "conductor"))
    shader.CreateInput("roughness", _TYPES.Float).Set(0.6)
    look.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return look


def _refuse_paths(paths: Sequence[str]) -> None:
    faults = [f"{p}: not a prim path" for p in paths if not _prim_path(p)]
    faults += [f"{p}: stands twice in the scene" for p in set(paths) if paths.count(p) > 1]
    if faults:
        raise SceneError(sorted(faults))


def _prim_path(path: str) -> bool:
    valid = bool(Sdf.Path.IsValidPathString(path))
    return valid and path.startswith("/") and Sdf.Path(path).IsPrimPath()


def _unused(name: str, taken: set[str]) -> str:
    names = (f"{name}_{i}" if i else name for i in range(len(taken) + 1))
    return next(n for n in names if n not in taken)


def _relative(path: Path, folder: Path) -> str:
    """Relative with a leading dot: USD searches for a bare name elsewhere too."""
    relative = os.path.relpath(os.path.realpath(path), os.path.realpath(folder))
    relative = relative.replace(os.sep, "/")
    return relative if relative.startswith(".") else f"./{relative}"


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().to(torch.float64).numpy()
