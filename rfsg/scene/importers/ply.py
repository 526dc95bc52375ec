"""PLY files (Turk 1994): vertices and polygons, text or binary. Everything else in them is skipped."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.objects.shapes.polygons import triangles_of
from rfsg.scene.errors import SceneError

MAX_BYTES = 512 * 2**20
MAX_HEADER = 64 * 1024
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
INDICES = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    """One table of the file: its rows, and columns (name, type) or (name, count type, item type)."""

    name: str
    count: int
    columns: list[tuple[str, ...]]


def read_ply(path: Path) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"]]:
    """Vertices and triangles; polygons are triangulated. Raises SceneError for a file that is too
    large, cut short, or none."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SceneError([f"{path}: larger than {MAX_BYTES} bytes"])
        data = path.read_bytes()
    except OSError as error:
        raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
    try:
        return _parsed(data)
    except (ValueError, IndexError, KeyError, UnicodeDecodeError, OverflowError) as error:
        raise SceneError([f"{path}: not a PLY file that can be read: {error}"]) from error


def _parsed(data: bytes) -> tuple[ndarray, ndarray]:
    order, elements, body = _header(data)
    reader = _Text(body) if order == "ascii" else _Binary(body, _ORDERS[order])
    points, count, index = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64)
    for element in elements:
        if element.name == "vertex":
            table = reader.table(element)
            points = np.stack([np.asarray(table[axis], np.float64) for axis in "xyz"], 1)
        elif element.name == "face":
            count, index = reader.lists(element)
        else:
            reader.skip(element)
    if not np.isfinite(points).all():
        raise ValueError("vertices that are not finite numbers")
    if len(index) and not (0 <= index.min() and index.max() < len(points)):
        raise ValueError(f"faces name vertices outside of 0 to {len(points) - 1}")
    whole = np.repeat(count >= 3, count)
    return points, triangles_of(points, count[count >= 3], index[whole])


def _header(data: bytes) -> tuple[str, list[_Element], bytes]:
    end = data.find(b"end_header", 0, MAX_HEADER)
    line_end = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        raise ValueError("it has no PLY header")
    order, elements = "", []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            order = words[1]
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), []))
            if elements[-1].count < 0 or elements[-1].count > len(data):
                raise ValueError(f"it declares {words[2]} rows of {words[1]}, in {len(data)} bytes")
        elif words[:1] == ["property"]:
            kinds = words[2:4] if words[1] == "list" else words[1:2]
            elements[-1].columns.append((words[-1], *(_TYPES[k] for k in kinds)))
    if order not in _ORDERS:
        raise ValueError(f"format {order!r}; expected one of {', '.join(_ORDERS)}")
    return order, elements, data[line_end + 1 :]


class _Binary:
    def __init__(self, body: bytes, order: str):
        self.body, self.order, self.at = body, order, 0

    def _rows(self, kind: np.dtype, count: int) -> ndarray:
        size = kind.itemsize * count
        if self.at + size > len(self.body):
            raise ValueError("it ends before its last row")
        rows = np.frombuffer(self.body, kind, count, self.at)
        self.at += size
        return rows

    def table(self, element: _Element) -> ndarray:
        kinds = [(name, self.order + kind[0]) for name, *kind in element.columns if len(kind) == 1]
        if len(kinds) < len(element.columns):
            raise ValueError(f"a list among the numbers of {element.name}")
        return self._rows(np.dtype(kinds), element.count)

    def lists(self, element: _Element) -> tuple[ndarray, ndarray]:
        """(corners of each face, all corners): at once where all faces have as many as the first."""
        start, name = self.at, _indices(element)
        sizes = self._first_sizes(element)
        kind = self._row(element, sizes)
        if self.at + kind.itemsize * element.count <= len(self.body):
            rows = self._rows(kind, element.count)
            alike = all((rows[f"#{n}"] == size).all() for n, size in sizes.items())
            if alike:
                return (
                    np.full(element.count, sizes[name], np.int64),
                    rows[name].astype(np.int64).ravel(),
                )
        self.at = start
        count, index = [], []
        for _ in range(element.count):
            row = self._one(element)
            count.append(len(row[name]))
            index.append(row[name].astype(np.int64))
        return np.array(count, np.int64), np.concatenate(index) if index else np.zeros(0, np.int64)

    def skip(self, element: _Element) -> None:
        if all(len(column) == 2 for column in element.columns):
            self.table(element)
            return
        for _ in range(element.count):
            self._one(element)

    def _first_sizes(self, element: _Element) -> dict[str, int]:
        if not element.count:
            return {c[0]: 0 for c in element.columns if len(c) == 3}
        start = self.at
        row = self._one(element)
        self.at = start
        return {c[0]: len(row[c[0]]) for c in element.columns if len(c) == 3}

    def _row(self, element: _Element, sizes: dict[str, int]) -> np.dtype:
        kinds: list[tuple] = []
        for name, *kind in element.columns:
            if len(kind) == 1:
                kinds.append((name, self.order + kind[0]))
            else:
                kinds.append((f"#{name}", self.order + kind[0]))
                kinds.append((name, self.order + kind[1], (sizes[name],)))
        return np.dtype(kinds)

    def _one(self, element: _Element) -> dict[str, ndarray]:
        row = {}
        for name, *kind in element.columns:
            count = 1
            if len(kind) == 2:
                count = int(self._rows(np.dtype(self.order + kind[0]), 1)[0])
            if count < 0:
                raise ValueError(f"a list of {count} items")
            row[name] = self._rows(np.dtype(self.order + kind[-1]), count)
        return row


class _Text:
    def __init__(self, body: bytes):
        self.words = body.decode("ascii").split()
        self.at = 0

    def _take(self, count: int) -> list[str]:
        words = self.words[self.at : self.at + count]
        if len(words) < count:
            raise ValueError("it ends before its last row")
        self.at += count
        return words

    def table(self, element: _Element) -> dict[str, ndarray]:
        if any(len(column) == 3 for column in element.columns):
            raise ValueError(f"a list among the numbers of {element.name}")
        width = len(element.columns)
        numbers = np.array(self._take(width * element.count), dtype=np.float64)
        rows = numbers.reshape(element.count, width)
        return {column[0]: rows[:, k] for k, column in enumerate(element.columns)}

    def lists(self, element: _Element) -> tuple[ndarray, ndarray]:
        name, count, index = _indices(element), [], []
        for _ in range(element.count):
            row = self._one(element)
            count.append(len(row[name]))
            index += row[name]
        return np.array(count, np.int64), np.array(index, dtype=np.float64).astype(np.int64)

    def skip(self, element: _Element) -> None:
        for _ in range(element.count):
            self._one(element)

    def _one(self, element: _Element) -> dict[str, list[str]]:
        row = {}
        for name, *kind in element.columns:
            count = float(self._take(1)[0]) if len(kind) == 2 else 1.0
            if not (count >= 0 and math.isfinite(count)):
                raise ValueError(f"a list of {count} items")
            row[name] = self._take(int(count))
        return row


def _indices(element: _Element) -> str:
    for name, *kind in element.columns:
        if name in INDICES and len(kind) == 2:
            return name
    raise ValueError(f"faces without {' or '.join(INDICES)}")
