"""Which defaults of a fit are worth their place? One thing changed at a time, on simulated truth.

    python benchmarks/ablations.py [--work out/ablations] [--seeds 10 11 12] [--write-docs]

Every result is stored as soon as it is there: a run that was killed goes on. --stored computes nothing.
"""

import argparse
import sys
from pathlib import Path

import torch
from learn import ablations_page as page
from learn.ablations import in_turn, outcome, stored, variants
from machine import ROOT, measured_on, write_page

PAGE = ROOT / "docs" / "learning-ablations.md"
PICTURE = ROOT / "docs" / "images" / "learning_ablations.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "ablations", help="results")
    parser.add_argument("--seeds", type=int, nargs="+", default=(10, 11, 12))
    parser.add_argument("--only", nargs="+", default=(), help="only variants of these defaults")
    parser.add_argument("--stored", action="store_true", help="compute nothing")
    parser.add_argument(
        "--write-docs", action="store_true", help="write docs/learning-ablations.md"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)  # CPU time is then the time of the fit, whatever else runs
    todo = [v for v in variants() if not options.only or v.of in options.only]
    if not options.stored:
        for how, seed in in_turn(options.seeds):
            if how in todo:
                print(page.line(how, seed, outcome(how, seed, options.work)), flush=True)
    runs = []
    for how in todo:
        found = [stored(how, seed, options.work) for seed in options.seeds]
        runs.append((how, [r for r in found if r is not None]))
    if not any(found for _, found in runs):
        sys.exit(f"{options.work}: no result stored; run once without --stored")
    tables = page.tables(runs)
    print(tables)
    if options.write_docs:
        page.picture(runs, PICTURE)
        seconds = sum(r.fit_s for _, found in runs for r in found)
        write_page(PAGE, page.HEAD, measured_on(seconds), tables, page.FOOT)


if __name__ == "__main__":
    main()
