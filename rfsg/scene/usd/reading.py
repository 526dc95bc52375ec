"""Reading a scene: a stage is opened, walked once, and everything at fault is told at once."""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from pxr import Sdf, Usd, UsdGeom

from rfsg.objects.body import Body
from rfsg.objects.catalogue import shape_class
from rfsg.objects.contract import Surface
from rfsg.scene import files
from rfsg.scene.fields import FIELDS, FREQUENCY, NEURAL, SHAPE
from rfsg.scene.materials import Material
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.usd import shapes
from rfsg.scene.usd.attributes import values_of
from rfsg.scene.usd.composition import is_prim_path, unit_faults
from rfsg.scene.usd.faults import PXR_ERRORS, attempt, one_line, pxr_words, quiet
from rfsg.scene.usd.layers import asset_path, open_stage
from rfsg.scene.usd.materials import Materials
from rfsg.scene.usd.meshes import read_mesh, smoothed
from rfsg.scene.usd.objects import WEIGHTS, asset_file, asset_metre, weights_bytes
from rfsg.scene.usd.placements import Places, world_from_stage
from rfsg.scene.usd.radios import Radios
from rfsg.scene.weights import FORMAT_VERSION, unpack

MAX_PRIMS = 200_000
SHOWN = 12  # paths named in a warning before "and more"


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
    with quiet(path):
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
        with quiet(path):
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
    return f"{where}: {one_line(error.GetMessage())} (OpenUSD {error.GetName()})"


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
    decor: list[str] = field(default_factory=list)
    cages: list[str] = field(default_factory=list)
    weights: dict[tuple[str, str], Body] = field(default_factory=dict)
    bodies: dict[Any, Body] = field(default_factory=dict)
    places: Places = field(init=False)
    materials: Materials = field(init=False)
    radios: Radios = field(init=False)
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
        stage = open_stage(path, roots)
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
        self.places = Places(self.time, world_from_stage(self.stage, self.path, self.faults))
        self.materials = Materials(self.time, self.device)
        self.radios = Radios(self.places, self.roots, self.device, self.warnings)
        for prim in self._prims():
            for step in (self._spelling, self._units, self._thing, self.radios.read):
                try:
                    step(prim)
                except SceneError as error:
                    self.faults += error.faults
                except PXR_ERRORS as error:
                    self.faults.append(f"{prim.GetPath()}: {pxr_words(error)}")
        self.faults = list(dict.fromkeys(self.faults))
        if self.decor:
            self.warnings.append(
                _named("prim(s) without radio material, not seen by waves", self.decor)
            )
        if self.cages:
            what = "mesh(es) to be subdivided, of which waves see the cage"
            self.warnings.append(_named(what, self.cages))
        return Scene(
            tuple(self.nodes),
            tuple(self.radios.found["tx"]),
            tuple(self.radios.found["rx"]),
            self._frequency(),
            tuple(self.warnings),
            Source(str(self.path), self.materials.names()),
        )

    # the stage

    def _choose(self, variants: Mapping[str, Mapping[str, str]]) -> None:
        with Usd.EditContext(self.stage, self.stage.GetSessionLayer()):
            for path, choices in variants.items():
                prim = self.stage.GetPrimAtPath(path) if is_prim_path(path) else None
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
            self.faults.append(f"{error.rootSite.path}: {one_line(str(error))}")
        for layer in self.stage.GetUsedLayers():
            if layer.realPath and (why := files.outside(layer.realPath, self.roots)):
                self.faults.append(f"{layer.realPath}: {why}")

    def _frequency(self) -> float | None:
        root = self.stage.GetDefaultPrim()
        try:
            return values_of(root, self.time, FREQUENCY)[FREQUENCY.name] if root else None
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
        self.faults += unit_faults(prim, self.time)

    def _thing(self, prim: Usd.Prim) -> None:
        """A neural object, a half-space, a known shape, or decor."""
        if prim.GetAttribute(WEIGHTS).HasAuthoredValue():
            if not prim.GetPath().HasPrefix(self.asset_root):
                self.asset_root = prim.GetPath()
            self._neural(prim)
        elif prim.GetPath().HasPrefix(self.asset_root):
            return  # the extracted mesh of the neural object
        elif prim.GetAttribute(SHAPE.name).HasAuthoredValue():
            values_of(prim, self.time, SHAPE)
            self._known(prim, "halfspace", {}, self.materials.said(prim))
        elif prim.IsA(UsdGeom.Gprim):
            self._gprim(prim)

    def _neural(self, prim: Usd.Prim) -> None:
        said = values_of(prim, self.time, *NEURAL[1:])
        where = str(prim.GetPath())
        if said["rfsg:neural:formatVersion"] != FORMAT_VERSION:
            raise SceneError(
                [f"{where}: rfsg:neural:formatVersion is {said['rfsg:neural:formatVersion']}; "
                 f"this rfsg reads {FORMAT_VERSION}"]
            )  # fmt: skip
        faults: list[str] = []
        body = attempt(faults, lambda: self._trained(prim, where))
        override = attempt(faults, lambda: self.materials.said(prim))
        pose = attempt(faults, lambda: self.places.uniform(prim, 1.0 / asset_metre(prim)))
        if faults or body is None or pose is None:
            raise SceneError(faults)
        if override is not None:
            surface = self.materials.surface(prim, *override)
            key = (id(body), id(surface))
            body = self.bodies.setdefault(key, Body(body.shape, surface))
        self._stand(prim, body.to(self.device), pose, asset_file(prim))

    def _trained(self, prim: Usd.Prim, where: str) -> Body:
        """The body of a prim's weights, read once for all prims with the same file and hash."""
        resolved, given = asset_path(prim, WEIGHTS, self.roots, where)
        key = (resolved, prim.GetAttribute("rfsg:neural:sha256").Get())
        if key not in self.weights:
            data = weights_bytes(prim, resolved, given, where)
            self.weights[key] = unpack(data, f"{where}: {given}", resolved)
        return self.weights[key]

    def _gprim(self, prim: Usd.Prim) -> None:
        thin = prim.IsA(UsdGeom.Curves) or prim.IsA(UsdGeom.Points)
        said = None if thin else self.materials.said(prim)
        if said is None:
            self.decor.append(str(prim.GetPath()))
            return
        kind = str(prim.GetTypeName())
        if kind == "Mesh":
            return self._mesh(prim, *said)
        if kind not in shapes.SIZES:
            raise SceneError(
                [f"{prim.GetPath()}: a {kind} with a radio material; waves see "
                 f"{', '.join(shapes.SIZES)}, closed Meshes and neural objects. Make one of a mesh "
                 "with `rfsg learn-shape`"]
            )  # fmt: skip
        self._known(prim, kind.lower(), shapes.sizes_of(prim, self.time), said)

    def _known(
        self,
        prim: Usd.Prim,
        kind: str,
        sizes: dict[str, float],
        said: tuple[str, Material] | None,
    ) -> None:
        if said is None:
            raise SceneError([f"{prim.GetPath()}: a {kind} needs a radio material"])
        placement = self.places.placement(prim)
        if "height" in sizes:
            placement = shapes.turned(prim, placement)
        try:
            token, lengths = shapes.measure(kind, sizes, placement)
        except ValueError as error:
            raise SceneError([f"{prim.GetPath()}: a {kind} cannot be {error}"]) from error
        thickness = 2 * min(lengths["half_size"]) if token == "box" else None
        surface = self.materials.surface(prim, *said, thickness)
        key = (_shared(prim), token, str(lengths), id(surface))
        body = self.bodies.get(key) if key[0] else None
        if body is None:
            body = self.bodies[key] = Body(shape_class(token)(**lengths), surface).to(self.device)
        self._stand(prim, body, placement.pose(), None)

    def _mesh(self, prim: Usd.Prim, where: str, material: Material) -> None:
        placement = self.places.placement(prim)
        surface = self.materials.surface(prim, where, material)
        key = (_shared(prim), "mesh", str(placement.scales), id(surface))
        body = self.bodies.get(key) if key[0] else None
        if body is None:
            shape = read_mesh(prim, self.time, placement.scales)
            body = self.bodies[key] = Body(shape, surface).to(self.device)
            if smoothed(prim):
                self.cages.append(str(prim.GetPath()))
        self._stand(prim, body, placement.pose(), None)

    def _stand(self, prim: Usd.Prim, body: Body, pose: Pose, asset: str | None) -> None:
        pose = Pose(*(t.to(self.device) for t in (pose.rotation, pose.translation, pose.scale)))
        velocity = self.places.velocity(prim).to(self.device)
        self.nodes.append(Node(str(prim.GetPath()), body, pose, velocity, asset))


def _shared(prim: Usd.Prim) -> str:
    """A key that instances of one asset have in common; empty for a prim of its own."""
    if prim.IsInstanceProxy():
        return str(prim.GetPrimInPrototype().GetPath())
    return str(prim.GetPrototype().GetPath()) if prim.IsInstance() else ""


def _named(what: str, paths: Sequence[str]) -> str:
    more = f" and {len(paths) - SHOWN} more" if len(paths) > SHOWN else ""
    return f"{len(paths)} {what}: {', '.join(paths[:SHOWN])}{more}"
