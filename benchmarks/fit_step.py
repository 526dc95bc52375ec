"""Time of a fit's step: four links of the laboratory, by what is learned of the cabinet.

    python benchmarks/fit_step.py [--quality draft] [--steps 60]

Cases take turns of ``TURN`` steps, so that a busy machine is as busy for all of them and each has its
caches to itself, as in a fit. Searches are not counted: where
only surfaces are learned there is one, elsewhere one every ``refresh`` steps.
"""

import argparse
import statistics
import time
from pathlib import Path

import torch

import rfsg
from rfsg.learn.links import link_up
from rfsg.learn.selection import select
from rfsg.learn.training import Settings, Training
from rfsg.objects.surfaces.stochastic import StochasticSurface

LAB = Path(__file__).parents[1] / "assets" / "scenes" / "lab.usda"
CABINET = "/World/Cabinet"
TURN = 20
CASES = {
    "surface": [f"{CABINET}.surface"],
    "shape and surface": [CABINET],
    "pose": [f"{CABINET}.pose"],
    "known material (doors and walls)": ["/World/Partition/*.surface", "/World/Door.surface"],
}


def begun(scene: rfsg.Scene, patterns: list[str], quality: rfsg.Quality) -> tuple[Training, float]:
    """A fit after its first search, and how long that took [s]."""
    receivers = [r.path for r in scene.receivers]
    measured = rfsg.Measurements.of(
        rx=receivers, rssi_dbm=[-50.0] * len(receivers), frequency_hz=scene.frequency
    )
    links = link_up(scene, measured)
    selection = select(scene, patterns, frequency=scene.frequency)
    held = torch.zeros(len(measured), dtype=torch.bool)
    training = Training(scene, selection, measured, links, held, Settings(quality=quality))
    began = time.perf_counter()
    training.search()
    return training, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args()
    scene = rfsg.Scene.from_usd(LAB)
    body = rfsg.Body(scene.node(CABINET).body.shape, StochasticSurface())
    scene = scene.replaced(CABINET, body)
    quality = rfsg.Quality.named(options.quality)
    runs = {name: begun(scene, patterns, quality) for name, patterns in CASES.items()}
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(0, options.steps, TURN):
        for name, (training, _) in runs.items():
            for step in range(turn, min(turn + TURN, options.steps)):
                began = time.process_time()
                training.step(step)
                spent[name].append(1e3 * (time.process_time() - began))
    print(f"{torch.get_num_threads()} threads, {options.quality}, {len(scene.receivers)} links")
    for name, (training, search) in runs.items():
        kept = training.kept
        assert kept is not None
        ms = [1e3 * s for s in training.seconds[5:]]
        low, _, high = statistics.quantiles(ms, n=4)
        print(
            f"{name:34} mean {statistics.mean(ms):6.1f} ms, median {statistics.median(ms):6.1f} ms "
            f"(quartiles {low:.1f} to {high:.1f}), "
            f"CPU {statistics.median(spent[name][5:]):.1f} ms; "
            f"{int(kept.live.sum())} of {len(kept.link)} paths live, {int(kept.traced.sum())} "
            f"solved again; search {search:.1f} s"
        )


if __name__ == "__main__":
    main()
