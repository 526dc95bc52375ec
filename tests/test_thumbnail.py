"""Pictures of objects: the same for the same shape wherever it stands and however large, and lit."""

import io

import numpy as np
import pytest
from matplotlib.image import imread

from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.shapes.shown import shown_mesh
from rfsg.plot_thumbnail import thumbnail

SIDE = 48


def pixels(mesh, **options) -> np.ndarray:
    image = imread(io.BytesIO(thumbnail(*mesh, side=SIDE, **options)))
    assert image.shape[:2] == (SIDE, SIDE)
    return image[..., :3]


@pytest.fixture(scope="module")
def box():
    return shown_mesh(Box((0.3, 0.3, 0.5)))


def test_equal_meshes_give_equal_pictures(box):
    assert thumbnail(*box, side=SIDE) == thumbnail(*box, side=SIDE)


def test_place_and_size_do_not_matter(box):
    vertices, faces, normals = box
    moved = pixels((4.0 * vertices + [10.0, -3.0, 2.0], faces, normals))
    assert np.abs(moved - pixels(box)).mean() < 2e-3


def test_the_middle_shows_the_object_and_the_rim_the_page(box):
    red = pixels(box, color=(0.6, 0.02, 0.02))
    middle, corner = red[SIDE // 2, SIDE // 2], red[0, 0]
    assert middle[0] > 2 * middle[1] and corner == pytest.approx([1, 1, 1], abs=0.02)


def test_the_top_is_lit_more_than_the_side_away_from_the_sun(box):
    """The sun stands on the left, before the object and above."""
    grey = pixels(box).mean(-1)
    top, away = grey[int(0.14 * SIDE), SIDE // 2], grey[SIDE // 2, int(0.66 * SIDE)]
    assert top > away + 0.1


def test_the_floor_is_shaded_beside_the_object(box):
    """Darker close to the foot, on the side that the sun does not reach, than in the open."""
    grey = pixels(box).mean(-1)
    assert grey[int(0.8 * SIDE), int(0.85 * SIDE)] < grey[int(0.8 * SIDE), 1] - 0.05


def test_a_ball_is_smooth():
    """Its normals are mixed over each triangle: no facet's edge shows as a step."""
    grey = pixels(shown_mesh(Sphere(0.3))).mean(-1)
    row = grey[SIDE // 2, SIDE // 2 - 8 : SIDE // 2 + 8]
    assert np.abs(np.diff(row)).max() < 0.08
