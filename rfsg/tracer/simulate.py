"""From a scene to its channel, the stages in order: plan, search, solve, field."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer import diffraction, refract, scatter, validity
from rfsg.tracer import field as fields
from rfsg.tracer.channel import Link, links, transfer
from rfsg.tracer.edges import edges_in
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.launch import SearchReport, search
from rfsg.tracer.memory import peak_bytes
from rfsg.tracer.plan import Plan, Quality, make_plan
from rfsg.tracer.records import Chains, Channel, Paths, Status
from rfsg.tracer.response import (
    ImpulseResponse,
    Taps,
    frequency_response,
    impulse_response,
    taps,
)
from rfsg.tracer.solve import solve

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Result:
    """Everything about one simulation. ``paths`` and ``channel`` share their path axis.

    peak_bytes: the most memory in use when it ended (``memory.peak_bytes``).
    """

    scene: Scene
    frequency: Float[Tensor, "f"]
    paths: Paths
    channel: Channel
    chains: Chains
    plan: Plan
    search: SearchReport
    status_counts: dict[str, int]
    seconds: dict[str, float]
    warnings: tuple[str, ...] = field(default=())
    peak_bytes: int | None = None

    def transfer(self) -> Complex[Tensor, "t r f"]:
        """h(f) of every transmitter and receiver, antennas included, 1 W in."""
        return transfer(self.channel, len(self.scene.transmitters), len(self.scene.receivers))

    def path_gain(self) -> Float[Tensor, "t r f"]:
        """|h(f)|^2, the coherent path gain (linear)."""
        return self.transfer().abs() ** 2

    def size(self) -> tuple[int, int]:
        """How many transmitters and receivers: what the functions of a channel ask for."""
        return len(self.scene.transmitters), len(self.scene.receivers)

    def frequency_response(
        self, frequency: Float[Tensor, "k"], time: Float[Tensor, "s"] | None = None
    ) -> Complex[Tensor, "t r s k"]:
        """h(f, t) at any frequencies [Hz] and times [s]; see ``response.frequency_response``."""
        return frequency_response(self.channel, *self.size(), frequency, time)

    def impulse_response(self, time: Float[Tensor, "s"] | None = None) -> ImpulseResponse:
        """Delays and complex gains of every link's paths; see ``response.impulse_response``."""
        return impulse_response(self.channel, *self.size(), time)

    def taps(self, bandwidth: float, time: Float[Tensor, "s"] | None = None) -> Taps:
        """Taps of the baseband channel sampled at a bandwidth [Hz]; see ``response.taps``."""
        return taps(self.channel, *self.size(), bandwidth, time=time)

    def links(self) -> list[Link]:
        """One record per transmitter and receiver, at the first frequency."""
        return links(self.scene, self.paths, self.channel)


def simulate(
    scene: Scene,
    frequency: float | Tensor | None = None,
    quality: str | Quality = "standard",
    *,
    accuracy_db: float | None = None,
    budget_s: float | None = None,
    gradients: bool = False,
    chains: Chains | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Result:
    """Exact paths and the channel between all transmitters and receivers of a scene.

    frequency: [Hz], one or several [f]; None takes the transmitters' or the scene's own.
    accuracy_db, budget_s: choose the setting by pilot runs, in place of ``quality``: the cheapest that
    is accurate enough, the most accurate within the time (``dial.within``). gradients: keep the graph,
    so that ``result.channel`` differentiates with respect to poses, radio positions, shapes, materials
    and weights that require it. chains: candidates kept from an earlier result (the search is skipped).
    Raises SceneError without a frequency or with broken radios.
    """
    if accuracy_db is not None or budget_s is not None:
        from rfsg.tracer.dial import simulate_within  # which simulates, too

        return simulate_within(
            scene,
            frequency,
            accuracy_db=accuracy_db,
            budget_s=budget_s,
            gradients=gradients,
            chains=chains,
            device=device,
            progress=progress,
        )
    quality = Quality.named(quality) if isinstance(quality, str) else quality
    frequencies = resolve_frequency(scene, frequency).to(device)
    tx, rx = (positions(r, device) for r in (scene.transmitters, scene.receivers))
    seconds: dict[str, float] = {}
    tell = progress or (lambda _: None)
    with torch.set_grad_enabled(gradients):
        with _timed(seconds, "plan", tell):
            world = world_for(scene, quality, device)
            validity.refuse(world, frequencies)
            plan = make_plan(world, quality)
        with _timed(seconds, "proxies", tell):
            proxies = Proxies(world)
        with _timed(seconds, "search", tell):
            report = SearchReport()
            if chains is None:
                chains, report = search(world, proxies, tx, rx, frequencies, quality)
                plan = plan.with_((report.sentence(),))
        with _timed(seconds, "solve", tell):
            wavelength = SPEED_OF_LIGHT / float(frequencies[0])
            paths, counts = solve(world, chains, tx, rx, wavelength, quality)
            edges, more = None, []
            if quality.refraction and bool(world.solid.any()):
                bent = refract.bend(world, proxies, paths, frequencies, quality)
                (paths,), more = bent.paths, [replace(bent, paths=())]
            if quality.diffraction:
                edges = edges_in(world, wavelength)
                more.append(diffraction.paths_of(world, edges, tx, rx, wavelength, quality))
            if bool(scatter.rough_nodes(world).any()):
                more.append(scatter.paths_of(world, tx, rx, quality))
            paths = Paths.joined([paths, *(p for found in more for p in found.paths)])
            for found in more:
                counts = Counter(counts) + Counter(found.counts)
                plan = plan.with_(found.modelled, found.left_out)
        with _timed(seconds, "field", tell):
            channel = fields.channel(
                world,
                proxies,
                paths,
                scene.transmitters,
                scene.receivers,
                frequencies,
                quality,
                edges,
            )
            paths, channel, counts = _above_floor(paths, channel, counts, quality)
    named = {s.name: n for s, n in sorted(counts.items())}
    warnings = (*scene.warnings, *validity.sentences(world, frequencies))
    return Result(
        scene,
        frequencies,
        paths,
        channel,
        chains,
        plan,
        report,
        named,
        seconds,
        warnings,
        peak_bytes(device),
    )


def world_for(scene: Scene, quality: Quality, device: torch.device | str) -> World:
    """The scene as tensors, its crossings integrated as the quality says."""
    samples, integral = quality.crossing_samples, quality.integral
    diffuse = quality.diffuse > 0
    return World(scene, device, samples=samples, integral=integral, diffuse=diffuse)


@contextmanager
def _timed(seconds: dict[str, float], stage: str, tell: Progress) -> Iterator[None]:
    tell(stage)
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def resolve_frequency(scene: Scene, frequency: float | Tensor | None) -> Float[Tensor, "f"]:
    """The frequencies asked for [Hz]; without any, those of the transmitters, or the scene's."""
    if frequency is None:
        own = {r.frequency for r in scene.transmitters if r.frequency is not None}
        if len(own) > 1:
            raise SceneError(
                ["frequency: the transmitters name several; say which, e.g. frequency=2.44e9"]
            )
        frequency = own.pop() if own else scene.frequency
    if frequency is None:
        raise SceneError(
            ["frequency: neither given nor in the scene (rfsg:frequencyHz); e.g. frequency=2.44e9"]
        )
    asked = torch.as_tensor(frequency, dtype=torch.float64).reshape(-1)
    if not len(asked) or not bool((torch.isfinite(asked) & (asked > 0)).all()):
        raise SceneError([f"frequency: expected positive finite hertz, got {frequency!r}"])
    return asked


def positions(radios: tuple[Radio, ...], device: torch.device | str) -> Float[Tensor, "n 3"]:
    """Radio positions stacked [m]; SceneError for one that is not finite."""
    if not radios:
        return torch.zeros(0, 3, dtype=torch.float64, device=device)
    position = torch.stack([r.position.to(device=device, dtype=torch.float64) for r in radios])
    finite = torch.isfinite(position).all(-1).tolist()
    bad = [r.path for r, good in zip(radios, finite, strict=True) if not good]
    if bad:
        raise SceneError([f"{path}: position is not finite" for path in bad])
    return position


def _above_floor(
    paths: Paths, channel: Channel, counts: dict[Status, int], quality: Quality
) -> tuple[Paths, Channel, dict[Status, int]]:
    """Drop what is opaque or below the floor, and count it.

    Where radios are polarised the Jones matrix decides: a path that the reference ports do not see
    (two +45 slants that face each other) is the whole channel of other ports. The tiles of one
    object, which are shares of one path, count together.
    """
    wavelength = SPEED_OF_LIGHT / channel.frequency
    free = wavelength[None] / (4 * math.pi) / paths.length.clamp(min=1e-300)[:, None]
    strength = channel.gain.abs() if channel.jones is None else channel.jones.abs().amax((2, 3))
    loss = scatter.together(paths, (strength.detach() / free.detach()).amax(1))
    weak = loss < 10.0 ** (quality.floor_db / 20.0)
    drop = weak | channel.blocked
    keep = torch.nonzero(~drop).squeeze(-1)
    counts = dict(counts)
    for status, n in (
        (Status.OPAQUE, int(channel.blocked.sum())),
        (Status.BELOW_FLOOR, int((weak & ~channel.blocked).sum())),
    ):
        if n:
            counts[status] = counts.get(status, 0) + n
    for status in (Status.OK, Status.CAUSTIC_CAPPED):
        if status in counts:
            counts[status] = int((paths.status[keep] == int(status)).sum())
    number = torch.full((len(drop),), -1, dtype=torch.int64, device=drop.device)
    number[keep] = torch.arange(len(keep), device=drop.device)
    crossed = channel.crossed[~drop[channel.crossed[:, 0]]]
    crossed = torch.cat([number[crossed[:, :1]], crossed[:, 1:]], -1)
    paths = paths.take(keep)
    per_path = [
        n for n in Channel.__dataclass_fields__ if n not in ("frequency", "crossed", "jones")
    ]
    kept = {n: getattr(channel, n)[keep] for n in per_path}
    kept["jones"] = None if channel.jones is None else channel.jones[keep]
    return paths, replace(channel, crossed=crossed, **kept), counts
