"""The tables of docs/learning.md: pooled over seeds, ratios against the best baseline, coverage by crop."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from learn import page
from learn.cases import Case
from learn.methods import Entry
from learn.page import Result
from learn.store import Outcome

from rfsg.learn.baselines import Readings
from rfsg.learn.protocol import Score

ONE = Readings(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1, int), np.zeros(1))


def entry(baseline):
    return Entry(lambda case: None, "1", "said", baseline=baseline)  # type: ignore[arg-type, return-value]


METHODS = {"near": entry(True), "far": entry(True), "our residual": entry(False)}


def result(method, seed, errors, coverage=0.5, crop="W"):
    case = Case("set", crop, "random", 0.175, seed, ONE, ONE)
    found = Score(len(errors), float(np.median(errors)), float(np.percentile(errors, 90)), coverage)
    return Result(case, method, Outcome(found, tuple(errors), 1.0, 1.0))


def row(text, title):
    """Cells of the first row below the table whose head contains ``title``."""
    lines = text.splitlines()
    head = next(i for i, line in enumerate(lines) if title in line and line.startswith("|"))
    return dict(zip(cells(lines[head]), cells(lines[head + 2]), strict=True))


def cells(line):
    return [c.strip() for c in line.strip("|").split("|")]


def test_errors_of_all_seeds_count_together():
    results = [result("near", 0, [1.0]), result("near", 1, [3.0, 5.0, 7.0])]
    assert page.pooled([r.outcome for r in results]) == (4.0, pytest.approx(6.4))


def test_ratios_are_over_the_best_baseline_of_each_figure():
    results = [
        result("near", 0, [2.0, 2.0, 20.0]),
        result("far", 0, [4.0, 4.0, 4.0]),
        result("our residual", 0, [1.0, 1.0, 1.0]),
    ]
    said = row(page.tables(results, METHODS), "best median")
    assert said["best median"] == "2.00 (near)" and said["best 90th percentile"] == "4.00 (far)"
    assert said["our residual: median"] == "0.50"
    assert said["our residual: 90th percentile"] == "0.25"


def test_a_method_without_all_seeds_is_no_rival():
    results = [
        result("near", 0, [1.0]),
        *(result("far", s, [4.0]) for s in (0, 1)),
        *(result("our residual", s, [2.0]) for s in (0, 1)),
    ]
    said = row(page.tables(results, METHODS), "best median")
    assert said["best median"] == "4.00 (far)" and said["our residual: median"] == "0.50"


def test_coverage_of_a_crop_weighs_readings():
    results = [
        result("near", 0, [1.0] * 3, coverage=1.0),
        result("near", 1, [1.0], coverage=0.0),
        result("near", 0, [1.0], coverage=0.0, crop="NE"),
    ]
    table = page.overall(results, ["near"]).splitlines()
    assert cells(table[2]) == ["W", "75 %"] and cells(table[3]) == ["NE", "0 %"]
