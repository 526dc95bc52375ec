"""How fast is it here? Measures every stage and writes a page of tables.

    python benchmarks/speed.py [--out docs/performance.md] [--quick]

Every figure is a median of several runs, with the least and the most of them. Where two ways are
compared they take turns, so that a machine that slows down slows both, and the ratio is that of each
turn. Nothing is asserted: a page from one machine is no promise about another.
"""

import argparse
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from machine import ROOT, write_page
from torch import Tensor

from rfsg.objects.shapes.neural import NeuralShape
from rfsg.scene.assets import load_asset
from rfsg.scene.scene import Scene
from rfsg.scene.world import World
from rfsg.tracer.embree import Proxies, brute_spans
from rfsg.tracer.launch import fibonacci
from rfsg.tracer.march import EVALUATE, SEARCH, MarchOptions, march
from rfsg.tracer.plan import Quality
from rfsg.tracer.radiomap import radio_map
from rfsg.tracer.records import Rays
from rfsg.tracer.simulate import simulate

SCENE = ROOT / "assets" / "scenes" / "lab.usda"
CABINET = ROOT / "assets" / "objects" / "cabinet" / "cabinet.usda"
PAGE = ROOT / "docs" / "performance.md"
OTHERS = "<!-- the sections below are written by the scripts that they name -->\n"
RAYS = 100_000
POINTS = 20_000  # asked of a network at once: in float64 with slopes some 4 GiB
HITTING = 0.5  # share of the marched rays that are aimed to hit


@dataclass(frozen=True)
class Spread:
    """Several measurements of one thing."""

    values: tuple[float, ...]

    @property
    def median(self) -> float:
        return statistics.median(self.values)

    def each(self, change: Callable[[float], float]) -> "Spread":
        return Spread(tuple(change(v) for v in self.values))

    def __str__(self) -> str:
        low, middle, high = (_short(v) for v in (min(self.values), self.median, max(self.values)))
        return f"{middle} ({low} to {high})"


def _short(value: float) -> str:
    for size, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"


def seconds(work: Callable[[], object], runs: int, warm: bool = True) -> Spread:
    """Wall time of each run [s]; ``warm`` runs it once before, unmeasured."""
    if warm:
        work()
    return Spread(tuple(_once(work) for _ in range(runs)))


def ratio(one: Callable[[], object], other: Callable[[], object], runs: int) -> list[Spread]:
    """[time of one, time of other, other / one], taking turns."""
    one()
    other()
    turns = [(_once(one), _once(other)) for _ in range(runs)]
    first, second = zip(*turns, strict=True)
    return [Spread(first), Spread(second), Spread(tuple(b / a for a, b in turns))]


def _once(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


@dataclass
class Page:
    """Markdown under way; a section is a heading, a sentence and a table."""

    lines: list[str] = field(default_factory=list)

    def section(self, heading: str, note: str, head: Sequence[str], rows: list[list[str]]) -> None:
        print(f"-- {heading}", *(" | ".join(r) for r in rows), sep="\n", flush=True)
        table = [head, ["---"] * len(head), *rows]
        body = [f"| {' | '.join(row)} |" for row in table]
        self.lines += [f"## {heading}", "", note, "", *body, ""]


# what is measured


def spans(page: Page, world: World, runs: int) -> None:
    """Rays through the scene's proxies: Embree against every ray with every box."""
    proxies = Proxies(world)
    rays = _scattered(world, RAYS)
    embree, brute, times = ratio(
        lambda: proxies.spans(rays), lambda: brute_spans(world, rays), runs
    )
    rows = [
        ["Embree spans", str(embree.each(lambda s: RAYS / s))],
        ["every ray with every box", str(brute.each(lambda s: RAYS / s))],
        ["Embree is faster by", str(times)],
    ]
    note = (
        f"{RAYS:,} rays from within the lab ({len(world)} objects), each to its end with everything "
        "on its way. Both give the same spans; for few objects the plain way may well be the faster."
    )
    page.section("Rays against proxies", note, ["way", "rays/s"], rows)


def _scattered(world: World, count: int) -> Rays:
    """Rays from random places inside the scene's extent, evenly over the sphere."""
    proxies = Proxies(world)
    corners = proxies.corners(proxies.owner).reshape(-1, 3)
    low, high = corners.amin(0), corners.amax(0)
    generator = torch.Generator().manual_seed(0)
    share = torch.rand(count, 3, dtype=torch.float64, generator=generator)
    limit = torch.full((count,), torch.inf, dtype=torch.float64)
    return Rays(low + share * (high - low), fibonacci(count), limit)


def marching(page: Page, shape: NeuralShape, runs: int, count: int) -> None:
    """Sphere tracing through the cabinet, half of the rays hitting it."""
    start, direction, length, share = _aimed(shape, count)
    rows = []
    for name, options in (("search, float32", SEARCH), ("evaluate, float64", EVALUATE)):
        time_of = seconds(lambda o=options: march(shape, start, direction, length, o), runs)
        rows.append([name, str(time_of.each(lambda s: count / s))])
    note = (
        f"{count:,} rays through the bounds of the trained cabinet, {100 * share:.0f} % of which go "
        "through the cabinet itself; every boundary found and polished."
    )
    page.section("Sphere tracing of a neural shape", note, ["options", "rays/s"], rows)


@torch.no_grad()
def _aimed(shape: NeuralShape, count: int) -> tuple[Tensor, Tensor, Tensor, float]:
    """Random chords of the bounds (start, direction, length), and the share of them that hits."""
    low, high = shape.bounds()
    generator = torch.Generator().manual_seed(0)
    most = 4 * count
    ends = torch.rand(2, most, 3, dtype=torch.float64, generator=generator)
    axis = torch.randint(3, (2, most), generator=generator)
    side = torch.randint(2, (2, most), generator=generator).double()
    ends = ends.scatter(-1, axis[..., None], side[..., None])  # onto the faces of the unit cube
    start, end = low + ends * (high - low)
    away = end - start
    length = away.norm(dim=-1)
    some = torch.nonzero(length > 0.05 * length.max()).squeeze(-1)
    direction = away[some] / length[some, None]
    options = MarchOptions(step_floor=0.02)
    row, _, _ = march(shape, start[some], direction, length[some], options)
    hits = torch.zeros(len(some), dtype=torch.bool)
    hits[row] = True
    wanted = int(HITTING * count)
    hit, miss = (torch.nonzero(x).squeeze(-1)[:wanted] for x in (hits, ~hits))
    if len(hit) < wanted or len(miss) < count - wanted:
        print(f"only {len(hit)} hits and {len(miss)} misses to draw from", file=sys.stderr)
    chosen = torch.cat([hit, miss])[:count]
    share = len(hit) / len(chosen)
    return start[some][chosen], direction[chosen], length[some][chosen], share


@torch.no_grad()
def network(page: Page, shape: NeuralShape, runs: int, count: int) -> None:
    """Evaluations of f, and of f with its gradient, against what the matrix product could do."""
    low, high = shape.bounds()
    point = low + (high - low) * torch.rand(count, 3, dtype=torch.float64)
    work = 2.0 * sum(p.numel() for n, p in shape.named_parameters() if _counts(n))
    size, rows = 512, []
    for dtype in (torch.float32, torch.float64):
        p = point.to(dtype)
        a, b = torch.rand(2, size, size, dtype=dtype)
        peak = seconds(lambda a=a, b=b: torch.mm(a, b), 3 * runs).each(lambda s: 2 * size**3 / s)
        name = str(dtype).removeprefix("torch.")
        rows.append([f"torch.mm, {name}", f"{peak} FLOP/s", "", ""])
        ways = (("f", shape.sdf, 1), ("f and gradient", shape.value_and_gradient, 2))
        for what, ask, sweeps in ways:
            rate = seconds(lambda ask=ask, p=p: ask(p), runs).each(lambda s: count / s)
            reached = rate.median * work * sweeps
            share = 100 * reached / peak.median
            rows.append(
                [
                    f"{what}, {name}",
                    f"{rate} points/s",
                    f"{_short(reached)}FLOP/s",
                    f"{share:.0f} %",
                ]
            )
    note = (
        f"{count:,} points; FLOP counts matrix products alone ({work:,.0f} for f, twice that with "
        "the gradient), so that the sines, the activations and the memory show as what is lost."
    )
    page.section("The network", note, ["what", "rate", "reached", "of torch.mm"], rows)


def _counts(parameter: str) -> bool:
    return parameter.endswith("weight") and "feature" not in parameter


def simulations(page: Page, scene: Scene, runs: int) -> None:
    """simulate, stage by stage, at draft and standard, and at draft with either search; in turns."""
    ways = {
        "draft": Quality.named("draft", search="enumerate"),
        "draft, by rays": Quality.named("draft", search="rays"),
        "standard": Quality.named("standard"),
    }
    first = _once(lambda: simulate(scene, quality=ways["draft"]))
    turns = [{name: simulate(scene, quality=q) for name, q in ways.items()} for _ in range(runs)]
    rows = []
    for stage in turns[0]["draft"].seconds:
        rows.append(
            [stage, *(str(Spread(tuple(t[n].seconds[stage] for t in turns))) for n in ways)]
        )
    whole = {name: [sum(t[name].seconds.values()) for t in turns] for name in ways}
    rows.append(["all", *(str(Spread(tuple(times))) for times in whole.values())])
    last = turns[-1]
    rows.append(["sequences", *("all" if last[n].search.complete else "by rays" for n in ways)])
    rows.append(["candidates", *(str(last[n].search.candidates) for n in ways)])
    rows.append(["paths", *(str(len(last[n].paths.tx)) for n in ways)])
    links = len(scene.transmitters) * len(scene.receivers)
    pairs = zip(whole["draft"], whole["draft, by rays"], strict=True)
    times = Spread(tuple(rays / enumerated for enumerated, rays in pairs))
    note = (
        f"The lab: {len(scene.nodes)} objects, {links} links, one frequency. Seconds. The first "
        f"simulation of the process, which also samples and measures every learned face, took "
        f"{_short(first)} s. By rays, draft takes {times} times as long as by enumeration."
    )
    page.section("A simulation", note, ["stage", *ways], rows)


def the_rest(page: Page, scene: Scene, runs: int) -> None:
    """Reading the scene, and a map."""
    read = seconds(lambda: Scene.from_usd(SCENE), runs)
    cells = tuple(radio_map(scene, quality="draft").path_gain.shape[1:])
    chart = seconds(lambda: radio_map(scene, quality="draft"), runs, warm=False)
    rows = [
        ["reading lab.usda with its four objects", str(read)],
        [f"radio map, draft, {cells[0]} x {cells[1]} cells", str(chart)],
    ]
    page.section("Reading and maps", "Seconds.", ["what", "s"], rows)


def peak_memory() -> float:
    """Most memory that this process ever held [MiB] (Linux counts KiB, macOS bytes)."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 2**20 if sys.platform == "darwin" else most / 2**10


def _machine(runs: int) -> list[str]:
    rows = {
        "system": f"{platform.system()}, {platform.machine()}",
        "processor": _processor(),
        "cores": f"{os.cpu_count()}, {torch.get_num_threads()} of them used by torch",
        "Python, torch": f"{platform.python_version()}, {torch.__version__}",
        "runs": f"{runs}: median (least to most)",
    }
    return ["| machine | |", "| --- | --- |", *(f"| {k} | {v} |" for k, v in rows.items()), ""]


def _processor() -> str:
    """Its model, where the system tells."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "not told"


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--quick", action="store_true", help="3 runs of everything, else 5")
    options = parser.parse_args()
    runs = 3 if options.quick else 5
    scene = Scene.from_usd(SCENE)
    shape = load_asset(CABINET).body.shape
    assert isinstance(shape, NeuralShape)
    page = Page()
    simulations(page, scene, 3)
    the_rest(page, scene, 3)
    spans(page, World(scene), runs)
    network(page, shape, runs, POINTS)
    marching(page, shape, runs, POINTS // 5)
    head = [
        "# Performance",
        "",
        "Written by `make bench` (`benchmarks/speed.py`) on one machine; another will differ. Other work",
        "on it shows in the spread. Compare a change with the same machine's figures before it.",
        "",
    ]
    tail = [f"Peak memory of the whole run: {peak_memory():.0f} MiB.", ""]
    kept = options.out.read_text().partition(OTHERS)[2] if options.out.is_file() else ""
    write_page(options.out, *head, *_machine(runs), *page.lines, *tail, OTHERS + kept)


if __name__ == "__main__":
    main()
