"""The house keeps its floors and doors, and is cheap to enter."""

import subprocess
import sys
from pathlib import Path

import pytest

import rfsg

ROOT = Path(__file__).parents[1]


def test_imports_point_one_way_and_heavy_packages_have_one_door():
    """The contracts are in pyproject.toml, [tool.importlinter]."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as f; f()"]
    done = subprocess.run([*command, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("statement", ["import rfsg", "import rfsg.cli", "import rfsg.report"])
def test_the_door_is_light(statement):
    """Nothing heavy is loaded before it is used: `rfsg --help` answers at once."""
    heavy = {"torch", "pxr", "trimesh", "manifold3d", "embreex", "matplotlib", "scipy", "skimage"}
    code = f"{statement}; import sys; print(*({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, [], "")


def test_an_answer_on_boxes_loads_no_more_than_it_needs():
    """From the start of a process to the channel of a room: torch and Embree, and nothing else heavy."""
    heavy = {"pxr", "trimesh", "matplotlib", "scipy", "sympy", "torch._dynamo", "torch._inductor"}
    code = (
        "import rfsg, sys; from tests.scenes import room; rfsg.simulate(room(), quality='draft');"
        f"rfsg.radio_map(room(), cell=2.0, method='images'); print(*({heavy!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, [], "")


@pytest.mark.parametrize("name", rfsg.__all__)
def test_every_public_name_leads_somewhere(name):
    assert getattr(rfsg, name).__doc__
    assert name in dir(rfsg)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        rfsg.nonsense  # noqa: B018


def test_no_pickle_anywhere():
    """Files are data: nothing that is read can run code."""
    for file in (ROOT / "rfsg").rglob("*.py"):
        text = file.read_text()
        assert "import pickle" not in text and "torch.load" not in text, file
        assert "allow_pickle=True" not in text, file
