"""Which settings matter, and which do not: error against time on three scenes.

    python benchmarks/tradeoffs.py [--write-docs] [--scene street] [--fresh]

Runs ``rfsg.tracer.tradeoff`` on the street, on tetam_lab and on the lab with its learned objects, and
prints a table of each; --write-docs writes docs/tradeoff.md and its pictures, with what
benchmarks/dial.py has counted, as far as it has. Results are kept in out/tradeoffs by scene and
settings, so that a second call only prints; --fresh forgets them.
"""

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from dial import ROOT, cases, coverage, kept, ladder_table
from machine import measured_on, write_page

from rfsg import plot
from rfsg.plot_tradeoff import tradeoff_figure
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene
from rfsg.tracer import ladder, tradeoff
from rfsg.tracer.compared import Difference
from rfsg.tracer.plan import Quality

SCENES = ROOT / "assets" / "scenes"
KEPT = ROOT / "out" / "tradeoffs"
PAGE = ROOT / "docs" / "tradeoff.md"


HEAD = """# Speed against accuracy

Written by `python benchmarks/tradeoffs.py --write-docs` and `benchmarks/dial.py`; for a scene of yours,
`rfsg tradeoff`. One process of one thread on a machine busy with other work: take times by their order
of magnitude, and a factor below two for none. Errors are of coherent path gain, against the best setting
that was affordable (each section names it); *at 90 %* is what nine links of ten keep. *missed* is the
share of that setting's power in paths that are not found; *from base* what the change alone moves at
90 % of links. Bold: on the Pareto front.

What to do with it (the numbers are those of the tables below, unless a finding says otherwise):

1. **Say the accuracy, not the setting.** `--accuracy 1dB` kept its promise on every random scene that was
   counted ([the dial](#the-dial)). It is careful: in the median a quarter of the estimated error was true.
   Where a scene needs the top of the ladder, the climb costs more than going there at once.
2. **The first edge is worth its price, the second rarely.** On the street the first costs some 9 times
   the time and takes the error from 3.5 to 0.73 dB; in tetam_lab it takes it from 18 to 5.9 dB. The second
   costs another 50 times for 0.6 dB. `diffraction_depth=1` halves the time of the first for 1.1 dB.
3. **Bounces among planes are cheap: take five.** On the street five in place of three cost 1.1 to 2.3 times
   the time, and the worst link goes from 5 dB off to 1. In tetam_lab, among 47 boxes, three bounces are
   not enough: 5.9 dB at 90 % of links, 19 dB on the worst.
4. **Never search planes by rays.** Enumeration took 0.66 s for the 688 paths of room.usda at five
   bounces and two edges, 200,000 rays 24.9 s for the same 688 and the same gains (measured apart from the
   tables, one thread). `reference` asks for rays (`curved=2`); the dial and `rfsg tradeoff` do not where
   nothing is curved. On the street 2,000 rays are as quick as enumerating and lose 3 of 936 paths; in
   the lab 2,000 to 100,000 rays find 122 to 126 of draft's 128, and take up to six times as long.
5. **Measure learned faces at two rings, no fewer.** `zone_rings=1` halves the time of the lab's draft and
   moves a link by 2.5 dB; from two to four rings 0.2 dB.
6. **Longer chains over learned objects are what costs there, and they are weak.** `curved_depth` 3 in
   place of 1 takes draft from 5.3 to 18 s for 0.2 dB; leaving out reflections on learned objects
   altogether (`curved=0`) is 4 times quicker and moves 0.07 dB at 2.44 GHz among five of them. What
   matters of furniture at this wavelength is what goes through it.
7. **Do not spend on the transport integral.** From 4 to 64 `crossing_samples`, and telescoped against
   Riemann sums of 16 and 128: 0.001 dB. By 20,000 rays `epsilon` from 1 to 50 mm moves nothing.
8. **The floor saves no time.** On the street -50 in place of -80 dB drops a third of the paths, takes as
   long, and moves 0.2 dB; -30 dB moves 0.6. Use it to keep files small.
9. **Delays converge before gains.** The first arrival is right from the first edge on (52 ns off without,
   on the street), the delay spread within a nanosecond from `standard` on.

Not on this page: widths and precisions of the network, which are set at training
([learning.md](learning.md)), and the ways of `intersection`, which `benchmarks/intersect.py` measures.
"""


@dataclass(frozen=True)
class Case:
    """A scene, the setting that is varied on it, and the time it may take [s]."""

    name: str
    scene: Callable[[], Scene]
    base: str
    budget_s: float
    note: str


def street() -> Scene:
    return Scene.from_usd(SCENES / "street.usda")


def offices() -> Scene:
    """Two of the twelve sensors, six places in the hall."""
    scene = Scene.from_usd(SCENES / "tetam_lab.usda")
    places = [(3.1, 4.2), (9.4, 3.3), (16.2, 5.1), (4.7, 12.6), (11.3, 14.9), (17.8, 11.7)]
    receivers = [Radio.at(f"/rx{i}", x, y, 1.2) for i, (x, y) in enumerate(places)]
    return scene.with_transmitters(scene.transmitters[::6]).with_receivers(receivers)


def lab() -> Scene:
    """Four of the 24 receivers: at all of them the thorough settings take too long for this page."""
    scene = Scene.from_usd(SCENES / "lab.usda")
    return scene.with_receivers(scene.receivers[2::6])


CASES = (
    Case("street", street, "standard", 240.0, "7 boxes, 20 links at 3.5 GHz"),
    Case("tetam_lab", offices, "standard", 240.0, "47 boxes, 2 of its sensors, 6 places"),
    Case("lab", lab, "draft", 330.0, "14 boxes, 5 learned objects, 4 of its receivers"),
)


def main() -> None:
    """Measure what is not kept yet, print, and write the page if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write-docs", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--scene", choices=[c.name for c in CASES], action="append")
    parser.add_argument("--fresh", action="store_true", help="measure all anew")
    options = parser.parse_args()
    chosen = [c for c in CASES if options.scene is None or c.name in options.scene]
    if options.write_docs and len(chosen) < len(CASES):
        parser.error("--write-docs writes the whole page: leave out --scene")
    start = time.perf_counter()
    parts = []
    for case in chosen:
        found = measured(case, options.fresh)
        parts.append(section(case, found))
        print(parts[-1], flush=True)
        if options.write_docs:
            picture = tradeoff_figure(found, f"{case.name}: {case.note}")
            plot.save(picture, PAGE.parent / "images" / f"tradeoff-{case.name}.png")
    if options.write_docs:
        line = measured_on(time.perf_counter() - start)
        write_page(PAGE, HEAD, line, *parts, promise())


def measured(case: Case, fresh: bool = False) -> tradeoff.Tradeoff:
    """The tradeoff of a scene: kept, or measured now."""
    scene = case.scene()
    file = place(case)
    if not file.exists() or fresh:
        told: Any = lambda setting: print(f"  {setting}", file=sys.stderr, flush=True)  # noqa: E731
        found = tradeoff.tradeoff(scene, base=case.base, budget_s=case.budget_s, progress=told)
        kept_now = vars(found) | {"scene": None, "outcomes": [asdict(o) for o in found.outcomes]}
        KEPT.mkdir(parents=True, exist_ok=True)
        beside = file.with_suffix(".part")
        beside.write_text(json.dumps(kept_now, indent=1))
        os.replace(beside, file)
    read = json.loads(file.read_text())
    outcomes = tuple(
        tradeoff.Outcome(**(o | {"error": Difference(**o["error"])})) for o in read["outcomes"]
    )
    left_out = tuple(read["left_out"])
    return tradeoff.Tradeoff(
        **(read | {"scene": scene, "outcomes": outcomes, "left_out": left_out})
    )


def place(case: Case) -> Path:
    """Where a scene's tradeoff is kept: by its settings and the ladder."""
    rungs = [(r.name, tradeoff.changed(r.quality, Quality())) for r in ladder.RUNGS]
    grid = [tradeoff.VARIATIONS, tradeoff.INTEGRALS, tradeoff.BY_RAYS]
    what = [case.name, case.base, case.budget_s, grid, rungs]
    key = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]
    return KEPT / f"{case.name}-{key}.json"


def section(case: Case, found: tradeoff.Tradeoff) -> str:
    """A scene's table and picture."""
    head = ["setting", "s", "MiB", "dB", "at 90 %", "most", "missed [dB]", "spread [ns]"]
    head += ["arrival [ns]", "from base [dB]", "paths"]
    rows = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for one in found.outcomes:
        bold = "**" if one.front else ""
        peak = "" if one.peak_mib is None else f"{one.peak_mib:.0f}"
        errors = (one.error.gain_db, one.error.gain_90_db, one.error.gain_most_db, one.missed_db)
        cells = [f"{bold}{one.setting}{bold}", f"{one.seconds:.2g}", peak]
        cells += [f"{x:.2g}" for x in (*errors, one.error.spread_ns, one.error.arrival_ns)]
        cells += [f"{one.moved_db:.2g}", str(one.paths)]
        rows.append(f"| {' | '.join(cells)} |")
    told = found.sentence()
    same = [s.split(":")[0] for s in found.left_out if "the same as" in s]
    untried = [s for s in found.left_out if "the same as" not in s]
    lines = [
        f"## {case.name}",
        "",
        f"{case.note}; varied from `{case.base}`. {told[0].upper()}{told[1:]}.",
    ]
    lines += ["", f"![error against time](images/tradeoff-{case.name}.png)", "", *rows, ""]
    if same:
        lines += [f"Of no effect on this scene by its make: {'; '.join(same)}.", ""]
    if untried:
        lines += [f"Not run: {'; '.join(untried)}.", ""]
    return "\n".join(lines)


def promise() -> str:
    """What benchmarks/dial.py has counted so far."""
    rows = [row for kind, seed in cases(50, 6, 2) if (row := kept(kind, seed, 1.0)) is not None]
    if not rows:
        return "## The dial\n\nNot counted yet: run benchmarks/dial.py.\n"
    return f"## The dial\n\n{coverage(rows, 1.0)}\n{ladder_table(rows)}"


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
