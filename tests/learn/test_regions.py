"""Regions: nothing lets a wave pass, nothing is learned as nothing, a block is found where it stands."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import rfsg
from rfsg.learn.baselines import Method, Predictor, Readings
from rfsg.learn.errors import LearnError
from rfsg.learn.region_physics import RegionPhysics
from rfsg.learn.regions import (
    QUALITY,
    RECEIVERS,
    REGIONS,
    Budget,
    fit_regions,
    friis_db,
    region_scene,
)
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node
from rfsg.scene.world import World
from rfsg.tracer.embree import Proxies
from rfsg.tracer.march import EVALUATE, crossings
from rfsg.tracer.records import Rays

FREQUENCY = 2.44e9
AREA = torch.tensor([12.0, 9.0, 0.6], dtype=torch.float64)
GATEWAYS = torch.tensor(
    [[0.2, 0.3, 1.5], [11.7, 0.4, 1.6], [0.4, 8.6, 1.4], [11.5, 8.7, 1.5], [6.1, 0.2, 1.6]],
    dtype=torch.float64,
)
# The occupancy of a blurred box is 1/2 + s d / 4 a metre's depth d in: so much is told of lengths.
OCCUPIED = 2e-4
SHORT = Budget(steps=35, batch=32, learning_rate=5e-2, offset_rate=0.4)
BLOCK, HALF = (4.0, 5.0, 1.5), (0.9, 1.1, 3.0)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def places(count: int, seed: int) -> torch.Tensor:
    """Random places in the area, clear of the block."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(2 * count, 3, generator=generator, dtype=torch.float64)
    place = torch.tensor([0.0, 0.0, 1.0]) + share * AREA
    away = (place[:, :2] - torch.tensor(BLOCK[:2])).abs() - torch.tensor(HALF[:2])
    return place[(away > 0.1).any(1)][:count]


def block() -> Node:
    """Wood-like and 0.4 m thick in any direction: about 10 dB."""
    return Node(
        "/block", Body(Box(HALF), Slab(thickness_m=0.4, eps_r=2.0, sigma=0.02)), Pose.at(*BLOCK)
    )


def friis(tx: torch.Tensor, rx: torch.Tensor) -> torch.Tensor:
    apart = (tx[:, None] - rx[None]).norm(dim=-1).flatten()
    return friis_db(apart, torch.full_like(apart, FREQUENCY))


def truth(tx: torch.Tensor, *nodes: Node) -> torch.Tensor:
    """rssi [dBm] from every place to every gateway, 0 dBm sent, through some nodes."""
    sent = [rfsg.Radio.at(f"/t{i}", *p) for i, p in enumerate(tx.tolist())]
    heard = [rfsg.Radio.at(f"/r{i}", *p) for i, p in enumerate(GATEWAYS.tolist())]
    scene = rfsg.Scene(tuple(nodes), tuple(sent), tuple(heard))
    gain = rfsg.simulate(scene, FREQUENCY, QUALITY).path_gain()[..., 0].flatten()
    return 10.0 * torch.log10(gain)


def readings(tx: torch.Tensor, rssi: torch.Tensor) -> Readings:
    g = len(GATEWAYS)
    return Readings(
        tx.repeat_interleave(g, 0).numpy(),
        GATEWAYS.repeat(len(tx), 1).numpy(),
        np.tile(np.arange(g), len(tx)),
        rssi.numpy(),
    )


def said(predictor: Predictor, asked: Readings) -> torch.Tensor:
    mean = predictor.predict(asked.tx_position, asked.rx_position, asked.gateway).mean
    return torch.from_numpy(mean)


# the scene


def test_regions_of_nothing_let_a_wave_pass():
    """Within 0.1 dB of Friis over 15 m, at every angle to the faces; and they are no mirrors."""
    tx = places(4, 0)
    scene = region_scene(tx, GATEWAYS)
    result = rfsg.simulate(scene, FREQUENCY, QUALITY)
    gain = 10.0 * torch.log10(result.path_gain()[..., 0].flatten())
    torch.testing.assert_close(gain, friis(tx, GATEWAYS), rtol=0.0, atol=0.1)
    bounced = rfsg.simulate(scene, FREQUENCY, rfsg.Quality.named("draft", depth=1))
    gain = 10.0 * torch.log10(bounced.path_gain()[..., 0].flatten())
    torch.testing.assert_close(gain, friis(tx, GATEWAYS), rtol=0.0, atol=0.1)


def test_regions_stand_flush_and_hold_every_link():
    """Of each link no metre is outside the regions or in two of them."""
    tx = places(6, 1)
    scene = region_scene(tx, GATEWAYS, cell_m=4.0, height_m=1.0)
    inside = length_inside(scene, tx, GATEWAYS)
    apart = (tx[:, None] - GATEWAYS[None]).norm(dim=-1)
    torch.testing.assert_close(inside, apart, rtol=OCCUPIED, atol=0.0)
    assert all(float(n.body.shape.half_size.max()) <= 2.0 for n in scene.nodes)


def length_inside(scene: rfsg.Scene, tx: torch.Tensor, rx: torch.Tensor) -> torch.Tensor:
    """Metres of links in regions, told by their loss: 1 Np/m in all of them, less the loss of 0."""
    loss = []
    for bulk in (0.0, 1.0):
        nodes = []
        for node in scene.nodes:
            surface = node.body.surface
            filled = type(surface)(**{**surface.config(), "bulk": bulk}).double()
            nodes.append(rfsg.Node(node.path, Body(node.body.shape, filled), node.pose))
        full = rfsg.Scene(tuple(nodes), scene.transmitters, scene.receivers)
        loss.append(-rfsg.simulate(full, FREQUENCY, QUALITY).path_gain()[..., 0].log())
    return loss[1] - loss[0]


@pytest.mark.parametrize("side", [(1, 0, 0), (0, 1, 0), (1, 1, 0)])
def test_a_link_along_a_seam_is_in_one_region_at_a_time(side):
    """In a face between two regions, and in an edge between four."""
    scene = region_scene(places(30, 2), GATEWAYS, height_m=1.0)
    node = next(n for n in scene.nodes if n.path == f"{REGIONS}/x1_y1_z0")
    half, way = node.body.shape.half_size.detach(), torch.tensor([0.0, 0.0, 1.0])
    if side != (1, 1, 0):
        way = torch.tensor([side[1], side[0], 0.0])
    at = half * torch.tensor(side) + 0.1 * way
    begin, end = (node.pose.point_world(at + s * way.double()) for s in (-0.3, 0.4))
    apart = (end - begin).norm()
    ray = Rays(begin[None], ((end - begin) / apart)[None], apart[None])
    world = World(scene)
    met = crossings(world, ray, Proxies(world).spans(ray), EVALUATE)
    assert float((met.leave - met.enter).sum()) == pytest.approx(0.7, abs=1e-7)
    assert bool((met.enter[1:] >= met.leave[:-1] - 1e-7).all())


def test_cells_that_no_link_crosses_are_left_out():
    tx = torch.tensor([[0.0, 0.0, 1.0], [0.0, 20.0, 1.0], [20.0, 0.0, 1.0]], dtype=torch.float64)
    rx = torch.tensor([[20.0, 0.1, 1.0], [0.1, 20.0, 1.0]], dtype=torch.float64)
    links = torch.tensor([[0, 0], [0, 1]])
    some, every = region_scene(tx, rx, links=links), region_scene(tx, rx)
    assert 2 <= len(some.nodes) < len(every.nodes)
    assert {n.path for n in some.nodes} < {n.path for n in every.nodes}


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"cell_m": 0.05}, "regions over"),
        ({"cell_m": -1.0}, "cell_m=-1.0"),
        ({"margin_m": 0.0}, "margin_m=0.0"),
        ({"height_m": math.nan}, "height_m=nan"),
    ],
)
def test_sizes_that_cannot_be_are_refused(options, told):
    with pytest.raises(LearnError, match=told):
        region_scene(places(5, 0), GATEWAYS, **options)


def test_positions_that_cannot_be_are_refused():
    with pytest.raises(LearnError, match="finite"):
        region_scene(torch.full((1, 3), math.nan), GATEWAYS)
    with pytest.raises(LearnError, match="length of 0"):
        region_scene(GATEWAYS[:1], GATEWAYS[:1])
    named = rfsg.Measurements.of(tx=["a"], rx=["b"], rssi_dbm=[-50.0], frequency_hz=FREQUENCY)
    with pytest.raises(LearnError, match="'a' is given by name"):
        fit_regions(named)


# the fit


def test_an_empty_building_is_learned_as_empty():
    tx, unseen = places(20, 3), places(10, 4)
    method = RegionPhysics(cell_m=6.0, budget=SHORT)
    assert isinstance(method, Method)
    predictor = method.fit(readings(tx, truth(tx)))
    asked = readings(unseen, friis(unseen, GATEWAYS))
    torch.testing.assert_close(said(predictor, asked), friis(unseen, GATEWAYS), rtol=0.0, atol=0.3)


def test_a_block_is_found():
    """Unseen links through it: less than 0.4 of Friis' error, for it fills no whole cell. Beside it:
    half of them within 0.5 dB, and 0.9 within a quarter of its loss."""
    tx, unseen = places(60, 5), places(40, 6)
    asked = readings(unseen, truth(unseen, block()))
    method = RegionPhysics(budget=replace(SHORT, receiver_gains=False))
    predictor = method.fit(readings(tx, truth(tx, block())))
    measured = torch.from_numpy(asked.rssi)
    off = (said(predictor, asked) - measured).abs()
    off_friis = (friis(unseen, GATEWAYS) - measured).abs()
    through = off_friis > 0.01
    assert 20 < int(through.sum()) < 100
    assert off[through].median() < 0.4 * off_friis[through].median()
    assert (
        off[~through].median() < 0.5
        and off[~through].quantile(0.9) < 0.25 * off_friis[through].median()
    )
    assert isinstance(predictor, Predictor)


def test_readings_of_moved_positions_teach_the_same():
    """Turned about z and shifted: the same regions, networks and batches, so the training noise is the
    same too; float32 rounding of local coordinates remains, grown over the steps: 0.05 dB."""
    tx, unseen = places(16, 7), places(8, 8)
    move = Pose.at(31.0, -17.0, 4.0, 37.0)
    method = RegionPhysics(cell_m=6.0, budget=Budget(steps=10, learning_rate=1e-1))
    here = readings(tx, truth(tx, block()))
    asked = readings(unseen, friis(unseen, GATEWAYS))
    still = said(method.fit(here), asked)
    moved = said(method.fit(shifted(here, move)), shifted(asked, move))
    torch.testing.assert_close(moved, still, rtol=0.0, atol=0.05)
    assert (still - torch.from_numpy(asked.rssi)).abs().max() > 1.0  # something was learned


def shifted(some: Readings, move: Pose) -> Readings:
    ends = (some.tx_position, some.rx_position)
    tx, rx = (move.point_world(torch.from_numpy(p)).numpy() for p in ends)
    return Readings(tx, rx, some.gateway, some.rssi)


def test_offsets_come_back():
    """A level 25 dB down, one deaf gateway, places given by position; the scene holds the level."""
    tx = places(20, 9)
    rssi = (friis(tx, GATEWAYS).reshape(-1, len(GATEWAYS)) - 25.0).clone()
    rssi[:, 2] -= 4.0
    rows = [(t, r) for t in tx.tolist() for r in GATEWAYS.tolist()]
    columns = {f"tx_{a}_m": [t[i] for t, _ in rows] for i, a in enumerate("xyz")}
    columns |= {f"rx_{a}_m": [r[i] for _, r in rows] for i, a in enumerate("xyz")}
    measured = rfsg.Measurements.of(
        **columns, rssi_dbm=rssi.flatten().tolist(), frequency_hz=FREQUENCY
    )
    fitted = fit_regions(measured, cell_m=6.0, budget=SHORT)
    gains = torch.tensor([fitted.gains_db[f"{RECEIVERS}/r{i}"] for i in range(len(GATEWAYS))])
    level = fitted.report["offsets"]["power_db"]
    assert level == pytest.approx(fitted.scene.transmitters[0].power_dbm)
    wanted = torch.tensor([0.0, 0.0, -4.0, 0.0, 0.0]) - 25.0
    torch.testing.assert_close(gains + level, wanted, rtol=0.0, atol=0.3)
    plain = fitted.predict(measured).rssi_dbm().reshape(rssi.shape)
    torch.testing.assert_close(plain[:, 2] + gains[2], rssi[:, 2], rtol=0.0, atol=0.3)


def test_a_radio_at_its_receiver_is_predicted():
    tx = places(5, 10)
    predictor = RegionPhysics(cell_m=6.0, budget=Budget(steps=2)).fit(readings(tx, truth(tx)))
    same = GATEWAYS[:1].numpy()
    for gateway in (0, 77):
        assert np.isfinite(predictor.predict(same, same, np.array([gateway])).mean).all()
