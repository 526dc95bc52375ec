"""``--usd``: results as a USD layer over the scene, beside the other files."""

import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

from rfsg.cli.terminal import note

Usd = Annotated[
    bool,
    typer.Option("--usd", help="Also write the result as USD: a layer over the scene."),
]


def refuse_usd(usd: bool, untrusted: bool) -> None:
    """Before anything is read: a layer over a stranger's file would open it outside the child."""
    if usd and untrusted:
        raise typer.BadParameter(
            "--usd writes a layer over the scene's file, which --untrusted keeps in a child process: "
            "leave one out"
        )


def print_usd(result: Any, file: Path, overwrite: bool) -> None:
    """Write ``result.to_usd`` and say so, and what a reader of the layer needs.

    Where it is to stay, not in the folder that becomes --out: a layer names its source by where it
    lies, and must not take the place of one that it stands on."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result.to_usd(file, overwrite)
    for warning in caught:
        note(str(warning.message))
    typer.echo(str(file))
