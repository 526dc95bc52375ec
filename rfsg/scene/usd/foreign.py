"""Other programs' USD scenes: a layer over them that says what their materials are to a wave.

The source stays as it is and where it is. Aerial's meshes are bound for radio to new materials;
SimReady's materials are themselves given radio attributes; open meshes are marked as sheets.
"""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade

from rfsg.scene import files
from rfsg.scene.fields import FREQUENCY, MATERIAL
from rfsg.scene.importers import aerial, simready
from rfsg.scene.importers.parts import MAX_PARTS, is_closed
from rfsg.scene.materials import Material
from rfsg.scene.radios import Radio
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import MATERIAL_API, as_numpy, author
from rfsg.scene.usd.composition import metre_of, up_of
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.layers import open_stage
from rfsg.scene.usd.materials import define_material
from rfsg.scene.usd.radios import author_radio
from rfsg.scene.weights import refuse_overwrite, write_beside

LOOKS = "/RadioMaterials"
MODEL = MATERIAL[0].name
SHOWN = 8  # names in a warning before "and more"


@dataclass
class Found:
    """What a stage says, and what is written over it."""

    objects: int = 0
    triangles: int = 0
    warnings: tuple[str, ...] = ()
    named: dict[str, Material] = field(default_factory=dict)  # Aerial's, by name
    bound: dict[str, str] = field(default_factory=dict)  # mesh: name of its material
    dressed: dict[str, Material] = field(default_factory=dict)  # SimReady's, by material prim
    sheets: list[str] = field(default_factory=list)

    @property
    def materials(self) -> tuple[str, ...]:
        return (*self.named, *(path.split("/")[-1] for path in self.dressed))


def write_over(
    source: Path,
    out: Path,
    transmitters: Sequence[Radio] = (),
    receivers: Sequence[Radio] = (),
    frequency: float | None = None,
    overwrite: bool = False,
) -> Found:
    """Write a layer (.usda) over a USD scene and say what it adds.

    Raises SceneError when the scene holds neither Aerial's nor SimReady's materials, when a material
    is at fault, and where the layer could not read its source."""
    if out.suffix != ".usda":
        raise SceneError([f"{out}: a layer over a scene is written as text; expected .usda"])
    refuse_overwrite([out], overwrite)
    if why := files.outside(str(source.absolute()), [files.default_root(out)]):
        raise SceneError([f"{out}: its source {source} {why}"])
    with quiet(source):
        stage = open_stage(source, (files.default_root(source),))
        found = _looked(stage, source, frequency)
        data = _layer(stage, source, out, found, (transmitters, receivers), frequency)
        del stage
    write_beside(out, data.encode(), overwrite)
    return found


def _looked(stage: Usd.Stage, source: Path, frequency: float | None) -> Found:
    """Every mesh and material of the stage. Raises SceneError listing all faults."""
    found, faults, unknown, left = Found(), [], Counter(), []
    meshes: list[Usd.Prim] = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        base = prim.GetAttribute(simready.BASE).Get()
        if base and not prim.GetAttribute(MODEL).HasAuthoredValue():
            material = simready.radio_of(str(base))
            if material is None:
                unknown[str(base)] += 1
            elif prim.IsInstanceProxy():
                left.append(str(prim.GetPath()))
            else:
                found.dressed[str(prim.GetPath())] = material
        if prim.IsA(UsdGeom.Mesh):
            meshes.append(prim)
            if len(meshes) > MAX_PARTS:
                raise SceneError([f"{source}: more than {MAX_PARTS} meshes"])
    for prim in meshes:
        name = prim.GetAttribute(aerial.MATERIAL).Get()
        if name and prim.GetAttribute(aerial.MESH).Get() is not False:
            _name(stage, str(name), found, faults, frequency)
            found.bound[str(prim.GetPath())] = str(name)
    for prim in meshes:
        _mesh(prim, found, left)
    if not (found.bound or found.dressed) and not faults:
        faults.append(
            f"{source}: no material of Aerial ({aerial.MATERIAL}) or SimReady ({simready.BASE}) "
            "that a wave would know"
        )
    if faults:
        raise SceneError([f"{source}: {f}" if not f.startswith(str(source)) else f for f in faults])
    found.warnings = _warnings(found, unknown, left)
    return found


def _name(
    stage: Usd.Stage, name: str, found: Found, faults: list[str], frequency: float | None
) -> None:
    """Look Aerial's material up, once."""
    if name in found.named or any(f" {name!r}: " in fault for fault in faults):
        return
    tops = [p for p in stage.GetPseudoRoot().GetAllChildren() if p.GetName() == "Materials"]
    prims = [p for top in tops for p in Usd.PrimRange(top) if p.GetName() == name]
    if not prims:
        faults.append(f"material {name!r}: there is no prim of this name under /Materials")
        return
    said = {k: _number(prims[0], k) for k in aerial.SAID}
    try:
        found.named[name] = aerial.radio_of(
            {k: v for k, v in said.items() if v is not None}, frequency
        )
    except (SceneError, ValueError) as error:
        faults.append(f"material {name!r}: {error}")


def _number(prim: Usd.Prim, name: str) -> float | None:
    """A number as it was meant: 0.3 in single precision is 0.3."""
    value = prim.GetAttribute(name).Get()
    return float(f"{value:.7g}") if isinstance(value, (int, float)) else None


def _mesh(prim: Usd.Prim, found: Found, left: list[str]) -> None:
    """Count a mesh that waves will see, and note whether it is a sheet."""
    path = str(prim.GetPath())
    look, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("radio")
    at = look.GetPrim() if look else None
    dressed = at and (
        str(at.GetPath()) in found.dressed or at.GetAttribute(MODEL).HasAuthoredValue()
    )
    if path not in found.bound and not dressed:
        return
    count = np.array(prim.GetAttribute("faceVertexCounts").Get() or [], dtype=np.int64)
    index = np.array(prim.GetAttribute("faceVertexIndices").Get() or [], dtype=np.int64)
    points = np.array(prim.GetAttribute("points").Get() or [], dtype=np.float64).reshape(-1, 3)
    found.objects += 1
    found.triangles += int((count - 2).clip(min=0).sum())
    whole = len(count) and count.min() >= 3 and count.sum() == len(index) and len(points)
    if not whole or index.min() < 0 or index.max() >= len(points):
        return  # reading the scene will say what is amiss
    first = np.repeat(np.cumsum(count) - count, count - 2)
    step = np.arange(len(first)) - np.repeat(np.cumsum(count - 2) - (count - 2), count - 2) + 1
    fan = np.stack([index[first], index[first + step], index[first + step + 1]], 1)
    if not is_closed(points, fan):
        (left if prim.IsInstanceProxy() else found.sheets).append(path)


def _warnings(found: Found, unknown: Counter, left: list[str]) -> tuple[str, ...]:
    said = []
    if found.dressed:
        said.append(
            "SimReady's materials say no thickness; walls were given the usual one: "
            + _some([path.split("/")[-1] for path in found.dressed])
        )
    if unknown:
        said.append(f"no radio material for {_some(list(unknown))}; waves do not see what has it")
    if left:
        said.append(f"inside instances, which a layer cannot edit, left as they are: {_some(left)}")
    return tuple(said)


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def _layer(
    source_stage: Usd.Stage,
    source: Path,
    out: Path,
    found: Found,
    radios: tuple[Sequence[Radio], Sequence[Radio]],
    frequency: float | None,
) -> str:
    root, below = Sdf.Layer.CreateAnonymous(".usda"), source_stage.GetRootLayer()
    root.subLayerPaths.append(below.identifier)
    if below.defaultPrim:
        root.defaultPrim = below.defaultPrim
    stage = Usd.Stage.Open(root)
    metre, up = metre_of(below), up_of(below)
    if metre is not None:  # neither is inherited from sublayers
        UsdGeom.SetStageMetersPerUnit(stage, metre)
    if up is not None:
        UsdGeom.SetStageUpAxis(stage, up)
    if frequency is not None and stage.GetDefaultPrim():
        author(stage.GetDefaultPrim(), {FREQUENCY: float(frequency)})
    looks = {}
    for name, material in found.named.items():
        path = f"{LOOKS}/{Tf.MakeValidIdentifier(name)}"
        looks[name] = define_material(stage, path, material)
    for path, name in found.bound.items():
        api = UsdShade.MaterialBindingAPI.Apply(stage.OverridePrim(path))
        api.Bind(looks[name], materialPurpose="radio")
    for path, material in found.dressed.items():
        author(stage.OverridePrim(path), _values(material), MATERIAL_API)
    for path in found.sheets:
        stage.OverridePrim(path).SetCustomDataByKey("rfsg:sheet", True)
    for role, some in zip(("tx", "rx"), radios, strict=True):
        for radio in some:
            _radio(stage, role, radio, metre or 1.0, up)
    root.subLayerPaths[0] = _relative(source, out.parent)
    return root.ExportToString()


def _values(material: Material) -> dict[Any, Any]:
    values = (getattr(material, name) for name in Material.__dataclass_fields__)
    return dict(zip(MATERIAL, values, strict=True))


def _radio(stage: Usd.Stage, role: str, radio: Radio, metre: float, up: str | None) -> None:
    """A radio, placed in metres with z up, in the stage's units and axes."""
    x, y, z = (as_numpy(radio.position) / metre).tolist()
    place = Gf.Vec3d(x, z, -y) if up == "Y" else Gf.Vec3d(x, y, z)
    default = stage.GetDefaultPrim()
    top = str(default.GetPath()) if default else ""
    name = radio.path.split("/")[-1]
    prim = UsdGeom.Xform.Define(stage, f"{top}/{name}").GetPrim()
    author_radio(prim, role, radio, None)
    form = UsdGeom.Xformable(prim)
    form.SetResetXformStack(True)
    form.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(place)


def _relative(path: Path, folder: Path) -> str:
    relative = os.path.relpath(os.path.realpath(path), os.path.realpath(folder)).replace(
        os.sep, "/"
    )
    return relative if relative.startswith(".") else f"./{relative}"
