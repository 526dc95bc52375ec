"""What a page of tables says of where it was made, and how a page is written."""

import os
import platform
import subprocess
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]


def measured_on(seconds: float) -> str:
    """The machine, the versions and the commit, in one line."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return (
        f"Measured on {_processor()}, {torch.get_num_threads()} of {os.cpu_count()} cores, {gpu}, "
        f"{platform.system()}, Python {platform.python_version()}, torch {torch.__version__}, at "
        f"{_commit()}, in {seconds:.0f} s.\n"
    )


def write_section(page: Path, heading: str, *parts: str) -> None:
    """Put a section in the place of the one of its heading ("## ..."), or last."""
    text = page.read_text() if page.is_file() else ""
    before, found, rest = f"\n{text}".partition(f"\n{heading}\n")
    _, mark, after = rest.partition("\n## ") if found else ("", "", "")
    following = f"## {after}" if mark else ""
    write_page(page, before.strip(), "", heading, "", "\n".join(parts).strip(), "", following)


def write_page(page: Path, *parts: str) -> None:
    """Parts of a page, a blank line between; written beside, then renamed."""
    beside = page.with_name(page.name + ".part")
    beside.write_text("\n".join(parts).rstrip() + "\n")
    beside.replace(page)
    print(f"written: {page}")


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "an unnamed processor"


def _commit() -> str:
    try:
        name = _git("rev-parse", "--short", "HEAD")
        # a page that was just written is no change of what it measures
        changed = _git("status", "--porcelain", "--", ".", ":!docs")
    except (OSError, subprocess.CalledProcessError):
        return "no known commit"
    return f"commit {name}" + (" with later changes" if changed else "")


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()
