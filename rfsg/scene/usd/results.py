"""Results as USD: a layer over the scene's source with paths as curves and a map as a coloured mesh.

The layer is that of ``edits.save_edits``, so what is seen is the scene that was simulated: its edits
and chosen variants too. The results are one prim more at the root, in the source's units and axes. It
carries no radio material, so waves do not see it and the scene that is read from the layer is the same.
Points are single precision about their middle, which is double: far from the origin they stay exact.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from rfsg.scene.colours import MAP, PATHS, colours, linear
from rfsg.scene.scene import Scene, SceneError, at_or_below
from rfsg.scene.usd.edits import save_edits
from rfsg.scene.usd.faults import quiet
from rfsg.scene.usd.placements import world_from_stage
from rfsg.scene.usd.reading import RESULTS
from rfsg.scene.usd.source import Source, opened
from rfsg.scene.weights import refuse_overwrite, write_beside

PATHS_PRIM, MAP_PRIM = "/RadioPaths", "/RadioMap"
RANGE_DB = 45.0  # of the colours of paths, below the strongest
WIDTH = 0.02  # of a curve [m]


def write_paths(
    scene: Scene,
    path: str | Path,
    points: Sequence[Float[ndarray, "_ 3"]],
    gain_db: Float[ndarray, "n"],
    delay_s: Float[ndarray, "n"],
    overwrite: bool = False,
) -> Path:
    """Write paths as linear BasisCurves ``/RadioPaths`` over the scene; returns the path (.usda).

    points: where each path goes in the world [m]. gain_db [dB], delay_s [s]: a primvar each, uniform
    (one per curve), as is displayColor: the strongest is bright, 45 dB below it is dark.

    Raises SceneError as ``save_edits`` does, and where the source has such a prim of its own.
    """
    counts = [len(p) for p in points]
    at = np.concatenate([np.zeros((0, 3)), *points])
    best = float(gain_db.max()) if len(gain_db) else 0.0

    def author(stage: Usd.Stage, stage_from_world: np.ndarray) -> None:
        curves = UsdGeom.BasisCurves.Define(stage, PATHS_PRIM)
        curves.CreateTypeAttr(UsdGeom.Tokens.linear)
        curves.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
        curves.CreateCurveVertexCountsAttr(_integers(counts))
        width = WIDTH * _length(stage_from_world)
        curves.CreateWidthsAttr([width])
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        _place(curves, at, stage_from_world, width / 2)
        _colour(curves, gain_db, best - RANGE_DB, best, PATHS)
        _number(curves, "gain_db", gain_db)
        _number(curves, "delay_s", delay_s)

    return _over(scene, path, PATHS_PRIM, author, overwrite)


def write_map(
    scene: Scene,
    path: str | Path,
    vertices: Float[ndarray, "v 3"],
    faces: Int[ndarray, "k corners"],
    rss_dbm: Float[ndarray, "k"],
    overwrite: bool = False,
) -> Path:
    """Write a map as a Mesh ``/RadioMap`` over the scene; returns the path (.usda).

    vertices: in the world [m]. rss_dbm: received signal strength of each face [dBm], a uniform primvar
    (one per face), as is displayColor: bright is strong, from the 1st to the 99.5th percentile. Faces
    where nothing arrives (-inf) are left out.

    Raises SceneError as ``save_edits`` does, and where the source has such a prim of its own.
    """
    heard = np.isfinite(rss_dbm)
    value = rss_dbm[heard]
    used, index = np.unique(faces[heard], return_inverse=True)
    low, high = np.percentile(value, (1, 99.5)) if len(value) else (0.0, 1.0)

    def author(stage: Usd.Stage, stage_from_world: np.ndarray) -> None:
        mesh = UsdGeom.Mesh.Define(stage, MAP_PRIM)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateFaceVertexCountsAttr(_integers([faces.shape[1]] * len(value)))
        mesh.CreateFaceVertexIndicesAttr(_integers(index.reshape(-1)))
        _place(mesh, vertices[used], stage_from_world)
        _colour(mesh, value, low, high, MAP)
        _number(mesh, "rss_dbm", value)

    return _over(scene, path, MAP_PRIM, author, overwrite)


def _over(
    scene: Scene,
    path: str | Path,
    name: str,
    author: Callable[[Usd.Stage, np.ndarray], None],
    overwrite: bool,
) -> Path:
    """A layer over the scene's source with one prim more: all of it, or no file."""
    path = Path(path).absolute()
    source = Source.of(scene, str(path))
    refuse_overwrite([path], overwrite)
    own = Usd.Stage.CreateInMemory()
    with quiet(path):
        below = opened(source.given or source.path, source.options).stage
        _refuse_taken(scene, below, name)
        author(own, np.linalg.inv(world_from_stage(below, path, [])))
        own.GetPrimAtPath(name).SetCustomDataByKey(RESULTS, True)
        del below
    save_edits(scene, path, overwrite)
    try:
        with quiet(path):
            layer = Sdf.Layer.OpenAsAnonymous(str(path))
            Sdf.CopySpec(own.GetRootLayer(), name, layer, name)
            text = layer.ExportToString()
        write_beside(path, text.encode(), overwrite=True)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return path


def _refuse_taken(scene: Scene, below: Usd.Stage, name: str) -> None:
    """Earlier results may give way, nothing else."""
    prim = below.GetPrimAtPath(name)
    things = (*scene.nodes, *scene.transmitters, *scene.receivers)
    if (prim and not prim.GetCustomDataByKey(RESULTS)) or any(
        at_or_below(thing.path, name) for thing in things
    ):
        raise SceneError(
            [f"{name}: the scene has a prim here, where its results would go; rename it"]
        )


def _place(
    shape: UsdGeom.PointBased,
    points_world: Float[ndarray, "p 3"],
    stage_from_world: np.ndarray,
    margin: float = 0.0,
) -> None:
    """Points of the world, about their middle, with an extent ``margin`` wider [stage units]."""
    at = points_world @ stage_from_world[:3, :3].T + stage_from_world[:3, 3]
    middle = (at.min(0) + at.max(0)) / 2 if len(at) else np.zeros(3)
    at = (at - middle).astype(np.float32)
    shape.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*middle.tolist()))
    shape.CreatePointsAttr(_vectors(at))
    ends = np.stack([at.min(0) - margin, at.max(0) + margin]) if len(at) else np.zeros((2, 3))
    shape.CreateExtentAttr(_vectors(ends))


def _colour(
    shape: UsdGeom.Gprim, value: Float[ndarray, "n"], low: float, high: float, scale: str
) -> None:
    shown = shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform)
    shown.Set(_vectors(linear(colours(value, low, high, scale))))
    shape.GetPrim().SetDocumentation(f"Colours: {scale}, from {low:.1f} dB to {high:.1f} dB.")


def _number(shape: UsdGeom.Gprim, name: str, value: Float[ndarray, "n"]) -> None:
    kind, uniform = Sdf.ValueTypeNames.DoubleArray, UsdGeom.Tokens.uniform
    primvar = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(name, kind, uniform)
    primvar.Set(Vt.DoubleArray.FromNumpy(np.ascontiguousarray(value, np.float64)))


def _length(matrix: np.ndarray) -> float:
    """What one metre is in the stage's units: the matrix turns and scales evenly."""
    return float(np.linalg.norm(matrix[:3, 0]))


def _vectors(value: Float[ndarray, "n 3"]) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(value, np.float32))


def _integers(value: Sequence[int] | Int[ndarray, "n"]) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(value, np.int32))
