"""Reading a scene: a stage is opened, walked once, and everything at fault is told at once."""

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pxr import Sdf, Usd, UsdGeom

from rfsg.objects.body import Body
from rfsg.objects.catalogue import shape_class
from rfsg.objects.contract import Surface
from rfsg.objects.shapes.stretched import stretched
from rfsg.scene import files
from rfsg.scene.fields import FIELDS, FREQUENCY, NEURAL, SHAPE
from rfsg.scene.materials import Material
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.transforms import Placement
from rfsg.scene.usd import shapes
from rfsg.scene.usd.attributes import values_of
from rfsg.scene.usd.composition import sublayer_warnings, unit_faults
from rfsg.scene.usd.faults import PXR_ERRORS, attempt, one_line, pxr_words, quiet
from rfsg.scene.usd.kept import Kept
from rfsg.scene.usd.layers import asset_path
from rfsg.scene.usd.materials import Materials
from rfsg.scene.usd.meshes import MeshRead, read_mesh, shapes_of, smoothed
from rfsg.scene.usd.objects import WEIGHTS, asset_file, asset_metre, band_of, weights_bytes
from rfsg.scene.usd.placements import Places, world_from_stage
from rfsg.scene.usd.radios import Radios
from rfsg.scene.usd.source import Opened, Options, Source, opened
from rfsg.scene.weights import FORMAT_VERSION, unpack

MAX_PRIMS = 200_000
RESULTS = "rfsg:results"  # in customData: a prim that shows results, and is no part of the scene
SHOWN = 12  # paths named in a warning before "and more"


def read(
    path: "str | Path | Usd.Stage",
    *,
    variants: Mapping[str, Mapping[str, str]] | None = None,
    asset_roots: Sequence[str | Path] = (),
    time: int | float | None = None,
    device: torch.device | str = "cpu",
) -> Scene:
    """Read a USD scene (usda, usdc, usd, usdz, or a stage that is open) into metres, z up.

    variants: {prim path: {variant set: choice}}, chosen for this scene; file and stage stay as they
    are. asset_roots: folders that may be read besides the scene's root: its nearest ancestor folder
    that holds a file named ``rfsg-assets.toml``, else its own folder; a stage without a file has no
    root of its own. time: a time code; by default the stage's start, else the earliest sample.
    device: where the tensors go.

    Raises SceneError listing all faults. Only files that may not be opened, or cannot be parsed,
    are listed on their own, before composition. Untrusted scenes belong into a child process with
    limits on time and memory: nothing in one process can bound what composition takes, and OpenUSD
    itself may print lines of its own about a damaged binary layer.
    """
    options = Options(dict(variants or {}), tuple(asset_roots), time, device)
    return scene_of(path, options, Kept())


def scene_of(source: "str | Path | Usd.Stage", options: Options, kept: Kept) -> Scene:
    """``read``, with what an earlier reading kept."""
    with quiet(str(source) if isinstance(source, (str, Path)) else "the stage"):
        reader = Reader(opened(source, options), options, kept)
        scene, faults = reader.scene(source), reader.faults
        del reader  # a traceback that somebody keeps must not keep the stage open
    if faults:
        raise SceneError(faults)
    return scene


def examine(
    path: str | Path,
    look: Callable[[Usd.Stage, Scene, Sequence[Path]], Iterable[str]],
    **options: Any,
) -> list[str]:
    """Every fault that ``read`` (same options) finds, and then what ``look`` finds on the stage, in
    what was read of it, given the folders that it may read."""
    asked = Options(**options)
    faults: list[str] = []
    try:
        with quiet(path):
            reader = Reader(opened(path, asked), asked, Kept())
            scene = reader.scene(path)
            faults += reader.faults
            faults += look(reader.opened.stage, scene, reader.opened.roots)
    except SceneError as error:
        faults += error.faults
    return list(dict.fromkeys(faults))


@dataclass(frozen=True)
class Waiting:
    """A mesh that was found, and after how many of the other nodes."""

    before: int
    prim: Usd.Prim
    read: MeshRead
    surface: Surface
    pose: Pose


@dataclass
class Reader:
    """The state of one read. Faults gather here: a prim at fault is left out, reading goes on."""

    opened: Opened
    options: Options
    kept: Kept
    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)
    meshes: "list[Waiting]" = field(default_factory=list)
    decor: list[str] = field(default_factory=list)
    cages: list[str] = field(default_factory=list)
    stretched: list[str] = field(default_factory=list)
    weights: dict[tuple[str, str, Any], Body] = field(default_factory=dict)
    asset_root: Sdf.Path = Sdf.Path.emptyPath  # the neural object that the traversal is inside of

    def __post_init__(self) -> None:
        self.faults += self.opened.faults
        self.device = torch.device(self.options.device)
        self.time = self.options.code(self.opened.stage)
        world = world_from_stage(self.opened.stage, self.opened.path, self.faults)
        self.places = Places(self.time, world)
        self.materials = Materials(self.time, self.device, self.kept)
        roots, device = self.opened.roots, self.device
        self.radios = Radios(self.places, roots, device, self.warnings, self.kept)

    def scene(self, source: Any) -> Scene:
        """Read everything; what is at fault is in ``faults`` afterwards."""
        self._composition()
        self.warnings += sublayer_warnings(self.opened.stage)
        self.kept.begin()
        self._walk(Usd.PrimRange.Stage(self.opened.stage, Usd.TraverseInstanceProxies()))
        if self.decor:
            self.warnings.append(
                _named("prim(s) without radio material, not seen by waves", self.decor)
            )
        if self.stretched:
            what = "learned object(s) scaled unevenly, other than what was learned"
            self.warnings.append(_named(what, self.stretched))
        if self.cages:
            what = "mesh(es) to be subdivided, of which waves see the cage"
            self.warnings.append(_named(what, self.cages))
        base = Scene(
            tuple(self.nodes),
            tuple(self.radios.found["tx"]),
            tuple(self.radios.found["rx"]),
            self._frequency(),
            tuple(self.warnings),
        )
        if not self.faults:
            self.kept.end()
        given = source if isinstance(source, Usd.Stage) else None
        path, names = str(self.opened.path), self.materials.names()
        return replace(base, source=Source(path, self.options, given, base, self.kept, names))

    def below(self, top: Usd.Prim) -> Scene:
        """The things at a prim and below it, alone."""
        self._walk(Usd.PrimRange(top, Usd.TraverseInstanceProxies()))
        found = self.radios.found
        return Scene(tuple(self.nodes), tuple(found["tx"]), tuple(found["rx"]))

    def _walk(self, prims: Usd.PrimRange) -> None:
        for prim in self._prims(prims):
            for step in (self._spelling, self._units, self._thing, self.radios.read):
                try:
                    step(prim)
                except SceneError as error:
                    self.faults += error.faults
                except PXR_ERRORS as error:
                    self.faults.append(f"{prim.GetPath()}: {pxr_words(error)}")
        self._meshes()
        self.faults = list(dict.fromkeys(self.faults))

    # the stage

    def _composition(self) -> None:
        for error in self.opened.stage.GetCompositionErrors():
            self.faults.append(f"{error.rootSite.path}: {one_line(str(error))}")
        for layer in self.opened.stage.GetUsedLayers():
            if layer.realPath and (why := files.outside(layer.realPath, self.opened.roots)):
                self.faults.append(f"{layer.realPath}: {why}")

    def _frequency(self) -> float | None:
        root = self.opened.stage.GetDefaultPrim()
        try:
            return values_of(root, self.time, FREQUENCY)[FREQUENCY.name] if root else None
        except SceneError as error:
            self.faults += error.faults
            return None

    def _prims(self, prims: Usd.PrimRange) -> Iterator[Usd.Prim]:
        """The prims that may be of account: no guides, no proxies."""
        walk = iter(prims)
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
        band = attempt(faults, lambda: band_of(where, said))
        body = attempt(faults, lambda: self._trained(prim, where, band))
        override = attempt(faults, lambda: self.materials.said(prim))
        placement = attempt(faults, lambda: self.places.placement(prim))
        if faults or body is None or placement is None:
            raise SceneError(faults)
        if override is not None:
            shape, surface = body.shape, self.materials.surface(prim, *override)
            key = ("covered", id(shape), id(surface))
            body = self.kept.of(key, lambda: Body(shape, surface))
        body, pose = self._scaled(where, body, placement, 1.0 / asset_metre(prim))
        self._stand(prim, body.to(self.device), pose, asset_file(prim))

    def _scaled(
        self, where: str, body: Body, placement: Placement, factor: float
    ) -> tuple[Body, Pose]:
        """What a scale makes of a learned object: an uneven one stretches its shape."""
        if placement.even():
            return body, placement.pose(placement.uniform() * factor)
        scales = placement.scales * factor
        self.stretched.append(f"{where} by {', '.join(f'{s:.4g}' for s in scales)}")
        key = ("stretched", id(body), scales.tobytes())
        return self.kept.of(key, lambda: stretched(body, scales)), placement.pose()

    def _trained(self, prim: Usd.Prim, where: str, band: tuple[float, float] | None) -> Body:
        """The body of a prim's weights, read once for all prims with the same file and hash."""
        resolved, given = asset_path(prim, WEIGHTS, self.opened.roots, where)
        key = (resolved, prim.GetAttribute("rfsg:neural:sha256").Get(), band)
        if key not in self.weights:

            def unpacked() -> Body:
                data = weights_bytes(prim, resolved, given, where)
                return unpack(data, f"{where}: {given}", resolved)

            kept = ("weights", *key, self.kept.stamp(resolved))
            self.weights[key] = self.kept.of(kept, unpacked)
            self.weights[key].band = band
        return self.weights[key]

    def _gprim(self, prim: Usd.Prim) -> None:
        thin = prim.IsA(UsdGeom.Curves) or prim.IsA(UsdGeom.Points)
        said = None if thin else self.materials.said(prim)
        if said is None:
            if not prim.GetCustomDataByKey(RESULTS):
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
            with np.errstate(over="ignore"):  # said below
                token, lengths = shapes.measure(kind, sizes, placement)
        except ValueError as error:
            raise SceneError([f"{prim.GetPath()}: a {kind} cannot be {error}"]) from error
        length = np.hstack([np.zeros(0), *lengths.values()])
        if not (np.isfinite(length) & (length > 0)).all():
            raise SceneError(
                [f"{prim.GetPath()}: a {kind} of {lengths} m, scale and all; expected numbers > 0"]
            )
        thickness = 2 * min(lengths["half_size"]) if token == "box" else None
        surface = self.materials.surface(prim, *said, thickness)
        key = (_shared(prim), token, str(lengths), id(surface))
        body = self.kept.of(key, lambda: Body(shape_class(token)(**lengths), surface))
        self._stand(prim, body.to(self.device), placement.pose(), None)

    def _mesh(self, prim: Usd.Prim, where: str, material: Material) -> None:
        placement = self.places.placement(prim)
        surface = self.materials.surface(prim, where, material)
        mesh = read_mesh(prim, self.time, placement.scales, _shared(prim))
        if smoothed(prim) and not any(mesh.key == m.read.key for m in self.meshes):
            self.cages.append(str(prim.GetPath()))
        self.meshes.append(Waiting(len(self.nodes), prim, mesh, surface, placement.pose()))

    def _meshes(self) -> None:
        """Meshes stand once all are found, for their shapes are made together; in the order of prims."""
        walked, waiting, self.meshes = self.nodes, self.meshes, []
        made, self.nodes, done = shapes_of([m.read for m in waiting], self.kept), [], 0
        for mesh in waiting:
            self.nodes += walked[done : mesh.before]
            done = mesh.before
            shape, surface = made[mesh.read.key], mesh.surface
            if isinstance(shape, SceneError):
                self.faults += [f for f in shape.faults if f not in self.faults]
                continue
            key = ("meshed", id(shape), id(surface))
            body = self.kept.of(key, partial(Body, shape, surface))
            if body.shape.vertices.device != self.device:
                body.to(self.device)
            self._stand(mesh.prim, body, mesh.pose, None)
        self.nodes += walked[done:]

    def _stand(self, prim: Usd.Prim, body: Body, pose: Pose, asset: str | None) -> None:
        pose = Pose(*(t.to(self.device) for t in (pose.rotation, pose.translation, pose.scale)))
        velocity = self.places.velocity(prim).to(self.device)
        node = Node(str(prim.GetPath()), body, pose, velocity, asset)
        self.nodes.append(self.kept.same(("node", node.path), node))


def _shared(prim: Usd.Prim) -> str:
    """A key that instances of one asset have in common; its own path for a prim of its own."""
    if prim.IsInstanceProxy():
        return str(prim.GetPrimInPrototype().GetPath())
    return str((prim.GetPrototype() if prim.IsInstance() else prim).GetPath())


def _named(what: str, paths: Sequence[str]) -> str:
    more = f" and {len(paths) - SHOWN} more" if len(paths) > SHOWN else ""
    return f"{len(paths)} {what}: {', '.join(paths[:SHOWN])}{more}"
