"""The path solver on scenes of flat faces, beside Sionna RT where it is installed.

    make -C benchmarks/peers venv        # once, for the peer; without it rfsg is measured alone
    python benchmarks/solver.py [--rounds 3] [--threads 2] [--write-docs] [JOB ...]

Every job runs in a process of its own, the two sides in turn; a process answers once (the first call)
and then twice more (steady). ``process``: from its start to its first answer, scene and imports
included. CPU seconds of a steady call, all threads, say more on a machine that others use. ``paths``
are held against the exhaustive image method. Prints a table in Markdown: medians, least and most in
brackets.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent / "peers"  # its scenes, and the way to drive each side
PEER = HERE / ".venv" / "bin" / "python"
sys.path.insert(0, str(HERE))

import cases  # noqa: E402

PAGE = HERE.parents[1] / "docs" / "performance.md"
SAID = """
Written by `python benchmarks/solver.py --write-docs`: a transmitter in an empty room of six concrete
slabs, or in a street canyon, and so many receivers at random; paths against the exhaustive image method.
Both sides run in turn, each job in a process of its own. *process* is from its start to its first answer.
Sionna RT, which tries every ray on every receiver, is given 10,000 rays for 1000 receivers and 100,000
for 100: with its default of a million three calls for 1000 receivers were not done after 100 s.
"""
STEADY = 2  # calls after the first
RECEIVERS = (10, 100, 1_000, 10_000)


def room(count: int, depth: int) -> cases.Case:
    places = np.random.default_rng(0).uniform([0.1] * 3, [5.9, 3.9, 2.9], (count, 3))
    receivers = tuple(tuple(p) for p in places.tolist())
    return replace(cases.rooms()[0], receivers=receivers, depth=depth)


def canyon(count: int, depth: int) -> cases.Case:
    places = np.random.default_rng(0).uniform([-60.0, -7.5, 1.0], [60.0, 8.5, 6.0], (count, 3))
    receivers = tuple(tuple(p) for p in places.tolist())
    return replace(cases.canyons()[0], receivers=receivers, depth=depth)


# name: (case, whether the gradient of all received power to a wall's permittivity is asked for)
JOBS = {
    "room, 1000 Rx, depth 3": (room(1000, 3), False),
    "room, 1000 Rx, depth 5": (room(1000, 5), False),
    "canyon, 100 Rx, depth 3": (canyon(100, 3), False),
    "gradient, 100 Rx, depth 3": (room(100, 3), True),
} | {f"room, {n} Rx, depth 3 ": (room(n, 3), False) for n in RECEIVERS}
ALONE = tuple(f"room, {n} Rx, depth 3 " for n in RECEIVERS)  # growth with receivers: rfsg's own


def exhaustive(name: str) -> int:
    """How many paths there are: in an empty room one for each image (an octahedron of them), in a
    canyon those of the image method over all sequences of faces."""
    case = JOBS[name][0]
    if "room" in name or "gradient" in name:
        d = case.depth
        return len(case.receivers) * (2 * d + 1) * (2 * d * d + 2 * d + 3) // 3
    import truth

    return len(truth.images(case).rx)


# the sides, each in a process of its own


def rfsg_side(case: cases.Case, gradient: bool):
    """(answer, paths): a call that traces the case anew, and how many paths it returned."""
    from rfsg import Body, simulate  # as a script begins: what these load is loaded by rfsg

    import rfsg_side as side  # isort: skip
    import torch

    import rfsg
    from rfsg.objects.surfaces.slab import Slab

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    scene = side.build(case)
    quality = rfsg.Quality(depth=case.depth, floor_db=case.floor_db)
    if not gradient:
        return lambda: len(simulate(scene, quality=quality).paths.tx)
    wall, *others = scene.nodes
    surface = Slab(0.1, eps_r=5.24, sigma=0.1)
    scene = replace(scene, nodes=(replace(wall, body=Body(wall.body.shape, surface)), *others))
    eps_r = surface.medium.eps_r.requires_grad_(True)
    kept = simulate(scene, quality=quality).chains

    def answer() -> int:
        result = simulate(scene, quality=quality, gradients=True, chains=kept)
        result.path_gain().sum().backward()
        assert eps_r.grad is not None
        return len(result.paths.tx)

    return answer


def sionna_side(case: cases.Case, gradient: bool):
    import drjit as dr
    import sionna_side as side

    threads = int(os.environ["OMP_NUM_THREADS"])
    if threads < (os.cpu_count() or 1):
        dr.set_thread_count(threads)
    rt, scene = side.rt, side.build(case)
    samples = 10_000 if len(case.receivers) >= 1000 else 100_000
    solver = rt.PathSolver()
    if gradient:
        solver.loop_mode = "evaluated"
        wall = rt.RadioMaterial(
            "wall", relative_permittivity=5.24, conductivity=0.1, thickness=0.1, color=(0.5,) * 3
        )
        scene.objects[case.things[0].name].radio_material = wall

    def answer() -> int:
        if gradient:
            dr.enable_grad(wall.relative_permittivity)
        paths = solver(scene, max_depth=case.depth, samples_per_src=samples, refraction=False)
        if gradient:
            real, imaginary = paths.a
            dr.backward(dr.sum(dr.square(real.array) + dr.square(imaginary.array)))
            assert np.isfinite(np.array(dr.grad(wall.relative_permittivity))).all()
        return int(paths.valid.numpy().sum())

    return answer


def one_side(side: str, name: str, calls: int) -> None:
    """Answer ``calls`` times and say how long each took."""
    prepare = {"rfsg": rfsg_side, "sionna": sionna_side}[side]
    answer = prepare(*JOBS[name])
    seconds, cpu, paths = [], [], 0
    for _ in range(calls):
        start, begin = time.perf_counter(), time.process_time()
        paths = answer()
        seconds.append(time.perf_counter() - start)
        cpu.append(time.process_time() - begin)
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"seconds": seconds, "cpu": cpu, "paths": paths, "peak": peak}))


# the comparison


def measured(side: str, name: str, threads: int) -> dict:
    """One process that answers and ends, and one that goes on."""
    python = PEER if side == "sionna" else Path(sys.executable)
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    environment.pop(
        "PYTHONDONTWRITEBYTECODE", None
    )  # both compiled once, as an installed package is
    command = [str(python), __file__, "--side", side, name]

    def run(calls: int) -> dict:
        said = subprocess.run(
            [*command, "--calls", str(calls)], check=True, stdout=subprocess.PIPE, env=environment
        )
        return json.loads(said.stdout.splitlines()[-1])

    start = time.perf_counter()
    run(1)
    process = time.perf_counter() - start
    said = run(1 + STEADY)
    return said | {
        "process": process,
        "first": said["seconds"][0],
        "steady": statistics.median(said["seconds"][1:]),
        "cpu": statistics.median(said["cpu"][1:]),
    }


def row(name: str, side: str, rounds: list[dict], there_are: int) -> str:
    def spread(key: str) -> str:
        values = sorted(r[key] for r in rounds)
        return f"{statistics.median(values):.3g} ({values[0]:.3g} to {values[-1]:.3g})"

    times = " | ".join(spread(k) for k in ("steady", "cpu", "first", "process"))
    memory = max(r["peak"] for r in rounds) / 2**30
    return (
        f"| {name.strip()} | {side} | {times} | {rounds[-1]['paths']} of {there_are} "
        f"| {memory:.2f} |"
    )


def compare(names: list[str], rounds: int, threads: int) -> list[str]:
    """A table's lines, each printed as soon as it is there."""
    sides = ["rfsg", "sionna"] if PEER.exists() else ["rfsg"]
    lines = [
        "| job | side | steady [s] | CPU [s] | first call [s] | process [s] | paths | peak [GiB] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print(*lines, sep="\n")
    for name in names:
        mine = sides[:1] if name in ALONE else sides
        found: dict[str, list[dict]] = {side: [] for side in mine}
        for _ in range(rounds):
            for side in mine:
                found[side].append(measured(side, name, threads))
        there_are = exhaustive(name)
        for side in mine:
            lines.append(row(name, side, found[side], there_are))
            print(lines[-1], flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("jobs", nargs="*", metavar="JOB", help=f"of {', '.join(JOBS)}")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--write-docs", action="store_true", help=f"a section of {PAGE.name}")
    parser.add_argument("--side", choices=("rfsg", "sionna"), help=argparse.SUPPRESS)
    parser.add_argument("--calls", type=int, default=1, help=argparse.SUPPRESS)
    options = parser.parse_args()
    names = options.jobs or list(JOBS)
    unknown = [n for n in names if n not in JOBS]
    if unknown:
        parser.error(f"job {unknown[0]!r}: expected one of {', '.join(JOBS)}")
    if options.side:
        one_side(options.side, names[0], options.calls)
    else:
        start = time.perf_counter()
        lines = compare(names, options.rounds, options.threads)
        if options.write_docs:
            import torch  # not in the peer's environment
            from machine import measured_on, write_section

            torch.set_num_threads(options.threads)
            seconds = time.perf_counter() - start
            write_section(
                PAGE, "## The path solver", SAID.strip(), "", *lines, "", measured_on(seconds)
            )


if __name__ == "__main__":
    main()
