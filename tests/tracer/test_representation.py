"""Which way an object is met: the bound against sums of phasors, and what is chosen."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Cylinder
from rfsg.objects.shapes.band import Off
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node
from rfsg.tracer import representation
from rfsg.tracer.representation import WAYS, choose, error_db, strictest
from tests.scenes import box_node
from tests.tracer.shapes import Field, ball

LENGTHS = st.floats(1e-3, 0.3)


# 1 mm off by its mesh, 20 um by a step from it, and 0.2 % missing from both
OFFS = {
    "certain": Off(1e-6, 1e-5, 0.0),
    "newton": Off(2e-5, 1e-3, 2e-3),
    "mesh": Off(1e-3, 5e-3, 2e-3),
    "grid": Off(1e-3, 5e-3, 2e-3),
}


def learned(path="/ball", scale=1.0):
    body = Body(Field(ball(0.4), (0.5, 0.5, 0.5)), Conductor())
    return Node(path, body, Pose.at(1.0, 2.0, 3.0, scale=scale))


@pytest.fixture(autouse=True, scope="module")
def as_if_baked():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(representation, "offs_of", lambda shape: OFFS)
        yield


@given(st.floats(0.0, 0.01), LENGTHS, st.floats(0.0, 89.0), st.integers(0, 10_000))
def test_no_sum_of_paths_moves_further_than_the_bound(error, wavelength, incidence_deg, seed):
    """Every face is off by no more than e, at its own angle, or its path is lost; amplitudes and
    phases are any."""
    generator = torch.Generator().manual_seed(seed)
    n = 7
    amplitude, phase, share = torch.rand(3, n, generator=generator, dtype=torch.float64).unbind()
    longer = 2 * error * (2 * share - 1) * math.cos(math.radians(incidence_deg))
    true = torch.polar(amplitude, 2 * math.pi * phase)
    wrong = true * torch.polar(torch.ones(n).double(), -2 * math.pi * longer / wavelength)
    wrong[seed % n] = 0.0
    lost = float(amplitude[seed % n] / amplitude.sum())
    moved = 20 * math.log10(1 + float((wrong.sum() - true.sum()).abs() / amplitude.sum()))
    assert moved <= error_db(error, wavelength, lost) + 1e-12


def test_known_shapes_are_exact():
    round_thing = Node("/c", Body(Cylinder(0.2, 0.5), Conductor()), Pose.at(0.0, 0.0, 0.0))
    for node in (box_node("/box", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), round_thing):
        way, sentence = choose(node, 1e-3, 1e-6)
        assert way == "analytic" and node.path in sentence and "exact" in sentence


@given(LENGTHS, st.floats(1e-3, 10.0))
def test_the_cheapest_way_within_the_accuracy(wavelength, accuracy_db):
    """Whatever is cheaper than the choice would break the accuracy; the choice keeps it."""
    way, sentence = choose(learned(), wavelength, accuracy_db)
    most = {w: error_db(OFFS[w].usual, wavelength, OFFS[w].lost) for w in WAYS}
    assert all(most[cheaper] > accuracy_db for cheaper in WAYS[: WAYS.index(way)])
    assert way == "certain" or most[way] <= accuracy_db
    assert "/ball" in sentence and repr(way) in sentence


def test_shorter_waves_ask_for_more():
    """1 mm is a small part of 12 cm, and a tenth of 1 cm."""
    chosen = [choose(learned(), w, 1.0)[0] for w in (0.122, 0.0107, 0.0001)]
    assert [WAYS.index(way) for way in chosen] == sorted(WAYS.index(way) for way in chosen)
    assert chosen[0] == "mesh" and chosen[1] == "newton"


def test_a_larger_copy_errs_by_more():
    assert choose(learned(), 0.122, 1.0)[0] == "mesh"
    assert choose(learned(scale=4.0), 0.122, 1.0)[0] != "mesh"


def test_one_way_for_all_is_the_strictest():
    small, large = learned(), learned("/large", scale=4.0)
    box = box_node("/box", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert strictest((box, small, large), 0.122, 1.0) == choose(large, 0.122, 1.0)[0]
    assert strictest((box,), 0.122, 1.0) == representation.CERTAIN


def test_what_is_not_baked_is_met_with_certainty(monkeypatch):
    monkeypatch.setattr(representation, "offs_of", lambda shape: None)
    way, sentence = choose(learned(), 0.122, 10.0)
    assert way == "certain" and "not baked" in sentence


def test_a_way_that_loses_too_much_is_not_chosen(monkeypatch):
    """What it finds may be where it should be: half of it missing is 3.5 dB all the same."""
    holed = OFFS | {way: Off(0.0, 0.0, 0.5) for way in ("mesh", "newton")}
    monkeypatch.setattr(representation, "offs_of", lambda shape: holed)
    assert choose(learned(), 0.122, 3.4)[0] == "certain"
    assert choose(learned(), 0.122, 3.6)[0] == "mesh"


@pytest.mark.parametrize(
    "numbers", [(-1.0, 0.1), (1e-3, 0.0), (1e-3, math.inf), (1e-3, 0.1, -0.1), (1e-3, 0.1, 1.1)]
)
def test_numbers_that_are_none_are_refused(numbers):
    with pytest.raises(ValueError, match="expected at least 0, above 0, and 0 to 1"):
        error_db(*numbers)


def test_an_accuracy_of_nothing_is_refused():
    with pytest.raises(ValueError, match="accuracy_db=0"):
        choose(learned(), 0.1, 0.0)
