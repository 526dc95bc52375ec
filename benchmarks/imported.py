"""Sionna RT's bundled scenes, imported: how large, how long, how much memory, and the same paths?

    python -m benchmarks.imported [--scenes FOLDER] [--peer PYTHON] [--only NAME ...] [--write-docs]

The page is written from the last run of every scene, which are kept in build/imported.

Each scene is imported, loaded and simulated in a process of its own. The small ones are also traced by
Sionna RT itself, in its own environment (benchmarks/peers), from the same XML and the same places; what
is compared is the line of sight and mirrors, up to three, that go through nothing: path by path.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PEER = ROOT / "benchmarks" / "peers" / ".venv" / "bin" / "python"
SCENES = PEER.parents[1] / "lib" / "python3.11" / "site-packages" / "sionna" / "rt" / "scenes"
PAGE = ROOT / "docs" / "import.md"
STORE = ROOT / "build" / "imported"  # a row of the table for each scene, from its last run
HEADING = "## Sionna RT's scenes"
FREQUENCY, DEPTH = 3.5e9, 3
SAME_DELAY, SAME_WAY = 2e-11, 2e-3  # [s], [rad] two paths are one: 6 mm, and a tenth of a degree

Place = tuple[float, float, float]
# transmitter, receivers; compared path by path where the third is true
CASES: dict[str, tuple[Place, list[Place], bool]] = {
    "box": ((-2.1, 1.3, 1.7), [(2.4, -1.2, 1.1), (3.3, 3.1, 2.9), (-3.7, -2.6, 0.6)], True),
    "box_knife": ((-2.1, 1.3, 1.7), [(2.4, -1.2, 1.1), (3.3, 3.1, 2.9)], True),
    "box_one_screen": ((-2.1, 1.3, 1.7), [(-3.4, -1.2, 1.1), (3.3, 3.1, 2.9)], True),
    "box_two_screens": ((-2.1, 1.3, 1.7), [(-3.4, -1.2, 1.1), (3.3, 3.1, 2.9)], True),
    "floor_wall": ((1.3, 0.4, 2.3), [(1.7, -0.9, 1.2), (0.8, 1.1, 0.5), (1.9, 0.2, 2.6)], True),
    "simple_reflector": ((0.6, 0.2, 2.0), [(-0.5, 0.1, 1.7), (0.3, -0.4, -1.1)], True),
    "double_reflector": ((-8.0, 1.2, 5.0), [(-1.1, 0.3, 4.2), (-4.0, -2.0, 2.0)], True),
    "triple_reflector": ((-8.0, 0.1, 5.0), [(12.0, 0.15, 6.0), (2.0, 1.0, 3.0)], True),
    "simple_wedge": ((20.0, 10.0, 1.0), [(-10.0, 5.0, 0.0), (30.0, 12.0, 2.0)], True),
    "simple_street_canyon": (
        (-33.0, 1.5, 25.0),
        [(20.0, -2.0, 1.5), (45.0, 5.0, 2.0), (0.0, 8.0, 1.5), (70.0, -6.0, 1.5)],
        True,
    ),
    "simple_street_canyon_with_cars": (
        (-33.0, 1.5, 25.0),
        [(20.0, -2.0, 2.5), (45.0, 5.0, 3.0), (0.0, 8.0, 2.5)],
        True,
    ),
    "etoile": ((0.0, 60.0, 30.0), [(30.0, 120.0, 1.5), (-80.0, 100.0, 1.5)], False),
    "munich": ((8.5, 21.0, 27.0), [(45.0, 90.0, 1.5), (30.0, 60.0, 1.5)], False),
    "florence": ((0.0, 0.0, 60.0), [(40.0, 30.0, 20.0), (-30.0, 50.0, 20.0)], False),
    "san_francisco": ((0.0, 0.0, 150.0), [(60.0, 30.0, 60.0), (-50.0, 80.0, 60.0)], False),
}


# one scene, in a process of its own


def ours(name: str, folder: Path) -> dict[str, Any]:
    """Import, load and simulate; processor seconds, sizes and paths that go through nothing."""
    import resource
    from dataclasses import replace

    import torch

    from rfsg.scene.importers import import_scene
    from rfsg.scene.scene import Scene
    from rfsg.tracer.plan import Quality
    from rfsg.tracer.simulate import simulate

    torch.set_num_threads(1)
    import_module("rfsg.scene.usd.importing")  # before anything is timed
    tx, rx, compared = CASES[name]
    with tempfile.TemporaryDirectory() as made:
        out = Path(made) / f"{name}.usdc"
        begin = time.process_time()
        report = import_scene(
            folder / name / f"{name}.xml", out, tx=[tx], rx=rx, frequency=FREQUENCY
        )
        imported = time.process_time()
        scene = Scene.from_usd(out)
        loaded = time.process_time()
    radios = [
        tuple(replace(r, polarization="V") for r in some)
        for some in (scene.transmitters, scene.receivers)
    ]
    scene = scene.with_transmitters(radios[0]).with_receivers(radios[1])
    quality = Quality(depth=DEPTH) if compared else Quality.named("draft")
    start = time.process_time()
    result = simulate(scene, quality=quality)
    done = time.process_time()
    gain = result.channel.gain[:, 0]
    clear = torch.ones(len(gain), dtype=torch.bool)
    clear[result.channel.crossed[:, 0]] = False
    wave = torch.exp(-2j * torch.pi * FREQUENCY * result.channel.delay)
    return {
        "objects": report.objects,
        "triangles": report.triangles,
        "import": imported - begin,
        "load": loaded - imported,
        "simulate": done - start,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "found": len(gain),
        "search": "all faces" if result.search.complete else f"{result.search.rays} rays",
        "paths": {
            "rx": result.paths.rx[clear].tolist(),
            "delay": result.channel.delay[clear].tolist(),
            "gain": gain[clear].abs().tolist(),
            "wave": torch.view_as_real((gain * wave)[clear]).tolist(),
            "departure": result.channel.departure[clear].tolist(),
        },
    }


def theirs(name: str, folder: Path) -> dict[str, Any]:
    """The same places in the same XML, by Sionna RT."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    import numpy as np
    import sionna.rt as rt

    tx, rx, _ = CASES[name]
    scene = rt.load_scene(str(folder / name / f"{name}.xml"))
    scene.frequency = FREQUENCY
    array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.tx_array = scene.rx_array = array
    scene.add(rt.Transmitter("tx", position=mi.Point3f(*tx)))
    for k, place in enumerate(rx):
        scene.add(rt.Receiver(f"rx{k}", position=mi.Point3f(*place)))
    paths = rt.PathSolver()(scene, max_depth=DEPTH, refraction=False)
    row, column = np.nonzero(paths.valid.numpy()[:, 0])
    real, imaginary = (x.numpy()[row, 0, 0, 0, column].astype(float) for x in paths.a)
    tau, theta, phi = (
        x.numpy()[row, 0, column].astype(float) for x in (paths.tau, paths.theta_t, paths.phi_t)
    )
    sine = np.sin(theta)
    way = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], -1)
    wave = (real + 1j * imaginary) * np.exp(-2j * np.pi * FREQUENCY * tau)
    return {
        "rx": row.tolist(),
        "delay": tau.tolist(),
        "gain": np.hypot(real, imaginary).tolist(),
        "wave": np.stack([wave.real, wave.imag], -1).tolist(),
        "departure": way.tolist(),
    }


# comparing


def agreement(mine: dict[str, Any], other: dict[str, Any], receivers: int) -> dict[str, Any]:
    """Paths of each, how many are common, and by how much common paths and path gains differ [dB]."""
    import numpy as np

    a, b = ({k: np.array(v) for k, v in x.items()} for x in (mine, other))
    taken, apart = set(), []
    for i in range(len(a["rx"])):
        near = (a["rx"][i] == b["rx"]) & (np.abs(a["delay"][i] - b["delay"]) < SAME_DELAY)
        cosine = b["departure"].reshape(-1, 3) @ a["departure"][i]
        near &= np.arccos(np.clip(cosine, -1, 1)) < SAME_WAY
        free = [j for j in np.flatnonzero(near) if j not in taken]
        if free:
            taken.add(free[0])
            if min(a["gain"][i], b["gain"][free[0]]) > 0:
                apart.append(20 * np.log10(a["gain"][i] / b["gain"][free[0]]))
    links = []
    for r in range(receivers):
        power = [abs((x["wave"].reshape(-1, 2)[x["rx"] == r] @ [1, 1j]).sum()) ** 2 for x in (a, b)]
        if min(power) > 0:
            links.append(10 * np.log10(power[0] / power[1]))
    return {
        "ours": len(a["rx"]),
        "theirs": len(b["rx"]),
        "common": len(taken),
        "most_db": max(map(abs, apart), default=float("nan")),
        "link_db": max(map(abs, links), default=float("nan")),
    }


def run(python: Path, side: str, name: str, folder: Path) -> dict[str, Any]:
    """One side of one scene in a process of its own."""
    command = [str(python), str(Path(__file__)), "--side", side, "--only", name]
    done = subprocess.run(
        [*command, "--scenes", str(folder)], cwd=ROOT, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{name}, {side}: {done.stderr.strip().splitlines()[-1:]}")
    return json.loads(done.stdout.splitlines()[-1])


def table(rows: list[dict[str, Any]]) -> str:
    head = (
        "| scene | objects | triangles | import s | load s | simulate s | peak MiB | search | paths | "
        "both / ours / theirs | most apart | link |"
    )
    lines = [head, "|---" * 12 + "|"]
    for row in rows:
        seconds = " | ".join(f"{row[k]:.2f}" for k in ("import", "load", "simulate"))
        with_peer = "| not compared | | |"
        if "common" in row:
            with_peer = (
                f"| {row['common']} / {row['ours']} / {row['theirs']} | {row['most_db']:.3f} dB | "
                f"{row['link_db']:.3f} dB |"
            )
        lines.append(
            f"| {row['scene']} | {row['objects']} | {row['triangles']} | {seconds} | "
            f"{row['peak_mib']:.0f} | {row['search']} | {row['found']} {with_peer}"
        )
    return "\n".join(lines)


NOTES = f"""
`python -m benchmarks.imported --write-docs`: every scene in a process and on a thread of its own, at
{FREQUENCY / 1e9:g} GHz, one transmitter and two to four receivers. Small scenes at depth {DEPTH}, without
diffraction; cities as `draft`. Seconds are those of the processor, on one thread: what a clock on the
wall says where the machine has nothing else to do. Memory is the most that the whole process took, imports
included.

both / ours / theirs: paths over mirrors that go through nothing, found by both, by rfsg and by Sionna RT
on its own from the same XML, with isotropic antennas, vertically polarised. Two are one where their
delays agree to {SAME_DELAY * 1e12:g} ps and their departures to {SAME_WAY * 1e3:g} mrad. most apart: the
largest difference in level between the two of one path. link: the largest difference of coherent path
gain over those paths, over receivers.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=Path, default=SCENES, help="sionna/rt/scenes")
    parser.add_argument("--peer", type=Path, default=PEER, help="a Python that has sionna-rt")
    parser.add_argument("--only", nargs="*", choices=list(CASES), default=list(CASES))
    parser.add_argument("--write-docs", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--side", choices=["ours", "theirs"], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.side:
        side = ours if options.side == "ours" else theirs
        print(json.dumps(side(options.only[0], options.scenes)))
        return
    STORE.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        begin = time.perf_counter()
        row = {"scene": name} | run(Path(sys.executable), "ours", name, options.scenes)
        paths = row.pop("paths")
        if CASES[name][2] and options.peer.exists():
            peer = run(options.peer, "theirs", name, options.scenes)
            row |= agreement(paths, peer, len(CASES[name][1]))
        row["seconds"] = time.perf_counter() - begin
        (STORE / f"{name}.json").write_text(json.dumps(row))
        print(table([row]).splitlines()[-1], flush=True)
    if options.write_docs:
        from benchmarks.machine import measured_on, write_section

        files = [STORE / f"{name}.json" for name in CASES]
        rows = [json.loads(file.read_text()) for file in files if file.is_file()]
        seconds = sum(row["seconds"] for row in rows)
        write_section(PAGE, HEADING, table(rows), NOTES, measured_on(seconds))


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main()
