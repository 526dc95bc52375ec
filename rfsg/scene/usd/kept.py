"""What a reading made of a stage, kept by what it was made from, for the next reading."""

import os
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any

import torch

from rfsg.scene import files
from rfsg.scene.arrays import Array
from rfsg.scene.patterns import Pattern
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node

Stamp = tuple[int, int, int]  # when a file was written, its size, which file it is


@dataclass
class Kept:
    """Bodies, surfaces, patterns and nodes under keys that name everything they were made from.

    A thing is made again only where that changed, so that what did not change is the same object,
    and the caches of the tracer hold. ``files`` are those that were read besides layers."""

    now: dict[Hashable, Any] = field(default_factory=dict)
    before: dict[Hashable, Any] = field(default_factory=dict)
    files: dict[str, Stamp | None] = field(default_factory=dict)

    def copy(self) -> "Kept":
        """For a reading after which this one is still to be followed."""
        return Kept(dict(self.now), dict(self.before), dict(self.files))

    def begin(self) -> None:
        """A reading of everything begins: what it does not ask for is forgotten at its ``end``."""
        self.before, self.now, self.files = self.before | self.now, {}, {}

    def end(self) -> None:
        self.before = {}

    def of(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The thing under the key: from this reading, from the one before, or made now."""
        if key not in self.now:
            self.now[key] = self.before[key] if key in self.before else make()
        return self.now[key]

    def holds(self, key: Hashable) -> bool:
        """Whether ``of`` has the thing already."""
        return key in self.now or key in self.before

    def same(self, key: Hashable, new: Any) -> Any:
        """The record of the reading before, if the new one says the same, else the new one."""
        old = self.now.get(key, self.before.get(key))
        self.now[key] = old if alike(old, new) else new
        return self.now[key]

    def stamp(self, resolved: str) -> Stamp | None:
        """The stamp of a file that is read, noted."""
        file = files.outer_file(resolved)
        self.files[file] = stamp_of(file)
        return self.files[file]

    def stale(self) -> bool:
        """Whether a file that was read has changed since."""
        return any(stamp_of(file) != stamp for file, stamp in self.files.items())


def stamp_of(file: str) -> Stamp | None:
    """What changes when a file is written or replaced; None where there is none."""
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def alike(a: Any, b: Any) -> bool:
    """Whether two records say the same: nodes, radios, poses and arrays by what they hold, tensors
    and patterns by their numbers, bodies by being the same."""
    if a is b:
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, Pattern):
        return a.same(b)
    if isinstance(a, (Node, Radio, Pose, Array)):
        return all(alike(value, vars(b)[name]) for name, value in vars(a).items())
    return isinstance(a, (str, float, tuple)) and a == b
