"""A watertight mesh becomes a neural shape: read, check, sample, train, measure, save.

The network is told the exact signed distance and its exact gradient (towards or away from the
nearest point of the mesh) at points on, near and far from the surface; far away the gradient only
has to have length 1 (the eikonal term, Gropp et al. 2020). Teaching the gradient is what makes flat
faces flat: a radio wave steers by normals and curvature, which amplify every ripple of the value.
"""

import hashlib
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from manifold3d import Error, Manifold, Mesh64, OpType
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional as F

from rfsg.learn.errors import LearnError as LearnError
from rfsg.learn.soap import Soap
from rfsg.objects.body import Body
from rfsg.objects.contract import Surface
from rfsg.objects.shapes.neural import NeuralShape, compute_lipschitz
from rfsg.objects.shapes.proxy import extract_mesh
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.assets import save_asset
from rfsg.scene.weights import refuse_overwrite

MAX_BYTES = 512 * 2**20
MAX_TRIANGLES = 5_000_000
MARGIN, LEAST_MARGIN = 0.05, 0.03  # bounds beyond the mesh: share of its size, or metres if more
STEPS = 6_000
WIDTH = 64  # of the hidden layers: the paper's
NEAR_BATCH, FAR_BATCH = 512, 256  # smaller batches and more steps learned better per second
NEAR_POOL, FAR_POOL = 100_000, 50_000
CHECKPOINT_EVERY = 200
SHOWN_TOLERANCE = 0.002  # [m] by which the mesh that is only shown may differ from the zero mesh

Progress = Callable[[int, int, str], None]  # (steps done, steps in all, a word on how it goes)


class MeshError(ValueError):
    """A mesh that cannot become an object; says why, and what would help."""


@dataclass(frozen=True)
class Report:
    """How well a shape was learned; lengths in millimetres.

    surface_*: |f| at fresh points of the mesh. zero_*: distance from the learned surface (vertices
    of its extracted mesh) to the given mesh. normal_*: angle between gradient and mesh normal at
    points of the mesh [degrees]. volume_error_percent: of the extracted mesh, signed.
    gradient_norm_error: mean | |grad f| - 1 | within 1.5 % of the size from the surface.
    """

    surface_mean_mm: float
    surface_p95_mm: float
    surface_max_mm: float
    zero_mean_mm: float
    zero_p95_mm: float
    zero_max_mm: float
    normal_median_deg: float
    normal_p95_deg: float
    volume_error_percent: float
    gradient_norm_error: float
    lipschitz: float
    seconds: float
    steps: int
    seed: int


def learn_shape_file(
    mesh_path: str | Path,
    asset_path: str | Path,
    *,
    steps: int = STEPS,
    seed: int = 0,
    scale: float = 1.0,
    up_axis: str | None = None,
    progress: Progress | None = None,
    resume: bool = True,
    surface: Surface | None = None,
    overwrite: bool = False,
    provenance: dict[str, Any] | None = None,
) -> Report:
    """Learn the shape of a mesh file and save it, with a surface, as asset_path (.usda).

    scale: metres per unit of the file. up_axis: "y" or "z"; by default y for glTF, z otherwise.
    surface: how it answers a wave; by default a ``StochasticSurface``. An interrupted training is
    taken up where it stopped when called again. Raises MeshError for a mesh that is refused,
    LearnError for a training that cannot be used, SceneError where the asset cannot be written.
    """
    mesh_path, asset = Path(mesh_path), Path(asset_path).with_suffix(".usda")
    refuse_overwrite([asset, asset.with_suffix(".safetensors")], overwrite)
    mesh, notes = check_watertight(load_mesh(mesh_path, scale=scale, up_axis=up_axis))
    asset.parent.mkdir(parents=True, exist_ok=True)
    checkpoint = asset.with_name(f".{asset.stem}.training.safetensors")
    shape, report = learn_shape(
        mesh, seed=seed, steps=steps, checkpoint=checkpoint, resume=resume, progress=progress
    )
    told = {
        "source": mesh_path.name,
        "source_sha256": hashlib.sha256(mesh_path.read_bytes()).hexdigest(),
        "repairs": notes,
        "report": {k: rounded(v) for k, v in asdict(report).items()},
    }
    if surface is None:
        surface = StochasticSurface()
        told["radio"] = "radio material is a prior, not fitted to measurements"
    save_asset(
        asset,
        Body(shape, surface),
        mesh=extract_mesh(shape, simplify=SHOWN_TOLERANCE),
        provenance=told | (provenance or {}),
        overwrite=overwrite,
    )
    checkpoint.unlink(missing_ok=True)
    return report


def learn_shape(
    mesh: trimesh.Trimesh,
    *,
    seed: int = 0,
    steps: int = STEPS,
    width: int = WIDTH,
    checkpoint: Path | None = None,
    resume: bool = True,
    progress: Progress | None = None,
) -> tuple[NeuralShape, Report]:
    """Learn a watertight mesh [m]: the shape, and how well it was learned.

    width: of the network's hidden layers; what more of it costs and buys stands in docs/tradeoff.md.
    checkpoint: file to write every few hundred steps and, with ``resume``, to continue from; the
    result is that of an uninterrupted run, because each step draws its batch from (seed, step).
    Raises LearnError for a checkpoint of another training, or when the learned surface reaches the
    bounds (too few steps).
    """
    for name, number in (("steps", steps), ("width", width)):
        if number < 1:
            raise LearnError(f"{name}={number}: expected at least 1")
    began = time.monotonic()
    distance = MeshDistance(mesh)
    training = _Training(distance, seed, steps, width)
    if checkpoint is not None and resume and checkpoint.exists():
        training.load(checkpoint)
    for step in range(training.done, steps):
        error = training.step(step)
        if checkpoint is not None and (step + 1) % CHECKPOINT_EVERY == 0 and step + 1 < steps:
            training.save(checkpoint, time.monotonic() - began)
        if progress is not None:
            progress(step + 1, steps, f"surface error {1000 * error:.2f} mm")
    shape = training.shape
    _require_positive_boundary(shape)
    shape.lipschitz = compute_lipschitz(shape, seed=seed)
    seconds = training.seconds_before + time.monotonic() - began
    return shape, measure(shape, distance, seconds=seconds, steps=steps, seed=seed)


def load_mesh(
    path: str | Path, *, scale: float = 1.0, up_axis: str | None = None
) -> trimesh.Trimesh:
    """One mesh in metres, z up, from obj, ply, glb or stl (all parts of the file together).

    scale: metres per unit of the file. up_axis: "y" or "z"; by default y for glTF, z otherwise.
    Raises MeshError for a file that is missing, too large, unreadable or holds no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path}: no such file")
    if path.stat().st_size > MAX_BYTES:
        raise MeshError(f"{path}: larger than {MAX_BYTES // 2**20} MB; simplify it first")
    if not (scale > 0 and math.isfinite(scale)):
        raise MeshError(f"{path}: scale={scale}: expected a positive number of metres per unit")
    up = up_axis or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")
    if up not in ("y", "z"):
        raise MeshError(f'{path}: up_axis={up_axis!r}: expected "y" or "z"')
    try:
        # process=False: what is in the file, and no need of libraries that only textures need.
        mesh = trimesh.load(path, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
    except Exception as error:  # the readers raise whatever the format's own library raises
        raise MeshError(f"{path}: cannot be read as a mesh: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeshError(f"{path}: holds no triangles (a point cloud, or an empty file)")
    if len(mesh.faces) > MAX_TRIANGLES:
        raise MeshError(f"{path}: {len(mesh.faces)} triangles, more than {MAX_TRIANGLES}")
    vertices = np.asarray(mesh.vertices, dtype=np.float64) * scale
    if up == "y":
        vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def check_watertight(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, list[str]]:
    """The mesh as an outward, watertight solid, and what had to be repaired.

    Repairs: coincident vertices are merged, an inside-out mesh is turned, overlapping parts are
    united. Raises MeshError where holes, stray sheets or inconsistent triangles remain.
    """
    notes: list[str] = []
    if not np.isfinite(mesh.vertices).all():
        raise MeshError("mesh: some vertices are not finite numbers")
    solid = _manifold(mesh)
    if solid is None:
        before, mesh = len(mesh.vertices), mesh.copy()
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces(height=0.0))
        mesh.update_faces(mesh.unique_faces())
        mesh.remove_unreferenced_vertices()
        notes.append(f"merged {before - len(mesh.vertices)} coincident vertices")
        solid = _manifold(mesh)
    if solid is None:
        raise MeshError(f"mesh is not a watertight solid: {_why_open(mesh)}")
    if solid.volume() < 0:
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
        notes.append("turned inside out")
        solid = _manifold(mesh)
    if solid is None or not solid.volume() > 0:
        raise MeshError("mesh encloses no volume: a flat sheet, or two that cancel")
    parts = solid.decompose()
    if len(parts) > 1 and all(part.volume() > 0 for part in parts):
        united = Manifold.batch_boolean(parts, OpType.Add)
        if abs(united.volume() - solid.volume()) > 1e-9 * solid.volume():
            notes.append(f"united {len(parts)} overlapping parts")
            mesh = _from_manifold(united)
    return mesh, notes


class MeshDistance:
    """Exact signed distance to a watertight mesh, for many points at once.

    Small meshes are searched whole. Larger ones are cut into small triangles whose centres lie in
    a tree; more candidates are looked at until no other triangle can be nearer, except far away,
    where the error that is left is below reach^2 / (2 x distance), a fraction of a millimetre.
    """

    WHOLE = 300  # triangles up to which looking at all is faster
    CUTS = 50  # small triangles along the longest side
    CANDIDATES = (8, 32, 128)
    CHUNK = 400_000  # point-triangle pairs at a time

    def __init__(self, mesh: trimesh.Trimesh):
        self.mesh = mesh
        self.size = float(mesh.extents.max())
        vertices, faces, parent = mesh.vertices, mesh.faces, np.arange(len(mesh.faces))
        self.tree: KDTree | None = None
        if len(faces) > self.WHOLE:
            cut = trimesh.remesh.subdivide_to_size(
                vertices, faces, self.size / self.CUTS, max_iter=32, return_index=True
            )
            vertices, faces, parent = cut[0], cut[1], cut[-1]
        corners = torch.from_numpy(np.ascontiguousarray(vertices[faces], dtype=np.float64))
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        proper = torch.linalg.cross(first, second).norm(dim=-1) > 0
        corners, parent = corners[proper], parent[proper.numpy()]
        self.corner = corners[:, 0]
        self.edges = corners[:, 1:] - corners[:, :1]
        self.normal = torch.from_numpy(np.array(mesh.face_normals)[parent])
        if len(mesh.faces) > self.WHOLE:
            centres = corners.mean(1)
            self.reach = float((corners - centres[:, None]).norm(dim=-1).max())
            self.tree = KDTree(centres.numpy())

    def __call__(
        self, point: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Signed distance [m], negative inside, and its unit gradient, float64."""
        nearest, normal = self.nearest(point)
        away = point - nearest
        length = away.norm(dim=-1)
        # Above a face the face's own normal decides; near edges and corners a ray does.
        upright = (away * normal).sum(-1) / length.clamp(min=torch.finfo(point.dtype).tiny)
        inside = torch.from_numpy(self.mesh.contains(point.numpy()))
        inside = torch.where(upright.abs() > 0.99, upright < 0, inside)
        sign = 1.0 - 2.0 * inside.to(point.dtype)
        # Closer than 1e-4 of the size, rounding and float32 rays make the direction uncertain.
        close = length < 1e-4 * self.size
        outward = away / torch.where(close, torch.ones_like(length), length)[:, None]
        return length * sign, torch.where(close[:, None], normal, outward * sign[:, None])

    def nearest(
        self, point: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Nearest point of the mesh and the outward normal of its triangle."""
        rows = max(1, self.CHUNK // (len(self.corner) if self.tree is None else 32))
        pieces = [self._nearest(piece) for piece in point.double().split(rows)]
        spot, face = (torch.cat(column) for column in zip(*pieces, strict=True))
        return spot, self.normal[face]

    def _nearest(self, point: Tensor) -> tuple[Tensor, Tensor]:
        if self.tree is None:
            return self._best(point, torch.arange(len(self.corner)).expand(len(point), -1))
        spot, face = torch.empty_like(point), torch.empty(len(point), dtype=torch.int64)
        open_ = torch.arange(len(point))
        for count in self.CANDIDATES:
            count = min(count, len(self.corner))
            far, index = self.tree.query(point[open_].numpy(), count)
            candidates = torch.from_numpy(index).reshape(len(open_), count)
            spot[open_], face[open_] = self._best(point[open_], candidates)
            length = (point[open_] - spot[open_]).norm(dim=-1)
            bound = torch.from_numpy(far).reshape(len(open_), count)[:, -1] - self.reach
            open_ = open_[(bound < length) & (length < 3 * self.reach)]
            if len(open_) == 0:
                break
        return spot, face

    def _best(self, point: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest spot among the triangles ``which`` [n, k], and its triangle."""
        corner, edges = self.corner[which], self.edges[which]
        weights = _closest_weights(point[:, None] - corner, edges)
        spots = corner + (weights[..., None] * edges).sum(-2)
        order = ((spots - point[:, None]) ** 2).sum(-1).argmin(-1, keepdim=True)
        spot = spots.gather(1, order[..., None].expand(-1, -1, 3)).squeeze(1)
        return spot, which.gather(1, order).squeeze(1)


def measure(
    shape: NeuralShape, distance: MeshDistance, *, seconds: float, steps: int, seed: int
) -> Report:
    """Compare a learned shape with its mesh, at points that the training has not seen."""
    mesh = distance.mesh
    with torch.no_grad():
        point, normal = _surface_points(mesh, 30_000, seed + 1)
        value, gradient = shape.value_and_gradient(point)
        error = 1000 * value.abs()
        cosine = F.cosine_similarity(gradient, normal, dim=-1).clamp(-1, 1)
        angle = torch.rad2deg(torch.acos(cosine))
        generator = torch.Generator().manual_seed(seed + 1)
        offset = 0.015 * distance.size * (2 * torch.rand(len(point), 1, generator=generator) - 1)
        band = (point + offset * normal).clamp(*shape.bounds())
        slope = shape.value_and_gradient(band)[1].norm(dim=-1)
    vertices, faces, _ = extract_mesh(shape)
    spot, _ = distance.nearest(torch.from_numpy(vertices))
    zero = 1000 * (torch.from_numpy(vertices) - spot).norm(dim=-1)
    volume = trimesh.Trimesh(vertices, faces, process=False).volume
    return Report(
        surface_mean_mm=float(error.mean()),
        surface_p95_mm=float(error.quantile(0.95)),
        surface_max_mm=float(error.max()),
        zero_mean_mm=float(zero.mean()),
        zero_p95_mm=float(zero.quantile(0.95)),
        zero_max_mm=float(zero.max()),
        normal_median_deg=float(angle.median()),
        normal_p95_deg=float(angle.quantile(0.95)),
        volume_error_percent=float(100 * (volume / mesh.volume - 1)),
        gradient_norm_error=float((slope - 1).abs().mean()),
        lipschitz=shape.lipschitz,
        seconds=seconds,
        steps=steps,
        seed=seed,
    )


class _Training:
    """What lasts from step to step: network, optimiser, and the pools that batches come from."""

    RATE, WARM_UP, LAST_RATE = 3e-3, 50, 0.01
    GRADIENT, EIKONAL, FAR = 0.1, 0.01, 0.2  # weights of the terms; that of the near values is 1

    def __init__(self, distance: MeshDistance, seed: int, steps: int, width: int = WIDTH):
        self.seed, self.steps, self.done, self.seconds_before = seed, steps, 0, 0.0
        self.size = distance.size
        mesh = distance.mesh
        margin = max(MARGIN * self.size, LEAST_MARGIN)
        bounds = torch.from_numpy(np.array([mesh.bounds[0] - margin, mesh.bounds[1] + margin]))
        self.shape = NeuralShape(bounds, width=width, lipschitz=1.0, seed=seed)
        learned = [*self.shape.hidden.parameters(), *self.shape.to_value.parameters()]
        self.optimiser = Soap(learned)
        self.near, self.far = _pools(distance, bounds, seed)
        self.job = {"mesh": _fingerprint(mesh), "seed": seed, "steps": steps, "width": width}

    def step(self, step: int) -> float:
        """One step; returns the mean |f| error of its near points [m]."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + step)
        near = self.near[torch.randint(len(self.near), (NEAR_BATCH,), generator=generator)]
        far = self.far[torch.randint(len(self.far), (FAR_BATCH,), generator=generator)]
        point, target, toward = torch.cat([near, far]).split([3, 1, 3], dim=-1)
        value, gradient = self.shape.value_and_gradient(point)
        error = value - target.squeeze(-1)
        # Errors count in units of 0.15 % of the size at the surface and of a tenth of the distance
        # far away; beyond half a unit linearly, so that edges, which are always wrong, do not rule.
        unit = 0.0015 * self.size + 0.1 * target.squeeze(-1).abs()
        fit = F.smooth_l1_loss(error / unit, torch.zeros_like(error), reduction="none", beta=0.5)
        turn = (((gradient - toward)[:NEAR_BATCH] ** 2).sum(-1) + _ROUND**2).sqrt()
        slope = ((gradient[NEAR_BATCH:] ** 2).sum(-1) + _ROUND**2).sqrt()
        loss = fit[:NEAR_BATCH].mean() + self.FAR * fit[NEAR_BATCH:].mean()
        loss = loss + self.GRADIENT * turn.mean() + self.EIKONAL * (slope - 1).abs().mean()
        loss.backward()
        self.optimiser.step(self._rate(step))
        self.done = step + 1
        return float(error.detach()[:NEAR_BATCH].abs().mean())

    def _rate(self, step: int) -> float:
        cosine = 0.5 * (1 + math.cos(math.pi * step / self.steps))
        falling = self.LAST_RATE + (1 - self.LAST_RATE) * cosine
        return self.RATE * falling * min(1.0, (step + 1) / self.WARM_UP)

    def save(self, path: Path, seconds: float) -> None:
        """Write beside and rename: there is always one whole checkpoint."""
        tensors = {f"shape.{k}": v for k, v in self.shape.state_dict().items()}
        tensors |= {f"optimiser.{k}": v for k, v in self.optimiser.tensors().items()}
        state = self.job | {"done": self.done, "seconds": self.seconds_before + seconds}
        beside = path.with_name(f"{path.name}.{os.getpid()}.part")
        try:
            save_file(tensors, beside, metadata={"training": json.dumps(state)})
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)

    def load(self, path: Path) -> None:
        """Continue from a checkpoint. Raises LearnError for one that is broken or another's."""
        try:
            with safe_open(path, framework="pt") as file:
                state = json.loads((file.metadata() or {}).get("training", "null"))
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, OSError, json.JSONDecodeError) as error:
            raise LearnError(f"{path}: not a checkpoint that can be read ({error})") from error
        if not isinstance(state, dict) or any(state.get(k) != v for k, v in self.job.items()):
            raise LearnError(
                f"{path}: checkpoint of another training (mesh, seed, steps or width differ): "
                "delete it, or begin anew with resume=False"
            )
        self.shape.load_state_dict(_under("shape.", tensors))
        self.optimiser.load(_under("optimiser.", tensors))
        self.done, self.seconds_before = int(state["done"]), float(state["seconds"])


_ROUND = 1e-3  # gradient errors below this count quadratically: the norm has no derivative at 0


def _pools(distance: MeshDistance, bounds: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Rows (point, distance, gradient): near half on the surface and half in bands around it."""
    generator = torch.Generator().manual_seed(seed)
    surface, normal = _surface_points(distance.mesh, NEAR_POOL, seed)
    width = torch.where(torch.rand(NEAR_POOL, 1, generator=generator) < 0.5, 0.003, 0.015)
    noise = torch.randn(NEAR_POOL, 3, generator=generator, dtype=torch.float64)
    band = (surface + noise * width * distance.size).clamp(*bounds)
    share = torch.rand(FAR_POOL, 3, generator=generator, dtype=torch.float64)
    volume = bounds[0] + (bounds[1] - bounds[0]) * share
    on = torch.cat([surface, torch.zeros(NEAR_POOL, 1), normal], -1)
    off, far = (_rows(distance, point) for point in (band, volume))
    return torch.cat([on, off]).float(), far.float()


def _rows(distance: MeshDistance, point: Tensor) -> Tensor:
    value, gradient = distance(point)
    return torch.cat([point, value[:, None], gradient], -1)


def _surface_points(mesh: trimesh.Trimesh, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Points spread evenly over the area, and the normals of their triangles."""
    drawn = trimesh.sample.sample_surface(mesh, count, seed=seed)
    point, face = drawn[0], drawn[1]
    return torch.from_numpy(np.array(point)), torch.from_numpy(np.array(mesh.face_normals)[face])


def _closest_weights(away: Tensor, edges: Tensor) -> Tensor:
    """Weights (v, w) of the spot corner + v e1 + w e2 of a triangle nearest to corner + away.

    Minimises |away - v e1 - w e2|^2 in the plane, else along the best of the three sides.
    """
    e1, e2 = edges.unbind(-2)
    along1, along2 = (away * e1).sum(-1), (away * e2).sum(-1)
    a, b, c = (e1 * e1).sum(-1), (e1 * e2).sum(-1), (e2 * e2).sum(-1)
    area = a * c - b * b
    v, w = (c * along1 - b * along2) / area, (a * along2 - b * along1) / area
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    on1 = (along1 / a).clamp(0, 1)
    on2 = (along2 / c).clamp(0, 1)
    on3 = ((along2 - along1 + a - b) / (a + c - 2 * b)).clamp(0, 1)
    zero = torch.zeros_like(v)
    sides = torch.stack(
        [torch.stack([on1, zero]), torch.stack([zero, on2]), torch.stack([1 - on3, on3])]
    )
    x, y = sides[:, 0], sides[:, 1]
    cost = x * x * a + 2 * x * y * b + y * y * c - 2 * (x * along1 + y * along2)
    best = cost.argmin(0)[None, None].expand(1, 2, *v.shape)
    side = sides.gather(0, best)[0]
    return torch.where(inside, torch.stack([v, w]), side).movedim(0, -1)


def _require_positive_boundary(shape: NeuralShape, per_side: int = 48) -> None:
    """The surface must close within the bounds, where alone the network means anything."""
    low, high = shape.bounds().float()
    grid = torch.cartesian_prod(*[torch.linspace(0, 1, per_side)] * 2)
    for axis in range(3):
        for end in (0.0, 1.0):
            face = torch.full((len(grid), 3), end)
            face[:, [i for i in range(3) if i != axis]] = grid
            with torch.no_grad():
                least = float(shape.sdf(low + face * (high - low)).min())
            if not least > 0:
                raise LearnError(
                    f"the learned surface reaches the {'low' if end == 0 else 'high'} "
                    f"{'xyz'[axis]} side of its bounds (f = {least:.3g} m there): train longer"
                )


def _manifold(mesh: trimesh.Trimesh) -> Manifold | None:
    raw = Mesh64(
        np.array(mesh.vertices, dtype=np.float64, order="C"),
        np.array(mesh.faces, dtype=np.uint64, order="C"),
    )
    solid = Manifold(raw)
    return solid if solid.status() == Error.NoError and not solid.is_empty() else None


def _from_manifold(solid: Manifold) -> trimesh.Trimesh:
    raw = solid.to_mesh64()
    return trimesh.Trimesh(
        raw.vert_properties[:, :3].copy(), raw.tri_verts.astype(np.int64), process=False
    )


def _why_open(mesh: trimesh.Trimesh) -> str:
    """Counts the edges that no solid has."""
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, inverse, uses = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    forward = np.bincount(inverse.ravel(), weights=(sides[:, 0] < sides[:, 1]))
    reasons = [
        (int((uses == 1).sum()), "open edges (holes or sheets; close them)"),
        (int((uses > 2).sum()), "edges shared by more than two triangles"),
        (int(((uses == 2) & (forward != 1)).sum()), "edges whose two triangles face opposite ways"),
    ]
    told = [f"{count} {what}" for count, what in reasons if count]
    return "; ".join(told) or "its triangles do not close around a volume"


def _fingerprint(mesh: trimesh.Trimesh) -> str:
    parts = (np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, dtype=np.int64))
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def rounded(value: float | int) -> float | int:
    """A number of a report to four digits, as provenance holds it."""
    return float(f"{value:.4g}") if isinstance(value, float) else value
