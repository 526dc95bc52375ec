"""Does the dial keep its promise, and what does it save? Counts over scenes drawn at random.

    python benchmarks/dial.py [--planar 50] [--cylinder 6] [--learned 2] [--accuracy 1]

Every scene is simulated with ``accuracy_db`` and then at ``reference``, on which no choice was made:
the seeds here are none of those that the ladder's constants were chosen on. A promise is kept where
90 % of a scene's links are within the accuracy. ``reference`` is run as the dial runs it, with the
fields that the scene gives no work at their standard values: for planar scenes that is an
enumeration, and quicker than the preset itself, which would launch rays. Results are kept in
out/dial, so that a second call only prints; --fresh forgets them.
"""

import argparse
import hashlib
import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

import torch
from random_scenes import random_scene

from rfsg.scene.scene import Scene
from rfsg.tracer import dial, ladder
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from rfsg.tracer.tradeoff import changed

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "out" / "dial"
RECEIVERS = (14, 6)  # by turns: with pilots, and climbed as a whole
FIRST_SEED = 1000  # below are those that the constants of the ladder were chosen on


def main() -> None:
    """Measure what is not kept yet, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for kind, count in (("planar", 50), ("cylinder", 6), ("learned", 2)):
        parser.add_argument(
            f"--{kind}", type=int, default=count, help=f"scenes of this kind: {count}"
        )
    parser.add_argument("--accuracy", type=float, default=1.0, help="asked for [dB]")
    parser.add_argument("--fresh", action="store_true", help="measure all anew")
    options = parser.parse_args()
    rows = [
        measured(kind, seed, options.accuracy, options.fresh)
        for kind, seed in cases(options.planar, options.cylinder, options.learned)
    ]
    print(coverage(rows, options.accuracy))
    print(ladder_table(rows))


def cases(planar: int, cylinder: int, learned: int) -> Iterator[tuple[str | None, int]]:
    """Kinds of scenes and their seeds, the quick ones first."""
    for kind, count in ((None, planar), ("cylinder", cylinder), ("learned", learned)):
        yield from ((kind, FIRST_SEED + k) for k in range(count))


def kept(kind: str | None, seed: int, accuracy_db: float) -> dict[str, Any] | None:
    """A scene's row of an earlier call, if there is one."""
    file = place(kind, seed, accuracy_db)
    return json.loads(file.read_text()) if file.exists() else None


def place(kind: str | None, seed: int, accuracy_db: float) -> Path:
    """Where a scene's row is kept: by what was asked, and the ladder it was asked of."""
    rungs = [(rung.name, changed(rung.quality, Quality())) for rung in ladder.RUNGS]
    what = [kind, seed, RECEIVERS[seed % 2], accuracy_db, rungs, ladder.SHRINKS]
    key = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:12]
    return KEPT / f"{kind or 'planar'}-{seed}-{key}.json"


def measured(kind: str | None, seed: int, accuracy_db: float, fresh: bool) -> dict[str, Any]:
    """One scene with the dial and at reference: kept, or measured now."""
    row = None if fresh else kept(kind, seed, accuracy_db)
    if row is not None:
        return row
    row = {"kind": kind or "planar", "seed": seed}
    row |= against_reference(random_scene(seed, RECEIVERS[seed % 2], kind), accuracy_db)
    file = place(kind, seed, accuracy_db)
    KEPT.mkdir(parents=True, exist_ok=True)
    beside = file.with_suffix(".part")
    beside.write_text(json.dumps(row))
    os.replace(beside, file)
    print(
        {k: row[k] for k in ("kind", "seed", "rung", "error_db", "true_db", "saving")}, flush=True
    )
    return row


def against_reference(scene: Scene, accuracy_db: float) -> dict[str, Any]:
    """The dial on a scene beside the top of its ladder: choice, true error, seconds of both."""
    simulate(scene, None, ladder.ladder(scene)[0].quality)  # what a process pays once
    start = time.perf_counter()
    result, choice = dial.within(scene, accuracy_db=accuracy_db)
    spent = time.perf_counter() - start
    start = time.perf_counter()
    truth = simulate(scene, None, ladder.ladder(scene)[-1].quality)
    always = time.perf_counter() - start
    return {
        "rung": choice.rung,
        "error_db": choice.error_db,
        "true_db": true_error_db(result, truth),
        "seconds": spent,
        "reference_s": always,
        "saving": always / spent,
        "tried": [asdict(trial) for trial in choice.tried],
    }


def true_error_db(result: Any, truth: Any) -> float:
    """Error of path gain at the carrier [dB] that 90 % of the links do not exceed."""
    one, other = (r.transfer()[..., 0][..., None] for r in (result, truth))
    return float(ladder.at_links(ladder.difference_db(one, other)))


def coverage(rows: list[dict[str, Any]], accuracy_db: float) -> str:
    """How often the promise was kept, and what was saved."""
    head = ["scenes", "promise kept", "worst error [dB]", "true by estimated error, median"]
    head += ["reference's time by the dial's, all", "median scene", "dearer than reference"]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for kind in ("planar", "cylinder", "learned", "all"):
        some = [r for r in rows if kind in (r["kind"], "all")]
        if some:
            kept = sum(r["true_db"] <= accuracy_db for r in some)
            saving = sum(r["reference_s"] for r in some) / sum(r["seconds"] for r in some)
            middle = median(r["saving"] for r in some)
            worst = max(r["true_db"] for r in some)
            careful = median(r["true_db"] / r["error_db"] for r in some if r["error_db"] > 0.0)
            dearer = sum(r["saving"] < 1.0 for r in some)
            cells = [kind, f"{kept} of {len(some)}", f"{worst:.2g}", f"{careful:.2g}"]
            cells += [f"{saving:.2g}", f"{middle:.2g}", f"{dearer} of {len(some)}"]
            lines.append(f"| {' | '.join(cells)} |")
    return f"{accuracy_db:g} dB asked for.\n\n" + "\n".join(lines) + "\n"


def ladder_table(rows: list[dict[str, Any]]) -> str:
    """What each rung cost against the one before, and how often it was chosen."""
    lines = ["| rung | chosen | tried | times the one before, median | at 90 % |"]
    lines += ["| --- | --- | --- | --- | --- |"]
    for name in [rung.name for rung in ladder.RUNGS]:
        dearer = [
            after["seconds"] / before["seconds"]
            for row in rows
            for before, after in zip(row["tried"], row["tried"][1:], strict=False)
            if after["rung"] == name
        ]
        chosen = sum(row["rung"] == name for row in rows)
        tried = sum(trial["rung"] == name for row in rows for trial in row["tried"])
        ratio = torch.tensor(dearer or [1.0], dtype=torch.float64)
        middle, high = (f"{float(ratio.quantile(q)):.2g}" for q in (0.5, 0.9))
        lines.append(f"| {name} | {chosen} | {tried} | {middle} | {high} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
