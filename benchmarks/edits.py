"""From an edit to the new channel: going on from the last result against a full run.

    OMP_NUM_THREADS=1 python benchmarks/edits.py [--write-docs] [--limit 20]

A hall with six concrete walls and upright boxes of metal, wood and glass in it; receivers anywhere.
Each row is one edit of the hall, answered once with the earlier result and once in full, by turns, in
seconds of the processor; ratios are of each such pair. Where a full run takes more than ``PATIENCE``,
two edits and one pair are measured; where more than ``--limit``, nothing. The two answers are compared:
as many paths, the same path gains.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from machine import ROOT, measured_on, write_page

from rfsg.objects.body import Body
from rfsg.objects.contract import Surface
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.simulate import Result, simulate

DOCS = ROOT / "docs" / "edits.md"
SIZE = (20.0, 14.0, 3.0)  # [m] of a hall of 20 objects; its floor grows with them
WALL = 0.1  # [m], half the thickness of a wall
PATIENCE = 2.5  # [s]
FIRST = ("move", "material")  # the edits that are measured always
SAME = 1e-9  # of a gain: what a full run may differ by
SAID = """# From an edit to the new channel

Written by `OMP_NUM_THREADS=1 python benchmarks/edits.py --write-docs`.

`result.after(scene)`, or `simulate(scene, previous=result)`, does again what an edit changes, and keeps
the rest; `result.redone` counts it. The answer is a full run's: the same paths, gains to 1e-9
(`tests/tracer/test_incremental.py`, 200 random edits). A hall with walls and upright boxes, one
transmitter. *After*, *full*: seconds of the processor, medians of pairs by turns. *Ratio*: of the pairs,
median and range, one pair where a full run is long. *Kept*, *evaluated*, *traced*: paths of which nothing
was done, whose field was evaluated again, and, of these, that were found or traced again.

An edit of one box costs what the paths that meet it cost, and a material no search at all. What is
paid whatever the edit: the scene as tensors, and copies of what is kept; in small scenes, that is most of
it. Where the search launches rays (many objects and mirrors), it launches all of them again.
"""


def hall(objects: int, receivers: int) -> Scene:
    """Six walls and boxes on the floor, none of them touching another."""
    draw = np.random.default_rng(objects)
    wide = max(1.0, (objects / 20) ** 0.5)
    size = np.array((wide * SIZE[0], wide * SIZE[1], SIZE[2]))
    nodes = []
    for axis, name in ((2, "z"), (0, "x"), (1, "y")):  # a floor before all
        for side in (0, 1):
            half, centre = 0.5 * size, 0.5 * size
            half[axis], centre[axis] = WALL, size[axis] + WALL if side else -WALL
            wall = Body(Box(half.tolist()), Slab(itu="concrete", thickness_m=2 * WALL))
            nodes.append(Node(f"/{name}{side}", wall, Pose.at(*centre.tolist())))
    nodes = nodes[: max(1, min(6, objects - 2))]
    places: list[np.ndarray] = []
    while len(nodes) < objects:
        place = draw.uniform((1.0, 1.0), size[:2] - 1.0)
        if any(np.linalg.norm(place - p) < 1.8 for p in places):
            continue
        places.append(place)
        half = draw.uniform((0.2, 0.2, 0.3), (0.6, 0.6, 1.0))
        pose = Pose.at(*place.tolist(), float(half[2]) + 1e-3, yaw_deg=float(draw.uniform(0, 90)))
        body = Body(Box(half.tolist()), _surface(draw, 2 * float(half.min())))
        nodes.append(Node(f"/box{len(places)}", body, pose))
    at = draw.uniform((0.3, 0.3, 0.8), size - (0.3, 0.3, 0.6), (receivers, 3)).tolist()
    tx = Radio.at("/tx", *(size[:2] * (0.31, 0.43)).tolist(), 2.6)
    return Scene(
        tuple(nodes), (tx,), tuple(Radio.at(f"/rx{i}", *p) for i, p in enumerate(at)), 2.4e9
    )


def _surface(draw: np.random.Generator, thickness: float) -> Surface:
    itu = str(draw.choice(["metal", "wood", "glass"]))
    return Conductor() if itu == "metal" else Slab(itu=itu, thickness_m=thickness)


def edits(scene: Scene) -> dict[str, Callable[[int], Scene]]:
    """Edits of the last box, another one for each number."""
    last = scene.nodes[-1]
    body = last.body
    beside = replace(last.pose, translation=last.pose.translation + 0.9)
    small = Body(Box((0.2, 0.3, 0.4)), Slab(itu="wood", thickness_m=0.4))
    return {
        "move": lambda k: scene.moved(last.path, (0.3 + 0.1 * k, 0.2, 0.0)),
        "material": lambda k: scene.replaced(
            last.path, Body(body.shape, Slab(itu="brick", thickness_m=0.2 + 0.01 * k))
        ),
        "swap": lambda k: scene.replaced(last.path, small),
        "remove": lambda k: scene.without(last.path),
        "add": lambda k: replace(scene, nodes=(*scene.nodes, Node(f"/new{k}", small, beside))),
        "move a receiver": lambda k: scene.with_receivers(
            [Radio.at(scene.receivers[0].path, 2.0 + 0.1 * k, 2.0, 1.5), *scene.receivers[1:]]
        ),
    }


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    begin = time.process_time()
    result = work()
    return time.process_time() - begin, result


def row(
    scene: Scene, quality: str, name: str, edit: Callable[[int], Scene], before: Result, pairs: int
) -> str:
    """One line of the table."""
    after, full, ratios, redone = [], [], [], None
    for k in range(pairs):
        edited = edit(k)
        some, found = timed(lambda s=edited: simulate(s, previous=before))
        every, whole = timed(lambda s=edited: simulate(s, quality=quality))
        compare(found, whole)
        after.append(some)
        full.append(every)
        ratios.append(some / every)
        redone = found.redone
    assert redone is not None
    low, high = min(ratios), max(ratios)
    search = "enumerated" if before.search.enumerated else "rays"
    line = (
        f"| {quality} | {len(scene.receivers)} | {len(scene.nodes)} | {name} | {search} "
        f"| {statistics.median(after):.3f} | {statistics.median(full):.2f} "
        f"| {statistics.median(ratios):.1%} ({low:.1%} to {high:.1%}) "
        f"| {redone.kept} | {redone.evaluated} | {redone.traced} |"
    )
    print(line, flush=True)
    return line


def compare(found: Result, full: Result) -> None:
    """Stop where an edit is not answered as a full run answers it."""
    a, b = found.path_gain(), full.path_gain()
    worst = float(((a - b).abs() / b.clamp(min=1e-300)).max()) if b.numel() else 0.0
    if len(found.paths.tx) != len(full.paths.tx) or worst > 1e3 * SAME:
        counts = (len(found.paths.tx), len(full.paths.tx))
        raise SystemExit(f"not the same: {counts} paths, path gains apart by {worst:.1e}")


COLUMNS = "quality receivers objects edit search after full ratio kept evaluated traced".split()
HEAD = f"| {' | '.join(COLUMNS)} |\n|{' --- |' * len(COLUMNS)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--receivers", type=int, nargs="+", default=[1, 100, 1000])
    parser.add_argument("--objects", type=int, nargs="+", default=[5, 20, 200])
    parser.add_argument("--qualities", nargs="+", default=["draft", "standard"])
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of a full run")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--write-docs", action="store_true")
    asked, begin, lines = parser.parse_args(), time.perf_counter(), [HEAD]
    torch.set_grad_enabled(False)
    slow: list[str] = []

    def write() -> None:
        left = f"Left out, a full run takes too long: {'; '.join(slow)}." * bool(slow)
        said = measured_on(time.perf_counter() - begin)
        write_page(DOCS, SAID, "\n".join(lines), "", left, "", said)

    for objects in asked.objects:
        for quality in asked.qualities:
            for receivers in asked.receivers:
                scene = hall(objects, receivers)
                taken, before = timed(lambda s=scene, q=quality: simulate(s, quality=q))
                if taken > asked.limit:
                    slow.append(
                        f"{quality}, {receivers} receivers, {objects} objects: {taken:.0f} s"
                    )
                    break  # more receivers take longer
                pairs = asked.pairs if taken < PATIENCE else 1
                for name, edit in edits(scene).items():
                    if taken < PATIENCE or name in FIRST:
                        lines.append(row(scene, quality, name, edit, before, pairs))
                if asked.write_docs:  # what is measured so far
                    write()


if __name__ == "__main__":
    main()
