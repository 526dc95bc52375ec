"""Points in a tree, against every point asked of every tube."""

import pytest
import torch

from rfsg.tracer.lattice import fibonacci, rounds, spacing
from rfsg.tracer.places import PIECE, Cones, Places
from tests.scenes import vector


def plain(cones: Cones, point: torch.Tensor, most: float) -> dict[tuple[int, int], float]:
    """Every tube and point, one after the other."""
    origin, direction = (torch.stack(c, -1) for c in (cones.origin, cones.direction))
    away = point[None] - origin[:, None]
    along = (away * direction[:, None]).sum(-1)
    across = torch.sqrt(((away * away).sum(-1) - along**2).clamp(min=0.0))
    width = cones.width[:, None] + cones.spread[:, None] * along
    miss = torch.where(along > 0, across / width.clamp(min=1e-300), torch.inf)
    return {(i, k): float(miss[i, k]) for i, k in torch.nonzero(miss < most).tolist()}


def drawn(seed: int, *shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("count", [0, 1, 7, 16, 17, 300, 1001])
@pytest.mark.parametrize("wide", [0.01, 0.3])
def test_points_in_tubes_are_those_of_the_plain_loop(count, wide):
    point = 10.0 * drawn(1, count, 3) * vector(1.0, 1.0, 0.1)
    origin = 14.0 * drawn(2, 60, 3) - 2.0
    cones = Cones(origin, fibonacci(60), 0.3 * drawn(3, 60), wide * drawn(4, 60))
    found = {}
    for tube, place, miss in Places(point).within(cones, 2.0):
        found |= dict(
            zip(zip(tube.tolist(), place.tolist(), strict=True), miss.tolist(), strict=True)
        )
    assert found == pytest.approx(plain(cones, point, 2.0), rel=1e-12)
    assert count < 300 or len(found) > 100 * wide


def test_points_in_one_place_and_a_ray_through_a_point():
    point = vector(1.0, 2.0, 3.0).expand(40, 3)
    towards = vector(1.0, 2.0, 3.0) / vector(1.0, 2.0, 3.0).norm()
    cones = Cones(
        torch.zeros(2, 3).double(), torch.stack([towards, -towards]), *[vector(0.1, 0.1)] * 2
    )
    ((tube, place, miss),) = [x for x in Places(point).within(cones, 2.0) if len(x[0])]
    assert tube.tolist() == [0] * 40 and sorted(place.tolist()) == list(range(40))
    assert float(miss.max()) < 1e-6


def test_pieces_are_bounded(monkeypatch):
    """Where every tube holds every point, what is looked at at a time stays small."""
    monkeypatch.setattr("rfsg.tracer.places.PIECE", 1000)
    cones = Cones(-10.0 + torch.zeros(50, 3).double(), fibonacci(50), torch.full((50,), 1e3).double(),
                  torch.zeros(50).double())  # fmt: skip
    pieces = [len(x[0]) for x in Places(drawn(1, 500, 3)).within(cones, 2.0)]
    half = fibonacci(50) @ vector(1.0, 1.0, 1.0)
    assert sum(pieces) >= 500 * int((half > 0.1).sum()) and max(pieces) <= 1000 < PIECE


def test_few_cells_are_asked(monkeypatch):
    """The tree is there to leave most of 20,000 points out."""
    asked = []
    seen = Cones._seen
    monkeypatch.setattr(Cones, "_seen", lambda self, i, p: asked.append(len(i)) or seen(self, i, p))
    cones = Cones(torch.zeros(100, 3).double(), fibonacci(100), torch.zeros(100).double(),
                  torch.full((100,), 0.02).double())  # fmt: skip
    point = 10.0 * drawn(1, 20_000, 3) - 5.0
    met = sum(len(x[0]) for x in Places(point).within(cones, 2.0))
    assert met > 0 and sum(asked) < 0.1 * 100 * 20_000


@pytest.mark.parametrize("count", [1, 600, 5000, 20_000])
def test_rounds_are_the_lattice_and_each_is_even(count):
    whole = torch.arange(count)
    parts = [whole[some] for some in rounds(count)]
    assert sorted(torch.cat(parts).tolist()) == whole.tolist()
    direction, sent = fibonacci(count), torch.zeros(0, dtype=torch.int64)
    looks = fibonacci(1999)
    for number, part in enumerate(parts):
        assert number == 0 or abs(len(part) - len(sent)) <= 1  # as many as before
        sent = torch.cat([sent, part])
        nearest = (looks @ direction[sent].T).amax(1).clamp(max=1.0).acos()
        assert count < 500 or float(nearest.max()) < 1.6 * spacing(len(sent))
