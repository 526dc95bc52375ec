"""Scenes of strangers, read by a child process that may crash, hang, grow or be taken over alone.

The child gives up the network, every folder but those that the scene may read, and all writing
(``confine``), reads and validates, and sends back plain numbers (``wire``). What comes of the file never
reaches OpenUSD in this process: a crash, a hang or too much memory is a sentence.
"""

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfsg.scene import confine
from rfsg.scene.errors import SceneError

if TYPE_CHECKING:
    import torch

    from rfsg.scene.importers.parts import Imported
    from rfsg.scene.scene import Scene
    from rfsg.scene.usd.validation import Findings

CHILD = ("-m", "rfsg.scene.sandbox")
KEPT = ("LANG", "LC_ALL", "LD_LIBRARY_PATH")  # of the environment, which may hold secrets
CHUNK = 2**20
GRACE = 10.0  # [s] from a child's last word to its end
UNCONFINED = {
    "files": "this system has no Landlock: the process that read the scene was limited in time and "
    "memory, but could have opened other files",
    "network": "this system lets no process leave the network: the one that read the scene had it",
}


@dataclass(frozen=True)
class Limits:
    """Of the child: seconds of processor time, and twice as many by the clock; bytes of address space,
    of which Python and its libraries take between 1 and 2 GiB."""

    seconds: float = 120.0
    memory: int = 4 * 2**30


def read(
    path: str | Path,
    limits: Limits | None = None,
    *,
    device: "torch.device | str" = "cpu",
    **options: Any,
) -> "Scene":
    """``Scene.from_usd`` in a limited child process; the same options, of a file only.

    The scene that comes back is one made in Python: it knows no file to be read again or written over,
    and no cache that lies beside weights is used. Raises SceneError: the faults that reading found,
    or that the child crashed, or ran out of time or memory.
    """
    from rfsg.scene import files, wire

    path = Path(path).absolute()
    roots = [str(Path(root).absolute()) for root in options.get("asset_roots", ())]
    asked = {"path": str(path), "options": options | {"asset_roots": roots}}
    message = ask("read", asked, [files.default_root(path), *roots], limits)
    scene = wire.scene_of(message, str(path), device)
    return _warned(scene, message[0].get("unconfined"))


def check(path: str | Path, limits: Limits | None = None, **options: Any) -> "Findings":
    """``rfsg.scene.usd.validation.findings`` in a limited child process."""
    from rfsg.scene import files, wire
    from rfsg.scene.usd.validation import Findings

    path = Path(path).absolute()
    roots = [str(Path(root).absolute()) for root in options.get("asset_roots", ())]
    asked = {"path": str(path), "options": options | {"asset_roots": roots}}
    head, _ = ask("check", asked, [files.default_root(path), *roots], limits)
    try:
        faults, notes = (tuple(map(wire.plain, head[name])) for name in ("found", "notes"))
    except wire.REFUSALS as error:
        raise SceneError([f"{path}: its reader sent what is no list of findings"]) from error
    return Findings(faults, notes)


def imported(
    source: str | Path,
    materials: str | Path | None,
    metre: float | None,
    up: str | None,
    limits: Limits | None = None,
) -> "Imported":
    """``rfsg.scene.importers.api.imported_file`` in a limited child process."""
    from rfsg.scene.importers.sent import imported_of

    source = Path(source).absolute()
    table = None if materials is None else str(Path(materials).absolute())
    asked = {"path": str(source), "materials": table, "metre": metre, "up": up}
    folders = [Path(os.path.realpath(source)).parent, *([table] if table else [])]
    return imported_of(ask("import", asked, folders, limits), str(source))


def _warned(scene: "Scene", unconfined: Any) -> "Scene":
    from dataclasses import replace

    more = tuple(UNCONFINED[name] for name in UNCONFINED if name in (unconfined or ()))
    return replace(scene, warnings=scene.warnings + more)


# the parent's side


def ask(
    job: str,
    asked: Mapping[str, Any],
    folders: Sequence[str | Path],
    limits: Limits | None = None,
) -> tuple[dict[str, Any], list[bytes]]:
    """The child's answer to one question: (head, blobs). Raises SceneError for faults and for a child
    that did not come to an answer."""
    if os.name != "posix":
        raise SceneError([f"{asked['path']}: untrusted files are read on Linux and macOS only"])
    from rfsg.scene import wire

    limits = limits or Limits()
    question = {"job": job, "asked": asked, "folders": [str(f) for f in folders]}
    try:
        question["limits"] = asdict(limits)
        text = json.dumps(question).encode()
    except (TypeError, ValueError) as error:
        raise SceneError([f"{asked['path']}: options that cannot be sent: {error}"]) from error
    data, ended = _answer(text, 2 * limits.seconds, wire.MAX_BYTES)
    why = _ended(ended, limits)
    if why is not None:
        raise SceneError([f"{asked['path']}: {why}"])
    try:
        head, blobs = wire.unpacked(data)
        faults = [wire.plain(fault) for fault in head.get("faults", ())]
    except wire.REFUSALS as error:
        raise SceneError([f"{asked['path']}: its reader sent no answer: {error}"]) from error
    if faults:
        raise SceneError(faults)
    return head, blobs


def _answer(question: bytes, seconds: float, most: int) -> tuple[bytes, int | str]:
    """(what the child wrote, its exit status or why it was ended)."""
    source, sink = os.pipe()
    command = [sys.executable, "-P", *CHILD, str(sink)]
    own = str(Path(__file__).parents[2])
    environment = {k: v for k, v in os.environ.items() if k in KEPT}
    environment |= {"PYTHONPATH": own, "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1",
                    "PXR_WORK_THREAD_LIMIT": "1", "MALLOC_ARENA_MAX": "2"}  # fmt: skip
    quiet = subprocess.DEVNULL
    child = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, env=environment, cwd="/",
        pass_fds=(sink,), start_new_session=True,
    )  # fmt: skip
    os.close(sink)
    try:
        assert child.stdin is not None
        child.stdin.write(question)
        child.stdin.close()
        data = _drained(source, time.monotonic() + seconds, most)
        if isinstance(data, str):
            return b"", data
        return data, child.wait(timeout=GRACE)
    except (BrokenPipeError, subprocess.TimeoutExpired):
        ended = child.poll()
        return b"", "time" if ended is None else ended
    finally:
        os.close(source)
        with suppress(ProcessLookupError, PermissionError):  # also what the child may have started
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()


def _drained(source: int, deadline: float, most: int) -> bytes | str:
    """All that comes through a pipe, or which limit it broke: "time" or "size"."""
    chunks, size = [], 0
    with selectors.DefaultSelector() as ready:
        ready.register(source, selectors.EVENT_READ)
        while ready.select(max(0.0, deadline - time.monotonic())):
            chunk = os.read(source, CHUNK)
            if not chunk:
                return b"".join(chunks)
            chunks.append(chunk)
            size += len(chunk)
            if size > most:
                return "size"
    return "time"


def _ended(how: int | str, limits: Limits) -> str | None:
    """Why there is no answer, None where there is one."""
    advice = f"more than {limits.seconds:g} s; it is hostile, or needs more time (limits)"
    if how == "size":
        return "holds more than one process takes from another"
    if how == "time" or how in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"reading it takes {advice}"
    if isinstance(how, int) and how < 0:
        return (
            f"reading it ends its process ({signal.Signals(-how).name}); it is hostile, or takes more "
            f"than {limits.memory} bytes of memory"
        )
    return None if how == 0 else f"its reader ended with status {how}"


# the child's side


def _read(path: str, options: dict[str, Any]) -> Any:
    from rfsg.scene import usd, wire

    return wire.scene_message(usd.read(path, **options))


def _check(path: str, options: dict[str, Any]) -> Any:
    from rfsg.scene.usd.validation import findings

    found = findings(path, **options)
    return {"found": found.faults, "notes": found.notes}, []


def _import(path: str, **options: Any) -> Any:
    from rfsg.scene.importers.api import imported_file
    from rfsg.scene.importers.sent import imported_message

    return imported_message(imported_file(Path(path), **options))


JOBS: dict[str, Callable[..., Any]] = {"read": _read, "check": _check, "import": _import}


def main() -> None:
    """Answer the one question on standard input through the pipe that the command line names."""
    question = json.loads(sys.stdin.buffer.read())
    limits = Limits(**question["limits"])
    unconfined = [] if confine.close_network() else ["network"]
    unconfined += [] if confine.close_files(question["folders"]) else ["files"]
    confine.limit(**asdict(limits))
    from rfsg.scene import wire

    path = question["asked"]["path"]
    try:
        head, blobs = JOBS[question["job"]](**question["asked"])
        answer = wire.packed(head | {"unconfined": unconfined}, blobs)
    except SceneError as error:
        answer = wire.packed({"faults": error.faults})
    except MemoryError:
        answer = wire.packed({"faults": [f"{path}: takes more than {limits.memory} bytes"]})
    except Exception as error:
        answer = wire.packed({"faults": [f"{path}: {type(error).__name__}: {error}"]})
    with os.fdopen(int(sys.argv[1]), "wb") as pipe:
        pipe.write(answer)
        pipe.flush()
    os._exit(0)  # what a damaged file left behind need not be taken down in order


if __name__ == "__main__":
    main()
