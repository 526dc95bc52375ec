"""How exact is each mechanism? Measures them beside exact fields, closed forms and quadrature.

    python benchmarks/mechanisms.py [--write-docs]

Prints every table; --write-docs also writes docs/accuracy.md. Ends with an error, and writes nothing,
if a figure is beyond the bound that the page holds it to.
"""

import argparse
import sys
import time
from collections.abc import Sequence

from accuracy import diffuse, edges, plates, solids
from accuracy.table import Table, markdown
from machine import ROOT, measured_on, write_page

PAGE = ROOT / "docs" / "accuracy.md"
TOPICS = (edges, diffuse, solids, plates)

HEAD = """# Accuracy

Written by `python benchmarks/mechanisms.py --write-docs`. How far each mechanism of
[mechanisms.md](mechanisms.md) is from a truth that was found another way. A cell is what was measured,
and in brackets the bound, in the same unit, beyond which the script fails. Errors are relative, a
percent of the truth unless the table says otherwise; a minus means too low. What is exact to rounding
is in [stability.md](stability.md).
"""


def tables() -> list[Table]:
    found = []
    for topic in TOPICS:
        for make in topic.TABLES:
            start = time.perf_counter()
            found.append(make())
            spent = time.perf_counter() - start
            print(markdown(found[-1:]), f"({spent:.1f} s)\n", sep="", flush=True)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, and write the page if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write-docs", action="store_true", help=f"write {PAGE.name}")
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    found = tables()
    line = measured_on(time.perf_counter() - start)
    print(line)
    broken = [words for table in found for words in table.broken()]
    if broken:
        sys.exit("beyond their bounds:\n" + "\n".join(broken))
    if options.write_docs:
        write_page(PAGE, HEAD, line, markdown(found))


if __name__ == "__main__":
    main()
