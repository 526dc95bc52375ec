"""Cost against objects: a hall of 10 to 1000 instances of one trained cabinet.

    OMP_NUM_THREADS=1 python benchmarks/objects.py [--counts 10 32 100 316 1000] [--runs 3]

A hall of 40 m with concrete walls, cabinets in a square pattern, one transmitter under the ceiling and
ten receivers. Seconds are the processor's, of all threads, medians of runs after a first one that is
not counted (samples and facets of the shape are its own, and kept). Memory by instance is what the
process grows by, from the fewest instances to the most, while scene, world, samples and proxies are
held.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from machine import ROOT, measured_on, write_section

import rfsg
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.embree import Proxies
from rfsg.tracer.faces import samples_of
from rfsg.tracer.launch import fibonacci
from rfsg.tracer.records import Rays

DOCS = ROOT / "docs" / "performance.md"
SAID = """Written by `OMP_NUM_THREADS=1 python benchmarks/objects.py --write-docs`: a hall of 40 m with so many
instances of one trained cabinet, a transmitter and ten receivers. Seconds of the processor but for
*search*, which is by the wall; *move*: the boxes of a hall in which one cabinet has moved. Medians of five
turns through all halls; the ratio is each turn's own."""
ASSET = Path(__file__).resolve().parents[1] / "assets" / "objects" / "cabinet" / "cabinet.usda"
SIDE, HEIGHT, WALL = 40.0, 6.0, 0.2  # [m]
RAYS = 100_000
PAGE = 4096  # bytes
COLUMNS = ("simulate, draft", "of it the search", "ray spans, 1e5 rays", "move of one object")


def hall(count: int, body: Body, receivers: int = 10) -> Scene:
    """A hall with ``count`` instances of one body on its floor."""
    half, up, thin = SIDE / 2, HEIGHT / 2, WALL / 2
    concrete = Slab(WALL, itu="concrete")
    walls = {
        "/floor": ([half, half, thin], (0.0, 0.0, -thin)),
        "/ceiling": ([half, half, thin], (0.0, 0.0, HEIGHT + thin)),
        "/west": ([thin, half, up], (-half - thin, 0.0, up)),
        "/east": ([thin, half, up], (half + thin, 0.0, up)),
        "/south": ([half, thin, up], (0.0, -half - thin, up)),
        "/north": ([half, thin, up], (0.0, half + thin, up)),
    }
    nodes = [Node(k, Body(Box(size), concrete), Pose.at(*at)) for k, (size, at) in walls.items()]
    rows, low = math.isqrt(count - 1) + 1, float(body.shape.bounds()[0, 2])
    pitch = (SIDE - 4.0) / rows
    for i in range(count):
        x, y = (2.0 - half + pitch * (k + 0.5) for k in (i % rows, i // rows))
        nodes.append(Node(f"/c{i}", body, Pose.at(x, y, -low)))
    places = torch.rand(receivers, 2, generator=torch.Generator().manual_seed(0)) * 36.0 - 18.0
    radios = [Radio.at(f"/r{j}", *p, 1.5) for j, p in enumerate(places.tolist())]
    return Scene(tuple(nodes), (Radio.at("/t", 1.3, 0.7, 5.0),), tuple(radios), 2.4e9)


def seconds(work: Callable[[], object]) -> float:
    """The processor's, of one run."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


class Hall:
    """What is asked of a hall, one of COLUMNS after the other, as often as wanted."""

    def __init__(self, count: int, body: Body):
        self.scene = hall(count, body)
        self.proxies = Proxies(World(self.scene))
        origin = self.scene.transmitters[0].position.expand(RAYS, 3).clone()
        far = torch.full((RAYS,), torch.inf, dtype=torch.float64)
        self.rays = Rays(origin, fibonacci(RAYS), far)
        last = self.scene.nodes[-1]
        shift = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
        moved = replace(last, pose=replace(last.pose, translation=last.pose.translation + shift))
        self.after = World(replace(self.scene, nodes=(*self.scene.nodes[:-1], moved)))

    def costs(self) -> list[float]:
        """Seconds of each of COLUMNS."""
        searches: list[float] = []

        def run() -> None:
            searches.append(rfsg.simulate(self.scene, quality="draft").seconds["search"])

        whole = seconds(run)
        return [
            whole,
            searches[-1],
            seconds(lambda: self.proxies.spans(self.rays)),
            seconds(lambda: Proxies(self.after)),
        ]


def resident() -> int:
    """Bytes of the process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def bytes_by_instance(few: int, many: int, body: Body) -> float:
    """Growth of the process from few instances to many, by each more."""
    held, sizes = [], []
    for count in (few, few, many):  # the first one brings what all of them share
        world = World(hall(count, body))
        held.append((world, samples_of(world), Proxies(world)))
        sizes.append(resident())
    return (sizes[2] - sizes[1]) / many


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 32, 100, 316, 1000])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--write-docs", action="store_true", help=f"a section of {DOCS.name}")
    args = parser.parse_args()
    begin, body = time.perf_counter(), load_asset(ASSET).body
    counts = sorted(args.counts)
    memory = bytes_by_instance(counts[0], counts[-1], body)
    halls = {n: Hall(n, body) for n in counts}
    for one in halls.values():
        one.costs()  # the first time is not counted
    turns = [{n: one.costs() for n, one in halls.items()} for _ in range(args.runs)]
    rows = {
        n: [statistics.median(c) for c in zip(*(t[n] for t in turns), strict=True)] for n in counts
    }
    lines = [f"| instances | {' | '.join(f'{c} [s]' for c in COLUMNS)} |"]
    lines += ["|---" * (len(COLUMNS) + 1) + "|"]
    lines += [f"| {n} | {' | '.join(f'{v:.3f}' for v in row)} |" for n, row in rows.items()]
    decades = math.log10(counts[-1] / counts[0])
    grown = [  # by turn, each column's growth from the fewest to the most
        [(z / a) ** (1.0 / decades) for a, z in zip(t[counts[0]], t[counts[-1]], strict=True)]
        for t in turns
        if decades
    ]
    told = [
        f"{statistics.median(c):.1f}x ({min(c):.1f} to {max(c):.1f})"
        for c in zip(*grown, strict=True)
    ]
    lines += [f"| ratio per decade | {' | '.join(told)} |", ""]
    lines += [f"Memory: {memory / 1000:.1f} kB by instance.", ""]
    lines += [measured_on(time.perf_counter() - begin)]
    print(*lines, sep="\n")
    if args.write_docs:
        write_section(DOCS, "## Many objects", SAID, "", *lines)


if __name__ == "__main__":
    main()
