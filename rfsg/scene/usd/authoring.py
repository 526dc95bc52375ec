"""Authoring things into the layer of edits over a stage."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils

from rfsg.objects.body import unstretched
from rfsg.objects.contract import Surface
from rfsg.scene.fields import FREQUENCY, RADIO, VELOCITY
from rfsg.scene.materials import Material, material_of
from rfsg.scene.patterns import Pattern
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.usd.attributes import as_numpy, author
from rfsg.scene.usd.composition import conversion, unit_faults
from rfsg.scene.usd.kept import Kept, alike
from rfsg.scene.usd.materials import Materials, define_material
from rfsg.scene.usd.meshes import is_sheet
from rfsg.scene.usd.objects import AssetRecord, read_asset
from rfsg.scene.usd.packaging import write_asset
from rfsg.scene.usd.placements import Places, world_from_stage
from rfsg.scene.usd.radios import author_radio
from rfsg.scene.weights import refuse_overwrite, same_bits, write_beside

ROUNDING = 1e-15  # of two matrix products: below it a transform's linear part did not change
MODEL = "rfsg:material:model"


class Author:
    """Authors the difference between things and what stands in a stage, into its root layer.

    ``base`` is what the stage says before. Paths of assets are absolute. ``folders`` are those of
    the assets that were referenced."""

    def __init__(
        self, stage: Usd.Stage, time: Usd.TimeCode, base: Scene, path: Path, overwrite: bool
    ):
        self.stage, self.time, self.path, self.overwrite = stage, time, path, overwrite
        self.world = world_from_stage(stage, path, [])
        things = (*base.nodes, *base.transmitters, *base.receivers)
        places = self._places()
        self.before = {t.path: places.matrix(stage.GetPrimAtPath(t.path)) for t in things}
        self.swapped: set[str] = set()
        self.folders: set[Path] = set()
        self.written: list[Path] = []
        self.records: dict[str, AssetRecord] = {}
        self.saved: dict[int, Path] = {}  # by identity of a body or a pattern
        self.looks: dict[int, UsdShade.Material] = {}  # by identity of the surface

    def undo(self) -> None:
        """Take back the files that were written beside the layer."""
        for file in self.written:
            file.unlink(missing_ok=True)

    def remove(self, path: str) -> None:
        self._prim(path).SetActive(False)

    def frequency(self, hertz: float | None) -> None:
        root = self.stage.GetDefaultPrim()
        if not root:
            raise SceneError([f"{self.path}: the stage has no defaultPrim to say its frequency"])
        if hertz is None:
            root.GetAttribute(FREQUENCY.name).Block()
        else:
            author(root, {FREQUENCY: hertz})

    # objects

    def node(self, node: Node, old: Node | None) -> None:
        """Author what a node is, if it is not what stands there."""
        material = material_of(node.body.surface)
        same_shape = old is not None and same_bits(node.body.shape, old.body.shape)
        same_surface = old is not None and same_bits(node.body.surface, old.body.surface)
        if old is not None and material is not None and material.thickness is not None:
            # a cube's material may take its thickness from a side, which a scale would change
            same_surface = same_surface and bool(node.pose.scale == old.pose.scale)
        same_band = old is not None and node.body.band == old.body.band
        if same_shape and same_surface and same_band:
            return
        prim = self._prim(node.path) if old else self._define(node.path)
        covered = not same_surface and material is not None
        if not (same_shape and covered):
            file, own = self._asset(node, material)
            self._refer(prim, file)
            self.swapped.add(node.path)
            covered = not own
        if covered and material is not None:
            self._cover(prim, node.body.surface, material)
        else:
            self._uncover(prim, node.body.surface, material)

    def _refer(self, prim: Usd.Prim, file: Path) -> None:
        """Make a prim what an asset file says, whatever brought in what it was."""
        for name in prim.GetVariantSets().GetNames():
            prim.GetVariantSet(name).BlockVariantSelection()
        if prim.HasAuthoredPayloads():
            prim.GetPayloads().SetPayloads([])
        if is_sheet(prim):
            prim.SetCustomDataByKey("rfsg:sheet", False)
        if prim.GetTypeName() != "Xform":
            prim.SetTypeName("Xform")
        prim.GetReferences().SetReferences([Sdf.Reference(str(file))])
        self.folders.add(file.parent)

    def _asset(self, node: Node, material: Material | None) -> tuple[Path, bool]:
        """(asset file that holds a node's object, whether it holds its surface too)."""
        body, _ = unstretched(node.body)
        if node.asset is not None and Path(node.asset).is_file():
            if node.asset not in self.records:
                self.records[node.asset] = read_asset(Path(node.asset))
            record = self.records[node.asset]
            own, same = record.holds(body, otherwise_bound=material is not None)
            if same and record.referable:
                return Path(node.asset).absolute(), own
        if id(node.body) not in self.saved:
            file = self._beside(node.path.split("/")[-1], ".usda")
            self.written += [file, file.with_suffix(".safetensors")]
            write_asset(file, body, name=file.stem, overwrite=self.overwrite)
            self.saved[id(node.body)] = file
        return self.saved[id(node.body)], True

    def _beside(self, name: str, ending: str) -> Path:
        """A free name in the folder beside the layer. Raises SceneError for one that is taken."""
        folder = self.path.with_name(f"{self.path.stem}_assets")
        folder.mkdir(exist_ok=True)
        taken = {file.name for file in self.saved.values()}
        names = (f"{name}_{i}{ending}" if i else name + ending for i in range(len(taken) + 1))
        file = folder / next(n for n in names if n not in taken)
        refuse_overwrite([file], self.overwrite)
        return file

    # materials

    def _cover(self, prim: Usd.Prim, surface: Surface, material: Material) -> None:
        """Bind a material for radio and for the eye; equal for all nodes that share the surface."""
        if id(surface) not in self.looks:
            scope = self._looks()
            plain = Tf.MakeValidIdentifier(material.itu or material.model)
            names = (f"{plain}_{i}" if i else plain for i in range(len(self.looks) + 1))
            free = (n for n in names if not self.stage.GetPrimAtPath(scope.AppendChild(n)))
            path = str(scope.AppendChild(next(free)))
            self.looks[id(surface)] = define_material(self.stage, path, material)
        if prim.GetAttribute(MODEL).HasAuthoredValue():
            prim.GetAttribute(MODEL).Block()  # what a prim says itself is stronger than a binding
        binding = UsdShade.MaterialBindingAPI.Apply(prim)
        for purpose in ("", "radio"):
            binding.Bind(self.looks[id(surface)], materialPurpose=purpose)

    def _looks(self) -> Sdf.Path:
        root = self.stage.GetDefaultPrim()
        top = root.GetPath() if root else Sdf.Path.absoluteRootPath
        UsdGeom.Scope.Define(self.stage, top.AppendChild("EditedLooks"))
        return top.AppendChild("EditedLooks")

    def _uncover(self, prim: Usd.Prim, surface: Surface, material: Material | None) -> None:
        """Take from a prim the materials of what stood there: its asset has its own."""
        if prim.GetAttribute(MODEL).HasAuthoredValue():
            prim.GetAttribute(MODEL).Block()
        binding = UsdShade.MaterialBindingAPI(prim)
        for purpose, rel in (("", "material:binding"), ("radio", "material:binding:radio")):
            if prim.GetRelationship(rel).HasAuthoredTargets():
                binding.UnbindDirectBinding(purpose)
        said = Materials(self.time, torch.device("cpu"), Kept()).said(prim)
        if said is None:
            return
        if material is not None:  # stronger than what an ancestor is bound to
            self._cover(prim, surface, material)
        else:  # bound to what says nothing of radio, and so to none of its ancestors' materials
            path = self._looks().AppendChild("AsTheAssetSays")
            plain = UsdShade.Material.Define(self.stage, path)
            UsdShade.MaterialBindingAPI.Apply(prim).Bind(plain)

    # radios

    def radio(self, role: str, radio: Radio, old: Any) -> None:
        """Author what a radio sends and hears, if that is not what stands there."""
        if isinstance(old, Radio) and self._said(radio.path) == role:
            placed = (radio.position, radio.rotation, radio.velocity)
            same = dict(zip(("position", "rotation", "velocity"), placed, strict=True))
            if alike(radio, old.__class__(**{**vars(old), **same})):
                return
        prim = self._prim(radio.path) if old is not None else self._define(radio.path)
        for item in RADIO:
            if prim.GetAttribute(item.name).HasAuthoredValue():
                prim.GetAttribute(item.name).Block()
        pattern = radio.pattern
        file = Sdf.AssetPath(str(self._pattern(pattern))) if isinstance(pattern, Pattern) else None
        author_radio(prim, role, radio, file)

    def _said(self, path: str) -> str:
        return str(self._prim(path).GetAttribute(RADIO[0].name).Get(self.time))

    def _pattern(self, pattern: Pattern) -> Path:
        """The file that a pattern came from, if it still holds the same; else one beside the layer."""
        if id(pattern) not in self.saved:
            file = Path(pattern.file).absolute() if pattern.file else None
            if file is None or not _holds(file, pattern):
                file = self._beside(Path(pattern.name).stem or "pattern", ".csv")
                self.written.append(file)
                write_beside(file, pattern.csv(), self.overwrite)
            self.saved[id(pattern)] = file
            self.folders.add(file.parent)
        return self.saved[id(pattern)]

    # places

    def place(self, thing: Node | Radio, old: Node | Radio | None) -> None:
        """Author the transform that puts a thing where it is, if it is not there; then its velocity."""
        prim = self.stage.GetPrimAtPath(thing.path)
        pose, here = _pose(thing), self._places().matrix(prim)
        if old is None or thing.path in self.swapped or thing.path not in self.before:
            wanted = _matrix(pose) @ _stretch(thing)
        elif alike(pose, was := _pose(old)):
            wanted = self.before[thing.path]
        else:
            wanted = _matrix(pose) @ np.linalg.solve(_matrix(was), self.before[thing.path])
        owes = thing.path in self.swapped and self._owes(prim)
        if owes or not np.array_equal(here, wanted):
            self._transform(self._prim(thing.path), wanted)
        self._velocity(thing)

    def _transform(self, prim: Usd.Prim, wanted: np.ndarray) -> None:
        parent = prim.GetParent()
        above = self.world if parent.IsPseudoRoot() else self._places().matrix(parent)
        local = np.linalg.solve(above, wanted)
        local[3] = 0, 0, 0, 1
        if not self._owes(prim) and self._shifted(prim, local):
            return
        self._ops(prim, {"xformOp:transform": local})
        if self._owes(prim):
            ratio, turn = conversion(prim)
            x = np.radians(turn)
            resolve = np.eye(4)
            resolve[1:3, 1:3] = [[np.cos(x), -np.sin(x)], [np.sin(x), np.cos(x)]]
            resolve[:3, :3] *= ratio
            ops: dict[str, Any] = {"xformOp:transform": local @ np.linalg.inv(resolve)}
            ops |= {"xformOp:rotateX:unitsResolve": turn} if turn else {}
            ops |= {"xformOp:scale:unitsResolve": ratio} if ratio != 1.0 else {}
            self._ops(prim, ops)

    def _owes(self, prim: Usd.Prim) -> bool:
        """Whether a prim lacks what converts the units and axes of what it references."""
        return any(True for _ in unit_faults(prim, self.time))

    def _shifted(self, prim: Usd.Prim, local: np.ndarray) -> bool:
        """Author the transform by its translation alone, where that is its first op and nothing else
        changes: it stays as readable as it was."""
        xform = UsdGeom.Xformable(prim)
        old = np.array(xform.GetLocalTransformation(self.time)).T
        off = np.abs(local[:3, :3] - old[:3, :3]).max()
        ops = xform.GetOrderedXformOps()
        if off > ROUNDING * np.abs(old[:3, :3]).max() or not ops:
            return False
        first = ops[0]
        double = first.GetPrecision() == UsdGeom.XformOp.PrecisionDouble
        if first.GetOpName() != "xformOp:translate" or first.MightBeTimeVarying() or not double:
            return False
        place = np.array(first.Get(self.time)) + local[:3, 3] - old[:3, 3]
        first.Set(Gf.Vec3d(*place.tolist()))
        return True

    def _ops(self, prim: Usd.Prim, values: dict[str, Any]) -> None:
        """Author a prim's transform as these ops alone, in their order."""
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                kind, value = Sdf.ValueTypeNames.Matrix4d, Gf.Matrix4d(*value.T.ravel().tolist())
            elif "scale" in name:
                kind, value = Sdf.ValueTypeNames.Double3, Gf.Vec3d(value)
            else:
                kind = Sdf.ValueTypeNames.Double
            prim.CreateAttribute(name, kind, custom=False).Set(value)
        UsdGeom.Xformable(prim).CreateXformOpOrderAttr().Set(list(values))

    def _velocity(self, thing: Node | Radio) -> None:
        """Said outright where the prim's motion would give another: it lost its samples, or never
        had any."""
        prim = self._prim(thing.path)
        wanted = as_numpy(thing.velocity)
        if np.array_equal(as_numpy(self._places().velocity(prim)), wanted):
            return
        turn = self.world[:3, :3] / np.linalg.norm(self.world[:3, 0])
        author(prim, {VELOCITY: Gf.Vec3d(*(turn.T @ wanted).tolist())})

    def _places(self) -> Places:
        return Places(self.time, self.world)

    # prims

    def _prim(self, path: str) -> Usd.Prim:
        """The prim at a path, made editable: what lies in an instance leaves it."""
        prim = self.stage.GetPrimAtPath(path)
        if prim and prim.IsInstanceProxy():
            UsdUtils.UninstancePrimAtPath(self.stage, path)
            prim = self.stage.GetPrimAtPath(path)
        return prim

    def _define(self, path: str) -> Usd.Prim:
        if self.stage.GetPrimAtPath(path):
            raise SceneError([f"{path}: a prim that is no object stands here; choose another path"])
        for parent in Sdf.Path(path).GetParentPath().GetPrefixes():
            if not self.stage.GetPrimAtPath(parent):
                UsdGeom.Xform.Define(self.stage, parent)
            elif self.stage.GetPrimAtPath(parent).IsInstanceable():
                self.stage.GetPrimAtPath(parent).SetInstanceable(False)
        return self.stage.DefinePrim(path, "Xform")


def _pose(thing: Node | Radio) -> Pose:
    if isinstance(thing, Node):
        return thing.pose
    return Pose(thing.rotation, thing.position, torch.ones((), dtype=torch.float64))


def _stretch(thing: Node | Radio) -> np.ndarray:
    """What its transform does to a thing besides its pose: a learned object may be stretched."""
    scales = as_numpy(unstretched(thing.body)[1]) if isinstance(thing, Node) else np.ones(3)
    return np.diag([*scales, 1.0])


def _matrix(pose: Pose) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = as_numpy(pose.rotation) * float(pose.scale.detach())
    matrix[:3, 3] = as_numpy(pose.translation)
    return matrix


def _holds(file: Path, pattern: Pattern) -> bool:
    """Whether a file holds the pattern that was once read from it."""
    try:
        return file.is_file() and Pattern.from_file(file).same(pattern)
    except SceneError:
        return False
