"""``rfsg tradeoff``: what each setting costs and lacks on a scene, and which to take."""

import csv
import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfsg.cli.options import (
    Accuracy,
    Additions,
    Changes,
    Device,
    Frequency,
    Moves,
    Out,
    Overwrite,
    Preset,
    Receivers,
    Removals,
    Roots,
    Save,
    SceneFile,
    Swaps,
    Time,
    Variants,
)
from rfsg.cli.parse import parse_budget, parse_quality
from rfsg.cli.scenes import Edits, asked_of_scene, device_named, edit, read_scene
from rfsg.cli.terminal import bar, note, print_files, print_table

if TYPE_CHECKING:
    from rfsg.tracer.tradeoff import Outcome, Tradeoff

FILES = ("tradeoff.csv", "tradeoff.json", "tradeoff.png")


class Grid(StrEnum):
    small = "small"
    full = "full"


def tradeoff(
    scene: SceneFile,
    out: Out,
    budget: Annotated[
        float,
        typer.Option(
            parser=parse_budget,
            metavar="NUMBER[s|min|h]",
            help="No setting is begun that is not expected to fit.",
        ),
    ] = 300.0,
    grid: Annotated[
        Grid,
        typer.Option(
            help="small: the presets, and one change at a time; full: also every "
            "combination of depth, diffraction and curved_depth."
        ),
    ] = Grid.small,
    accuracy: Accuracy = None,
    frequency: Frequency = None,
    quality: Preset = "standard",
    changes: Changes = [],
    move: Moves = [],
    swap: Swaps = [],
    remove: Removals = [],
    add: Additions = [],
    save: Save = None,
    receivers: Receivers = None,
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    device: Device = "cpu",
    overwrite: Overwrite = False,
) -> None:
    """Measure error against time on a scene, setting by setting, and recommend one.

    --quality and --set give the setting that single fields are changed of. Writes tradeoff.csv,
    tradeoff.json and tradeoff.png into --out.

    Example: rfsg tradeoff lab.usda --budget 10min --accuracy 1dB --out lab-tradeoff
    """
    from rfsg import report

    base = parse_quality(quality, changes)
    report.refuse_taken(out, overwrite)
    edits = Edits(move, swap, remove, add, save)
    edits.refuse_taken(overwrite)
    read = read_scene(scene, asset_root, variant, time)
    edited = edit(read, edits, receivers, overwrite)
    from rfsg.tracer import tradeoff as measuring

    options: dict[str, Any] = {} if accuracy is None else {"accuracy_db": accuracy}
    with bar() as progress:
        found = measuring.tradeoff(
            edited,
            frequency,
            base=base,
            grid=grid.value,
            budget_s=budget,
            device=device_named(device),
            progress=progress,
            **options,
        )
    asked = asked_of_scene(scene, edits, asset_root, variant, time)
    asked |= {"budget_s": budget, "grid": grid.value, "base": base, "device": device}
    from rfsg import plot
    from rfsg.plot_tradeoff import tradeoff_figure

    with report.output_folder(out, overwrite) as folder:
        write_csv(found, folder / "tradeoff.csv")
        report.write_json(asked | facts(found), folder / "tradeoff.json")
        plot.save(tradeoff_figure(found, scene.name), folder / "tradeoff.png")
    print_table("settings", [shown(one, found.recommended) for one in found.outcomes])
    for sentence in found.left_out:
        note(sentence)
    typer.echo(found.sentence())
    print_files(out, FILES)


def row(one: "Outcome") -> dict[str, Any]:
    """One setting as a row of tradeoff.csv."""
    errors = vars(one.error)
    return {
        "setting": one.setting,
        "seconds": one.seconds,
        "runs": one.runs,
        "peak_mib": one.peak_mib,
        "paths": one.paths,
        "complete": one.complete,
        **errors,
        "missed_db": one.missed_db,
        "moved_db": one.moved_db,
        "front": one.front,
    }


def write_csv(found: "Tradeoff", file: Path) -> None:
    """tradeoff.csv: one row per setting, quickest first; a cell without a finite value stays empty."""
    rows = [row(one) for one in found.outcomes]
    with open(file, "w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows({name: _cell(value) for name, value in one.items()} for one in rows)


def facts(found: "Tradeoff") -> dict[str, Any]:
    """What tradeoff.json says besides what was asked."""
    from rfsg import report

    return {
        "frequency_hz": found.frequency,
        "links": found.links,
        "reference": found.reference,
        "truth_is_reference": found.truth_is_reference,
        "accuracy_db": found.accuracy_db,
        "recommended": found.recommended,
        "sentence": found.sentence(),
        "settings": [row(one) | {"changed": one.changed} for one in found.outcomes],
        "left_out": found.left_out,
        "versions": report.versions(),
    }


def shown(one: "Outcome", recommended: str | None) -> dict[str, str]:
    """One setting as a row of the table on the terminal."""
    error = one.error
    return {
        "setting": one.setting,
        "time [s]": f"{one.seconds:.3g}",
        "peak [MiB]": "" if one.peak_mib is None else f"{one.peak_mib:.0f}",
        "error [dB]": f"{error.gain_db:.2g}",
        "at 90 %": f"{error.gain_90_db:.2g}",
        "most": f"{error.gain_most_db:.2g}",
        "missed [dB]": f"{one.missed_db:.3g}",
        "spread [ns]": f"{error.spread_ns:.2g}",
        "arrival [ns]": f"{error.arrival_ns:.2g}",
        "from base": f"{one.moved_db:.2g}",
        "paths": str(one.paths),
        "": "take this" if one.setting == recommended else "front" if one.front else "",
    }


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return "" if value is None else value
