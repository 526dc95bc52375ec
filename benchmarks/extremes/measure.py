"""One small scene, simulated with gradients, and what came of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from mpmath import mpc
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.errors import SceneError
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.channel import coefficients
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import Result, simulate

Point = tuple[float, float, float]
FLOOR_DB = -590.0  # what one interaction leaves of the power below -600 dB counts as nothing
DEEP = Quality(depth=1, floor_db=FLOOR_DB)
GONE = 10.0 ** (FLOOR_DB / 20.0)


@dataclass(frozen=True)
class Measured:
    """paths: (length, share of h) in order of length. gradient: whether every derivative of the path
    gain, by radio positions, poses, sizes and materials, is finite."""

    result: Result
    paths: list[tuple[float, complex]]
    gradient: bool | None
    slope: Tensor  # of the path gain by the receiver's position

    @property
    def status(self) -> str:
        """How the candidates ended, in the words of ``Status``."""
        counts = {k: n for k, n in self.result.status_counts.items() if n}
        return ", ".join(f"{k} {n}" for k, n in counts.items()) or "no path asked for"

    def warned(self, words: str) -> bool:
        return any(words in w for w in self.result.warnings)

    def errors(self, truth: Sequence[mpc]) -> float:
        """Largest difference from the true shares, in order of length, relative to each; infinite
        where their number differs."""
        if len(truth) != len(self.paths):
            return float("inf")
        pairs = zip(self.paths, truth, strict=True)
        return max((float(abs(mpc(c) - t) / abs(t)) for (_, c), t in pairs), default=0.0)


def measure(
    nodes: Sequence[Node], tx: Point, rx: Point, frequency: float, quality: Quality = DEEP
) -> Measured:
    """Simulate one link; every dimension, pose and constant of the nodes is differentiated."""
    radios = [
        replace(_radio(name, at), position=_leaf(at)) for name, at in (("/t", tx), ("/r", rx))
    ]
    inputs = [r.position for r in radios]
    for node in nodes:
        for x in (node.pose.translation, node.pose.scale, *_constants(node.body)):
            inputs.append(x.requires_grad_(True))
    result = simulate(
        Scene(tuple(nodes), (radios[0],), (radios[1],)), frequency, quality, gradients=True
    )
    gain = result.path_gain().sum()
    slopes: Sequence[Tensor | None] = [None] * len(inputs)
    if gain.requires_grad:
        slopes = torch.autograd.grad(gain, inputs, allow_unused=True)
    some = [s for s in slopes if s is not None]
    finite = all(bool(torch.isfinite(s).all()) for s in some) if some else None
    shares = coefficients(result.channel)[:, 0].detach().tolist()
    lengths = result.paths.length.detach().tolist()
    paths = sorted(zip(lengths, shares, strict=True), key=lambda p: p[0])
    slope = slopes[1] if slopes[1] is not None else torch.zeros(3, dtype=torch.float64)
    return Measured(result, paths, finite, slope)


def refusal(ask: Callable[[], object]) -> str:
    """The first fault of what a call refuses; "not refused" where it does not."""
    try:
        ask()
    except SceneError as error:
        return f"refused: {error.faults[0]}"
    except ValueError as error:
        return f"refused: {error}"
    return "not refused"


def node(body: Body, at: Point = (0.0, 0.0, 0.0), yaw_deg: float = 0.0, path: str = "/n") -> Node:
    return Node(path, body, Pose.at(*at, yaw_deg))


def wall_of(thickness: float = 0.2, eps_r: float = 5.24, sigma: float = 0.05) -> Slab:
    return Slab(thickness, eps_r=eps_r, sigma=sigma)


def _radio(path: str, at: Point) -> Radio:
    return Radio.at(path, *at)


def _leaf(at: Point) -> Tensor:
    return torch.tensor(at, dtype=torch.float64, requires_grad=True)


def _constants(body: Body) -> list[torch.nn.Parameter]:
    """Sizes and material constants: the few numbers of a body, not the weights of its networks."""
    return [p for p in body.parameters() if p.numel() <= 4]
