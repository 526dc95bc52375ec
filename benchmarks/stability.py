"""Where does it stop being right? Takes the tracer to its extremes, each beside a truth.

    python benchmarks/stability.py [--write-docs] [--quick]

Prints every table; --write-docs also writes docs/stability.md. Ends with an error if a row is bad
(wrong, not finite, or not a path) and no footnote says why. Truths are closed forms in 50 digits
(mpmath), from other sources than the code. Times and memory are as they came: nothing is promised.
"""

import argparse
import sys
import time

from extremes import matter, networks, places, waves
from extremes.table import Section, markdown
from machine import ROOT, measured_on, write_page

PAGE = ROOT / "docs" / "stability.md"
TOPICS = (waves, matter, places, networks)

HEAD = """# Stability

Written by `python benchmarks/stability.py --write-docs`. Every row takes one thing to an extreme and
holds the answer against a truth: a closed form in 50 digits unless the section says otherwise. Errors
are relative and of the worst path, amplitude and phase together; 0 is below 1e-16. *status* counts how
candidates ended; *gradient* says whether the derivatives of the path
gain by both radios' places, every pose, size and material constant are finite. A dash stands where
there is nothing to compare or to differentiate. A number in brackets is a footnote, which says why a
row is not simply right, and what to do about it.

Nothing here ends in a NaN, an infinity or a silence: what cannot be answered is refused with the name
of the prim, and what should not be believed comes with a sentence in `Result.warnings`.
"""


def sections(quick: bool) -> list[Section]:
    """All tables, a few rows of each where it should be quick."""
    found = []
    for topic in TOPICS:
        for make in topic.SECTIONS:
            start = time.perf_counter()
            found.append(make(quick))
            spent = time.perf_counter() - start
            print(markdown(found[-1:]), f"({spent:.1f} s)\n", sep="", flush=True)
    return found


def main() -> None:
    """Measure, print, and write the page if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write-docs", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--quick", action="store_true", help="a few rows of each table")
    options = parser.parse_args()
    if options.write_docs and options.quick:
        parser.error("--write-docs writes the whole page: leave out --quick")
    start = time.perf_counter()
    found = sections(options.quick)
    line = measured_on(time.perf_counter() - start)
    print(line)
    unexplained = [f"{s.title}: {r.case}: {r}" for s in found for r in s.unexplained()]
    if unexplained:
        sys.exit("bad rows without a footnote:\n" + "\n".join(unexplained))
    if options.write_docs:
        write_page(PAGE, HEAD, line, markdown(found))


if __name__ == "__main__":
    main()
