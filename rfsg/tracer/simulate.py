"""From a scene to its channel, the stages in order: plan, search, solve, field."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.objects.displayed import Displayed
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer import incremental, scatter, validity
from rfsg.tracer.channel import Link, links, transfer
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.incremental import Redone
from rfsg.tracer.kept import Kept
from rfsg.tracer.labelled import channel_dataset, links_frame, paths_frame
from rfsg.tracer.launch import SearchReport
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
from rfsg.tracer.stages import Candidates, Run, candidates

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Result(Displayed):
    """Everything about one simulation. ``paths`` and ``channel`` share their path axis.

    peak_bytes: the most memory in use when it ended (``memory.peak_bytes``). redone: how much of it was
    new, where it went on from an earlier one; kept: what the next may go on from (``after``).
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
    redone: Redone | None = None
    kept: Kept | None = field(default=None, repr=False, compare=False)

    def after(self, scene: Scene, progress: Progress | None = None) -> "Result":
        """The same question about an edited scene: only what the edit changes is done again.

        result.after(result.scene.moved("/World/Cabinet", (1.0, 0.0, 0.0)))
        """
        return simulate(scene, previous=self, progress=progress)

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

    def to_xarray(self) -> Any:
        """The channel as an xarray.Dataset; see ``labelled.channel_dataset``."""
        return channel_dataset(self)

    def to_pandas(self, what: str = "paths") -> Any:
        """A pandas.DataFrame: "paths", a row each as in paths.csv, or "links", as in links.csv.

        Raises ValueError for another word."""
        frames = {"paths": paths_frame, "links": links_frame}
        if what not in frames:
            raise ValueError(f"{what!r}: expected one of {', '.join(frames)}")
        return frames[what](self)

    def to_usd(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the paths as curves, coloured by gain at the first frequency, in a layer over the
        scene's source; see ``rfsg.scene.usd.results.write_paths``."""
        from rfsg.scene.usd.results import write_paths
        from rfsg.tracer.drawing import path_lines

        lines = path_lines(self)
        gain_db = np.array([line.gain_db for line in lines])
        delay_s = np.array([line.delay_ns for line in lines]) * 1e-9
        points = [line.points for line in lines]
        return write_paths(self.scene, path, points, gain_db, delay_s, overwrite)

    def __repr__(self) -> str:
        hertz = ", ".join(f"{f / 1e9:g}" for f in self.frequency.tolist())
        return f"{len(self.paths.tx)} paths in a {self.scene!r} at {hertz} GHz"


def simulate(
    scene: Scene,
    frequency: float | Tensor | None = None,
    quality: str | Quality | None = None,
    *,
    previous: Result | None = None,
    accuracy_db: float | None = None,
    budget_s: float | None = None,
    gradients: bool = False,
    chains: Chains | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Result:
    """Exact paths and the channel between all transmitters and receivers of a scene.

    frequency: [Hz], one or several [f]; None takes those of ``previous``, else the transmitters' or the
    scene's own. quality: None takes that of ``previous``, else "standard". previous: an earlier result:
    what is as it was then is kept, and the answer is a full run's, to 1e-9 of each gain
    (``incremental``; ``result.redone`` and the plan say how much was done again).
    accuracy_db, budget_s: choose the setting by pilot runs, in place of ``quality``: the cheapest that
    is accurate enough, the most accurate within the time (``dial.within``). gradients: keep the graph,
    so that ``result.channel`` differentiates with respect to poses, radio positions, shapes, materials
    and weights that require it. chains: candidates kept from an earlier result (the search is skipped).
    Raises SceneError without a frequency or with broken radios, ValueError for ``previous`` beside what
    it cannot serve.
    """
    if previous is not None:
        asked = {"accuracy_db": accuracy_db is not None, "budget_s": budget_s is not None}
        asked |= {"gradients": gradients, "chains": chains is not None}
        wrong = [name for name, given in asked.items() if given]
        if wrong:
            raise ValueError(
                f"previous= beside {wrong[0]}=: what is kept of an earlier simulation holds no "
                f"gradients and is of one quality; leave one of the two out"
            )
        frequency = previous.frequency if frequency is None else frequency
        quality = previous.plan.quality if quality is None else quality
    quality = "standard" if quality is None else quality
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
        run = Run(world, proxies, tx, rx, frequencies, quality)
        with _timed(seconds, "search", tell):
            before, why = incremental.since(previous.kept, run) if previous else (None, None)
            if chains is None:
                found = candidates(run, before)
                plan = plan.with_((found.report.sentence(),))
            else:
                found = Candidates(chains, run.none(), SearchReport(), searched=False)
        with _timed(seconds, "solve", tell):
            done = incremental.solved(run, found, before)
            for stage in done.stages:
                plan = plan.with_(stage.modelled, stage.left_out)
        with _timed(seconds, "field", tell):
            everything = incremental.fielded(run, done.stages, done.around.edges, before)
            paths, channel, counts = _above_floor(
                everything.paths, everything.channel, done.counts, quality
            )
    redone = None
    if previous is not None:
        redone = Redone.of(done, everything)
        said = (
            redone.sentence() if why is None else f"a full run, nothing of the earlier kept: {why}"
        )
        plan = plan.with_((said,))
    keeps = not gradients and chains is None
    kept = incremental.keep(run, done, everything) if keeps else None
    named = {s.name: n for s, n in sorted(counts.items())}
    warnings = (*scene.warnings, *validity.sentences(world, frequencies))
    return Result(
        scene,
        frequencies,
        paths,
        channel,
        done.mirrors.chains,
        plan,
        found.report,
        named,
        seconds,
        warnings,
        peak_bytes(device),
        redone,
        kept,
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
