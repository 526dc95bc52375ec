"""What a picture needs of a result: faces tile the map, lines run from transmitter to receiver."""

import numpy as np
import pytest
import torch

from rfsg.tracer.cells import plane_through
from rfsg.tracer.drawing import KINDS, map_faces, path_lines
from rfsg.tracer.radiomap import radio_map, radio_map_on
from rfsg.tracer.simulate import simulate
from tests.scenes import room


@pytest.fixture(scope="module")
def result():
    return simulate(room(), quality="draft")


def test_lines_run_from_transmitter_to_receiver(result):
    scene, lines = result.scene, path_lines(result)
    assert len(lines) == len(result.paths.tx)
    for line in lines:
        ends = scene.transmitters[line.tx].position, scene.receivers[line.rx].position
        assert np.abs(line.points[[0, -1]] - torch.stack(ends).numpy()).max() < 1e-12
        assert line.kind in KINDS


def test_a_line_is_as_long_as_its_path(result):
    light = 299792458.0
    for line in path_lines(result):
        length = np.linalg.norm(np.diff(line.points, axis=0), axis=1).sum()
        assert length == pytest.approx(line.delay_ns * 1e-9 * light, rel=1e-9)


def test_each_link_has_its_direct_line_and_the_strongest_first(result):
    lines = path_lines(result)
    straight = [line.rx for line in lines if line.kind == "line of sight"]
    assert sorted(straight) == list(range(len(result.scene.receivers)))
    assert all(len(line.points) == 2 for line in lines if line.kind == "line of sight")
    for rx in straight:
        gains = [line.gain_db for line in lines if line.rx == rx]
        assert gains == sorted(gains, reverse=True)


def areas(drawn):
    """Of each face, about its first corner."""
    corner = drawn.vertices[drawn.faces]
    side = corner[:, 1:] - corner[:, :1]
    return np.linalg.norm(np.cross(side[:, :-1], side[:, 1:]), axis=-1).sum(1) / 2


@pytest.mark.parametrize(
    "plane", [None, plane_through((0.5, 1.0, 1.0), (1.0, 0.2, 0.0), (0.0, 0.0, 1.0))]
)
def test_faces_tile_the_map_of_a_plane(plane):
    bounds = (0.5, 0.5, 3.5, 2.5)
    found = radio_map(room(), bounds=bounds, cell=0.5, plane=plane, method="images")
    drawn = map_faces(found)
    area, own = areas(drawn), found.cells.area.reshape(-1).numpy()
    assert np.allclose(area, own[drawn.cell], rtol=1e-12, atol=0)
    assert area.sum() == pytest.approx(6.0, rel=1e-12)
    assert sorted(drawn.cell) == list(range(len(own)))
    middle = drawn.vertices[drawn.faces].mean(1)
    points = found.cells.point.numpy()
    assert np.abs(middle - points[drawn.cell]).max() < 1e-12


def test_faces_tile_the_outside_of_an_object():
    found = radio_map_on(room(), "/z0", cell=2.0, method="images")
    drawn = map_faces(found)
    area = np.bincount(drawn.cell, areas(drawn), minlength=len(found.cells.area))
    assert np.allclose(area, found.cells.area.numpy(), rtol=1e-9, atol=0)
