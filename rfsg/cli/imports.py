"""``rfsg import``: another program's scene as a scene of rfsg."""

from pathlib import Path
from typing import Annotated

import typer

from rfsg.cli.options import Frequency, Overwrite, Untrusted
from rfsg.cli.parse import parse_numbers
from rfsg.cli.scenes import must_exist
from rfsg.cli.terminal import note

PLACE = "three numbers in metres, as in 8.5,21,27"


def import_(
    source: Annotated[
        Path,
        typer.Argument(
            help="Mitsuba XML; a mesh (.obj, .ply, .glb, .gltf, .stl); a floor plan (.geojson, "
            ".json); a USD scene with Aerial's or SimReady's materials."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The scene: .usda, or .usdc for a large one.")
    ],
    materials: Annotated[
        Path | None,
        typer.Option(help="Material table (TOML) of a mesh: which name is what to a wave."),
    ] = None,
    metre: Annotated[
        float | None, typer.Option(help="Metres per unit of a mesh that does not say.")
    ] = None,
    up: Annotated[
        str | None, typer.Option(help="y or z: what points up in a mesh that does not say.")
    ] = None,
    tx: Annotated[
        list[str], typer.Option("--tx", metavar="X,Y,Z", help="Add a transmitter [m].")
    ] = [],
    rx: Annotated[
        list[str], typer.Option("--rx", metavar="X,Y,Z", help="Add a receiver [m].")
    ] = [],
    frequency: Frequency = None,
    untrusted: Untrusted = False,
    overwrite: Overwrite = False,
) -> None:
    """Read another program's scene and write it as USD with radio materials.

    Example: rfsg import munich.xml -o munich.usdc --tx 8.5,21,27 --rx 45,90,1.5
    """
    must_exist(source)
    places = [[parse_numbers(text, 3, PLACE) for text in some] for some in (tx, rx)]
    from rfsg.scene.importers import import_scene

    report = import_scene(
        source,
        out,
        materials=materials,
        metre=metre,
        up=up,
        tx=places[0],
        rx=places[1],
        frequency=frequency,
        overwrite=overwrite,
        untrusted=untrusted,
    )
    for warning in report.warnings:
        note(warning)
    names = ", ".join(report.materials)
    typer.echo(f"{out}: {report.objects} objects, {report.triangles} triangles; {names}")
