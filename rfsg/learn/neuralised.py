"""A mesh object of a scene becomes a neural object: its shape learned, its material and place kept."""

from dataclasses import asdict
from pathlib import Path

import trimesh

from rfsg.learn.geometry import (
    SHOWN_TOLERANCE,
    STEPS,
    MeshError,
    Progress,
    Report,
    check_watertight,
    learn_shape,
    rounded,
)
from rfsg.objects.body import Body
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.proxy import extract_mesh
from rfsg.objects.shapes.sheet import Sheet
from rfsg.scene.assets import save_asset
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.usd.edits import save_edits
from rfsg.scene.weights import refuse_overwrite


def neuralise_object(
    scene: Scene,
    path: str,
    asset: str | Path,
    *,
    layer: str | Path | None = None,
    steps: int = STEPS,
    seed: int = 0,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Report:
    """Learn the mesh at a prim path of a scene and save it as asset (.usda); how well it was learned.

    layer: a scene (.usda) over the one that ``scene`` was read from, in which the asset stands in the
    mesh's place. A sheet that encloses something is learned as what it encloses.

    Raises SceneError for a path without a mesh and for files in the way or out of reach, MeshError for
    a mesh that is open, with the reason, LearnError for a training that cannot be used.
    """
    asset = Path(asset).with_suffix(".usda")
    written = [asset, asset.with_suffix(".safetensors"), *([Path(layer)] if layer else [])]
    refuse_overwrite(written, overwrite)
    node = scene.node(path)
    mesh, notes = _solid(path, node.body.shape)
    shape, report = learn_shape(mesh, seed=seed, steps=steps, progress=progress)
    told = {
        "prim": path,
        "repairs": notes,
        "report": {k: rounded(v) for k, v in asdict(report).items()},
    }
    save_asset(
        asset,
        Body(shape, node.body.surface),
        mesh=extract_mesh(shape, simplify=SHOWN_TOLERANCE),
        provenance=told,
        overwrite=overwrite,
    )
    if layer is not None:
        save_edits(scene.replaced(path, asset), layer, overwrite)
    return report


def _solid(path: str, shape: object) -> tuple[trimesh.Trimesh, list[str]]:
    """The closed mesh of an object, in its own frame, and what was repaired."""
    if not isinstance(shape, Mesh):
        kind = getattr(shape, "kind", type(shape).__name__)
        raise SceneError([f"{path}: a {kind}; expected a mesh, which alone is learned here"])
    triangles = shape.triangles.cpu().numpy()
    if isinstance(shape, Sheet):
        triangles = triangles[: len(triangles) // 2]
    mesh = trimesh.Trimesh(shape.vertices.detach().cpu().numpy(), triangles, process=False)
    if isinstance(shape, Sheet):
        trimesh.repair.fix_winding(mesh)  # a sheet's triangles may be wound anyhow
    try:
        return check_watertight(mesh)
    except MeshError as error:
        raise MeshError(
            f"{path}: {error}. A neural object has an inside: close the mesh in the program it came "
            "from, or give its walls a thickness; as a sheet it is traced as it is"
        ) from error
