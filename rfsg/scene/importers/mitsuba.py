"""Mitsuba XML as Sionna RT uses it: shapes with radio materials, in metres, z up.

Rules of its materials (Sionna RT 2.2): ``itu-radio-material`` names a row of ITU-R P.2040 and a
thickness; so does any ``bsdf`` whose id, less ``mat-``, begins ``itu_`` or ``itu-``; ``radio-material``
gives constants. A wall there is a sheet of triangles, seen from both sides, and so it is here.
"""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from rfsg.scene import files
from rfsg.scene.errors import SceneError
from rfsg.scene.importers import primitives
from rfsg.scene.importers.obj import read_obj
from rfsg.scene.importers.parts import MAX_PARTS, Imported, Part, divided
from rfsg.scene.importers.ply import read_ply
from rfsg.scene.importers.table import itu_material
from rfsg.scene.importers.transforms import transform_of
from rfsg.scene.materials import Material

MAX_BYTES = 64 * 2**20
MAX_DEPTH = 8  # shapes within shapes
THICKNESS = 0.1  # [m] where a material says none (Sionna RT's default)
SKIPPED = ("sensor", "emitter", "integrator", "film", "sampler", "texture", "medium", "phase")
DRAWN = {"rectangle": primitives.rectangle, "cube": primitives.cube, "disk": primitives.disk}


def read_mitsuba(path: Path) -> Imported:
    """The shapes and radio materials of a Mitsuba scene. Mesh files must lie in its folder.

    Raises SceneError listing every fault: XML that cannot be read or declares a document type,
    materials that no wave knows, shapes of other kinds, mesh files that are missing or elsewhere.
    """
    reader = _Reader(path)
    root = _root(path)
    reader.defaults = {
        e.get("name", ""): e.get("value", "") for e in root.findall("default") if e.get("name")
    }
    for child in root:
        if child.tag == "bsdf":
            reader.try_(lambda child=child: reader.named(child))
    for child in root:
        if child.tag == "shape":
            reader.shape(child)
        elif child.tag not in ("bsdf", "default", *SKIPPED):
            reader.faults.append(
                f"{path}: <{child.tag}> is not read; Mitsuba can write it out flat"
            )
    if not reader.parts and not reader.faults:
        reader.faults.append(f"{path}: a scene without shapes")
    if reader.faults:
        raise SceneError(reader.faults)
    used = {part.material for part in reader.parts}
    materials = {name: m for name, m in reader.materials.items() if name in used}
    return Imported(tuple(reader.parts), materials, tuple(reader.warnings), str(path))


class _NoDoctype(ET.TreeBuilder):
    """A document type may declare entities that grow without end, or files to read: refused."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("it declares a document type; a scene needs none")


def _root(path: Path) -> ET.Element:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SceneError([f"{path}: larger than {MAX_BYTES} bytes"])
        root = ET.fromstring(path.read_bytes(), ET.XMLParser(target=_NoDoctype()))
    except (ET.ParseError, ValueError, LookupError) as error:
        raise SceneError([f"{path}: not XML that can be read: {error}"]) from error
    except OSError as error:
        raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
    if root.tag != "scene":
        raise SceneError([f"{path}: <{root.tag}> at the top; expected a Mitsuba <scene>"])
    return root


@dataclass
class _Reader:
    path: Path
    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    materials: dict[str, Material] = field(default_factory=dict)
    defaults: dict[str, str] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)  # materials at fault, each told once

    def try_(self, step: Any) -> Any:
        try:
            return step()
        except SceneError as error:
            self.faults += error.faults
        except ValueError as error:
            self.faults.append(f"{self.path}: {error}")
        return None

    def value(self, element: ET.Element, name: str = "value") -> str:
        """An attribute, ``$name`` replaced by the scene's default."""
        given = element.get(name, "")
        return self.defaults.get(given[1:], given) if given.startswith("$") else given

    def number(self, element: ET.Element, name: str, fallback: float) -> float:
        found = element.find(f"float[@name='{name}']")
        if found is None:
            found = element.find(f"integer[@name='{name}']")
        value = fallback if found is None else float(self.value(found))
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}; expected a finite number")
        return value

    def text(self, element: ET.Element, name: str) -> str | None:
        found = element.find(f"string[@name='{name}']")
        return None if found is None else self.value(found)

    # materials

    def named(self, bsdf: ET.Element) -> str | None:
        """The name of a material, which is now known; None for one at fault, told before."""
        name = bsdf.get("id") or bsdf.get("name") or f"material_{len(self.materials)}"
        if name in self.materials or name in self.failed:
            return name if name in self.materials else None
        try:
            self.materials[name] = self.material(bsdf, name)
        except (SceneError, ValueError) as error:
            self.failed.add(name)
            raise ValueError(f"material {name!r}: {error}") from error
        return name

    def material(self, bsdf: ET.Element, name: str) -> Material:
        kind, plain = bsdf.get("type", ""), name.removeprefix("mat-")
        thickness = self.number(bsdf, "thickness", THICKNESS)
        rough = self.number(bsdf, "scattering_coefficient", 0.0)
        options: dict[str, Any] = {"thickness": thickness}
        if rough > 0:
            options |= {
                "scattering": rough,
                "cross_share": self.number(bsdf, "xpd_coefficient", 0.0),
            }
        if kind == "itu-radio-material" or plain.startswith(("itu_", "itu-")):
            itu = self.text(bsdf, "type") or (plain[4:] if plain.startswith("itu") else "")
            return itu_material(itu, **options)
        if kind == "radio-material":
            eps_r = self.number(bsdf, "relative_permittivity", 1.0)
            sigma = self.number(bsdf, "conductivity", 0.0)
            return Material("slab", eps_r=eps_r, sigma=sigma, **options)
        raise ValueError(
            f"a {kind or 'bsdf without a type'}, which says nothing of radio waves; name it "
            "itu_concrete or the like, or make it an itu-radio-material"
        )

    # shapes

    def shape(self, element: ET.Element, depth: int = 0) -> None:
        if len(self.parts) > MAX_PARTS or depth > MAX_DEPTH:
            self.faults.append(f"{self.path}: more than {MAX_PARTS} shapes, or {MAX_DEPTH} levels")
            return
        kind = element.get("type", "")
        if kind == "merge":
            for child in element.findall("shape"):
                self.shape(child, depth + 1)
            return
        name = (
            element.get("id") or element.get("name") or f"{kind}_{len(self.parts)}"
        ).removeprefix("mesh-")
        try:
            material = self._material_of(element, name)
            if material is not None:
                self.parts += self._parts(element, kind, name, material)
        except SceneError as error:
            self.faults += error.faults
        except ValueError as error:
            self.faults.append(f"{self.path}: shape {name!r}: {error}")

    def _material_of(self, element: ET.Element, name: str) -> str | None:
        own = element.find("bsdf")
        if own is not None:
            return self.named(own)
        given = [self.value(r, "id") for r in element.findall("ref")]
        known = [g for g in given if g in self.materials]
        if not known and not set(given) & self.failed:
            raise ValueError(f"refers to {given or 'no material'}; none is a material of the scene")
        return known[0] if known else None

    def _parts(self, element: ET.Element, kind: str, name: str, material: str) -> list[Part]:
        place = transform_of(element.find("transform"), self.value)
        if kind == "sphere":
            centre, radius = primitives.ball(element, self.number, place)
            empty = np.zeros((0, 3))
            return [Part(name, empty, empty.astype(int), material, False, (centre, radius))]
        vertices, triangles = self._drawn(element, kind)
        vertices = vertices @ place[:3, :3].T + place[:3, 3]
        if not len(triangles):
            self.warnings.append(f"{name}: no triangles, left out")
            return []
        return divided(Part(name, vertices, triangles, material))

    def _drawn(self, element: ET.Element, kind: str) -> tuple[ndarray, ndarray]:
        if kind in ("ply", "obj"):
            given = self.text(element, "filename")
            if not given:
                raise ValueError("names no file")
            file = self.path.parent / given
            if why := files.outside(str(file), [self.path.parent]):
                raise ValueError(f"{given!r} {why.split(';')[0]}")
            if kind == "ply":
                return read_ply(file)
            groups = read_obj(file)
            first = np.cumsum([0, *(len(g.vertices) for g in groups[:-1])])
            faces = [g.triangles + a for g, a in zip(groups, first, strict=True)]
            return np.concatenate([g.vertices for g in groups]), np.concatenate(faces)
        if kind == "cylinder":
            return primitives.cylinder(element, self.number)
        if kind not in DRAWN:
            known = ", ".join(("ply", "obj", "sphere", "cylinder", *DRAWN))
            raise ValueError(f"a {kind or 'shape without a type'}; read are {known}")
        return DRAWN[kind]()
