"""What was tried on seed 100, whose rooms, links and noise are in no other table."""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import rfsg
from learn import moved
from learn.moved import TRUTH, Case, keyed, training
from learn.moved_methods import OBJECTS, Budget, learned
from learn.moved_page import PLAN, Result, Results
from learn.moved_rooms import HEARD, NEW, SITUATIONS, THINGS
from learn.store import write

CASE = Case(100, 200, 2.0, 200, PLAN.asked)
EDGE = replace(OBJECTS.quality, diffraction=1)


@dataclass(frozen=True)
class Remedy:
    """How it was learned (None: true materials), and at which quality it was asked."""

    said: str
    budget: Budget | None
    asked: rfsg.Quality

    def place(self, work: Path) -> Path:
        key = (CASE, TRUTH, moved.ROOMS_CODE, self.budget, self.asked)
        return keyed(work / "remedies", self.said.replace(" ", "_").replace(",", ""), *key)


REMEDIES = (
    Remedy("rfsg, as in the tables", OBJECTS, OBJECTS.quality),
    Remedy("the same, asked with one edge", OBJECTS, EDGE),
    Remedy("the same, learned with one edge too", replace(OBJECTS, quality=EDGE), EDGE),
    Remedy("true materials", None, OBJECTS.quality),
    Remedy("true materials, one edge", None, EDGE),
)


def compute(work: Path) -> None:
    """All of them; what is stored is not computed again."""
    for remedy in REMEDIES:
        if not remedy.place(work).is_file():
            moved.tests(CASE, work)
            begin = time.perf_counter()
            store(remedy, bodies(remedy, work), work, begin)


def bodies(remedy: Remedy, work: Path) -> dict[str, rfsg.Body]:
    if remedy.budget is None:
        return {name: thing.body() for name, thing in THINGS.items()}
    return learned(CASE.layout, *training(CASE, "before", work), remedy.budget)


def store(remedy: Remedy, known: dict[str, rfsg.Body], work: Path, begin: float) -> None:
    """What is said with these bodies, and how long it took since ``begin`` [s]."""
    said = moved.from_scenes(CASE, lambda s: CASE.layout.scene(s, known), remedy.asked)
    took = time.perf_counter() - begin
    write(remedy.place(work), json.dumps({"said": said, "seconds": took}) + "\n")


def rows(work: Path) -> Iterator[str]:
    """Markdown: medians / 90th percentiles, links that matter, all gateways; of what is stored."""
    for remedy in REMEDIES:
        if remedy.place(work).is_file():
            found = json.loads(remedy.place(work).read_text())
            results = Results([Result(CASE, "", found["said"], moved.tests(CASE, work))])
            cells = []
            for situation in SITUATIONS:
                every = [results.errors("", 200, 2.0, situation, k, True) for k in (HEARD, NEW)]
                off = np.concatenate([e for e in every if e is not None])
                cells.append(f"{np.median(off):.2f} / {np.percentile(off, 90):.2f}")
            yield f"| {remedy.said} | 100 | {' | '.join(cells)} | {found['seconds']:.0f} |"
