"""Doors and windows: what a wall with openings is made of."""

import math
from dataclasses import dataclass
from typing import Any

WIDTH, TALL = 0.9, 2.1  # [m] of an opening that says nothing else: a door
EDGE = 1e-6  # [m]
KEYS = ("piece", "at", "width", "sill", "height", "material", "thickness", "name", "kind")


@dataclass(frozen=True)
class Opening:
    """A rectangle in one straight piece of a wall: from ``start`` to ``end`` along it, ``low`` to
    ``high`` above its base [m]; filled with a material, or open."""

    piece: int
    start: float
    end: float
    low: float
    high: float
    material: str | None
    thickness: float | None


@dataclass(frozen=True)
class Panel:
    """A rectangle of wall, or of what fills an opening, in the same coordinates."""

    start: float
    end: float
    low: float
    high: float
    opening: Opening | None = None


def openings_of(said: Any, pieces: int) -> list[Opening]:
    """The openings of a wall of so many pieces. Raises ValueError naming the one at fault."""
    if not isinstance(said, list):
        raise ValueError(f"openings are {said!r:.60}; expected a list")
    return [_opening(entry, number, pieces) for number, entry in enumerate(said)]


def _opening(entry: Any, number: int, pieces: int) -> Opening:
    where = f"opening {number}"
    if not isinstance(entry, dict) or (unknown := sorted(set(entry) - set(KEYS))):
        amiss = unknown[0] if isinstance(entry, dict) else f"{entry!r:.40}"
        raise ValueError(f"{where}: {amiss!r} is unknown; expected {', '.join(KEYS)}")
    piece = entry.get("piece", 0)
    if not isinstance(piece, int) or not 0 <= piece < pieces:
        raise ValueError(f"{where}: piece is {piece!r}; the wall has pieces 0 to {pieces - 1}")
    if "at" not in entry:
        raise ValueError(f"{where}: says no at, the metres from the piece's start to its middle")
    at, width = (_length(entry, key, where, WIDTH) for key in ("at", "width"))
    sill, tall = _length(entry, "sill", where, 0.0), _length(entry, "height", where, TALL)
    thickness = _length(entry, "thickness", where, 0.0) or None
    if not (width > EDGE and tall > EDGE):
        raise ValueError(f"{where}: {width:g} m wide and {tall:g} m high; expected more")
    material = entry.get("material")
    if not isinstance(material, str | None):
        raise ValueError(f"{where}: material is {material!r}; expected a name")
    start = at - 0.5 * width
    return Opening(piece, start, start + width, sill, sill + tall, material, thickness)


def _length(entry: dict[str, Any], key: str, where: str, fallback: float) -> float:
    value = entry.get(key, fallback)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < 0:
        raise ValueError(f"{where}: {key} is {value!r}; expected a number >= 0 [m]")
    return float(value)


def panels(length: float, height: float, openings: list[Opening]) -> list[Panel]:
    """What a piece of wall is made of. Raises ValueError for openings that leave it or overlap."""
    openings = sorted(openings, key=lambda o: o.start)
    made, reached = [], 0.0
    for opening in openings:
        within = opening.start >= -EDGE and opening.end <= length + EDGE
        if not within or opening.high > height + EDGE:
            raise ValueError(
                f"an opening from {opening.start:g} to {opening.end:g} m, {opening.high:g} m high; "
                f"its piece of wall is {length:g} m long and {height:g} m high"
            )
        if opening.start < reached - EDGE:
            raise ValueError(f"two openings overlap at {opening.start:g} m along their piece")
        start, end = max(opening.start, reached), min(opening.end, length)
        made.append(Panel(reached, start, 0.0, height))
        made.append(Panel(start, end, 0.0, opening.low))
        made.append(Panel(start, end, opening.low, min(opening.high, height), opening))
        made.append(Panel(start, end, opening.high, height))
        reached = end
    made.append(Panel(reached, length, 0.0, height))
    return [p for p in made if p.end - p.start > EDGE and p.high - p.low > EDGE]
