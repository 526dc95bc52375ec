"""Objects made of nobody knows what: their shapes kept, their surfaces ready to be learned."""

import fnmatch
from collections.abc import Sequence
from dataclasses import replace

import torch

from rfsg.learn.errors import SelectionError
from rfsg.objects.body import Body
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.scene import Scene


def blank(scene: Scene, patterns: Sequence[str], *, seed: int = 0, bulk: bool = False) -> Scene:
    """A scene in which the objects that ``patterns`` name have a new stochastic surface.

    For those that a known material is bound to, or whose learned one is to be learned anew. Objects
    that shared a body share the new one. bulk: with a loss inside, which thick objects need.
    Raises SelectionError for a pattern that names no object.
    """
    for pattern in patterns:
        if not fnmatch.filter([n.path for n in scene.nodes], pattern):
            known = ", ".join(n.path for n in scene.nodes[:12]) or "no objects"
            raise SelectionError(f"blank: {pattern!r} names no object; the scene has {known}")
    bodies: dict[int, Body] = {}
    nodes = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for node in scene.nodes:
            if any(fnmatch.fnmatchcase(node.path, pattern) for pattern in patterns):
                surface = StochasticSurface(bulk=0.1 if bulk else None)
                body = bodies.setdefault(id(node.body), Body(node.body.shape, surface))
                node = replace(node, body=body, asset=None)
            nodes.append(node)
    return replace(scene, nodes=tuple(nodes))
