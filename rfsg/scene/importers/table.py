"""Material tables: which mesh or material name is what to a wave. TOML, first match counts."""

import fnmatch
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rfsg.objects.physics.media import MATERIALS
from rfsg.scene.errors import SceneError
from rfsg.scene.materials import Material

MAX_BYTES = 2**20
EXAMPLE = '"wall*" = { itu = "concrete", thickness = 0.2 }'
_KEYS = {"epsR": "eps_r", "alphaR": "alpha_r", "alphaI": "alpha_i", "forwardShare": "forward_share",
         "crossShare": "cross_share"}  # fmt: skip
_FIELDS = tuple(f.name for f in fields(Material))


@dataclass(frozen=True)
class Row:
    """What names of one pattern are: a material, whether a sheet (None: where it is not closed)."""

    pattern: str
    material: Material
    sheet: bool | None = None


@dataclass(frozen=True)
class Table:
    """The rows of a table in order, and what it says of the meshes' unit [m] and upward axis."""

    rows: tuple[Row, ...]
    metre: float | None = None
    up: str | None = None

    def row(self, *names: str) -> Row | None:
        """The first row whose pattern one of the names has, whatever the case."""
        for row in self.rows:
            if any(n and fnmatch.fnmatchcase(n.lower(), row.pattern.lower()) for n in names):
                return row
        return None


def read_table(path: Path) -> Table:
    """A material table. Raises SceneError listing all that is amiss, by row."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SceneError([f"{path}: larger than {MAX_BYTES} bytes"])
        said = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError([f"{path}: not TOML that can be read: {error}"]) from error
    faults, rows = [], []
    for key in sorted(set(said) - {"materials", "metre", "up"}):
        faults.append(f"{path}: {key!r} is unknown; expected [materials], metre and up")
    entries = said.get("materials", {})
    if not isinstance(entries, dict) or not entries:
        raise SceneError([*faults, f"{path}: no [materials]; expected rows such as {EXAMPLE}"])
    for pattern, entry in entries.items():
        try:
            rows.append(row_of(pattern, entry))
        except (ValueError, TypeError) as error:
            faults.append(f"{path}: materials.{pattern}: {error}")
    metre, up = said.get("metre"), said.get("up")
    if metre is not None and not (isinstance(metre, (int, float)) and 0 < metre < 1e6):
        faults.append(f"{path}: metre is {metre!r}; expected metres per unit, a number > 0")
    if up not in (None, "y", "z"):
        faults.append(f'{path}: up is {up!r}; expected "y" or "z"')
    if faults:
        raise SceneError(faults)
    return Table(tuple(rows), metre, up)


def row_of(pattern: str, entry: Any) -> Row:
    """One row of a table. Raises ValueError for what makes no material."""
    if not isinstance(entry, dict):
        raise ValueError(f"{entry!r}; expected a row such as {EXAMPLE}")
    said: dict[str, Any] = {_KEYS.get(str(key), str(key)): value for key, value in entry.items()}
    sheet = said.pop("sheet", None)
    if not isinstance(sheet, bool | None):
        raise ValueError(f"sheet is {sheet!r}; expected true or false")
    unknown = sorted(set(said) - set(_FIELDS))
    if unknown:
        raise ValueError(f"{unknown[0]!r} is unknown; expected {', '.join((*_FIELDS, 'sheet'))}")
    if "itu" in said and "model" not in said:
        return Row(pattern, itu_material(said.pop("itu"), **said), sheet)
    said.setdefault("model", "slab")
    material = Material(**said)
    refuse_faulty(material)
    return Row(pattern, material, sheet)


def itu_material(itu: str, **options: Any) -> Material:
    """A wall of an ITU-R P.2040 material; metal, through which nothing comes, is a conductor.

    Raises ValueError for an unknown name, and for what contradicts itself."""
    itu = str(itu).replace("-", "_").lower()
    if itu not in MATERIALS:
        raise ValueError(f"ITU material {itu!r}; expected one of {', '.join(MATERIALS)}")
    if itu == "metal":
        options = {k: v for k, v in options.items() if k not in ("thickness", "extrapolate")}
        return Material("conductor", **options)
    material = Material("slab", itu=itu, **options)
    refuse_faulty(material)
    return material


def refuse_faulty(material: Material) -> None:
    """ValueError for a material that contradicts itself or that no surface can be made of."""
    faults = material.faults()
    if material.model == "slab" and material.thickness is None:
        faults.append("a slab needs a thickness [m]")
    if faults:
        raise ValueError("; ".join(faults))
    material.surface()
