"""Predict a real laboratory: 12 fixed sensors, one beacon at 126 places and along 9 walks.

    python benchmarks/tetam.py --data DIR [--quality standard] [--out DIR] [--write-docs]

DIR is the tetam-ble data set (docs/tetam.md says where it comes from, and the protocol). Each
predictor gives path gain up to constants: one unknown gain per sensor, fitted on the places of
set_1, and one per beacon, fitted on the links that are scored. Nothing else is fitted, but for the
exponent of the log-distance law. ``--baseline-only`` needs no ray tracing.
"""

import argparse
import csv
import json
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Int
from numpy import ndarray

if TYPE_CHECKING:
    from rfsg.scene.scene import Scene
    from rfsg.tracer.plan import Quality

ROOT = Path(__file__).resolve().parents[1]
SCENE = ROOT / "assets" / "scenes" / "tetam_lab.usda"
PAGE = ROOT / "docs" / "tetam.md"
PICTURES = ROOT / "docs" / "images"
BEGIN, END = "<!-- results: written by benchmarks/tetam.py -->", "<!-- end of results -->"

# Bluetooth Core Specification, Vol 6 Part B 1.4.1: advertising channels 37, 38, 39, centres [Hz].
# The data set does not say which channel a packet came on: a mean over packets is over all three.
ADVERTISING = (2.402e9, 2.426e9, 2.480e9)

# Written for a link on which the tracer finds no path at all [dB]: below every path gain that a
# room of this size can show, and far above -inf, so that the link still counts, as a large error.
NO_PATH_DB = -150.0

TRAIN = "set_1"


class DataError(Exception):
    """The data folder is not what the benchmark expects."""


@dataclass(frozen=True)
class Links:
    """Measured links: RSS [dBm] of ``group`` (a set or a walk) from place ``place`` at a sensor."""

    sensors: tuple[str, ...]
    sensor_position: Float[ndarray, "s 3"]
    place_position: Float[ndarray, "n 3"]
    group: tuple[str, ...]
    sensor: Int[ndarray, "l"]
    place: Int[ndarray, "l"]
    rss: Float[ndarray, "l"]

    def of(self, groups: Sequence[str]) -> Bool[ndarray, "l"]:
        return np.isin(np.array(self.group), list(groups))

    @property
    def distance(self) -> Float[ndarray, "l"]:
        apart = self.sensor_position[self.sensor] - self.place_position[self.place]
        return np.linalg.norm(apart, axis=1)

    @property
    def walks(self) -> list[str]:
        return sorted(g for g in set(self.group) if not g.startswith("set_"))


# Data


def rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        raise DataError(
            f"{path}: not found; --data expects the tetam-ble folder with its CSV files"
        )
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def position(row: dict[str, str]) -> tuple[float, float, float]:
    return float(row["x_m"]), float(row["y_m"]), float(row["z_m"])


def stationary(data: Path) -> list[tuple[str, str, tuple[float, float, float], float]]:
    """(set, sensor, place, mean dBm over the packets) of each link between a sensor and a place."""
    return [
        (row["set"], row["sensor"], position(row), float(row["mean_dbm"]))
        for row in rows(data / "fingerprints_mean.csv")
    ]


def walked(data: Path) -> list[tuple[str, str, tuple[float, float, float], float]]:
    """(walk, sensor, place, mean dBm) for each second of a walk in which a sensor heard a packet.

    The place is the mean over every packet of that second, whoever heard it, so that one place
    serves all sensors.
    """
    place, heard = defaultdict(list), defaultdict(list)
    for row in rows(data / "tracks.csv"):
        second = (row["track"], int(float(row["t_s"])))
        place[second].append(position(row))
        heard[*second, row["sensor"]].append(float(row["rssi_dbm"]))
    where = {second: tuple(np.mean(points, axis=0).tolist()) for second, points in place.items()}
    return [
        (walk, sensor, where[walk, second], float(np.mean(values)))
        for (walk, second, sensor), values in heard.items()
    ]


def read(data: Path) -> Links:
    """All links of the data set. Raises DataError when a file is missing."""
    at = {row["sensor"]: position(row) for row in rows(data / "sensors.csv")}
    measured = stationary(data) + walked(data)
    places = {place: i for i, place in enumerate(dict.fromkeys(m[2] for m in measured))}
    names = tuple(at)
    return Links(
        names,
        np.array(list(at.values())),
        np.array(list(places)),
        tuple(m[0] for m in measured),
        np.array([names.index(m[1]) for m in measured]),
        np.array([places[m[2]] for m in measured]),
        np.array([m[3] for m in measured]),
    )


# Gains and errors


def sensor_gains(
    links: Links, predicted: Float[ndarray, "l"], train: Bool[ndarray, "l"]
) -> Float[ndarray, "s"]:
    """The gain of each sensor [dB] with the least absolute error on ``train``: a median."""
    rest = links.rss - predicted
    return np.array(
        [np.median(rest[train & (links.sensor == s)]) for s in range(len(links.sensors))]
    )


def errors(
    links: Links,
    predicted: Float[ndarray, "l"],
    gains: Float[ndarray, "s"],
    test: Bool[ndarray, "l"],
) -> Float[ndarray, "t"]:
    """Measured minus predicted [dB] on ``test``, its beacon's gain fitted there (a median)."""
    rest = (links.rss - predicted - gains[links.sensor])[test]
    return rest - np.median(rest)


def log_distance_exponent(links: Links, train: Bool[ndarray, "l"]) -> float:
    """Exponent n of -10 n log10 d with the least absolute error on ``train``, gains refitted."""

    def cost(n: float) -> float:
        predicted = log_distance(links, n)
        rest = links.rss - predicted - sensor_gains(links, predicted, train)[links.sensor]
        return float(np.abs(rest[train]).mean())

    return float(scipy.optimize.minimize_scalar(cost, bounds=(0.0, 6.0), method="bounded").x)


def log_distance(links: Links, exponent: float) -> Float[ndarray, "l"]:
    return -10.0 * exponent * np.log10(links.distance)


def score(
    links: Links, predicted: Float[ndarray, "l"], sight: Bool[ndarray, "l"] | None = None
) -> dict[str, dict[str, float]]:
    """Errors per group [dB]: median and 90th percentile of the absolute error, and its RMS.

    One beacon was carried on all walks, so its gain is fitted on all of them together, and the rows
    of single walks keep it. With ``sight``, links in sight and in shadow get rows of their own, by
    the gains of all.
    """
    gains = sensor_gains(links, predicted, links.of([TRAIN]))
    table = {}
    for name, groups in {TRAIN: [TRAIN], "set_2": ["set_2"], "walks": links.walks}.items():
        test = links.of(groups)
        off = errors(links, predicted, gains, test)
        table[name] = summary(off)
        if sight is not None:
            table[f"{name} in sight"] = summary(off[sight[test]])
            table[f"{name} in shadow"] = summary(off[~sight[test]])
    walked = links.of(links.walks)
    off = errors(links, predicted, gains, walked)
    for walk in links.walks:
        table[walk] = summary(off[links.of([walk])[walked]])
    return table


def summary(error: Float[ndarray, "t"]) -> dict[str, float]:
    size = np.abs(error)
    return {
        "links": len(error),
        "bias_db": float(np.median(error)),
        "median_db": float(np.median(size)),
        "p90_db": float(np.percentile(size, 90)),
        "rms_db": float(np.sqrt(np.mean(error**2))),
    }


# Ray tracing


@dataclass(frozen=True)
class Traced:
    """What rays say of every sensor and place: path gain [dB] summed two ways, who sees whom."""

    power_sum: Float[ndarray, "s n"]
    coherent_sum: Float[ndarray, "s n"]
    in_sight: Bool[ndarray, "s n"]
    paths: Int[ndarray, "s n"]
    seconds: float


def trace(links: Links, quality: str, overrides: dict[str, int], chunk: int) -> Traced:
    """Trace ``chunk`` places at a time (each chunk searches anew; chunks bound the memory)."""
    from rfsg.scene.scene import Scene
    from rfsg.tracer.plan import Quality

    scene = Scene.from_usd(SCENE)
    order = [radio.path.rsplit("/", 1)[-1] for radio in scene.transmitters]
    scene = scene.with_transmitters([scene.transmitters[order.index(n)] for n in links.sensors])
    begin, parts = time.perf_counter(), []
    for start in range(0, len(links.place_position), chunk):
        places = links.place_position[start : start + chunk]
        parts.append(trace_chunk(scene, places, Quality.named(quality, **overrides)))
        print(f"traced {start + len(places)} places, {time.perf_counter() - begin:.0f} s")
    joined = [np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True)]
    return Traced(*joined, time.perf_counter() - begin)


def trace_chunk(scene: "Scene", places: Float[ndarray, "n 3"], quality: "Quality") -> tuple:
    """The arrays of ``Traced``. Gains are averaged over the advertising channels: the power sum in
    watts, the coherent sum in decibels (the RSSI of each packet was read in dBm)."""
    import torch

    from rfsg.scene.radios import Radio
    from rfsg.tracer.simulate import simulate

    still, axes = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    beacons = [
        Radio(f"/World/Radios/beacon_{i}", torch.as_tensor(place), axes, still)
        for i, place in enumerate(places)
    ]
    frequency = torch.tensor(ADVERTISING, dtype=torch.float64)
    result = simulate(scene.with_receivers(beacons), frequency, quality)
    c, shape = result.channel, (len(scene.transmitters), len(places))
    link = (c.tx * shape[1] + c.rx).numpy()
    straight = (result.paths.which < 0).all(1)
    straight[c.crossed[:, 0]] = False

    def total(weights: ndarray | None = None) -> ndarray:
        return np.bincount(link, weights, minlength=shape[0] * shape[1]).reshape(shape)

    power = total((c.gain.abs() ** 2).mean(1).numpy())
    coherent = decibels(result.path_gain().numpy()).mean(-1)
    return decibels(power), coherent, total(straight.numpy()) > 0, total()


def decibels(power: Float[ndarray, "*b"]) -> Float[ndarray, "*b"]:
    """10 log10, never below NO_PATH_DB."""
    return 10.0 * np.log10(np.maximum(power, 10.0 ** (NO_PATH_DB / 10.0)))


# Output


def table(scores: dict[str, dict[str, dict[str, float]]]) -> str:
    """Markdown: a row per group of links, a column per predictor."""
    names, groups = list(scores), next(iter(scores.values()))
    lines = ["| links of | number | " + " | ".join(names) + " |", "|---" * (len(names) + 2) + "|"]
    for key, first in groups.items():
        cells = [f"{s[key]['median_db']:.2f} / {s[key]['p90_db']:.2f}" for s in scores.values()]
        if "sight" in key or "shadow" in key:
            cells = [
                f"{c} ({s[key]['bias_db']:+.1f})"
                for c, s in zip(cells, scores.values(), strict=True)
            ]
        title = key.replace("_", " ") + (" (gains fitted)" if key == TRAIN else "")
        lines.append(f"| {title} | {first['links']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def picture(
    links: Links, predictors: dict[str, Float[ndarray, "l"]], groups: list[str], path: Path
) -> None:
    """Measured against predicted RSS on the links of ``groups``, and the CDF of the errors."""
    from rfsg.plot import comparison_figure, save

    test, train = links.of(groups), links.of([TRAIN])
    measured = links.rss[test]
    said = {}
    for name, predicted in predictors.items():
        gains = sensor_gains(links, predicted, train)
        said[name] = measured - errors(links, predicted, gains, test)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(comparison_figure(measured, said, title=path.stem.replace("_", " ")), path)


def pictures(links: Links, predictors: dict[str, Float[ndarray, "l"]], folder: Path) -> None:
    picture(links, predictors, ["set_2"], folder / "tetam_set_2.png")
    picture(links, predictors, links.walks, folder / "tetam_walks.png")


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    beside.write_text(text)
    beside.replace(path)


def write_page(results: str) -> None:
    """Put the results between their marks in docs/tetam.md; the rest of the page is by hand."""
    page = PAGE.read_text()
    head, rest = page.split(BEGIN)
    write(PAGE, f"{head}{BEGIN}\n\n{results}\n\n{END}{rest.split(END)[1]}")


def write_links(links: Links, predictors: dict[str, Float[ndarray, "l"]], path: Path) -> None:
    names = [name.replace(" ", "_").replace("-", "_") + "_db" for name in predictors]
    lines = [",".join(["group", "sensor", "x_m", "y_m", "z_m", "measured_dbm", *names])]
    for i, (s, p) in enumerate(zip(links.sensor, links.place, strict=True)):
        place = (f"{v:.3f}" for v in links.place_position[p])
        said = (f"{v[i]:.3f}" for v in predictors.values())
        cells = [links.group[i], links.sensors[s], *place, f"{links.rss[i]:.3f}", *said]
        lines.append(",".join(cells))
    write(path, "\n".join(lines) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the tetam-ble data set")
    parser.add_argument("--quality", default="standard", help="draft, standard or reference")
    parser.add_argument("--depth", type=int, help="most reflections on a path")
    parser.add_argument("--diffraction", type=int, help="most edges that a path bends round")
    parser.add_argument("--rays", type=int, help="directions launched from each sensor")
    parser.add_argument("--chunk", type=int, default=1024, help="places at a time")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "tetam")
    parser.add_argument("--baseline-only", action="store_true", help="no ray tracing")
    parser.add_argument("--write-docs", action="store_true", help="write docs/tetam.md too")
    options = parser.parse_args()
    try:
        links = read(options.data)
    except DataError as fault:
        parser.error(str(fault))

    exponent = log_distance_exponent(links, links.of([TRAIN]))
    predictors = {
        "free space": log_distance(links, 2.0),
        "log-distance": log_distance(links, exponent),
        "gains only": np.zeros_like(links.rss),
    }
    report: dict = {"log_distance_exponent": exponent}
    said = f"Log-distance exponent fitted on {TRAIN}: {exponent:.2f}."
    sight = None
    if not options.baseline_only:
        names = ("depth", "diffraction", "rays")
        overrides = {k: v for k in names if (v := getattr(options, k)) is not None}
        traced = trace(links, options.quality, overrides, options.chunk)
        at = (links.sensor, links.place)
        rays = {"power sum": traced.power_sum[at], "coherent sum": traced.coherent_sum[at]}
        predictors, sight = rays | predictors, traced.in_sight[at]
        report |= {"quality": options.quality, "seconds": traced.seconds} | overrides
        report |= {"paths": int(traced.paths.sum()), "pairs": traced.paths.size}
        report["pairs_without_path"] = int((traced.paths == 0).sum())
        extra = "".join(f", {k} {v}" for k, v in overrides.items())
        said += (
            f" Ray tracing at quality `{options.quality}`{extra}: {report['paths']} paths between "
            f"{report['pairs']} pairs of sensor and place in {traced.seconds:.0f} s; "
            f"{report['pairs_without_path']} pairs have no path at all. A link is in sight when "
            "its straight line crosses no box of the scene."
        )
    scores = {name: score(links, predicted, sight) for name, predicted in predictors.items()}
    results = (
        "Median / 90th percentile of the absolute error [dB]; in brackets the median error, "
        f"measured minus predicted.\n\n{table(scores)}\n\n{said}"
    )
    print(results)
    write(options.out / "results.json", json.dumps(report | {"scores": scores}, indent=1) + "\n")
    write_links(links, predictors, options.out / "links.csv")
    pictures(links, predictors, options.out)
    print(f"wrote {options.out}/results.json, links.csv, tetam_set_2.png, tetam_walks.png")
    if options.write_docs:
        write_page(results)
        pictures(links, predictors, PICTURES)


if __name__ == "__main__":
    main()
