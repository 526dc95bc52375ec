"""Which files a scene may open, decided before any parser sees them.

A scene may come from a stranger. What it names must lie, links resolved, inside its roots; a
layer's size and nesting are bounded, since text layers take far more memory than disc and deep
nesting ends the process inside the USD parser. This does not bound composition (references that
multiply): read untrusted scenes in a child process with limits on time and memory.
"""

import csv
import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from rfsg.scene.errors import SceneError

MARKER = "rfsg-assets.toml"  # a file of this name makes its folder the root of the scenes below it
LAYER_SUFFIXES = (".usda", ".usd", ".usdc", ".usdz")
MAX_TEXT_BYTES = 64 * 2**20  # 20 million integers as text took 3.5 GB and 16 s to parse
MAX_LAYER_BYTES = 2**30
MAX_NESTING = 2000  # usd-core 26.11 survives 20,000 nested prims and dies at 100,000

# what may hold a brace without meaning one: strings, asset paths, comments; then the braces
_TOKENS = re.compile(
    rb'"""(?:[^\\]|\\.)*?"""|\'\'\'(?:[^\\]|\\.)*?\'\'\'|"(?:[^"\\\n]|\\.)*"|\'(?:[^\'\\\n]|\\.)*\''
    rb"|@@@.*?@@@|@[^@\n]*@|#[^\n]*|[{}]",
    re.DOTALL,
)


def default_root(scene: Path) -> Path:
    """The folder whose tree a scene may read: its nearest ancestor that holds a file named
    ``rfsg-assets.toml``, else its own folder."""
    folder = Path(os.path.realpath(scene)).parent
    return next((f for f in (folder, *folder.parents) if (f / MARKER).is_file()), folder)


def is_url(path: str) -> bool:
    return re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", path) is not None


@contextmanager
def open_csv(path: Path, limit: int) -> Iterator[TextIO]:
    """A CSV file of at most ``limit`` bytes, open. SceneError for one that cannot be opened or read."""
    try:
        if path.stat().st_size > limit:
            raise SceneError([f"{path}: larger than {limit} bytes"])
        with path.open(newline="", encoding="utf-8-sig") as file:
            yield file
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SceneError([f"{path}: not a CSV file that can be read: {error}"]) from error


def outer_file(path: str) -> str:
    """The file on disc: ``lab.usdz`` of ``lab.usdz[cabinet.safetensors]``."""
    return path.split("[", 1)[0]


def outside(path: str, roots: Sequence[Path]) -> str | None:
    """Why a path may not be read, or None: links are followed first, then it must lie in a root."""
    real = Path(os.path.realpath(outer_file(path)))
    if any(real.is_relative_to(os.path.realpath(root)) for root in roots):
        return None
    folders = ", ".join(str(r) for r in roots)
    return (
        f"lies outside the folders this scene may read ({folders}); "
        f"name its folder in asset_roots, or put a {MARKER} into a common folder above the scene"
    )


def unsafe_layer(path: str) -> str | None:
    """Why a layer file may not be handed to the USD parser, or None."""
    path = outer_file(path)
    if not os.path.isfile(path):
        return "there is no such file"
    if Path(path).suffix.lower() not in LAYER_SUFFIXES:
        return f"not a USD file; expected an ending of {', '.join(LAYER_SUFFIXES)}"
    size = os.path.getsize(path)
    if size > MAX_LAYER_BYTES:
        return f"{size} bytes; the limit for a layer is {MAX_LAYER_BYTES}"
    with open(path, "rb") as file:
        magic = file.read(8)
    if magic == b"PXR-USDC":
        return None
    if magic[:2] == b"PK":
        return _unsafe_package(path)
    if size > MAX_TEXT_BYTES:
        return f"{size} bytes of text; the limit is {MAX_TEXT_BYTES}: store data as .usdc"
    return _unsafe_text(Path(path).read_bytes())


def _unsafe_package(path: str) -> str | None:
    try:
        with zipfile.ZipFile(path) as package:
            for item in package.infolist():
                if not item.filename.lower().endswith(LAYER_SUFFIXES):
                    continue
                if item.file_size > MAX_TEXT_BYTES or item.compress_type != zipfile.ZIP_STORED:
                    return f"{item.filename} in the package is compressed or too large"
                data = package.read(item)
                reason = None if data[:8] == b"PXR-USDC" else _unsafe_text(data)
                if reason:
                    return f"{item.filename} in the package: {reason}"
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        return f"not a package that can be read: {error}"
    return None


def _unsafe_text(text: bytes) -> str | None:
    try:
        text.decode()
    except UnicodeDecodeError as error:
        return f"not UTF-8 text: byte {error.start}"
    depth = 0
    for match in _TOKENS.finditer(text):
        depth += {b"{": 1, b"}": -1}.get(match[0], 0)
        if depth > MAX_NESTING:
            return f"prims nest more than {MAX_NESTING} deep"
    return None
