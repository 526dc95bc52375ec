"""Every example runs as it stands, from any folder, and says something."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import rfsg

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))
QUICK = "02_move_the_cabinet"  # it begins as the first one does; the third one fits for long


@pytest.mark.parametrize(
    "example",
    [pytest.param(e, id=e.stem, marks=[pytest.mark.slow] * (e.stem != QUICK)) for e in EXAMPLES],
)
def test_an_example_runs(example, tmp_path):
    done = subprocess.run(
        [sys.executable, str(example)], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout and "nan" not in done.stdout


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda file: file.stem)
def test_an_example_asks_for_what_there_is(example):
    """Every name that it takes from a module, and from rfsg itself."""
    asked = list(ast.walk(ast.parse(example.read_text())))
    for node in asked:
        if isinstance(node, ast.ImportFrom):
            module = import_module(node.module)
            assert all(hasattr(module, name.name) for name in node.names)
    mine = [n for n in asked if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)]
    names = {n.attr for n in mine if n.value.id == "rfsg"}
    assert names and all(hasattr(rfsg, name) for name in names)
