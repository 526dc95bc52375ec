"""Wavefront OBJ files: corners and polygons, by object and material. Everything else is skipped."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.objects.shapes.polygons import triangles_of
from rfsg.scene.errors import SceneError

MAX_BYTES = 512 * 2**20


@dataclass(frozen=True)
class Group:
    """The triangles of one object and material of a file, in the file's units and axes."""

    name: str
    material: str
    vertices: Float[ndarray, "v 3"]
    triangles: Int[ndarray, "t 3"]


def read_obj(path: Path) -> list[Group]:
    """Every object and material that has faces. Files that it names (mtllib) are not opened.

    Raises SceneError, with the line, for a file that is too large or cannot be read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SceneError([f"{path}: larger than {MAX_BYTES} bytes"])
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
    points: list[list[float]] = []
    faces: dict[tuple[str, str], list[list[int]]] = {}
    name, material = path.stem, ""
    for number, line in enumerate(lines, 1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                x, y, z = words[1:4]
                points.append([float(x), float(y), float(z)])
            elif words[:1] == ["f"]:
                polygon = [_index(w, len(points)) for w in words[1:]]
                faces.setdefault((name, material), []).append(polygon)
            elif words[:1] in (["o"], ["g"]):
                name = " ".join(words[1:]) or path.stem
            elif words[:1] == ["usemtl"]:
                material = " ".join(words[1:])
        except ValueError as error:
            raise SceneError([f"{path}: line {number}: {error}"]) from error
    place = np.array(points, dtype=np.float64) if points else np.zeros((0, 3))
    if not np.isfinite(place).all():
        raise SceneError([f"{path}: corners that are not finite"])
    if not faces:
        raise SceneError([f"{path}: holds no faces"])
    return [_group(*key, place, polygons) for key, polygons in faces.items()]


def _index(word: str, count: int) -> int:
    """The corner that "7", "7/1/3" or "-1" names, from 0."""
    number = int(word.split("/")[0])
    index = number - 1 if number > 0 else count + number
    if not 0 <= index < count or number == 0:
        raise ValueError(f"a face names corner {word}; there are {count} so far")
    return index


def _group(name: str, material: str, place: ndarray, polygons: list[list[int]]) -> Group:
    polygons = [p for p in polygons if len(p) >= 3]
    index = np.array([i for p in polygons for i in p], dtype=np.int64)
    used, index = np.unique(index, return_inverse=True)
    count = np.array([len(p) for p in polygons], dtype=np.int64)
    triangles = triangles_of(place[used], count, index.reshape(-1))
    return Group(name, material, place[used], triangles)
