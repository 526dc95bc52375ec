"""What is asked of learned objects that are moved, in a few figures: on the links that matter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from learn import moved
from learn.moved_page import AFTER, BEFORE, Results, cell, ratio
from learn.moved_rooms import HEARD, NEW

MOST, DOUBLE, WITHIN_DB = 1.3, 2.0, 1.0  # asked: rfsg after / before, interpolators', rfsg's error


@dataclass(frozen=True)
class Change:
    """A method's errors [dB] before, and in each situation after."""

    method: str
    before: np.ndarray
    after: dict[str, np.ndarray]

    @property
    def together(self) -> np.ndarray:
        return np.concatenate(list(self.after.values()))

    @property
    def ratios(self) -> dict[str, float]:
        """Median after / median before, by situation."""
        return {situation: ratio(off, self.before) for situation, off in self.after.items()}

    @property
    def ratio(self) -> float:
        """The same of all situations together."""
        return ratio(self.together, self.before)

    @property
    def high(self) -> float:
        """That of the 90th percentiles."""
        return float(np.percentile(self.together, 90) / np.percentile(self.before, 90))


def change(
    results: Results, method: str, count: int, noise_db: float, kinds: Sequence[str]
) -> Change | None:
    """Over all seeds and these kinds of links; None where the method says nothing of them."""

    def errors(situation: str) -> np.ndarray | None:
        every = [results.errors(method, count, noise_db, situation, k, True) for k in kinds]
        there = [off for off in every if off is not None]
        return np.concatenate(there) if there else None

    before = errors(BEFORE)
    after = {s: off for s in AFTER if (off := errors(s)) is not None}
    return None if before is None or not after else Change(method, before, after)


def compared(
    results: Results, method: str, count: int, noise_db: float
) -> tuple[Change, Change, Change] | None:
    """rfsg, the true materials, and the interpolator with the least median before."""
    ours = change(results, method, count, noise_db, (HEARD, NEW))
    known = change(results, moved.KNOWN, count, noise_db, (HEARD, NEW))
    every = [change(results, m, count, noise_db, (HEARD,)) for m in moved.INTERPOLATORS]
    there = [c for c in every if c is not None]
    if ours is None or known is None or not there:
        return None
    return ours, known, min(there, key=lambda c: float(np.median(c.before)))


def summary(results: Results) -> str:
    """Markdown: figures for each number of readings and noise."""
    lines = [
        "On the links that matter. Before: median / 90th percentile [dB]. After: how many times the "
        "median of the three situations together is that before (in brackets: the worst situation; for "
        "the best interpolator the least bad) / the same of the 90th percentile. rfsg and the true "
        f"materials are asked for {HEARD} and {NEW} together, interpolators, most of which know no "
        f"others, for {HEARD}.\n",
        "| readings | noise [dB] | method | seeds | before | after | true materials before | after | "
        "best interpolator before | after |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for count, noise, method in _rows(results):
        found = compared(results, method, count, noise)
        if found is not None:
            ours, known, best = found
            row = [f"{count}", f"{noise:g}", method, f"{results.seeds(method, count, noise)}"]
            row += [cell(ours.before, None), _grown(ours, max(ours.ratios.values()))]
            row += [cell(known.before, None), _grown(known, max(known.ratios.values()))]
            row += [f"{cell(best.before, None)} ({best.method})"]
            row += [_grown(best, min(best.ratios.values()))]
            lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def _rows(results: Results) -> list[tuple[int, float, str]]:
    return [
        (count, noise, method)
        for count in results.counts
        for noise in results.noises
        for method in (moved.OURS, moved.TWICE)
    ]


def _grown(of: Change, bracket: float) -> str:
    return f"x {of.ratio:.2f} (x {bracket:.2f}) / x {of.high:.2f}"


def met(results: Results) -> str:
    """Markdown: what was asked, what was measured, and whether that is met."""
    lines = ["| asked | method | readings, noise | measured | met |", "|---|---|---|---|---|"]
    for count, noise, method in _rows(results):
        found = compared(results, method, count, noise)
        if found is None:
            continue
        ours, _, best = found
        where = f"{count}, {noise:g} dB"
        worst, least = max(ours.ratios.values()), min(best.ratios.values())
        lines.append(
            f"| after at most {MOST:g} x before | {method} | {where} | x {ours.ratio:.2f}, worst "
            f"situation x {worst:.2f} | {_verdict(ours.ratio <= MOST, worst <= MOST)} |"
        )
        if count == 200:
            off, after = (float(np.median(e)) for e in (ours.before, ours.together))
            lines.append(
                f"| unseen links within {WITHIN_DB:g} dB median | {method} | {where} | {off:.2f} dB, "
                f"after the move {after:.2f} dB | {_verdict(off <= WITHIN_DB, off <= WITHIN_DB)} |"
            )
        if method == moved.OURS:
            lines.append(
                f"| interpolators at least double | {best.method} | {where} | x {best.ratio:.2f}, least "
                f"x {least:.2f} | {_verdict(best.ratio >= DOUBLE, least >= DOUBLE)} |"
            )
    return "\n".join(lines)


def by_seed(results: Results, count: int, noise_db: float) -> str:
    """Markdown: medians before [dB] and ratios after, seed by seed, beside the floor's."""
    lines = ["| seed | method | links before | before | after |", "|---|---|---|---|---|"]
    for seed in sorted({r.case.seed for r in results.every}):
        of = Results([r for r in results.every if r.case.seed == seed])
        for method in (moved.OURS, moved.TWICE, moved.KNOWN):
            found = change(of, method, count, noise_db, (HEARD, NEW))
            if found is not None:
                row = [f"{seed}", method, f"{len(found.before)}", cell(found.before, None)]
                row += [_grown(found, max(found.ratios.values()))]
                lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def _verdict(together: bool, each: bool) -> str:
    return "yes" if each else "together, not in each situation" if together else "no"
