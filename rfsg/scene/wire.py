"""A scene as bytes from one process to another: JSON, and safetensors for what is large. No pickle, and
nothing believed: who sends may have been taken over by the file that it read.

    8 bytes: length of the head | head, JSON | blobs, whose sizes the head gives
"""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.scene.arrays import Array
from rfsg.scene.errors import SceneError
from rfsg.scene.patterns import LARGEST_MEAN_GAIN, Pattern
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.scene.weights import pack, unpack

MAX_BYTES = 2**30  # of a message
MAX_HEAD_BYTES = 2**28
MAX_TEXT = 4000  # letters of a path or a sentence
REFUSALS = (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError,
            RuntimeError, OverflowError, SafetensorError)  # fmt: skip
Message = tuple[dict[str, Any], list[bytes]]


def packed(head: dict[str, Any], blobs: Sequence[bytes] = ()) -> bytes:
    """One message."""
    text = json.dumps(head | {"sizes": [len(b) for b in blobs]}, allow_nan=False).encode()
    return b"".join((len(text).to_bytes(8, "little"), text, *blobs))


def unpacked(data: bytes) -> Message:
    """(head, blobs) of a message. Raises ValueError for bytes that are none."""
    size = int.from_bytes(data[:8], "little") if len(data) >= 8 else -1
    if not 0 <= size <= min(MAX_HEAD_BYTES, len(data) - 8):
        raise ValueError("a message whose head does not fit in it")
    head = json.loads(data[8 : 8 + size], parse_constant=_no_number)
    sizes = head["sizes"]
    if not all(type(n) is int and n >= 0 for n in sizes) or sum(sizes) != len(data) - 8 - size:
        raise ValueError("a message of another length than its head says")
    ends = np.cumsum([8 + size, *sizes]).tolist()
    return head, [data[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]


def plain(text: Any) -> str:
    """A sentence or a path that a terminal may show: of bounded length, no control characters."""
    if not isinstance(text, str):
        raise TypeError(f"{type(text).__name__} in place of text")
    return "".join(c if c.isprintable() else "?" for c in text[:MAX_TEXT])


# scenes


def scene_message(scene: Scene) -> Message:
    """A scene's objects, radios and warnings; where it came from stays behind."""
    blobs: list[bytes] = []
    shapes: dict[int, int] = {}
    surfaces: dict[int, int] = {}
    bodies: dict[int, int] = {}
    told: list[dict[str, Any]] = []
    for node in scene.nodes:
        body = node.body
        if id(body) in bodies:
            continue
        bodies[id(body)] = len(told)
        told.append({
            "blob": len(blobs),
            "shape": shapes.setdefault(id(body.shape), len(shapes)),
            "surface": surfaces.setdefault(id(body.surface), len(surfaces)),
            "band": body.band,
        })  # fmt: skip
        blobs.append(pack(body))
    patterns: dict[int, int] = {}
    radios = {
        role: [_radio_told(radio, patterns, blobs) for radio in some]
        for role, some in (("tx", scene.transmitters), ("rx", scene.receivers))
    }
    nodes = [
        {"path": n.path, "body": bodies[id(n.body)], "velocity": n.velocity.tolist(),
         "rotation": n.pose.rotation.tolist(), "translation": n.pose.translation.tolist(),
         "scale": float(n.pose.scale)}
        for n in scene.nodes
    ]  # fmt: skip
    head = {"nodes": nodes, "bodies": told, "frequency": scene.frequency}
    return head | radios | {"warnings": list(scene.warnings)}, blobs


def scene_of(message: Message, where: str, device: torch.device | str = "cpu") -> Scene:
    """The scene of a message. Raises SceneError for one that is not in order."""
    head, blobs = message
    try:
        bodies = _bodies(head["bodies"], blobs, where)
        bodies = [body.to(device) for body in bodies]
        nodes = tuple(
            Node(
                _path(row["path"]),
                bodies[_index(row["body"], len(bodies))],
                _pose(row, device),
                numbers(row["velocity"], 3).to(device),
            )
            for row in head["nodes"]
        )
        known: dict[int, Pattern] = {}
        tx, rx = (
            tuple(_radio(row, known, blobs, device) for row in head[role]) for role in ("tx", "rx")
        )
        frequency = head["frequency"]
        if frequency is not None and not 0 < float(frequency) < 1e15:
            raise ValueError(f"a frequency of {frequency} Hz")
        warnings = tuple(plain(w) for w in head["warnings"])
    except REFUSALS as error:
        raise SceneError([f"{where}: its reader sent what is no scene: {error}"]) from error
    return Scene(nodes, tx, rx, frequency and float(frequency), warnings)


def _bodies(told: list[dict[str, Any]], blobs: list[bytes], where: str) -> list[Body]:
    """Bodies that share shapes and surfaces as those that were sent do."""
    shapes: dict[int, Any] = {}
    surfaces: dict[int, Any] = {}
    bodies = []
    for row in told:
        body = unpack(blobs[_index(row["blob"], len(blobs))], where)
        shape = shapes.setdefault(int(row["shape"]), body.shape)
        surface = surfaces.setdefault(int(row["surface"]), body.surface)
        band = row["band"]
        if band is not None:
            low, high = numbers(band, 2).tolist()
            band = low, high
        bodies.append(Body(shape, surface, band))
    return bodies


def _pose(row: dict[str, Any], device: torch.device | str) -> Pose:
    rotation, translation = numbers(row["rotation"], 3, 3), numbers(row["translation"], 3)
    scale = numbers(row["scale"])
    if not 0 < float(scale) or not _orthonormal(rotation):
        raise ValueError("a pose that is neither a turn nor a mirror, evenly scaled")
    return Pose(rotation.to(device), translation.to(device), scale.to(device))


def _orthonormal(rotation: Tensor) -> bool:
    one = torch.eye(3, dtype=torch.float64)
    return torch.allclose(rotation @ rotation.T, one, atol=1e-6)  # as far as readers let it be off


def _radio_told(radio: Radio, patterns: dict[int, int], blobs: list[bytes]) -> dict[str, Any]:
    pattern = radio.pattern
    if isinstance(pattern, Pattern):
        if id(pattern) not in patterns:
            patterns[id(pattern)] = len(blobs)
            samples = torch.view_as_real(pattern.samples.detach().cpu()).contiguous()
            parts = {"theta": pattern.theta.cpu(), "phi": pattern.phi.cpu(), "samples": samples}
            blobs.append(save(parts))
        said: Any = {"blob": patterns[id(pattern)], "name": pattern.name, "vector": pattern.vector}
    else:
        said = pattern
    array = radio.array
    return {
        "path": radio.path,
        "position": radio.position.tolist(),
        "rotation": radio.rotation.tolist(),
        "velocity": radio.velocity.tolist(),
        "power_dbm": radio.power_dbm,
        "frequency": radio.frequency,
        "pattern": said,
        "polarization": radio.polarization,
        "array": None if array is None else [array.offsets.tolist(), array.unit, array.layout],
    }


def _radio(
    row: dict[str, Any], known: dict[int, Pattern], blobs: list[bytes], device: torch.device | str
) -> Radio:
    pattern = row["pattern"]
    if not isinstance(pattern, str):
        at = _index(pattern["blob"], len(blobs))
        if at not in known:
            known[at] = _pattern(pattern, load(blobs[at]))
        pattern = known[at]
    said = row["array"]
    array = None if said is None else _array(*said)
    frequency = row["frequency"]
    if frequency is not None and not 0 < float(frequency) < 1e15:
        raise ValueError(f"a frequency of {frequency} Hz")
    rotation = numbers(row["rotation"], 3, 3)
    if not _orthonormal(rotation):
        raise ValueError("a radio whose axes are not at right angles")
    return Radio(
        _path(row["path"]),
        numbers(row["position"], 3).to(device),
        rotation.to(device),
        numbers(row["velocity"], 3).to(device),
        float(numbers(row["power_dbm"])),
        frequency and float(frequency),
        pattern,
        row["polarization"],
        array,
    )


def _array(offsets: Any, unit: str, layout: Any) -> Array:
    made = Array(numbers(offsets, len(offsets), 3), unit)
    if layout is None:
        return made
    again = Array.planar(*layout, unit=unit)
    if not torch.equal(again.offsets, made.offsets):
        raise ValueError("an array whose places are not those of its rows and columns")
    return again


def _pattern(said: dict[str, Any], t: dict[str, Tensor]) -> Pattern:
    theta, phi, samples = t["theta"], t["phi"], t["samples"]
    if any(a.dtype != torch.float64 or not bool(a.isfinite().all()) for a in t.values()):
        raise ValueError("a pattern of numbers that are not finite")
    grid = (len(theta), len(phi), 2, 2)
    rising = all(len(a) > 1 and bool((a.diff() > 0).all()) for a in (theta, phi))
    turn = math.isclose(float(phi[-1] - phi[0]), 2 * math.pi, rel_tol=1e-9)
    whole = float(theta[0]) == 0.0 and math.isclose(float(theta[-1]), math.pi, rel_tol=1e-9)
    if samples.shape != grid or not (rising and turn and whole):
        raise ValueError("a pattern that is no grid over the sphere")
    made = torch.view_as_complex(samples.clone())
    pattern = Pattern(plain(said["name"]), theta.clone(), phi.clone(), made, said["vector"] is True)
    if not pattern.mean_gain() <= LARGEST_MEAN_GAIN:
        raise ValueError("a pattern that gives more than it takes")
    return pattern


def _path(text: Any) -> str:
    if plain(text) != text or not text.startswith("/"):
        raise ValueError(f"{plain(text)!r} in place of a prim path")
    return text


def _index(number: Any, end: int) -> int:
    if type(number) is not int or not 0 <= number < end:
        raise ValueError(f"{number!r} where there are {end}")
    return number


def numbers(given: Any, *shape: int) -> Tensor:
    made = torch.tensor(given, dtype=torch.float64)
    if tuple(made.shape) != shape or not bool(made.isfinite().all()):
        raise ValueError(f"expected {shape} finite numbers")
    return made


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is no number")
