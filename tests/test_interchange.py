"""Channels in other tools' layouts: closed forms in free space, nothing lost, padding as they pad."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import rfsg
from rfsg.interchange import deepmimo_matrices, sionna_cir, write_deepmimo, write_sionna
from rfsg.report import OutputExists

ROOM = Path(__file__).parents[1] / "assets" / "scenes" / "room.usda"
FREQUENCY, LIGHT = 3.0e9, 299_792_458.0
TX = (rfsg.Radio.at("/tx_0", 0.0, 0.0, 1.0), rfsg.Radio.at("/tx_1", 0.0, 9.0, 2.0))
RX = (
    rfsg.Radio.at("/rx_0", 3.0, 4.0, 1.0),
    rfsg.Radio.at("/rx_1", -2.0, 1.0, 0.5),
    rfsg.Radio.at("/rx_2", 0.0, 0.0, 6.0),
)


def distance() -> np.ndarray:
    """[rx, tx]"""
    return np.array([[float((r.position - t.position).norm()) for t in TX] for r in RX])


@pytest.fixture(scope="module")
def free_space():
    return rfsg.simulate(rfsg.Scene(transmitters=TX, receivers=RX), FREQUENCY)


@pytest.fixture(scope="module")
def room():
    """Reflections off six walls, and penetration."""
    return rfsg.simulate(rfsg.Scene.from_usd(ROOM), FREQUENCY, rfsg.Quality(depth=2))


def test_free_space_is_friis_with_the_carriers_phase(free_space):
    """a = lambda / (4 pi d) exp(-j 2 pi f d / c), tau = d / c: baseband, as Sionna RT defines it."""
    cir = sionna_cir(free_space, normalize_delays=False)
    assert cir.a.shape == (3, 1, 2, 1, 1, 1) and cir.tau.shape == (3, 2, 1)
    d = distance()
    expected = LIGHT / FREQUENCY / (4 * math.pi * d) * np.exp(-2j * math.pi * FREQUENCY * d / LIGHT)
    np.testing.assert_allclose(cir.a[:, 0, :, 0, 0, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(cir.tau[..., 0], d / LIGHT, rtol=1e-12)


def test_normalized_delays_begin_at_zero_and_count_phases_from_there(free_space):
    cir = sionna_cir(free_space)
    np.testing.assert_array_equal(cir.tau, 0.0)
    np.testing.assert_allclose(cir.a.imag, 0.0, atol=1e-12)  # a single path in free space: real
    batch = cir.batched()
    assert batch.a.shape == (1, *cir.a.shape) and batch.tau.shape == (1, *cir.tau.shape)


def test_the_sum_of_all_coefficients_is_the_channel(room):
    """Nothing is dropped by the layout: sum over paths of a = h(f), per port."""
    cir = sionna_cir(room, normalize_delays=False)
    total = cir.a.sum((-2, -1))[:, 0, :, 0].T
    np.testing.assert_allclose(total, room.transfer()[..., 0].numpy(), rtol=1e-9)
    absent = cir.tau < 0
    assert (np.abs(cir.a[:, 0, :, 0, :, 0])[absent] == 0).all()
    assert (~absent).sum() == len(room.paths.tx)


def test_ports_are_those_of_mimo():
    array = rfsg.Array.planar(2, 2)
    tx = rfsg.Radio.at("/tx", 0, 0, 1, array=array, polarization="VH")
    rx = (
        rfsg.Radio.at("/rx_0", 5, 1, 1, polarization="cross"),
        rfsg.Radio.at("/rx_1", 2, 4, 1, polarization="V", array=array),
    )
    result = rfsg.simulate(rfsg.Scene(transmitters=(tx,), receivers=rx), FREQUENCY)
    cir = sionna_cir(result, normalize_delays=False)
    assert cir.a.shape[:4] == (2, 4, 1, 8)
    expected = rfsg.mimo(result).padded()[0, :, 0].numpy()  # rx, n_rx, n_tx
    np.testing.assert_allclose(cir.a.sum((-2, -1))[:, :, 0], expected, atol=1e-15)


def test_doppler_turns_the_coefficients():
    """A receiver that leaves at v: exp(-j 2 pi (v / lambda) t)."""
    away = rfsg.Radio.at("/rx", 10, 0, 1, velocity=torch.tensor([3.0, 0, 0], dtype=torch.float64))
    result = rfsg.simulate(rfsg.Scene(transmitters=TX[:1], receivers=(away,)), FREQUENCY)
    time = torch.tensor([0.0, 1e-3, 2e-3])
    a = sionna_cir(result, time=time).a[0, 0, 0, 0, 0]
    turn = np.exp(-2j * np.pi * 3.0 * FREQUENCY / LIGHT * time.double().numpy())
    np.testing.assert_allclose(a / a[0], turn, rtol=1e-6)


def test_too_large_is_refused_before_memory_is_taken(free_space):
    time = torch.zeros(2**25)
    with pytest.raises(rfsg.SceneError, match="impulse response of .* expected at most"):
        sionna_cir(free_space, time=time)


def test_deepmimo_has_friis_in_decibels_and_zenith_angles(free_space):
    found = deepmimo_matrices(free_space, 0)
    d = distance()[:, 0]
    expected = 20 * np.log10(LIGHT / FREQUENCY / (4 * math.pi * d))
    np.testing.assert_allclose(found["power"][:, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(found["delay"][:, 0], d / LIGHT, rtol=1e-12)
    assert found["inter"].tolist() == [[0.0]] * 3
    assert found["aod_el"][2, 0] == pytest.approx(0.0, abs=1e-6)  # straight up
    assert found["aoa_el"][2, 0] == pytest.approx(180.0, abs=1e-6)
    assert found["aod_az"][0, 0] == pytest.approx(math.degrees(math.atan2(4, 3)))
    assert found["tx_pos"].shape == (1, 3) and found["rx_pos"].shape == (3, 3)


def test_deepmimo_says_what_happens_and_where(room):
    found = deepmimo_matrices(room, 0)
    codes = found["inter"][np.isfinite(found["inter"])]
    assert 1.0 in codes and set("".join(str(int(c)) for c in codes)) <= set("01234")
    amplitude = 10 ** (found["power"] / 20) * np.exp(1j * np.radians(found["phase"]))
    total = np.where(np.isnan(found["power"]), 0.0, amplitude).sum(1)
    np.testing.assert_allclose(total, room.transfer()[0, :, 0].numpy(), rtol=1e-9)
    one = np.argwhere(found["inter"] == 1.0)[0]
    place = found["inter_pos"][tuple(one)][0]
    length = np.linalg.norm(place - found["tx_pos"][0]) + np.linalg.norm(
        place - found["rx_pos"][one[0]]
    )
    assert length / LIGHT == pytest.approx(found["delay"][tuple(one)], rel=1e-9)


def test_a_scenario_folder_is_whole_or_not_there(free_space, tmp_path):
    folder = write_deepmimo(free_space, tmp_path / "hall")
    params = json.loads((folder / "params.json").read_text())
    assert [s["num_points"] for s in params["txrx_sets"].values()] == [2, 3]
    for i in range(2):
        with np.load(folder / f"power_t000_tx{i:03}_r001.npz") as file:
            np.testing.assert_array_equal(file["power"], deepmimo_matrices(free_space, i)["power"])
    with pytest.raises(OutputExists):
        write_deepmimo(free_space, folder)
    with pytest.raises(rfsg.SceneError, match="lower case"):
        write_deepmimo(free_space, tmp_path / "Hall")


def test_the_sionna_file_has_a_batch_axis(free_space, tmp_path):
    file = write_sionna(free_space, tmp_path / "cir.npz")
    with np.load(file) as found:
        assert found["a"].shape == (1, 3, 1, 2, 1, 1, 1)
        assert found["rx_paths"].tolist() == [r.path for r in RX]
    assert [f.name for f in tmp_path.iterdir()] == ["cir.npz"]
