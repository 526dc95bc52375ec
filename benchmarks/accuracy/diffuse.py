"""Power scattered in all against closed forms and quadrature; the area that tiles stand for."""

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from accuracy.table import Row, Table, percents
from rfsg.objects.body import Body
from rfsg.objects.contract import Shape
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import Cylinder, HalfSpace, Sphere
from rfsg.objects.shapes.proxy import extract_mesh
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.plan import Quality
from rfsg.tracer.tiles import curved_tiles
from tests.tracer.shapes import Field, ball
from tests.truths import rough

ASSETS = Path(__file__).resolve().parents[2] / "assets"
COUNTS = (8, 16, 32)
LAMBERT = Conductor(Scattering(1.0))
HEIGHTS = ((1.0, 1.5), (1.0, 10.0), (0.1, 100.0))  # [m] of radios one above the other
PAIRS = (  # [m] radios over a dielectric ground: at right angles, slanting, shallow, steep
    ((0.0, 0.0, 1.0), (0.0, 1e-9, 1.5)),
    ((0.0, 0.0, 1.0), (4.0, 0.0, 2.0)),
    ((0.0, 0.0, 1.5), (10.0, 0.0, 1.5)),
    ((0.0, 0.0, 2.0), (1.0, 0.5, 1.0)),
)
PHASE_ANGLES = (0.01, 0.5, 1.2, 2.0, 2.8)  # [rad], to 160 degrees
LOBES = {  # with the bounds at each count, percent
    "Lambertian": (rough.LOBES["lambertian"], (2.5, 0.6, 0.2)),
    "directive 4": (rough.LOBES["directive"], (1.2, 0.5, 0.1)),
    "directive 30": (Scattering(1.0, "directive", alpha_r=30), (0.25, 0.05, 0.02)),
    "backscattering": (rough.LOBES["backscattering"], (1.0, 0.3, 0.1)),
}


def scattered() -> Table:
    rows = [_row("endless conducting ground, Lambertian", _plane, (0.3, 0.02, 0.002))]
    for name, (lobe, bounds) in LOBES.items():
        truths = [rough.endless_sum(lobe, *pair) for pair in PAIRS]
        case = lambda q, lobe=lobe, truths=truths: _ground(lobe, truths, q)  # noqa: E731
        rows.append(_row(f"dielectric ground, {name}", case, bounds))
    learned = Field(ball(0.7), [0.75] * 3)
    rows += [
        _row("sphere, Lambertian", lambda q: _sphere(Sphere(0.7), q), (0.3, 0.05, 0.2)),
        _row("sphere met as a learned shape", lambda q: _sphere(learned, q), (0.5, 0.1, 0.2)),
        _row("disc (cap of a cylinder), Lambertian", _disc, (0.6, 0.2, 0.2)),
    ]
    return Table(
        "Diffuse reflection: power scattered in all",
        "The sum of |gain|^2 of all tiles, worst link. Conducting ground, sphere and disc against closed "
        "forms: 2 / (h1 + h2)^2 for radios one above the other, Lambert's phase law (1760) at phase "
        "angles to 160 degrees, and (h^2 / 2) (1 / h^4 - 1 / (a^2 + h^2)^2) on the disc's axis. "
        "Dielectric ground (eps_r 5.24, 0.05 S/m) against plain quadrature of the model's own integral, "
        "with R, lobe and distances at every point (`tests/truths/rough.py`), for four pairs of radios; "
        "the backscattering lobe has alphaR 6, alphaI 3 and Lambda 0.6. What is left over a dielectric is "
        "mostly R, which a tile has at its centre. The sphere is worst at 160 degrees, a thin crescent, "
        "where the error comes and goes with the lattice.",
        tuple(f"`diffuse={c}`" for c in COUNTS),
        tuple(rows),
    )


def _row(case: str, error: Callable[[Quality], float], bounds: tuple[float, ...]) -> Row:
    errors = [error(replace(rough.QUALITY, diffuse=count)) for count in COUNTS]
    return Row(case, percents(errors, bounds))


def _plane(quality: Quality) -> float:
    body = Body(HalfSpace(), LAMBERT)
    return max(
        _apart(_link(body, (0, 0, low), (0, 1e-9, high), quality), rough.lambert_plane(low, high))
        for low, high in HEIGHTS
    )


def _ground(lobe: Scattering, truths: list[float], quality: Quality) -> float:
    body = rough.ground(lobe)
    return max(
        _apart(_link(body, *pair, quality), truth)
        for pair, truth in zip(PAIRS, truths, strict=True)
    )


def _sphere(shape: Shape, quality: Quality) -> float:
    found = rough.at_phase_angles(Body(shape, LAMBERT), PHASE_ANGLES, quality).tolist()
    truths = [rough.lambert_sphere(0.7, b) for b in PHASE_ANGLES]
    return max(map(_apart, found, truths))


def _disc(quality: Quality) -> float:
    h, a, half = 1.3, 0.9, 0.2
    ends = (0, 0, half + h), (0, 1e-9, half + h)
    return _apart(_link(Body(Cylinder(a, half), LAMBERT), *ends, quality), rough.lambert_disc(h, a))


def _link(body: Body, tx, rx, quality: Quality) -> float:
    return float(rough.diffuse(rough.of_one(body, tx, [rx], quality)))


def _apart(found: float, truth: float) -> float:
    return abs(found / truth - 1.0)


# area

AREA_BOUNDS = {  # percent at 8 and 16: beside the extracted mesh, beside the mesh it was trained on
    "chair": ((2, 7), (5, 2)),
    "person": ((2, 2), (2, 2)),
    "cabinet": ((4, 2), (4, 2)),
    "desk": ((4, 5), (2, 2)),
}


def areas() -> Table:
    rows = []
    for name, bounds in AREA_BOUNDS.items():
        shape = load_asset(ASSETS / "objects" / name / f"{name}.usda").body.shape
        world = World(Scene((Node("/it", Body(shape, LAMBERT), Pose.identity()),)))
        with torch.no_grad():
            found = [float(curved_tiles(world, 0, count).area.sum()) for count in COUNTS[:2]]
        truths = _extracted_area(shape), float(getattr(_drawn(), name)().area)
        for case, truth, bound in zip(("extracted", "drawn"), truths, bounds, strict=True):
            rows.append(Row(f"{name}, {case}", percents([a / truth - 1.0 for a in found], bound)))
    return Table(
        "Diffuse reflection: area of trained objects",
        "The area of all tiles, over that of the mesh extracted from the trained shape "
        "(`rfsg/objects/shapes/proxy.py`, grid as by default; it cuts edges off, and so is too small), "
        "and over that of the mesh that the shape was trained on (`assets/sources/make_meshes.py`). One "
        "percent of area is 0.04 dB of power.",
        tuple(f"`diffuse={c}`" for c in COUNTS[:2]),
        tuple(rows),
    )


def _extracted_area(shape: Shape) -> float:
    """[m2]"""
    vertices, triangles, _ = extract_mesh(shape)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _drawn():
    """assets/sources/make_meshes.py, a script, as a module."""
    path = ASSETS / "sources" / "make_meshes.py"
    spec = importlib.util.spec_from_file_location("make_meshes", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TABLES = (scattered, areas)
