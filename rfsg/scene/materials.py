"""Radio materials as a scene names them <-> surfaces. One table; nothing of USD in here."""

from dataclasses import dataclass
from typing import Any

from rfsg.objects.catalogue import surface_class

MODELS = ("conductor", "halfspace", "slab", "solid", "stochastic")
CONSTANTS = ("halfspace", "slab", "solid")  # the models that take permittivity and conductivity
SCATTERING = ("scattering", "lobe", "alpha_r", "alpha_i", "forward_share", "cross_share")

# linear base colour and opacity of the preview surface, by ITU name or model
LOOKS = {
    "concrete": ((0.35, 0.35, 0.34), 1.0),
    "brick": ((0.4, 0.15, 0.1), 1.0),
    "plasterboard": ((0.7, 0.69, 0.65), 1.0),
    "wood": ((0.35, 0.2, 0.09), 1.0),
    "glass": ((0.6, 0.75, 0.78), 0.25),
    "conductor": ((0.45, 0.47, 0.5), 1.0),
}
PLAIN_LOOK = ((0.5, 0.5, 0.5), 1.0)


@dataclass(frozen=True)
class Material:
    """What a prim says of its material: a model and, for halfspace, slab and solid, either an ITU-R
    P.2040 name or a relative permittivity and a conductivity [S/m]; thickness [m] for slab. extrapolate:
    whether the ITU formula may be used outside its bands. scattering and what follows: how a rough
    one scatters, as ``rfsg.objects.physics.lobes.Scattering`` takes it; the lobe is Lambertian where
    none is named."""

    model: str
    itu: str | None = None
    eps_r: float | None = None
    sigma: float | None = None
    thickness: float | None = None
    extrapolate: bool = False
    scattering: float | None = None
    lobe: str | None = None
    alpha_r: int | None = None
    alpha_i: int | None = None
    forward_share: float | None = None
    cross_share: float | None = None

    def faults(self) -> list[str]:
        """What contradicts itself or is missing, thickness aside."""
        given = [n for n in SCATTERING if getattr(self, n) is not None]
        if given and self.model == "stochastic":
            return [f"model stochastic takes no {', '.join(given)}: alpha says what scatters"]
        if given and self.scattering is None:
            return [f"{', '.join(given)} without scattering"]
        if self.model not in CONSTANTS:
            names = ("itu", "eps_r", "sigma", "thickness")
            given = [n for n in names if getattr(self, n) is not None]
            return [f"model {self.model} takes no {', '.join(given)}"] if given else []
        if self.itu is not None and (self.eps_r, self.sigma) != (None, None):
            return ["give either itu, or epsR and sigma, not both"]
        if self.itu is None and self.eps_r is None:
            return [f"model {self.model} needs itu, or epsR and sigma"]
        if self.model == "halfspace" and self.thickness is not None:
            return ["model halfspace has no thickness; use slab"]
        if self.model == "solid" and self.thickness is not None:
            return ["model solid is as thick as its shape and takes no thickness; use slab"]
        return []

    def surface(self) -> Any:
        """The ``Surface``; ValueError for what its constructor refuses."""
        arguments: dict[str, Any] = {}
        if self.model in CONSTANTS:
            names = ("itu", "eps_r", "sigma", "extrapolate")
            arguments = {name: getattr(self, name) for name in names}
        if self.model == "slab":
            arguments["thickness_m"] = self.thickness
        if self.scattering is not None:
            rough = {name: getattr(self, name) for name in SCATTERING[1:]}
            given = {name: value for name, value in rough.items() if value is not None}
            arguments["scattering"] = {"coefficient": self.scattering, **given}
        return surface_class(self.model)(**arguments)

    def look(self) -> tuple[tuple[float, float, float], float]:
        return LOOKS.get(self.itu or self.model, PLAIN_LOOK)


def material_of(surface: Any) -> Material | None:
    """The material that gives an equal surface, or None when only a weights file can hold it."""
    if surface.kind not in MODELS or surface.kind == "stochastic":
        return None
    config = surface.config()
    rough = dict(config.get("scattering", {}))
    material = Material(
        surface.kind,
        config.get("itu"),
        config.get("eps_r"),
        config.get("sigma"),
        config.get("thickness_m"),
        config.get("extrapolate", False),
        rough.pop("coefficient", None),
        **rough,
    )
    return material if material.surface().config() == config else None
