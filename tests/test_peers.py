"""benchmarks/peers: its closed forms obey laws, its scenes load, its rules tell causes apart."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

PEERS = Path(__file__).resolve().parents[1] / "benchmarks" / "peers"
sys.path.insert(0, str(PEERS))

import cases  # noqa: E402
import edges  # noqa: E402
import rfsg_side  # noqa: E402
import truth  # noqa: E402
import waves  # noqa: E402
from differences import Compared, matched  # noqa: E402
from exchange import Traced  # noqa: E402
from explain import UNEXPLAINED, cause_of  # noqa: E402

COSINES = np.array([1.0, 0.8, 0.5, 0.1])


def test_layer_of_vacuum_only_delays():
    te_r, tm_r, te_t, tm_t = waves.layer(COSINES, 1.0, 0.1, 2.4e9)
    way = np.exp(-2j * np.pi * 2.4e9 / waves.C * 0.1 * COSINES)
    np.testing.assert_allclose([te_r, tm_r], 0.0, atol=1e-15)
    np.testing.assert_allclose([te_t, tm_t], [way, way], rtol=1e-13)


def test_lossless_layer_keeps_energy():
    r, t = np.split(np.abs(waves.layer(COSINES, 4.3, 0.07, 5e9)) ** 2, 2)
    np.testing.assert_allclose(r + t, 1.0, rtol=1e-13)


def test_thick_lossy_layer_is_a_half_space():
    """Fresnel at normal incidence, and next to nothing at Brewster's angle in TM."""
    eps = 4.0 - 0.05j
    r = waves.layer(np.array([1.0, 1 / np.sqrt(5.0)]), eps, 50.0, 5e9)
    n = np.sqrt(eps)
    assert r[0, 0] == pytest.approx((1 - n) / (1 + n), rel=1e-12)
    assert r[1, 0] == pytest.approx(-r[0, 0], rel=1e-12)
    assert abs(r[1, 1]) < 0.01 < 0.5 < abs(r[0, 1])
    assert np.abs(r[2:]).max() < 1e-12


def test_room_has_the_image_lattice():
    """Allen & Berkley (1979): 1 + 6 + 18 + 38 images to order 3, each at its lattice distance."""
    case = replace(cases.named("room 2.4 GHz"), receivers=cases.ROOM_RX[:2])
    found = truth.images(case)
    assert np.bincount(found.rx).tolist() == [63, 63]
    size, tx = np.array(cases.ROOM), np.array(case.transmitter)
    n = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3), -1).reshape(-1, 3)
    n = n[np.abs(n).sum(1) <= 3]
    image = n * size + np.where(n % 2 == 0, tx, size - tx)
    for r, rx in enumerate(case.receivers):
        expected = np.sort(np.linalg.norm(image - np.array(rx), axis=1))
        lengths = np.sort(found.delay[found.rx == r]) * waves.C
        np.testing.assert_allclose(lengths, expected, rtol=1e-12)


def test_blocked_and_reciprocal():
    """Behind an opaque box there is no line of sight; both ways the paths and gains are the same."""
    case = replace(cases.named("box 2.4 GHz"), receivers=((4.4, 1.0, 0.9), (1.0, 1.2, 0.9)))
    there = truth.images(case)
    assert (there.kind[there.rx == 0] >= 0).any(1).all()
    assert not (there.kind[there.rx == 1] >= 0).any(1).all()
    for r, rx in enumerate(case.receivers):
        back = truth.images(replace(case, transmitter=rx, receivers=(case.transmitter,)))
        mine = there.rx == r
        i, j = np.argsort(there.delay[mine]), np.argsort(back.delay)
        np.testing.assert_allclose(there.gain[mine][i], back.gain[j], rtol=1e-9, atol=1e-15)


def test_two_ray():
    """Over concrete a vertical pair sees the TM coefficient; lengths by Pythagoras."""
    case = cases.named("two-ray 2.4 GHz")
    found = truth.images(case)
    d = case.receivers[3][0]
    direct, bounced = found.gain[found.rx == 3] * 4 * np.pi * 2.4e9 / waves.C
    eps, cosine = waves.permittivity("concrete", 2.4e9), 11.5 / np.hypot(d, 11.5)
    root = np.sqrt(eps - 1 + cosine**2)
    assert direct == pytest.approx(1 / np.hypot(d, 8.5), rel=1e-12)
    tm = (eps * cosine - root) / (eps * cosine + root)
    assert bounced == pytest.approx(tm / np.hypot(d, 11.5), rel=1e-9)


def test_glint_and_divergence():
    """Equal angles at the glint; a huge ball spreads like a plane."""
    centre, tx, rx = (
        np.array([0.1, -0.2, 0.3]),
        np.array([5.0, 0.0, 0.0]),
        np.array([1.0, 4.0, 2.0]),
    )
    p, n = truth._glint(centre, 1.0, tx, rx)
    k, onward = ((b - a) / np.linalg.norm(b - a) for a, b in ((tx, p), (p, rx)))
    np.testing.assert_allclose(onward, k - 2 * (k @ n) * n, atol=1e-12)
    assert np.linalg.norm(p - centre) == pytest.approx(1.0, rel=1e-12)
    assert waves.divergence(3.0, 4.0, 0.6, 1e9) == pytest.approx(1 / 7, rel=1e-6)


@pytest.mark.parametrize("polarization", ["V", "H"])
def test_edge_closes_the_gaps(polarization):
    """Across the ends of the reflection and of the direct ray the whole field goes on smoothly."""
    case = replace(cases.named("wedge V"), polarization=polarization)
    low, high = _either_side(case)
    for ray in (0, 1):
        assert abs(high[ray] - low[ray]) < 0.01 * abs(low[ray])
    bare = replace(case, diffraction=False)
    low, high = _either_side(bare)
    assert abs(high[0] - low[0]) > 0.3 * abs(low[0])  # the gap is there to be closed


def _either_side(case):
    """h a ten-thousandth of a degree before and after both ends."""
    x, y, z = case.transmitter
    ends = np.array([np.arctan2(-y, x), np.arctan2(-y, -x)])
    out = []
    for turn in np.radians([-1e-4, 1e-4]):
        angles = ends + turn
        places = tuple((5 * float(np.cos(a)), 5 * float(np.sin(a)), z) for a in angles)
        one = replace(case, receivers=places)
        out.append(truth.images(one).transfer(case.frequency, 2))
    return out


def test_edge_is_reciprocal_and_shorts_the_face():
    """Both ways the same gain; no field along a conductor next to its face."""
    case, a, b = cases.named("wedge V"), (-6.1, 3.2, 0.2), (4.0, -2.0, 1.3)
    gain = []
    for tx, rx in ((a, b), (b, a)):
        one = replace(case, transmitter=tx, receivers=(rx,))
        (edge,) = (e for e in edges.bending(one, np.array(rx)) if not e.point[:2].any())
        gain.append((edges.CONDUCTOR * edges.terms(one, edge, np.array(rx))).sum())
    assert gain[0] == pytest.approx(gain[1], rel=1e-12)
    near = replace(case, receivers=((4.0, -1e-6, 1.3), (4.0, -1.0, 1.3)))
    field = np.abs(truth.images(near).transfer(case.frequency, 2))
    assert field[0] < 1e-3 * field[1]


def test_rough_wall_far_away():
    """A tile seen from afar: area cos cos / pi over both squared distances, of S^2 |R|^2."""
    tile = cases.Wall("w", (0.0, -0.05, -0.05), (0.1, 0.05, 0.05), "-x", scattering=0.5)
    case = cases.Case("", (tile,), (-40.0, 0.0, 0.0), ((-30.0, 30.0, 0.0),), 2.4e9, 1)
    r = waves.layer(1.0, waves.permittivity("concrete", 2.4e9), 0.1, 2.4e9)[0]
    lobe = np.sqrt(0.5) / np.pi * 0.01 / (40.0**2 * 1800.0)
    expected = 0.25 * abs(r) ** 2 * lobe * (waves.C / 2.4e9 / 4 / np.pi) ** 2
    assert truth.diffuse_power(case)[0] == pytest.approx(expected, rel=1e-5)


def test_icosphere():
    """A closed mesh on the sphere (Euler: V - F / 2 = 2); above a triangle only that one mirrors."""
    ball = cases.Ball("b", (0.5, 0.0, -1.0), 2.0, facets=320)
    corners = ball.triangles()
    assert len(corners) == 320
    assert len(np.unique(corners.reshape(-1, 3).round(9), axis=0)) - 320 // 2 == 2
    out = corners - np.array(ball.centre)
    np.testing.assert_allclose(np.linalg.norm(out, axis=-1), 2.0, rtol=1e-12)
    normal = np.cross(out[:, 1] - out[:, 0], out[:, 2] - out[:, 0])
    assert (normal * out.mean(1)).sum(1).min() > 0
    middle, up = corners[7].mean(0), normal[7] / np.linalg.norm(normal[7])
    seen = truth.mirrored_on_facets(ball, middle + 3 * up, middle + 4 * up)
    np.testing.assert_allclose(seen, middle[None], atol=1e-12)


def test_every_scene_loads():
    for case in cases.all_cases():
        scene = rfsg_side.build(case)
        assert [n.path for n in scene.nodes] == [f"/{t.name}" for t in case.things]
        assert len(scene.receivers) == len(case.receivers)


@pytest.fixture(scope="module")
def slab() -> Compared:
    """The slab traced by rfsg, beside a peer that gives what the closed form gives."""
    case = cases.named("slab 2.4 GHz")
    return Compared(case, rfsg_side.trace(case), truth.solve(case), truth.solve(case))


@pytest.mark.parametrize("name", ["two-ray 28 GHz", "box moved 28 GHz", "slab 28 GHz", "wedge H"])
def test_rfsg_is_the_closed_form(name):
    case = cases.named(name)
    case = replace(case, receivers=(*case.receivers[:2], case.receivers[-1]))
    exact, traced = truth.solve(case), rfsg_side.trace(case)
    pairs = matched(case, exact, traced)
    assert len(pairs) == len(exact.rx) == len(traced.rx)
    i, j = pairs.T
    share = exact.share(case.frequency)[i]
    np.testing.assert_allclose(traced.share(case.frequency)[j], share, rtol=1e-8, atol=1e-15)
    np.testing.assert_allclose(traced.delay[j], exact.delay[i], rtol=1e-10)


def test_files_keep_everything(slab, tmp_path):
    slab.rfsg.save(tmp_path / "a.npz")
    again = Traced.load(tmp_path / "a.npz")
    for name in Traced.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(slab.rfsg, name))


def test_agreement_has_no_differences(slab):
    assert slab.differences == []


def test_known_causes_are_recognised(slab):
    """A peer that counts the wall twice, and gives it no delay of its own."""
    case, exact = slab.case, slab.truth
    lengths = [
        np.linalg.norm(np.diff(exact.polyline(p, np.array(case.transmitter), rx), axis=0), axis=1)
        for p, rx in enumerate(np.array(case.receivers)[exact.rx])
    ]
    straight = np.array([x.sum() for x in lengths]) / waves.C
    turn = np.where(exact.crossed > 0, 0.1 * exact.departure[:, 0] / waves.C, 0.0)
    turn += exact.delay - straight
    gain = exact.gain * np.exp(-2j * np.pi * case.frequency * turn)
    peer = replace(exact, gain=gain, delay=straight)
    compared = replace(slab, peer=peer)
    causes = [cause_of(compared, d) for d in compared.differences]
    assert sorted(set(causes)) == ["delay of a wall", "wall counted twice"] and len(causes) == 12


def test_unknown_causes_are_not(slab):
    """A lost path, a decibel and a degree or two that no cause predicts stay unexplained."""
    exact = slab.truth
    keep = np.arange(len(exact.rx)) != 4
    lost = Traced(exact.names, *(getattr(exact, n)[keep] for n in list(vars(exact))[1:]))
    loud = replace(exact, gain=exact.gain * 1.122)
    turned = replace(exact, gain=exact.gain * np.exp(0.05j))
    for peer in (lost, loud, turned):
        compared = replace(slab, peer=peer)
        assert compared.differences
        assert {cause_of(compared, d) for d in compared.differences} == {UNEXPLAINED}


def test_facets_excuse_only_what_facets_do():
    """A lost glint is put down to the mesh only where no triangle has it; and so is no other power."""
    ball = cases.Ball("ball", (0.0, 0.0, 0.0), 1.0, facets=320)
    a, b, c = ball.triangles()[7]
    up, side = (v / np.linalg.norm(v) for v in (np.cross(b - a, c - a), b - a))
    middle = (a + b + c) / 3
    tx, shown = (middle + 3 * up + 2 * s * side for s in (1, -1))
    hidden = shown + 0.4 * up - 0.7 * np.cross(up, side)
    assert not len(truth.mirrored_on_facets(ball, tx, hidden))
    receivers = (tuple(shown.tolist()), tuple(hidden.tolist()))
    case = cases.Case("", (ball,), tuple(tx.tolist()), receivers, 2.4e9, 1)
    exact = truth.solve(case)
    glint = (exact.kind >= 0).any(1)
    lost = Traced(exact.names, *(getattr(exact, n)[~glint] for n in list(vars(exact))[1:]))
    causes = {
        (d.rx, d.quantity): cause_of(k, d)
        for k in [Compared(case, exact, lost, exact)]
        for d in k.differences
    }
    assert causes[0, "missing in the peer"] == UNEXPLAINED
    assert causes[1, "missing in the peer"] == "flat facets"
    loud = replace(exact, gain=np.where(glint, 4.0, 1.0) * exact.gain)  # 12 dB is not 14
    k = Compared(case, exact, loud, exact)
    assert {cause_of(k, d) for d in k.differences if d.quantity == "power [dB]"} == {UNEXPLAINED}
