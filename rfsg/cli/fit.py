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
    residual: Annotated[
        bool,
        typer.Option(
            help="Model what physics leaves of powers as well; reported beside physics alone.",
        ),
    ] = False,
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

    Writes the fitted scene and assets, history.csv, predictions.csv with 90 % intervals, report.json,
    a checkpoint and pictures into --out; with --residual also what physics leaves of the readings.

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
            residual=residual,
            resume=resume,
            overwrite=overwrite,
            progress=lambda done, total, word: progress("fitting", done, total, word),
        )
    finish(fitted, out)


def finish(fitted: "Fitted", out: Path) -> None:
    """Pictures, and what a person wants to know of a fit that was written to ``out``."""
    from rfsg.learn.output import FILES

    pictures = _draw(fitted, out)
    print_table("errors", _errors(fitted.report))
    if rows := _intervals(fitted.report):
        print_table("intervals", rows)
    for cause, count in fitted.report["refused_steps"].items():
        note(f"{count} steps were refused: {cause} was not finite")
    if said := risen(fitted.report):
        note(said)
    written = [name for name in FILES if (out / name).exists()]
    print_files(out, (*written, *pictures))


def risen(report: dict[str, Any]) -> str:
    """What to say of a fit whose training error is larger than before it; "" of any other."""
    before, after = (report["train"][when]["median_db"] for when in ("before", "after"))
    if before is None or after is None or after <= before:
        return ""
    return (
        f"the median training error rose from {before:.2f} to {after:.2f} dB: nothing was learned. Likely "
        "causes: a rate that is too high (--rate), batches too small (--batch 16), a few readings far off "
        "(--law student), or a scene that lacks what the readings saw"
    )


def _row(row: dict[str, Any]) -> dict[str, Any]:
    said = f"{row['parameter']} ({row['note']})" if row["note"] else row["parameter"]
    return {
        "parameter": said,
        "of": ", ".join(row["objects"]),
        "numbers": row["count"],
        "taught with it": ", ".join(row["also"]),
    }


def _errors(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Before, after, and with the residual: of training readings that is cross-validated."""

    def decibel(value: float | None) -> str:
        return "" if value is None else f"{value:.2f}"

    names = {"before": "before", "after": "after", "with_residual": "after, with residual"}
    return [
        {
            "readings": f"{which}, {name}",
            "median [dB]": decibel(report[which][when]["median_db"]),
            "90 % within [dB]": decibel(report[which][when]["p90_db"]),
            "number": report[which][when]["readings"],
        }
        for which in ("train", "validation")
        for when, name in names.items()
        if when in report[which]
    ]


def _intervals(report: dict[str, Any]) -> list[dict[str, Any]]:
    """What is known of the 90 % intervals."""

    def share(value: float | None) -> str:
        return "not measured: no readings held" if value is None else f"{100 * value:.0f} %"

    sure, left = report["uncertainty"], report["residual"]
    if sure is None:
        return []
    named = {"physics": sure} | ({} if left is None else {"with residual": left})
    return [
        {
            "90 % interval": name,
            "median width [dB]": f"{said['median_width_db']:.2f}",
            "covers": share(said["coverage"]),
        }
        for name, said in named.items()
    ]


def _draw(fitted: "Fitted", out: Path) -> list[str]:
    """loss.png; and where powers or gains were read errors.png, error_map.png and cdf.png.

    Of the readings held for validation, where there are any.
    """
    from rfsg import plot
    from rfsg.learn.losses import residual_db
    from rfsg.learn.measurements import Quantity

    plot.save(plot.loss_figure(fitted.history), out / "loss.png")
    measured, after = fitted.measured, fitted.after
    use = measured.received & after.arrives & (measured.quantity != int(Quantity.DELAY))
    use = use & (fitted.held if bool(fitted.held.any()) else ~fitted.held)
    if not bool(use.any()):
        return ["loss.png"]
    held = "readings not trained on" if bool(fitted.held.any()) else "readings trained on"
    off = {"physics": residual_db(after, measured)}
    if fitted.spread is not None and fitted.spread.left is not None:
        off["with residual"] = off["physics"] + fitted.spread.left
    off["before"] = residual_db(fitted.before, measured)
    errors = {name: value[use].numpy() for name, value in off.items()}
    # path gains, whatever was read: what was measured is what is predicted less the error
    value = after.path_gain_db()[use].numpy() - errors["physics"]
    said = {name: value + error for name, error in errors.items()}
    figures = {
        "errors.png": plot.comparison_figure(value, said, "dB path gain", held),
        "error_map.png": plot.error_map_figure(
            fitted.scene,
            _places(fitted)[use.numpy(), :2],
            {name: error for name, error in errors.items() if name != "before"},
            held,
        ),
        "cdf.png": plot.cdf_figure(errors, held),
    }
    for name, figure in figures.items():
        plot.save(figure, out / name)
    return ["loss.png", *figures]


def _places(fitted: "Fitted") -> Any:
    """Of every reading the end that stands at more places [m]: the other is a gateway."""
    from rfsg.learn.links import link_up
    from rfsg.learn.over_scene import Ends

    ends = Ends.of(link_up(fitted.scene, fitted.measured))
    return ends.rx if ends.receivers_are_places() else ends.tx
