"""What the floor plan of tetam-ble is worth, term by term, by cross-validation on set_1 alone.

    python benchmarks/floor_plan.py --data DIR [--only NAME ...] [--write-docs]

DIR is the folder of tetam-ble (docs/tetam.md). The settings of ``learn/plan.py`` were chosen by such
tables; set_2 and the walks are not read. Three ways to hold places of set_1 out: a random fifth at a
time, a fifth of all squares of 3 m at a time, all but 20 places (5 draws). Each result is stored in
--work as soon as it is there.
"""

import argparse
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from learn import tetam
from learn.cases import DataError
from learn.methods import code
from learn.plan import SCENE, FloorPlan
from learn.plan_rays import lookup
from learn.store import write
from machine import ROOT
from numpy import ndarray

from rfsg.learn import baselines
from rfsg.learn.baselines import Method, Readings
from rfsg.learn.protocol import absolute_error
from rfsg.learn.residual import Residual
from rfsg.scene.scene import Scene
from rfsg.tracer.field import SPEED_OF_LIGHT

PAGE = ROOT / "docs" / "tetam.md"
BEGIN, END = "<!-- choice: written by benchmarks/floor_plan.py -->", "<!-- end of choice -->"
FOLDS, SQUARE, DRAWS = 5, 3.0, 5
WAYS = ("random fifth", "squares of 3 m", f"all but {tetam.FEW}")
Split = tuple[Bool[ndarray, "n"], Bool[ndarray, "n"]]


def splits(known: Readings, way: str) -> Iterator[Split]:
    """(train, held out) readings, by place. Seeds differ from those of the benchmark's cases."""
    places, of = np.unique(known.tx_position, axis=0, return_inverse=True)
    of = of.ravel()
    if way == WAYS[2]:
        for draw in range(DRAWS):
            order = np.random.default_rng(100 + draw).permutation(len(places))
            train = np.isin(of, order[: tetam.FEW])
            yield train, ~train
        return
    groups = np.arange(len(places))
    if way == WAYS[1]:
        square = np.floor(places[:, :2] / SQUARE)
        groups = np.unique(square, axis=0, return_inverse=True)[1].ravel()
    part = np.random.default_rng(7).permutation(groups.max() + 1)[groups][of] % FOLDS
    for fold in range(FOLDS):
        yield part != fold, part == fold


def variants(known: Readings, work: Path) -> dict[str, Callable[[], Method]]:
    """Name -> method. What costs time to make is made when it is asked for."""
    scene = Scene.from_usd(SCENE)

    def traced() -> Method:
        return FloorPlan(scene, rays=lookup(SCENE, known.tx_position, known.rx_position, work))

    def only_traced() -> Method:
        rays = lookup(SCENE, known.tx_position, known.rx_position, work)
        return FloorPlan(scene, reverberant=False, rays=rays)

    return {
        "log-distance": baselines.LogDistance,
        "joint kriging": baselines.JointKriging,
        "log-distance + residual": lambda: Residual(baselines.LogDistance(offsets=False)),
        "floor plan": lambda: FloorPlan(scene),
        "floor plan + residual": lambda: Residual(FloorPlan(scene)),
        "floor plan + common": lambda: Residual(FloorPlan(scene), answer="common"),
        "floor plan + residual, one level": lambda: Residual(FloorPlan(scene), counts=(1,)),
        "without objects": lambda: FloorPlan(scene, objects=False),
        "without patterns": lambda: FloorPlan(scene, pattern_db=0.0),
        "without reverberation": lambda: FloorPlan(scene, reverberant=False),
        "free space and offsets": lambda: FloorPlan(
            scene, objects=False, pattern_db=0.0, reverberant=False
        ),
        "with mirrors and edges": traced,
        "mirrors and edges for reverberation": only_traced,
        "one loss for all of a kind": lambda: FloorPlan(scene, own_db=1e-3),
        "losses twice as free": lambda: FloorPlan(scene, own_db=4.0),
        "patterns half as free": lambda: FloorPlan(scene, pattern_db=1.0),
        "patterns twice as free": lambda: FloorPlan(scene, pattern_db=4.0),
        "objects less blurred": lambda: FloorPlan(scene, blur_m=0.02),
        "objects more blurred": lambda: FloorPlan(scene, blur_m=0.15),
        "intercepted later": lambda: FloorPlan(scene, length_m=0.3),
    }


def errors(make: Callable[[], Method], known: Readings, way: str) -> list[float]:
    """|error| [dB] of every held-out reading."""
    method, found = make(), []
    for train, held in splits(known, way):
        asked = known.only(held)
        fitted = method.fit(known.only(train), 0)
        said = fitted.predict(asked.tx_position, asked.rx_position, asked.gateway)
        found.append(absolute_error(asked.rssi, said.mean))
    return np.concatenate(found).round(3).tolist()


def table(results: dict[str, dict[str, list[float]]]) -> str:
    """Markdown: a row per variant; median / 90th percentile / mean."""
    lines = ["| | " + " | ".join(WAYS) + " |", "|---" * (len(WAYS) + 1) + "|"]
    for name, by_way in results.items():
        cells = [
            f"{np.median(e):.2f} / {np.percentile(e, 90):.2f} / {np.mean(e):.2f}"
            for e in by_way.values()
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def learned(known: Readings) -> str:
    """What the floor plan learns of all of set_1, in a sentence."""
    plan = FloorPlan(Scene.from_usd(SCENE)).fit(known)
    loss = [v for path, v in plan.losses_db().items() if "/Columns/" in path]
    room = float(plan.value["reverberant"])
    free = 10.0 ** (-room / 20.0) * SPEED_OF_LIGHT / (4.0 * np.pi * plan.how.frequency_hz)
    return (
        f"From all of set_1: columns lose {min(loss):.1f} to {max(loss):.1f} dB; reverberation is "
        f"{room:.1f} dB, as strong as free space at {free:.0f} m; {plan.std:.1f} dB are left."
    )


def stored(name: str, make: Callable[[], Method], known: Readings, work: Path) -> dict:
    """By way, from the folder where it is there."""
    here, learn = Path(__file__).parent / "learn", Path(baselines.__file__).parents[1]
    sources = [here / "plan.py", here / "plan_rays.py", learn / "residual.py", learn / "levels.py"]
    told = "".join(code(path) for path in sources) + repr((FOLDS, SQUARE, DRAWS))
    key = hashlib.sha256(told.encode()).hexdigest()[:12]
    path = work / f"{name.replace(' ', '_')}-{key}.json"
    if not path.is_file():
        begin = time.perf_counter()
        found = {way: errors(make, known, way) for way in WAYS}
        write(path, json.dumps(found) + "\n")
        print(f"{name}: {time.perf_counter() - begin:.0f} s", flush=True)
    return json.loads(path.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of tetam-ble")
    parser.add_argument("--only", nargs="+", default=(), help="names of rows")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "floor_plan", help="results")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--write-docs", action="store_true", help="write docs/tetam.md too")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        known = tetam.readings(options.data, "set_1")
    except DataError as fault:
        parser.error(str(fault))
    rows = variants(known, options.work)
    unknown = sorted(set(options.only) - set(rows))
    if unknown:
        parser.error(
            f"--only {', '.join(unknown)}: no such row; expected some of {', '.join(rows)}"
        )
    chosen = {n: make for n, make in rows.items() if not options.only or n in options.only}
    results = {n: stored(n, make, known, options.work) for n, make in chosen.items()}
    text = f"{table(results)}\n\n{learned(known)}"
    print(text)
    if options.write_docs:
        head, rest = PAGE.read_text().split(BEGIN)
        write(PAGE, f"{head}{BEGIN}\n\n{text}\n\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
