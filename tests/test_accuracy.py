"""benchmarks/mechanisms.py: its cheapest tables are of the right kind, and every bound is checked."""

import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture(scope="module")
def mechanisms():
    """The script as a module; its neighbours as it imports them itself."""
    before = set(sys.modules)
    sys.path.insert(0, str(BENCHMARKS))
    import mechanisms

    yield mechanisms
    sys.path.remove(str(BENCHMARKS))
    for name in set(sys.modules) - before:
        if name.split(".")[0] in ("mechanisms", "accuracy", "machine"):
            del sys.modules[name]


@pytest.fixture(scope="module")
def cheap(mechanisms):
    """Tables that take a second each."""
    from accuracy import edges, solids

    return [edges.near(), solids.point_source()]


@pytest.fixture
def run(mechanisms, monkeypatch, tmp_path):
    """What the script makes of given tables: the page, if it writes one."""
    page = tmp_path / "accuracy.md"
    monkeypatch.setattr(mechanisms, "PAGE", page)

    def with_tables(tables):
        makers = [lambda t=t: t for t in tables]
        monkeypatch.setattr(mechanisms, "TOPICS", [SimpleNamespace(TABLES=makers)])
        mechanisms.main(["--write-docs"])
        return page.read_text()

    return SimpleNamespace(page=page, of=with_tables)


def doctored(table, row, column, value):
    """The table with one figure replaced."""
    rows = list(table.rows)
    figures = list(rows[row].figures)
    figures[column] = replace(figures[column], value=value)
    rows[row] = replace(rows[row], figures=tuple(figures))
    return replace(table, rows=tuple(rows))


def test_cheap_tables_hold_and_say_what_they_compare(cheap):
    for table in cheap:
        assert table.broken() == []
        assert "against" in table.told and "tests/" in table.told  # a truth, and where it lives
        for row in table.rows:
            assert len(row.figures) == len(table.columns)
            assert all(math.isfinite(f.value) and 0 < f.bound < 1 for f in row.figures)


def test_a_page_has_head_machine_and_every_row(mechanisms, cheap, run):
    text = run.of(cheap)
    assert text.startswith("# Accuracy\n") and "benchmarks/mechanisms.py --write-docs" in text
    machine = next(line for line in text.splitlines() if line.startswith("Measured on "))
    for word in (" cores, ", "Python ", "torch ", " commit"):
        assert word in machine
    for table in cheap:
        assert f"\n## {table.title}\n" in text
        for row in table.rows:
            assert f"\n| {row.case} | {' | '.join(map(str, row.figures))} |\n" in text
    assert not list(run.page.parent.glob("*.part"))


def test_the_page_in_docs_is_of_this_script(mechanisms, cheap):
    """Its tables, rows and bounds, whatever was measured."""
    text = (ROOT / "docs" / "accuracy.md").read_text()
    assert text.startswith(mechanisms.HEAD)
    assert text.count("\n## ") == sum(len(topic.TABLES) for topic in mechanisms.TOPICS)
    for table in cheap:
        section = text.split(f"## {table.title}\n")[1].split("\n## ")[0]
        for row in table.rows:
            line = next(x for x in section.splitlines() if x.startswith(f"| {row.case} |"))
            bounds = [str(f).split()[-1] for f in row.figures]
            assert [cell.split()[-1] for cell in line.split("|")[2:-1]] == bounds


def test_every_bound_is_checked(cheap, run):
    """A figure just beyond it, far below zero, or no number is told by table, row and column, ends the
    script with an error and leaves no page."""
    for table in cheap:
        for r, row in enumerate(table.rows):
            for c, figure in enumerate(row.figures):
                for value in (1.001 * figure.bound, -2.0 * figure.bound, math.nan, math.inf):
                    (words,) = doctored(table, r, c, value).broken()
                    assert words.startswith(f"{table.title}: {row.case}, {table.columns[c]}: ")
    with pytest.raises(SystemExit, match="beyond their bounds:\n.*half plane") as end:
        run.of([doctored(cheap[0], 3, 1, 1.0), *cheap[1:]])
    assert end.value.code and not run.page.exists()


def test_no_figure_without_a_bound_and_no_row_without_its_figures(mechanisms):
    from accuracy.table import Figure, Row, Table

    for bound in (0.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="expected a bound above 0"):
            Figure(0.1, bound)
    with pytest.raises(ValueError, match="one figure per column"):
        Table("t", "told", ("a", "b"), (Row("case", (Figure(0.1, 0.2),)),))


@pytest.mark.parametrize(
    ("figure", "text"),
    [
        ((0.00123, 0.005, "%"), "0.12 % (0.5)"),
        ((-0.0415, 0.05, "%"), "-4.2 % (5)"),
        ((-2.952, 3.0, "dB"), "-2.95 dB (3)"),
    ],
)
def test_cells(mechanisms, figure, text):
    from accuracy.table import Figure

    assert str(Figure(*figure)) == text
