"""Baked shapes, kept: in memory while a shape's parameters stay as they are, and on disk by key.

A file is never needed: where it is missing, spoiled or cannot be written, the shape is baked again.
"""

import json
import os
import warnings
from collections import OrderedDict
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.band import BLOCK, WAYS, Baked, Off, Surface

MOST_KEPT = 16
MAX_BYTES = 512 * 2**20  # of a file: ten times what a 2 m object takes at 5 mm
MAX_HEADER_BYTES = 2**16
ENDING = ".baked.safetensors"
BAKE_AFTER = 50_000  # rays that a question launches before baking its shapes pays

_NUMBERS = ("step", "margin", "slope", "lipschitz")
_OFF = tuple(field.name for field in fields(Off))
# name: (dtype, number of dimensions)
_TENSORS = {
    "zero.vertices": (torch.float32, 2),
    "zero.triangles": (torch.int32, 2),
    "gradient": (torch.float32, 2),
    "shell.vertices": (torch.float32, 2),
    "shell.triangles": (torch.int32, 2),
    "low": (torch.float32, 1),
    "block": (torch.int32, 3),
    "middle": (torch.float32, 3),
    "values": (torch.float32, 2),
    "error": (torch.float16, 2),
    "turn": (torch.float16, 2),
}


@dataclass
class _Kept:
    state: object
    baked: Baked | None = None
    refused: bool = False


_MEMORY: OrderedDict[int, _Kept] = OrderedDict()  # the one asked last stands last


def bake(shape: Shape, step: float | None = None) -> Baked:
    """``baked.bake``: marching cubes are imported when a shape is baked, not with the tracer."""
    from rfsg.objects.shapes import baked as baking

    return baking.bake(shape, step)


def baked(shape: Shape, folder: str | Path | None = None, step: float | None = None) -> Baked:
    """The shape, baked: from memory, from ``folder`` (that of the asset's weights), or anew.

    step: grid step [m]. A file that is not what its name says is ignored with a warning, and one is
    written where the folder allows it. Raises ValueError as ``bake`` does.
    """
    kept = _of(shape)
    if kept.baked is not None and step in (None, kept.baked.step):
        return kept.baked
    from rfsg.objects.shapes.baked import default_step, key_of  # brings scikit-image along

    key = key_of(shape, step or default_step(shape))
    path = Path(folder) / f"{key[:32]}{ENDING}" if folder else None
    found = _read(path, key) if path and path.is_file() else None
    if found is None:
        found = bake(shape, step)
        if path:
            _write(path, found)
    kept.baked = found
    return found


def baked_if_it_pays(shape: Shape, rays: int) -> Baked | None:
    """The shape, baked, for a question that launches so many ``rays`` that baking pays; else None.

    Only the question decides, not what was asked before: the same question has the same answer, to
    the bit. Only networks on the CPU are baked; one without a surface is not.
    """
    if rays < BAKE_AFTER or shape.kind != "neural" or shape.bounds().device.type != "cpu":
        return None
    kept = _of(shape)
    if kept.baked is None and not kept.refused:
        try:
            learning = any(p.requires_grad for p in getattr(shape, "parameters", list)())
            kept.baked = baked(shape, None if learning else getattr(shape, "folder", None))
        except ValueError:  # no surface on its grid: the plain march looks closer
            kept.refused = True
    return kept.baked


def offs_of(shape: Shape) -> dict[str, Off] | None:
    """What each way to meet a baked shape errs by, if it is kept, in memory or on disk; else None."""
    kept = _MEMORY.get(id(shape))
    if kept is not None and kept.state == state_of(shape) and kept.baked is not None:
        return kept.baked.offs
    folder = getattr(shape, "folder", None)
    if folder is None or not any(Path(folder).glob(f"*{ENDING}")):
        return None
    from rfsg.objects.shapes.baked import default_step, key_of

    key = key_of(shape, default_step(shape))
    try:
        with (Path(folder) / f"{key[:32]}{ENDING}").open("rb") as file:
            head = _head(file.read(8 + MAX_HEADER_BYTES))
        return _offs(head["offs"]) if head.get("key") == key else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None  # missing or spoiled: who reads all of it says so


def state_of(shape: Shape) -> tuple:
    """Changes when a parameter of the shape does. It holds the shape, so that its id is no other's."""
    parameters = list(getattr(shape, "parameters", list)())
    return (shape, tuple((p.data_ptr(), p._version) for p in parameters))


def _of(shape: Shape) -> _Kept:
    state = state_of(shape)
    kept = _MEMORY.get(id(shape))
    if kept is None or kept.state != state:
        kept = _MEMORY[id(shape)] = _Kept(state)
    _MEMORY.move_to_end(id(shape))
    if len(_MEMORY) > MOST_KEPT:
        _MEMORY.popitem(last=False)
    return kept


def _write(path: Path, found: Baked) -> None:
    head = {"key": found.key} | {name: getattr(found, name) for name in _NUMBERS}
    head |= {"offs": {way: asdict(off) for way, off in found.offs.items()}}
    tensors = {name: tensor.contiguous().clone() for name, tensor in tensors_of(found).items()}
    data = save(tensors, metadata={"rfsg-baked": json.dumps(head, sort_keys=True)})
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.write_bytes(data)
        os.replace(beside, path)
    except OSError:  # a folder that may only be read, or a full disk: it is baked again next time
        pass
    finally:
        try:
            beside.unlink(missing_ok=True)
        except OSError:
            pass


def tensors_of(found: Baked) -> dict[str, Tensor]:
    """What a file of it holds, by name."""
    return {name: _part(found, name) for name in _TENSORS}


def _part(found: Baked, name: str) -> Tensor:
    value: Any = found
    for word in name.split("."):
        value = getattr(value, word)
    return value


def _read(path: Path, key: str) -> Baked | None:
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ValueError(f"{size} bytes; the limit is {MAX_BYTES}")
        data = path.read_bytes()
        head = _head(data)
        if head.get("key") != key:
            raise ValueError("made from other weights or settings than its name says")
        return _built(head, load(data))
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
        warnings.warn(f"{path}: ignored, the shape is baked again: {error}", stacklevel=3)
        return None


def _head(data: bytes) -> dict[str, Any]:
    size = int.from_bytes(data[:8], "little") if len(data) >= 8 else -1
    if not 0 <= size <= min(MAX_HEADER_BYTES, len(data) - 8):
        raise ValueError("not a safetensors file: its header does not fit in it")
    head = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["rfsg-baked"])
    if not isinstance(head, dict):
        raise ValueError("its metadata is not that of a baked shape")
    return head


def _built(head: dict[str, Any], given: dict[str, Tensor]) -> Baked:
    if given.keys() != _TENSORS.keys():
        raise ValueError(f"holds {sorted(given)}; expected {sorted(_TENSORS)}")
    for name, (dtype, dimensions) in _TENSORS.items():
        tensor = given[name]
        if tensor.dtype != dtype or tensor.ndim != dimensions:
            raise ValueError(f"tensor {name!r} is {tensor.dtype} {tuple(tensor.shape)}")
        if dtype.is_floating_point and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"tensor {name!r} holds a number that is not finite")
    numbers = {name: float(head[name]) for name in _NUMBERS}
    if not all(0.0 < n < 1e6 for n in numbers.values()):
        raise ValueError(f"numbers {numbers}: expected positive ones")
    _check_sizes(given)
    t = {name: tensor.clone() for name, tensor in given.items()}  # the file's buffer is not aligned
    return Baked(
        key=str(head["key"]),
        **numbers,
        zero=Surface(t["zero.vertices"], t["zero.triangles"]),
        shell=Surface(t["shell.vertices"], t["shell.triangles"]),
        gradient=t["gradient"],
        low=t["low"],
        block=t["block"],
        middle=t["middle"],
        values=t["values"],
        error=t["error"],
        turn=t["turn"],
        offs=_offs(head["offs"]),
    )


def _offs(given: Any) -> dict[str, Off]:
    if not isinstance(given, dict) or given.keys() != set(WAYS):
        raise ValueError(f"says what it errs by as {given!r}: expected {', '.join(WAYS)}")
    offs = {way: Off(*(float(given[way][n]) for n in _OFF)) for way in WAYS}
    for way, off in offs.items():
        if not (0.0 <= off.usual <= off.most < 1e6 and 0.0 <= off.lost <= 1.0):
            raise ValueError(f"says that {way!r} errs by {off}")
    return offs


def _check_sizes(t: dict[str, Tensor]) -> None:
    """Every index within what it counts, so that nothing reads beyond its array."""
    for name in ("zero", "shell"):
        vertices, triangles = t[f"{name}.vertices"], t[f"{name}.triangles"]
        _expect(name, vertices, (len(vertices), 3))
        _expect(name, triangles, (len(triangles), 3))
        _within(name, triangles, 0, len(vertices))
    count = len(t["values"])
    _expect("gradient", t["gradient"], tuple(t["zero.vertices"].shape))
    _expect("low", t["low"], (3,))
    _expect("middle", t["middle"], tuple(t["block"].shape))
    _expect("values", t["values"], (count, (BLOCK + 1) ** 3))
    for name in ("error", "turn"):
        _expect(name, t[name], (count, BLOCK**3))
    _within("block", t["block"], -1, count)


def _expect(name: str, tensor: Tensor, size: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != size or 0 in size:
        raise ValueError(f"tensor {name!r} has shape {tuple(tensor.shape)}; expected {size}")


def _within(name: str, index: Tensor, low: int, high: int) -> None:
    if int(index.min()) < low or int(index.max()) >= high:
        raise ValueError(f"indices of {name!r} are not within {low} and {high}")
