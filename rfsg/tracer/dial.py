"""The dial: the cheapest setting that is accurate enough, or the most accurate that is quick enough.

Settings stand on a ladder, each more thorough and dearer than the one before; the last is
``reference``. Pilot runs over a few receivers climb it. Rung k is compared with the rungs above it,
and what the highest rung tried still lacks is extrapolated from how the steps shrink (``ladder.estimate``).

What is promised: of the scene's links, 90 % have a path gain within ``accuracy_db`` of that of
``reference``. It is an estimate from pilots and not a proof; ``benchmarks/dial.py`` counts over
random scenes how often it holds. What only the rungs above the last one tried can see at all, such
as a link that nothing reaches below ``reference``, an estimate cannot see either.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.scene.scene import Scene, SceneError
from rfsg.tracer import representation
from rfsg.tracer.ladder import estimate, ladder, responses
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import Result, resolve_frequency, simulate

PILOTS = 6  # receivers of a pilot run; scenes with up to twice as many are climbed as a whole
TIMED = 3  # the same where only time is asked for
FOR_WAYS = 0.25  # share of the accuracy that stand-ins of learned objects may take
HEADROOM = 1.3  # a predicted time is taken to be this much longer
Simulate = Callable[..., Result]


@dataclass(frozen=True)
class Trial:
    """A rung that was run on the pilots: how long it took, and its estimated error.

    error_db: not exceeded on 90 % of links, as estimated when the climb ended; inf where a link is
    heard by a higher rung alone. predicted_s: for all receivers, from this pilot.
    """

    rung: str
    seconds: float
    predicted_s: float
    error_db: float


@dataclass(frozen=True)
class Choice:
    """What the dial chose, and why. ``accuracy_db`` and ``budget_s`` are what was asked, or None."""

    rung: str
    quality: Quality
    error_db: float
    accuracy_db: float | None
    budget_s: float | None
    pilots: int
    receivers: int
    tried: tuple[Trial, ...]
    left_out: tuple[str, ...]  # rungs above the chosen one, each with the reason
    seconds: float  # all of it, pilots included

    @property
    def met(self) -> bool:
        """Whether the estimated error is within what was asked; true where nothing was."""
        return self.accuracy_db is None or self.error_db <= self.accuracy_db

    def sentence(self) -> str:
        """For ``Plan.modelled``."""
        tried = ", ".join(
            f"{t.rung} {_decibel(t.error_db)} in {t.seconds:.2g} s" for t in self.tried
        )
        asked = [] if self.accuracy_db is None else [f"{self.accuracy_db:g} dB"]
        asked += [] if self.budget_s is None else [f"{self.budget_s:g} s"]
        return (
            f"setting {self.rung!r}, chosen for {' and '.join(asked)}: estimated error "
            f"{_decibel(self.error_db)} of path gain at 90 % of links against reference; "
            f"tried on {self.pilots} of {self.receivers} receivers: {tried}"
        )


def simulate_within(
    scene: Scene,
    frequency: float | Tensor | None = None,
    *,
    accuracy_db: float | None = None,
    budget_s: float | None = None,
    **options: Any,
) -> Result:
    """``simulate`` at the setting that meets an accuracy, a budget, or both; see ``within``."""
    return within(scene, frequency, accuracy_db=accuracy_db, budget_s=budget_s, **options)[0]


def within(
    scene: Scene,
    frequency: float | Tensor | None = None,
    *,
    accuracy_db: float | None = None,
    budget_s: float | None = None,
    seed: int = 0,
    run: Simulate = simulate,
    **options: Any,
) -> tuple[Result, Choice]:
    """The channel at a chosen setting, and the choice.

    accuracy_db: the cheapest setting whose estimated error is below it [dB of path gain, at 90 % of
    links]. budget_s: the most accurate that is predicted to be done by then [s]; the cheapest rung is
    always run, so that there is always a result. With both, accuracy is sought while time lasts.
    seed: which receivers are pilots. run: what simulates; options go to it. Raises ValueError for
    neither, for numbers that are not positive, or with ``chains``; SceneError as ``simulate`` does.
    """
    for name, value in (("accuracy_db", accuracy_db), ("budget_s", budget_s)):
        if value is not None and not 0.0 < value < math.inf:
            raise ValueError(f"{name}={value!r}: expected a positive finite number")
    if accuracy_db is None and budget_s is None:
        raise ValueError("the dial: give accuracy_db (such as 1.0), budget_s (such as 2.0) or both")
    if options.get("chains") is not None:
        raise ValueError("the dial searches at every setting: chains of one cannot be given")
    if not scene.receivers or not scene.transmitters:
        raise SceneError(["the dial needs a transmitter and a receiver to try settings on"])
    carrier = resolve_frequency(scene, frequency)
    climb = _Climb(scene, carrier, accuracy_db, budget_s, seed, run, options)
    return climb.end()


class _Climb:
    """The rungs tried on pilots so far, and the results in hand."""

    def __init__(
        self,
        scene: Scene,
        carrier: Float[Tensor, "f"],
        accuracy_db: float | None,
        budget_s: float | None,
        seed: int,
        run: Simulate,
        options: dict[str, Any],
    ):
        self.start = time.perf_counter()
        self.scene, self.carrier = scene, carrier
        self.accuracy_db, self.budget_s = accuracy_db, budget_s
        self.run, self.options = run, options
        self.ladder = ladder(scene)
        self.way_db, self.ways = 0.0, ()
        if accuracy_db is not None:
            self._represent(accuracy_db * FOR_WAYS)
        chosen = pilots(scene, TIMED if accuracy_db is None else PILOTS, seed)
        self.whole = len(chosen) == len(scene.receivers)
        self.pilot = scene.with_receivers([scene.receivers[i] for i in chosen])
        self.heard: list[Complex[Tensor, "t r k"]] = []
        self.seconds: list[float] = []
        self.result: Result | None = None  # over all receivers, of rung ``held``
        self.held = -1
        self.factor = len(scene.receivers) / len(chosen)  # no receiver takes longer than a pilot

    def _represent(self, accuracy_db: float) -> None:
        """Meet learned objects in the cheapest way that is accurate enough, on every rung."""
        wavelength, nodes = SPEED_OF_LIGHT / float(self.carrier[0]), self.scene.nodes
        self.ways = representation.told(nodes, wavelength, accuracy_db)
        if all(node.body.shape.exact for node in nodes):
            return
        way = representation.strictest(nodes, wavelength, accuracy_db)
        self.way_db = accuracy_db
        self.ladder = tuple(
            replace(rung, quality=replace(rung.quality, intersection=way)) for rung in self.ladder
        )

    def end(self) -> tuple[Result, Choice]:
        """Climb, run the chosen rung on all receivers, and say what was done."""
        if self.budget_s is not None and not self.whole:
            self._run_all(0)  # in hand, whatever comes
        self._try(0)
        left_out = self._climb()
        chosen = self._choice()
        while chosen > self.held and not self._affords(self.factor * self.seconds[chosen]):
            needs = f"needs {self.factor * self.seconds[chosen]:.2g} s for all receivers"
            left_out.insert(0, f"{self.ladder[chosen].name}: {needs}")
            chosen -= 1
        chosen = max(chosen, self.held)
        if chosen != self.held:
            self._run_all(chosen)
        return self._said(chosen, tuple(left_out))

    def _climb(self) -> list[str]:
        """Try rung after rung until one is accurate enough; returns what there was no time for."""
        while not self._enough():
            k = len(self.seconds)
            if k == len(self.ladder):
                break
            pilot = self.ladder[k].dearer * self.seconds[-1]
            kept = 0.0 if self.whole else self.factor * self.seconds[-1]  # for the rung before
            if not self._affords(pilot + kept):
                return [f"{rung.name}: no time left to try it" for rung in self.ladder[k:]]
            self._try(k)
        return []

    def _try(self, k: int) -> None:
        """Rung k on the pilots; where they are all receivers, it is the result in hand."""
        options = self.options if self.whole else self.options | {"gradients": False}
        start = time.perf_counter()
        found = self.run(self.pilot, self.carrier, self.ladder[k].quality, **options)
        self.seconds.append(time.perf_counter() - start)
        self.heard.append(responses(found))
        if self.whole:
            self.result, self.held = found, k

    def _run_all(self, k: int) -> None:
        self.result = self.run(self.scene, self.carrier, self.ladder[k].quality, **self.options)
        self.held = k

    def errors(self) -> list[float]:
        """Estimated error of each rung tried [dB]."""
        qualities = [rung.quality for rung in self.ladder]
        complete = len(self.heard) == len(self.ladder)
        return [error + self.way_db for error in estimate(self.heard, qualities, complete)]

    def _choice(self) -> int:
        """The cheapest rung that is accurate enough; else the most accurate one tried."""
        if self.accuracy_db is not None and not self.whole:
            for k, error in enumerate(self.errors()):
                if error <= self.accuracy_db:
                    return k
        return len(self.seconds) - 1

    def _enough(self) -> bool:
        return self.accuracy_db is not None and min(self.errors()) <= self.accuracy_db

    def _left(self) -> float:
        spent = time.perf_counter() - self.start
        return math.inf if self.budget_s is None else self.budget_s - spent

    def _affords(self, seconds: float) -> bool:
        return HEADROOM * seconds <= self._left()

    def _said(self, chosen: int, left_out: tuple[str, ...]) -> tuple[Result, Choice]:
        assert self.result is not None
        tried = tuple(
            Trial(rung.name, seconds, seconds * self.factor, error)
            for rung, seconds, error in zip(self.ladder, self.seconds, self.errors(), strict=False)
        )
        rung = self.ladder[chosen]
        choice = Choice(
            rung.name,
            rung.quality,
            tried[chosen].error_db,
            self.accuracy_db,
            self.budget_s,
            len(self.pilot.receivers),
            len(self.scene.receivers),
            tried,
            left_out,
            time.perf_counter() - self.start,
        )
        plan = self.result.plan.with_((choice.sentence(), *self.ways), left_out)
        return replace(self.result, plan=plan), choice


def pilots(scene: Scene, count: int, seed: int = 0) -> list[int]:
    """Receivers to try settings on, in scene order: the first at random, each next one farthest from
    those chosen; all of them where that saves less than half."""
    place = torch.stack([radio.position.detach().double() for radio in scene.receivers])
    if len(place) <= 2 * count:
        return list(range(len(place)))
    generator = torch.Generator().manual_seed(seed)
    chosen = [int(torch.randint(len(place), (1,), generator=generator))]
    distance = (place - place[chosen[0]]).norm(dim=-1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (place - place[chosen[-1]]).norm(dim=-1))
    return sorted(chosen)


def _decibel(value: float) -> str:
    return f"{value:.2g} dB" if math.isfinite(value) else "unknown"
