"""``rfsg simulate``: every path between the scene's radios, and the channels they make."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfsg.cli.options import (
    HERTZ,
    Accuracy,
    Additions,
    Budget,
    Changes,
    Device,
    Frequencies,
    Moves,
    Out,
    Overwrite,
    Preset,
    Receivers,
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
    parse_duration,
    parse_frequencies,
    parse_frequency,
    parse_pair,
    parse_quality,
)
from rfsg.cli.results import Usd, print_usd, refuse_usd
from rfsg.cli.scenes import Edits, asked_of_scene, device_named, edit, read_scene
from rfsg.cli.terminal import bar, note, print_files, print_table

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene
    from rfsg.tracer.simulate import Result


class Layout(StrEnum):
    """Tools whose layout of a channel is known; see docs/interchange.md."""

    sionna = "sionna"
    deepmimo = "deepmimo"


MOST_ROWS = 30  # of the table on the terminal; links.csv holds all


def simulate(
    scene: SceneFile,
    out: Out,
    frequency: Frequencies = [],
    quality: Preset = "standard",
    changes: Changes = [],
    accuracy: Accuracy = None,
    budget: Budget = None,
    move: Moves = [],
    swap: Swaps = [],
    remove: Removals = [],
    add: Additions = [],
    save: Save = None,
    receivers: Receivers = None,
    bandwidth: Annotated[
        float | None,
        typer.Option(
            parser=parse_frequency,
            metavar=HERTZ,
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
    channel: Annotated[
        list[Layout],
        typer.Option(help="Also write the channel as this tool reads it (repeatable)."),
    ] = [],
    usd: Usd = False,
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    untrusted: Untrusted = False,
    device: Device = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Find every path between the scene's radios, and the channels they make.

    Writes links.csv, paths.csv, channel.npz, report.json, scene.png and pdp.png into --out; with
    --channel also cir.npz (Sionna) or a folder deepmimo, with --usd paths.usda.

    --accuracy or --budget take the place of --quality: the setting is chosen by pilot runs.

    Example: rfsg simulate lab.usda --frequency 2.44GHz --move /World/Cabinet=1.2,0,0 --out moved
    """
    from rfsg import report

    if subcarriers is not None and bandwidth is None:
        raise typer.BadParameter("--subcarriers divides a band: give --bandwidth as well")
    if (snapshots is None) != (duration is None):
        raise typer.BadParameter("--snapshots and --duration: give both or neither")
    if (accuracy or budget) and (quality != "standard" or changes):
        raise typer.BadParameter(
            "--accuracy and --budget choose the quality: leave out --quality, --set"
        )
    refuse_usd(usd, untrusted)
    question, carriers = parse_quality(quality, changes), parse_frequencies(frequency)
    report.refuse_taken(out, overwrite)
    edits = Edits(move, swap, remove, add, save)
    edits.refuse_taken(overwrite)
    read = read_scene(scene, asset_root, variant, time, untrusted)
    edited = edit(read, edits, receivers, overwrite)
    import torch

    from rfsg.tracer import simulate as tracer

    torch.manual_seed(seed)
    hertz = torch.tensor(carriers, dtype=torch.float64) if carriers else None
    with bar() as progress:
        options: dict[str, Any] = {"device": device_named(device), "progress": progress}
        if accuracy is None and budget is None:
            result, choice = tracer.simulate(edited, hertz, question, **options), None
        else:
            from rfsg.tracer.dial import within

            wanted = {"accuracy_db": accuracy, "budget_s": budget, "seed": seed}
            result, choice = within(edited, hertz, **wanted, **options)
        progress("responses")
        band = {} if subcarriers is None else {"subcarriers": subcarriers}
        responses = report.response_arrays(
            result, bandwidth, snapshots=snapshots, duration_s=duration, **band
        )
    asked = asked_of_scene(scene, edits, asset_root, variant, time)
    asked |= {"seed": seed, "device": device, "receivers_file": receivers and str(receivers)}
    asked |= {"bandwidth_hz": bandwidth, "snapshots": snapshots, "duration_s": duration, **band}
    asked |= {} if choice is None else {"dial": choice}
    chosen = _chosen_links(edited, result, link)
    with report.output_folder(out, overwrite) as folder:
        report.write_links(result, folder / "links.csv")
        report.write_paths(result, folder / "paths.csv")
        report.write_channel(result, folder / "channel.npz", responses)
        report.write_json(report.report(result, **asked), folder / "report.json")
        _draw(edited, result, chosen, folder, title=scene.name)
        _write_layouts(result, channel, folder)
    _print_links(result)
    from rfsg.tracer.mimo import plane_wave_warnings

    if choice is not None:
        typer.echo(choice.sentence())
    for warning in (*result.warnings, *plane_wave_warnings(result)):
        note(warning)
    print_files(out, ("links.csv", "paths.csv", "channel.npz", "report.json"))
    print_files(out, ("scene.png", "pdp.png"))
    if usd:
        print_usd(result, out / "paths.usda", overwrite)


def _chosen_links(scene: "Scene", result: "Result", asked: list[str]) -> list[tuple[int, int]]:
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


def _draw(
    scene: "Scene", result: "Result", links: list[tuple[int, int]], folder: Path, title: str
) -> None:
    from rfsg import plot

    figure = plot.scene_figure(scene, result.paths, result.channel, title)
    plot.save(figure, folder / "scene.png")
    plot.save(plot.delay_figure(scene, result.channel, links), folder / "pdp.png")


def _write_layouts(result: "Result", layouts: list[Layout], folder: Path) -> None:
    from rfsg import interchange

    if Layout.sionna in layouts:
        interchange.write_sionna(result, folder / "cir.npz")
    if Layout.deepmimo in layouts:
        interchange.write_deepmimo(result, folder / "deepmimo")


def _print_links(result: "Result") -> None:
    rows = result.links()
    print_table("links", [_link_row(row) for row in rows[:MOST_ROWS]])
    if len(rows) > MOST_ROWS:
        typer.echo(f"... and {len(rows) - MOST_ROWS} more in links.csv")


def _link_row(row: Any) -> dict[str, Any]:
    return {
        "tx": row["tx"],
        "rx": row["rx"],
        "path gain [dB]": f"{row['path_gain_db']:.2f}" if row["n_paths"] else "",
        "RSS [dBm]": f"{row['rss_dbm']:.2f}" if row["n_paths"] else "",
        "delay spread [ns]": f"{row['delay_spread_ns']:.2f}" if row["n_paths"] else "",
        "paths": row["n_paths"],
        "line of sight": "yes" if row["los"] else "no",
    }
