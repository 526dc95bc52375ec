"""Which variant sets a scene's prims have, and what is chosen of each."""

from dataclasses import dataclass

from pxr import Usd

from rfsg.scene.scene import Scene, at_or_below
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.source import Source, opened


@dataclass(frozen=True)
class VariantSet:
    """A variant set: of which prim, its name and choices, and the one chosen ("" for none), as
    ``scene.with_variant(path, name, choice)`` takes them."""

    path: str
    name: str
    choices: tuple[str, ...]
    chosen: str

    def concerns(self, path: str) -> bool:
        """Whether what stands at a path is part of it: its prim is there or above."""
        return at_or_below(path, self.path)


def variant_sets(scene: Scene) -> tuple[VariantSet, ...]:
    """All variant sets of a scene's stage that can be chosen of, outermost first; none of a scene that
    was made in Python. Raises SceneError for a file that can no longer be read."""
    if not isinstance(scene.source, Source):
        return ()
    source = scene.source
    with quiet(source.path):
        stage = opened(source.given or source.path, source.options).stage
        found = tuple(x for prim in Usd.PrimRange.Stage(stage) for x in _of(prim))
        del stage
    return found


def _of(prim: Usd.Prim) -> list[VariantSet]:
    sets, path = prim.GetVariantSets(), str(prim.GetPath())
    every = [(name, sets.GetVariantSet(name)) for name in sets.GetNames()]
    return [
        VariantSet(path, name, tuple(one.GetVariantNames()), one.GetVariantSelection())
        for name, one in every
        if one.GetVariantNames()
    ]
