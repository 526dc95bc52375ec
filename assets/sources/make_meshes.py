"""The meshes behind assets/objects: watertight solids in metres, z up, front towards +x.

The origin is the middle of the footprint. Run as a script to write NAME.ply files:
``python assets/sources/make_meshes.py OUT_FOLDER``.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
from manifold3d import Manifold, Mesh
from skimage.measure import marching_cubes

# Solids that only touch are not one solid: parts overlap by this much [m].
OVERLAP = 0.01


def cabinet() -> trimesh.Trimesh:
    """Metal office cabinet, 0.45 x 0.90 x 1.40 m: sharp edges, flat faces, on a plinth set back."""
    body = _block((-0.225, 0.225), (-0.45, 0.45), (0.06, 1.40))
    plinth = _block((-0.185, 0.185), (-0.41, 0.41), (0.0, 0.06 + OVERLAP))
    return _mesh(body + plinth)


def desk() -> trimesh.Trimesh:
    """Desk, 0.70 x 1.40 x 0.74 m: a 3 cm top on panel legs, with a modesty panel at the back."""
    top = _block((-0.35, 0.35), (-0.70, 0.70), (0.71, 0.74))
    legs = [_block((-0.31, 0.31), sorted((s * 0.67, s * 0.64)), (0.0, 0.72)) for s in (-1, 1)]
    panel = _block((-0.29, -0.26), (-0.65, 0.65), (0.36, 0.72))
    return _mesh(top + legs[0] + legs[1] + panel)


def chair() -> trimesh.Trimesh:
    """Chair, 0.46 x 0.46 x 0.88 m: square legs of 4 cm, a 4 cm seat, posts and a 3 cm back."""
    solid = _block((-0.23, 0.23), (-0.23, 0.23), (0.42, 0.46))
    for x, height in ((-0.21, 0.88), (0.21, 0.43)):
        for y in (-0.21, 0.21):
            solid += _block((x - 0.02, x + 0.02), (y - 0.02, y + 0.02), (0.0, height))
    return _mesh(solid + _block((-0.225, -0.195), (-0.20, 0.20), (0.56, 0.86)))


def person(step: float = 0.012, blend: float = 0.035) -> trimesh.Trimesh:
    """Standing person, 1.75 m: capsules blended over ``blend``, meshed on a grid of ``step``."""
    axes = [
        np.arange(low, high, step) for low, high in ((-0.25, 0.30), (-0.36, 0.36), (-0.06, 1.82))
    ]
    point = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    field = np.full(point.shape[:-1], np.inf)
    for a, b, radius in _limbs():
        field = _smooth_minimum(field, _capsule(point, a, b, radius), blend)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(step,) * 3)
    mesh = trimesh.Trimesh(vertices + [axis[0] for axis in axes], faces)
    solid = Manifold(Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)))
    ground = _block((-1, 1), (-1, 1), (-1, 0))
    mesh = _mesh((solid - ground).simplify(0.0005))
    mesh.apply_scale([1, 1, 1.75 / mesh.bounds[1, 2]])
    return mesh


def _limbs() -> list[tuple[tuple[float, ...], tuple[float, ...], float]]:
    """Capsules (from, to, radius) [m]; y towards the person's left."""
    middle = [
        ((0.0, 0.0, 1.00), (-0.01, 0.0, 1.18), 0.125),  # belly
        ((-0.01, -0.09, 1.32), (-0.01, 0.09, 1.32), 0.115),  # chest
        ((-0.01, -0.06, 0.95), (-0.01, 0.06, 0.95), 0.12),  # hips
        ((-0.01, 0.0, 1.38), (0.01, 0.0, 1.54), 0.055),  # neck
        ((0.02, 0.0, 1.60), (0.0, 0.0, 1.67), 0.082),  # head
    ]
    left = [
        ((-0.01, 0.10, 1.41), (-0.01, 0.19, 1.40), 0.065),  # shoulder
        ((-0.01, 0.215, 1.38), (-0.02, 0.245, 1.10), 0.047),  # upper arm
        ((-0.02, 0.245, 1.10), (0.04, 0.255, 0.86), 0.039),  # forearm
        ((0.045, 0.255, 0.83), (0.06, 0.25, 0.75), 0.036),  # hand
        ((0.0, 0.095, 0.90), (0.0, 0.10, 0.50), 0.078),  # thigh
        ((0.0, 0.10, 0.50), (-0.02, 0.105, 0.09), 0.055),  # lower leg
        ((-0.05, 0.105, 0.04), (0.14, 0.12, 0.03), 0.042),  # foot
    ]
    right = [((a[0], -a[1], a[2]), (b[0], -b[1], b[2]), r) for a, b, r in left]
    return middle + left + right


def _capsule(point: np.ndarray, a: tuple[float, ...], b: tuple[float, ...], r: float) -> np.ndarray:
    start, along = np.array(a), np.array(b) - np.array(a)
    t = np.clip((point - start) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(point - start - t[..., None] * along, axis=-1) - r


def _smooth_minimum(a: np.ndarray, b: np.ndarray, blend: float) -> np.ndarray:
    overlap = np.maximum(blend - np.abs(a - b), 0.0) / blend
    return np.minimum(a, b) - 0.25 * blend * overlap**2


def _block(*sides: tuple[float, float] | list[float]) -> Manifold:
    low, high = np.array(sides, dtype=float).T
    return Manifold.cube(list(high - low)).translate(list(low))


def _mesh(solid: Manifold) -> trimesh.Trimesh:
    parts = solid.decompose()
    if len(parts) != 1:
        raise ValueError(f"expected one solid, got {len(parts)} that do not overlap")
    raw = solid.to_mesh64()
    return trimesh.Trimesh(raw.vert_properties[:, :3], raw.tri_verts, process=False)


MAKERS = {"cabinet": cabinet, "desk": desk, "chair": chair, "person": person}

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in MAKERS.items():
        made = make()
        made.export(folder / f"{name}.ply")
        print(f"{name}: {len(made.faces)} triangles, {made.volume:.4f} m3, {made.extents} m")
