"""What a network's width and precision cost and buy, and what it is against the plain mesh.

    python benchmarks/widths.py [--write-docs] [--steps 2000] [--fresh]

Trains the cabinet from its own mesh at several widths, stands each amid a ring of receivers, and measures
shape, speed and channel. Networks are kept in out/widths by what they were trained of,
figures by that and the weights' hash; --fresh measures anew, with the networks that are there.
"""

import argparse
import copy
import hashlib
import json
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import trimesh
from machine import ROOT, measured_on, write_section

from rfsg.learn.geometry import learn_shape
from rfsg.objects.body import Body
from rfsg.objects.contract import Shape
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.assets import load_asset, save_asset
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer import launch
from rfsg.tracer.compared import see
from rfsg.tracer.ladder import difference_db, responses
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import Result, simulate

sys.path.insert(0, str(ROOT / "assets" / "sources"))
from make_meshes import MAKERS  # noqa: E402

KEPT = ROOT / "out" / "widths"
PAGE = ROOT / "docs" / "tradeoff.md"
HEADING = "## Widths and precision"
CABINET = "/World/Cabinet"
WIDTHS = (16, 32, 64, 128)
STEPS = 2_000
SHIPPED, PLAIN = "shipped", "mesh"
RECEIVERS, AWAY = 24, 3.0  # on a ring about the cabinet, of this radius [m]
TRANSMITTER = (-2.5, 1.8, 1.3)  # [m]: off every axis of the cabinet
SETTING = "standard"
POINTS, TURNS = 32_768, 3
WITHIN = 0.9  # share of links, and of the carriers about the asked one
MATTERS = 0.1  # [dB] a link that the cabinet moves by less tells nothing of it
Figures = dict[str, Any]


@dataclass(frozen=True)
class Heard:
    """A simulation, and the processor time that it took [s]."""

    result: Result
    seconds: float


def source() -> trimesh.Trimesh:
    """The mesh that the cabinet is learned from."""
    return MAKERS["cabinet"]()


def trained(width: int, steps: int) -> NeuralShape:
    """The cabinet's network of a width: kept, or learned now."""
    mesh = source()
    what = [mesh.vertices.tolist(), mesh.faces.tolist(), width, steps]
    key = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:12]
    file = KEPT / f"cabinet-{width}-{key}.usda"
    if not file.exists():
        KEPT.mkdir(parents=True, exist_ok=True)
        shape, _ = learn_shape(mesh, steps=steps, width=width, progress=told(f"width {width}"))
        save_asset(file, Body(shape, Conductor()), overwrite=True)
    return frozen(load_asset(file).body.shape)


def told(name: str) -> Callable[[int, int, str], None]:
    """Progress of a training on stderr, ten times in all."""

    def tell(done: int, total: int, word: str) -> None:
        if done % max(total // 10, 1) == 0:
            print(f"  {name}: {done} of {total} steps, {word}", file=sys.stderr, flush=True)

    return tell


def frozen(shape: Any) -> Any:
    return shape.requires_grad_(False)


def shipped() -> NeuralShape:
    return frozen(load_asset(ROOT / "assets" / "objects" / "cabinet" / "cabinet.usda").body.shape)


def stored(shape: NeuralShape, dtype: torch.dtype) -> NeuralShape:
    """The same network with weights rounded to what a smaller type holds."""
    rounded = copy.deepcopy(shape)
    for parameter in rounded.parameters():
        parameter.copy_(parameter.to(dtype).to(parameter.dtype))
    return rounded


# the shape itself


def off_mesh(shape: Shape) -> Figures:
    """|f| [mm] and the angle of its gradient [degrees] at points of the source mesh, of 50 and 99 %."""
    mesh = source()
    point, face = trimesh.sample.sample_surface(mesh, POINTS, seed=1)[:2]
    normal = torch.from_numpy(mesh.face_normals[face].copy())
    value, gradient = shape.value_and_gradient(torch.from_numpy(point.copy()))
    cosine = torch.nn.functional.cosine_similarity(gradient, normal, dim=-1).clamp(-1, 1)
    angle = torch.rad2deg(torch.acos(cosine))
    return {"off_mm": quantiles(1e3 * value.abs()), "turned_deg": quantiles(angle)}


def quantiles(value: torch.Tensor) -> list[float]:
    return [float(value.double().quantile(q)) for q in (0.5, 0.99)]


def rounding_mm(shape: Shape) -> list[float]:
    """How far f of float32 is from f of float64 [mm], of 50 and 99 % of the points near the surface."""
    point = near(shape)
    return quantiles(1e3 * (shape.sdf(point.float()).double() - shape.sdf(point)).abs())


def near(shape: Shape) -> torch.Tensor:
    """Points within 5 cm of the source mesh."""
    point = torch.from_numpy(trimesh.sample.sample_surface(source(), POINTS, seed=2)[0].copy())
    generator = torch.Generator().manual_seed(2)
    moved = point + 0.1 * (torch.rand(point.shape, generator=generator).double() - 0.5)
    return moved.clamp(*shape.bounds())


def speeds(shapes: dict[str, Shape]) -> dict[str, dict[str, float]]:
    """Processor time per point [us] of f, and of f with its gradient, in both precisions. All take turns."""
    asked = {"f": "sdf", "g": "value_and_gradient"}
    types = {"32": torch.float32, "64": torch.float64}
    spent: dict[str, dict[str, list[float]]] = {name: {} for name in shapes}
    for _ in range(TURNS):
        for name, shape in shapes.items():
            point = near(shape)
            for what, method in asked.items():
                for bits, dtype in types.items():
                    given = point.to(dtype)
                    begin = time.process_time()
                    getattr(shape, method)(given)
                    took = 1e6 * (time.process_time() - begin) / len(point)
                    spent[name].setdefault(what + bits, []).append(took)
    return {n: {k: statistics.median(v) for k, v in one.items()} for n, one in spent.items()}


def size(shape: Any) -> int:
    """Bytes of the numbers that describe it."""
    whole = [*shape.state_dict().values(), *([shape.triangles] if shape.kind == PLAIN else ())]
    return sum(t.nbytes for t in whole)


# the channel


def amid(shape: Shape, cabinet: bool = True) -> Scene:
    """A metal cabinet of this shape alone, a transmitter beside it, and receivers all round."""
    node = Node(CABINET, Body(shape, Conductor()), Pose.identity())
    ring = [2 * math.pi * (k + 0.5) / RECEIVERS for k in range(RECEIVERS)]
    receivers = tuple(
        Radio.at(f"/rx{k}", AWAY * math.cos(a), AWAY * math.sin(a), 1.2) for k, a in enumerate(ring)
    )
    return Scene((node,) * cabinet, (Radio.at("/tx", *TRANSMITTER),), receivers, 2.44e9)


def heard(shape: Shape, quality: Quality) -> Heard:
    """The ring with this cabinet; what a process or a shape pays once is not counted."""
    scene = amid(shape)
    simulate(scene, None, replace(quality, depth=1))
    begin = time.process_time()
    result = simulate(scene, None, quality)
    return Heard(result, time.process_time() - begin)


def cabinet_matters(shape: Shape) -> torch.Tensor:
    """Links [t, r] that this cabinet moves by more than ``MATTERS``: it is touched, or in the way."""
    scenes, quality = (amid(shape), amid(shape, cabinet=False)), Quality.named(SETTING)
    with_, without = (responses(simulate(s, None, quality)) for s in scenes)
    return (difference_db(with_, without) > MATTERS).any(-1)


def moved(one: Result, other: Result, where: torch.Tensor) -> Figures:
    """How far path gain is from the other's [dB], of 90 % of the links that matter and the carriers about
    the asked one, so that no luck with phases hides it."""
    some = difference_db(responses(one), responses(other))[where].flatten().sort().values
    at_90 = float(some[math.ceil(WITHIN * len(some)) - 1]) if len(some) else 0.0
    return {"moved_db": at_90}


@contextmanager
def searching_in(dtype: torch.dtype) -> Iterator[None]:
    """Launched rays are marched in this precision: no setting asks for another than float32."""
    usual = launch.search_options
    launch.search_options = lambda *given: replace(usual(*given), dtype=dtype)  # type: ignore
    try:
        yield
    finally:
        launch.search_options = usual


# what is measured, and told


def measured(steps: int) -> Figures:
    """Everything that the section tells."""
    shapes: dict[str, Any] = {str(width): trained(width, steps) for width in WIDTHS}
    plain = source()
    shapes |= {SHIPPED: shipped(), PLAIN: Mesh(plain.vertices, plain.faces)}
    widest = str(max(WIDTHS))
    with torch.no_grad():
        where = cabinet_matters(shapes[SHIPPED])
        return {"steps": steps, "widest": widest, "links": int(where.sum())} | {
            "rows": compared(shapes, widest, where),
            "stored": as_stored(shapes[SHIPPED], where),
            "searched": as_searched(shapes[SHIPPED], where),
        }


def compared(shapes: dict[str, Any], widest: str, where: torch.Tensor) -> dict[str, Figures]:
    """Every shape by itself and amid the ring: against the source mesh, and the widest network."""
    quality = Quality.named(SETTING)
    channels = {}
    for name, shape in reversed(shapes.items()):
        print(f"  the ring with {name}", file=sys.stderr, flush=True)
        channels[name] = heard(shape, quality)
    took = speeds(shapes)
    return {
        name: off_mesh(shape)
        | took[name]
        | {"bytes": size(shape), "seconds": channels[name].seconds}
        | {"paths": see(channels[name].result).count, "rounding_mm": rounding_mm(shape)}
        | {"from_widest": moved(channels[name].result, channels[widest].result, where)}
        | {"from_mesh": moved(channels[name].result, channels[PLAIN].result, where)}
        for name, shape in shapes.items()
    }


def as_stored(shape: NeuralShape, where: torch.Tensor) -> dict[str, Figures]:
    """The shipped network with its weights rounded: how far the surface and the channel move."""
    rows, whole = {}, heard(shape, Quality.named(SETTING))
    for name, dtype in (("float16", torch.float16), ("bfloat16", torch.bfloat16)):
        print(f"  weights in {name}", file=sys.stderr, flush=True)
        small = stored(shape, dtype)
        found = heard(small, Quality.named(SETTING))
        rows[name] = off_mesh(small) | moved(found.result, whole.result, where)
        rows[name] |= {"bytes": size(shape) // 2, "paths": see(found.result).count}
    return rows


def as_searched(shape: NeuralShape, where: torch.Tensor) -> dict[str, Figures]:
    """The ring by rays that are marched in float32, and in float64, which counts as the truth."""
    quality = Quality.named(SETTING, search="rays")
    with searching_in(torch.float64):
        fine = heard(shape, quality)
    coarse = heard(shape, quality)
    return {
        name: moved(one.result, fine.result, where)
        | {"seconds": one.seconds, "paths": see(one.result).count}
        for name, one in (("float32", coarse), ("float64", fine))
    }


def place(steps: int = STEPS) -> Path:
    """Where the figures are kept: by what was trained, and the shipped weights."""
    weights = (ROOT / "assets" / "objects" / "cabinet" / "cabinet.safetensors").read_bytes()
    what = [
        WIDTHS,
        steps,
        POINTS,
        MATTERS,
        RECEIVERS,
        AWAY,
        TRANSMITTER,
        SETTING,
        hashlib.sha256(weights).hexdigest(),
    ]
    return KEPT / f"{hashlib.sha256(json.dumps(what).encode()).hexdigest()[:12]}.json"


def kept(steps: int = STEPS) -> Figures | None:
    """The figures of an earlier call, if there are any."""
    file = place(steps)
    return json.loads(file.read_text()) if file.exists() else None


def keep(found: Figures, steps: int) -> None:
    KEPT.mkdir(parents=True, exist_ok=True)
    beside = place(steps).with_suffix(".part")
    beside.write_text(json.dumps(found, indent=1))
    os.replace(beside, place(steps))


def section(found: Figures | None) -> str:
    """What the page says of widths, precisions and the mesh, below the heading."""
    if found is None:
        return "Not measured yet: run benchmarks/widths.py.\n"
    return "\n".join([about(found), "", *widths_table(found), "", *precision_tables(found), ""])


def about(found: Figures) -> str:
    return (
        f"The cabinet learned from its own mesh in {found['steps']} steps at each width; `{SHIPPED}` is "
        f"that of assets/objects, of width 64 and more steps, `{PLAIN}` the source mesh itself, on its faces. "
        "*off*: |f| at points of that mesh, *turned*: angle between gradient and normal there, each of 50 / "
        "99 %. *f*, *f+g*: processor time per point of the value alone and with its gradient, in float32 / "
        f"float64. *ring*: processor time of {RECEIVERS} receivers on a ring of {AWAY:g} m about this cabinet, "
        f"of metal, at `{SETTING}`; *moved*: path gain at 90 % of the links that the cabinet moves by "
        f"{MATTERS:g} dB or more ({found['links']} of {RECEIVERS}) and "
        "of 17 carriers within 8 %."
    )


def widths_table(found: Figures) -> list[str]:
    head = ["width", "off [mm]", "turned [deg]", "kB", "f [us]", "f+g [us]", "ring [s]", "paths"]
    head += [f"moved from {found['widest']} [dB]", "moved from the mesh [dB]"]
    lines = []
    for name, row in found["rows"].items():
        cells = [name, pair(row["off_mm"]), pair(row["turned_deg"]), f"{row['bytes'] / 1e3:.3g}"]
        cells += [pair([row[what + "32"], row[what + "64"]]) for what in "fg"]
        cells += [f"{row['seconds']:.2g}", str(row["paths"])]
        cells += [f"{row[other]['moved_db']:.2g}" for other in ("from_widest", "from_mesh")]
        lines.append(cells)
    return table(head, lines)


def precision_tables(found: Figures) -> list[str]:
    kept_as = [
        [name, pair(row["off_mm"]), f"{row['bytes'] / 1e3:.3g}", f"{row['moved_db']:.2g}"]
        for name, row in found["stored"].items()
    ]
    marched = [
        [name, f"{row['seconds']:.2g}", str(row["paths"]), f"{row['moved_db']:.2g}"]
        for name, row in found["searched"].items()
    ]
    rounding = pair(found["rows"][SHIPPED]["rounding_mm"])
    return [
        "Weights are float32, and the points decide what f is evaluated in, so that float32 weights "
        "evaluated in float64 and the same weights kept in float64 are one and the same. Evaluated in "
        f"float32, f of the shipped cabinet is {rounding} mm from that (50 / 99 %). Paths are searched for in "
        "float32 and come to rest in float64 whatever the setting. Weights rounded further:",
        "",
        *table(["weights", "off [mm]", "kB", "moved from float32 [dB]"], kept_as),
        "",
        "The same by rays (`search=rays`), these marched in either precision:",
        "",
        *table(["march", "s", "paths", "moved [dB]"], marched),
    ]


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    return lines + [f"| {' | '.join(cells)} |" for cells in rows]


def pair(values: list[float]) -> str:
    return " / ".join(f"{value:.2g}" for value in values)


def main() -> None:
    """Measure what is not kept yet, print, and write the section if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write-docs", action="store_true", help=f"write it into {PAGE.name}")
    parser.add_argument("--steps", type=int, default=STEPS, help=f"of each training: {STEPS}")
    parser.add_argument("--fresh", action="store_true", help="measure anew")
    options = parser.parse_args()
    if options.write_docs and options.steps != STEPS:
        parser.error(f"--write-docs writes what {STEPS} steps learn: leave out --steps")
    start = time.perf_counter()
    found = None if options.fresh else kept(options.steps)
    if found is None:
        found = measured(options.steps)
        found["measured_on"] = measured_on(time.perf_counter() - start)
        keep(found, options.steps)
    text = section(found)
    print(text)
    if options.write_docs:
        write_section(PAGE, HEADING, text, found["measured_on"])


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
