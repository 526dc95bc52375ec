"""A fast part of benchmarks/stability.py: nothing at the extremes is wrong without a word.

Every table of docs/stability.md, with a few of its rows: each is within its limit of a closed form in
50 digits and has finite gradients, or a footnote says why not.
"""

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
TOPICS = {
    "waves": ("frequency", "distance", "size", "thickness", "incidence"),
    "matter": ("laws", "sharpness", "material", "alpha", "bands"),
    "places": ("radios", "objects", "vertices", "depth", "count"),
    "networks": ("precision", "degenerate"),
}
SLOW = ("precision",)
CASES = [
    pytest.param(topic, name, id=name, marks=[pytest.mark.slow] if name in SLOW else [])
    for topic, names in TOPICS.items()
    for name in names
]


@pytest.fixture(scope="module")
def extremes():
    """The benchmark's own modules, as its script imports them."""
    before = set(sys.modules)
    sys.path.insert(0, str(BENCHMARKS))
    from importlib import import_module

    yield {topic: import_module(f"extremes.{topic}") for topic in TOPICS}
    sys.path.remove(str(BENCHMARKS))
    for name in set(sys.modules) - before:
        if name.split(".")[0] == "extremes":
            del sys.modules[name]


def test_no_table_is_left_out(extremes):
    for topic, names in TOPICS.items():
        assert tuple(make.__name__ for make in extremes[topic].SECTIONS) == names


@pytest.mark.parametrize(("topic", "name"), CASES)
def test_every_row_is_right_or_explained(extremes, topic, name):
    section = getattr(extremes[topic], name)(True)
    assert section.rows and section.truth and section.valid
    assert section.unexplained() == []
    for row in section.rows:
        assert row.gradient is not False  # no footnote excuses a gradient that is not finite
        numbers = [e for e in row.errors if e is not None]
        assert all(0.0 <= e < 1.0 for e in numbers), row


def test_a_wrong_row_would_be_told(extremes):
    from extremes.table import Note, Row, Section

    rows = (
        Row("right", (1e-12,), "OK 2", True),
        Row("wrong", (1e-3,), "OK 2", True),
        Row("not finite", (0.0,), "OK 2", False),
        Row("no number", (float("nan"),), "OK 2", True),
        Row("no path", (None,), "OPAQUE 1", True),
        Row("explained", (1e-3,), "OK 2", True, Note("because.", "Do this.")),
        Row("right as it is", (0.0,), "OK 2, DUPLICATE 1", True, expected=True),
    )
    section = Section("t", "truth", ("error",), rows, "valid")
    bad = ["wrong", "not finite", "no number", "no path"]
    assert [row.case for row in section.unexplained()] == bad
