"""Faults gathered, and pxr's own words turned into them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pxr import Tf, UsdUtils

from rfsg.scene.scene import SceneError

# the second comes of strings in binary layers that are not UTF-8
PXR_ERRORS = (Tf.ErrorException, UnicodeDecodeError)


@contextmanager
def quiet(path: str | Path) -> Iterator[None]:
    """Hold pxr's diagnostics: what matters is said again as faults, with prim paths. What pxr
    raises where nobody expects it (a corrupt crate, say) becomes a fault of the file."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    except PXR_ERRORS as error:
        raise SceneError([f"{path}: {pxr_words(error)}"]) from error
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


def pxr_words(error: Exception) -> str:
    """The message of a pxr exception without the names of its C++ functions."""
    try:
        text = str(error).strip()
    except UnicodeDecodeError:
        return "OpenUSD refuses it, in words that are not UTF-8"
    return one_line(text.split(" : '", 1)[-1].rstrip("'\n ") if " : '" in text else text)


def one_line(text: str) -> str:
    return " ".join(text.split())


def attempt(faults: list[str], step: Callable[[], Any]) -> Any:
    """What the step gives, or None with its faults noted."""
    try:
        return step()
    except SceneError as error:
        faults += error.faults
        return None
