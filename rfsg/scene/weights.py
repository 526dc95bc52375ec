"""A body as the bytes of a safetensors file, and back: same bits, no pickle, nothing trusted.

The file holds the tensors ``shape.*`` and ``surface.*`` and one metadata entry, ``rfsg``: JSON with
the format version and, for shape and surface, the kind token and the constructor's arguments; of a
mesh these are arrays, and stand among the tensors.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from rfsg.objects.body import Body
from rfsg.objects.catalogue import shape_class, surface_class
from rfsg.objects.shapes.presence import absence
from rfsg.objects.shapes.topology import MAX_TRIANGLES
from rfsg.scene.files import outer_file
from rfsg.scene.scene import SceneError

FORMAT_VERSION = 1
MAX_WEIGHTS_BYTES = (
    256 * 2**20
)  # the paper's networks take 2 MB; this bounds what a stranger's take
MAX_HEADER_BYTES = 2**20
MAX_ROWS = 3 * MAX_TRIANGLES  # of a mesh's arrays
MAX_DECLARED = 1024  # largest width or depth that a file may declare
MAX_DECLARED_ELEMENTS = (
    2**26
)  # width^2 times depth, with the two largest declared numbers as widths
_FLOATS = (torch.float32, torch.float64)
ARRAYS = {"mesh": {"vertices": torch.float64, "triangles": torch.int64}}  # arguments that are [n 3]


def pack(body: Body) -> bytes:
    """The body's architecture and tensors as safetensors bytes; equal bodies give equal bytes."""
    head: dict[str, Any] = {"formatVersion": FORMAT_VERSION}
    tensors: dict[str, Tensor] = {}
    for part, module in _parts(body):
        config = dict(module.config())
        given = {
            name: torch.tensor(config.pop(name), dtype=dtype)
            for name, dtype in ARRAYS.get(module.kind, {}).items()
        }
        head[part] = {"kind": module.kind, "config": config}
        for name, tensor in (module.state_dict() | given).items():
            tensors[f"{part}.{name}"] = tensor.detach().cpu().contiguous().clone()
    # one metadata entry only: the order of several is not fixed, and the bytes are hashed
    return save_tensors(tensors, metadata={"rfsg": json.dumps(head, sort_keys=True)})


def unpack(data: bytes, where: str, file: str | None = None) -> Body:
    """The body in safetensors bytes. ``where`` begins each fault; ``file`` is where they came from,
    beside which a learned shape may keep what it is baked to.

    Raises SceneError with every fault found: header, version, kinds, declared sizes, and names,
    shapes, dtypes and finiteness of the tensors against the declared architecture, and whether a
    learned shape has a surface at all.
    """
    head = _head(data, where)
    try:
        tensors = load_tensors(data)
    except (SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise SceneError([f"{where}: not a safetensors file that can be read: {error}"]) from error
    parts, faults = {}, []
    for part, class_of in (("shape", shape_class), ("surface", surface_class)):
        try:
            arrays = _arrays(head.get(part), part, tensors, where)
            module = _build(class_of, head.get(part), arrays, f"{where}: {part}")
            faults += _fill(module, part, tensors, set(arrays), where)
            parts[part] = module
        except SceneError as error:
            faults += error.faults
    faults += [
        f"{where}: tensor {name!r} belongs to neither shape nor surface"
        for name in sorted(tensors)
        if name.split(".", 1)[0] not in ("shape", "surface")
    ]
    if not faults and not parts["shape"].exact and (why := absence(parts["shape"])):
        faults.append(f"{where}: the {parts['shape'].kind} shape {why}")
    if faults:
        raise SceneError(faults)
    if file is not None and parts["shape"].kind == "neural":
        parts["shape"].folder = os.path.dirname(outer_file(file))
    return Body(parts["shape"], parts["surface"])


def digest(data: bytes) -> str:
    """sha256 of the bytes, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def same_bits(a: Any, b: Any) -> bool:
    """True when two shapes, or two surfaces, have one kind, one configuration and equal tensors."""
    left, right = a.state_dict(), b.state_dict()
    return (
        (a.kind, a.config()) == (b.kind, b.config())
        and left.keys() == right.keys()
        and all(
            t.dtype == right[k].dtype and torch.equal(t.cpu(), right[k].cpu())
            for k, t in left.items()
        )
    )


def write_beside(path: Path, data: bytes, overwrite: bool) -> None:
    """Write a whole file or nothing: under another name first, then renamed.

    Raises SceneError when the file is there and ``overwrite`` is False, or the folder is not.
    """
    refuse_overwrite([path], overwrite)
    if not path.parent.is_dir():
        raise SceneError([f"{path}: the folder {path.parent} does not exist; make it first"])
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.write_bytes(data)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def refuse_overwrite(paths: list[Path], overwrite: bool) -> None:
    """Raises SceneError naming the files that are already there, unless ``overwrite``."""
    there = [p for p in paths if p.exists() and not overwrite]
    if there:
        raise SceneError([f"{p}: already exists; pass overwrite=True to replace it" for p in there])


def _parts(body: Body) -> tuple[tuple[str, Any], tuple[str, Any]]:
    return ("shape", body.shape), ("surface", body.surface)


def _head(data: bytes, where: str) -> dict[str, Any]:
    """The ``rfsg`` metadata entry, read by hand so that its size is known before it is parsed."""
    size = int.from_bytes(data[:8], "little") if len(data) >= 8 else -1
    if not 0 <= size <= min(MAX_HEADER_BYTES, len(data) - 8):
        raise SceneError([f"{where}: not a safetensors file: its header does not fit in the file"])
    try:
        head = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["rfsg"])
        version = head["formatVersion"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise SceneError([f"{where}: the header has no readable rfsg metadata: {error}"]) from error
    if version != FORMAT_VERSION:
        raise SceneError(
            [f"{where}: format version {version!r}; this rfsg reads version {FORMAT_VERSION}"]
        )
    return head


def _arrays(
    declared: Any, part: str, tensors: dict[str, Tensor], where: str
) -> dict[str, np.ndarray]:
    """The constructor's arguments that stand among the tensors; none where the header holds all, as
    in older files of small meshes."""
    said = declared if isinstance(declared, dict) else {}
    config = said.get("config")
    wanted = ARRAYS.get(str(said.get("kind")), {}) if isinstance(config, dict) else {}
    arrays = {}
    for name, dtype in wanted.items():
        if name in (config or {}):
            continue
        given, what = tensors.get(f"{part}.{name}"), f"{where}: tensor {f'{part}.{name}'!r}"
        if given is None:
            raise SceneError([f"{what} is missing"])
        if given.dtype != dtype or given.ndim != 2 or given.shape[1] != 3:
            raise SceneError(
                [f"{what} is {given.dtype} {list(given.shape)}; expected {dtype} [n, 3]"]
            )
        if len(given) > MAX_ROWS:
            raise SceneError([f"{what} has {len(given)} rows; the limit is {MAX_ROWS}"])
        arrays[name] = given.numpy()
    return arrays


def _build(
    class_of: Callable[[str], type], declared: Any, arrays: dict[str, np.ndarray], where: str
) -> nn.Module:
    if not isinstance(declared, dict) or not isinstance(declared.get("config"), dict):
        raise SceneError([f"{where}: metadata declares no kind and config"])
    kind, config = declared.get("kind"), declared["config"]
    _bound(config, where)
    try:
        return class_of(str(kind))(**config, **arrays)
    except Exception as error:  # the arguments are a stranger's: any refusal is the file's fault
        raise SceneError(
            [f"{where}: kind {kind!r} cannot be built from its config {config}: {error}"]
        ) from error


def _bound(config: dict[str, Any], where: str) -> None:
    """Refuse declared numbers that could take much memory, before anything is built."""
    numbers = list(_numbers(config))
    whole = sorted((abs(n) for n in numbers if isinstance(n, int)), reverse=True)
    if any(not math.isfinite(n) for n in numbers):
        raise SceneError([f"{where}: config holds a number that is not finite"])
    if whole and whole[0] > MAX_DECLARED:
        raise SceneError([f"{where}: config declares {whole[0]}; the limit is {MAX_DECLARED}"])
    if math.prod(whole[:1] + whole[:2]) > MAX_DECLARED_ELEMENTS:
        raise SceneError([f"{where}: the declared widths and depth make too large a network"])


def _numbers(value: Any) -> Iterator[int | float]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _fill(
    module: nn.Module, part: str, tensors: dict[str, Tensor], built: set[str], where: str
) -> list[str]:
    """Load ``part.*`` into the module, but for what it was ``built`` from; returns the faults and
    loads nothing when there are any."""
    wanted = {f"{part}.{k}": v for k, v in module.state_dict().items() if k not in built}
    given = {k: v for k, v in tensors.items() if k.startswith(f"{part}.")}
    given = {k: v for k, v in given.items() if k[len(part) + 1 :] not in built}
    faults = [f"{where}: tensor {k!r} is missing" for k in sorted(wanted.keys() - given.keys())]
    faults += [f"{where}: tensor {k!r} is unknown" for k in sorted(given.keys() - wanted.keys())]
    for name in sorted(wanted.keys() & given.keys()):
        faults += _compare(name, wanted[name], given[name], where)
    if not faults:
        # assign keeps the file's precision; clone, since the file's buffer may not be aligned
        loaded = {k[len(part) + 1 :]: v.clone() for k, v in given.items()}
        module.load_state_dict(loaded, assign=True, strict=not built)
    return faults


def _compare(name: str, wanted: Tensor, given: Tensor, where: str) -> list[str]:
    if wanted.shape != given.shape:
        return [
            f"{where}: tensor {name!r} has shape {tuple(given.shape)}; "
            f"the declared architecture needs {tuple(wanted.shape)}"
        ]
    both_float = wanted.dtype in _FLOATS and given.dtype in _FLOATS
    if wanted.dtype != given.dtype and not both_float:
        return [f"{where}: tensor {name!r} has dtype {given.dtype}; expected {wanted.dtype}"]
    if not bool(torch.isfinite(given).all()):
        return [f"{where}: tensor {name!r} holds a number that is not finite"]
    return []
