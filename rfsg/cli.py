"""The command line: thin commands over the same functions that Python users call.

Heavy imports live inside the commands, so that ``rfsg --help`` answers at once. Exit codes: 0 done,
1 a fault of rfsg itself, 2 the command was not understood, 3 a scene, asset or file is at fault,
4 the numbers gave out (singular, out of memory), 130 interrupted.
"""

import math
import sys
import traceback
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfsg import __version__
from rfsg.parse import (
    parse_duration,
    parse_frequencies,
    parse_frequency,
    parse_move,
    parse_numbers,
    parse_pair,
    parse_plane,
    parse_quality,
    parse_variants,
)
from rfsg.terminal import bar, note, print_files, print_table, say, short

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene

INTERNAL, USAGE, INPUT, NUMERIC, INTERRUPTED = 1, 2, 3, 4, 130
_NUMERIC_FAULTS = ("LinAlgError", "OutOfMemoryError")  # torch's, by name: torch may not be loaded

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


class Metric(StrEnum):
    rss = "rss"
    path_loss = "path-loss"
    sinr = "sinr"
    best_server = "best-server"


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
        return say("interrupted", INTERRUPTED)
    except Exception as error:
        if debug:
            traceback.print_exc()
        return say(*_verdict(error))


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
Frequencies = Annotated[
    list[str],
    typer.Option(
        "--frequency",
        metavar="NUMBER[Hz|kHz|MHz|GHz][,...]",
        help="Carrier frequencies, over one geometry: 2.4GHz,5GHz. Default: the scene's own.",
    ),
]
Roots = Annotated[
    list[Path],
    typer.Option("--asset-root", metavar="FOLDER", help="Another folder the scene may read from."),
]
Variants = Annotated[
    list[str],
    typer.Option(
        "--variant",
        metavar="PRIM:SET=NAME",
        help="Choose a variant for this run: /World/Door:state=open.",
    ),
]
Time = Annotated[
    float | None,
    typer.Option(metavar="CODE", help="USD time code to read at. Default: the stage's start."),
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
    frequency: Frequencies = [],
    quality: Preset = "standard",
    changes: Changes = [],
    move: Moves = [],
    replace: Replacements = [],
    without: Removals = [],
    receivers: Receivers = None,
    bandwidth: Annotated[
        float | None,
        typer.Option(
            parser=parse_frequency,
            metavar="NUMBER[Hz|kHz|MHz|GHz]",
            help="Also write the frequency response and the taps over this band.",
        ),
    ] = None,
    subcarriers: Annotated[
        int | None, typer.Option(min=1, help="Sub-carriers in the band. Default: 64.")
    ] = None,
    snapshots: Annotated[
        int | None,
        typer.Option(min=1, help="Also write the channel at so many times: Doppler turns it."),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            parser=parse_duration,
            metavar="NUMBER[s|ms|us]",
            help="The time that the snapshots are spread over.",
        ),
    ] = None,
    link: Annotated[
        list[str],
        typer.Option(metavar="TX=RX", help="Draw this link's delay profile (repeatable)."),
    ] = [],
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    device: Device = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Find every path between the scene's radios, and the channels they make.

    Writes links.csv, paths.csv, channel.npz, report.json, scene.png and pdp.png into --out.

    Example: rfsg simulate lab.usda --frequency 2.44GHz --move /World/Cabinet=1.2,0,0 --out moved
    """
    from rfsg import report

    if subcarriers is not None and bandwidth is None:
        raise typer.BadParameter("--subcarriers divides a band: give --bandwidth as well")
    if (snapshots is None) != (duration is None):
        raise typer.BadParameter("--snapshots and --duration: give both or neither")
    question, carriers = parse_quality(quality, changes), parse_frequencies(frequency)
    report.refuse_taken(out, overwrite)
    read = _read(scene, asset_root, variant, time)
    edited = _edited(read, move, replace, without, receivers)
    _seed(seed)
    import torch

    from rfsg.tracer import simulate as tracer

    hertz = torch.tensor(carriers, dtype=torch.float64) if carriers else None
    with bar() as progress:
        result = tracer.simulate(edited, hertz, question, device=_device(device), progress=progress)
        progress("responses")
        band = {} if subcarriers is None else {"subcarriers": subcarriers}
        responses = report.response_arrays(
            result, bandwidth, snapshots=snapshots, duration_s=duration, **band
        )
    asked = {"scene": str(scene), "move": move, "replace": replace, "without": without}
    asked |= {"asset_roots": asset_root, "variants": variant, "time_code": time}
    asked |= {"seed": seed, "device": device, "receivers_file": receivers and str(receivers)}
    asked |= {"bandwidth_hz": bandwidth, "snapshots": snapshots, "duration_s": duration, **band}
    chosen = _chosen_links(edited, result, link)
    with report.output_folder(out, overwrite) as folder:
        report.write_links(result, folder / "links.csv")
        report.write_paths(result, folder / "paths.csv")
        report.write_channel(result, folder / "channel.npz", responses)
        report.write_json(report.report(result, **asked), folder / "report.json")
        _draw_run(edited, result, chosen, folder, title=scene.name)
    _print_links(result)
    from rfsg.tracer.mimo import plane_wave_warnings

    for warning in (*result.warnings, *plane_wave_warnings(result)):
        note(warning)
    print_files(out, ("links.csv", "paths.csv", "channel.npz", "report.json"))
    print_files(out, ("scene.png", "pdp.png"))


@app.command(name="map")
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
            metavar="NUMBER[Hz|kHz|MHz|GHz]",
            help="Band that the noise of the SINR fills. Default: 20MHz.",
        ),
    ] = None,
    noise_figure: Annotated[float, typer.Option(help="Of the receivers [dB].")] = 0.0,
    method: Annotated[
        Method | None,
        typer.Option(
            help="rays: mean over each cell, fast. paths: exact at its middle, with every "
            "mechanism. Default: rays on a plane, paths on an object."
        ),
    ] = None,
    frequency: Frequency = None,
    quality: Preset = "standard",
    changes: Changes = [],
    move: Moves = [],
    replace: Replacements = [],
    without: Removals = [],
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    device: Device = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Received power, path loss, SINR and best server over a plane or over an object.

    Writes map.png, map.npz and report.json into --out.

    Example: rfsg map lab.usda --height 1.2 --cell 0.25 --metric sinr --noise-figure 7 --out map
    """
    from rfsg import report

    chosen = {"--height": height, "--plane": plane, "--on": on}
    given = [name for name, value in chosen.items() if value is not None]
    if len(given) > 1 or (on is not None and bounds is not None):
        raise typer.BadParameter("--height, --plane, --on: give one; --bounds goes with a plane")
    question = parse_quality(quality, changes)
    report.refuse_taken(out, overwrite)
    band = bandwidth or 20e6
    edited = _edited(_read(scene, asset_root, variant, time), move, replace, without, None)
    shown = None if transmitter is None else _transmitter(edited, transmitter)
    options: dict[str, Any] = {"quality": question, "seed": seed, "device": _device(device)}
    options |= {} if cell is None else {"cell": cell}
    options |= {} if method is None else {"method": method.value}
    where: dict[str, Any] = {} if height is None else {"height": height}
    where |= {} if plane is None else {"plane": parse_plane(plane)}
    if bounds is not None:
        where["bounds"] = parse_numbers(bounds, 4, "four numbers in metres, as in 0,0,8,5")
    from rfsg.tracer import radiomap

    with bar() as progress:
        progress("radio map")
        if on is not None:
            found = radiomap.radio_map_on(edited, on, frequency, offset=offset, **options)
        else:
            found = radiomap.radio_map(edited, frequency, **where, **options)
    asked = {"scene": str(scene), "move": move, "replace": replace, "without": without}
    asked |= {"asset_roots": asset_root, "variants": variant, "time_code": time}
    asked |= {"frequency_hz": found.frequency, "cells": list(found.cells.shape), "cell": cell}
    asked |= {"height": height, "plane": plane, "bounds": bounds, "on": on, "offset": offset}
    asked |= {"metric": metric.value, "bandwidth_hz": band, "noise_figure_db": noise_figure}
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


@app.command()
def check(file: AnyFile, asset_root: Roots = [], variant: Variants = [], time: Time = None) -> None:
    """List every fault of a scene or an asset; exit code 3 if there is one."""
    _must_exist(file)
    from rfsg.scene import usd

    faults = usd.check(file, **_reading(asset_root, variant, time))
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
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
) -> None:
    """Print what a scene or an asset holds: objects, kinds, parameter counts, radios."""
    from rfsg import report

    scene = _read(file, asset_root, variant, time)
    print_table(f"{file}", report.scene_table(scene))
    if parameters:
        print_table("parameters", report.parameter_table(scene))
    radios = [("transmitter", r) for r in scene.transmitters]
    radios += [("receiver", r) for r in scene.receivers]
    if radios:
        print_table("radios", [_radio_row(role, radio) for role, radio in radios])
    if scene.frequency is not None:
        typer.echo(f"frequency: {scene.frequency / 1e9:g} GHz")
    for warning in scene.warnings:
        note(warning)


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
    with bar() as progress:
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
    rows = [{"quantity": k, "value": short(v)} for k, v in vars(outcome).items()]
    print_table(f"{asset}", rows)


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


def _must_exist(file: Path) -> None:
    if not file.exists() or file.is_dir():
        raise FileNotFoundError(2, "no such file", str(file))


def _read(file: Path, roots: list[Path], variants: list[str], time: float | None) -> "Scene":
    _must_exist(file)
    options = _reading(roots, variants, time)
    from rfsg.scene.scene import Scene

    return Scene.from_usd(file, **options)


def _reading(roots: list[Path], variants: list[str], time: float | None) -> dict[str, Any]:
    """The options of ``rfsg.scene.usd.read`` that were given."""
    for root in roots:
        if not root.is_dir():
            raise typer.BadParameter(f"--asset-root {root}: no such folder")
    if time is not None and not math.isfinite(time):
        raise typer.BadParameter(f"--time {time}: expected a finite time code")
    chosen = parse_variants(variants)
    return {"asset_roots": roots, "variants": chosen, "time": time}


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
    print_table(
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


if __name__ == "__main__":
    main()
