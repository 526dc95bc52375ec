"""Checkpoints of a training: tensors and JSON in one safetensors file, written beside, then renamed."""

import json
import os
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from rfsg.learn.errors import LearnError


def save_checkpoint(path: Path, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
    """One whole file or none: a kill at any moment leaves the last one."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        kept = {name: t.detach().clone().contiguous() for name, t in tensors.items()}
        save_file(kept, beside, metadata={"training": json.dumps(state)})
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def load_checkpoint(path: Path, job: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """(tensors, state). Raises LearnError for a file that is broken, or of another job."""
    try:
        with safe_open(path, framework="pt") as file:
            state = json.loads((file.metadata() or {}).get("training", "null"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, json.JSONDecodeError) as error:
        raise LearnError(f"{path}: not a checkpoint that can be read ({error})") from error
    if not isinstance(state, dict) or state.get("job") != job:
        raise LearnError(
            f"{path}: checkpoint of another fit (scene, measurements or settings differ): give "
            "another folder, or begin anew with overwrite and without resume"
        )
    return tensors, state


def under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names begin with ``prefix``, without it."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
