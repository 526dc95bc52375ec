"""Pictures: what is drawn lies where the objects are, and every figure can be made and saved."""

import numpy as np
import pytest
import torch

from rfsg import plot
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.cells import grid_on, plane_through
from rfsg.tracer.patches import patches_of
from rfsg.tracer.radiomap import RadioMap


def node(shape, pose=None, path="/World/Thing"):
    return Node(path, Body(shape, Conductor()), pose or Pose.identity())


def area(ring):
    x, y = ring.T
    return 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))


def test_footprint_of_a_sphere_is_its_circle():
    (ring,) = plot.footprint(node(Sphere(0.5), Pose.at(3.0, -2.0, 1.0, scale=2.0)))
    radius = np.linalg.norm(ring - [3.0, -2.0], axis=1)
    assert radius == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("yaw", [0.0, 30.0, 90.0])
def test_footprint_of_a_turned_box_keeps_its_area(yaw):
    (ring,) = plot.footprint(node(Box((2.0, 0.01, 1.0)), Pose.at(1.0, 1.0, 0.0, yaw)))
    assert area(ring) == pytest.approx(4.0 * 0.02, rel=1e-9)


def test_slices_lie_on_the_surface():
    turned = node(Cylinder(0.2, 0.6), Pose.at(0.0, 5.0, 2.0, 45.0))
    rings = plot.slices(turned)
    assert len(rings) == plot.SLICES
    for ring in rings:
        assert np.hypot(ring[:, 0], ring[:, 1] - 5.0) == pytest.approx(0.2, abs=0.005)
        assert 1.4 < ring[0, 2] < 2.6


def test_a_tilted_object_is_seen_from_above():
    upright = Pose.identity()
    lying = Pose(upright.rotation[[2, 0, 1]], upright.translation, upright.scale)
    (ring,) = plot.footprint(node(Cylinder(0.2, 1.0), lying))
    assert sorted(np.ptp(ring, axis=0)) == pytest.approx([0.4, 2.0], abs=0.03)


def test_an_unbounded_object_is_left_out():
    ground = node(HalfSpace())
    assert plot.footprint(ground) == [] and plot.slices(ground) == []
    low, high = plot.scene_bounds(Scene(nodes=(ground,)))
    assert np.isfinite([low, high]).all()


def test_path_lines_drop_the_padding_and_the_blocked(small_run):
    lines, gain_db = plot.path_lines(small_run.paths, small_run.channel)
    assert sorted(len(line) for line in lines) == [2, 2, 3]
    assert list(gain_db) == sorted(gain_db)
    assert gain_db[-1] == pytest.approx(20 * np.log10(0.0239 / 4.0))


def map_of(scene, cells, gain):
    error = torch.zeros_like(gain)
    return RadioMap(scene, 1e9, cells, gain, error, "paths")


def level():
    return grid_on(Pose.at(0.0, 0.0, 1.2), (0.0, 0.0, 3.0, 2.5), 0.5)


def gains(*shape):
    value = torch.logspace(-9, -4, int(np.prod(shape)), dtype=torch.float64).reshape(shape)
    value[:, 0] = 0.0  # nothing arrives there
    return value


def test_figures_are_saved_as_pictures(small_run, tmp_path):
    scene = small_run.scene
    pair = scene.with_transmitters([Radio.at("/A", 1, 1, 1), Radio.at("/B", 2, 1, 1, power_dbm=60)])
    upright = plane_through((0.0, 2.95, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    flat = map_of(pair, level(), gains(2, 5, 6))
    steep = map_of(pair, grid_on(upright, (0.0, 0.0, 3.0, 2.0), 0.5), gains(2, 4, 6))
    single = map_of(scene, grid_on(Pose.at(0, 0, 1), (0, 0, 1, 1), 1.0), gains(1, 1, 1))
    patches = patches_of(World(scene), "/World/Wall", 1.0, 0.01)
    surface = map_of(pair, patches, gains(2, len(patches.point)))
    measured = np.linspace(-90.0, -40.0, 50)
    figures = {
        "run": plot.scene_figure(scene, small_run.paths, small_run.channel),
        "scene": plot.scene_figure(scene),
        "empty": plot.scene_figure(Scene()),
        "delay": plot.delay_figure(scene, small_run.channel, [(0, 0), (0, 1)]),
        "silence": plot.delay_figure(scene, small_run.channel, []),
        "map": plot.map_figure(flat, pair),
        "second": plot.map_figure(flat, pair, 1),
        "upright": plot.map_figure(steep, pair),
        "nothing": plot.map_figure(single, scene),
        "compared": plot.comparison_figure(measured, {"rfsg": measured + 1.0}),
        "cdf": plot.cdf_figure({"rfsg": np.ones(3), "other": np.zeros(0)}),
    }
    for metric, shown in (("sinr", flat), ("best-server", flat), ("path-loss", surface)):
        figures[metric] = plot.map_figure(shown, pair, metric=metric)
    for name, figure in figures.items():
        file = plot.save(figure, tmp_path / f"{name}.png", dpi=40)
        assert file.read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == len(figures)
    with pytest.raises(ValueError, match="best-server"):
        plot.map_figure(flat, pair, metric="colour")


def test_an_error_map_shows_the_mean_at_each_place(small_run):
    place = np.array([[1.0, 1.0], [2.0, 1.0], [1.0, 1.0], [9.0, -4.0]])
    errors = {"physics": np.array([3.0, -1.0, 1.0, 0.5]), "with residual": np.zeros(4)}
    figure = plot.error_map_figure(small_run.scene, place, errors)
    first, second = figure.axes[:2]
    shown = first.collections[0]
    places = shown.get_offsets().tolist()
    assert places == [[1.0, 1.0], [2.0, 1.0], [9.0, -4.0]]
    assert shown.get_array().tolist() == [2.0, -1.0, 0.5]
    assert "1.4 dB" in first.get_title() and "0.0 dB" in second.get_title()
    assert first.get_xlim()[1] > 9.0 and first.get_ylim()[0] < -4.0


def test_a_map_shows_the_best_in_each_cell_and_nothing_where_nothing_arrives():
    scene = Scene(transmitters=(Radio.at("/A", 1, 1, 1), Radio.at("/B", 2, 1, 1, power_dbm=3.0)))
    gain = torch.tensor([[[1e-6, 0.0, 1e-8]], [[1e-8, 0.0, 1e-8]]], dtype=torch.float64)
    found = map_of(scene, grid_on(Pose.identity(), (0, 0, 3, 1), 1.0), gain)

    def shown(metric, transmitter=None):
        return plot.metric_values(found, transmitter, metric, 20e6, 0.0)[0].filled(-999).tolist()[0]

    assert shown("rss") == pytest.approx([-60.0, -999.0, -77.0])
    assert shown("rss", 1) == pytest.approx([-77.0, -999.0, -77.0])
    assert shown("path-loss") == pytest.approx([60.0, -999.0, 80.0])
    assert shown("best-server") == [0, -999, 1]
    sinr = found.sinr_db(20e6)
    assert shown("sinr")[0] == pytest.approx(float(sinr[0, 0, 0]))
    assert shown("sinr", 1)[0] == pytest.approx(float(sinr[1, 0, 0]))


def test_an_upright_plane_cuts_a_sphere_in_its_circle():
    """0.3 m from the middle of a ball of 0.5 m: a circle of 0.4 m."""
    plane = plane_through((0.0, 0.3, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    ball = node(Sphere(0.5), Pose.at(1.0, 0.0, 2.0))
    (ring,) = plot.cut(ball, plane, (0.0, 2.0), (1.0, 3.0))
    assert np.hypot(ring[:, 0] - 1.0, ring[:, 1] - 2.0) == pytest.approx(0.4, abs=0.005)
    assert plot.cut(node(Sphere(0.2), Pose.at(1.0, 0.0, 2.0)), plane, (0.0, 2.0), (1.0, 3.0)) == []


def test_the_delay_profile_shows_each_arriving_path_once(small_run):
    figure = plot.delay_figure(small_run.scene, small_run.channel, [(0, 0), (0, 1)])
    first, second = figure.axes
    delays = np.sort(first.lines[0].get_xdata())
    lengths = [4.0, 2 * np.hypot(2.0, 2.9)]
    assert delays == pytest.approx([1e9 * length / 299_792_458.0 for length in lengths])
    assert len(second.lines[0].get_xdata()) == 1
