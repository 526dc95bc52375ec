"""From a file of another program to a scene of rfsg, whatever its format."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rfsg.scene.errors import SceneError
from rfsg.scene.importers.floorplan import read_floor_plan
from rfsg.scene.importers.meshes import MESHES, read_meshes
from rfsg.scene.importers.mitsuba import read_mitsuba
from rfsg.scene.importers.parts import Imported
from rfsg.scene.radios import Radio

PLANS = (".json", ".geojson")
STAGES = (".usda", ".usdc", ".usd", ".usdz")
Place = Sequence[float]


@dataclass(frozen=True)
class ImportReport:
    """What was written where: objects, triangles and materials, and what to keep in mind."""

    path: Path
    objects: int
    triangles: int
    materials: tuple[str, ...]
    warnings: tuple[str, ...]


def import_scene(
    source: str | Path,
    out: str | Path,
    *,
    materials: str | Path | None = None,
    metre: float | None = None,
    up: str | None = None,
    tx: Sequence[Place] = (),
    rx: Sequence[Place] = (),
    frequency: float | None = None,
    overwrite: bool = False,
    untrusted: bool = False,
) -> ImportReport:
    """Read another program's scene and write it as USD (.usda, or .usdc for a large one).

    source: Mitsuba XML as Sionna RT uses it; obj, ply, glb, gltf or stl with a ``materials`` table; a
    floor plan as GeoJSON or JSON; a USD scene with Aerial's or SimReady's materials, over which a
    layer is written. metre, up: metres per unit and "y" or "z", asked for where the format does not
    say. tx, rx: positions [m] of radios to add. frequency: [Hz], written as the scene's own, and what
    a permittivity by formula is evaluated at. untrusted: read a stranger's file in a limited child
    process (``rfsg.scene.sandbox``). docs/import.md has the formats.

    Raises SceneError listing every fault; nothing is written then.
    """
    source, out = Path(source), Path(out)
    if not source.is_file():
        raise SceneError([f"{source}: no such file"])
    radios = _radios("Tx", tx, frequency), _radios("Rx", rx, None)
    ending = source.suffix.lower()
    if ending in STAGES:
        if untrusted:
            raise SceneError(
                [f"{source}: a USD scene is imported as a layer over it, which this process would have "
                 "to open; untrusted imports are of other formats"]
            )  # fmt: skip
        return _over_stage(source, out, radios, frequency, overwrite)
    from rfsg.scene import sandbox
    from rfsg.scene.usd.importing import write_imported

    find = sandbox.imported if untrusted else imported_file
    imported = find(source, materials, metre, up)
    write_imported(imported, out, *radios, frequency, overwrite)
    names = tuple(imported.materials)
    return ImportReport(out, len(imported.parts), imported.triangles, names, imported.warnings)


def imported_file(
    source: Path, materials: str | Path | None, metre: float | None, up: str | None
) -> Imported:
    """What is in a file that is no USD scene, by its ending. Raises SceneError."""
    ending = source.suffix.lower()
    if ending in MESHES:
        table = None if materials is None else Path(materials)
        return read_meshes(source, table, metre, up)
    if given := [n for n, v in (("materials", materials), ("metre", metre), ("up", up)) if v]:
        raise SceneError([f"{source}: says its own materials, units and axes; given {given[0]}"])
    if ending == ".xml":
        return read_mitsuba(source)
    if ending in PLANS:
        return read_floor_plan(source)
    known = ", ".join((".xml", *MESHES, *PLANS, *STAGES))
    raise SceneError([f"{source}: not a format that is read; expected {known}"])


def _over_stage(
    source: Path,
    out: Path,
    radios: tuple[list[Radio], list[Radio]],
    frequency: float | None,
    overwrite: bool,
) -> ImportReport:
    from rfsg.scene.usd.foreign import write_over

    found = write_over(source, out, *radios, frequency, overwrite)
    return ImportReport(out, found.objects, found.triangles, found.materials, found.warnings)


def _radios(name: str, places: Sequence[Place], frequency: float | None) -> list[Radio]:
    made = []
    for number, place in enumerate(places, 1):
        x = tuple(float(v) for v in place)
        if len(x) != 3 or not all(map(math.isfinite, x)):
            raise SceneError([f"{name}{number}: expected x, y, z in metres, got {place!r}"])
        made.append(Radio.at(f"/World/{name}{number}", *x, frequency=frequency))
    return made
