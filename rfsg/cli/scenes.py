"""The scene that a command works on: read as its options say, and edited; and where it runs."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rfsg.cli.parse import parse_move, parse_pair, parse_variants

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene


def must_exist(file: Path) -> None:
    if not file.exists() or file.is_dir():
        raise FileNotFoundError(2, "no such file", str(file))


def read_scene(file: Path, roots: list[Path], variants: list[str], time: float | None) -> "Scene":
    must_exist(file)
    options = reading_options(roots, variants, time)
    from rfsg.scene.scene import Scene

    return Scene.from_usd(file, **options)


def reading_options(roots: list[Path], variants: list[str], time: float | None) -> dict[str, Any]:
    """The options of ``rfsg.scene.usd.read`` that were given."""
    for root in roots:
        if not root.is_dir():
            raise typer.BadParameter(f"--asset-root {root}: no such folder")
    if time is not None and not math.isfinite(time):
        raise typer.BadParameter(f"--time {time}: expected a finite time code")
    chosen = parse_variants(variants)
    return {"asset_roots": roots, "variants": chosen, "time": time}


def edit(
    scene: "Scene",
    moves: list[str],
    replacements: list[str],
    removals: list[str],
    receivers: Path | None = None,
) -> "Scene":
    """The scene after the edits of the command line: replaced, moved, left out, re-equipped."""
    for text in replacements:
        path, asset = parse_pair(text, "PATH=ASSET, as in /World/Cabinet=desk.usda")
        must_exist(Path(asset))
        scene = scene.replaced(path, asset)
    for text in moves:
        path, metres = parse_move(text)
        scene = scene.moved(path, metres)
    for path in removals:
        scene = scene.without(path)
    if receivers is not None:
        from rfsg.scene.receivers import from_csv

        must_exist(receivers)
        scene = scene.with_receivers(from_csv(receivers))
    return scene


def asked_of_scene(
    scene: Path,
    moves: list[str],
    replacements: list[str],
    removals: list[str],
    roots: list[Path],
    variants: list[str],
    time: float | None,
) -> dict[str, Any]:
    """What report.json says of how the scene was read and edited."""
    asked = {"scene": str(scene), "move": moves, "replace": replacements, "without": removals}
    return asked | {"asset_roots": roots, "variants": variants, "time_code": time}


def device_named(name: str) -> str:
    """The device, if this machine has it. Raises typer.BadParameter."""
    import torch

    if name != "cpu" and not (name.startswith("cuda") and torch.cuda.is_available()):
        raise typer.BadParameter(f"device {name!r}: this machine offers only cpu")
    return name
