"""Examples of every kind that the catalogue names, and random ways for a wave to meet them.

A new kind is one entry here. The laws in this folder are tried on every example;
``tests/objects/test_catalogue.py`` fails for a kind that has none.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from rfsg.objects.contract import Contact, Crossing, Shape, Surface
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.shapes.mesh import Mesh, extruded
from rfsg.objects.shapes.neural import NeuralShape, compute_lipschitz
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.world import unit
from rfsg.tracer.march import MarchOptions, march
from tests import shipped

F64 = torch.float64
Met = TypeVar("Met", Contact, Crossing)
FREQUENCY = torch.tensor([1.1e9, 2.4e9, 28e9, 90e9], dtype=F64)  # where ITU knows concrete
UNBOUNDED = (1.0, 1.0, 0.2)  # [m] half the box in which a shape without bounds is looked at
FEW, MANY = (
    2_000,
    10_000,
)  # contacts and crossings that a law is tried on: at every turn, and at length
MARCH = MarchOptions(step_floor=1e-2, dtype=F64, polish=40)

LAMBERTIAN = {"coefficient": 0.4, "cross_share": 0.1}
DIRECTIVE = {"coefficient": 0.7, "lobe": "directive", "alpha_r": 4, "cross_share": 0.3}
TWO_LOBES = {
    "coefficient": 0.6,
    "lobe": "backscattering",
    "alpha_r": 8,
    "alpha_i": 3,
    "forward_share": 0.7,
}


def angle_iron() -> Mesh:
    """An L of two arms along z: eight faces, one of its edges inward."""
    outline = [(-0.3, -0.3), (0.4, -0.3), (0.4, -0.1), (0.0, -0.1), (0.0, 0.35), (-0.3, 0.35)]
    return extruded(outline, 0.25)


def prism() -> Mesh:
    """A slanted one, of five faces, convex; as its triangles lie in space, no face is along an axis."""
    made = extruded([(-0.4, -0.3), (0.5, -0.2), (0.0, 0.4)], 0.3)
    tilt = torch.linalg.qr(torch.randn(3, 3, generator=_generator(6)).to(F64))[0]
    return Mesh(made.vertices @ tilt, made.triangles)


@cache
def lumpy() -> NeuralShape:
    """A small network about a ball of 0.3 m, bent out of shape."""
    shape = NeuralShape([[-0.6] * 3, [0.6] * 3], width=16, depth=4, skip=2)
    _shaken(shape, 0.001)
    shape.lipschitz = compute_lipschitz(shape)
    return shape


def lively(**arguments) -> StochasticSurface:
    """A stochastic surface whose fields vary from point to point, as after a fit."""
    surface = StochasticSurface(samples=2, **arguments)
    _shaken(surface, 0.0)
    with torch.no_grad():
        generator = torch.Generator().manual_seed(1)
        surface.head_weight.normal_(0.0, 0.1, generator=generator)
    return surface


def _shaken(module: torch.nn.Module, size: float) -> None:
    """The same weights in every process, whoever asked torch for numbers before."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for layer in module.modules():
            if isinstance(layer, torch.nn.Linear):
                noise = torch.randn(layer.weight.shape, generator=generator)
                spread = size or (2.0 / layer.in_features) ** 0.5
                layer.weight.copy_(spread * noise + (layer.weight if size else 0.0))


SHAPES: dict[str, dict[str, Callable[[], Shape]]] = {
    "box": {"": lambda: Box([0.2, 0.3, 0.4]), "sheet": lambda: Box([0.002, 0.7, 0.5])},
    "sphere": {"": lambda: Sphere(0.3)},
    "cylinder": {"": lambda: Cylinder(0.35, 0.15)},
    "capsule": {"": lambda: Capsule(0.2, 0.3)},
    "halfspace": {"": HalfSpace},
    "mesh": {"": angle_iron, "prism": prism},
    "neural": {"": lumpy, "cabinet": partial(shipped.shape, "cabinet")},
}
SURFACES: dict[str, dict[str, Callable[[], Surface]]] = {
    "conductor": {"": Conductor, "rough": lambda: Conductor(TWO_LOBES)},
    "halfspace": {
        "": lambda: DielectricHalfSpace("concrete"),
        "rough": lambda: DielectricHalfSpace(eps_r=4.0, sigma=0.5, scattering=DIRECTIVE),
    },
    "slab": {
        "": lambda: Slab(0.1, "concrete"),
        "rough": lambda: Slab(0.006, eps_r=6.3, sigma=0.02, scattering=LAMBERTIAN),
    },
    "solid": {
        "": lambda: Solid("wood"),
        "lossy": lambda: Solid(eps_r=3.0, sigma=2.0),
        "rough": lambda: Solid(eps_r=2.5, sigma=0.01, scattering=LAMBERTIAN),
    },
    "stochastic": {
        "": lambda: lively(m=0.5, bulk=0.2),
        "split": lambda: lively(m=0.3, alpha=0.4, phi=-1.2).with_numerics(2, "telescoped", True),
        "literal": lambda: lively(law="gaussian", interface="paper", phi=0.6),
    },
}


def names(table: dict[str, dict[str, Callable]]) -> list[str]:
    """kind, or kind-variant, of every example."""
    return [f"{kind}-{v}" if v else kind for kind, some in table.items() for v in some]


def made(table: dict[str, dict[str, Callable]], name: str) -> Any:
    """The example of a name."""
    kind, _, variant = name.partition("-")
    return table[kind][variant]()


# ways to meet a shape


@cache
def chords(name: str, count: int = FEW) -> tuple[Shape, Crossing]:
    """Stretches of random lines inside a shape; every tenth begins inside, every tenth ends inside."""
    shape = made(SHAPES, name)
    start, end = _stretches(name, count)
    normal = [normals(shape, x) for x in (start, end)]
    inner = torch.rand(count, 1, generator=_generator(2), dtype=F64)
    tenth = torch.arange(count)[:, None] % 10
    points = [start, end]
    for k, mine in enumerate((tenth == 3, tenth == 7)):
        points[k] = torch.where(mine, start + inner * (end - start), points[k])
        normal[k] = torch.where(mine, 0.0, normal[k])
    return shape, Crossing(*points, *normal)


@cache
def contacts(name: str, count: int = FEW) -> tuple[Shape, Contact]:
    """Mirrors all over a shape, at every angle; some within a hair of grazing, some head on."""
    shape = made(SHAPES, name)
    point = torch.cat(_stretches(name, count))
    normal = normals(shape, point)
    on = torch.nonzero(normal.any(-1)).squeeze(-1)
    on = on[torch.arange(count) % len(on)]
    point, normal = point[on], normal[on]
    cosine = torch.rand(count, 1, generator=_generator(3), dtype=F64)
    tenth = torch.arange(count)[:, None] % 10
    cosine = torch.where(tenth == 0, 1.0, torch.where(tenth == 1, 1e-6 * cosine, cosine))
    across = torch.randn(count, 3, generator=_generator(4), dtype=F64)
    across = unit(across - (across * normal).sum(-1, keepdim=True) * normal)
    sine = ((1.0 - cosine) * (1.0 + cosine)).sqrt()
    down, up = sine * across - cosine * normal, sine * across + cosine * normal
    return shape, Contact(point, down, up, normal)


def reversed_crossing(c: Crossing) -> Crossing:
    return Crossing(c.end, c.start, c.normal_end, c.normal_start)


def reversed_contact(c: Contact) -> Contact:
    return Contact(c.point, -c.outgoing, -c.incoming, c.normal)


def some(record: Met, i: Tensor | slice) -> Met:
    """Some rows of a record."""
    return type(record)(*(x[i] for x in vars(record).values()))


def lines(shape: Shape, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Random lines through the box about a shape: origins outside it, and unit directions."""
    low, high = box(shape)
    toward = low + (high - low) * torch.rand(count, 3, generator=_generator(seed), dtype=F64)
    direction = unit(torch.randn(count, 3, generator=_generator(seed + 1), dtype=F64))
    return toward - 2.0 * (high - low).norm() * direction, direction


def box(shape: Shape) -> Tensor:
    """Lowest and highest corner of where a shape is looked at [m]."""
    bounds = shape.bounds().detach().to(F64)
    half = torch.tensor(UNBOUNDED, dtype=F64)
    return bounds if bool(torch.isfinite(bounds).all()) else torch.stack([-half, half])


@cache
@torch.no_grad()
def _stretches(name: str, count: int) -> tuple[Tensor, Tensor]:
    """Ends of ``count`` stretches of random lines inside a shape."""
    shape = made(SHAPES, name)
    starts, ends, seed = [], [], 10
    while sum(map(len, starts)) < count:
        origin, direction = lines(shape, count, seed)
        i, start, length = through_box(shape, origin, direction)
        direction = direction[i]
        row, enter, leave = inside(shape, start, direction, length)
        starts.append(start[row] + enter[:, None] * direction[row])
        ends.append(start[row] + leave[:, None] * direction[row])
        seed += 2
    return torch.cat(starts)[:count], torch.cat(ends)[:count]


def through_box(shape: Shape, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Which lines pass the box about a shape, where each enters it, and how long it stays."""
    low, high = box(shape)
    around = Box(0.5 * (high - low))
    enter, leave = around.interval(origin - 0.5 * (low + high), direction)
    i = torch.nonzero(enter < leave).squeeze(-1)
    return i, origin[i] + enter[i, None] * direction[i], (leave - enter)[i]


def inside(
    shape: Shape, start: Tensor, direction: Tensor, length: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(row, enter, leave) where lines are inside a shape: in closed form, or marched."""
    if not shape.convex:
        return march(shape, start, direction, length, MARCH)
    enter, leave = shape.interval(start, direction)
    enter, leave = enter.clamp(min=0.0), torch.minimum(leave, length)
    row = torch.nonzero(enter < leave).squeeze(-1)
    return row, enter[row], leave[row]


@torch.no_grad()
def normals(shape: Shape, point: Tensor) -> Tensor:
    """Outward unit normals on the boundary, zero off it."""
    own = getattr(shape, "normal_at", None)
    normal = own(point) if own else unit(shape.value_and_gradient(point)[1])
    return torch.where(shape.sdf(point)[:, None].abs() < 1e-6, normal, 0.0)


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
