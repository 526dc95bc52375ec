"""Scales of colours: their ends, that they rise evenly, and that linear and back is the same."""

import numpy as np
import pytest

from rfsg.scene.colours import MAP, PATHS, colours, css, linear, srgb

LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear RGB, ITU-R BT.709


@pytest.mark.parametrize("scale", [PATHS, MAP])
def test_strong_is_lighter_than_weak_all_along(scale):
    paint = colours(np.linspace(-90.0, -40.0, 200), -90.0, -40.0, scale)
    light = linear(paint) @ LUMINANCE
    assert (np.diff(light) > -1e-3).all() and light[-1] > 10 * light[0]


@pytest.mark.parametrize("scale", [PATHS, MAP])
def test_what_is_beyond_the_scale_takes_its_ends(scale):
    ends = colours(np.array([-90.0, -40.0]), -90.0, -40.0, scale)
    assert (colours(np.array([-200.0, 10.0]), -90.0, -40.0, scale) == ends).all()
    one = colours(np.array([-50.0]), -50.0, -50.0, scale)  # a single value: the strongest
    assert (one[0] == ends[1]).all()
    assert css(scale).startswith("linear-gradient(to right, rgb(") and str(ends[1][0]) in css(scale)


def test_linear_and_back_is_the_same():
    every = np.arange(256, dtype=np.uint8)
    for value in np.stack([every, every[::-1], every], axis=1)[::5]:
        red, green, blue = linear(value).tolist()
        assert srgb((red, green, blue)) == tuple(value.tolist())
    assert srgb((-1.0, 2.0, 0.0)) == (0, 255, 0)
