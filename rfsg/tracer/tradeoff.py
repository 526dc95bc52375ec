"""Error against time, measured on the user's own scene: a grid of settings beside the best of them.

The best is ``reference`` where time allows, else the highest rung of the ladder (``ladder.RUNGS``)
that was done; the result says which. Every error is against it, so that what it lacks itself is not
seen. Times and memory are this machine's, of these runs.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

from rfsg.objects.shapes.band import WAYS
from rfsg.objects.shapes.kept import BAKE_AFTER, baked_if_it_pays
from rfsg.scene.scene import Scene
from rfsg.tracer.compared import Difference, Seen, difference, see
from rfsg.tracer.ladder import effective, ladder
from rfsg.tracer.launch import search_options
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import Result, resolve_frequency, simulate

RUNS = 3  # of a setting that is quick; its time is their median
QUICK = 1.0  # [s] what is quick
FOR_TRUTH = 0.6  # share of the time for the reference; the rest is for the grid
BASE = "base"
Progress = Callable[[str], None]

# one at a time, from the base; the values of a field that the base has are left out
VARIATIONS: dict[str, tuple[Any, ...]] = {
    "crossing_samples": (4, 64),
    "zone_rings": (1, 4),
    "refits": (4, 8),
    "floor_db": (-30.0, -50.0, -120.0),
    "refraction": (False,),
    "diffraction_depth": (1, 3),
    "curved": (0, 2),
    "curved_depth": (1, 3),
    "depth": (1, 2, 4, 5),
    "diffraction": (0, 1, 2),
}
# these mean something only together
INTEGRALS: tuple[dict[str, Any], ...] = (
    {"integral": "riemann", "crossing_samples": 16},
    {"integral": "riemann", "crossing_samples": 128},
)
BY_RAYS: tuple[dict[str, Any], ...] = (
    {"search": "rays", "rays": 2_000},
    {"search": "rays", "rays": 20_000},
    {"search": "rays", "rays": 20_000, "epsilon": 0.001},
    {"search": "rays", "rays": 20_000, "epsilon": 0.05},
)
# where shapes are learned: at first a march on the network itself, as for any fewer rays; from BAKE_AFTER
# on they are baked
MEETINGS: tuple[dict[str, Any], ...] = (
    {"search": "rays", "rays": BAKE_AFTER - 1},
    *({"search": "rays", "rays": BAKE_AFTER, "intersection": way} for way in WAYS),
)
# what one more of a field multiplies the time by, nearly, and how many rays take the time of all else:
# they order the grid, and nothing is begun that would take longer than is left
DEARER = {"depth": 2.0, "diffraction": 9.0, "diffraction_depth": 2.5, "curved_depth": 2.0}
RAYS_ALIKE = 20_000
PRODUCT = ("depth", "diffraction", "curved_depth")  # of ``grid="full"``, every combination


@dataclass(frozen=True)
class Outcome:
    """One setting on the scene: what it cost, and its error against the reference.

    changed: the fields that differ from the base. seconds: median of ``runs``. peak_mib: largest
    size of the whole process during the runs; None where the system does not tell. complete: the
    search was an enumeration. moved_db: how far path gain lies from that of the base, at 90 % of
    links: what the change alone does, whatever both lack. front: no other setting is both quicker
    and more accurate.
    """

    setting: str
    changed: dict[str, Any]
    seconds: float
    runs: int
    peak_mib: float | None
    paths: int
    complete: bool
    error: Difference
    moved_db: float
    front: bool = False

    @property
    def missed_db(self) -> float:
        """Power in paths that the setting lacks, over all of the reference's [dB]; -inf for none."""
        return 10.0 * math.log10(self.error.missed) if self.error.missed > 0.0 else -math.inf


@dataclass(frozen=True)
class Tradeoff:
    """All settings that were run, quickest first; ``recommended`` is the name of one, or None."""

    scene: Scene
    frequency: float
    links: int
    reference: str
    truth_is_reference: bool
    accuracy_db: float
    outcomes: tuple[Outcome, ...]
    left_out: tuple[str, ...]
    recommended: str | None

    def sentence(self) -> str:
        """What the errors are against, and what is recommended."""
        against = f"errors are against {self.reference!r}"
        against += "" if self.truth_is_reference else ", the best that time allowed"
        if self.recommended is None:
            return f"{against}; no other setting is within {self.accuracy_db:g} dB at 90 % of links"
        best = next(o for o in self.outcomes if o.setting == self.recommended)
        return (
            f"{against}; recommended for {self.accuracy_db:g} dB: {best.setting} "
            f"({best.error.gain_90_db:.2g} dB at 90 % of links, {best.seconds:.2g} s)"
        )


def tradeoff(
    scene: Scene,
    frequency: float | None = None,
    *,
    base: str | Quality = "standard",
    grid: str = "small",
    budget_s: float = 300.0,
    accuracy_db: float = 1.0,
    device: str = "cpu",
    progress: Progress | None = None,
    run: Callable[..., Result] = simulate,
) -> Tradeoff:
    """Run a grid of settings on a scene, and say what each costs and lacks.

    base: the setting that single fields are changed of. grid: "small", the ladder and one change at
    a time, those first that are expected to be quick; "full", besides every combination of depth,
    diffraction and curved_depth. budget_s: no setting is begun that is not expected to fit [s]; one
    under way is left at the next stage once time is up. Raises ValueError for another grid or a budget
    that is not positive.
    """
    if grid not in ("small", "full"):
        raise ValueError(f"grid {grid!r}: expected small or full")
    if not 0.0 < budget_s < math.inf:
        raise ValueError(f"budget_s={budget_s!r}: expected positive finite seconds")
    base = Quality.named(base) if isinstance(base, str) else base
    done = _Runs(scene, frequency, budget_s, device, progress, run)
    name = done.climb()
    if name is None:
        raise ValueError(f"budget_s={budget_s:g}: not even the cheapest setting was done by then")
    done.grid(base, grid)
    truth = done.seen[name]
    outcomes = with_front([done.outcome(setting, truth, base) for setting in done.seen])
    pick = recommend([o for o in outcomes if o.setting != name], accuracy_db)
    top = ladder(scene)[-1].name
    carrier = float(resolve_frequency(scene, frequency)[0])
    said = tuple(done.left_out)
    return Tradeoff(
        scene, carrier, truth.power.numel(), name, name == top, accuracy_db, outcomes, said, pick
    )


def with_front(outcomes: Sequence[Outcome]) -> tuple[Outcome, ...]:
    """The outcomes, quickest first, those marked that nothing quicker is as accurate as."""
    best, marked = math.inf, []
    for one in sorted(outcomes, key=lambda o: (o.seconds, o.error.gain_90_db)):
        marked.append(replace(one, front=one.error.gain_90_db < best))
        best = min(best, one.error.gain_90_db)
    return tuple(marked)


def recommend(outcomes: Sequence[Outcome], accuracy_db: float) -> str | None:
    """The quickest setting with 90 % of links within an accuracy [dB]; None if there is none."""
    enough = [o for o in outcomes if o.error.gain_90_db <= accuracy_db]
    return min(enough, key=lambda o: o.seconds).setting if enough else None


def settings(base: Quality, grid: str, learned: bool = True) -> list[tuple[str, Quality]]:
    """Names and qualities: the base, then one change at a time, and with "full" the product, those
    first that are expected to be quick (``times``). learned: with the ways to meet learned shapes."""
    changes = [{name: value} for name, values in VARIATIONS.items() for value in values]
    changes = [*INTEGRALS, *changes, *BY_RAYS, *(MEETINGS if learned else ())]
    if grid == "full":
        ranges = [range(1, 6), range(3), range(1, 4)]
        changes += [dict(zip(PRODUCT, v, strict=True)) for v in product(*ranges)]
    named = [
        (", ".join(f"{k} {v}" for k, v in change.items()), replace(base, **change))
        for change in changes
        if any(getattr(base, k) != v for k, v in change.items())
    ]
    return [(BASE, base), *sorted(named, key=lambda one: times(one[1], base))]


def times(quality: Quality, base: Quality) -> float:
    """How many times as long as the base a setting is expected to take: a guess, by ``DEARER``."""
    steps = {name: getattr(quality, name) - getattr(base, name) for name in DEARER}
    factor = math.prod(DEARER[name] ** steps[name] for name in DEARER)
    return factor * _launched(quality) / _launched(base)


def _launched(quality: Quality) -> float:
    return 1.0 + quality.rays / RAYS_ALIKE if quality.search == "rays" else 1.0


def changed(quality: Quality, base: Quality) -> dict[str, Any]:
    """The fields in which a quality differs from the base."""
    pairs = ((f.name, getattr(quality, f.name)) for f in fields(Quality))
    return {name: value for name, value in pairs if value != getattr(base, name)}


class OutOfTime(Exception):
    """The time for a setting is up."""


class _Runs:
    """What was run: results, times and memory by setting, and what was not run and why."""

    def __init__(
        self,
        scene: Scene,
        frequency: float | None,
        budget_s: float,
        device: str,
        progress: Progress | None,
        run: Callable[..., Result],
    ):
        self.scene, self.frequency, self.budget_s = scene, frequency, budget_s
        self.device, self.tell, self.run = device, progress or (lambda _: None), run
        self.start = time.perf_counter()
        self.seen: dict[str, Seen] = {}
        self.quality: dict[str, Quality] = {}
        self.cost: dict[str, tuple[float, int, float | None]] = {}  # seconds, runs, peak MiB
        self.left_out: list[str] = []
        self.base: str | None = None  # what the base stands under

    def climb(self) -> str | None:
        """Rung after rung of the ladder, while the next is expected to fit; the last one done."""
        top, share = None, FOR_TRUTH * self.budget_s
        for rung in ladder(self.scene):
            expected = 0.0 if top is None else rung.dearer * self.cost[top][0]
            if top is not None and self.spent() + expected > share:
                self.left_out.append(
                    f"{rung.name}: would take some {expected:.2g} s, by the ladder"
                )
                break
            if self.one(rung.name, rung.quality, share) is None:
                break
            top = rung.name
        return top

    def grid(self, base: Quality, grid: str) -> None:
        """The base, and what is changed of it, each setting that is expected to fit."""
        learned = not all(node.body.shape.exact for node in self.scene.nodes)
        for setting, quality in settings(base, grid, learned):
            one = 0.0 if self.base is None else self.cost[self.base][0]
            found = self.one(setting, quality, self.budget_s, one * times(quality, base))
            self.base = found if setting == BASE else self.base

    def one(
        self, setting: str, quality: Quality, until: float, expected: float = 0.0
    ) -> str | None:
        """Run one setting, unless an equal one was; the name that it stands under, or None where it
        would take until after ``until`` [s] or did."""
        asked = effective(quality, self.scene)
        same = next((n for n, q in self.quality.items() if effective(q, self.scene) == asked), None)
        if same is not None:
            self.left_out.append(f"{setting}: the same as {same!r} on this scene")
            return same
        left = until - self.spent()
        if expected > left or left < 0.0:
            would = f"would take some {expected:.2g} s, and {left:.2g} s of the time were left"
            self.left_out.append(f"{setting}: {would if left > 0.0 else 'no time left'}")
            return None
        self.tell(setting)
        self._bake(asked)
        seconds: list[float] = []
        found: Result | None = None
        try:
            with peak_memory() as peak:
                if not self.seen:  # what a process pays once belongs to no setting
                    self._simulate(quality, until)
                while not seconds or (len(seconds) < RUNS and sum(seconds) < QUICK):
                    begin = time.perf_counter()
                    found = self._simulate(asked, until)
                    seconds.append(time.perf_counter() - begin)
        except OutOfTime:
            if found is None:
                self.left_out.append(f"{setting}: time was up while it ran")
                return None
        assert found is not None
        self.seen[setting], self.quality[setting] = see(found), quality
        self.cost[setting] = (statistics.median(seconds), len(seconds), peak[0])
        return setting

    def _bake(self, quality: Quality) -> None:
        """What rays need of learned shapes: it is kept beside them, and belongs to no setting."""
        if quality.search == "rays":
            rays = search_options(quality, quality.rays).rays
            for shape in {id(n.body.shape): n.body.shape for n in self.scene.nodes}.values():
                baked_if_it_pays(shape, rays)

    def outcome(self, setting: str, truth: Seen, base: Quality) -> Outcome:
        """A setting's cost, and its error against the truth."""
        seen, fields_changed = self.seen[setting], changed(self.quality[setting], base)
        error = difference(seen, truth)
        cost = self.cost[setting]
        moved = math.inf
        if self.base is not None:
            moved = difference(seen, self.seen[self.base]).gain_90_db
        return Outcome(setting, fields_changed, *cost, seen.count, seen.complete, error, moved)

    def spent(self) -> float:
        return time.perf_counter() - self.start

    def _simulate(self, quality: Quality, until: float) -> Result:
        def stage(_: str) -> None:
            if self.spent() > until:
                raise OutOfTime

        options = {"device": self.device, "progress": stage}
        return self.run(self.scene, self.frequency, quality, **options)


@contextmanager
def peak_memory() -> Iterator[list[float | None]]:
    """A list that holds the largest resident size of the process within [MiB], once it is over.

    Linux tells it (``VmHWM``, reset by ``clear_refs``: proc(5)); elsewhere None.
    """
    found: list[float | None] = []
    try:
        Path("/proc/self/clear_refs").write_text("5")
        known = True
    except OSError:
        known = False
    try:
        yield found
    finally:
        found.append(_high_water() if known else None)


def _high_water() -> float | None:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024.0
    return None
