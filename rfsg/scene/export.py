"""An object of a scene as an asset: a folder, a USD file with its weights beside it, or a package.

What is exported is the object as it stands in the scene, with the material that the scene gives it and
the weights that it has now, in its own frame; place, size and motion stay with the scene.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rfsg.objects.body import Body, unstretched
from rfsg.objects.shapes.shown import Shown, hull_of, shown_mesh
from rfsg.scene.assets import LoadedAsset, load_asset
from rfsg.scene.errors import SceneError
from rfsg.scene.materials import material_of
from rfsg.scene.scene import Node, Scene
from rfsg.scene.usd.packaging import PACKAGE, asset_files, write_files, write_folder, write_package
from rfsg.scene.weights import refuse_overwrite, same_bits

LAYER = ".usda"
LEARNED = (0.55, 0.57, 0.6)  # linear RGB of what no known material colours


def export(
    scene: Scene,
    path: str,
    out: str | Path,
    *,
    picture: bytes | None = None,
    mesh: Shown | None = None,
    provenance: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the object at a prim path as an asset; returns the USD file.

    out: a folder (NAME/ holds NAME.usda, NAME.safetensors and NAME.png), NAME.usda (the same files
    beside one another), or a package NAME.usdz. picture: a PNG, as ``rfsg.export`` draws it. mesh: as
    ``shown_mesh`` gives it, when it is at hand. provenance: what to tell besides what the object's own
    asset tells: anything JSON can hold.

    Raises SceneError for a path where no object is, one without bounds (a half-space), what cannot be
    written, and files that are there unless ``overwrite``.
    """
    node, out, file = scene.node(path), Path(out), usd_file(out)
    node = replace(node, body=unstretched(node.body)[0])
    refuse_overwrite([file], overwrite)  # before the work
    shown = surface_of(node) if mesh is None else mesh
    files = asset_files(
        file.stem,
        node.body,
        name=file.stem,
        mesh=shown,
        hull=hull_of(shown[0]),
        picture=picture,
        provenance=story(scene, node) | dict(provenance or {}),
        color=color_of(node.body),
    )
    if out.suffix == PACKAGE:
        write_package(out, files, overwrite)
    elif out.suffix == LAYER:
        write_files(out.parent, files, overwrite)
    else:
        write_folder(out, files, overwrite)
    return file


def usd_file(out: str | Path) -> Path:
    """The USD file of an asset that is written to a folder, NAME.usda or NAME.usdz."""
    out = Path(out)
    if not out.name or out.name == "..":
        raise SceneError([f"{out}: expected a folder, NAME{LAYER} or NAME{PACKAGE} to write to"])
    return out if out.suffix in (PACKAGE, LAYER) else out / f"{out.name}{LAYER}"


def surface_of(node: Node) -> Shown:
    """The mesh that an asset shows of a node's object, as it was learned. SceneError where there is
    none."""
    try:
        return shown_mesh(unstretched(node.body)[0].shape)
    except ValueError as error:
        raise SceneError([f"{node.path}: no asset can be made of it: {error}"]) from error


def color_of(body: Body) -> tuple[float, float, float]:
    """Linear RGB of an object in pictures: its material's."""
    material = material_of(body.surface)
    return LEARNED if material is None else material.look()[0]


def story(scene: Scene, node: Node) -> dict[str, Any]:
    """What an object's own asset tells of it, as far as that still holds, and where it came from."""
    told: dict[str, Any] = {}
    if node.asset is not None and Path(node.asset).is_file():
        told = _retold(node.body, load_asset(node.asset))
    source = getattr(scene.source, "path", None)
    exported = {"object": node.path} | ({"scene": Path(source).name} if source else {})
    return told | {"exported": exported}


def _retold(body: Body, origin: LoadedAsset) -> dict[str, Any]:
    shape = same_bits(body.shape, origin.body.shape)
    surface = same_bits(body.surface, origin.body.surface)
    if shape and surface:
        return {k: v for k, v in origin.provenance.items() if k != "exported"}
    parts = [name for name, same in (("shape", shape), ("surface", surface)) if not same]
    was = {"file": origin.path.name, "sha256": origin.sha256, "provenance": origin.provenance}
    return {"changed": parts, "origin": was}
