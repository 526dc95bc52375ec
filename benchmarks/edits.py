"""From an edit to the new channel: going on from the last result against a full run.

    OMP_NUM_THREADS=1 python benchmarks/edits.py [--write-docs] [--minutes 11]

A hall with six concrete walls and upright boxes of metal, wood and glass in it; receivers anywhere.
Each row is one edit of the hall, answered once with the earlier result and once in full, by turns, in
seconds of the processor; ratios are of each such pair. Where a full run takes more than ``PATIENCE``,
one pair is measured, and of the edits two where the table is to hold many. Where the time that is left
does not do for a row's full run, the row is left out and named. The two answers are compared: as many
paths, the same path gains.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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
from rfsg.tracer.incremental import Redone
from rfsg.tracer.simulate import Result, simulate

DOCS = ROOT / "docs" / "edits.md"
SIZE = (20.0, 14.0, 3.0)  # [m] of a hall of 20 objects; its floor grows with them
WALL = 0.1  # [m], half the thickness of a wall
PATIENCE = 2.5  # [s] of a full run
FIRST = ("move", "material")  # the edits that are measured however long a full run takes
LAST = "move a receiver"  # in the details alone: no thing that is edited
# receivers at most, where a full run of more takes minutes, and gigabytes
MOST = {("standard", 200): 1}
ASKED = {("standard", 1000, 20, "move"): 5}  # pairs for the figure that is asked for
SAME = 1e-9  # of a gain: what a full run may differ by
SAID = """# From an edit to the new channel

Written by `OMP_NUM_THREADS=1 python benchmarks/edits.py --write-docs`.

`result.after(scene)`, or `simulate(scene, previous=result)`, does again what an edit changes, and keeps
the rest. The answer is a full run's: the same paths, gains to 1e-9 (`tests/tracer/test_incremental.py`,
200 random edits). Of one box or receiver in a hall with walls and upright boxes, one transmitter: seconds
of the processor after the edit -> of a full run, and their ratio.
"""
WHY = """## What an edit costs

- The paths that meet what changed, where it was or where it is: found, traced and evaluated again.
- A material: no search and no geometry, the field of the paths that meet it.
- The search for what is new: of planar faces it follows sequences to their last face only where they
  meet something new (`rfsg.tracer.renewed`). Where a power floor drops sequences, or among curved and
  learned faces, it looks at all beginnings again; where rays are launched, it launches all of them.
- Whatever the edit: the scene as tensors, and copies of what is kept. In small scenes, most of it.

## In detail

Medians of pairs by turns, and the range of the ratios; one pair where a full run is long. Each pair moves
another box. *Kept*,
*evaluated*, *traced*: paths of which nothing was done, whose field was evaluated again and, of these, that
were found or traced again (`result.redone`).
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
    """Edits, another one for each number: ``move`` takes another box each time, the rest the last one."""
    last, boxes = scene.nodes[-1], [n.path for n in scene.nodes if n.path.startswith("/box")]
    body = last.body
    beside = replace(last.pose, translation=last.pose.translation + 0.9)
    small = Body(Box((0.2, 0.3, 0.4)), Slab(itu="wood", thickness_m=0.4))
    return {
        "move": lambda k: scene.moved(boxes[-1 - 3 * k % len(boxes)], (0.3 + 0.1 * k, 0.2, 0.0)),
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


@dataclass(frozen=True)
class Row:
    """One edit of one hall: seconds and ratios of its pairs, and what the last of them did again."""

    quality: str
    receivers: int
    objects: int
    edit: str
    after: list[float]
    full: list[float]
    redone: Redone

    @property
    def ratio(self) -> list[float]:
        return [a / b for a, b in zip(self.after, self.full, strict=True)]

    def short(self) -> str:
        """A cell of the table above."""
        after, full, ratio = map(statistics.median, (self.after, self.full, self.ratio))
        return f"{after:.2g} -> {full:.2g}: {ratio:.0%}"

    def long(self) -> str:
        """A line of the table below."""
        after, full, ratio = map(statistics.median, (self.after, self.full, self.ratio))
        done = self.redone
        return (
            f"| {self.quality} | {self.receivers} | {self.objects} | {self.edit} | {after:.3f} "
            f"| {full:.2f} | {ratio:.1%} ({min(self.ratio):.1%} to {max(self.ratio):.1%}) "
            f"| {done.kept} | {done.evaluated} | {done.traced} |"
        )


def measured(
    scene: Scene, quality: str, name: str, edit: Callable[[int], Scene], before: Result, pairs: int
) -> Row:
    """One edit, another number for each pair."""
    after, full = [], []
    for k in range(pairs):
        edited = edit(k)
        some, found = timed(lambda s=edited: simulate(s, previous=before))
        every, whole = timed(lambda s=edited: simulate(s, quality=quality))
        compare(found, whole)
        after.append(some)
        full.append(every)
    assert found.redone is not None
    row = Row(quality, len(scene.receivers), len(scene.nodes), name, after, full, found.redone)
    print(row.long(), flush=True)
    return row


def compare(found: Result, full: Result) -> None:
    """Stop where an edit is not answered as a full run answers it."""
    a, b = found.path_gain(), full.path_gain()
    worst = float(((a - b).abs() / b.clamp(min=1e-300)).max()) if b.numel() else 0.0
    if len(found.paths.tx) != len(full.paths.tx) or worst > 1e3 * SAME:
        counts = (len(found.paths.tx), len(full.paths.tx))
        raise SystemExit(f"not the same: {counts} paths, path gains apart by {worst:.1e}")


def table(columns: Sequence[str]) -> str:
    """The head of a table."""
    return f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}"


def first_table(rows: list[Row]) -> str:
    """A line for each hall and quality, a column for each edit of a thing."""
    names = list(dict.fromkeys(r.edit for r in rows if r.edit != LAST))
    lines = [table(["quality", "receivers", "objects", *names])]
    halls = dict.fromkeys((r.quality, r.receivers, r.objects) for r in rows)
    for hall in halls:
        cells = {r.edit: r.short() for r in rows if (r.quality, r.receivers, r.objects) == hall}
        lines.append(f"| {' | '.join([*map(str, hall), *(cells.get(n, '') for n in names)])} |")
    return "\n".join(lines)


COLUMNS = "quality receivers objects edit after full ratio kept evaluated traced".split()


class Clock:
    """The time that the whole may take."""

    def __init__(self, minutes: float):
        self.begin, self.most = time.perf_counter(), 60.0 * minutes

    def spent(self) -> float:
        return time.perf_counter() - self.begin

    def left(self) -> float:
        return self.most - self.spent()


def write(rows: list[Row], left_out: list[str], clock: Clock) -> None:
    left = f"Left out for the time they take: {'; '.join(left_out)}.\n" * bool(left_out)
    details = "\n".join([table(COLUMNS), *(r.long() for r in rows)])
    said = measured_on(clock.spent())
    write_page(DOCS, SAID, first_table(rows), "", WHY, details, "", left, said)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--receivers", type=int, nargs="+", default=[1, 100, 1000])
    parser.add_argument("--objects", type=int, nargs="+", default=[5, 20, 200])
    parser.add_argument("--qualities", nargs="+", default=["draft", "standard"])
    parser.add_argument("--minutes", type=float, default=11.0, help="that all may take")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--write-docs", action="store_true")
    asked = parser.parse_args()
    clock, rows, left_out = Clock(asked.minutes), [], []
    torch.set_grad_enabled(False)
    for quality in asked.qualities:
        for objects in asked.objects:
            longest = 0.0
            for receivers in asked.receivers:
                many = receivers > MOST.get((quality, objects), receivers)
                if many or 3 * longest > clock.left():
                    left_out.append(f"{quality}, {receivers} receivers, {objects} objects")
                    continue
                scene = hall(objects, receivers)
                longest, before = timed(lambda s=scene, q=quality: simulate(s, quality=q))
                pairs = asked.pairs if longest < PATIENCE else 1
                for name, edit in edits(scene).items():
                    if longest > PATIENCE and name not in FIRST:
                        continue
                    if longest > clock.left():
                        left_out.append(
                            f"{quality}, {receivers} receivers, {objects} objects, {name}"
                        )
                        continue
                    times = ASKED.get((quality, receivers, objects, name), pairs)
                    rows.append(measured(scene, quality, name, edit, before, times))
                if asked.write_docs:  # what is measured so far
                    write(rows, left_out, clock)


if __name__ == "__main__":
    main()
