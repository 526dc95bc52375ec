"""docs/learning-moved.md: what was learned in room A, asked there and where it was moved to."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from learn import moved
from learn.moved import Case, Plan, Said, Truth
from learn.moved_rooms import HEARD, NEW, SITUATIONS

MATTERS_DB = 1.0  # a link matters where the objects change its true path gain by more
PLAN = Plan({0: (50, 200, 1000), 1: (50, 200), 2: (50, 200)})
BEFORE, AFTER = SITUATIONS[0], SITUATIONS[1:]


@dataclass(frozen=True)
class Result:
    """What one method said of one case, and the truth."""

    case: Case
    method: str
    said: Said
    truth: dict[str, dict[str, Truth]]

    def errors(self, situation: str, kind: str, mattering: bool) -> list[float] | None:
        """|said - true| [dB] of all test links, or of those that matter; None where nothing is said."""
        said = self.said.get(situation, {}).get(kind)
        if said is None:
            return None
        true = self.truth[situation][kind]
        off = np.abs(np.array(said) - true.gain_db)
        return off[matters(true)].tolist() if mattering else off.tolist()


def matters(true: Truth) -> np.ndarray:
    """Which links the objects matter to."""
    return np.abs(true.gain_db - true.without_db) > MATTERS_DB


@dataclass(frozen=True)
class Results:
    """All results, and how their errors are taken together: over seeds."""

    every: Sequence[Result]

    @cached_property
    def methods(self) -> list[str]:
        found = {r.method for r in self.every}
        return [m for m in moved.METHODS if m in found]

    @cached_property
    def counts(self) -> list[int]:
        return sorted({r.case.count for r in self.every if r.method == moved.OURS})

    @cached_property
    def noises(self) -> list[float]:
        return sorted({r.case.noise_db for r in self.every if r.method == moved.OURS})

    def seeds(self, method: str, count: int, noise_db: float) -> int:
        """How many seeds a method was run for."""
        cases = [r.case for r in self.every if r.method == method]
        return len({c.seed for c in cases if (c.count, c.noise_db) == (count, noise_db)})

    def errors(
        self, method: str, count: int, noise_db: float, situation: str, kind: str, mattering: bool
    ) -> np.ndarray | None:
        """Errors [dB] over all seeds; None where the method says nothing."""
        if method.endswith(moved.RETRAINED) and situation == BEFORE:
            method = method.removesuffix(moved.RETRAINED)
        parts = [
            r.errors(situation, kind, mattering)
            for r in self.every
            if (r.method, r.case.count, r.case.noise_db) == (method, count, noise_db)
        ]
        there = [p for p in parts if p is not None]
        return np.concatenate(there) if there and len(there) == len(parts) else None


def collected(plan: Plan, work: Path) -> Results:
    """Every stored result of a plan."""
    found = []
    for case in plan.cases():
        there = [m for m in moved.METHODS if moved.place(case, m, work).is_file()]
        truth = moved.tests(case, work) if there else {}
        found += [Result(case, m, moved.predictions(case, m, work)[0], truth) for m in there]
    return Results(found)


def seconds(results: Results, work: Path) -> float:
    """What these results and the truth took together [s]; results of other settings may lie beside."""
    paths = {moved.place(r.case, r.method, work) for r in results.every}
    for seed in {r.case.seed for r in results.every}:
        paths |= {*(work / "truth").glob(f"seed{seed}-*.json")}
    return sum(json.loads(path.read_text())["seconds"] for path in paths)


def tables(results: Results) -> str:
    """Markdown: errors on the links that matter, then on all."""
    parts = []
    for mattering, title in ((True, "Links that matter"), (False, "All links")):
        parts.append(f"\n### {title}\n")
        for kind in (HEARD, NEW):
            for noise in reversed(results.noises):
                parts += [f"\n{kind.capitalize()}, noise of {noise:g} dB:\n"]
                parts.append(table(results, noise, kind, mattering))
    return "\n".join(parts)


def table(results: Results, noise_db: float, kind: str, mattering: bool) -> str:
    """A row per number of readings and method, a column per situation."""
    lines = ["| readings | method | " + " | ".join(SITUATIONS) + " |", "|---|---|" + "---|" * 4]
    for count in results.counts:
        for method in results.methods:
            ran, most = (results.seeds(m, count, noise_db) for m in (method, moved.OURS))
            if not ran or (method in moved.UNTRAINED and count != results.counts[0]):
                continue  # untrained ones say the same for any number of readings
            cells = []
            for situation in SITUATIONS:
                off = results.errors(method, count, noise_db, situation, kind, mattering)
                before = results.errors(method, count, noise_db, BEFORE, kind, mattering)
                cells.append(cell(off, None if situation == BEFORE else before))
            if any(cells):
                shown = "none" if method in moved.UNTRAINED else f"{count}"
                label = method if ran >= most else f"{method} ({ran} of {most} seeds)"
                lines.append(f"| {shown} | {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def cell(off: np.ndarray | None, before: np.ndarray | None) -> str:
    """Median / 90th percentile, and the ratio of medians after and before."""
    if off is None or not len(off):
        return ""
    text = f"{np.median(off):.2f} / {np.percentile(off, 90):.2f}"
    return text if before is None else f"{text} (x {ratio(off, before):.2f})"


def ratio(after: np.ndarray, before: np.ndarray) -> float:
    return float(np.median(after) / np.median(before))


def mattering_share(results: Results) -> str:
    """How many test links matter, by situation."""
    found = []
    for situation in SITUATIONS:
        seen = {}
        for r in results.every:
            for kind, true in r.truth[situation].items():
                seen[r.case.seed, kind] = matters(true)
        every = np.concatenate(list(seen.values()))
        found.append(f"{situation} {int(every.sum())} of {len(every)}")
    return ", ".join(found)


def picture(results: Results, path: Path) -> None:
    """Median error by situation, a panel per number of readings; links that matter."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    noise = results.noises[-1]
    figure, axes = pyplot.subplots(
        1, len(results.counts), figsize=(4.2 * len(results.counts), 4.0), sharey=True, squeeze=False
    )
    shown = [m for m in results.methods if m not in (moved.BLANK, moved.EMPTY_ROOM)]
    colours = pyplot.get_cmap("tab10").colors  # type: ignore[attr-defined]
    for axis, count in zip(axes[0], results.counts, strict=True):
        for method in shown:
            values = []
            for situation in SITUATIONS:
                off = results.errors(method, count, noise, situation, HEARD, True)
                values.append(np.nan if off is None or not len(off) else float(np.median(off)))
            base = method.removesuffix(moved.RETRAINED)
            style = ":" if base != method else "--" if method == moved.KNOWN else "-"
            style = "-." if method == moved.TWICE else style
            order = [m for m in shown if not m.endswith(moved.RETRAINED)].index(base)
            axis.plot(
                range(len(SITUATIONS)),
                values,
                style,
                marker="o",
                ms=4,
                color="black"
                if method in (moved.OURS, moved.KNOWN, moved.TWICE)
                else colours[order % 10],
                lw=2.2 if method == moved.OURS else 1.2,
                label=method,
            )
        axis.set_title(f"{count} readings")
        axis.set_xticks(range(len(SITUATIONS)), SITUATIONS)
        axis.grid(alpha=0.3)
    axes[0][0].set_ylim(bottom=0.0)  # after all panels, which share it
    axes[0][0].set_ylabel("median |error| [dB]")
    axes[0][-1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"part-{path.name}")
    figure.savefig(beside, dpi=110)
    beside.replace(path)
    pyplot.close(figure)
