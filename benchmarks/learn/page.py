"""docs/learning.md: tables of errors, coverage and times, and the error CDF."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learn.cases import Case
from learn.methods import Entry
from learn.store import Outcome

REFUSED, MISSING = "-", ""
SHOWN_DENSITIES = (0.175, 3.0)  # one row of pictures each


@dataclass(frozen=True)
class Result:
    case: Case
    method: str
    outcome: Outcome


def tables(results: Sequence[Result], methods: dict[str, Entry]) -> str:
    """Markdown: per data set errors, coverage and times; a cell is over all seeds."""
    parts = []
    for data_set in dict.fromkeys(r.case.data_set for r in results):
        mine = [r for r in results if r.case.data_set == data_set]
        names = [m for m in methods if any(r.method == m for r in mine)]
        unsure = [n for n in names if any(has_std(r) for r in mine if r.method == n)]
        parts += [
            f"### {data_set}: errors\n",
            "Median / 90th percentile of the absolute error of received readings [dB]; the least of "
            "each row in bold.\n",
            grid(mine, names, errors),
        ]
        rivals = [n for n in names if methods[n].baseline]
        ours = [n for n in names if n.endswith("residual")]
        if rivals and ours:
            parts += [
                f"\n### {data_set}: against the best baseline\n",
                "The least median and the least 90th percentile of any baseline, and ours over it.\n",
                against(mine, rivals, ours),
            ]
        if unsure:
            parts += [
                f"\n### {data_set}: coverage of the 90 % interval\n",
                "Share of test readings inside, for the methods that give an interval.\n",
                grid(mine, unsure, covers),
                "",
                overall(mine, unsure),
            ]
        parts += [
            f"\n### {data_set}: seconds per fit\n",
            "Wall time of the fit, then of all predictions: medians over the seeds.\n",
            grid(mine, names, times),
            "",
        ]
    return "\n".join(parts)


def against(results: Sequence[Result], rivals: Sequence[str], ours: Sequence[str]) -> str:
    """A row per crop, split and density, of methods that ran for all seeds."""
    titles = [f"{name}: {what}" for name in ours for what in ("median", "90th percentile")]
    lines = ["| crop | split | readings/sq ft | best median | best 90th percentile | "]
    lines[0] += " | ".join(titles) + " |"
    lines.append("|---" * (5 + len(titles)) + "|")
    cells = by_row(results)
    for key in dict.fromkeys(k for k, _ in cells):
        seeds = max(len(column) for (k, _), column in cells.items() if k == key)
        found = {n: pooled(cells[key, n]) for n in (*rivals, *ours) if len(cells[key, n]) == seeds}
        told = {n: pair for n, pair in found.items() if pair is not None}
        best = [min(((told[n][i], n) for n in rivals if n in told), default=None) for i in (0, 1)]
        said = [MISSING if b is None else f"{b[0]:.2f} ({b[1]})" for b in best]
        for name in ours:
            for i, b in enumerate(best):
                known = b is not None and name in told
                said.append(f"{told[name][i] / b[0]:.2f}" if b is not None and known else MISSING)
        lines.append(f"| {key[0]} | {key[1]} | {key[2]:g} | " + " | ".join(said) + " |")
    return "\n".join(lines)


def overall(results: Sequence[Result], names: Sequence[str]) -> str:
    """Coverage of each crop, all its splits, densities and seeds together."""
    lines = ["| crop | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for crop in dict.fromkeys(r.case.crop for r in results):
        columns = [
            [r.outcome for r in results if r.case.crop == crop and r.method == name]
            for name in names
        ]
        lines.append(f"| {crop} | " + " | ".join(covers(columns)) + " |")
    return "\n".join(lines)


Row = tuple[str, str, float]


def by_row(results: Sequence[Result]) -> dict[tuple[Row, str], list[Outcome]]:
    """The outcomes of all seeds, by crop, split and density, and by method."""
    cells = defaultdict(list)
    for r in results:
        cells[(r.case.crop, r.case.split, r.case.density), r.method].append(r.outcome)
    return cells


def has_std(result: Result) -> bool:
    found = result.outcome.score
    return found is not None and found.coverage is not None


def grid(
    results: Sequence[Result],
    names: Sequence[str],
    row: Callable[[Sequence[Sequence[Outcome]]], list[str]],
) -> str:
    """A table with a row per crop, split and density; ``row`` writes its cells."""
    cells = by_row(results)
    keys = dict.fromkeys(key for key, _ in cells)
    lines = ["| crop | split | readings/sq ft | seeds | " + " | ".join(names) + " |"]
    lines.append("|---" * (len(names) + 4) + "|")
    for key in keys:
        columns = [cells[key, name] for name in names]
        seeds = max(len(c) for c in columns)
        said = [
            f"{cell} ({len(column)})" if 0 < len(column) < seeds and cell != REFUSED else cell
            for cell, column in zip(row(columns), columns, strict=True)
        ]
        density = f"{key[2]:g}" if key[2] else ""
        lines.append(f"| {key[0]} | {key[1]} | {density} | {seeds} | " + " | ".join(said) + " |")
    return "\n".join(lines)


def errors(columns: Sequence[Sequence[Outcome]]) -> list[str]:
    """Median and 90th percentile; the least in bold, among methods that ran for all the seeds."""
    seeds = max(len(c) for c in columns)
    pairs = [pooled(column) for column in columns]
    whole = [p for p, c in zip(pairs, columns, strict=True) if p is not None and len(c) == seeds]
    best = [min((p[i] for p in whole), default=0.0) for i in (0, 1)]
    said = []
    for column, pair in zip(columns, pairs, strict=True):
        if pair is None:
            said.append(blank(column))
        elif len(column) == seeds:
            said.append(f"{bold(pair[0], best[0])} / {bold(pair[1], best[1])}")
        else:
            said.append(f"{pair[0]:.2f} / {pair[1]:.2f}")
    return said


def pooled(column: Sequence[Outcome]) -> tuple[float, float] | None:
    """Median and 90th percentile [dB] of the errors of all seeds together, None without one."""
    every = [error for outcome in column for error in outcome.error_db]
    return (float(np.median(every)), float(np.percentile(every, 90))) if every else None


def bold(value: float, best: float) -> str:
    text = f"{value:.2f}"
    return f"**{text}**" if text == f"{best:.2f}" else text


def covers(columns: Sequence[Sequence[Outcome]]) -> list[str]:
    said = []
    for column in columns:
        scores = [o.score for o in column if o.score is not None and o.score.coverage is not None]
        inside = sum(s.coverage * s.readings for s in scores if s.coverage is not None)
        total = sum(s.readings for s in scores)
        said.append(f"{100.0 * inside / total:.0f} %" if total else blank(column))
    return said


def times(columns: Sequence[Sequence[Outcome]]) -> list[str]:
    return [
        f"{seconds([o.fit_s for o in c])}, {seconds([o.predict_s for o in c])}" if c else MISSING
        for c in columns
    ]


def seconds(values: Sequence[float]) -> str:
    middle = float(np.median(values))
    return f"{middle:.0f}" if middle >= 10.0 else f"{middle:.2g}"


def blank(column: Sequence[Outcome]) -> str:
    return REFUSED if column else MISSING


def described(methods: dict[str, Entry]) -> str:
    rows = ["| method | |", "|---|---|"]
    for name, entry in methods.items():
        budget = f" Budget: {entry.budget}." if entry.budget else ""
        rows.append(f"| {name} | {entry.said}.{budget} |")
    return "\n".join(rows)


def cdf_picture(results: Sequence[Result], methods: dict[str, Entry], path: Path) -> None:
    """Share of absolute errors below a value: a row per density and split, a column per crop."""
    from matplotlib.figure import Figure

    from rfsg.learn.protocol import error_cdf

    crops = list(dict.fromkeys(r.case.crop for r in results))
    rows = [(split, d) for split in ("random", "blocks") for d in SHOWN_DENSITIES]
    figure = Figure(figsize=(4.2 * len(crops), 3.2 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), len(crops), squeeze=False)
    at = np.linspace(0.0, 30.0, 301)
    for line, (split, density) in zip(panels, rows, strict=True):
        for axes, crop in zip(line, crops, strict=True):
            for i, name in enumerate(methods):
                errors = [
                    r.outcome.error_db
                    for r in results
                    if (r.method, r.case.crop, r.case.split, r.case.density)
                    == (name, crop, split, density)
                ]
                joined = np.concatenate([np.array(e) for e in errors]) if errors else np.array([])
                if len(joined):
                    axes.plot(at, error_cdf(joined, at), label=name, color=f"C{i}")
            axes.set(title=f"{crop}, {split}, {density:g}/sq ft", ylim=(0, 1), xlim=(0, 30))
            axes.grid(alpha=0.3)
    for axes in panels[-1]:
        axes.set_xlabel("absolute error [dB]")
    for line in panels:
        line[0].set_ylabel("share of readings")
    panels[0][0].legend(fontsize=8, loc="lower right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
