"""``rfsg export`` and ``rfsg assets``: objects as reusable assets, and the libraries that hold them."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from rfsg.cli.options import AnyFile, Overwrite, Roots, Time, Variants
from rfsg.cli.scenes import must_exist, read_scene
from rfsg.cli.terminal import note, print_table

LIBRARY = Path("assets/objects")


def export(
    scene: AnyFile,
    path: Annotated[str, typer.Argument(metavar="PRIM", help="The object: /World/Cabinet.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="A folder, NAME.usda, or a package NAME.usdz, to write the asset to.",
        ),
    ],
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    overwrite: Overwrite = False,
) -> None:
    """Write one object of a scene as an asset that any scene can reference.

    With the material and the weights that it has there, its surface and hull for other programs, a
    picture, and what it was trained on. Example: rfsg export lab.usda /World/Cabinet -o cabinet/
    """
    read = read_scene(scene, asset_root, variant, time)
    from rfsg.assets import export as write

    typer.echo(str(write(read, path, out, overwrite=overwrite)))


class _ListsByDefault(TyperGroup):
    """``rfsg assets FOLDER`` lists: what is no command of its own is the folder."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or args[0] not in (*self.commands, *ctx.help_option_names):
            args = ["list", *args]
        return super().parse_args(ctx, args)


assets = typer.Typer(
    cls=_ListsByDefault,
    help="List the assets of a folder (rfsg assets [FOLDER]), or add one to it.",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@assets.command("list")
def list_(
    folder: Annotated[Path, typer.Argument(help="A folder of assets.")] = LIBRARY,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write a page with the pictures.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """List a library: name, kind, size, band, error, hash and picture of each asset.

    Its index is kept in FOLDER/index.json and written anew when a file has changed.
    Example: rfsg assets assets/objects --html objects.html
    """
    from rfsg.assets import contact_sheet, rows
    from rfsg.scene.library import Library

    library = Library(folder)
    print_table(f"{folder}: {len(library)} assets", rows(library))
    for fault in library.faults:
        note(fault)
    if html is not None:
        from rfsg.scene.weights import write_beside

        write_beside(html, contact_sheet(library).encode(), overwrite)
        typer.echo(str(html))


@assets.command("add")
def add(
    asset: Annotated[Path, typer.Argument(help="An asset: NAME.usda or NAME.usdz.")],
    library: Annotated[Path, typer.Option("--library", help="The folder to add it to.")] = LIBRARY,
    overwrite: Overwrite = False,
) -> None:
    """Copy an asset into a library, in a folder of its own, and draw its picture if it has none."""
    must_exist(asset)
    from rfsg.assets import illustrate
    from rfsg.scene.library import Library

    library.mkdir(parents=True, exist_ok=True)
    copy = library / asset.stem / asset.name
    Library(library).add(asset, overwrite=overwrite)
    if copy.suffix == ".usda":
        illustrate(copy, overwrite=overwrite)
    Library(library)  # with the picture in the index
    typer.echo(str(copy))
