"""``rfsg neuralise``: a mesh object of a scene becomes a neural object."""

from pathlib import Path
from typing import Annotated, Any

import typer

from rfsg.cli.options import Overwrite, Roots, SceneFile, Seed, Time, Variants
from rfsg.cli.scenes import read_scene
from rfsg.cli.terminal import bar, print_table


def neuralise(
    scene: SceneFile,
    prim: Annotated[str, typer.Argument(help="The mesh object: /World/Building.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The asset to write: NAME.usda.")],
    in_place: Annotated[
        Path | None,
        typer.Option(help="Also write a layer over the scene in which the asset has its place."),
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Training steps.", min=1)] = None,
    seed: Seed = 0,
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    overwrite: Overwrite = False,
) -> None:
    """Learn the shape of a mesh object and write it as an asset, its material kept.

    Example: rfsg neuralise city.usda /World/Town_hall -o town_hall.usda --in-place learned.usda
    """
    read = read_scene(scene, asset_root, variant, time)
    from rfsg.learn.neuralised import neuralise_object
    from rfsg.report import short

    options: dict[str, Any] = {} if steps is None else {"steps": steps}
    with bar() as progress:
        outcome = neuralise_object(
            read,
            prim,
            out,
            layer=in_place,
            seed=seed,
            overwrite=overwrite,
            progress=lambda step, total, note: progress("training", step, total, note),
            **options,
        )
    rows = [{"quantity": k, "value": short(v)} for k, v in vars(outcome).items()]
    print_table(f"{out.with_suffix('.usda')}", rows)
