"""The files of a run: what they say agrees with the records they were written from."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rfsg import report
from rfsg.scene.world import World
from rfsg.tracer import pathtable
from rfsg.tracer.cells import grid_on, plane_through
from rfsg.tracer.channel import Link, thermal_noise_dbm
from rfsg.tracer.patches import patches_of
from rfsg.tracer.radiomap import RadioMap
from rfsg.tracer.records import Act

SPEED_OF_LIGHT = 299_792_458.0


def read(file):
    with open(file, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_paths_are_the_arriving_ones_strongest_first(small_run, tmp_path):
    report.write_paths(small_run, tmp_path / "paths.csv")
    rows = read(tmp_path / "paths.csv")
    assert tuple(rows[0]) == report.PATH_COLUMNS
    assert [row["rx"] for row in rows] == ["/World/rx_0", "/World/rx_0", "/World/rx_1"]
    assert [row["interactions"] for row in rows] == [
        "line_of_sight",
        "reflection(/World/Wall)",
        "penetration(/World/Ball)",
    ]
    assert rows[0]["vertices"] == "0.000000 0.000000 1.000000; 4.000000 0.000000 1.000000"
    assert rows[1]["vertices"].count(";") == 2


def test_a_path_row_says_what_the_channel_says(small_run):
    direct = pathtable.path_rows(small_run)[0]
    assert direct["delay_ns"] == pytest.approx(1e9 * 4.0 / SPEED_OF_LIGHT, rel=1e-12)
    assert direct["gain_db"] == pytest.approx(20 * np.log10(0.0239 / 4.0), rel=1e-12)
    expected = np.angle(np.exp(-2j * np.pi * 1e9 * 4.0 / SPEED_OF_LIGHT))
    assert direct["phase_rad"] == pytest.approx(expected, abs=1e-9)
    assert direct["aod_azimuth_deg"] == pytest.approx(0.0, abs=1e-9)
    assert direct["aoa_azimuth_deg"] == pytest.approx(180.0)


@pytest.mark.parametrize("act", Act)
def test_every_act_has_its_word(small_run, act):
    words = {Act.REFLECT: "reflection", Act.DIFFRACT: "diffraction", Act.SCATTER: "scattering"}
    words |= {Act.ENTER: "refraction_in", Act.LEAVE: "refraction_out"}
    small_run.paths.act[1] = int(act)
    assert pathtable.path_rows(small_run)[1]["interactions"] == f"{words[act]}(/World/Wall)"


@pytest.mark.parametrize(
    ("direction", "azimuth", "elevation"),
    [((1, 0, 0), 0, 0), ((0, 1, 0), 90, 0), ((-1, 0, 0), 180, 0), ((0, 0, -1), 0, -90)]
    + [((0.5, -0.5, 0.5**0.5), -45, 45), ((-1, -0.0, -0.0), 180, 0)],
)
def test_angles(direction, azimuth, elevation):
    angles = pathtable.angles_deg(np.array([direction], dtype=float))
    assert angles[0] == pytest.approx([azimuth, elevation])


def test_links_without_a_path_leave_their_cells_empty(tmp_path):
    silent = dict.fromkeys(report.LINK_COLUMNS, 0.0) | {"n_paths": 0, "los": False}
    silent |= {"path_gain_db": -np.inf, "coherence_time_s": np.inf}
    report.write_links(SimpleNamespace(links=lambda: [silent]), tmp_path / "links.csv")
    (row,) = read(tmp_path / "links.csv")
    assert row["path_gain_db"] == row["coherence_time_s"] == ""
    assert row["delay_spread_ns"] == row["n_paths"] == row["los"] == "0"


def test_links_are_written_with_every_column(small_run, tmp_path):
    assert report.LINK_COLUMNS == tuple(Link.__annotations__)
    report.write_links(small_run, tmp_path / "links.csv")
    near, far = read(tmp_path / "links.csv")
    assert (far["rx"], far["n_paths"], far["los"]) == ("/World/rx_1", "1", "0")
    assert (near["rx"], near["los"], near["n_paths"]) == ("/World/rx_0", "1", "2")
    # powers go as one over the squared length: 4 m and 2 hypot(2, 2.9) m
    assert float(near["k_factor_db"]) == pytest.approx(20 * np.log10(np.hypot(2, 2.9) / 2))
    # the receiver's two directions: straight, and off the wall in the middle
    share = 1 / (1 + 4 / np.hypot(2, 2.9) ** 2)
    turn = np.arctan2(2.9, 2.0)
    r = abs(share + (1 - share) * np.exp(1j * turn))
    assert float(near["asa_deg"]) == pytest.approx(np.degrees(np.sqrt(-2 * np.log(r))), rel=1e-6)


def test_the_channel_file_holds_the_same_bits(small_run, tmp_path):
    report.write_channel(small_run, tmp_path / "channel.npz")
    with np.load(tmp_path / "channel.npz", allow_pickle=False) as stored:
        assert np.array_equal(stored["gain"], small_run.channel.gain.numpy())
        assert np.array_equal(stored["delay"], small_run.channel.delay.numpy())
        assert list(stored["rx_paths"]) == ["/World/rx_0", "/World/rx_1"]
        assert stored["path_gain"].shape == (1, 2, 1)
        # The file alone gives the channel back.
        turns = np.exp(-2j * np.pi * stored["frequency"][0] * stored["delay"])
        heard = (stored["rx"] == 0) & ~stored["blocked"]
        h = (stored["gain"][:, 0] * turns)[heard].sum()
        lengths = np.array([4.0, 2 * np.hypot(2.0, 2.9)])
        gains = 0.0239 / lengths * np.exp(1j * np.array([0.0, 3.0]))
        expected = (gains * np.exp(-2j * np.pi * 1e9 * lengths / SPEED_OF_LIGHT)).sum()
        assert h == pytest.approx(expected, rel=1e-9)


def test_responses_are_the_channel_over_band_and_time(small_run, tmp_path):
    channel = small_run.channel
    arrays = report.response_arrays(small_run, 1e8, 8, snapshots=5, duration_s=1e-3)
    report.write_channel(small_run, tmp_path / "channel.npz", arrays)
    with np.load(tmp_path / "channel.npz", allow_pickle=False) as stored:
        assert stored["time"] == pytest.approx(np.arange(5) * 2e-4)
        assert stored["subcarrier_frequency"].shape == (1, 8)
        assert stored["cfr"].shape == (1, 2, 1, 5, 8) and stored["transfer"].shape == (1, 2, 1, 5)
        # the carrier is number 4 of 8, at every time
        assert stored["cfr"][..., 4] == pytest.approx(stored["transfer"])
        delay, drift = channel.delay[:2, None].numpy(), channel.doppler[:2, None].numpy() / 1e9
        late = delay - drift * stored["time"]
        gain = channel.gain[:2].numpy() * np.exp(-2j * np.pi * 1e9 * late)
        assert stored["transfer"][0, 0, 0] == pytest.approx(gain.sum(0), rel=1e-6)
        count, first = stored["taps"].shape[-1], int(stored["first_tap"])
        number = first + np.arange(count)
        pulse = np.sinc(number - 1e8 * delay)
        taps = (gain[:, :1] * pulse).sum(0)
        assert stored["taps"][0, 0, 0, 0] == pytest.approx(taps, rel=1e-6, abs=1e-9)
    assert report.response_arrays(small_run) == {}
    with pytest.raises(ValueError, match="snapshots"):
        report.response_arrays(small_run, snapshots=5)


def test_a_map_file_places_its_cells_and_holds_every_metric(small_run, tmp_path):
    scene = small_run.scene
    upright = plane_through((1.0, 2.0, 0.5), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    gain = torch.tensor([[[1e-6, 0.0]]], dtype=torch.float64)
    found = RadioMap(scene, 1e9, grid_on(upright, (0, 0, 2, 1), 1.0), gain, 0 * gain, "paths")
    report.write_map(found, tmp_path / "map.npz", 1e6, 5.0)
    with np.load(tmp_path / "map.npz", allow_pickle=False) as stored:
        x, y = (stored[name][..., None] for name in "xy")
        place = stored["origin"] + x * stored["u"] + y[:, None] * stored["v"]
        assert place.reshape(-1, 3) == pytest.approx(found.cells.point.numpy())
        assert stored["rss_dbm"].tolist() == [[[pytest.approx(-50.0), -np.inf]]]
        assert stored["path_loss_db"].tolist() == [[[pytest.approx(60.0), np.inf]]]
        noise = thermal_noise_dbm(1e6, 5.0)
        assert stored["sinr_db"][0, 0, 0] == pytest.approx(-50.0 - noise)
        assert stored["best_server"].tolist() == [[0, -1]]
        assert not np.isnan(stored["sinr_db"]).any()
    patches = patches_of(World(scene), "/World/Ball", 1.0, 0.01)
    gain = torch.ones(1, len(patches.point), dtype=torch.float64)
    on = RadioMap(scene, 1e9, patches, gain, 0 * gain, "paths")
    report.write_map(on, tmp_path / "on.npz")
    with np.load(tmp_path / "on.npz", allow_pickle=False) as stored:
        assert stored["triangle"].shape == (len(stored["owner"]), 3, 3)
        assert stored["owner"].max() == len(patches.point) - 1
        assert stored["area"] == pytest.approx(patches.area.numpy())


def test_the_report_is_json_and_complete(small_run, tmp_path):
    facts = report.report(small_run, seed=3, oddity=float("nan"))
    report.write_json(facts, tmp_path / "report.json")
    text = json.loads((tmp_path / "report.json").read_text())
    assert text["seed"] == 3 and text["oddity"] is None
    assert text["quality"]["depth"] == 3 and text["paths"] == 3
    assert text["status_counts"] == {"OK": 3, "OPAQUE": 1}
    assert set(text["status_meaning"]) == {"OK", "OPAQUE"}
    assert {"modelled", "left_out", "seconds", "versions", "warnings"} <= set(text)


def test_an_output_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "deep" / "out"
    with pytest.raises(ZeroDivisionError), report.output_folder(out) as folder:
        (folder / "a.txt").write_text("half")
        raise ZeroDivisionError
    assert not out.exists() and not list(out.parent.iterdir())
    with report.output_folder(out) as folder:
        (folder / "a.txt").write_text("whole")
    assert (out / "a.txt").read_text() == "whole"
    assert list(out.parent.iterdir()) == [out]


def test_nothing_is_overwritten_unasked(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(report.OutputExists, match="--overwrite"):
        with report.output_folder(tmp_path):
            pass
    with report.output_folder(tmp_path, overwrite=True) as folder:
        (folder / "links.csv").write_text("new")
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert (tmp_path / "links.csv").read_text() == "new"
    with pytest.raises(report.OutputExists, match="file"):
        report.refuse_taken(tmp_path / "mine.txt", overwrite=True)


def test_the_scene_table_counts_and_measures(small_run):
    wall, ball = report.scene_table(small_run.scene)
    assert (wall["path"], wall["shape"], wall["surface"]) == ("/World/Wall", "box", "conductor")
    assert wall["size [m]"] == "4 x 0.2 x 3" and ball["at [m]"] == "2 -1 1"


def test_the_parameter_table_names_every_tensor(small_run):
    rows = report.parameter_table(small_run.scene)
    count = sum(1 for node in small_run.scene.nodes for _ in node.body.parameters())
    assert len(rows) == count > 0
    assert all(row["path"].startswith("/World/") for row in rows)
