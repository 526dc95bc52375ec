"""The ladder of settings, from one bounce to ``reference``, and how far each is from its top.

What a rung lacks shows as what the rungs above it change. Two settings may agree at one frequency by
luck, so that they are compared at several about the carrier: the same paths, their phases anew. What
is beyond the highest rung tried is extrapolated: steps of one kind shrink.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.scene import Scene
from rfsg.tracer.plan import PRESETS, Quality
from rfsg.tracer.response import at_carrier, frequency_response
from rfsg.tracer.simulate import Result

LINKS_WITHIN = 0.9  # share of the links that an error is stated for
DRAWS = 17  # carriers about the asked one at which settings are compared
DRAWS_WITHIN = 0.9  # share of the draws that an estimated error holds for
BAND = 0.08  # their spread, as a share of the carrier: paths 1.5 m apart turn once at 2.4 GHz
# how a step up the ladder shrinks to the next of its kind, at best and at worst: see docs/tradeoff.md
SHRINKS = {"depth": (0.3, 0.5), "diffraction": (0.2, 0.2), "curved_depth": (0.3, 0.3)}


@dataclass(frozen=True)
class Rung:
    """One setting of the ladder; ``dearer``: how many times the time of the rung before, at most, in
    nine of ten random scenes (``benchmarks/dial.py``)."""

    name: str
    quality: Quality
    dearer: float


_FINE = {"floor_db": -200.0, "crossing_samples": 128, "zone_rings": 5, "rays": 200_000}
RUNGS = (
    Rung("one bounce", replace(PRESETS["draft"], depth=1), 1.0),
    Rung("draft", PRESETS["draft"], 2.5),
    Rung("three bounces", Quality(curved_depth=1), 2.0),
    Rung("standard", PRESETS["standard"], 7.0),
    Rung("five bounces", Quality(depth=5, diffraction=1, floor_db=-100.0), 2.0),
    Rung("two edges", Quality(depth=5, diffraction=2, curved_depth=3, **_FINE), 8.0),  # type: ignore[arg-type]
    Rung("reference", PRESETS["reference"], 30.0),
)


def ladder(scene: Scene) -> tuple[Rung, ...]:
    """The rungs that differ for this scene, cheapest first; the last of equals keeps its name."""
    distinct: dict[Quality, Rung] = {}
    for rung in RUNGS:
        quality = effective(rung.quality, scene)
        first = distinct.get(quality, rung)
        distinct[quality] = Rung(rung.name, quality, first.dearer)
    return tuple(distinct.values())


def effective(quality: Quality, scene: Scene) -> Quality:
    """The same question of ``simulate`` without what the scene gives no work: such fields are as in
    a Quality made by hand.

    ``curved`` without curved faces is the one that counts: from 2 on the search is by rays, which is
    slower and may miss what an enumeration finds.
    """
    shapes = [node.body.shape for node in scene.nodes]
    idle = ["map_rays"]  # for maps alone
    if not quality.diffraction:
        idle.append("diffraction_depth")
    if not any(isinstance(node.body.surface, Solid) for node in scene.nodes):
        idle.append("refraction")
    if all(shape.faceted for shape in shapes):
        idle += ["curved", "curved_depth"]
    if all(shape.exact for shape in shapes):
        idle += ["epsilon", "zone_rings", "refits", "intersection"]
    if all(node.body.surface.kind != "stochastic" for node in scene.nodes):
        idle += ["crossing_samples", "integral"]
    if all(
        node.body.scattering is None and node.body.surface.kind != "stochastic"
        for node in scene.nodes
    ):
        idle += ["diffuse", "phase_seed"]
    return replace(quality, **{name: getattr(Quality(), name) for name in idle})


def responses(result: Result) -> Complex[Tensor, "t r k"]:
    """h of every link at ``DRAWS`` frequencies about the carrier: its paths, their phases anew.

    Two settings may agree at one frequency by luck. Gains are those of the carrier.
    """
    carrier = float(result.frequency[0])
    offset = torch.linspace(-0.5, 0.5, DRAWS, dtype=torch.float64) * BAND
    band = (carrier * (1.0 + offset)).to(result.channel.delay.device)
    one = at_carrier(result.channel, 0)
    return frequency_response(one, *result.size(), band)[:, :, 0].detach()


def difference_db(one: Complex[Tensor, "*b"], other: Complex[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """|path gain of one over the other| [dB]: 0 where neither hears anything, inf where one does."""
    level, against = (20.0 * torch.log10(h.abs()) for h in (one, other))
    silent = torch.isinf(level) & torch.isinf(against)
    return torch.where(silent, torch.zeros_like(level), (level - against).abs())


def at_links(error: Float[Tensor, "t r *k"]) -> Float[Tensor, "*k"]:
    """The error not exceeded on ``LINKS_WITHIN`` of the links; the higher of two neighbours."""
    return _not_exceeded(error.flatten(0, 1), LINKS_WITHIN)


def _apart(one: Complex[Tensor, "t r k"], other: Complex[Tensor, "t r k"]) -> float:
    """How far two settings differ at the links, in nearly every draw of the phases [dB]."""
    return float(_not_exceeded(at_links(difference_db(one, other)), DRAWS_WITHIN))


def _not_exceeded(value: Float[Tensor, "n *k"], share: float) -> Float[Tensor, "*k"]:
    return value.sort(0).values[max(0, math.ceil(share * len(value)) - 1)]


def estimate(
    heard: Sequence[Complex[Tensor, "t r k"]], qualities: Sequence[Quality], complete: bool
) -> list[float]:
    """Estimated error against ``reference`` of each rung tried [dB], at 90 % of links.

    heard: the responses of the rungs tried, cheapest first; qualities: of the whole ladder. complete:
    the last is ``reference`` itself, and nothing remains. Else what the highest rung tried lacks is added:
    further bounces and further edges, each by how much the last step of its kind changed (``_rest``).
    """
    last = len(heard) - 1
    rest = 0.0 if complete else sum(_rest(heard, qualities, kind) for kind in SHRINKS)
    return [_apart(h, heard[last]) + rest for h in heard]


def _rest(
    heard: Sequence[Complex[Tensor, "t r k"]], qualities: Sequence[Quality], kind: str
) -> float:
    """What further steps of a field would change [dB]: a geometric series after the last one.

    As each step was r times the one before, r / (1 - r) times the last, r within ``SHRINKS``; inf
    before there was a step to judge by.
    """
    level = [getattr(q, kind) for q in qualities[: len(heard)]]
    if level[-1] >= getattr(qualities[-1], kind):
        return 0.0
    steps = [
        _apart(a, b)
        for (a, b), (low, high) in zip(pairwise(heard), pairwise(level), strict=True)
        if high > low
    ]
    if not steps or not math.isfinite(steps[-1]):
        return math.inf
    best, worst = SHRINKS[kind]
    before = steps[-2] if len(steps) > 1 else 0.0
    shrinks = min(max(steps[-1] / before, best), worst) if before > 0.0 else worst
    return steps[-1] * shrinks / (1.0 - shrinks)
