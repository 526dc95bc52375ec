"""The summary of what was asked and reached: it can read every table that it is made of."""

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def goals():
    """benchmarks/goals.py, by its own name as the scripts beside it import it."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("goals")
    finally:
        sys.path.remove(str(BENCHMARKS))


def test_a_figure_is_read_with_its_spread(goals):
    assert goals.Cell.read("62.2 (59.7 to 72.6)") == goals.Cell(62.2, 59.7, 72.6)
    assert goals.Cell.read("1.85e+03") == goals.Cell(1850.0, 1850.0, 1850.0)
    assert str(goals.Cell.read("0.25 s")) == "0.25"
    with pytest.raises(ValueError, match="expected a figure"):
        goals.Cell.read("none")


def test_tables_are_found_by_heading_row_and_column(goals, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "| a | b |\n|---|---|\n| x | 1 |\n\n## Two\n\n| a | b |\n|---|---|\n| x | 2 |\n"
    )
    table = next(goals.tables(page, "## Two"))
    assert table.text("b", "x") == "2"
    with pytest.raises(KeyError, match="no row"):
        table.text("b", "y")


def test_every_goal_is_read_from_the_pages(goals):
    lines = [str(goal) for part in goals.PARTS for goal in part()]
    assert len(lines) == 12
    assert all(line.endswith("met |") or "**missed**. " in line for line in lines)
    assert all("**missed**.  |" not in line for line in lines)  # what is missed says why
