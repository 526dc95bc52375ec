"""The one error of scenes, assets, edits and their files."""

from collections.abc import Sequence


class SceneError(Exception):
    """A scene, an asset or an edit is at fault. ``faults`` lists every fault found, each one line
    that begins with the prim path or the file."""

    def __init__(self, faults: Sequence[str]):
        self.faults = tuple(faults)
        super().__init__("\n".join(self.faults))
