"""Are objects that were learned still right where they are moved, in another room, and copied?

    python benchmarks/moved.py [--work out/moved] [--seeds 0 1 2] [--stored] [--remedies] [--write-section]

Everything is simulated: no data are needed. Truth and results are stored in the folder --work as soon
as they are there, so that a run that was killed goes on where it stopped; a result is computed anew
when the rooms, the truth's quality or the budget changed. --write-section writes
docs/learning-moved.md and its picture of what is stored; --stored computes nothing before; --remedies
also computes what else was tried, on seed 100.
"""

import argparse
import sys
from pathlib import Path

import torch
from learn import moved, moved_figures, moved_page, moved_remedies, moved_text
from machine import ROOT, measured_on, write_page

PAGE = ROOT / "docs" / "learning-moved.md"
PICTURE = ROOT / "docs" / "images" / "learning_moved.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "moved", help="results")
    parser.add_argument("--seeds", nargs="+", type=int, default=(), help="only these of the plan")
    parser.add_argument("--counts", nargs="+", type=int, default=(), help="only so many readings")
    parser.add_argument("--noises", nargs="+", type=float, default=(), help="only these [dB]")
    parser.add_argument("--only", nargs="+", default=(), help="methods (default: all)")
    parser.add_argument("--stored", action="store_true", help="compute nothing")
    parser.add_argument("--remedies", action="store_true", help="what was tried on seed 100")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--write-section", action="store_true", help=f"write docs/{PAGE.name}")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    unknown = sorted(set(options.only) - set(moved.METHODS))
    if unknown:
        parser.error(
            f"--only {', '.join(unknown)}: no such method; expected some of "
            f"{', '.join(moved.METHODS)}"
        )
    plan = moved_page.PLAN
    if not options.stored:
        wanted = [
            case
            for case in plan.cases()
            if case.seed in (options.seeds or [case.seed])
            and case.count in (options.counts or [case.count])
            and case.noise_db in (options.noises or [case.noise_db])
        ]
        moved.compute(wanted, options.only or moved.METHODS, options.work)
    if options.remedies:
        moved_remedies.compute(options.work)
    results = moved_page.collected(plan, options.work)
    if not results.every:
        sys.exit(f"{options.work}: no result stored; run once without --stored")
    print(moved_figures.summary(results), moved_page.tables(results), sep="\n\n")
    if options.write_section:
        moved_page.picture(results, PICTURE)
        took = measured_on(moved_page.seconds(results, options.work))
        write_page(PAGE, moved_text.page(results, PICTURE.name, took, options.work))


if __name__ == "__main__":
    main()
