"""The attributes of rfsg in USD: one table of names, types, what they may hold, and fallbacks.

``schema/generatedSchema.usda`` tells other programs the same; a test compares the two.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

from rfsg.objects.physics.lobes import LOBES
from rfsg.objects.shapes.topology import MAX_TRIANGLES
from rfsg.scene.antennas import PATTERNS, POLARIZATIONS
from rfsg.scene.arrays import MAX_ELEMENTS, UNITS
from rfsg.scene.materials import MODELS
from rfsg.scene.weights import FORMAT_VERSION


@dataclass(frozen=True)
class Field:
    """One attribute: its USD type, the tokens or the sign it may take, its fallback."""

    name: str
    kind: str
    tokens: tuple[str, ...] = ()
    positive: bool = False
    most: int = MAX_ELEMENTS  # rows of an array
    fallback: Any = None

    def amiss(self, value: Any) -> str | None:
        """What was expected instead of a value, or None when it is in order."""
        if self.kind == "double":
            fine = isinstance(value, float) and math.isfinite(value)
            fine = fine and (value > 0 or not self.positive)
            return None if fine else "a finite number" + " > 0" * self.positive
        if self.kind in ("float3", "double3"):
            fine = isinstance(value, tuple) and len(value) == 3 and all(map(math.isfinite, value))
            return None if fine else "three finite numbers"
        if self.kind == "double3[]":
            fine = isinstance(value, ndarray) and value.ndim == 2 and value.shape[1] == 3
            fine = fine and 1 <= len(value) <= self.most and bool(np.isfinite(value).all())
            return None if fine else f"1 to {self.most} triples of finite numbers"
        if self.kind == "int" and self.positive:
            return None if isinstance(value, int) and value > 0 else "a whole number > 0"
        if self.tokens:
            return None if value in self.tokens else f"one of {', '.join(self.tokens)}"
        wanted = {"int": int, "bool": bool}.get(self.kind, str)
        return None if isinstance(value, wanted) else f"a value of type {self.kind}"


BAND = (  # what the object was learned at; beyond is extrapolation
    Field("rfsg:band:minHz", "double", positive=True),
    Field("rfsg:band:maxHz", "double", positive=True),
)
NEURAL = (
    Field("rfsg:neural:weights", "asset"),
    Field("rfsg:neural:formatVersion", "int", fallback=FORMAT_VERSION),
    Field("rfsg:neural:sha256", "string"),
    Field("rfsg:neural:boundsMin", "float3"),
    Field("rfsg:neural:boundsMax", "float3"),
    Field("rfsg:neural:lipschitz", "double", positive=True),
    Field("rfsg:neural:provenance", "string", fallback="{}"),
    *BAND,
)
MATERIAL = (
    Field("rfsg:material:model", "token", tokens=MODELS),
    Field("rfsg:material:itu", "token"),
    Field("rfsg:material:epsR", "double", positive=True),
    Field("rfsg:material:sigma", "double"),
    Field("rfsg:material:thickness", "double", positive=True),
    Field("rfsg:material:extrapolate", "bool", fallback=False),
    Field("rfsg:material:scattering", "double"),
    Field("rfsg:material:lobe", "token", tokens=tuple(LOBES)),
    Field("rfsg:material:alphaR", "int"),
    Field("rfsg:material:alphaI", "int"),
    Field("rfsg:material:forwardShare", "double"),
    Field("rfsg:material:crossShare", "double"),
)
RADIO = (
    Field("rfsg:radio:role", "token", tokens=("tx", "rx")),
    Field("rfsg:radio:powerDbm", "double", fallback=0.0),
    Field("rfsg:radio:frequencyHz", "double", positive=True),
    Field("rfsg:radio:pattern", "token", tokens=tuple(PATTERNS), fallback="isotropic"),
    Field("rfsg:radio:patternFile", "asset"),
    Field("rfsg:radio:polarization", "token", tokens=tuple(POLARIZATIONS), fallback="none"),
    Field("rfsg:radio:array:rows", "int", positive=True),
    Field("rfsg:radio:array:columns", "int", positive=True),
    Field("rfsg:radio:array:spacingVertical", "double", positive=True, fallback=0.5),
    Field("rfsg:radio:array:spacingHorizontal", "double", positive=True, fallback=0.5),
    Field("rfsg:radio:array:offsets", "double3[]"),
    Field("rfsg:radio:array:unit", "token", tokens=UNITS, fallback="wavelength"),
)
SHAPE = Field("rfsg:shape", "token", tokens=("halfspace",))
VELOCITY = Field("rfsg:velocity", "double3")
MESH_POINTS = Field("rfsg:mesh:points", "double3[]", most=3 * MAX_TRIANGLES)
FREQUENCY = Field("rfsg:frequencyHz", "double", positive=True)
FIELDS = {f.name: f for f in (*NEURAL, *MATERIAL, *RADIO, SHAPE, VELOCITY, MESH_POINTS, FREQUENCY)}
