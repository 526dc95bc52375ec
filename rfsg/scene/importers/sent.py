"""What an importer finds, from one process to another; see ``rfsg.scene.wire``."""

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from safetensors.torch import load, save

from rfsg.scene.errors import SceneError
from rfsg.scene.importers.parts import Imported, Part
from rfsg.scene.materials import Material
from rfsg.scene.wire import REFUSALS, Message, numbers, plain


def imported_message(found: Imported) -> Message:
    parts = [
        {"name": p.name, "material": p.material, "sheet": p.sheet, "ball": p.ball,
         "vertices": len(p.vertices), "triangles": len(p.triangles)}
        for p in found.parts
    ]  # fmt: skip
    vertices = [torch.zeros(0, 3, dtype=torch.float64)]
    triangles = [torch.zeros(0, 3, dtype=torch.int64)]
    vertices += [torch.tensor(p.vertices, dtype=torch.float64) for p in found.parts]
    triangles += [torch.tensor(p.triangles, dtype=torch.int64) for p in found.parts]
    blob = save({"vertices": torch.cat(vertices), "triangles": torch.cat(triangles)})
    materials = {name: asdict(m) for name, m in found.materials.items()}
    head = {"parts": parts, "materials": materials, "warnings": list(found.warnings)}
    return head, [blob]


def imported_of(message: Message, where: str) -> Imported:
    """What an importer found, of a message. Raises SceneError for one that is not in order."""
    head, blobs = message
    try:
        arrays = load(blobs[0])
        vertices, triangles = arrays["vertices"].numpy(), arrays["triangles"].numpy()
        materials = {plain(name): Material(**said) for name, said in head["materials"].items()}
        parts, v, t = [], 0, 0
        for row in head["parts"]:
            ends = v + int(row["vertices"]), t + int(row["triangles"])
            parts.append(_part(row, vertices[v : ends[0]], triangles[t : ends[1]], materials))
            v, t = ends
        warnings = tuple(plain(w) for w in head["warnings"])
    except REFUSALS as error:
        raise SceneError([f"{where}: its reader sent what is no scene: {error}"]) from error
    return Imported(tuple(parts), materials, warnings, where)


def _part(
    row: dict[str, Any],
    vertices: ndarray,
    triangles: ndarray,
    materials: dict[str, Material],
) -> Part:
    if row["material"] not in materials or not np.isfinite(vertices).all():
        raise ValueError("a part without a material, or with numbers that are not finite")
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ValueError("a part with corners that are not there")
    ball = row["ball"]
    if ball is not None:
        x, y, z = numbers(ball[0], 3).tolist()
        ball = (x, y, z), float(numbers(ball[1]))
    name, sheet = plain(row["name"]), row["sheet"] is True
    return Part(name, vertices, triangles, row["material"], sheet, ball)
