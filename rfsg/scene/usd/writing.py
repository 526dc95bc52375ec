"""Writing a scene as text USD, in metres, z up, with every value explicit."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade

from rfsg.objects.body import Body, unstretched
from rfsg.objects.contract import Surface
from rfsg.scene import files
from rfsg.scene.fields import FREQUENCY, VELOCITY
from rfsg.scene.materials import Material, material_of
from rfsg.scene.patterns import Pattern
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.usd.attributes import as_numpy, author
from rfsg.scene.usd.composition import is_prim_path
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.layers import new_stage
from rfsg.scene.usd.materials import define_material
from rfsg.scene.usd.objects import AssetRecord, read_asset
from rfsg.scene.usd.packaging import write_asset
from rfsg.scene.usd.radios import author_radio
from rfsg.scene.usd.reading import Source
from rfsg.scene.usd.shapes import PRIM_TYPES, author_shape
from rfsg.scene.weights import refuse_overwrite, write_beside


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
    with quiet(path):
        writer = _Writer(scene, path, overwrite)
        writer.run()
        text = writer.stage.GetRootLayer().ExportToString()
        del writer
    write_beside(path, text.encode(), overwrite)
    return path


class _Writer:
    def __init__(self, scene: Scene, path: Path, overwrite: bool):
        self.scene, self.path, self.overwrite = scene, path, overwrite
        self.stage = new_stage()
        self.placed: dict[str, np.ndarray] = {}  # world matrices of what stands in the stage
        self.materials: dict[int, UsdShade.Material] = {}  # by identity of the surface
        self.plain: dict[tuple[int, int], Body] = {}  # by identity of the shape and the surface
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
            author(top, {FREQUENCY: self.scene.frequency})
        bodies = [id(n.body) for n in self.scene.nodes]
        for node in self.scene.nodes:
            alone = not any(t.path.startswith(f"{node.path}/") for t in things)
            self._node(node, instance=alone and bodies.count(id(node.body)) > 1)
        for role, radios in (("tx", self.scene.transmitters), ("rx", self.scene.receivers)):
            for radio in radios:
                self._radio(role, radio)

    def _node(self, node: Node, instance: bool) -> None:
        node, stretch = self._unstretched(node)
        shape, surface = node.body.shape, node.body.surface
        material = material_of(surface)
        if shape.kind in PRIM_TYPES and material is not None:
            prim = self._define(node.path, PRIM_TYPES[shape.kind])
            stretch = author_shape(prim, shape)
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

    def _unstretched(self, node: Node) -> tuple[Node, np.ndarray]:
        """A node with the object that its asset holds, and the stretch that its transform carries."""
        body, scales = unstretched(node.body)
        if body is not node.body:
            body = self.plain.setdefault((id(body.shape), id(body.surface)), body)
        return replace(node, body=body), as_numpy(scales)

    def _asset(self, node: Node, material: Material | None) -> tuple[Path, bool]:
        """(asset file to reference, whether it carries the node's surface)."""
        if node.asset is not None and Path(node.asset).is_file():
            if node.asset not in self.records:
                self.records[node.asset] = read_asset(Path(node.asset))
            record = self.records[node.asset]
            own, same = record.holds(node.body, otherwise_bound=material is not None)
            file = Path(node.asset).absolute()
            here = not files.outside(str(file), [files.default_root(self.path)])
            if same and record.referable and (here or record.parts):
                return file if here else self._copy(record.parts), own
        if id(node.body) not in self.assets:
            file = self._beside(node.path.split("/")[-1])
            write_asset(file, node.body, name=file.stem, overwrite=self.overwrite)
            self.assets[id(node.body)] = file
        return self.assets[id(node.body)], True

    def _copy(self, parts: Sequence[Path]) -> Path:
        """A copy beside the scene, which could not read the asset where it lies; of two with one
        name, the second in a folder of its own, for its files name each other."""
        asset = parts[0]
        if asset not in self.assets:
            file = self._beside(asset.stem)
            home = file.parent if file.stem == asset.stem else file.with_suffix("")
            copies = {home / part.relative_to(asset.parent): part for part in parts}
            refuse_overwrite(list(copies), self.overwrite)
            for copy, original in copies.items():
                copy.parent.mkdir(parents=True, exist_ok=True)
                write_beside(copy, original.read_bytes(), self.overwrite)
            self.assets[asset] = home / asset.name
        return self.assets[asset]

    def _beside(self, name: str) -> Path:
        folder = self.path.with_name(f"{self.path.stem}_assets")
        folder.mkdir(exist_ok=True)
        tops = (file.relative_to(folder).parts[0] for file in self.assets.values())
        taken = {Path(t).stem if t.endswith(files.LAYER_SUFFIXES) else t for t in tops}
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
            self.materials[id(surface)] = define_material(
                self.stage, f"{self.root}/Looks/{name}", material
            )
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(self.materials[id(surface)])

    def _radio(self, role: str, radio: Radio) -> None:
        prim = self._define(radio.path, "Xform")
        pattern = radio.pattern
        file = self._pattern_file(pattern) if isinstance(pattern, Pattern) else None
        author_radio(prim, role, radio, file)
        one = torch.ones((), dtype=torch.float64)
        self._place(prim, Pose(radio.rotation, radio.position, one), np.ones(3))
        self._velocity(prim, radio.velocity)

    def _define(self, path: str, kind: str) -> Usd.Prim:
        for parent in Sdf.Path(path).GetParentPath().GetPrefixes():
            if not self.stage.GetPrimAtPath(parent):
                UsdGeom.Xform.Define(self.stage, parent)
        return self.stage.DefinePrim(path, kind)

    def _place(self, prim: Usd.Prim, pose: Pose, stretch: np.ndarray) -> None:
        rotation, translation = (as_numpy(t) for t in (pose.rotation, pose.translation))
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
            author(prim, {VELOCITY: Gf.Vec3d(*as_numpy(velocity).tolist())})


def _still(file: Path, pattern: Pattern) -> bool:
    """Whether a file holds the pattern that was once read from it."""
    try:
        return Pattern.from_file(file).same(pattern)
    except SceneError:
        return False


def _refuse_paths(paths: Sequence[str]) -> None:
    faults = [f"{p}: not a prim path" for p in paths if not is_prim_path(p)]
    faults += [f"{p}: stands twice in the scene" for p in set(paths) if paths.count(p) > 1]
    if faults:
        raise SceneError(sorted(faults))


def _unused(name: str, taken: set[str]) -> str:
    names = (f"{name}_{i}" if i else name for i in range(len(taken) + 1))
    return next(n for n in names if n not in taken)


def _relative(path: Path, folder: Path) -> str:
    """Relative with a leading dot: USD searches for a bare name elsewhere too."""
    relative = os.path.relpath(os.path.realpath(path), os.path.realpath(folder))
    relative = relative.replace(os.sep, "/")
    return relative if relative.startswith(".") else f"./{relative}"
