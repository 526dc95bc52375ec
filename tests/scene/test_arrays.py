"""Arrays: where elements stand, their order, files, and what is refused."""

import numpy as np
import pytest
import torch

from rfsg.scene import arrays, usd
from rfsg.scene.arrays import Array
from rfsg.scene.errors import SceneError
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene


def real(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_a_planar_array_stands_in_the_y_z_plane_about_the_radio():
    array = Array.planar(3, 2, 0.7, 0.5)
    assert len(array) == 6
    torch.testing.assert_close(array.offsets.mean(0), real(0.0, 0, 0))
    assert not bool(array.offsets[:, 0].any())
    # rows fastest, from the bottom up; columns grow with y (TR 38.901 figure 7.3-1)
    torch.testing.assert_close(array.offsets[1] - array.offsets[0], real(0.0, 0, 0.7))
    torch.testing.assert_close(array.offsets[3] - array.offsets[0], real(0.0, 0.5, 0))


def test_wavelengths_become_metres():
    array = Array.planar(1, 2)
    torch.testing.assert_close(array.metres(0.2).diff(dim=0), real(0.0, 0.1, 0)[None])
    assert Array.of([(1, 2, 3)], "m").metres(0.2).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    "make, fault",
    [
        (lambda: Array.planar(0, 4), "0 rows and 4 columns"),
        (lambda: Array.planar(2, 2, -0.5), "spacings -0.5 and 0.5"),
        (lambda: Array.planar(2, 2, float("nan")), "spacings nan"),
        (lambda: Array.planar(65, 64), "4160 elements; expected 1 to 4096"),
        (lambda: Array.of([]), "shape"),
        (lambda: Array.of([(1, 2)]), "shape"),
        (lambda: Array.of([(1, 2, float("inf"))]), "not finite"),
        (lambda: Array.of([(1, 2, 3)], "feet"), "unit is 'feet'; expected one of wavelength, m"),
        (lambda: Array.of([(1, 2, 3), (1, 2)]), "expected triples of numbers"),
    ],
)
def test_what_is_no_array_is_refused(make, fault):
    with pytest.raises(SceneError, match="^array: ") as error:
        make()
    assert fault in str(error.value)


def test_csv(tmp_path):
    path = tmp_path / "array.csv"
    path.write_text("x, y, z\n0,0,0.1\n0, 0.25, -1e-1\n\n")
    array = Array.from_csv(path, "m")
    assert array.offsets.tolist() == [[0, 0, 0.1], [0, 0.25, -0.1]] and array.unit == "m"


def test_csv_names_file_and_line_of_every_fault(tmp_path, monkeypatch):
    path = tmp_path / "array.csv"
    path.write_text("x,y,z\n0,zero,0\n0,0\n0,0,0\n0,0,nan\n")
    with pytest.raises(SceneError) as error:
        Array.from_csv(path)
    assert [f.split(": ")[0] for f in error.value.faults] == [f"{path}:{n}" for n in (2, 3, 5)]
    path.write_text("x,y\n0,0\n")
    with pytest.raises(SceneError, match=f"^{path}:1: expected the columns x, y, z"):
        Array.from_csv(path)
    with pytest.raises(SceneError, match="cannot|not a CSV file"):
        Array.from_csv(tmp_path / "none.csv")
    path.write_text("x,y,z\n")
    with pytest.raises(SceneError, match=f"^{path}: array: "):
        Array.from_csv(path)
    monkeypatch.setattr(arrays, "MAX_CSV_BYTES", 3)
    with pytest.raises(SceneError, match="larger than 3 bytes"):
        Array.from_csv(path)


# USD


def radio_text(*attributes: str) -> str:
    lines = "\n        ".join(attributes)
    return f"""
    def Xform "AP"
    {{
        custom token rfsg:radio:role = "tx"
        {lines}
    }}"""


def read_array(scene_file, *attributes) -> Array:
    (radio,) = Scene.from_usd(scene_file(radio_text(*attributes), metre=0.01)).transmitters
    assert radio.array is not None
    return radio.array


def test_usd_rows_and_columns(scene_file):
    array = read_array(
        scene_file,
        "custom int rfsg:radio:array:rows = 4",
        "custom int rfsg:radio:array:columns = 2",
        "custom double rfsg:radio:array:spacingVertical = 0.8",
    )
    expected = Array.planar(4, 2, 0.8, 0.5)
    assert torch.equal(array.offsets, expected.offsets) and array.unit == "wavelength"
    assert array.layout == expected.layout


@pytest.mark.parametrize("kind", ["float3[]", "double3[]"])
def test_usd_offsets_are_si_whatever_the_stage(scene_file, kind):
    array = read_array(
        scene_file,
        f"custom {kind} rfsg:radio:array:offsets = [(0, 0.5, 0), (0, -0.5, 0.25)]",
        'custom token rfsg:radio:array:unit = "m"',
    )
    assert array.offsets.tolist() == [[0, 0.5, 0], [0, -0.5, 0.25]] and array.unit == "m"


def test_a_radio_without_array_attributes_has_none(scene_file):
    (radio,) = Scene.from_usd(scene_file(radio_text())).transmitters
    assert radio.array is None


def many(n: int) -> str:
    return f"custom double3[] rfsg:radio:array:offsets = [{', '.join(['(0, 0, 0)'] * n)}]"


@pytest.mark.parametrize(
    "attributes, fault",
    [
        (["custom int rfsg:radio:array:rows = 0"], "rows is 0; expected a whole number > 0"),
        (["custom int rfsg:radio:array:rows = 100000"], "array: 100000 elements; expected 1 to"),
        ([many(5000)], "offsets is an array of 5000; expected 1 to 4096 triples"),
        ([many(0)], "expected 1 to 4096 triples"),
        (["custom double3[] rfsg:radio:array:offsets = [(0, nan, 0)]"], "finite numbers"),
        (['custom string rfsg:radio:array:offsets = "here"'], "triples of finite numbers"),
        (['custom token rfsg:radio:array:unit = "feet"'], "expected one of wavelength, m"),
        (["custom double rfsg:radio:array:spacingVertical = -1"], "expected a finite number > 0"),
        (["custom int rfsg:radio:array:rows = 2", many(2)], "say one of them"),
        (['custom token rfsg:radio:polarization = "45"'], "one of none, V, H, +45, -45, VH, cross"),
    ],
)
def test_usd_faults_name_the_prim(scene_file, attributes, fault):
    with pytest.raises(SceneError) as error:
        Scene.from_usd(scene_file(radio_text(*attributes)))
    (line,) = error.value.faults
    assert line.startswith("/World/AP: ") and fault in line and len(line) < 200


def test_round_trip(tmp_path):
    free = Array.of(np.random.default_rng(0).normal(size=(7, 3)).tolist(), "m")
    radios = (
        Radio.at("/World/panel", 0, 0, 1, polarization="cross", array=Array.planar(3, 7, 0.05, 0.1, "m")),
        Radio.at("/World/free", 0, 0, 2, polarization="+45", array=free),
        Radio.at("/World/one", 0, 0, 3, polarization="-45"),
        Radio.at("/World/pair", 0, 0, 4, polarization="VH"),
    )  # fmt: skip
    path = Scene((), radios).to_usd(tmp_path / "out.usda")
    read = Scene.from_usd(path)
    assert usd.check(path) == [] and read.warnings == ()
    for a, b in zip(radios, read.transmitters, strict=True):
        assert (a.polarization, a.array is None) == (b.polarization, b.array is None)
        if a.array is not None and b.array is not None:
            assert torch.equal(a.array.offsets, b.array.offsets)
            assert (a.array.unit, a.array.layout) == (b.array.unit, b.array.layout)
    assert read.to_usd(tmp_path / "again.usda").read_text() == path.read_text()


def test_info_shows_arrays():
    from rfsg.report import radio_table

    radio = Radio.at("/r", 0, 0, 0, polarization="VH", array=Array.planar(4, 8))
    row, plain = radio_table(Scene((), (radio,), (Radio.at("/s", 0, 0, 0),)))
    assert str(row["array"]) == "4 x 8, 0.5 x 0.5 wavelength" and row["polarization"] == "VH"
    assert plain["array"] == ""
