"""Two searches, one answer: sequences enumerated against rays launched."""

from dataclasses import replace

import pytest
import torch

from rfsg.scene.scene import Scene, SceneError
from rfsg.tracer.launch import fibonacci
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate
from tests.laws.test_simulation_laws import furnished
from tests.scenes import radio, room, vector

QUALITY = Quality(depth=2, rays=8000, floor_db=-100.0)


def _planar_paths(result):
    flat = {i for i, n in enumerate(result.scene.nodes) if n.body.shape.kind == "box"}
    out = set()
    for p in range(len(result.paths.tx)):
        chain = tuple(w for w in result.paths.which[p].tolist() if w >= 0)
        if set(chain) <= flat:
            ends = (int(result.paths.tx[p]), int(result.paths.rx[p]))
            out.add((*ends, chain, round(float(result.paths.length[p]), 7)))
    return out


def test_rays_find_nothing_that_the_enumeration_misses():
    scene = furnished()
    every = simulate(scene, quality=replace(QUALITY, search="enumerate"))
    rays = simulate(scene, quality=replace(QUALITY, search="rays"))
    assert every.search.complete and not rays.search.complete
    all_of_them, some = _planar_paths(every), _planar_paths(rays)
    assert some <= all_of_them
    assert len(some) > 0.95 * len(all_of_them)


def test_rays_find_the_whole_room():
    """The issue's box room to depth three, by launched rays alone."""
    result = simulate(room(), quality=Quality(search="rays", floor_db=-200.0))
    assert torch.bincount(result.paths.rx).tolist() == [63] * 4


def test_lattice_is_even():
    direction = fibonacci(2000)
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(2000).double())
    assert float(direction.mean(0).norm()) < 1e-3
    nearest = (direction @ direction.T).fill_diagonal_(-1).amax(1).clamp(max=1.0).acos()
    spacing = (4 * torch.pi / 2000) ** 0.5
    assert float(nearest.min()) > 0.6 * spacing and float(nearest.max()) < 1.2 * spacing


def test_doppler_of_moving_radios():
    """A receiver leaving at v sees -f v / c on the line of sight; a transmitter approaching, +f v / c."""
    away = replace(radio("/r", 10.0, 0.0, 0.0), velocity=vector(3.0, 0.0, 0.0))
    result = simulate(Scene((), (radio("/t", 0.0, 0.0, 0.0),), (away,)), 3e9)
    assert float(result.channel.doppler[0]) == pytest.approx(-3e9 * 3.0 / 299_792_458.0, rel=1e-12)
    coming = replace(radio("/t", 0.0, 0.0, 0.0), velocity=vector(3.0, 4.0, 0.0))
    result = simulate(Scene((), (coming,), (radio("/r", 10.0, 0.0, 0.0),)), 3e9)
    assert float(result.channel.doppler[0]) == pytest.approx(3e9 * 3.0 / 299_792_458.0, rel=1e-12)


def test_doppler_of_a_moving_mirror():
    """A wall that approaches at v shortens the echo by 2 v per second at normal incidence."""
    scene = room(receivers=((2.0, 2.0, 1.5),), transmitter=(2.0, 2.0, 1.4))
    nodes = tuple(
        replace(n, velocity=vector(-1.0, 0, 0)) if n.path == "/x1" else n for n in scene.nodes
    )
    result = simulate(replace(scene, nodes=nodes), 2.4e9, Quality(depth=1))
    index = scene.index("/x1")
    p = int(torch.nonzero((result.paths.which == index).any(1))[0])
    u = result.paths.vertices[p, 1] - result.paths.vertices[p, 0]
    cosine = float(u[0] / u.norm())
    assert float(result.channel.doppler[p]) == pytest.approx(
        2 * cosine * 2.4e9 / 299_792_458.0, rel=1e-9
    )


def test_frequency_is_needed_and_quality_is_checked(monkeypatch):
    scene = replace(room(), frequency=None)
    with pytest.raises(SceneError, match="frequency"):
        simulate(scene)
    with pytest.raises(SceneError, match="frequency"):
        simulate(scene, -1.0)
    with pytest.raises(ValueError, match="draft, standard, reference"):
        simulate(scene, 1e9, "best")
    with pytest.raises(ValueError, match="dept"):
        Quality.named("draft", dept=2)
    monkeypatch.setattr("rfsg.tracer.sequences.MOST_PAIRS", 1000)
    with pytest.raises(ValueError, match="enumerate"):
        simulate(furnished(), 1e9, Quality(search="enumerate"))
    assert not simulate(furnished(), 1e9, Quality(depth=1, rays=500)).search.complete
