"""What was asked of the speed of rfsg beside what was measured: a table of the other pages' figures.

    python benchmarks/goals.py [--write-docs]

Measures nothing: it reads the tables that ``intersect.py``, ``solver.py``, ``maps.py`` and
``objects.py`` have written, so that the summary cannot differ from them. Run it last.
"""

import argparse
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from machine import ROOT, write_section

DOCS = ROOT / "docs"
PAGE = DOCS / "performance.md"
SAID = """
Written by `python benchmarks/goals.py --write-docs` from the tables below and in
[intersection.md](intersection.md); medians, and in brackets the least and the most of them. A ratio
without brackets is of two medians.
"""
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Cell:
    """A measured figure: median, least and most (all the same where only one was written)."""

    median: float
    least: float
    most: float

    @staticmethod
    def read(text: str) -> "Cell":
        found = [float(n) for n in NUMBER.findall(text)]
        if not found:
            raise ValueError(f"expected a figure, found {text!r}")
        median, least, most = found if len(found) == 3 else (found[0],) * 3
        return Cell(median, least, most)

    def __str__(self) -> str:
        alone = self.least == self.most
        return f"{self.median:.3g}" + ("" if alone else f" ({self.least:.3g} to {self.most:.3g})")


@dataclass(frozen=True)
class Table:
    """A table of a page, by the name of a row and the head of a column."""

    head: list[str]
    rows: list[list[str]]

    def text(self, column: str, *names: str) -> str:
        """The cell of the first row whose first cells are ``names``."""
        place = self.head.index(column)
        for row in self.rows:
            if tuple(row[: len(names)]) == names:
                return row[place]
        raise KeyError(f"no row {names} in the table with columns {self.head}")

    def cell(self, column: str, *names: str) -> Cell:
        return Cell.read(self.text(column, *names))


def tables(page: Path, heading: str) -> Iterator[Table]:
    """The tables of a page that follow a heading or the start of a line of text."""
    _, _, rest = page.read_text().partition(heading)
    lines: list[str] = []
    for line in [*rest.splitlines(), ""]:
        if line.startswith("|"):
            lines.append(line)
        elif lines:
            head, _, *rows = ([c.strip() for c in one.strip("| ").split("|")] for one in lines)
            yield Table(head, rows)
            lines = []


@dataclass(frozen=True)
class Goal:
    """One line of the summary."""

    what: str
    asked: str
    measured: str
    met: bool
    note: str = ""  # where it is missed: what was lost, what was tried, what is the limit

    def __str__(self) -> str:
        verdict = "met" if self.met else f"**missed**. {self.note}"
        return f"| {self.what} | {self.asked} | {self.measured} | {verdict} |"


def rays() -> Iterator[Goal]:
    """Rays against the trained cabinet."""
    page = DOCS / "intersection.md"
    cabinet = next(tables(page, "The trained cabinet:"))
    wrong, off = "false / missed %", "off mm, 50 / 99 %"
    certain, newton = cabinet.text(wrong, "certain"), cabinet.text(wrong, "newton")
    exact = [float(n) for n in NUMBER.findall(certain)], cabinet.text(off, "certain")
    naive, pruned = (cabinet.cell(c, "certain") for c in ("x naive", "x pruned march"))
    clean = sum(exact[0]) <= 0.01 and float(exact[1].split("/")[1]) <= 0.05
    yield Goal(
        "cabinet, the certain way against naive sphere tracing, with at most 0.01 % false and missed "
        "and 0.05 mm at 99 %",
        "at least 60 x",
        f"{naive} x; {certain} %, {exact[1]} mm",
        naive.median >= 60 and clean,
        "The few late rays at creases take most of the time.",
    )
    yield Goal(
        "the same against the pruned march",
        "at least 5 x",
        f"{pruned} x",
        pruned.median >= 5,
        "The few late rays at creases take most of the time.",
    )
    fast = cabinet.cell("x naive", "newton")
    missed = float(NUMBER.findall(newton)[1])
    yield Goal(
        "zero mesh and one step against naive, at most 0.05 % missed",
        "at least 100 x",
        f"{fast} x; {missed:g} % missed",
        fast.median >= 100 and missed <= 0.05,
    )
    slower = (
        cabinet.cell("krays/s", "mesh").median / cabinet.cell("krays/s", "certain").median,
        cabinet.cell("krays/s", "mesh").median / cabinet.cell("krays/s", "newton").median,
    )
    yield Goal(
        "certain, and zero mesh with one step, against Embree on the 5 mm mesh",
        "at most 12 x slower",
        f"{slower[0]:.1f} and {slower[1]:.1f} x",
        max(slower) <= 12,
    )
    _, _, after = page.read_text().partition("f with its gradient: ")
    share = Cell.read(after.split("k/s,")[1].split("%")[0])
    yield Goal(
        "f with its gradient, of what matrix products allow",
        "at least 40 %",
        f"{share} %",
        share.median >= 40,
        "Between the products stand four passes over the activations: they are bound by memory.",
    )


def paths() -> Iterator[Goal]:
    """The solver beside Sionna RT."""
    table = next(tables(PAGE, "\n## The path solver\n"))
    for job in ("room, 1000 Rx, depth 3", "room, 1000 Rx, depth 5", "canyon, 100 Rx, depth 3"):
        told, faster = [], True
        for column in ("steady [s]", "first call [s]", "process [s]"):
            ours, theirs = (table.cell(column, job, side) for side in ("rfsg", "sionna"))
            told.append(f"{column.removesuffix(' [s]')} {ours} against {theirs} s")
            faster &= ours.median <= theirs.median
        found, there_are = NUMBER.findall(table.text("paths", job, "rfsg"))
        peer = NUMBER.findall(table.text("paths", job, "sionna"))[0]
        told.append(f"{found} of {there_are} paths, {peer} there")
        yield Goal(
            f"{job}, against Sionna RT",
            "faster, nothing lost",
            "; ".join(told),
            faster and found == there_are,
            "Four fifths of a process's start are the import of torch, which Sionna RT does without; the two "
            "take turns in being first from run to run.",
        )
    ours, theirs = (
        table.cell("steady [s]", "gradient, 100 Rx, depth 3", side) for side in ("rfsg", "sionna")
    )
    ratio = theirs.median / ours.median
    yield Goal(
        "gradient of 100 powers to a material, with kept chains",
        "at least 5 x faster",
        f"{ours} against {theirs} s: {ratio:.1f} x",
        ratio >= 5,
    )
    few, many = (table.cell("steady [s]", f"room, {n} Rx, depth 3", "rfsg") for n in (10, 10_000))
    growth = many.median / few.median
    counts = [NUMBER.findall(table.text("paths", f"room, {n} Rx, depth 3")) for n in (10, 10_000)]
    yield Goal(
        "10 to 10,000 receivers, paths unchanged",
        "less than 500 x the time",
        f"{growth:.0f} x; {counts[0][0]} and {counts[1][0]} paths, all",
        growth < 500 and all(a == b for a, b in counts),
    )


def maps() -> Iterator[Goal]:
    """The radio map of the canyon."""
    table = next(tables(PAGE, "\n## A radio map of a street\n"))
    error, theirs = "95 % within [dB]", "Sionna RT, 1,000,000 rays"
    told, best = [], None
    for way in ("rfsg, images", "rfsg, images, 2 reflections", theirs):
        took, off = table.cell("then [s]", way), table.cell(error, way).median
        wrong = table.text("wrongly lit or dark", way)
        told.append(f"{way}: {took} s, {off:.2g} dB at 95 %, {wrong} cells wrongly lit or dark")
        if way != theirs and off <= table.cell(error, theirs).median:
            best = took.median if best is None else min(best, took.median)
    yield Goal(
        "radio map of the canyon, against Sionna RT at a million rays",
        "faster at the same error",
        "; ".join(told),
        best is not None and best <= table.cell("then [s]", theirs).median,
        "A third of the exact map's time are gains, a third whether a line is free. Ten million rays, "
        "which are no better at 95 %, take Sionna RT several times as long.",
    )


def objects() -> Iterator[Goal]:
    """Growth with objects, and memory."""
    table = next(tables(PAGE, "\n## Many objects\n"))
    few, many = (table.cell("simulate, draft [s]", n) for n in ("10", "1000"))
    growth = (many.median / few.median) ** 0.5
    _, _, after = PAGE.read_text().partition("\nMemory: ")
    each = Cell.read(after.split("\n")[0])
    yield Goal(
        "10 to 1000 instances of a trained object",
        "less than 3 x a decade, less than 10 kB each",
        f"{growth:.1f} x; {each} kB",
        growth < 3 and each.median < 10,
        "Each instance asks for mirror points of its own, and 3 of the 184 paths at 1000 touch one: of 70,000 "
        "candidates 16,000 pass a glance, 10,000 the first look at facets measured beforehand, 440 the first "
        "measurement of a zone, which is a third of the time. Tried: bounds first, steps in closed form, "
        "far steps in float32 (3.6 x before), finer clusters, float32 scores, no gain. Left: a proof that "
        "a zone has no mirror point near the object.",
    )


PARTS: tuple[Callable[[], Iterator[Goal]], ...] = (rays, paths, maps, objects)


def main() -> None:
    """Print the summary, and write it if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write-docs", action="store_true", help=f"a section of {PAGE.name}")
    options = parser.parse_args()
    lines = ["| what | asked | measured | |", "| --- | --- | --- | --- |"]
    lines += [str(goal) for part in PARTS for goal in part()]
    print(*lines, sep="\n")
    if options.write_docs:
        write_section(PAGE, "## Asked and reached", SAID.strip(), "", *lines)


if __name__ == "__main__":
    main()
