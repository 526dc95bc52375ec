"""``rfsg fit-regions``: learn what stands between radios where there is no scene."""

from pathlib import Path
from typing import Annotated

import typer

from rfsg.cli.fit import finish
from rfsg.cli.options import Out, Overwrite, Seed
from rfsg.cli.parse import parse_frequency
from rfsg.cli.scenes import must_exist
from rfsg.cli.terminal import bar


def fit_regions(
    measurements: Annotated[Path, typer.Argument(help="A CSV file of readings between places.")],
    out: Out,
    cell: Annotated[
        float, typer.Option(help="Longest side of a region along the floor [m].")
    ] = 3.0,
    margin: Annotated[float, typer.Option(help="How far regions reach beyond radios [m].")] = 0.5,
    height: Annotated[
        float | None, typer.Option(help="Greatest height of a region [m]. Default: one layer.")
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Training steps.")] = 150,
    batch: Annotated[int, typer.Option(min=1, help="Readings in a step.")] = 64,
    frequency: Annotated[
        float | None,
        typer.Option(parser=parse_frequency, help="Where the file leaves frequency_hz empty."),
    ] = None,
    receiver_gains: Annotated[bool, typer.Option(help="Learn an offset of every receiver.")] = True,
    validation: Annotated[float, typer.Option(help="Share of readings never trained on.")] = 0.2,
    residual: Annotated[
        bool, typer.Option(help="Model what physics leaves of powers as well.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from an interrupted run.")
    ] = False,
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Learn losses of region objects from readings between known places; no scene is needed.

    Fills the bounding box of all links with boxes that learn how much is lost inside. Writes what
    ``rfsg fit`` writes; scene.usda can be simulated and edited as any other.

    Example: rfsg fit-regions readings.csv --cell 4 --residual --out fitted
    """
    must_exist(measurements)
    from rfsg.learn import regions
    from rfsg.learn.measurements import Measurements

    read = Measurements.from_csv(measurements, frequency_hz=frequency)
    budget = regions.Budget(steps=steps, batch=batch, receiver_gains=receiver_gains)
    with bar() as progress:
        fitted = regions.fit_regions(
            read,
            cell_m=cell,
            margin_m=margin,
            height_m=height,
            budget=budget,
            seed=seed,
            validation=validation,
            residual=residual,
            out=out,
            resume=resume,
            overwrite=overwrite,
            progress=lambda done, total, word: progress("fitting", done, total, word),
        )
    finish(fitted, out)
