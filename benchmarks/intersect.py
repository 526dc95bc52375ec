"""Rays against a neural shape: what each way to meet it costs, and what it gets wrong.

    python benchmarks/intersect.py [--rays 1000000] [--runs 3] [--write-docs]

A trained cabinet, and a thin pane (1 cm in a 5 cm wall) trained here. Rays start 3 m away and are aimed
into a box half as large again as the bounds: about half of them miss. The ways take turns, so that a
machine that slows down slows all, and a ratio is that of each turn. Naive tracing runs on a part of
the rays, its rate is what is compared. Truth: a plain float64 march with a least step of 0.2 mm on
some thousands of the rays.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import trimesh
from machine import ROOT, measured_on, write_page
from sweeps import section
from torch import Tensor
from torch.nn import functional as F

from rfsg.objects.contract import Shape
from rfsg.objects.shapes.baked import bake
from rfsg.objects.shapes.band import Baked, Surface
from rfsg.objects.shapes.kept import tensors_of
from rfsg.objects.shapes.neural import NeuralShape, compute_lipschitz
from rfsg.scene.assets import load_asset
from rfsg.tracer.intersect import WAYS, Intersector, Rest
from rfsg.tracer.march import EVALUATE, plain_march
from rfsg.tracer.traced import Traced

CABINET = ROOT / "assets" / "objects" / "cabinet" / "cabinet.usda"
PAGE = ROOT / "docs" / "intersection.md"
ABOUT = """# Rays against a neural shape

Written by `benchmarks/intersect.py --write-docs` on one machine; another will differ. Ratios are medians
(least to most) of turns taken one after the other. *naive* is sphere tracing of every ray in 64 steps
with difference normals; *pruned march* leaves out what misses the convex hull and what is done, and
stops at 1 mm. The other ways are those of the setting `intersection`. Errors are held to a float64 march
with a least step of 0.2 mm: hits of what is thinner count as false.
"""
NAIVE_STEPS, NAIVE_RAYS, CHECKED = 64, 10_000, 20_000
STOP, H = 1e-3, 1e-3  # [m] where sphere tracing stops; of its difference normals

Rays = tuple[Tensor, Tensor, Tensor]
Answer = tuple[Tensor, Tensor]  # (hit [m], t [m])


@dataclass(frozen=True)
class Way:
    name: str
    run: Callable[[Rays], Answer]
    most: int  # rays that it is given


def aimed(shape: Shape, count: int, seed: int = 0) -> Rays:
    """Rays from a sphere of 3 m at points of a box half as large again as the bounds, float32."""
    generator = torch.Generator().manual_seed(seed)
    low, high = shape.bounds().float()
    centre = 0.5 * (low + high)
    origin = centre + 3.0 * F.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    share = 2.0 * torch.rand(count, 3, generator=generator) - 1.0
    direction = F.normalize(centre + 0.75 * (high - low) * share - origin, dim=-1)
    return origin, direction, torch.full((count,), 6.0)


def in_bounds(shape: Shape, rays: Rays) -> tuple[Tensor, Tensor]:
    """(enter, leave) of rays through the bounds."""
    low, high = shape.bounds().to(rays[0])
    ends = torch.stack([(low - rays[0]) / rays[1], (high - rays[0]) / rays[1]])
    return ends.amin(0).amax(-1).clamp(min=0.0), torch.minimum(ends.amax(0).amin(-1), rays[2])


@torch.no_grad()
def naive(shape: Shape, rays: Rays) -> Answer:
    """Sphere tracing as usually written: every ray, a fixed number of steps, difference normals."""
    origin, direction, _ = rays
    enter, leave = in_bounds(shape, rays)
    t = torch.minimum(enter, leave)
    for _ in range(NAIVE_STEPS):
        t = torch.minimum(t + shape.sdf(origin + t[:, None] * direction), leave)
    point = origin + t[:, None] * direction
    sides = H * torch.eye(3)
    slopes = [shape.sdf(point + e) - shape.sdf(point - e) for e in sides]
    F.normalize(torch.stack(slopes, -1), dim=-1)
    return (leave > enter) & (shape.sdf(point).abs() < STOP), t


@torch.no_grad()
def pruned(traced: Intersector, shape: Shape, rays: Rays) -> Answer:
    """Sphere tracing with care: rays that miss the convex hull left out, those that are done too, a stop at
    1 mm and one Newton step."""
    origin, direction, length = rays
    hit, found = torch.zeros(len(origin), dtype=torch.bool), torch.zeros(len(origin))
    whole = Rest(torch.arange(len(origin)), origin, direction, torch.zeros_like(length), length)
    i, start, d, entry, left = traced._in_shell(whole)
    t, active = torch.zeros(len(i)), torch.arange(len(i))
    done = torch.zeros(len(i), dtype=torch.bool)
    for _ in range(2 * NAIVE_STEPS):
        value = shape.sdf(start[active] + t[active, None] * d[active])
        close = value < STOP
        done[active[close]] = True
        t[active] += torch.where(close, 0.0, value)
        active = active[~close & (t[active] < left[active])]
        if not len(active):
            break
    k = torch.nonzero(done).squeeze(-1)
    value, gradient = shape.value_and_gradient(start[k] + t[k, None] * d[k])
    slope = (gradient * d[k]).sum(-1).clamp(max=-0.1)
    hit[i[k]], found[i[k]] = True, t[k] - (value / slope).clamp(-5 * STOP, 5 * STOP) + entry[k]
    return hit, found


def hull(shell: Surface) -> Surface:
    """The convex hull of a shell."""
    made = trimesh.Trimesh(shell.vertices.numpy(), shell.triangles.numpy()).convex_hull
    return Surface(torch.tensor(made.vertices).float(), torch.tensor(made.faces).int())


def by(traced: Intersector, way: str) -> Callable[[Rays], Answer]:
    def run(rays: Rays) -> Answer:
        hits = traced.first_hits(*rays, way)
        hit, t = torch.zeros(len(rays[2]), dtype=torch.bool), torch.zeros(len(rays[2]))
        hit[hits.ray], t[hits.ray] = True, hits.t
        return hit, t

    return run


def truth(shape: Shape, rays: Rays) -> Answer:
    """Hit or not, and where, by steps no longer than f / L and a least one of 0.2 mm, in float64."""
    o, d, length = (x.double() for x in rays)
    d = F.normalize(d, dim=-1)
    enter, leave = in_bounds(shape, (o, d, length))
    options = replace(EVALUATE, step_floor=2e-4)
    at = (o + enter[:, None] * d, d, (leave - enter).clamp(min=0.0))
    row, first, _ = plain_march(shape, *at, options)
    t = torch.full_like(length, torch.inf).scatter_reduce(0, row, first, "amin")
    return torch.isfinite(t), t + enter


def errors(found: Answer, true: Answer) -> list[str]:
    """[false / missed hits %, position error mm at 50 / 99 %]."""
    (hit, t), (there, at) = found, true
    false, missed = ((hit & ~there).double().mean(), (there & ~hit).double().mean())
    off = (t.double() - at)[hit & there].abs() * 1e3
    half, most = (float(torch.quantile(off, q)) for q in (0.5, 0.99))
    return [f"{100 * float(false):.3f} / {100 * float(missed):.3f}", f"{half:.2g} / {most:.2g}"]


def table(name: str, shape: Shape, count: int, runs: int, step: float | None) -> list[str]:
    start = time.perf_counter()
    baked = bake(shape, step)
    seconds = time.perf_counter() - start
    traced, exact = Intersector(shape, baked), Intersector(shape, baked, network_normals=True)
    hulled = Intersector(shape, baked)
    hulled.shell = Traced(hull(baked.shell))
    rays = aimed(shape, count)
    ways = [
        Way("naive", lambda r: naive(shape, r), min(count, NAIVE_RAYS)),
        Way("pruned march", lambda r: pruned(hulled, shape, r), min(count, 5 * NAIVE_RAYS)),
        *(Way(way, by(traced, way), count) for way in WAYS),
        Way("certain, normals by the network", by(exact, "certain"), count),
    ]
    given = {way.name: tuple(x[: way.most] for x in rays) for way in ways}
    for way in ways:
        way.run(tuple(x[:1000] for x in rays))  # type: ignore[arg-type]
    rates: dict[str, list[float]] = {way.name: [] for way in ways}
    for _ in range(runs):
        for way in ways:
            begin = time.perf_counter()
            way.run(given[way.name])  # type: ignore[arg-type]
            rates[way.name].append(way.most / (time.perf_counter() - begin))
    some = tuple(x[:CHECKED] for x in rays)
    true = truth(shape, some)  # type: ignore[arg-type]
    off = shape.sdf(baked.shell.vertices).median()
    size = sum(t.nbytes for t in tensors_of(baked).values()) / 2**20
    lines = [
        f"{name}: {count} rays ({100 * float(true[0].double().mean()):.0f} % hit; naive runs on "
        f"{min(count, NAIVE_RAYS)}, the pruned march on {min(count, 5 * NAIVE_RAYS)}), errors on "
        f"{len(some[0])}. Baked in {seconds:.1f} s at {1e3 * baked.step:.3g} mm: "
        f"{len(baked.zero.triangles)} triangles; {len(baked.shell.triangles)} of a shell, half of it "
        f"less than {1e3 * float(off):.2g} mm outside; {size:.0f} MB of file.",
        "",
        "| way | krays/s | x naive | x pruned march | false / missed % | off mm, 50 / 99 % |",
        "|---|---|---|---|---|---|",
    ]
    for way in ways:
        own = rates[way.name]
        over = [
            _spread([a / b for a, b in zip(own, rates[base], strict=True)])
            for base in ("naive", "pruned march")
        ]
        cells = [way.name, _spread([r / 1e3 for r in own]), *over]
        cells += errors(way.run(some), true)  # type: ignore[arg-type]
        lines.append(f"| {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    return [*lines, "", *said(baked)]


def said(baked: Baked) -> list[str]:
    """What the baked shape itself says that each way errs by."""
    parts = [
        f"{way} {1e3 * off.usual:.2g} / {1e3 * off.most:.2g} mm / {100 * off.lost:.2g} %"
        for way, off in baked.offs.items()
    ]
    return [
        f"Off by what was found when it was baked (99 % / most / lost): {'; '.join(parts)}.",
        "",
    ]


@torch.no_grad()
def floor(shape: Shape, runs: int) -> list[str]:
    """f and its gradient against matrix products, taking turns."""
    point = shape.bounds().float().mean(0) + 0.2 * torch.randn(65_536, 3)
    a = torch.randn(1024, 1024)
    assert isinstance(shape, NeuralShape)
    macs = sum(layer.weight.numel() for layer in (*shape.hidden, shape.to_value))  # type: ignore[union-attr]
    shares, rates = [], []
    for _ in range(runs + 1):
        begin = time.perf_counter()
        shape.value_and_gradient(point)
        middle = time.perf_counter()
        for _ in range(4):
            a @ a
        rates.append(len(point) / (middle - begin))
        peak = 4 * 2 * 1024**3 / (time.perf_counter() - middle)
        shares.append(100.0 * rates[-1] * 4 * macs / peak)
    return [
        f"f with its gradient: {_spread([r / 1e3 for r in rates[1:]])} k/s, "
        f"{_spread(shares[1:])} % of what matrix products of this machine allow.",
        "",
    ]


def _spread(values: list[float]) -> str:
    return f"{statistics.median(values):.3g} ({min(values):.3g} to {max(values):.3g})"


def thin_pane(steps: int = 400) -> NeuralShape:
    """A network of the paper's size taught a 5 cm wall with a 1 cm pane, half a metre each way."""
    torch.manual_seed(0)
    shape = NeuralShape([[-0.15, -0.5, -0.5], [0.15, 0.5, 0.5]], lipschitz=2.0)
    optimiser = torch.optim.Adam(shape.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    half = torch.tensor([0.15, 0.5, 0.5])
    for _ in range(steps):
        point = (2.0 * torch.rand(4096, 3) - 1.0) * half
        point[::2, 0] = 0.04 * torch.randn(2048)
        optimiser.zero_grad()
        (shape.sdf(point) - _pane(point)).abs().mean().backward()
        optimiser.step()
        schedule.step()
    shape.lipschitz = compute_lipschitz(shape)
    return shape.requires_grad_(False)


def _pane(point: Tensor) -> Tensor:
    x, y, z = point.abs().unbind(-1)
    edge = torch.maximum(y, z)
    glass = torch.maximum(x - 0.005, edge - 0.42)
    wall = torch.maximum(torch.maximum(x - 0.025, 0.25 - edge), edge - 0.42)
    return torch.minimum(glass, wall)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--step", type=float, default=None, help="grid step [m]")
    parser.add_argument("--only", choices=["cabinet", "pane"])
    parser.add_argument("--write-docs", action="store_true")
    given = parser.parse_args()
    start = time.perf_counter()
    lines: list[str] = []
    cabinet = load_asset(CABINET).body.shape
    assert isinstance(cabinet, NeuralShape)
    cabinet.requires_grad_(False)
    if given.only != "pane":
        lines += table("The trained cabinet", cabinet, given.rays, given.runs, given.step)
    if given.only != "cabinet":
        lines += table("A thin pane", thin_pane(), given.rays, given.runs, given.step)
    lines += floor(cabinet, given.runs)
    lines += section(given.runs)
    lines += [measured_on(time.perf_counter() - start)]
    print("\n".join(lines))
    if given.write_docs:
        write_page(PAGE, ABOUT, *lines)


if __name__ == "__main__":
    main()
