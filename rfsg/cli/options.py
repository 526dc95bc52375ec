"""Options that several commands have, each written once."""

from pathlib import Path
from typing import Annotated

import typer

from rfsg.cli.parse import parse_budget, parse_decibel, parse_frequency

HERTZ = "NUMBER[Hz|kHz|MHz|GHz]"

SceneFile = Annotated[Path, typer.Argument(help="A USD scene (.usda, .usdc, .usdz).")]
AnyFile = Annotated[Path, typer.Argument(help="A USD scene, or one object's asset.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]
Frequency = Annotated[
    float | None,
    typer.Option(
        parser=parse_frequency,
        metavar=HERTZ,
        help="Carrier frequency. Default: the scene's own.",
    ),
]
Frequencies = Annotated[
    list[str],
    typer.Option(
        "--frequency",
        metavar=f"{HERTZ}[,...]",
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
Accuracy = Annotated[
    float | None,
    typer.Option(
        parser=parse_decibel,
        metavar="NUMBER[dB]",
        help="Of path gain, at 90 % of links against reference. Takes the cheapest setting that is "
        "estimated to meet it.",
    ),
]
Budget = Annotated[
    float | None,
    typer.Option(
        parser=parse_budget,
        metavar="NUMBER[s|min|h]",
        help="Time to spend. Takes the most accurate setting that is predicted to fit.",
    ),
]
Moves = Annotated[
    list[str],
    typer.Option(
        "--move",
        metavar="PATH=X,Y,Z[,YAW]",
        help="Move an object, a radio or a group by metres, from where it stands: "
        "/World/Cabinet=1.2,0,0; with a fourth number also turn it about z, in degrees.",
    ),
]
Swaps = Annotated[
    list[str],
    typer.Option(
        "--swap",
        "--replace",
        metavar="PATH=ASSET",
        help="Put another asset in an object's place: /World/Cabinet=desk.usda.",
    ),
]
Removals = Annotated[
    list[str],
    typer.Option(
        "--remove", "--without", metavar="PATH", help="Leave an object, a radio or a group out."
    ),
]
Additions = Annotated[
    list[str],
    typer.Option(
        "--add",
        metavar="PATH=ASSET@X,Y,Z[,YAW]",
        help="Add an object from its asset: /World/Desk_2=desk.usda@1,2,0,90.",
    ),
]
Save = Annotated[
    Path | None,
    typer.Option(
        "--save",
        metavar="EDITS.usda",
        help="Also keep the edits: as a USD layer over the scene, which stays as it is.",
    ),
]
Receivers = Annotated[
    Path | None,
    typer.Option(help="CSV table name,x,y,z in metres: receivers in place of the scene's."),
]
Device = Annotated[str, typer.Option(help="cpu, cuda or cuda:1.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random; it is written down.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")]
Untrusted = Annotated[
    bool,
    typer.Option(
        "--untrusted",
        help="Read a stranger's file in a child process with limits on time, memory and files.",
    ),
]
