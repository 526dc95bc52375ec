"""``rfsg check``, ``info`` and ``learn-shape``: what a file holds, and how an asset is made."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from rfsg.cli.errors import INPUT
from rfsg.cli.options import AnyFile, Overwrite, Roots, Seed, Time, Untrusted, Variants
from rfsg.cli.scenes import must_exist, read_scene, reading_options
from rfsg.cli.terminal import bar, note, print_table


class Axis(StrEnum):
    y = "y"
    z = "z"


def check(
    file: AnyFile,
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    untrusted: Untrusted = False,
) -> None:
    """List every fault of a scene or an asset, prim by prim; exit code 3 if there is one.

    What reading refuses, what OpenUSD's own validators find, and what neither looks at: meshes that
    are only shown, pictures, bounds beside the weights. What is so by design is a note.
    """
    must_exist(file)
    options = reading_options(asset_root, variant, time)
    if untrusted:
        from rfsg.scene.sandbox import check as findings
    else:
        from rfsg.scene.usd.validation import findings

    found = findings(file, **options)
    for fault in found.faults:
        typer.echo(fault)
    for reason in found.notes:
        note(reason)
    if found.faults:
        raise typer.Exit(INPUT)
    typer.echo(f"{file}: no faults")


def info(
    file: AnyFile,
    parameters: Annotated[
        bool, typer.Option("--parameters", help="Also list every parameter tensor.")
    ] = False,
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    untrusted: Untrusted = False,
) -> None:
    """Print what a scene or an asset holds: objects, kinds, parameter counts, radios."""
    from rfsg import report

    scene = read_scene(file, asset_root, variant, time, untrusted)
    print_table(f"{file}", report.scene_table(scene))
    if parameters:
        print_table("parameters", report.parameter_table(scene))
    if radios := report.radio_table(scene):
        print_table("radios", radios)
    if scene.frequency is not None:
        typer.echo(f"frequency: {scene.frequency / 1e9:g} GHz")
    for warning in scene.warnings:
        note(warning)


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
    must_exist(mesh)
    from rfsg.assets import illustrate
    from rfsg.learn.geometry import learn_shape_file
    from rfsg.report import short
    from rfsg.scene.weights import refuse_overwrite

    refuse_overwrite([asset.with_suffix(".png")], overwrite)  # before the training
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
    illustrate(asset.with_suffix(".usda"), overwrite=overwrite)
    rows = [{"quantity": k, "value": short(v)} for k, v in vars(outcome).items()]
    print_table(f"{asset}", rows)
