"""The scene that a command works on: read as its options say, and edited; and where it runs."""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rfsg.cli.parse import parse_addition, parse_move, parse_pair, parse_variants
from rfsg.cli.terminal import note

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene


def must_exist(file: Path) -> None:
    if not file.exists() or file.is_dir():
        raise FileNotFoundError(2, "no such file", str(file))


def read_scene(
    file: Path,
    roots: list[Path],
    variants: list[str],
    time: float | None,
    untrusted: bool = False,
) -> "Scene":
    must_exist(file)
    options = reading_options(roots, variants, time)
    from rfsg.scene.scene import Scene

    return Scene.from_usd(file, untrusted=untrusted, **options)


def reading_options(roots: list[Path], variants: list[str], time: float | None) -> dict[str, Any]:
    """The options of ``rfsg.scene.usd.read`` that were given."""
    for root in roots:
        if not root.is_dir():
            raise typer.BadParameter(f"--asset-root {root}: no such folder")
    if time is not None and not math.isfinite(time):
        raise typer.BadParameter(f"--time {time}: expected a finite time code")
    chosen = parse_variants(variants)
    return {"asset_roots": roots, "variants": chosen, "time": time}


@dataclass(frozen=True)
class Edits:
    """What the options of the command line change in a scene, as they were written."""

    move: list[str]
    swap: list[str]
    remove: list[str]
    add: list[str]
    save: Path | None = None

    def refuse_taken(self, overwrite: bool) -> None:
        """Before anything is read: the file that the edits go to must be free."""
        if self.save is not None and self.save.exists() and not overwrite:
            raise typer.BadParameter(f"--save {self.save}: already exists; --overwrite replaces it")

    def asked(self) -> dict[str, Any]:
        """What report.json says of them."""
        said: dict[str, Any] = {"move": self.move, "swap": self.swap, "remove": self.remove}
        return said | {"add": self.add, "save": self.save and str(self.save)}


def edit(
    scene: "Scene", edits: Edits, receivers: Path | None = None, overwrite: bool = False
) -> "Scene":
    """The scene after the edits of the command line: swapped, added to, moved, left out, re-equipped;
    kept, if that is asked."""
    for text in edits.swap:
        path, asset = parse_pair(text, "PATH=ASSET, as in /World/Cabinet=desk.usda")
        must_exist(Path(asset))
        scene = scene.replaced(path, asset)
    for text in edits.add:
        path, asset, metres, yaw = parse_addition(text)
        must_exist(Path(asset))
        scene = scene.added(asset, path, at=metres, yaw_deg=yaw)
    for text in edits.move:
        path, metres, yaw = parse_move(text)
        scene = scene.moved(path, metres, yaw_deg=yaw)
    for path in edits.remove:
        scene = scene.without(path)
    if receivers is not None:
        from rfsg.scene.receivers import from_csv

        must_exist(receivers)
        scene = scene.with_receivers(from_csv(receivers))
    if edits.save is not None:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            scene.save_edits(edits.save, overwrite)
        for warning in caught:
            note(str(warning.message))
        typer.echo(f"{edits.save}: the edits, as a layer over the scene")
    return scene


def asked_of_scene(
    scene: Path, edits: Edits, roots: list[Path], variants: list[str], time: float | None
) -> dict[str, Any]:
    """What report.json says of how the scene was read and edited."""
    asked = {"scene": str(scene)} | edits.asked()
    return asked | {"asset_roots": roots, "variants": variants, "time_code": time}


def device_named(name: str) -> str:
    """The device, if this machine has it. Raises typer.BadParameter."""
    import torch

    if name != "cpu" and not (name.startswith("cuda") and torch.cuda.is_available()):
        raise typer.BadParameter(f"device {name!r}: this machine offers only cpu")
    return name
