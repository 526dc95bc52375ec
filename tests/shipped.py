"""What comes with rfsg, loaded once in a process: change nothing of it in place.

The tracer keeps what it has learned of a network (edges, samples, sketches) with its shape. Tests that
share the shape share that too, which is most of what a run of the lab costs.
"""

from functools import cache
from pathlib import Path

from rfsg.objects.shapes.neural import NeuralShape
from rfsg.scene.scene import Scene

ASSETS = Path(__file__).resolve().parents[1] / "assets"
LAB = ASSETS / "scenes" / "lab.usda"
WHERE = {
    "cabinet": "/World/Cabinet",
    "person": "/World/Person",
    "desk": "/World/Desk",
    "chair": "/World/Chairs/Chair_0",
}


@cache
def lab() -> Scene:
    return Scene.from_usd(LAB)


def shape(name: str) -> NeuralShape:
    """A trained one of the lab's own: cabinet, person, desk or chair."""
    found = lab().node(WHERE[name]).body.shape
    assert isinstance(found, NeuralShape)
    return found
