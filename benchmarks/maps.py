"""Radio maps: how fast, how exact, how much memory? Against the exact sum, and a peer where there is one.

    python benchmarks/maps.py [--runs 5] [--threads 2] [--rays N] [--peer-rays N] [--memory]
                              [--write-docs]

The street canyon of ``peers/cases.py``: 180 x 120 cells of 1 m, 3 reflections, 3.5 GHz. The truth is
the path solver's incoherent sum at cells' middles (``method="paths"``), at 400 of them, drawn once.
Where ``peers/.venv`` exists, Sionna RT's RadioMapSolver runs in a process of its own that takes turns
with rfsg's methods: figures of one run share its load. Each figure is a median (least to most); the
processor's seconds, of all threads, say what it was without the load. ``--rays``: rfsg's rays as well;
``--peer-rays``: Sionna's once more with so many, whose error against the exact map says what an error
costs there. Ways by rays take as many turns as the others, or ``FEW`` above ten times a million rays.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "peers"))
PEER = HERE / "peers" / ".venv" / "bin" / "python"
SIZE, HEIGHT, CELL = (180.0, 120.0), 1.5, 1.0  # [m]
CASE = "canyon 3.5 GHz"
DRAWN = 400  # cells of the truth
PEER_RAYS = 1_000_000
FEW, MANY = 2, 10_000_000  # turns of a way of so many rays
PAGE = HERE.parent / "docs" / "performance.md"
SAID = {
    "## A radio map of a street": """
Written by `python benchmarks/maps.py --write-docs`: 180 x 120 cells of 1 m, 3 reflections, against the
exact incoherent sum at the middles of 400 cells. The ways take turns. Leaving out the third reflection is
what buys time for an error here, as fewer rays do there.
""",
    "## Memory of a map of a million cells": """
Written by `python benchmarks/maps.py --memory --write-docs`: the same street in cells of 0.147 m, each
method in a process of its own. The goal was 2 GB.
""",
}
WORK = HERE.parent / "out" / "maps"


# what a process of its own does: answers lines that say what to map, and into which file


def timed(work: Callable[[], object], file: str) -> None:
    """Saves the map and prints [wall, processor] seconds."""
    import numpy as np

    start, worked = time.perf_counter(), time.process_time()
    gain = work()
    seconds = time.perf_counter() - start, time.process_time() - worked
    np.save(file, gain)
    print(json.dumps(seconds), flush=True)


def serve_sionna() -> None:
    import cases
    import sionna_side

    mi, rt = sionna_side.mi, sionna_side.rt
    case = cases.named(CASE)
    scene = sionna_side.build(case)
    where = {"center": mi.Point3f(0.0, 0.0, HEIGHT), "orientation": mi.Point3f(0.0, 0.0, 0.0)}
    where |= {"size": mi.Point2f(*SIZE), "cell_size": mi.Point2f(CELL, CELL)}

    def work(rays: int) -> object:
        found = rt.RadioMapSolver()(
            scene, samples_per_tx=rays, max_depth=case.depth, refraction=False, **where
        )
        return found.path_gain.numpy()[0]

    for line in sys.stdin:
        rays, file = line.split()
        timed(lambda n=int(rays): work(n), file)


def serve_rfsg() -> None:
    import cases
    import rfsg_side

    import rfsg

    case = cases.named(CASE)
    scene = rfsg_side.build(case)
    half = [s / 2 for s in SIZE]
    where = {"height": HEIGHT, "cell": CELL, "bounds": (-half[0], -half[1], *half)}

    def work(method: str, rays: int, depth: int) -> object:
        quality = rfsg.Quality(depth=depth, floor_db=case.floor_db, map_rays=rays)
        return rfsg.radio_map(scene, quality=quality, method=method, **where).path_gain[0].numpy()

    for line in sys.stdin:
        method, rays, depth, file = line.split()
        timed(lambda m=method, n=int(rays), d=int(depth): work(m, n, d), file)


class Server:
    """A process that answers lines."""

    def __init__(self, python: str, role: str, threads: int):
        threads_of = {"OMP_NUM_THREADS": str(threads), "PYTHONPATH": str(HERE.parent)}
        if role == "sionna":
            threads_of.pop("PYTHONPATH")
        self.process = subprocess.Popen(
            [python, __file__, "--serve", role], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            text=True, env=os.environ | threads_of,
        )  # fmt: skip

    def ask(self, line: str) -> tuple[float, float]:
        assert self.process.stdin is not None and self.process.stdout is not None
        print(line, file=self.process.stdin, flush=True)
        wall, processor = json.loads(self.process.stdout.readline())
        return wall, processor

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def compare(runs: int, threads: int, rays: int, peer_rays: int) -> list[str]:
    """Prints the table."""
    import numpy as np

    WORK.mkdir(parents=True, exist_ok=True)
    ours = Server(sys.executable, "rfsg", threads)
    # Sionna's process has no thread count of its own: Dr.Jit takes the cores it may run on
    peer = Server(str(PEER), "sionna", threads) if PEER.exists() else None
    ways = {
        "rfsg, images": (ours, f"images 1 3 {WORK}/3.npy"),
        "rfsg, images, 2 reflections": (ours, f"images 1 2 {WORK}/2.npy"),
    }
    turns = dict.fromkeys(ways, runs + 1)
    for count in (PEER_RAYS, peer_rays) if peer is not None else ():
        if count:
            ways[name := f"Sionna RT, {count:,} rays"] = (peer, f"{count} {WORK}/s{count}.npy")
            turns[name] = runs + 1 if count < MANY else FEW + 1
    if rays:
        ways[name := f"rfsg, {rays:,} rays"] = (ours, f"rays {rays} 3 {WORK}/r{rays}.npy")
        turns[name] = runs + 1 if rays < MANY else FEW + 1
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for turn in range(runs + 1):
        for name, (server, line) in ways.items():
            if turn < turns[name]:
                times[name].append(server.ask(line))
        print({n: t[-1] for n, t in times.items()}, file=sys.stderr, flush=True)
    for server in (ours, peer):
        if server is not None:
            server.close()
    truth, drawn = _truth()
    head = ("way", "first [s]", "then [s]", "processor [s]", "median error [dB]")
    head = (*head, "95 % within [dB]", "wrongly lit or dark")
    lines = [_row(head), _row(("---",) * len(head))]
    for name, (first, *rest) in times.items():
        gain = np.load(ways[name][1].split()[-1]).reshape(-1)[drawn].astype(float)
        both = (gain > 0) & (truth > 0)
        off = 10 * np.log10(gain[both] / truth[both])
        wrong = int(((gain > 0) != (truth > 0)).sum())
        wall, processor = (_spread(x) for x in zip(*rest, strict=True))
        error = f"{np.median(off):.2g}", f"{np.quantile(np.abs(off), 0.95):.2g}"
        lines.append(
            _row((name, f"{first[0]:.3g}", wall, processor, *error, f"{wrong} of {len(drawn)}"))
        )
    print(*lines, sep="\n")
    return lines


def _row(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"


def _spread(values: tuple[float, ...]) -> str:
    return f"{statistics.median(values):.3g} ({min(values):.3g} to {max(values):.3g})"


def _truth():  # noqa: ANN202
    """Exact incoherent sums at some cells' middles, and which cells."""
    import cases
    import numpy as np
    import rfsg_side

    import rfsg
    from rfsg.tracer.channel import power

    case = cases.named(CASE)
    scene = rfsg_side.build(case)
    nx, ny = (int(s / CELL) for s in SIZE)
    drawn = np.random.default_rng(0).choice(nx * ny, DRAWN, replace=False)
    row, column = np.divmod(drawn, nx)
    x, y = ((k + 0.5) * CELL - s / 2 for k, s in ((column, SIZE[0]), (row, SIZE[1])))
    radios = [rfsg.Radio.at(f"/c{i}", *p, HEIGHT) for i, p in enumerate(zip(x, y, strict=True))]
    quality = rfsg.Quality(depth=case.depth, floor_db=case.floor_db)
    result = rfsg.simulate(scene.with_receivers(radios), quality=quality)
    return power(result.channel, 1, DRAWN)[0, :, 0].numpy(), drawn


# memory


def memory() -> list[str]:
    """Peak memory of a map of a million cells, each method in a process of its own: a table."""
    lines = [
        "| method | cells | s | peak memory [MiB] | before the map [MiB] |",
        "| --- | --- | --- | --- | --- |",
    ]
    print(*lines, sep="\n")
    for method in ("rays", "images", "paths"):
        done = subprocess.run(
            [sys.executable, __file__, "--serve", f"peak-{method}"], stdout=subprocess.PIPE,
            text=True, check=True, env=os.environ | {"PYTHONPATH": str(HERE.parent)},
        )  # fmt: skip
        lines.append(done.stdout.strip())
        print(lines[-1], flush=True)
    return lines


def peak(method: str) -> None:
    import cases
    import rfsg_side

    import rfsg

    case = cases.named(CASE)
    depth = 1 if method == "paths" else case.depth
    quality = rfsg.Quality(depth=depth, floor_db=case.floor_db)
    scene, bounds = rfsg_side.build(case), (-90.0, -60.0, 90.0, 60.0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    start = time.perf_counter()
    found = rfsg.radio_map(
        scene, quality=quality, method=method, height=HEIGHT, cell=0.147, bounds=bounds
    )
    seconds = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    cells = found.path_gain.shape[1] * found.path_gain.shape[2]
    print(f"| {method}, depth {depth} | {cells:,} | {seconds:.3g} | {after:,} | {before:,} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rays", type=int, default=0, help="rfsg's rays as well: so many")
    parser.add_argument("--peer-rays", type=int, default=0, help="Sionna's once more: so many")
    parser.add_argument("--memory", action="store_true", help="a million cells: peak memory")
    parser.add_argument("--write-docs", action="store_true", help=f"a section of {PAGE.name}")
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve == "sionna":
        serve_sionna()
    elif options.serve == "rfsg":
        serve_rfsg()
    elif options.serve:
        peak(options.serve.removeprefix("peak-"))
    else:
        start = time.perf_counter()
        if options.memory:
            heading, lines = "## Memory of a map of a million cells", memory()
        else:
            heading = "## A radio map of a street"
            lines = compare(options.runs, options.threads, options.rays, options.peer_rays)
        if options.write_docs:
            import torch
            from machine import measured_on, write_section

            torch.set_num_threads(options.threads)
            seconds = time.perf_counter() - start
            write_section(
                PAGE, heading, SAID[heading].strip(), "", *lines, "", measured_on(seconds)
            )


if __name__ == "__main__":
    main()
