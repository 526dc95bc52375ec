"""Two ways to make a network's sweep cheaper that were tried: torch.compile, and equal networks as one.

    python benchmarks/sweeps.py [--runs 7]

Both against ``value_and_gradient`` as it is, in turns. Written here as plain functions, as short as they
can be, for what they are compared with is not short either: the sweep by hand in reused memory.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from machine import ROOT
from torch import Tensor

from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.shapes.sweeps import SHARE
from rfsg.scene.scene import Scene
from rfsg.tracer.simulate import simulate

LAB = ROOT / "assets" / "scenes" / "lab.usda"

COMPILED_AT = (2_048, 16_384)  # points of a call: one chunk, and several
STACKED_AT = (8, 64, 512, 2_048)  # points of each of the networks
NETWORKS = 5  # learned objects in the lab
BOUNDS = [[-0.5] * 3, [0.5] * 3]


@dataclass(frozen=True)
class Stacked:
    """Networks of one architecture: weights [b ...] of each layer."""

    weight: list[Tensor]
    bias: list[Tensor]
    value: tuple[Tensor, Tensor]
    centre: Tensor
    reach: Tensor
    octaves: Tensor
    skip: int
    softness: float

    @staticmethod
    def of(shapes: Sequence[NeuralShape]) -> "Stacked":
        def stack(get: Callable[[NeuralShape], Tensor]) -> Tensor:
            return torch.stack([get(shape).detach().float() for shape in shapes])

        depth, first = shapes[0].depth, shapes[0]
        return Stacked(
            [stack(lambda s, i=i: s.hidden[i].weight.t()).contiguous() for i in range(depth)],  # type: ignore[union-attr]
            [stack(lambda s, i=i: s.hidden[i].bias[None]) for i in range(depth)],  # type: ignore[union-attr]
            (stack(lambda s: s.to_value.weight), stack(lambda s: s.to_value.bias)),
            stack(lambda s: s._centre[None]),
            stack(lambda s: s._reach)[:, None, None],
            first._octaves.float(),
            first.skip,
            first.softness,
        )


def value_and_gradient(net: Stacked, point: Tensor) -> tuple[Tensor, Tensor]:
    """f [b n] and its gradient [b n 3] at points [b n 3]."""
    own = (point - net.centre) / net.reach
    phase = own[..., None] * net.octaves
    sine, cosine = phase.sin(), phase.cos()
    encoded = torch.cat([own, sine.flatten(2), cosine.flatten(2)], -1)
    x, slopes = encoded, []
    for i, (weight, bias) in enumerate(zip(net.weight, net.bias, strict=True)):
        x = torch.cat([x, encoded], -1) * SHARE if i == net.skip else x
        x = torch.baddbmm(bias, x, weight)
        root = (x * x + net.softness).sqrt()
        x = 0.5 * (x + root)
        slopes.append(x / root)
    value = (x * net.value[0]).sum(-1) + net.value[1]
    adjoint, again = net.value[0].expand_as(x), torch.zeros_like(encoded)
    width = x.shape[-1]
    for i in reversed(range(len(slopes))):
        adjoint = torch.bmm(adjoint * slopes[i], net.weight[i].transpose(1, 2))
        if i == net.skip:
            adjoint = adjoint * SHARE
            again, adjoint = adjoint[..., width:], adjoint[..., :width]
    own_part, to_sine, to_cosine = (adjoint + again).split(
        [3, sine[0, 0].numel()] + [sine[0, 0].numel()], -1
    )
    turned = to_sine.view_as(sine) * cosine - to_cosine.view_as(sine) * sine
    gradient = own_part + (turned * net.octaves).sum(-1)
    return value * net.reach.squeeze(-1), gradient


@torch.no_grad()
def compiled(runs: int) -> list[str]:
    """What torch.compile makes of a sweep: seconds to compile, and how much quicker it is then."""
    shape = NeuralShape(BOUNDS, lipschitz=1.0).requires_grad_(False)
    net = Stacked.of([shape])
    lines = [
        "| points | by hand, us | compiled, us | by hand / compiled | to compile, s | pays from |"
    ]
    lines += ["|---|---|---|---|---|---|"]
    for count in COMPILED_AT:
        torch._dynamo.reset()
        quick = torch.compile(value_and_gradient, dynamic=False)
        point = torch.rand(count, 3) - 0.5
        start = time.perf_counter()
        found = quick(net, point[None])
        seconds = time.perf_counter() - start
        for one, other in zip(found, shape.value_and_gradient(point), strict=True):
            torch.testing.assert_close(one[0], other, rtol=1e-3, atol=1e-4)
        own, other, ratio = _turns(
            lambda p=point: shape.value_and_gradient(p),
            lambda p=point, q=quick: q(net, p[None]),
            runs,
        )
        gain = own - other
        pays = f"{count * seconds / gain:.2g} points" if gain > 0 else "never"
        lines.append(
            f"| {count} | {1e6 * own:.0f} | {1e6 * other:.0f} | {ratio} | {seconds:.1f} | {pays} |"
        )
    return [*lines, ""]


@torch.no_grad()
def stacked(runs: int) -> list[str]:
    """Equal networks one after the other, and all at once by batched matrix products."""
    shapes = [
        NeuralShape(BOUNDS, lipschitz=1.0, seed=k).requires_grad_(False) for k in range(NETWORKS)
    ]
    net = Stacked.of(shapes)
    lines = [
        "| points of each | one by one, us | at once, us | one by one / at once |",
        "|---|---|---|---|",
    ]
    for count in STACKED_AT:
        point = torch.rand(NETWORKS, count, 3) - 0.5

        def in_turn(p: Tensor = point) -> list[tuple[Tensor, Tensor]]:
            return [s.value_and_gradient(q) for s, q in zip(shapes, p, strict=True)]

        for k, own in enumerate(in_turn()):
            torch.testing.assert_close(
                value_and_gradient(net, point)[0][k], own[0], rtol=1e-3, atol=1e-4
            )
        own, other, ratio = _turns(in_turn, lambda p=point: value_and_gradient(net, p), runs)
        lines.append(f"| {count} | {1e6 * own:.0f} | {1e6 * other:.0f} | {ratio} |")
    return [*lines, ""]


def asked_in_the_lab() -> str:
    """How many points networks are asked at once where the lab is simulated, and how often several
    networks are asked one after the other, which is where they might be asked at once."""
    calls: list[tuple[int, int]] = []
    own = NeuralShape._answers

    def counted(shape: NeuralShape, point: Tensor, **asked: bool) -> tuple[Tensor, ...]:
        calls.append((id(shape), point.numel() // 3))
        return own(shape, point, **asked)

    NeuralShape._answers = counted
    try:
        simulate(Scene.from_usd(LAB), quality="draft")
    finally:
        NeuralShape._answers = own
    in_groups, group = 0, set[int]()
    for shape, _ in calls:
        if shape in group:
            in_groups, group = in_groups + len(group) * (len(group) > 1), set()
        group.add(shape)
    few = [sum(points <= most for _, points in calls) for most in (64, 512)]
    return (
        f"A draft of lab.usda asks its networks {len(calls)} times, {few[0]} times for 64 points or "
        f"fewer and {few[1]} times for 512 or fewer; in {in_groups} of the calls another network is "
        "asked just before or after: that many could be stacked at most."
    )


def _turns(
    one: Callable[[], object], other: Callable[[], object], runs: int
) -> tuple[float, float, str]:
    """Medians of the seconds of two, in turns of some ten calls, and the spread of their ratios."""
    one(), other()
    times: list[tuple[float, float]] = []
    for _ in range(runs):
        pair = []
        for work in (one, other):
            start = time.perf_counter()
            for _ in range(10):
                work()
            pair.append((time.perf_counter() - start) / 10)
        times.append((pair[0], pair[1]))
    ratios = [a / b for a, b in times]
    spread = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
    return statistics.median(a for a, _ in times), statistics.median(b for _, b in times), spread


def section(runs: int) -> list[str]:
    return [
        "## Tried: torch.compile, and equal networks at once",
        "",
        "f with its gradient by the sweep by hand (`value_and_gradient`), and by a plain one that "
        "torch.compile has compiled for that many points:",
        "",
        *compiled(runs),
        f"{NETWORKS} networks of equal size one after the other, and as one sweep of stacked weights:",
        "",
        *stacked(runs),
        asked_in_the_lab(),
        "",
        "So neither is used. Compiling takes longer than all that a question asks; stacking saves calls, "
        "not arithmetic, and few calls stand beside one of another network.",
        "",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7)
    print("\n".join(section(parser.parse_args().runs)))


if __name__ == "__main__":
    main()
