"""Two-dimensional floor plans: walls along lines, rooms as polygons, with doors and windows.

GeoJSON (RFC 7946) in local metres, or plain JSON with the same features; docs/import.md has the
attributes. Every wall becomes a closed prism on its own, so that nothing needs to be united: what
overlaps in a corner is crossed as two walls over a hand's breadth.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from rfsg.objects.shapes.mesh import prism_of
from rfsg.scene.errors import SceneError
from rfsg.scene.importers.openings import Opening, openings_of, panels
from rfsg.scene.importers.parts import Imported, Part
from rfsg.scene.importers.table import row_of
from rfsg.scene.materials import Material

MAX_BYTES = 64 * 2**20
MAX_FEATURES = 20_000
MAX_EXTENT = 1e5  # [m] beyond this coordinates are degrees, or another unit
KINDS = ("wall", "room", "floor", "ceiling", "block")
LEAST = 1e-3  # [m] of a wall's length, thickness and height
Point = tuple[float, float]


class _Amiss(ValueError):
    """What is wrong with one feature."""


def read_floor_plan(path: Path) -> Imported:
    """A plan's walls, rooms, floors, ceilings and blocks.

    Raises SceneError listing every feature at fault by its name."""
    said = _loaded(path)
    faults: list[str] = []
    materials = _materials(path, said.get("materials", {}), faults)
    defaults = said.get("defaults", {})
    if not isinstance(defaults, dict):
        faults.append(f"{path}: defaults are {defaults!r}; expected an object")
        defaults = {}
    features = said.get("features", [])
    if not isinstance(features, list) or not features:
        raise SceneError([*faults, f"{path}: no features; expected a list of walls and rooms"])
    if len(features) > MAX_FEATURES:
        raise SceneError(
            [*faults, f"{path}: {len(features)} features; expected {MAX_FEATURES} at most"]
        )
    parts: list[Part] = []
    for number, feature in enumerate(features):
        name = f"feature_{number}"
        try:
            found = _Feature(feature, defaults, materials, name)
            name = found.name
            parts += found.parts()
        except (_Amiss, ValueError) as error:
            faults.append(f"{path}: {name}: {error}")
    if faults:
        raise SceneError(faults)
    used = {part.material for part in parts}
    chosen = {name: m for name, m in materials.items() if name in used}
    return Imported(tuple(parts), chosen, (), str(path))


def _loaded(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SceneError([f"{path}: larger than {MAX_BYTES} bytes"])
        said = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
    except (ValueError, RecursionError) as error:
        raise SceneError([f"{path}: not JSON that can be read: {error}"]) from error
    if not isinstance(said, dict):
        raise SceneError([f"{path}: a {type(said).__name__} at the top; expected an object"])
    return said


def _materials(path: Path, said: Any, faults: list[str]) -> dict[str, Material]:
    if not isinstance(said, dict) or not said:
        faults.append(f'{path}: no materials; expected "materials": {{name: {{"itu": ...}}}}')
        return {}
    found = {}
    for name, entry in said.items():
        try:
            # a wall is as thick as it is drawn
            found[name] = row_of(name, {"thickness": LEAST, **entry}).material
        except (ValueError, TypeError) as error:
            faults.append(f"{path}: materials.{name}: {error}")
    return found


class _Feature:
    """One feature: GeoJSON's geometry and properties, or both in one object."""

    def __init__(
        self,
        feature: Any,
        defaults: dict[str, Any],
        materials: dict[str, Material],
        fallback: str,
    ):
        if not isinstance(feature, dict):
            raise _Amiss(f"{feature!r:.60}; expected an object")
        own = feature.get("properties", feature)
        geometry = feature.get("geometry", feature)
        if not isinstance(own, dict) or not isinstance(geometry, dict):
            raise _Amiss("properties and geometry must be objects")
        self.said = defaults | own
        self.name = str(own.get("name") or feature.get("id") or fallback)
        self.materials = materials
        self.lines, self.closed = self._lines(geometry)

    def parts(self) -> list[Part]:
        kind = self.said.get("kind", "room" if self.closed else "wall")
        if kind not in KINDS:
            raise _Amiss(f"{self.name}: kind is {kind!r}; expected one of {', '.join(KINDS)}")
        if kind in ("wall", "room"):
            return self._walls()
        if not self.closed:
            raise _Amiss(f"{self.name}: a {kind} needs a polygon")
        height = self._number("height", 3.0)
        base = self._number("base", 0.0, least=-math.inf)
        thickness = self._number("thickness", 0.2)
        low, high = {
            "floor": (base - thickness, base),
            "ceiling": (base + height, base + height + thickness),
            "block": (base, base + height),
        }[kind]
        if len(self.lines) > 1:
            raise _Amiss(f"{self.name}: a {kind} with a hole; draw it as several")
        return [self._prism(self.name, self.lines[0], low, high, self._material("material"))]

    def _walls(self) -> list[Part]:
        """A prism between the openings of every straight piece, and one above and below each."""
        height = self._number("height", 3.0)
        base = self._number("base", 0.0, least=-math.inf)
        thickness, material = self._number("thickness", 0.2), self._material("material")
        pieces = [
            (line[i], line[(i + 1) % len(line)])
            for line in self.lines
            for i in range(len(line) - (not self.closed))
        ]
        openings = openings_of(self.said.get("openings", []), len(pieces))
        made = []
        for number, (start, end) in enumerate(pieces):
            length = math.dist(start, end)
            if length < LEAST:
                raise _Amiss(f"{self.name}: piece {number} from {start} is {length:g} m long")
            mine = [o for o in openings if o.piece == number]
            for k, panel in enumerate(panels(length, height, mine)):
                own = self._opening_material(panel.opening) if panel.opening else material
                if own is None:
                    continue
                thick = panel.opening.thickness if panel.opening else None
                outline = _band(start, end, panel.start, panel.end, thick or thickness)
                name = f"{self.name}_{number}" + (f"_{k}" if k else "")
                low, high = base + panel.low, base + panel.high
                made.append(self._prism(name, outline, low, high, own))
        return made

    def _opening_material(self, opening: Opening) -> str | None:
        """The material that fills an opening; None leaves it open."""
        if opening.material is None:
            return None
        if opening.material not in self.materials:
            raise _Amiss(f"{self.name}: an opening of {opening.material!r}; {self._known()}")
        return opening.material

    def _prism(
        self, name: str, outline: list[Point], low: float, high: float, material: str
    ) -> Part:
        vertices, triangles = prism_of(outline, low, high)
        if self.materials[material].model == "slab":
            material = self._as_thick(material, outline, high - low)
        return Part(name, vertices, triangles, material, sheet=False)

    def _as_thick(self, material: str, outline: list[Point], height: float) -> str:
        """The material for a wall of the prism's thickness, made where it is not there yet."""
        corner = np.array(outline)
        sides = np.linalg.norm(corner - np.roll(corner, 1, 0), axis=1)
        thick = round(float(min(sides.min(), height)), 6)
        name = f"{material}_{thick * 1e3:g}mm"
        if name not in self.materials:
            from dataclasses import replace

            self.materials[name] = replace(self.materials[material], thickness=thick)
        return name

    # what is said

    def _material(self, key: str) -> str:
        name = self.said.get(key)
        if name not in self.materials:
            raise _Amiss(f"{self.name}: {key} is {name!r}; {self._known()}")
        return str(name)

    def _known(self) -> str:
        return f"expected one of {', '.join(self.materials) or 'no materials at all'}"

    def _number(self, key: str, fallback: float, least: float = LEAST) -> float:
        value = self.said.get(key, fallback)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not math.isfinite(value) or value < least or abs(value) > MAX_EXTENT:
            limit = f" of at least {least:g}" if math.isfinite(least) else ""
            raise _Amiss(f"{self.name}: {key} is {value!r}; expected a number{limit} [m]")
        return float(value)

    def _lines(self, geometry: dict[str, Any]) -> tuple[list[list[Point]], bool]:
        kind, given = geometry.get("type"), geometry.get("coordinates")
        for plain, name in (("polygon", "Polygon"), ("line", "LineString")):
            if plain in geometry:
                kind, given = name, geometry[plain]
                given = [given] if name == "Polygon" else given
        if kind == "LineString":
            return [self._points(given, 2)], False
        if kind == "MultiLineString" and isinstance(given, list):
            return [self._points(line, 2) for line in given], False
        if kind == "Polygon" and isinstance(given, list):
            return [_opened(self._points(ring, 3)) for ring in given], True
        raise _Amiss(
            f"{self.name}: geometry {kind!r}; expected a LineString, MultiLineString or Polygon"
        )

    def _points(self, given: Any, least: int) -> list[Point]:
        try:
            points = [(float(p[0]), float(p[1])) for p in given]
        except (TypeError, ValueError, IndexError, KeyError) as error:
            raise _Amiss(f"{self.name}: coordinates that are no list of x, y") from error
        if len(points) < least:
            raise _Amiss(f"{self.name}: {len(points)} points; expected {least} or more")
        if not np.isfinite(points).all() or np.abs(points).max() > MAX_EXTENT:
            raise _Amiss(f"{self.name}: coordinates beyond {MAX_EXTENT:g} m, or not finite")
        return points


def _opened(ring: list[Point]) -> list[Point]:
    """A ring without its first point at the end again, counter-clockwise."""
    ring = ring[:-1] if ring[0] == ring[-1] else ring
    corner = np.array(ring)
    following = np.roll(corner, -1, 0)
    area = float((corner[:, 0] * following[:, 1] - corner[:, 1] * following[:, 0]).sum())
    return ring if area > 0 else ring[::-1]


def _band(start: Point, end: Point, near: float, far: float, thickness: float) -> list[Point]:
    """The outline of a straight stretch of wall, from ``near`` to ``far`` [m] along its middle line."""
    a, b = np.array(start), np.array(end)
    along: ndarray = (b - a) / np.linalg.norm(b - a)
    across = 0.5 * thickness * np.array([-along[1], along[0]])
    p, q = a + near * along, a + far * along
    corners = (p - across, q - across, q + across, p + across)
    return [(float(x), float(y)) for x, y in corners]
