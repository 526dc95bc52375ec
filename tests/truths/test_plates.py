"""Trained and rippled metal plates against physical optics at 2.4, 28 and 140 GHz: one path per
mirror, within half a decibel in the mean."""

import numpy as np
import pytest

from tests.truths.plates import PATCHES, RECEIVERS, trained


@pytest.mark.parametrize(
    "frequency",
    # the ends of the range; the middle among the slow ones
    [pytest.param(f, marks=[pytest.mark.slow] if f == 28e9 else []) for f in PATCHES],
)
def test_a_trained_face_reflects_as_physical_optics_says(frequency):
    """What training left of error changes the reflection by what it changes the integral by."""
    found = trained(frequency)
    for receivers in found.mirrors:
        assert receivers == list(range(len(RECEIVERS)))  # one path per mirror
    assert abs(np.mean(found.errors)) < 0.5
    assert np.mean(np.abs(found.errors)) < 0.5
