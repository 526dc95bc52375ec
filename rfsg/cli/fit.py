"""``rfsg fit``: learn objects, materials, places and offsets of a scene from measurements."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfsg.cli.options import Changes, Out, Overwrite, Preset, Roots, SceneFile, Seed, Time, Variants
from rfsg.cli.parse import parse_frequency, parse_quality
from rfsg.cli.scenes import must_exist, read_scene
from rfsg.cli.terminal import bar, note, print_files, print_table

if TYPE_CHECKING:
    from rfsg.learn.fit import Fitted

FILES = ("scene.usda", "history.csv", "predictions.csv", "measurements.csv", "report.json")


class Law(StrEnum):
    gaussian = "gaussian"
    huber = "huber"
    student = "student"


class Censoring(StrEnum):
    tobit = "tobit"
    fill = "fill"
    ignore = "ignore"


class Schedule(StrEnum):
    constant = "constant"
    cosine = "cosine"


def fit(
    scene: SceneFile,
    measurements: Annotated[Path, typer.Argument(help="A CSV file of readings.")],
    select: Annotated[
        list[str],
        typer.Option(
            metavar="PATTERN",
            help="What may be learned (repeatable): '/World/Cabinet*', '/World/Door.surface.eps_r', "
            "'/World/Desk.pose', '*.gain_db', power.",
        ),
    ],
    out: Out,
    unknown: Annotated[
        list[str],
        typer.Option(
            metavar="PATTERN",
            help="Forget these objects' materials: they begin with a surface that is learned.",
        ),
    ] = [],
    steps: Annotated[int, typer.Option(min=1, help="Training steps.")] = 2000,
    batch: Annotated[int, typer.Option(min=1, help="Readings in a step.")] = 4,
    rate: Annotated[float, typer.Option(help="Adam's rate.")] = 1e-4,
    schedule: Annotated[Schedule, typer.Option(help="Whether the rate falls.")] = Schedule.constant,
    refresh: Annotated[int, typer.Option(min=1, help="Steps between searches.")] = 500,
    frequency: Annotated[
        float | None,
        typer.Option(parser=parse_frequency, help="Where the file leaves frequency_hz empty."),
    ] = None,
    threshold: Annotated[
        float | None, typer.Option(help="dBm below which nothing is received.")
    ] = None,
    noise: Annotated[float, typer.Option(help="Noise of powers and gains [dB].")] = 2.0,
    law: Annotated[Law, typer.Option(help="What an outlier costs.")] = Law.gaussian,
    censoring: Annotated[
        Censoring, typer.Option(help="What is made of readings not received.")
    ] = Censoring.tobit,
    incoherent: Annotated[
        bool, typer.Option("--incoherent", help="Add powers of paths, not their amplitudes.")
    ] = False,
    validation: Annotated[float, typer.Option(help="Share of readings never trained on.")] = 0.2,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from an interrupted run.")
    ] = False,
    quality: Preset = "draft",
    changes: Changes = [],
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Learn what is selected of a scene from measurements.

    Writes the fitted scene and assets, history.csv, predictions.csv, report.json, a checkpoint and
    pictures into --out.

    Example: rfsg fit lab.usda readings.csv --select '/World/Cabinet.surface' --out fitted
    """
    must_exist(measurements)
    question = parse_quality(quality, changes)
    base = read_scene(scene, asset_root, variant, time)
    from rfsg.learn import fit as fitting
    from rfsg.learn.blank import blank
    from rfsg.learn.links import link_up
    from rfsg.learn.losses import Losses
    from rfsg.learn.measurements import Measurements
    from rfsg.learn.selection import select as choose

    read = Measurements.from_csv(measurements, frequency_hz=frequency, threshold_dbm=threshold)
    begin = blank(base, unknown, seed=seed)
    links = link_up(begin, read)
    radios = [r.path for r in (*links.transmitters, *links.receivers)]
    chosen = choose(begin, select, radios=radios, frequency=float(links.frequency[0]))
    print_table("what is learned", [_row(r) for r in chosen.rows()])
    losses = Losses(
        noise_db=noise, law=law.value, censoring=censoring.value, coherent=not incoherent
    )
    with bar() as progress:
        fitted = fitting.fit(
            begin,
            read,
            select=select,
            out=out,
            steps=steps,
            batch=batch,
            refresh=refresh,
            quality=question,
            seed=seed,
            learning_rate=rate,
            schedule=schedule.value,
            losses=losses,
            validation=validation,
            resume=resume,
            overwrite=overwrite,
            progress=lambda done, total, word: progress("fitting", done, total, word),
        )
    pictures = _draw(fitted, out)
    print_table("errors", _errors(fitted.report))
    for cause, count in fitted.report["refused_steps"].items():
        note(f"{count} steps were refused: {cause} was not finite")
    print_files(out, (*FILES, *pictures))


def _row(row: dict[str, Any]) -> dict[str, Any]:
    said = f"{row['parameter']} ({row['note']})" if row["note"] else row["parameter"]
    return {
        "parameter": said,
        "of": ", ".join(row["objects"]),
        "numbers": row["count"],
        "taught with it": ", ".join(row["also"]),
    }


def _errors(report: dict[str, Any]) -> list[dict[str, Any]]:
    def decibel(value: float | None) -> str:
        return "" if value is None else f"{value:.2f}"

    return [
        {
            "readings": f"{which}, {when}",
            "median [dB]": decibel(report[which][when]["median_db"]),
            "90 % within [dB]": decibel(report[which][when]["p90_db"]),
            "number": report[which][when]["readings"],
        }
        for which in ("train", "validation")
        for when in ("before", "after")
    ]


def _draw(fitted: "Fitted", out: Path) -> list[str]:
    """loss.png; and errors.png where powers or gains were read."""
    from rfsg import plot
    from rfsg.learn.losses import residual_db
    from rfsg.learn.measurements import Quantity

    plot.save(plot.loss_figure(fitted.history), out / "loss.png")
    measured, after = fitted.measured, fitted.after
    use = measured.received & after.arrives & (measured.quantity != int(Quantity.DELAY))
    use = use & (fitted.held if bool(fitted.held.any()) else ~fitted.held)
    if not bool(use.any()):
        return ["loss.png"]
    # path gains, whatever was read: what was measured is what is predicted less the error
    value = (after.path_gain_db() - residual_db(after, measured))[use]
    predicted = {
        name: (value + residual_db(said, measured)[use]).numpy()
        for name, said in (("fitted", after), ("before", fitted.before))
    }
    held = "readings not trained on" if bool(fitted.held.any()) else "readings trained on"
    figure = plot.comparison_figure(value.numpy(), predicted, "dB path gain", held)
    plot.save(figure, out / "errors.png")
    return ["loss.png", "errors.png"]
