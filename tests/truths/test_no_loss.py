"""No silent loss: every path of an empty room, whatever the depth and the number of receivers.

The images of a source in a box are a lattice (Allen & Berkley 1979, J. Acoust. Soc. Am. 65(4)): image
(i, j, k) is met by |i| + |j| + |k| reflections, on the two walls of each axis in turn, and every
image within the depth is one path.
"""

import numpy as np
import pytest
import torch

from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.scenes import ROOM, room

TRANSMITTER = (1.31, 2.11, 1.73)


def lattice(depth: int) -> np.ndarray:
    """[n 3]: all (i, j, k) with |i| + |j| + |k| <= depth."""
    axis = np.arange(-depth, depth + 1)
    every = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return every[np.abs(every).sum(1) <= depth]


def image_lengths(number: np.ndarray, receiver: np.ndarray) -> np.ndarray:
    """Distances of the images from a receiver; each axis is mirrored in turn at 0 and at its size."""
    size, source = np.array(ROOM), np.array(TRANSMITTER)
    turned = number % 2 != 0
    image = (number + turned) * size + np.where(turned, -source, source)
    return np.linalg.norm(image - receiver, axis=1)


def found_all(count: int, depth: int) -> None:
    places = np.random.default_rng(count).uniform(0.1, np.array(ROOM) - 0.1, (count, 3))
    result = simulate(
        room(places.tolist(), TRANSMITTER), quality=Quality(depth=depth, floor_db=-400.0)
    )
    paths, number = result.paths, lattice(depth)
    assert torch.bincount(paths.rx).tolist() == [len(number)] * count
    order = np.lexsort((paths.length.numpy(), paths.rx.numpy()))
    length = paths.length.numpy()[order].reshape(count, -1)
    expected = np.stack([np.sort(image_lengths(number, place)) for place in places])
    np.testing.assert_allclose(length, expected, rtol=0, atol=1e-9)
    sequence = torch.cat([paths.rx[:, None], paths.which], 1)
    assert len(torch.unique(sequence, dim=0)) == len(sequence)


def test_every_image_of_a_room_is_found():
    found_all(30, 5)


@pytest.mark.slow
def test_every_image_of_a_room_is_found_by_a_thousand_receivers():
    found_all(1000, 5)
