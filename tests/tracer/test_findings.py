"""What docs/tradeoff.md advises: figures are those of the outcomes, and a run that lacks them is named."""

import importlib
import math
import sys
from pathlib import Path

import pytest

from rfsg.tracer.compared import Difference
from rfsg.tracer.tradeoff import Outcome, Tradeoff, with_front
from tests.scenes import room

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def findings():
    """benchmarks/findings.py, by its own name as the scripts beside it import it."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("findings")
    finally:
        sys.path.remove(str(BENCHMARKS))


def outcome(setting, seconds, error_db, arrival_ns=0.0):
    error = Difference(error_db, error_db, error_db, 0.0, 0.25, arrival_ns)
    return Outcome(setting, {}, seconds, 1, None, 7, True, error, 0.5)


def street(*outcomes, left_out=()):
    return Tradeoff(room(), 1e9, 4, "best", True, 1.0, with_front(outcomes), left_out, None)


def test_nothing_measured_leaves_nothing_but_advice(findings):
    said = findings.say(findings.Measured({}, [], None)).strip().split("\n")
    assert len(said) == len(findings.FINDINGS) >= 5
    assert all("*Not shown by this run: " in line for line in said)
    assert [line.split(".")[0] for line in said] == [str(k + 1) for k in range(len(said))]


def test_figures_are_those_of_the_outcomes(findings):
    scene = street(outcome("three bounces", 2.0, 4.0, 50.0), outcome("standard", 6.0, 1.0, 0.0))
    told = findings.delays(findings.Measured({"street": scene}, [], None))
    assert "50 ns off without edges and 0 ns with one" in told.text and told.holds
    measured = findings.Measured({"street": scene}, [], None)
    assert measured.dearer("street", "standard", "three bounces") == "3 times"
    assert measured.error("street", "standard") == 1.0


def test_a_run_that_contradicts_the_advice_says_so(findings):
    scene = street(outcome("three bounces", 2.0, 4.0, 1.0), outcome("standard", 6.0, 1.0, 90.0))
    measured = findings.Measured({"street": scene}, [], None)
    assert not findings.delays(measured).holds
    line = next(x for x in findings.say(measured).split("\n") if "Delays" in x)
    assert "does not bear it out" in line


def test_an_equal_setting_stands_for_one_that_was_not_run(findings):
    scene = street(
        outcome("standard", 1.0, 2.0), left_out=("base: the same as 'standard' on this scene",)
    )
    measured = findings.Measured({"street": scene}, [], None)
    assert measured.at("street", "base") is measured.at("street", "standard")
    with pytest.raises(findings.Missing, match="`depth 9` was not run on street"):
        measured.at("street", "depth 9")


def test_a_promise_is_counted(findings):
    rows = [{"true_db": t, "error_db": 0.8, "saving": 2.0} for t in (0.2, 0.4, 1.2)]
    told = findings.accuracy(findings.Measured({}, rows, None))
    assert "2 of 3" in told.text and "0.5 of the estimated" in told.text and not told.holds


def test_a_link_that_is_lost_has_no_figure(findings):
    assert findings.db(math.inf) == "no limit (a link is lost)"
    assert findings.db(0.5) == "0.5 dB"
