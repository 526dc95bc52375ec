"""Radio maps: the rays' mean over a cell against the path solver at its centre."""

import pytest
import torch

from rfsg.scene.scene import Scene, SceneError
from rfsg.tracer.montecarlo import estimate_power
from rfsg.tracer.plan import Quality
from rfsg.tracer.radiomap import radio_map
from tests.scenes import room

QUALITY = Quality(depth=1, map_rays=120_000, floor_db=-100.0)
BOUNDS = (0.0, 0.0, 6.0, 4.0)


def test_map_agrees_with_the_path_solver_within_its_error():
    scene = room()
    options = dict(height=1.2, cell=1.0, bounds=BOUNDS, quality=QUALITY)
    rays = radio_map(scene, 2.4e9, **options)
    paths = radio_map(scene, 2.4e9, method="paths", **options)
    assert rays.path_gain.shape == (1, 4, 6)
    assert bool(torch.isfinite(rays.error_db).all()) and bool((paths.error_db == 0).all())
    difference = (10 * torch.log10(rays.path_gain / paths.path_gain)).abs()
    # one standard deviation holds two cells in three, two hold all but one in twenty
    assert float((difference <= rays.error_db).double().mean()) >= 0.68
    assert float((difference <= 2 * rays.error_db).double().mean()) >= 0.95
    assert float(rays.error_db.median()) < 2.0


def test_seeds_scatter_within_the_reported_error():
    scene = room()
    options = dict(height=1.2, cell=1.0, bounds=BOUNDS, quality=QUALITY)
    one, two = (radio_map(scene, 2.4e9, seed=s, **options) for s in (0, 1))
    again = radio_map(scene, 2.4e9, seed=0, **options)
    assert torch.equal(one.path_gain, again.path_gain)
    difference = (10 * torch.log10(one.path_gain / two.path_gain)).abs()
    assert float(difference.amax()) > 0.0
    assert bool((difference <= 3 * one.error_db).all())


def test_empty_and_wrong_questions():
    alone = Scene((), room().transmitters, ())
    gain = radio_map(alone, 2.4e9, bounds=BOUNDS, quality=QUALITY, cell=2.0).path_gain
    assert bool((gain > 0).all())
    with pytest.raises(SceneError, match="extent"):
        radio_map(Scene(()), 2.4e9)
    with pytest.raises(SceneError, match="method"):
        radio_map(alone, 2.4e9, method="magic")
    with pytest.raises(SceneError, match="cells"):
        radio_map(alone, 2.4e9, bounds=BOUNDS, cell=1e-4)
    with pytest.raises(ValueError, match="branching"):
        estimate_power(alone.with_receivers(room().receivers), 2.4e9, QUALITY, branching="both")
