"""An imported scene as USD: thousands of meshes at once, through Sdf in one block of changes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy import ndarray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from rfsg.scene.fields import FREQUENCY
from rfsg.scene.files import MAX_TEXT_BYTES
from rfsg.scene.importers.parts import Imported, Part
from rfsg.scene.radios import Radio
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import as_numpy, author
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.materials import define_material
from rfsg.scene.usd.meshes import SHEET, vectors
from rfsg.scene.usd.radios import author_radio
from rfsg.scene.weights import refuse_overwrite, write_beside

ROOT = Sdf.Path("/World")
ENDINGS = (".usda", ".usdc")


def write_imported(
    imported: Imported,
    path: Path,
    transmitters: Sequence[Radio] = (),
    receivers: Sequence[Radio] = (),
    frequency: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Write parts, materials and radios as USD in metres, z up: text (.usda) or binary (.usdc).

    Each object stands at the middle of its floor, so that it turns about itself. Raises SceneError
    for another ending, and for text of more than a reader takes.
    """
    if path.suffix not in ENDINGS:
        raise SceneError([f"{path}: expected an ending of {' or '.join(ENDINGS)}"])
    refuse_overwrite([path], overwrite)
    with quiet(path):
        layer = Sdf.Layer.CreateAnonymous(path.suffix)
        _author(layer, imported, transmitters, receivers, frequency)
        if path.suffix == ".usda":
            data = layer.ExportToString().encode()
            if len(data) > MAX_TEXT_BYTES:
                raise SceneError([f"{path}: {len(data)} bytes of text; write it as .usdc"])
            write_beside(path, data, overwrite)
        else:
            beside = path.with_name(f".{path.stem}.part.usdc")
            try:
                layer.Export(str(beside))
                write_beside(path, beside.read_bytes(), overwrite)
            finally:
                beside.unlink(missing_ok=True)
    return path


def _author(
    layer: Sdf.Layer,
    imported: Imported,
    transmitters: Sequence[Radio],
    receivers: Sequence[Radio],
    frequency: float | None,
) -> None:
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    top = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    stage.SetDefaultPrim(top)
    if frequency is not None:
        author(top, {FREQUENCY: float(frequency)})
    UsdGeom.Scope.Define(stage, ROOT.AppendChild("Looks"))
    looks, taken = {}, {"Looks"}
    names: set[str] = set()
    for name, material in imported.materials.items():
        looks[name] = ROOT.AppendChild("Looks").AppendChild(_fresh(name, names))
        define_material(stage, str(looks[name]), material)
    for role, radios in (("tx", transmitters), ("rx", receivers)):
        for radio in radios:
            taken.add(radio.path.split("/")[-1])
            prim = UsdGeom.Xform.Define(stage, radio.path).GetPrim()
            author_radio(prim, role, radio, None)
            place = Gf.Vec3d(*as_numpy(radio.position).tolist())
            UsdGeom.Xformable(prim).AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(place)
    with Sdf.ChangeBlock():
        for part in imported.parts:
            _part(layer, ROOT.AppendChild(_fresh(part.name, taken)), part, looks[part.material])


def _part(layer: Sdf.Layer, path: Sdf.Path, part: Part, look: Sdf.Path) -> None:
    spec = Sdf.CreatePrimInLayer(layer, path)
    spec.specifier = Sdf.SpecifierDef
    spec.typeName = "Sphere" if part.ball else "Mesh"
    apis = Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"])
    spec.SetInfo("apiSchemas", apis)
    binding = Sdf.RelationshipSpec(spec, "material:binding", custom=False)
    binding.targetPathList.explicitItems = [look]
    types = Sdf.ValueTypeNames
    if part.ball:
        centre, radius = part.ball
        _set(spec, "radius", types.Double, radius)
        _set(spec, "extent", types.Float3Array, vectors(np.array([[-radius] * 3, [radius] * 3])))
    else:
        centre, points = _centred(part.vertices)
        _set(spec, "points", types.Point3fArray, vectors(points))
        count = np.full(len(part.triangles), 3, np.int32)
        _set(spec, "faceVertexCounts", types.IntArray, Vt.IntArray.FromNumpy(count))
        index = part.triangles.astype(np.int32).ravel()
        _set(spec, "faceVertexIndices", types.IntArray, Vt.IntArray.FromNumpy(index))
        _set(spec, "extent", types.Float3Array, vectors(np.stack([points.min(0), points.max(0)])))
        _set(spec, "subdivisionScheme", types.Token, "none", Sdf.VariabilityUniform)
        if part.sheet:
            spec.SetInfo("customData", SHEET)
            _set(spec, "doubleSided", types.Bool, True, Sdf.VariabilityUniform)
    _set(spec, "xformOp:translate", types.Double3, Gf.Vec3d(*centre))
    order = ["xformOp:translate"]
    _set(spec, "xformOpOrder", types.TokenArray, Vt.TokenArray(order), Sdf.VariabilityUniform)


def _centred(vertices: ndarray) -> tuple[tuple[float, float, float], ndarray]:
    """The middle of the floor under vertices, to the millimetre, and the vertices from there."""
    low, high = vertices.min(0), vertices.max(0)
    centre = np.round(np.array([*(0.5 * (low + high))[:2], low[2]]), 3)
    x, y, z = centre.tolist()
    return (x, y, z), vertices - centre


def _set(
    spec: Sdf.PrimSpec,
    name: str,
    kind: Sdf.ValueTypeName,
    value: object,
    variability: Sdf.Variability = Sdf.VariabilityVarying,
) -> None:
    Sdf.AttributeSpec(spec, name, kind, variability).default = value


def _fresh(name: str, taken: set[str]) -> str:
    """A valid prim name that nothing else has; it is then taken."""
    plain = Tf.MakeValidIdentifier(name or "Part")
    fresh, number = plain, 1
    while fresh in taken:
        fresh, number = f"{plain}_{number}", number + 1
    taken.add(fresh)
    return fresh
