"""assets/scenes/tetam_lab.usda and the fitting in benchmarks/tetam.py; needs none of the data."""

import importlib.util
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from rfsg.scene.scene import Scene

ROOT = Path(__file__).resolve().parents[1]

# sensors.csv of the data set [m]: the scene must hold these twelve and no others.
SENSORS = {
    "sensor10": (7.0, 7.09, 1.22),
    "sensor11": (7.18, 0.68, 2.3),
    "sensor12": (0.71, 6.16, 2.3),
    "sensor20": (7.25, 11.36, 1.22),
    "sensor21": (0.76, 12.13, 2.3),
    "sensor22": (7.18, 17.64, 2.3),
    "sensor30": (13.14, 12.33, 1.22),
    "sensor31": (12.82, 16.83, 2.3),
    "sensor32": (18.12, 11.93, 2.3),
    "sensor40": (13.01, 5.51, 1.22),
    "sensor41": (17.77, 6.33, 2.3),
    "sensor42": (12.76, 0.27, 2.3),
}
MOUNTING_GAP = 0.045  # [m]: sensors were set 5 cm before the faces that carry them
BEACON_HEIGHT = 1.85  # [m]: of nearly all stationary places


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_usd(ROOT / "assets" / "scenes" / "tetam_lab.usda")


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("tetam", ROOT / "benchmarks" / "tetam.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["tetam"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["tetam"]


def bounds(scene: Scene) -> np.ndarray:
    """World bounds [n 2 3] of the scene's boxes, which all stand upright."""
    found = []
    for node in scene.nodes:
        corners = node.pose.point_world(node.body.shape.bounds().double()).detach().numpy()
        found.append([corners.min(0), corners.max(0)])
    return np.array(found)


def distance(scene: Scene, point: torch.Tensor) -> float:
    """From a point to the nearest box [m], negative inside one."""
    nodes = scene.nodes
    return min(
        float(n.pose.scale * n.body.shape.sdf(n.pose.point_object(point)[None]).double())
        for n in nodes
    )


def test_sensors_are_where_the_data_set_says(scene):
    found = {radio.path.rsplit("/", 1)[-1]: radio for radio in scene.transmitters}
    assert sorted(found) == sorted(SENSORS) and not scene.receivers
    for name, place in SENSORS.items():
        assert np.allclose(found[name].position.numpy(), place, atol=1e-9), name
        assert found[name].frequency == pytest.approx(2.44e9)


def test_no_sensor_is_in_or_on_a_box(scene):
    for radio in scene.transmitters:
        assert distance(scene, radio.position) > MOUNTING_GAP, radio.path


def test_the_middle_of_the_room_is_free_at_beacon_height(scene):
    for x, y in [(5.8, 8.6), (11.5, 1.0), (11.5, 17.0), (17.0, 8.4), (0.5, 4.2), (20.0, 0.5)]:
        here = torch.tensor([x, y, BEACON_HEIGHT], dtype=torch.float64)
        assert distance(scene, here) > 0.1, (x, y)


def test_boxes_touch_but_do_not_overlap(scene):
    box = bounds(scene)
    for i, j in itertools.combinations(range(len(box)), 2):
        shared = np.minimum(box[i, 1], box[j, 1]) - np.maximum(box[i, 0], box[j, 0])
        assert shared.min() < 1e-6, (scene.nodes[i].path, scene.nodes[j].path)


def test_the_room_has_the_size_of_the_tested_area(scene):
    box = dict(zip((n.path for n in scene.nodes), bounds(scene), strict=True))
    assert box["/World/Shell/north"][1, 0] == pytest.approx(0.0, abs=1e-6)
    assert box["/World/Shell/south"][0, 0] == pytest.approx(20.66, abs=1e-6)
    assert box["/World/Shell/west_upper"][1, 1] == pytest.approx(0.0, abs=1e-6)
    assert box["/World/Shell/east_upper"][0, 1] == pytest.approx(17.64, abs=0.06)
    assert box["/World/Shell/floor"][1, 2] == pytest.approx(0.0, abs=1e-6)
    assert len(box) <= 60


def made_up_links(benchmark, exponent: float):
    """Links that follow a log-distance law exactly, with a gain per sensor and one per set."""
    rng = np.random.default_rng(1)
    sensors, places = 4, 30
    gains = np.array([-3.0, 0.0, 2.0, 5.0])
    sensor = np.tile(np.arange(sensors), places)
    place = np.repeat(np.arange(places), sensors)
    group = tuple(np.array(["set_1", "set_2", "walk"])[place % 3])
    links = benchmark.Links(
        tuple(f"s{i}" for i in range(sensors)),
        rng.uniform(0, 10, (sensors, 3)),
        rng.uniform(0, 10, (places, 3)),
        group,
        sensor,
        place,
        np.zeros(sensors * places),
    )
    offset = np.array([{"set_1": 0.0, "set_2": 4.0, "walk": -7.0}[g] for g in group])
    rss = benchmark.log_distance(links, exponent) + gains[sensor] + offset - 60.0
    return benchmark.Links(*(list(vars(links).values())[:-1]), rss)


@pytest.mark.parametrize("exponent", [1.4, 2.0, 3.1])
def test_fit_recovers_the_law_that_made_the_links(benchmark, exponent):
    links = made_up_links(benchmark, exponent)
    found = benchmark.log_distance_exponent(links, links.of(["set_1"]))
    assert found == pytest.approx(exponent, abs=1e-3)
    for group in benchmark.score(links, benchmark.log_distance(links, exponent)).values():
        assert group["p90_db"] < 1e-9


def test_a_gain_per_sensor_and_beacon_is_all_that_is_fitted(benchmark):
    links = made_up_links(benchmark, 2.0)
    wrong = benchmark.score(links, np.zeros_like(links.rss))
    assert wrong["set_2"]["median_db"] > 0.5
    assert wrong["set_2"]["links"] == 40


def test_no_path_counts_as_a_large_error(benchmark):
    assert benchmark.decibels(np.array([0.0, 1e-6])).tolist() == [benchmark.NO_PATH_DB, -60.0]


def test_missing_data_is_a_clear_error(benchmark, tmp_path):
    with pytest.raises(benchmark.DataError, match=r"fingerprints_mean|sensors\.csv"):
        benchmark.read(tmp_path)
