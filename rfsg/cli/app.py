"""``rfsg``: the commands, put together and run."""

import gc
import sys
import traceback
from collections.abc import Callable
from typing import Annotated

import typer

from rfsg import __version__
from rfsg.cli.assets import check, info, learn_shape
from rfsg.cli.edit import edit
from rfsg.cli.errors import INTERRUPTED, verdict
from rfsg.cli.export import assets, export
from rfsg.cli.fit import fit
from rfsg.cli.fit_regions import fit_regions
from rfsg.cli.imports import import_
from rfsg.cli.map import map_
from rfsg.cli.neuralise import neuralise
from rfsg.cli.simulate import simulate
from rfsg.cli.terminal import say
from rfsg.cli.tradeoff import tradeoff
from rfsg.cli.view import view

COMMANDS: dict[str, Callable[..., None]] = {  # in the order of --help
    "simulate": simulate,
    "map": map_,
    "tradeoff": tradeoff,
    "view": view,
    "edit": edit,
    "check": check,
    "info": info,
    "export": export,
    "import": import_,
    "neuralise": neuralise,
    "learn-shape": learn_shape,
    "fit": fit,
    "fit-regions": fit_regions,
}

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Radio ray tracing with neural objects that are trained once and reused in any scene.",
    epilog="Errors are one plain sentence; --debug, anywhere, shows where they come from. "
    "Exit codes: 0 done, 2 usage, 3 a scene or file at fault, 4 a numeric problem.",
)
for _name, _command in COMMANDS.items():
    app.command(_name)(_command)
app.add_typer(assets, name="assets")


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit()


def main() -> None:
    """Entry point of ``rfsg``."""
    gc.set_threshold(50_000, 10, 10)  # or it looks through torch's modules again and again
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
        return say(*verdict(error))
