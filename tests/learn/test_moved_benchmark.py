"""benchmarks/moved.py: its rooms hold what they should, and its errors are taken as they are said."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(autouse=True)
def _on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield
    for name in [n for n in sys.modules if n == "learn" or n.startswith("learn.")]:
        del sys.modules[name]


@pytest.mark.parametrize("situation", ["before", "moved", "room B", "copies"])
def test_objects_stand_inside_their_room_apart_from_each_other(situation):
    from learn.moved_rooms import APART, THINGS, Layout

    layout = Layout(7)
    size = layout.room(situation).size
    poses = layout.poses(situation)
    assert len(poses) == (6 if situation == "copies" else 3)
    for i, (_, name, pose) in enumerate(poses):
        low, high = THINGS[name].shape.bounds()
        corner = torch.cartesian_prod(*torch.stack([low, high]).T)
        at = pose.point_world(corner.double())
        assert bool((at > 0).all()) and bool((at < torch.tensor(size)).all())
        for _, other, there in poses[:i]:
            gap = (pose.translation - there.translation)[:2].norm()
            assert gap > THINGS[name].radius + THINGS[other].radius + APART


def test_a_circle_about_the_origin_holds_each_object():
    from learn.moved_rooms import THINGS

    for thing in THINGS.values():
        x, y, z = thing.shape.bounds()[1].tolist()
        # a box reaches its corner; an upright capsule its radius
        reach = x if thing.shape.kind == "capsule" else np.hypot(x, y)
        assert reach <= thing.radius
        assert z == pytest.approx(thing.half_height)


def test_radios_stand_free_in_every_situation_and_fewer_are_the_first_of_more():
    from learn.moved_rooms import APART, HEARD, NEW, SITUATIONS, Layout

    layout = Layout(7)
    for kind in (HEARD, NEW):
        links = layout.asked("moved", kind, 24)
        for place, situations in ((links.tag, ["moved"]), (links.gateway, SITUATIONS)):
            point = torch.from_numpy(place)
            for situation in situations:
                for node in layout.truth(situation).nodes:
                    away = node.body.shape.sdf(node.pose.point_object(point))
                    assert float(away.min()) > APART
    heard, new = (set(layout.asked("before", k, 24).number.tolist()) for k in (HEARD, NEW))
    assert heard.isdisjoint(new)


def test_an_error_is_against_the_truth_on_the_links_that_matter():
    from learn.moved import Case, Truth
    from learn.moved_page import Result, Results, cell
    from learn.moved_rooms import HEARD, NEW, Layout

    links = Layout(7).asked("before", HEARD, 3)
    true = Truth(links, np.array([-50.0, -60.0, -70.0]), np.array([-50.5, -65.0, -60.0]))
    truth = {"before": {HEARD: true}, "moved": {HEARD: true}}
    said = {
        "before": {HEARD: [-50.0, -61.0, -73.0], NEW: None},
        "moved": {HEARD: [-50.0, -62.0, -76.0]},
    }
    case = Case(7, 50, 2.0, 50, 3)
    results = Results([Result(case, "rfsg", said, truth)])

    def errors(situation, kind, mattering):
        return results.errors("rfsg", 50, 2.0, situation, kind, mattering)

    assert errors("before", HEARD, False).tolist() == [0.0, 1.0, 3.0]
    before, moved = (errors(s, HEARD, True) for s in ("before", "moved"))
    assert before.tolist() == [1.0, 3.0]
    assert errors("before", NEW, True) is None
    # medians 2 and 4; linear interpolation between 2 and 6 puts the 90th percentile at 5.6
    assert cell(moved, before) == "4.00 / 5.60 (x 2.00)"

    from learn.moved_figures import change

    found = change(results, "rfsg", 50, 2.0, (HEARD, NEW))
    assert found is not None
    assert found.ratios == {"moved": 2.0} and found.ratio == 2.0
    assert found.high == pytest.approx(5.6 / 2.8)  # 90th percentiles, interpolated alike
