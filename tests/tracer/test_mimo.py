"""MIMO matrices: array factors, ranks, polarisation, and plane waves against every element alone."""

import math

import numpy as np
import pytest
import torch

from rfsg import report
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import HalfSpace
from rfsg.objects.surfaces.interface import DielectricHalfSpace
from rfsg.scene.arrays import Array
from rfsg.scene.errors import SceneError
from rfsg.scene.patterns import Pattern
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer import mimo as module
from rfsg.tracer.mimo import capacity, mimo, plane_wave_errors
from rfsg.tracer.simulate import simulate
from tests.scenes import room_nodes

C = 299_792_458.0
F = 2.4e9
K = 2 * math.pi * F / C


def run(tx, rx, nodes=(), frequency=F, **options):
    tx, rx = (r if isinstance(r, tuple) else (r,) for r in (tx, rx))
    return simulate(Scene(nodes, tx, rx), frequency, **options)


def matrix(tx, rx, nodes=(), synthetic=True, frequency=F):
    """The matrix [n_rx, n_tx] of one link at one frequency."""
    return mimo(run(tx, rx, nodes, frequency), synthetic).blocks[0][0][0]


def ground() -> tuple[Node, ...]:
    earth = DielectricHalfSpace(eps_r=5.0, sigma=0.01)
    return (Node("/ground", Body(HalfSpace(), earth), Pose.identity()),)


def rolled(radio: Radio, degrees: float) -> Radio:
    """The radio turned about its own boresight."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    roll = torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64)
    return Radio(**{**vars(radio), "rotation": radio.rotation @ roll})


# array factors


@pytest.mark.parametrize("azimuth", [-72.0, -30.0, 3.0, 17.0, 45.0, 80.0])
@pytest.mark.parametrize("spacing", [0.25, 0.5, 1.3])
def test_a_row_has_the_array_factor_of_the_textbook(azimuth, spacing):
    """|sum| = |sin(N psi / 2) / sin(psi / 2)|, psi = k d sin(azimuth) (Balanis section 6.3)."""
    n, far, angle = 7, 1e3, math.radians(azimuth)
    tx = Radio.at("/t", 0, 0, 0, array=Array.planar(1, n, 0.5, spacing))
    rx = Radio.at("/r", far * math.cos(angle), far * math.sin(angle), 0)
    h = matrix(tx, rx)[0]
    psi = 2 * math.pi * spacing * math.sin(angle)
    expected = abs(math.sin(n * psi / 2) / math.sin(psi / 2))
    assert float(h.sum().abs() / h[0].abs()) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    # and with its sign: elements further along +y are nearer to a receiver at positive azimuth
    step = torch.tensor(complex(math.cos(psi), math.sin(psi)), dtype=torch.complex128)
    torch.testing.assert_close(h[1:] / h[:-1], step.expand(n - 1), rtol=1e-9, atol=1e-9)


def test_a_panel_is_the_product_of_its_row_and_its_column():
    rx = Radio.at("/r", 300, 120, -40)
    row, column, panel = (
        matrix(Radio.at("/t", 0, 0, 0, 25.0, array=Array.planar(m, n, 0.7, 0.5)), rx)[0]
        for m, n in ((1, 4), (3, 1), (3, 4))
    )
    centre = matrix(Radio.at("/t", 0, 0, 0, 25.0), rx)[0]
    product = torch.outer(row, column).flatten() / centre  # columns first, rows fastest
    torch.testing.assert_close(panel, product, rtol=1e-9, atol=0)


def test_a_receiver_that_steers_hears_all_elements_in_phase():
    """The arrival direction points back to the wave: conjugate phases add to N."""
    rx = Radio.at("/r", 0, 0, 0, 60.0, array=Array.planar(4, 4))
    tx = Radio.at("/t", 400, 300, 50)
    h = matrix(tx, rx)[:, 0]
    towards = torch.nn.functional.normalize(tx.position - rx.position, dim=0)
    assert rx.array is not None
    place = rx.array.metres(C / F) @ rx.rotation.T
    weights = torch.exp(-1j * K * (place @ towards))
    assert float((weights * h).sum().abs() / h.abs().sum()) == pytest.approx(1.0, abs=1e-12)


# against every element alone


DISTANCES = (20.0, 40.0, 80.0, 160.0)


def ends(d: float, polarization: str) -> tuple[Radio, Radio]:
    """Two panels; with the distance everything scales but they, so that angles stay."""
    options = {"polarization": polarization, "pattern": "half_wave_dipole"}
    tx = Radio.at("/t", 0, 0, 0.5 * d, 20.0, array=Array.planar(3, 4), **options)
    return tx, Radio.at("/r", d, 0.2 * d, 0.3 * d, 150.0, array=Array.planar(2, 2), **options)


@pytest.mark.parametrize("polarization", ["none", "cross"])
def test_plane_waves_err_as_one_over_the_distance(polarization):
    errors = []
    for d in DISTANCES:
        result = run(*ends(d, polarization))
        near, exact = (mimo(result, synthetic).blocks[0][0] for synthetic in (True, False))
        errors.append(float((near - exact).norm() / exact.norm()))
    slope = np.polyfit(np.log(DISTANCES), np.log(errors), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.05)
    assert errors[-1] < 0.01


@pytest.mark.parametrize("polarization", ["none", "cross"])
def test_plane_waves_err_as_little_over_ground(polarization):
    """Every entry within the phase bound of its paths, and what turns with their directions: gains
    and coefficients, of first order in the arrays' size over the distance."""
    for d in DISTANCES[::3]:
        tx, rx = ends(d, polarization)
        result = run(tx, rx, ground())
        near, exact = (mimo(result, synthetic).blocks[0][0] for synthetic in (True, False))
        free = C / F / (4 * math.pi) * result.paths.spread
        size = sum(float(r.array.metres(C / F).norm(dim=-1).max()) for r in (tx, rx) if r.array)
        limit = max(plane_wave_errors(result).values()) + 3 * size / (0.5 * d)
        assert len(free) == 2 and limit < 45.0 / d
        most = 1.64 * float(free.sum())  # two dipoles, both paths in phase
        assert float((near - exact).abs().max()) < limit * most


@pytest.mark.parametrize("distance", [1.5, 4.0, 30.0])
def test_the_bound_holds_and_is_not_idle(distance):
    """k (a + b)^2 / (2 r) bounds the phase of every pair; a quarter of it is reached broadside."""
    tx = Radio.at("/t", 0, 0, 0, array=Array.planar(3, 3))
    rx = Radio.at("/r", distance, 0, 0, 180.0, array=Array.planar(2, 2, 0.6, 0.9))
    result = run(tx, rx)
    near, exact = (mimo(result, s).blocks[0][0][0] for s in (True, False))
    off = float((near / exact).angle().abs().max())
    bound = plane_wave_errors(result)
    assert set(bound) == {"/t", "/r"} and bound["/t"] == pytest.approx(bound["/r"])
    assert 0.25 * bound["/t"] < off <= bound["/t"]


def test_the_bound_in_a_room_is_that_of_the_nearest_wall():
    tx = Radio.at("/t", 0.5, 2, 1.5, array=Array.planar(1, 2, 0.5, 0.2, "m"))
    rx = Radio.at("/r", 4, 2.2, 1.4)
    bound = plane_wave_errors(run(tx, rx, room_nodes()))
    assert set(bound) == {"/t"}  # a single antenna makes no error of its own
    # all first segments are at least as long as the way to the wall behind, 0.5 m, and one nearly is
    assert 0.9 * K * 0.1**2 / (2 * 0.5) < bound["/t"] <= K * 0.1**2 / (2 * 0.5)


def test_a_warning_names_the_radio_whose_array_is_too_large():
    """Within 2 D^2 / lambda the phase is off by more than pi / 8 (IEEE Std 145)."""
    array = Array.planar(1, 9)
    diameter = 8 * 0.5 * C / F
    fraunhofer = 2 * diameter**2 / (C / F)
    for distance, words in ((1.01 * fraunhofer, 0), (0.99 * fraunhofer, 1)):
        tx = Radio.at("/base", 0, 0, 0, array=array)
        result = run(tx, Radio.at("/phone", distance, 0, 0))
        warnings = mimo(result).warnings
        assert len(warnings) == words and all(w.startswith("/base: ") for w in warnings)
    assert mimo(result, synthetic=False).warnings == ()
    assert "22 degrees" in warnings[0] or "23 degrees" in warnings[0]


# ranks and polarisation


def test_free_space_has_one_mode_and_two_polarisations_have_two():
    place = {"array": Array.planar(2, 3)}
    for polarization, rank in (("none", 1), ("V", 1), ("VH", 2), ("cross", 2)):
        tx = Radio.at("/t", 0, 0, 10, 15.0, polarization=polarization, **place)
        rx = Radio.at("/r", 800, 100, 3, 170.0, polarization=polarization, **place)
        modes = torch.linalg.svdvals(matrix(tx, rx))
        assert int((modes > 1e-9 * modes[0]).sum()) == rank
        if rank == 2:  # equal, and each as strong as the one
            assert float(modes[1] / modes[0]) == pytest.approx(1.0, abs=1e-9)


def test_a_wall_adds_a_mode_to_line_of_sight():
    tx = Radio.at("/t", 0, 0, 10, array=Array.planar(8, 1))
    rx = Radio.at("/r", 20, 0, 8, 180.0, array=Array.planar(8, 1))
    modes = torch.linalg.svdvals(matrix(tx, rx, ground()))
    assert int((modes > 1e-9 * modes[0]).sum()) == 2


def facing(polarization, **options):
    tx = Radio.at("/t", 0, 0, 0, polarization=polarization, **options)
    return tx, Radio.at("/r", 50, 0, 0, 180.0, polarization=polarization, **options)


def test_vertical_and_horizontal_in_line_of_sight():
    """The matrix of TR 38.901 Eq. 7.5-29: diag(1, -1), and nothing across."""
    h = matrix(*facing("VH")) / matrix(*facing("none"))
    torch.testing.assert_close(h.real, torch.diag(torch.tensor([1.0, -1.0]).double()))
    assert float(h.imag.abs().max()) < 1e-12


def test_slants_that_face_each_other_are_crossed():
    """+45 seen from the front leans the other way: all power goes to the other slant, none straight."""
    h = (matrix(*facing("cross")) / matrix(*facing("none"))).abs()
    expected = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(h, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 90.0])
def test_a_rolled_radio_hears_the_cosine(degrees):
    """Malus: a receiver rolled by some angle hears V with its cosine and H with its sine; on its
    side its V is H."""
    tx, rx = facing("VH")
    h = (matrix(tx, rolled(rx, degrees)) / matrix(*facing("none"))).real
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    expected = torch.tensor([[c, s], [s, c]], dtype=torch.float64)
    torch.testing.assert_close(h.abs(), expected, atol=1e-9, rtol=0)
    assert float(torch.linalg.det(h)) == pytest.approx(-1.0)  # a turn, and the mirror of facing


def test_reciprocity_in_a_room():
    """Swapping the ends transposes the matrix, polarised arrays and reflections included."""
    options = {"polarization": "cross", "pattern": "tr38901"}
    a = Radio.at("/a", 1.3, 2.1, 1.7, 30.0, array=Array.planar(2, 2), **options)
    b = Radio.at("/b", 5.1, 3.2, 1.1, 200.0, array=Array.planar(1, 3), **options)
    there, back = matrix(a, b, room_nodes()), matrix(b, a, room_nodes())
    assert float((there - back.T).norm() / there.norm()) < 1e-9


def test_the_reference_ports_are_the_first_ports():
    options = {"polarization": "VH", "pattern": "half_wave_dipole"}
    tx, rx = Radio.at("/t", 1, 1, 1, **options), Radio.at("/r", 4, 3, 2, 70.0, **options)
    result = run(tx, rx, room_nodes())
    h = mimo(result).link("/t", "/r")
    torch.testing.assert_close(h[:, 0, 0], result.transfer()[0, 0], rtol=1e-9, atol=0)


def test_an_unpolarised_radio_beside_a_polarised_one_counts_as_v():
    tx, rx = facing("VH")
    plain = Radio.at("/r", 50, 0, 0, 180.0)
    torch.testing.assert_close(matrix(tx, plain), matrix(tx, rx)[:1])


def test_a_measured_pattern_takes_part():
    """A gain of 6 dB and a phase of the whole file come through to every entry."""
    field = torch.zeros(3, 2, 2, dtype=torch.complex128)
    field[1:2, :, 0] = 2j  # theta field at the horizon
    pattern = Pattern.from_samples("p", np.array([0.0, 90, 180]), np.array([0.0, 180]), field)
    tx, rx = facing("VH")
    measured = Radio.at("/t", 0, 0, 0, polarization="VH", pattern=pattern)
    torch.testing.assert_close(matrix(measured, rx), 2j * matrix(tx, rx))


# frequencies, units, labels


def test_elements_stay_where_they_are_over_a_band():
    """Wavelengths are those of the first frequency, or of the radio's own."""
    band = torch.tensor([2.0e9, 2.6e9], dtype=torch.float64)
    angle = math.radians(40.0)
    rx = Radio.at("/r", 1e3 * math.cos(angle), 1e3 * math.sin(angle), 0)
    for own, carrier in ((None, 2.0e9), (2.6e9, 2.6e9)):
        tx = Radio.at("/t", 0, 0, 0, frequency=own, array=Array.planar(1, 2))
        h = mimo(run(tx, rx, frequency=band)).blocks[0][0][:, 0]
        psi = 2 * math.pi * band / C * 0.5 * C / carrier * math.sin(angle)
        torch.testing.assert_close((h[:, 1] / h[:, 0]).angle(), psi, rtol=1e-9, atol=0)


def test_radios_of_one_scene_may_differ():
    base = Radio.at("/base", 0, 0, 5, polarization="cross", array=Array.planar(2, 2))
    relay = Radio.at("/relay", 5, 0, 3, polarization="V")
    phones = (Radio.at("/a", 30, 3, 1, polarization="VH"), Radio.at("/b", 40, -3, 1))
    found = mimo(run((base, relay), phones, ground(), torch.tensor([F, 2 * F])))
    assert found.link("/base", "/a").shape == (2, 2, 8)
    assert found.link("/relay", "/b").shape == (2, 1, 1)
    assert found.tx_ports[0][:5] == ("+45:0", "+45:1", "+45:2", "+45:3", "-45:0")
    assert found.rx_ports == (("V:0", "H:0"), ("none:0",))
    whole = found.padded()
    assert whole.shape == (2, 2, 2, 2, 8)
    torch.testing.assert_close(whole[0, 0], found.link("/base", "/a"))
    assert not bool(whole[1, 1, :, 1:].any()) and not bool(whole[1, 1, :, :, 1:].any())
    with pytest.raises(SceneError, match="^/c: no such radio here; there are /a, /b"):
        found.link("/base", "/c")


def test_ports_of_a_polarisation_stand_together():
    """Polarisation slowest: each quarter of the matrix is one polarisation pair over all elements."""
    array = Array.planar(2, 2)
    tx, rx = facing("VH", array=array)
    h = matrix(tx, rx)
    v, _ = facing("V", array=array), None
    torch.testing.assert_close(h[:4, :4], matrix(*v))
    torch.testing.assert_close(h[4:, 4:], -matrix(*v))
    assert float(h[:4, 4:].abs().max()) < 1e-12 * float(h.abs().max())


def test_no_path_no_channel():
    steel = room_nodes(wall=0.1)
    h = matrix(Radio.at("/t", 1, 1, 1, array=Array.planar(1, 2)), Radio.at("/r", 1e4, 9, 1), steel)
    assert h.shape == (1, 2) and bool(torch.isfinite(h.real).all())
    found = mimo(run(Radio.at("/t", 1, 1, 1), ()))
    assert found.blocks == ((),) and found.padded().shape[:2] == (1, 0)


def test_sizes_are_bounded(monkeypatch):
    result = run(Radio.at("/t", 0, 0, 0, array=Array.planar(2, 2)), Radio.at("/r", 9, 0, 0))
    monkeypatch.setattr(module, "MAX_EXACT_ELEMENTS", 3)
    with pytest.raises(SceneError, match="4 transmitting elements; .* at most 3"):
        mimo(result, synthetic=False)
    monkeypatch.setattr(module, "MAX_ENTRIES", 3)
    with pytest.raises(SceneError, match="4 entries in all matrices; the limit is 3"):
        mimo(result)


# gradients


@pytest.mark.parametrize("synthetic", [True, False])
def test_gradients_reach_places_aims_and_offsets(synthetic):
    eye = torch.eye(3, dtype=torch.float64)

    def entries(position, offsets, angle):
        c, s = torch.cos(angle), torch.sin(angle)
        zero, one = torch.zeros_like(c), torch.ones_like(c)
        turn = torch.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)
        still = torch.zeros(3, dtype=torch.float64)
        options = {"pattern": "half_wave_dipole", "polarization": "cross"}
        tx = Radio("/t", position, turn, still, array=Array(offsets, "m"), **options)
        rx = Radio("/r", torch.tensor([9.0, 2, 1]).double(), eye, still, **options)
        result = run(tx, rx, ground() if synthetic else (), 3e8, gradients=True)
        return mimo(result, synthetic).blocks[0][0] * 1e3  # near 1, for the checker's tolerances

    offsets = torch.tensor([[0.0, 0.2, 0.1], [0.05, -0.3, 0.0]], dtype=torch.float64)
    start = (torch.tensor([0.5, 0.1, 2.0]).double(), offsets, torch.tensor(0.3).double())
    assert torch.autograd.gradcheck(entries, [x.requires_grad_() for x in start], fast_mode=True)


# capacity


def test_capacity_is_the_determinant():
    h = torch.randn(5, 3, 6, dtype=torch.complex128)
    for a in (h, h.mT):
        r, t = a.shape[-2:]
        gram = torch.eye(r, dtype=a.dtype) + 7.0 / t * a @ a.mH
        expected = torch.linalg.slogdet(gram).logabsdet / math.log(2.0)
        torch.testing.assert_close(capacity(a, 7.0), expected)


def test_capacity_of_known_channels():
    """Telatar 1999: n parallel channels, and one mode of all the power."""
    eye = torch.eye(4, dtype=torch.complex128)
    assert float(capacity(eye, 12.0)) == pytest.approx(4 * math.log2(1 + 12 / 4))
    ones = torch.ones(2, 3, dtype=torch.complex128)
    assert float(capacity(ones, 5.0)) == pytest.approx(math.log2(1 + 5 / 3 * 6))
    snr = torch.tensor([0.0, 1.0, 1e30], dtype=torch.float64)
    found = capacity(1e-6 * ones.expand(3, 2, 3), snr)
    expected = torch.log1p(snr * 2e-12) / math.log(2.0)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("snr", [-1.0, math.nan, math.inf])
def test_capacity_refuses_what_is_no_ratio(snr):
    with pytest.raises(ValueError, match="snr: expected finite ratios"):
        capacity(torch.ones(1, 1, dtype=torch.complex128), snr)


def test_capacity_gradients():
    h = torch.randn(2, 3, 2, dtype=torch.complex128, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: capacity(x, 3.0), h)
    flat = torch.ones(
        3, 3, dtype=torch.complex128, requires_grad=True
    )  # modes that are equal, at 0
    capacity(flat, 3.0).backward()
    assert flat.grad is not None and bool(torch.isfinite(torch.view_as_real(flat.grad)).all())


# files


def test_channel_file_holds_the_matrices_where_a_radio_has_several_ports(tmp_path, monkeypatch):
    base = Radio.at("/base", 0, 0, 5, polarization="VH", array=Array.planar(1, 2))
    result = run(base, Radio.at("/phone", 30, 3, 1), ground())
    report.write_channel(result, tmp_path / "channel.npz")
    with np.load(tmp_path / "channel.npz") as file:
        np.testing.assert_array_equal(file["mimo"], mimo(result).padded().numpy())
        assert file["mimo_tx_ports"].tolist() == [4] and file["mimo_rx_ports"].tolist() == [1]
    single = run(Radio.at("/base", 0, 0, 5), Radio.at("/phone", 30, 3, 1))
    report.write_channel(single, tmp_path / "single.npz")
    with np.load(tmp_path / "single.npz") as file:
        assert not [name for name in file if name.startswith("mimo")]
    monkeypatch.setattr(module, "MAX_ENTRIES", 3)
    report.write_channel(result, tmp_path / "large.npz")
    with np.load(tmp_path / "large.npz") as file:
        assert "the limit is 3" in str(file["mimo_left_out"])
