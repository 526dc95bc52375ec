"""The attributes of ``rfsg.scene.fields`` on prims: their USD types and schemas, reading, writing."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pxr import Plug, Sdf, Usd, Vt

from rfsg.scene.fields import Field
from rfsg.scene.scene import SceneError

NEURAL_API, MATERIAL_API, RADIO_API = "RfsgNeuralObjectAPI", "RfsgMaterialAPI", "RfsgRadioAPI"
SCHEMA_FOLDER = Path(__file__).parents[1] / "schema"
USD_TYPES = {
    "asset": Sdf.ValueTypeNames.Asset,
    "int": Sdf.ValueTypeNames.Int,
    "bool": Sdf.ValueTypeNames.Bool,
    "string": Sdf.ValueTypeNames.String,
    "token": Sdf.ValueTypeNames.Token,
    "double": Sdf.ValueTypeNames.Double,
    "float3": Sdf.ValueTypeNames.Float3,
    "double3": Sdf.ValueTypeNames.Double3,
    "double3[]": Sdf.ValueTypeNames.Double3Array,
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


def values_of(prim: Usd.Prim, time: Usd.TimeCode, *wanted: Field) -> dict[str, Any]:
    """The authored values, else the fallbacks. Raises SceneError with everything amiss."""
    values: dict[str, Any] = {}
    faults: list[str] = []
    for item in wanted:
        attribute = prim.GetAttribute(item.name)
        value = attribute.Get(time) if attribute.HasAuthoredValue() else None
        values[item.name] = item.fallback if value is None else _plain(value, item.kind)
        if value is not None and (amiss := item.amiss(values[item.name])):
            faults.append(f"{prim.GetPath()}: {item.name} is {_brief(value)}; expected {amiss}")
    if faults:
        raise SceneError(faults)
    return values


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


def author(prim: Usd.Prim, values: Mapping[Field, Any], api: str | None = None) -> None:
    """Every value explicit and custom: other programs lose fallbacks and schema attributes."""
    for item, value in values.items():
        if value is not None:
            prim.CreateAttribute(item.name, USD_TYPES[item.kind], custom=True).Set(value)
    if api:  # last: what a schema already defines would not be authored as custom
        prim.AddAppliedSchema(api)


def as_numpy(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().to(torch.float64).numpy()
