"""The command line: thin commands over the same functions that Python users call.

Heavy imports live inside the commands, so that ``rfsg --help`` answers at once. Exit codes: 0 done,
1 a fault of rfsg itself, 2 the command was not understood, 3 a scene, asset or file is at fault,
4 the numbers gave out (singular, out of memory), 130 interrupted.
"""

import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfsg import __version__

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene
    from rfsg.tracer.plan import Quality

INTERNAL, USAGE, INPUT, NUMERIC, INTERRUPTED = 1, 2, 3, 4, 130
UNITS = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9, "thz": 1e12}
_NUMERIC_FAULTS = ("LinAlgError", "OutOfMemoryError")  # torch's, by name: torch may not be loaded
HIGHEST_CREDIBLE_HZ = 1e15  # above this a unit was surely mistaken (ultraviolet light)

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Radio ray tracing with neural objects that are trained once and reused in any scene.",
    epilog="Errors are one plain sentence; --debug, anywhere, shows where they come from. "
    "Exit codes: 0 done, 2 usage, 3 a scene or file at fault, 4 a numeric problem.",
)


class Method(StrEnum):
    rays = "rays"
    paths = "paths"


class Axis(StrEnum):
    y = "y"
    z = "z"


def main() -> None:
    """Entry point of ``rfsg``."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run one command; returns the exit code and never raises."""
    debug = "--debug" in arguments
    try:
        code = app([a for a in arguments if a != "--debug"], "rfsg", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except KeyboardInterrupt:
        return _say("interrupted", INTERRUPTED)
    except Exception as error:
        if debug:
            traceback.print_exc()
        return _say(*_verdict(error))


def parse_frequency(text: str) -> float:
    """'2.44GHz', '868 MHz' or '2.44e9' in hertz. Raises typer.BadParameter."""
    match = re.fullmatch(r"\s*([0-9.]+(?:e[+-]?[0-9]+)?)\s*([kmgt]?hz)?\s*", text, re.IGNORECASE)
    try:
        value = float(match[1]) * UNITS[(match[2] or "hz").lower()] if match else 0.0
    except ValueError:
        value = 0.0
    if not 0.0 < value < HIGHEST_CREDIBLE_HZ:
        raise typer.BadParameter(f"{text!r} is not a frequency; write for example 2.44GHz")
    return value


def parse_pair(text: str, what: str) -> tuple[str, str]:
    """'A=B' as (A, B). Raises typer.BadParameter."""
    left, equals, right = (part.strip() for part in text.partition("="))
    if not (left and equals and right):
        raise typer.BadParameter(f"{text!r}: expected {what}")
    return left, right


def parse_move(text: str) -> tuple[str, tuple[float, float, float]]:
    """'/World/Cabinet=1.2,0,0' as path and metres. Raises typer.BadParameter."""
    path, numbers = parse_pair(text, "PATH=x,y,z in metres, as in /World/Cabinet=1.2,0,0")
    try:
        x, y, z = (float(number) for number in numbers.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r}: expected three numbers in metres after =") from None
    return path, (x, y, z)


def parse_quality(name: str, changes: list[str]) -> "Quality":
    """A preset with single fields changed ('depth=2'). Raises typer.BadParameter."""
    from rfsg.tracer.plan import Quality

    pairs = dict(parse_pair(change, "FIELD=VALUE, as in depth=2") for change in changes)
    try:
        kinds = {key: type(value) for key, value in vars(Quality.named(name)).items()}
        values = {key: kinds.get(key, str)(value) for key, value in pairs.items()}
        return Quality.named(name, **values)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


SceneFile = Annotated[Path, typer.Argument(help="A USD scene (.usda, .usdc, .usdz).")]
AnyFile = Annotated[Path, typer.Argument(help="A USD scene, or one object's asset.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]
Frequency = Annotated[
    float | None,
    typer.Option(
        parser=parse_frequency,
        metavar="NUMBER[Hz|kHz|MHz|GHz]",
        help="Carrier frequency. Default: the scene's own.",
    ),
]
Preset = Annotated[str, typer.Option("--quality", help="draft, standard or reference.")]
Changes = Annotated[
    list[str],
    typer.Option("--set", metavar="FIELD=VALUE", help="Change one field of the quality: depth=2."),
]
Moves = Annotated[
    list[str],
    typer.Option(
        "--move",
        metavar="PATH=X,Y,Z",
        help="Move an object by metres, from where it stands: /World/Cabinet=1.2,0,0.",
    ),
]
Replacements = Annotated[
    list[str],
    typer.Option(
        "--replace",
        metavar="PATH=ASSET",
        help="Put another asset in an object's place: /World/Cabinet=desk.usda.",
    ),
]
Removals = Annotated[
    list[str], typer.Option("--without", metavar="PATH", help="Leave an object out.")
]
Receivers = Annotated[
    Path | None,
    typer.Option(help="CSV table name,x,y,z in metres: receivers in place of the scene's."),
]
Device = Annotated[str, typer.Option(help="cpu, cuda or cuda:1.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random; it is written down.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")]


@app.command()
def simulate(
    scene: SceneFile,
    out: Out,
    frequency: Frequency = None,
    quality: Preset = "standard",
    changes: Changes = [],
    move: Moves = [],
    replace: Replacements = [],
    without: Removals = [],
    receivers: Receivers = None,
    link: Annotated[
        list[str],
        typer.Option(metavar="TX=RX", help="Draw this link's delay profile (repeatable)."),
    ] = [],
    device: Device = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Find every path between the scene's radios, and the channels they make.

    Writes links.csv, paths.csv, channel.npz, report.json, scene.png and pdp.png into --out.

    Example: rfsg simulate lab.usda --frequency 2.44GHz --move /World/Cabinet=1.2,0,0 --out moved
    """
    from rfsg import report

    question = parse_quality(quality, changes)
    report.refuse_taken(out, overwrite)
    edited = _edited(_read(scene), move, replace, without, receivers)
    _seed(seed)
    from rfsg.tracer import simulate as tracer

    with _bar() as progress:
        result = tracer.simulate(
            edited, frequency, question, device=_device(device), progress=progress
        )
    asked = {"scene": str(scene), "move": move, "replace": replace, "without": without}
    asked |= {"seed": seed, "device": device, "receivers_file": receivers and str(receivers)}
    chosen = _chosen_links(edited, result, link)
    with report.output_folder(out, overwrite) as folder:
        report.write_links(result, folder / "links.csv")
        report.write_paths(result, folder / "paths.csv")
        report.write_channel(result, folder / "channel.npz")
        report.write_json(report.report(result, **asked), folder / "report.json")
        _draw_run(edited, result, chosen, folder, title=scene.name)
    _print_links(result)
    for warning in result.warnings:
        _note(warning)
    _print_files(out, ("links.csv", "paths.csv", "channel.npz", "report.json"))
    _print_files(out, ("scene.png", "pdp.png"))


@app.command(name="map")
def map_(
    scene: SceneFile,
    out: Out,
    height: Annotated[float, typer.Option(help="Height of the plane [m].")] = 1.2,
    cell: Annotated[float, typer.Option(help="Size of a cell [m].", min=1e-3)] = 0.5,
    transmitter: Annotated[
        str | None,
        typer.Option(metavar="PATH", help="Draw this one. Default: the strongest in each cell."),
    ] = None,
    method: Annotated[
        Method, typer.Option(help="rays: mean over each cell, fast. paths: exact at its centre.")
    ] = Method.rays,
    frequency: Frequency = None,
    quality: Preset = "standard",
    changes: Changes = [],
    move: Moves = [],
    replace: Replacements = [],
    without: Removals = [],
    device: Device = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Received power over a level plane, as a picture and as numbers.

    Writes map.png, map.npz and report.json into --out.

    Example: rfsg map lab.usda --height 1.2 --cell 0.25 --out map
    """
    from rfsg import report

    question = parse_quality(quality, changes)
    report.refuse_taken(out, overwrite)
    edited = _edited(_read(scene), move, replace, without, None)
    shown = None if transmitter is None else _transmitter(edited, transmitter)
    where = _device(device)
    from rfsg.tracer import radiomap

    with _bar() as progress:
        progress("radio map")
        found = radiomap.radio_map(
            edited,
            frequency,
            height=height,
            cell=cell,
            quality=question,
            method=method.value,
            seed=seed,
            device=where,
        )
    asked = {"scene": str(scene), "move": move, "replace": replace, "without": without}
    asked |= {"frequency_hz": found.frequency, "height": height, "cell": cell}
    asked |= {"method": method.value, "seed": seed, "device": device, "quality": question}
    asked |= {"warnings": edited.warnings, "versions": report.versions()}
    from rfsg import plot

    with report.output_folder(out, overwrite) as folder:
        report.write_map(found, folder / "map.npz")
        report.write_json(asked, folder / "report.json")
        plot.save(plot.map_figure(found, edited, shown), folder / "map.png")
    _print_files(out, ("map.npz", "map.png"))


@app.command()
def check(file: AnyFile) -> None:
    """List every fault of a scene or an asset; exit code 3 if there is one."""
    _must_exist(file)
    from rfsg.scene import usd

    faults = usd.check(file)
    for fault in faults:
        typer.echo(fault)
    if faults:
        raise typer.Exit(INPUT)
    typer.echo(f"{file}: no faults")


@app.command()
def info(
    file: AnyFile,
    parameters: Annotated[
        bool, typer.Option("--parameters", help="Also list every parameter tensor.")
    ] = False,
) -> None:
    """Print what a scene or an asset holds: objects, kinds, parameter counts, radios."""
    from rfsg import report

    scene = _read(file)
    _print_table(f"{file}", report.scene_table(scene))
    if parameters:
        _print_table("parameters", report.parameter_table(scene))
    radios = [("transmitter", r) for r in scene.transmitters]
    radios += [("receiver", r) for r in scene.receivers]
    if radios:
        _print_table("radios", [_radio_row(role, radio) for role, radio in radios])
    if scene.frequency is not None:
        typer.echo(f"frequency: {scene.frequency / 1e9:g} GHz")
    for warning in scene.warnings:
        _note(warning)


@app.command(name="learn-shape")
def learn_shape(
    mesh: Annotated[Path, typer.Argument(help="A watertight mesh: .obj, .ply, .glb or .stl.")],
    asset: Annotated[Path, typer.Option("--out", "-o", help="The asset to write: NAME.usda.")],
    steps: Annotated[int | None, typer.Option(help="Training steps.", min=1)] = None,
    scale: Annotated[float, typer.Option(help="Metres per unit of the mesh.")] = 1.0,
    up: Annotated[
        Axis | None,
        typer.Option(
            case_sensitive=False, help="Axis that points up. Default: y for .glb, z otherwise."
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume/--fresh", help="Go on from an interrupted run."),
    ] = True,
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Train a neural shape from a mesh, and write it as an asset that scenes can reference.

    Example: rfsg learn-shape cabinet.obj -o cabinet.usda
    """
    _must_exist(mesh)
    from rfsg.learn.geometry import learn_shape_file

    options: dict[str, Any] = {} if steps is None else {"steps": steps}
    options |= {} if up is None else {"up_axis": up.value}
    with _bar() as progress:
        outcome = learn_shape_file(
            mesh,
            asset,
            seed=seed,
            scale=scale,
            progress=lambda step, total, note: progress("training", step, total, note),
            resume=resume,
            overwrite=overwrite,
            **options,
        )
    rows = [{"quantity": k, "value": _short(v)} for k, v in vars(outcome).items()]
    _print_table(f"{asset}", rows)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit()


def _verdict(error: Exception) -> tuple[str, int]:
    """What to say about an exception, and the exit code."""
    from rfsg.report import OutputExists

    if hasattr(error, "format_message"):  # what typer raises for a command line it cannot read
        words = error.format_message()  # type: ignore[attr-defined]
        return words and f"{words} (rfsg --help tells more)", USAGE
    if isinstance(error, OutputExists):
        return str(error), USAGE
    if isinstance(error, OSError):
        return f"{error.filename or ''}: {error.strerror or error}".lstrip(": "), INPUT
    kind = type(error).__name__
    if isinstance(error, ArithmeticError | MemoryError) or kind in (
        "LinAlgError",
        "OutOfMemoryError",
    ):
        return f"numeric problem: {error or kind}; --set chunk=4096 needs less memory", NUMERIC
    if kind == "LearnError":  # a training that ended in something unusable
        return str(error), NUMERIC
    if isinstance(error, ValueError) or kind.endswith("Error") and _is_ours(error):
        return str(error), INPUT
    return f"rfsg itself failed ({kind}: {error}); --debug shows where", INTERNAL


def _is_ours(error: Exception) -> bool:
    return type(error).__module__.split(".")[0] == "rfsg"


def _say(sentence: str, code: int) -> int:
    for line in sentence.splitlines():
        typer.echo(f"rfsg: {line}", err=True)
    return code


def _note(sentence: str) -> None:
    typer.echo(f"note: {sentence}", err=True)


def _must_exist(file: Path) -> None:
    if not file.exists() or file.is_dir():
        raise FileNotFoundError(2, "no such file", str(file))


def _read(file: Path) -> "Scene":
    _must_exist(file)
    from rfsg.scene.scene import Scene

    return Scene.from_usd(file)


def _edited(
    scene: "Scene",
    moves: list[str],
    replacements: list[str],
    removals: list[str],
    receivers: Path | None,
) -> "Scene":
    """The scene after the edits of the command line: replaced, moved, left out, re-equipped."""
    for text in replacements:
        path, asset = parse_pair(text, "PATH=ASSET, as in /World/Cabinet=desk.usda")
        _must_exist(Path(asset))
        scene = scene.replaced(path, asset)
    for text in moves:
        path, metres = parse_move(text)
        scene = scene.moved(path, metres)
    for path in removals:
        scene = scene.without(path)
    if receivers is not None:
        from rfsg.scene.receivers import from_csv

        _must_exist(receivers)
        scene = scene.with_receivers(from_csv(receivers))
    return scene


def _seed(seed: int) -> None:
    import torch

    torch.manual_seed(seed)


def _device(name: str) -> str:
    """The device, if this machine has it. Raises typer.BadParameter."""
    import torch

    if name != "cpu" and not (name.startswith("cuda") and torch.cuda.is_available()):
        raise typer.BadParameter(f"device {name!r}: this machine offers only cpu")
    return name


def _transmitter(scene: "Scene", path: str) -> int:
    paths = [radio.path for radio in scene.transmitters]
    if path not in paths:
        known = ", ".join(paths) or "none"
        raise typer.BadParameter(f"transmitter {path!r}: the scene has {known}")
    return paths.index(path)


def _chosen_links(scene: "Scene", result: Any, asked: list[str]) -> list[tuple[int, int]]:
    """Links whose delay profile is drawn: those asked for, or strongest, median and weakest."""
    names = {(r.path, s.path): (i, j) for i, r in enumerate(scene.transmitters)
             for j, s in enumerate(scene.receivers)}  # fmt: skip
    for text in asked:
        if parse_pair(text, "TX=RX, as in /World/AP=/World/rx_3") not in names:
            known = ", ".join("=".join(pair) for pair in list(names)[:3])
            raise typer.BadParameter(f"link {text!r} is not in the scene; it has {known} ...")
    if asked:
        return [names[parse_pair(text, "")] for text in asked]
    heard = [row for row in result.links() if row["n_paths"] > 0]
    heard.sort(key=lambda row: -row["path_gain_db"])
    pick = sorted({0, len(heard) // 2, len(heard) - 1}) if heard else []
    return [names[heard[i]["tx"], heard[i]["rx"]] for i in pick]


def _draw_run(
    scene: "Scene", result: Any, links: list[tuple[int, int]], folder: Path, title: str
) -> None:
    from rfsg import plot

    figure = plot.scene_figure(scene, result.paths, result.channel, title)
    plot.save(figure, folder / "scene.png")
    plot.save(plot.delay_figure(scene, result.channel, links), folder / "pdp.png")


def _print_links(result: Any) -> None:
    rows = result.links()
    most = 30
    _print_table(
        "links",
        [
            {
                "tx": row["tx"],
                "rx": row["rx"],
                "path gain [dB]": f"{row['path_gain_db']:.2f}" if row["n_paths"] else "",
                "RSS [dBm]": f"{row['rss_dbm']:.2f}" if row["n_paths"] else "",
                "delay spread [ns]": f"{row['delay_spread_ns']:.2f}" if row["n_paths"] else "",
                "paths": row["n_paths"],
                "line of sight": "yes" if row["los"] else "no",
            }
            for row in rows[:most]
        ],
    )
    if len(rows) > most:
        typer.echo(f"... and {len(rows) - most} more in links.csv")


def _radio_row(role: str, radio: Any) -> dict[str, Any]:
    place = " ".join(f"{x:.3g}" for x in radio.position.tolist())
    power = f"{radio.power_dbm:g}" if role == "transmitter" else ""
    row = {"path": radio.path, "role": role, "at [m]": place, "power [dBm]": power}
    array = "" if radio.array is None else radio.array
    return row | {"pattern": radio.pattern, "polarization": radio.polarization, "array": array}


def _print_files(out: Path, names: tuple[str, ...]) -> None:
    for name in names:
        typer.echo(str(out / name))


def _print_table(title: str, rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in rows[0] if rows else ():
        table.add_column(name, no_wrap=name in ("path", "tx", "rx"))
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    terminal = Console()
    # Piped output has no width of its own: leave lines whole, for grep and awk.
    (terminal if terminal.is_terminal else Console(width=200)).print(table, markup=False)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextmanager
def _bar() -> Iterator[Callable[..., None]]:
    """progress(stage) or progress(stage, done, total, note): bars on stderr; quiet when piped.

    A stage without counts is over when the next one begins.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:

        def progress(
            stage: str, done: float | None = None, total: float | None = None, note: str = ""
        ) -> None:
            if stage not in tasks:
                _finish(bars)
                tasks[stage] = bars.add_task(stage, total=total)
            if done is not None:
                text = f"{stage}: {note}" if note else stage
                bars.update(tasks[stage], completed=done, total=total, description=text)

        yield progress
        _finish(bars)


def _finish(bars: Any) -> None:
    for task in bars.tasks:
        bars.update(task.id, completed=task.total or 1, total=task.total or 1)


if __name__ == "__main__":
    main()
