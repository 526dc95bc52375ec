"""Radio materials: what a prim says or is bound to, the surfaces made of it, and writing them."""

from dataclasses import astuple, dataclass, field, replace

import torch
from pxr import Gf, Sdf, Usd, UsdShade

from rfsg.objects.contract import Surface
from rfsg.scene.fields import MATERIAL
from rfsg.scene.materials import Material
from rfsg.scene.scene import SceneError
from rfsg.scene.usd.attributes import MATERIAL_API, author, values_of
from rfsg.scene.usd.composition import spec
from rfsg.scene.usd.kept import Kept
from rfsg.scene.usd.meshes import is_sheet

FILLING = ("solid", "stochastic")  # models that say what an object does inside


@dataclass
class Materials:
    """The radio materials of a stage at a time code, with the surfaces made so far."""

    time: Usd.TimeCode
    device: torch.device
    kept: Kept
    surfaces: dict[tuple[str, Material], Surface] = field(default_factory=dict)

    def said(self, prim: Usd.Prim) -> tuple[str, Material] | None:
        """(where it is said, what is said), or None without radio material."""
        at = spec(prim)
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
            prim, at = at, spec(at)
        material = Material(*values_of(prim, self.time, *MATERIAL).values())
        if faults := material.faults():
            raise SceneError([f"{prim.GetPath()}: {fault}" for fault in faults])
        return str(at.GetPath()), material

    def surface(
        self, prim: Usd.Prim, where: str, material: Material, thickness: float | None = None
    ) -> Surface:
        """One surface for each material prim and thickness: what a fit learns of it, all share."""
        if material.model in FILLING and is_sheet(prim):
            raise SceneError(
                [f"{prim.GetPath()}: a sheet has no inside for model {material.model} to fill; "
                 "expected conductor, halfspace or slab"]
            )  # fmt: skip
        if material.model == "slab" and material.thickness is None:
            if thickness is None:
                raise SceneError([f"{prim.GetPath()}: slab needs rfsg:material:thickness here"])
            material = replace(material, thickness=thickness)
        key = (where, material)
        if key not in self.surfaces:
            try:
                make = material.surface
                surface = self.kept.of(("surface", *key), make)
                self.surfaces[key] = surface.to(self.device)
            except (ValueError, TypeError) as error:
                raise SceneError([f"{where}: {error}"]) from error
        return self.surfaces[key]

    def names(self) -> tuple[tuple[Surface, str], ...]:
        """Each surface with the name of the prim that says its material."""
        return tuple((s, Sdf.Path(where).name) for (where, _), s in self.surfaces.items())


def define_material(stage: Usd.Stage, path: str, material: Material) -> UsdShade.Material:
    look = UsdShade.Material.Define(stage, path)
    values = dict(zip(MATERIAL, astuple(material), strict=True))
    author(look.GetPrim(), values, MATERIAL_API)
    color, opacity = material.look()
    shader = UsdShade.Shader.Define(stage, f"{path}/Preview")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(opacity)
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(
        float(material.model == "conductor")
    )
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
    look.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return look
