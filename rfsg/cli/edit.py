"""``rfsg edit``: move, swap, remove and add objects of a scene, kept as a layer over it."""

from pathlib import Path
from typing import Annotated

import typer

from rfsg.cli.options import (
    Additions,
    Moves,
    Overwrite,
    Receivers,
    Removals,
    Roots,
    SceneFile,
    Swaps,
    Time,
    Variants,
)
from rfsg.cli.scenes import Edits, read_scene
from rfsg.cli.scenes import edit as edited


def edit(
    scene: SceneFile,
    save: Annotated[
        Path, typer.Option("--save", "-o", metavar="EDITS.usda", help="The layer to write.")
    ],
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
    """Move, swap, remove and add objects, and keep that as a USD layer over the scene.

    The scene and its assets stay as they are; the layer is a scene for every command.

    Example: rfsg edit lab.usda --move /World/Cabinet=1.2,0,0 --remove /World/Desk --save moved.usda
    """
    edits = Edits(move, swap, remove, add, save)
    edits.refuse_taken(overwrite)
    edited(read_scene(scene, asset_root, variant, time), edits, receivers, overwrite)
