"""Objects learned in room A, then moved, put into room B, and copied: what each method still knows.

Truth and predictions are stored as JSON as soon as they are there; a run that was killed goes on.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

import rfsg
from learn.methods import code
from learn.moved_methods import (
    INTERPOLATORS,
    OBJECTS,
    ROOM,
    STARTS,
    blank,
    learned,
    learned_room,
    with_node,
)
from learn.moved_rooms import HEARD, NEW, SITUATIONS, THINGS, Asked, Layout
from learn.store import write
from rfsg.learn.baselines import Predictor, UnheardGatewayError

ROOMS_CODE = hashlib.sha256(code(Path(__file__).with_name("moved_rooms.py")).encode()).hexdigest()
# `reference` but for three reflections instead of five, and sequences of faces enumerated (nothing
# can be missed) instead of 200 000 rays: what can be computed for thousands of links.
TRUTH = rfsg.Quality.named("reference", depth=3, curved_depth=2, diffraction=1, search="enumerate")
TEST, TRAINING = 0, 1  # draws of links


OURS, TWICE, WHOLE_ROOM = "rfsg", "rfsg, two starts", "one network for the room"
BLANK, KNOWN, EMPTY_ROOM = "rfsg, not learned", "true materials", "no objects"
UNTRAINED = (EMPTY_ROOM, BLANK, KNOWN)
RETRAINED = ", retrained"
METHODS = (
    OURS,
    TWICE,
    WHOLE_ROOM,
    *INTERPOLATORS,
    *(name + RETRAINED for name in INTERPOLATORS),
    *UNTRAINED,
)

Said = dict[str, dict[str, list[float] | None]]  # situation, kind of links -> path gains [dB]


@dataclass(frozen=True)
class Plan:
    """Which seeds see how many readings; ``asked``: test links of each kind and situation."""

    counts: dict[int, tuple[int, ...]]
    noises_db: tuple[float, ...] = (2.0, 0.0)
    asked: int = 60

    def cases(self) -> Iterator["Case"]:
        for seed, counts in self.counts.items():
            for count in counts:
                for noise in self.noises_db:
                    yield Case(seed, count, noise, max(counts), self.asked)


@dataclass(frozen=True)
class Case:
    """``count`` readings with normal noise [dB], the first of ``pool`` drawn for the seed."""

    seed: int
    count: int
    noise_db: float
    pool: int
    asked: int

    @property
    def name(self) -> str:
        return f"seed{self.seed}-{self.count}-{self.noise_db:g}dB"

    @property
    def layout(self) -> Layout:
        return Layout(self.seed)


# truth


@dataclass(frozen=True)
class Truth:
    """Links and their true path gain [dB], with the objects and without."""

    links: Asked
    gain_db: Float[ndarray, "n"]
    without_db: Float[ndarray, "n"]


def truth(layout: Layout, situation: str, kind: str, count: int, draw: int, work: Path) -> Truth:
    """As simulated at TRUTH; stored. draw: TEST or TRAINING."""
    links = layout.asked(situation, kind, count, draw)
    name = f"seed{layout.seed}-{situation}-{kind}-{count}-{draw}".replace(" ", "_")
    path = keyed(work / "truth", name, TRUTH, ROOMS_CODE)
    if not path.is_file():
        begin = time.perf_counter()
        gain = gains(layout.truth(situation), links, TRUTH).tolist()
        without = gains(layout.scene(situation, {}), links, TRUTH).tolist()
        seconds = time.perf_counter() - begin
        known = {"gain_db": gain, "without_db": without, "seconds": seconds}
        write(path, json.dumps(known) + "\n")
    found = json.loads(path.read_text())
    return Truth(links, np.array(found["gain_db"]), np.array(found["without_db"]))


def gains(scene: rfsg.Scene, links: Asked, quality: rfsg.Quality) -> Float[ndarray, "n"]:
    """Path gain [dB]: the sum of the paths' powers, which is the mean over their phases."""
    return rfsg.predict(scene, links.measured(), quality, coherent=False).path_gain_db().numpy()


def tests(case: Case, work: Path) -> dict[str, dict[str, Truth]]:
    """Situation, kind of links -> links that no method learns from."""
    return {
        situation: {
            kind: truth(case.layout, situation, kind, case.asked, TEST, work)
            for kind in (HEARD, NEW)
        }
        for situation in SITUATIONS
    }


def training(case: Case, situation: str, work: Path) -> tuple[Asked, Float[ndarray, "n"]]:
    """Links to the heard gateways and their noisy path gains [dB]."""
    count = case.pool if situation == SITUATIONS[0] else case.count
    whole = truth(case.layout, situation, HEARD, count, TRAINING, work)
    draw = np.random.default_rng([case.seed, 4, SITUATIONS.index(situation)])
    noisy = whole.gain_db + case.noise_db * draw.standard_normal(len(whole.links))
    return whole.links.first(case.count), noisy[: case.count]


# methods


def compute(cases: Iterable[Case], methods: Sequence[str], work: Path) -> None:
    """Every method on every case; what is stored is not computed again."""
    for case in cases:
        for method in methods:
            if not place(case, method, work).is_file():
                _, seconds = predictions(case, method, work)
                print(f"{case.name} {method}: {seconds:.1f} s", flush=True)


def predictions(case: Case, method: str, work: Path) -> tuple[Said, float]:
    """What a method says of all test links, and how long it took [s]; stored.

    None instead of path gains: it cannot say (it never heard the gateway).
    """
    path = place(case, method, work)
    if not path.is_file():
        tests(case, work)  # the truth, whose time is not the method's
        training(case, "before", work)
        begin = time.perf_counter()
        said = _predicted(case, method, work)
        write(path, json.dumps({"said": said, "seconds": time.perf_counter() - begin}) + "\n")
    found = json.loads(path.read_text())
    return found["said"], found["seconds"]


def place(case: Case, method: str, work: Path) -> Path:
    """File of a result; one of other settings, rooms or truth is another."""
    if method in UNTRAINED:
        case = replace(case, count=0, noise_db=0.0)
    budgets: dict[str, object] = {OURS: OBJECTS, TWICE: (OBJECTS, STARTS), WHOLE_ROOM: ROOM}
    budgets |= dict.fromkeys(UNTRAINED, OBJECTS.quality)
    folder = work / method.replace(" ", "_").replace(",", "")
    return keyed(folder, case.name, case, TRUTH, budgets.get(method), ROOMS_CODE)


def keyed(folder: Path, name: str, *key: object) -> Path:
    digest = hashlib.sha256(repr(key).encode()).hexdigest()
    return folder / f"{name}-{digest[:12]}.json"


def _predicted(case: Case, method: str, work: Path) -> Said:
    layout = case.layout
    if method == EMPTY_ROOM:
        return from_scenes(case, lambda s: layout.scene(s, {}), OBJECTS.quality)
    if method in (OURS, TWICE, BLANK, KNOWN):
        if method in (OURS, TWICE):
            starts = [*STARTS][: 1 if method == OURS else None]
            bodies = learned(layout, *training(case, "before", work), starts=starts)
        elif method == BLANK:
            bodies = blank(case.seed)
        else:
            bodies = {name: thing.body() for name, thing in THINGS.items()}
        return from_scenes(case, lambda s: layout.scene(s, bodies), OBJECTS.quality)
    if method == WHOLE_ROOM:
        everything = learned_room(layout, *training(case, "before", work))
        return from_scenes(case, lambda s: with_node(layout.scene(s, {}), everything), ROOM.quality)
    return _interpolated(case, method, work)


def from_scenes(case: Case, scene_of: Callable[[str], rfsg.Scene], quality: rfsg.Quality) -> Said:
    return {
        situation: {
            kind: gains(
                scene_of(situation), case.layout.asked(situation, kind, case.asked), quality
            )
            .round(4)
            .tolist()
            for kind in (HEARD, NEW)
        }
        for situation in SITUATIONS
    }


def _interpolated(case: Case, method: str, work: Path) -> Said:
    """An interpolator; a retrained one sees as many readings again wherever it is asked."""
    make = INTERPOLATORS[method.removesuffix(RETRAINED)]

    def trained(situation: str) -> Predictor:
        links, gain_db = training(case, situation, work)
        return make().fit(links.readings(gain_db), case.seed)

    if not method.endswith(RETRAINED):
        once = trained("before")
        return {s: _asked_of(once, case, s) for s in SITUATIONS}
    return {s: _asked_of(trained(s), case, s) for s in SITUATIONS[1:]}


def _asked_of(predictor: Predictor, case: Case, situation: str) -> dict[str, list[float] | None]:
    found: dict[str, list[float] | None] = {}
    for kind in (HEARD, NEW):
        links = case.layout.asked(situation, kind, case.asked)
        try:
            said = predictor.predict(links.tag, links.gateway, links.number)
            found[kind] = said.mean.round(4).tolist()
        except UnheardGatewayError:
            found[kind] = None
    return found
