"""``rfsg view``: a scene in the browser, its paths, and hands to move things by."""

import time as clock
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfsg.cli.options import (
    Additions,
    Changes,
    Frequency,
    Moves,
    Overwrite,
    Preset,
    Receivers,
    Removals,
    Roots,
    SceneFile,
    Swaps,
    Time,
    Variants,
)
from rfsg.cli.parse import parse_quality
from rfsg.cli.scenes import Edits, edit, must_exist, reading_options

if TYPE_CHECKING:
    from rfsg.view.session import Session

PORT = 8080
LOOK_S = 1.0  # between looks at whether another program has written the scene's files


def view(
    scene: SceneFile,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Of the page, on this machine. 0: a free one.")
    ] = PORT,
    open_: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
    ] = True,
    map_: Annotated[
        bool, typer.Option("--map", help="Also a radio map, anew whenever the scene is at rest.")
    ] = False,
    height: Annotated[float, typer.Option(help="With --map: its height [m].")] = 1.2,
    library: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Assets to swap objects for, as of `rfsg assets`."),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Write one page that needs no server, and end."),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(metavar="EDITS.usda", help="Where the button 'Save edits' writes."),
    ] = None,
    frequency: Frequency = None,
    quality: Preset = "standard",
    changes: Changes = [],
    move: Moves = [],
    swap: Swaps = [],
    remove: Removals = [],
    add: Additions = [],
    receivers: Receivers = None,
    asset_root: Roots = [],
    variant: Variants = [],
    time: Time = None,
    overwrite: Overwrite = False,
) -> None:
    """Look at a scene and its paths in the browser, and move, swap, copy and remove things.

    The page is served to this machine alone (127.0.0.1). While something is dragged its paths follow
    as a draft; at rest they are those of `rfsg simulate`. What another program writes to the scene's
    files is taken over. Needs: pip install rfsg[viewer]

    Example: rfsg view lab.usda --library objects --map --save moved.usda
    """
    _need_viser()
    question = parse_quality(quality, changes)
    for name, file in (("--save", save), ("--html", html)):
        if file is not None and file.exists() and not overwrite:
            raise typer.BadParameter(f"{name} {file}: already exists; --overwrite replaces it")
    must_exist(scene)
    options = reading_options(asset_root, variant, time)
    from rfsg.scene.library import Library
    from rfsg.scene.usd.live import LiveScene
    from rfsg.view.session import Session

    live = LiveScene(scene, **options)
    edited = edit(live.scene, Edits(move, swap, remove, add), receivers)

    session = Session(
        edited,
        frequency=frequency,
        quality=question,
        library=None if library is None else Library(library),
        save_to=save,
        overwrite=overwrite,
        map_options={"height": height} if map_ else None,
        live=live,
    )
    try:
        if html is None:
            _serve(session, port, scene.stem, open_)
        else:
            _write(session, html, scene.stem)
    finally:
        session.close()


def _serve(session: "Session", port: int, title: str, open_: bool) -> None:
    """Until Ctrl-C."""
    from rfsg.view.page import Page

    typer.echo("drawing the scene ...", err=True)
    page = Page(session, port, title)
    typer.echo(f"{page.url}    (Ctrl-C ends it)")
    if open_:
        import webbrowser

        webbrowser.open(page.url)
    try:
        while True:
            clock.sleep(LOOK_S)
            page.refresh()
    except KeyboardInterrupt:
        typer.echo("")
    finally:
        page.close()


def _write(session: "Session", file: Path, title: str) -> None:
    from rfsg.view.still import write_html

    if not session.wait_for_all():
        fault: Any = session.answer and session.answer.fault
        raise ValueError(f"{file}: not written, for the simulation failed: {fault}")
    typer.echo(str(write_html(session, file, title)))


def _need_viser() -> None:
    from importlib.util import find_spec

    if find_spec("viser") is None:
        raise typer.BadParameter("the page needs viser: pip install 'rfsg[viewer]'")
