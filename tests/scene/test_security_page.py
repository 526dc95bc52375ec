"""docs/security.md: every row of its tables names a test, and the test is there."""

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PAGE = REPOSITORY / "docs" / "security.md"
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")
LEAST = 40


def rows() -> list[list[str]]:
    """The cells of every row of the page's tables, heads and rules aside."""
    found = [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in PAGE.read_text().splitlines()
        if line.startswith("|")
    ]
    return [row for row in found if row[0] != "input" and set("".join(row)) - set("-: ")]


@pytest.mark.parametrize("row", rows(), ids=lambda row: row[0][:40])
def test_every_row_has_its_test(row):
    what, happens, tests = row
    named = TEST.findall(tests)
    assert what and happens and named
    for file, name in named:
        assert re.search(rf"^def {name}\(", (REPOSITORY / file).read_text(), re.MULTILINE), name


def test_the_table_is_whole():
    assert len(rows()) >= LEAST
    assert len({row[0] for row in rows()}) == len(rows())
