"""Which settings matter, and which do not: error against time on three scenes.

    python benchmarks/tradeoffs.py [--write-docs] [--scene street] [--fresh]

Runs ``rfsg.tracer.tradeoff`` on the street, on tetam_lab and on the lab with its learned objects, and
prints a table of each; --write-docs writes docs/tradeoff.md and its pictures, with what
benchmarks/dial.py and benchmarks/widths.py have found, as far as they have. Results are kept in
out/tradeoffs by scene and settings, so that a second call only prints; --fresh forgets them.
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

import findings
import torch
import widths
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

Written by `python benchmarks/tradeoffs.py --write-docs`, with what `benchmarks/dial.py` and
`benchmarks/widths.py` have measured; for a scene of yours, `rfsg tradeoff`. Take times by their order of
magnitude, and a factor below two for none. Errors are of coherent path gain, against the reference that
each section names; *at 90 %* is what nine links of ten keep. *missed* is the share of the reference's power
in paths that are not found; *from base* what the change alone moves at 90 % of links, whatever both lack:
where the reference is far off, read this one. Bold: on the Pareto front.

What to do with it. Each finding names its tables, and its figures are theirs:
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
    Case("tetam_lab", offices, "standard", 300.0, "47 boxes, 2 of its sensors, 6 places"),
    Case("lab", lab, "draft", 360.0, "14 boxes, 5 learned objects, 4 of its receivers"),
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
    parts, scenes = [], {}
    for case in chosen:
        scenes[case.name] = found = measured(case, options.fresh)
        parts.append(section(case, found))
        print(parts[-1], flush=True)
        if options.write_docs:
            picture = tradeoff_figure(found, f"{case.name}: {case.note}")
            plot.save(picture, PAGE.parent / "images" / f"tradeoff-{case.name}.png")
    advice = findings.say(findings.Measured(scenes, counted(), widths.kept()))
    print(advice)
    if options.write_docs:
        line = measured_on(time.perf_counter() - start)
        learned = f"{widths.HEADING}\n\n{widths.section(widths.kept())}"
        write_page(PAGE, HEAD, advice, line, *parts, learned, promise())


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
    grid = [tradeoff.VARIATIONS, tradeoff.INTEGRALS, tradeoff.BY_RAYS, tradeoff.MEETINGS]
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
    same = [s.split(":")[0] for s in found.left_out if "the same as" in s]
    untried = [s for s in found.left_out if "the same as" not in s]
    lines = [f"## {case.name}", "", f"{case.note}. {against(case, found)}"]
    lines += ["", f"![error against time](images/tradeoff-{case.name}.png)", "", *rows, ""]
    if same:
        lines += [f"Of no effect on this scene by its make: {'; '.join(same)}.", ""]
    if untried:
        lines += [f"Not run: {'; '.join(untried)}.", ""]
    return "\n".join(lines)


def against(case: Case, found: tradeoff.Tradeoff) -> str:
    """What is varied and what the errors are against, why that, and what is recommended."""
    why = "the thorough preset itself"
    if not found.truth_is_reference:
        above = [s for s in found.left_out if s.endswith("by the ladder")]
        why = (
            f"the most thorough rung of the ladder that fitted into {100 * tradeoff.FOR_TRUTH:.0f} % of "
            f"{case.budget_s:.0f} s" + "".join(f" (next, {s})" for s in above)
        )
    told = f"Single fields are varied from `{case.base}`. Errors are against `{found.reference}`, {why}. "
    if found.recommended is None:
        return f"{told}Nothing else is within {found.accuracy_db:g} dB of it at 90 % of links."
    return f"{told}Recommended for {found.accuracy_db:g} dB: {found.recommended}."


def counted() -> list[dict[str, Any]]:
    """The scenes that benchmarks/dial.py has run so far."""
    rows = [kept(kind, seed, 1.0) for kind, seed in cases(50, 6, 2)]
    return [row for row in rows if row is not None]


def promise() -> str:
    """What benchmarks/dial.py has counted so far."""
    rows = counted()
    if not rows:
        return "## The dial\n\nNot counted yet: run benchmarks/dial.py.\n"
    return f"## The dial\n\n{coverage(rows, 1.0)}\n{ladder_table(rows)}"


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
