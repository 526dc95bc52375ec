"""Measured patterns: what interpolation keeps, what files say, and what they may not."""

import math
import re

import numpy as np
import pytest
import torch

from rfsg.scene import patterns, usd
from rfsg.scene.antennas import HALF_WAVE_DIRECTIVITY, basis, half_wave_dipole, short_dipole
from rfsg.scene.errors import SceneError
from rfsg.scene.patterns import FIELD, Pattern, parse
from rfsg.scene.radios import Radio, amplitude, field_components
from rfsg.scene.scene import Scene

AROUND = np.arange(0.0, 360.0, 5.0)


def direction(theta_deg, phi_deg):
    theta, phi = (
        torch.deg2rad(torch.as_tensor(a, dtype=torch.float64)) for a in (theta_deg, phi_deg)
    )
    parts = (theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos() * torch.ones_like(phi))
    return torch.stack(torch.broadcast_tensors(*parts), -1)


def some_directions(n=200):
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=-1)


def grid(step: float) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
    """theta, phi [deg] of a regular grid, and its directions."""
    theta, phi = np.arange(0.0, 180.0 + step / 2, step), np.arange(0.0, 360.0, step)
    return theta, phi, direction(theta[:, None], phi)


def sampled(function, step: float) -> Pattern:
    theta, phi, d = grid(step)
    return Pattern.from_samples("sampled", theta, phi, function(d))


def lying_dipole(step: float) -> Pattern:
    """A short dipole along x: the part of x across the direction, sqrt(3/2) (Balanis section 4.2).

    At a pole the components are those of each phi, as measurement ranges write them.
    """
    theta, phi, _ = grid(step)
    t, p = torch.from_numpy(np.deg2rad(theta))[:, None], torch.from_numpy(np.deg2rad(phi))
    field = torch.stack([t.cos() * p.cos(), -p.sin() * torch.ones_like(t)], -1)
    return Pattern.from_samples("lying", theta, phi, math.sqrt(1.5) * field.to(torch.complex128))


def noise(phi_deg=AROUND, vector=False, step=10.0) -> Pattern:
    """Samples without any smoothness."""
    theta = np.arange(0.0, 181.0, step)
    shape = (len(theta), len(phi_deg), 2)
    field = torch.randn(*shape, dtype=torch.complex128)
    return Pattern.from_samples("noise", theta, phi_deg, field if vector else field[..., 0].abs())


# interpolation


@pytest.mark.parametrize(
    "make, exact",
    [
        (lambda step: sampled(half_wave_dipole, step), half_wave_dipole),
        (lying_dipole, lambda d: math.sqrt(1.5) * torch.sqrt(1 - d[..., 0] ** 2)),
    ],
)
def test_bilinear_interpolation_is_of_second_order(make, exact):
    """Half the step, a quarter of the error, in the mean over the sphere."""
    d = some_directions(2000)
    errors = [float((make(step).amplitude(d) - exact(d)).abs().mean()) for step in (4, 2, 1)]
    for coarse, fine in zip(errors, errors[1:], strict=False):
        assert 3.0 < coarse / fine < 5.0


@pytest.mark.parametrize("vector", [False, True])
def test_samples_are_met_exactly(vector):
    pattern = noise(vector=vector)
    d = direction(torch.tensor([10.0, 90, 170])[:, None], torch.tensor([0.0, 5, 180, 355]))
    rows, columns = torch.tensor([1, 9, 17]), torch.tensor([0, 1, 36, 71])
    torch.testing.assert_close(pattern.field(d), pattern.samples[rows[:, None], columns])


def test_any_beginning_and_a_closed_turn_are_one_pattern():
    field = torch.rand(19, 72, dtype=torch.float64)
    theta = np.arange(0.0, 181.0, 10.0)
    d = torch.cat([some_directions(), direction(77.0, [179.999999, -179.999999, 0.0, -1e-9])])
    one = Pattern.from_samples("a", theta, AROUND, field).amplitude(d)
    shifted = Pattern.from_samples("b", theta, AROUND - 180.0, field.roll(36, 1)).amplitude(d)
    closed = torch.cat([field, field[:, :1]], 1)
    whole = Pattern.from_samples("c", theta, np.append(AROUND, 360.0), closed).amplitude(d)
    torch.testing.assert_close(shifted, one)
    torch.testing.assert_close(whole, one)
    assert float((one[-4] - one[-3]).abs()) < 1e-6  # no seam
    assert float((one[-2] - one[-1]).abs()) < 1e-6


@pytest.mark.parametrize("pole", [0.0, 180.0])
def test_poles_have_one_gain(pole):
    pattern = noise()
    near = pattern.amplitude(direction(abs(pole - 1e-7), np.arange(-180.0, 180, 7)))
    at = pattern.amplitude(direction(pole, 0.0))
    assert float((near - at).abs().max()) < 1e-6
    row = pattern.samples[0 if pole == 0 else -1, :-1, 0]
    torch.testing.assert_close((row.abs() ** 2).mean(), at**2)


@pytest.mark.parametrize("pole", [0.0, 180.0])
def test_poles_have_one_field_vector(pole):
    """E_theta and E_phi turn with phi there, the vector that they describe does not."""
    pattern = noise(vector=True)
    d = direction(abs(pole - 1e-7), AROUND)
    vectors = torch.einsum("pk,pki->pi", pattern.field(d), basis(d).to(torch.complex128))
    at = direction(pole, 0.0)
    vector = torch.einsum("k,ki->i", pattern.field(at), basis(at).to(torch.complex128))
    assert float((vectors - vector).abs().max()) < 1e-6
    assert float(vector.abs().max()) > 1e-3


def test_a_measured_field_is_the_antenna_that_made_it():
    """A dipole measured lying along x is a dipole along z turned onto x, in gain and polarisation."""
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)  # z to x
    laid = Radio.at("/r", 0, 0, 0, polarization="V", pattern="short_dipole")
    measured = Radio.at("/m", 0, 0, 0, polarization="V", pattern=lying_dipole(1.0))
    d = some_directions()

    def world(radio, rotation):
        local = d @ rotation
        field = field_components(radio, local)[:, 0]
        return torch.einsum("pk,pki->pi", field, basis(local).to(field.dtype)) @ rotation.T.to(
            field.dtype
        )

    a, b = world(laid, turn), world(measured, torch.eye(3, dtype=torch.float64))
    # theta-hat points away from the dipole's own +z: the field is minus its current's direction
    torch.testing.assert_close(b, -a, rtol=0, atol=3e-4)  # 1.5 (1 degree)^2 / 4 and a little


def test_the_second_port_of_a_measured_field_is_the_same_across():
    pattern = noise(vector=True)
    d = some_directions()
    v, h = field_components(Radio.at("/r", 0, 0, 0, polarization="VH", pattern=pattern), d).unbind(
        -2
    )
    torch.testing.assert_close(v, pattern.field(d))
    torch.testing.assert_close(h, torch.stack([-v[:, 1], v[:, 0]], -1))


@pytest.mark.parametrize("vector", [False, True])
def test_gradients(vector):
    pattern = noise(vector=vector, phi_deg=np.arange(0.0, 360, 40), step=30.0)
    d = direction([47.0, 80, 131, 5], [13.0, -100, 171, 75]).requires_grad_()
    assert torch.autograd.gradcheck(pattern.field, d)
    assert torch.autograd.gradcheck(pattern.amplitude, d)


def test_gradients_with_respect_to_samples():
    theta, phi = np.array([0.0, 60, 120, 180]), np.array([0.0, 90, 180, 270])
    d = some_directions(5)
    samples = torch.rand(4, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda s: Pattern.from_samples("s", theta, phi, s).amplitude(d), samples
    )


def test_gradients_are_finite_at_poles_and_in_nulls():
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1e-160, 0, 1]], dtype=torch.float64)
    for pattern in (noise(), noise(vector=True), sampled(lambda d: 0 * d[..., 0], 30.0)):
        d = torch.cat([poles, some_directions(3)]).requires_grad_()
        gain = pattern.amplitude(d)
        gain.sum().backward()
        assert d.grad is not None and bool(torch.isfinite(d.grad).all())
        assert bool(torch.isfinite(gain).all())


def test_float32_directions_stay_float32():
    assert noise().amplitude(some_directions().float()).dtype == torch.float32
    assert noise().field(some_directions().float()).dtype == torch.complex64


# energy


def test_a_constant_gain_has_itself_as_mean():
    pattern = Pattern.from_samples(
        "flat", np.array([0.0, 7, 90, 180]), np.array([3.0]), torch.full((4, 1), math.sqrt(2.0))
    )
    assert pattern.mean_gain() == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("vector", [False, True])
def test_mean_gain_is_the_integral_of_the_interpolant(vector):
    """Against its plain twin: the midpoint rule over many more directions than samples."""
    pattern = noise(vector=vector, phi_deg=np.arange(0.0, 360, 60), step=45.0)
    theta, phi = np.arange(0.25, 180, 0.5), np.arange(0.25, 360, 0.5)
    gain = pattern.amplitude(direction(theta[:, None], phi)) ** 2
    weight = torch.sin(torch.deg2rad(torch.from_numpy(theta)))[:, None]
    assert pattern.mean_gain() == pytest.approx(
        float((gain * weight).mean() / weight.mean()), rel=1e-4
    )


def test_the_directive_gain_of_a_dipole_integrates_to_one():
    for pattern in (
        sampled(half_wave_dipole, 1.0),
        sampled(short_dipole, 1.0),
        lying_dipole(1.0),
    ):
        assert pattern.mean_gain() == pytest.approx(1.0, abs=2e-4)


def test_nothing_is_normalised_and_too_much_is_refused():
    d = direction(90.0, 0.0)
    theta, phi, _ = grid(30.0)
    for db, words in ((-3.0, 0), (0.0, 0), (3.0, 1), (19.9, 1)):
        amplitudes = torch.full((len(theta), len(phi)), 10 ** (db / 20), dtype=torch.float64)
        pattern = Pattern.from_samples("p", theta, phi, amplitudes)
        assert float(pattern.amplitude(d)) == pytest.approx(10 ** (db / 20))
        assert len(pattern.warnings()) == words
    for db in (20.1, 4000.0):
        amplitudes = torch.full((len(theta), len(phi)), 10.0, dtype=torch.float64) ** (db / 20)
        with pytest.raises(SceneError, match="^p: the mean gain over the sphere is "):
            Pattern.from_samples("p", theta, phi, amplitudes)


# CSV


def csv_text(rows, columns=("theta_deg", "phi_deg", "gain_dbi")) -> str:
    return "\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n"


def flat_rows(gain=0.0):
    return [(t, p, gain) for t in (0, 90, 180) for p in (0, 120, 240)]


def written(tmp_path, text: str, name: str = "antenna.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_csv_of_gains(tmp_path):
    rows = flat_rows()
    rows[3] = (90, 0, 6.0)
    rows[5] = (90, 240, "-inf")
    path = written(tmp_path, csv_text(reversed(rows)))  # in any order
    pattern = Pattern.from_file(path)
    assert (pattern.name, pattern.file, pattern.vector) == ("antenna.csv", str(path), False)
    gains = pattern.amplitude(direction(90.0, [0.0, 120, 240, 180]))
    expected = [10 ** (6 / 20), 1.0, 0.0, 0.5]  # amplitudes are what is interpolated
    torch.testing.assert_close(gains, torch.tensor(expected, dtype=torch.float64))


def test_csv_of_fields(tmp_path):
    rows = [(t, p, 0.5, -0.25, 0.0, 1.0) for t in (0, 90, 180) for p in (0, 120, 240)]
    path = written(tmp_path, csv_text(rows, ("theta_deg", "phi_deg", *FIELD)))
    pattern = Pattern.from_file(path)
    assert pattern.vector
    field = pattern.field(direction(90.0, 60.0))
    torch.testing.assert_close(field, torch.tensor([0.5 - 0.25j, 1j], dtype=torch.complex128))


@pytest.mark.parametrize("vector", [False, True])
def test_csv_round_trip(vector):
    pattern = noise(vector=vector)
    again = parse(pattern.csv(), "again.csv")
    assert again.same(pattern) and pattern.same(again)
    assert not again.same(noise(vector=vector))
    assert not again.same(noise(vector=not vector))


def faults(text: str, tmp_path, name="antenna.csv") -> list[str]:
    path = written(tmp_path, text, name)
    with pytest.raises(SceneError) as error:
        Pattern.from_file(path)
    assert all(f.startswith(str(path)) for f in error.value.faults)
    return [f.removeprefix(str(path)) for f in error.value.faults]


def test_csv_names_line_and_column_of_every_fault(tmp_path):
    text = csv_text(flat_rows()).splitlines()
    text[2] = "0,120,loud"
    text[4] = "nan,0,0"
    text[5] = "90,120"
    text[7] = "180,0,inf"
    text[9] = "180,120,0"
    assert faults("\n".join(text), tmp_path) == [
        ":3: gain_dbi: expected a finite number, got 'loud'",
        ":5: theta_deg: expected a finite number, got 'nan'",
        ":6: expected 3 cells, got 2",
        ":8: gain_dbi: expected a finite number, got 'inf'",
        ":10: theta_deg 180, phi_deg 120 stands twice",
    ]


@pytest.mark.parametrize(
    "text, expected",
    [
        ("", ":1: column 'theta_deg' is missing"),
        ("theta_deg,phi_deg\n", ":1: column 'e_theta_re' is missing"),
        ("theta_deg,phi_deg,gain_dbi,colour\n", ":1: column 'colour' is unknown"),
        ("theta_deg,theta_deg,phi_deg,gain_dbi\n", ":1: column 'theta_deg' twice"),
        (csv_text(flat_rows()[:-1]), "theta_deg 180, phi_deg 240 is missing"),
        (csv_text(flat_rows()[:-3]), "theta_deg: expected samples from 0 to 180, got 0 to 90"),
        (csv_text(flat_rows()[3:]), "theta_deg: expected samples from 0 to 180, got 90 to 180"),
        (
            csv_text([(t, p, 0) for t in (0, 180) for p in (0, 180, 361)]),
            "phi_deg: expected samples within one turn of 360, got 0 to 361",
        ),
        (csv_text([]), "theta_deg: expected samples from 0 to 180, got nothing"),
        (csv_text(flat_rows(35.0)), "the mean gain over the sphere is 35.0 dB"),
        (csv_text(flat_rows(1e300)), "the mean gain over the sphere is inf dB"),
    ],
)
def test_csv_that_is_no_pattern(tmp_path, text, expected):
    assert expected in faults(text, tmp_path)[0]


def test_files_are_bounded(tmp_path, monkeypatch):
    text = csv_text([(0, 0, "bad")] * 1000)
    assert len(faults(text, tmp_path)) == patterns.MAX_FAULTS + 1
    monkeypatch.setattr(patterns, "MAX_SAMPLES", 8)
    assert "more than 8 samples" in faults(csv_text(flat_rows()), tmp_path)[0]
    monkeypatch.setattr(patterns, "MAX_PATTERN_BYTES", 10)
    assert "the limit is 10" in faults(csv_text(flat_rows()), tmp_path)[0]
    with pytest.raises(SceneError, match="the limit is 10"):
        parse(b" " * 11, "antenna.csv")


def test_other_files_are_refused(tmp_path):
    with pytest.raises(SceneError, match="expected a pattern file ending in .csv, .msi, .pln"):
        Pattern.from_file(written(tmp_path, "", "antenna.txt"))
    with pytest.raises(SceneError, match="none.csv: cannot be read"):
        Pattern.from_file(tmp_path / "none.csv")
    with pytest.raises(SceneError, match="not UTF-8 text: byte 0"):
        parse(b"\xff\xfe", "antenna.csv")


# Planet


def horizontal_loss(angle: int) -> float:
    """A beam that looks 20 degrees to the right."""
    off = abs((angle - 20 + 180) % 360 - 180)
    return min(12 * (off / 65) ** 2, 25.0)


def vertical_loss(angle: int) -> float:
    """A beam tilted 6 degrees down."""
    off = abs((angle - 6 + 180) % 360 - 180)
    return min(12 * (off / 10) ** 2, 30.0)


def planet_text(gain="GAIN 15.0 dBi", head="NAME panel", horizontal=360, vertical=360) -> str:
    lines = [head, "FREQUENCY 2140", gain, "TILT ELECTRICAL", "COMMENT made by a test"]
    lines += [f"HORIZONTAL {horizontal}"]
    lines += [f"{a}\t{horizontal_loss(a):.6f}" for a in range(horizontal)]
    lines += [f"VERTICAL {vertical}"] + [f"{a} {vertical_loss(a):.6f}" for a in range(vertical)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("name", ["panel.msi", "PANEL.PLN"])
def test_planet_cuts_and_their_sum(tmp_path, name):
    """Horizontal angles to the right, vertical ones down; off both axes the losses add."""
    pattern = Pattern.from_file(written(tmp_path, planet_text(), name))
    assert not pattern.vector

    def dbi(theta, phi):
        return 20 * math.log10(float(pattern.amplitude(direction(theta, phi))))

    assert dbi(96.0, -20.0) == pytest.approx(15.0, abs=1e-6)  # the peak: down, and to the right
    for right in (0, 20, 65, 180, 300):  # the horizon
        expected = 15 - horizontal_loss(right) - vertical_loss(0)
        assert dbi(90.0, -right) == pytest.approx(expected, abs=1e-5)
    for down in (-80, -10, 0, 6, 45, 89):  # the vertical plane through the boresight
        expected = 15 - horizontal_loss(0) - vertical_loss(down % 360)
        assert dbi(90.0 + down, 0.0) == pytest.approx(expected, abs=1e-5)
    expected = 15 - horizontal_loss(70) - vertical_loss(345)
    assert dbi(75.0, -70.0) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    "line, dbi",
    [("GAIN 15 dBi", 15), ("GAIN 12.85 dBd", 15), ("GAIN 12.85", 15), ("gain 15.0dBi", 15)],
)
def test_planet_gain_is_dbd_unless_it_says_dbi(line, dbi):
    pattern = parse(planet_text(line, head="A name alone").encode(), "panel.msi")
    peak = pattern.amplitude(direction(96.0, -20.0))
    assert 20 * math.log10(float(peak)) == pytest.approx(dbi, abs=1e-6)


def test_dbd_is_the_gain_over_a_half_wave_dipole():
    assert patterns.DBD == pytest.approx(10 * math.log10(HALF_WAVE_DIRECTIVITY), abs=2e-3)


def test_coarse_cuts_are_interpolated_round_and_round():
    text = "GAIN 0 dBi\nHORIZONTAL 2\n90 0\n270 20\nVERTICAL 1\n0 0\n"
    pattern = parse(text.encode(), "panel.msi")
    for right, loss in ((90, 0), (180, 10), (0, 10), (270, 20)):
        gain = float(pattern.amplitude(direction(90.0, -float(right))))
        assert 20 * math.log10(gain) == pytest.approx(-loss, abs=1e-6)


@pytest.mark.parametrize(
    "edit, expected",
    [
        (lambda s: s.replace("GAIN 15.0 dBi\n", ""), ": GAIN: is missing"),
        (lambda s: s.replace("15.0", "loud"), ":3: GAIN: expected a finite number, got 'loud'"),
        (lambda s: s.replace("HORIZONTAL 360", "HORIZONTAL many"), ":6: HORIZONTAL: expected 1 to"),
        (
            lambda s: s.replace("HORIZONTAL 360", "HORIZONTAL 99999"),
            ":6: HORIZONTAL: expected 1 to",
        ),
        (lambda s: s[: s.index("VERTICAL")], ": VERTICAL: the cut is missing"),
        (lambda s: s.replace("VERTICAL 360", "VERTICAL 361"), ":367: VERTICAL: expected 361 lines"),
        (
            lambda s: s.replace("HORIZONTAL 360", "HORIZONTAL 361"),
            ":367: HORIZONTAL: expected a fin",
        ),
        (lambda s: s.replace("\n7\t", "\n6\t", 1), ":14: HORIZONTAL: the angle 6 stands twice"),
        (
            lambda s: re.sub(r"\n7\t", "\n7\t-", s),
            ":14: HORIZONTAL: expected an attenuation of 0 dB",
        ),
        (lambda s: s.replace("\n7\t", "\n7 8 ", 1), ":14: HORIZONTAL: expected 360 lines"),
    ],
)
def test_planet_faults_name_the_line(tmp_path, edit, expected):
    assert faults(edit(planet_text()), tmp_path, "panel.msi")[0].startswith(expected)


# USD


def radio_text(asset: str, name="AP", polarization="none", kind="asset") -> str:
    value = f"@{asset}@" if kind == "asset" else f'"{asset}"'
    return f"""
    def Xform "{name}"
    {{
        custom token rfsg:radio:role = "tx"
        custom {kind} rfsg:radio:patternFile = {value}
        custom token rfsg:radio:polarization = "{polarization}"
    }}"""


@pytest.mark.parametrize("kind", ["asset", "string"])  # Blender makes strings of assets
def test_usd_radios_share_the_pattern_of_one_file(scene_file, tmp_path, kind):
    written(tmp_path, csv_text(flat_rows(-1.0)))
    body = radio_text("./antenna.csv", kind=kind) + radio_text("./antenna.csv", "B", kind=kind)
    scene = Scene.from_usd(scene_file(body))
    first, second = (radio.pattern for radio in scene.transmitters)
    assert isinstance(first, Pattern) and first is second and first.name == "antenna.csv"
    expected = torch.tensor(10 ** (-1 / 20), dtype=torch.float64)
    torch.testing.assert_close(amplitude(scene.transmitters[0], direction(3.0, 4.0)), expected)
    assert scene.warnings == ()


def test_an_empty_file_name_blocks_a_weaker_one(scene_file):
    (radio,) = Scene.from_usd(scene_file(radio_text(""))).transmitters
    assert radio.pattern == "isotropic"


@pytest.mark.parametrize(
    "asset, fault",
    [
        ("../secret.csv", "lies outside the folders this scene may read"),
        ("https://example.org/a.csv", "is a URL; rfsg reads files only"),
        ("./none.csv", "patternFile './none.csv' not found"),
        ("./scene.usda", "expected a pattern file ending in .csv, .msi, .pln"),
        ("./bad.csv", "bad.csv:2: gain_dbi: expected a finite number, got 'loud'"),
    ],
)
def test_usd_confines_pattern_files_and_names_their_faults(scene_file, tmp_path, asset, fault):
    inner = tmp_path / "inner"
    inner.mkdir()
    written(tmp_path, csv_text(flat_rows()), "secret.csv")
    written(inner, csv_text([(0, 0, "loud")]), "bad.csv")
    path = scene_file(radio_text(asset), name="inner/scene.usda")
    with pytest.raises(SceneError) as error:
        Scene.from_usd(path)
    assert error.value.faults[0].startswith("/World/AP: ") and fault in error.value.faults[0]


def test_usd_bounds_pattern_files(scene_file, tmp_path, monkeypatch):
    monkeypatch.setattr(usd.radios, "MAX_PATTERN_BYTES", 10)
    written(tmp_path, csv_text(flat_rows()))
    with pytest.raises(SceneError, match="patternFile './antenna.csv' take .*; the limit is 10"):
        Scene.from_usd(scene_file(radio_text("./antenna.csv")))


def test_usd_tells_of_gains_above_passive_and_of_fields_that_nobody_asks_for(scene_file, tmp_path):
    written(tmp_path, csv_text(flat_rows(3.0)), "loud.csv")
    (warning,) = Scene.from_usd(scene_file(radio_text("./loud.csv"))).warnings
    assert warning.startswith(
        "/World/AP: pattern loud.csv: the mean gain over the sphere is 3.0 dB"
    )
    (tmp_path / "field.csv").write_bytes(noise(vector=True).csv())
    warnings = Scene.from_usd(scene_file(radio_text("./field.csv"))).warnings
    assert any("rfsg:radio:polarization is none" in w for w in warnings)
    asked = Scene.from_usd(scene_file(radio_text("./field.csv", polarization="V"))).warnings
    assert not any("polarization" in w for w in asked)


def test_usd_round_trip_references_what_is_near_and_copies_what_is_not(tmp_path):
    path = written(tmp_path, planet_text(), "panel.msi")
    measured, made = Pattern.from_file(path), noise(vector=True)
    radios = (
        Radio.at("/World/a", 0, 0, 1, pattern=measured, polarization="cross"),
        Radio.at("/World/b", 0, 0, 2, pattern=made, polarization="VH"),
        Radio.at("/World/c", 0, 0, 3, pattern=made, polarization="V"),
    )

    def check(file):
        read = Scene.from_usd(file).transmitters
        assert [r.polarization for r in read] == ["cross", "VH", "V"]
        for radio, original in zip(read, radios, strict=True):
            assert isinstance(radio.pattern, Pattern) and isinstance(original.pattern, Pattern)
            assert radio.pattern.same(original.pattern)
        assert read[1].pattern is read[2].pattern

    near = Scene((), radios).to_usd(tmp_path / "near.usda")
    assert "@./panel.msi@" in near.read_text()
    assert [f.name for f in (tmp_path / "near_assets").iterdir()] == ["noise.csv"]
    check(near)
    assert str(tmp_path) not in near.read_text()
    (tmp_path / "far").mkdir()
    far = Scene((), radios).to_usd(tmp_path / "far" / "far.usda")
    assert "@./far_assets/panel.csv@" in far.read_text()
    check(far)
    # a file that was changed since is not what the scene holds
    path.write_text(planet_text("GAIN 3 dBi"))
    again = Scene((), radios).to_usd(tmp_path / "again.usda")
    assert "@./again_assets/panel.csv@" in again.read_text()
    check(again)


def test_a_package_holds_its_patterns(scene_file, tmp_path):
    from pxr import Sdf, UsdUtils

    written(tmp_path, csv_text(flat_rows(-2.0)))
    package = tmp_path / "scene.usdz"
    path = scene_file(radio_text("./antenna.csv"))
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(path)), str(package))
    (radio,) = Scene.from_usd(package).transmitters
    assert isinstance(radio.pattern, Pattern)
    assert radio.pattern.mean_gain() == pytest.approx(10**-0.2, rel=1e-5)
