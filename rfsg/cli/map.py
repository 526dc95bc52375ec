"""``rfsg map``: received power, path loss, SINR and best server over a plane or over an object."""

from collections.abc import Callable
from enum import StrEnum
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfsg.cli.options import (
    HERTZ,
    Additions,
    Changes,
    Device,
    Frequency,
    Moves,
    Out,
    Overwrite,
    Preset,
    Removals,
    Roots,
    Save,
    SceneFile,
    Seed,
    Swaps,
    Time,
    Untrusted,
    Variants,
)
from rfsg.cli.parse import (
    parse_budget,
    parse_decibel,
    parse_frequency,
    parse_numbers,
    parse_plane,
    parse_quality,
)
from rfsg.cli.results import Usd, print_usd, refuse_usd
from rfsg.cli.scenes import Edits, asked_of_scene, device_named, edit, read_scene
from rfsg.cli.terminal import bar, note, print_files

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene
    from rfsg.tracer import radiomap


class Method(StrEnum):
    rays = "rays"
    paths = "paths"
    images = "images"


class Metric(StrEnum):
    rss = "rss"
    path_loss = "path-loss"
    sinr = "sinr"
    best_server = "best-server"


def map_(
    scene: SceneFile,
    out: Out,
    height: Annotated[
        float | None, typer.Option(help="Height of a level plane [m]. Default: 1.2.")
    ] = None,
    plane: Annotated[
        str | None,
        typer.Option(
            metavar="ORIGIN:U:V",
            help="Another plane: a point of it and its x and y directions, "
            "0,2,0:1,0,0:0,0,1 for an upright one.",
        ),
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,X1,Y1", help="Corners in the plane [m]. Default: the scene's extent."
        ),
    ] = None,
    on: Annotated[
        str | None,
        typer.Option(metavar="PRIM", help="Map the outside of this object instead of a plane."),
    ] = None,
    offset: Annotated[
        float, typer.Option(min=0.0, help="With --on: how far before the surface [m].")
    ] = 0.01,
    cell: Annotated[
        float | None,
        typer.Option(
            help="Size of a cell [m]. Default: 0.5 on a plane, 0.25 on an object.", min=1e-3
        ),
    ] = None,
    metric: Annotated[
        Metric, typer.Option(help="What map.png shows; map.npz holds all.")
    ] = Metric.rss,
    transmitter: Annotated[
        str | None,
        typer.Option(metavar="PATH", help="Draw this one. Default: the best in each cell."),
    ] = None,
    bandwidth: Annotated[
        float | None,
        typer.Option(
            parser=parse_frequency,
            metavar=HERTZ,
            help="Band that the noise of the SINR fills. Default: 20MHz.",
        ),
    ] = None,
    noise_figure: Annotated[float, typer.Option(help="Of the receivers [dB].")] = 0.0,
    method: Annotated[
        Method | None,
        typer.Option(
            help="rays: mean over each cell, fast. paths: exact at its middle, with every "
            "mechanism. images: as exact, and fast, for mirrors that are boxes and half-spaces. "
            "Default: rays on a plane, paths on an object."
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            parser=parse_budget,
            metavar="NUMBER[s|min|h]",
            help="By rays: refine the map until the time is up.",
        ),
    ] = None,
    error: Annotated[
        float | None,
        typer.Option(
            parser=parse_decibel,
            metavar="NUMBER[dB]",
            help="By rays: refine until the median standard error of the cells is below this.",
        ),
    ] = None,
    usd: Usd = False,
    frequency: Frequency = None,
    quality: Preset = "standard",
    changes: Changes = [],
    move: Moves = [],
    swap: Swaps = [],
    remove: Removals = [],
    add: Additions = [],
    save: Save = None,
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    untrusted: Untrusted = False,
    device: Device = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Received power, path loss, SINR and best server over a plane or over an object.

    Writes map.png, map.npz and report.json into --out, with --usd also map.usda.

    Example: rfsg map lab.usda --height 1.2 --cell 0.25 --metric sinr --noise-figure 7 --out map
    """
    from rfsg import report

    chosen = {"--height": height, "--plane": plane, "--on": on}
    given = [name for name, value in chosen.items() if value is not None]
    if len(given) > 1 or (on is not None and bounds is not None):
        raise typer.BadParameter("--height, --plane, --on: give one; --bounds goes with a plane")
    refuse_usd(usd, untrusted)
    question = parse_quality(quality, changes)
    report.refuse_taken(out, overwrite)
    edits = Edits(move, swap, remove, add, save)
    edits.refuse_taken(overwrite)
    band = bandwidth or 20e6
    edited = edit(read_scene(scene, asset_root, variant, time, untrusted), edits, None, overwrite)
    shown = None if transmitter is None else _transmitter(edited, transmitter)
    options: dict[str, Any] = {"quality": question, "seed": seed, "device": device_named(device)}
    options |= {} if cell is None else {"cell": cell}
    options |= {} if method is None else {"method": method.value}
    options |= {"budget_s": budget, "error_db": error}
    where: dict[str, Any] = {} if height is None else {"height": height}
    where |= {} if plane is None else {"plane": parse_plane(plane)}
    if bounds is not None:
        where["bounds"] = parse_numbers(bounds, 4, "four numbers in metres, as in 0,0,8,5")
    from rfsg.tracer import radiomap

    with bar() as progress:
        progress("radio map")
        options["progress"] = _shown(progress, budget)
        if on is not None:
            found = radiomap.radio_map_on(edited, on, frequency, offset=offset, **options)
        else:
            found = radiomap.radio_map(edited, frequency, **where, **options)
    asked = asked_of_scene(scene, edits, asset_root, variant, time)
    asked |= {"frequency_hz": found.frequency, "cells": list(found.cells.shape), "cell": cell}
    asked |= {"height": height, "plane": plane, "bounds": bounds, "on": on, "offset": offset}
    asked |= {"metric": metric.value, "bandwidth_hz": band, "noise_figure_db": noise_figure}
    asked |= {"budget_s": budget, "asked_error_db": error}
    asked |= {"current_error_db": found.current_error_db()}
    asked |= {"method": found.method, "seed": seed, "device": device, "quality": question}
    asked |= {"modelled": found.modelled, "left_out": found.left_out}
    asked |= {"warnings": found.warnings, "versions": report.versions()}
    from rfsg import plot

    with report.output_folder(out, overwrite) as folder:
        report.write_map(found, folder / "map.npz", band, noise_figure)
        report.write_json(asked, folder / "report.json")
        figure = plot.map_figure(found, edited, shown, metric.value, band, noise_figure)
        plot.save(figure, folder / "map.png")
    for warning in found.warnings:
        note(warning)
    print_files(out, ("map.npz", "map.png", "report.json"))
    if usd:
        print_usd(found, out / "map.usda", overwrite)


def _shown(
    progress: Callable[..., None], budget: float | None
) -> "Callable[[radiomap.RadioMap], None]":
    """Tells a progress bar how exact the map is so far; it fills as the budget is spent."""
    begun = monotonic()

    def tell(found: "radiomap.RadioMap") -> None:
        done = 0.0 if budget is None else min(monotonic() - begun, budget)
        progress("radio map", done, budget, f"{found.current_error_db():.2f} dB")

    return tell


def _transmitter(scene: "Scene", path: str) -> int:
    paths = [radio.path for radio in scene.transmitters]
    if path not in paths:
        known = ", ".join(paths) or "none"
        raise typer.BadParameter(f"transmitter {path!r}: the scene has {known}")
    return paths.index(path)
