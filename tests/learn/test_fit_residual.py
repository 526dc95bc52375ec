"""What a fitted scene leaves: it helps where it should, is kept on disk, and stays behind when moved."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

import rfsg
from rfsg.learn.errors import LearnError
from rfsg.learn.model import load
from rfsg.learn.over_scene import Ends, ResidualSettings, SceneResidual
from rfsg.objects.surfaces.interface import Conductor
from tests.learn.rooms import QUALITY, halfspace, readings, room_with, thing
from tests.scenes import box_node, radio

ONE = ResidualSettings(counts=(1,), most=60)
STEP = 9.0  # [dB] by which places on one side of the room are weaker, whatever the gateway


def weak_side(scene, measured, seed=2, noise=0.5):
    """Readings with noise, and weaker where x > 3 m: something that the places carry."""
    position = {r.path: r.position for r in (*scene.transmitters, *scene.receivers)}
    x = torch.stack([position[p] for p in measured.rx_places])[measured.rx, 0]
    g = torch.Generator().manual_seed(seed)
    extra = noise * torch.randn(len(measured), generator=g, dtype=torch.float64)
    extra = extra - torch.where(x > 3.0, STEP, 0.0)
    return replace(measured, value=measured.value + torch.stack([extra, 0.0 * extra], -1))


def room(count=36):
    """The room with two gateways that send and places that receive."""
    scene = room_with(thing(halfspace(4.0, 0.1)), count=count)
    return scene.with_transmitters(
        [*scene.transmitters, replace(scene.transmitters[0], path="/tx2", position=OTHER)]
    )


OTHER = torch.tensor([5.3, 3.1, 1.9], dtype=torch.float64)


def fitted(scene, measured, **options) -> rfsg.Fitted:
    standard = {"quality": QUALITY, "steps": 3, "batch": 10, "validation": 0.25, "residual": ONE}
    return rfsg.fit(scene, measured, **{"select": ["power"], **standard, **options})


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """(folder, fit, readings) of a fit with a residual."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("whole") / "fit"
    scene = room()
    measured = weak_side(scene, readings(scene, "rssi"))
    done = fitted(scene, measured, out=out)
    torch.set_num_threads(before)
    return out, done, measured


# both are said


def test_the_residual_takes_what_the_places_carry(whole):
    """A step over places that all gateways see: physics cannot have it, the residual does."""
    _, done, _ = whole
    for which in ("train", "validation"):
        physics, both = (done.report[which][k]["p90_db"] for k in ("after", "with_residual"))
        assert both < 0.5 * physics and physics > 0.8 * STEP
    assert done.report["train"]["with_residual"]["readings"] == 54
    sure, left = done.report["uncertainty"], done.report["residual"]
    assert sure["calibrated_on"] == "validation" and sure["calibrating_readings"] == 18
    assert 0.0 <= sure["coverage"] <= 1.0 and 0.0 <= left["coverage"] <= 1.0
    assert left["places_are"] == "receivers" and left["readings"] == 54


def test_files_say_both_with_bounds(whole):
    out, done, measured = whole
    rows = list(csv.DictReader((out / "predictions.csv").open()))
    number = [{k: float(v) for k, v in r.items() if k in NUMBERS} for r in rows]
    for row, said in zip(number, done.after.rssi_dbm().tolist(), strict=True):
        assert row["predicted"] == said
        assert row["low"] < row["high"]
        assert row["with_residual_low"] < row["with_residual"] < row["with_residual_high"]
    # the widening was chosen so that nine tenths and one more of those held lie inside
    held = [r for r, raw in zip(number, rows, strict=True) if raw["used"] == "validation"]
    for low, high in (("low", "high"), ("with_residual_low", "with_residual_high")):
        inside = sum(r[low] <= r["measured"] <= r[high] for r in held)
        assert inside == 18  # ceil(0.9 (18 + 1)) = 18
    widths = np.array(
        [[r["high"] - r["low"], r["with_residual_high"] - r["with_residual_low"]] for r in number]
    )
    assert np.median(widths[:, 1]) < np.median(widths[:, 0])


NUMBERS = "measured predicted low high with_residual with_residual_low with_residual_high".split()


def test_without_a_residual_physics_has_its_interval(tmp_path):
    scene = room(12)
    measured = readings(scene, "rssi")
    done = fitted(scene, measured, residual=False, validation=0.0, out=tmp_path / "fit")
    report = json.loads((tmp_path / "fit" / "report.json").read_text())
    assert report["residual"] is None and "with_residual" not in report["train"]
    assert report["uncertainty"]["calibrated_on"] == "train"
    assert report["uncertainty"]["coverage"] is None
    rows = list(csv.DictReader((tmp_path / "fit" / "predictions.csv").open()))
    assert all(r["low"] and not r["with_residual"] for r in rows)
    assert not (tmp_path / "fit" / "residual.safetensors").exists()
    assert done.predict(measured).with_residual_dbm is None


def test_delays_alone_have_neither():
    """A mirror joins radios that a screen hides from each other; nothing is said of their powers."""
    mirror = box_node("/mirror", (4.5, 2.0, 1.5), (0.5, 4.0, 3.0), Conductor())
    screen = box_node("/screen", (0.0, 2.0, 1.5), (2.5, 0.05, 3.0), Conductor())
    rx = tuple(radio(f"/rx{i}", 1.0, 2.6 + 0.3 * i, 1.2) for i in range(4))
    scene = rfsg.Scene((mirror, screen), (radio("/tx", 1.0, 1.0, 1.5),), rx, 2.4e9)
    late = readings(scene.moved("/mirror", (0.01, 0.0, 0.0)), "delay")
    done = fitted(scene, late, residual=False, select=["/mirror.pose.translation"])
    assert done.report["uncertainty"] is None and done.predict(late).interval_dbm is None
    with pytest.raises(LearnError, match="0 training readings of power"):
        fitted(scene, late, select=["/mirror.pose.translation"])


# predictions and files


def test_a_folder_predicts_as_the_fit_did(whole):
    out, done, measured = whole
    first, again = done.predict(measured), load(out).predict(measured)
    torch.testing.assert_close(again.rssi_dbm(), first.rssi_dbm(), rtol=0.0, atol=1e-9)
    for name in ("interval_dbm", "with_residual_interval_dbm"):
        for a, b in zip(getattr(again, name), getattr(first, name), strict=True):
            torch.testing.assert_close(a, b, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(
        again.with_residual_dbm, first.with_residual_dbm, rtol=0.0, atol=1e-6
    )
    # at readings held for validation, what is said anew is what was scored
    rows = list(csv.DictReader((out / "predictions.csv").open()))
    held = [i for i, r in enumerate(rows) if r["used"] == "validation"]
    column = torch.tensor([float(rows[i]["with_residual"]) for i in held], dtype=torch.float64)
    torch.testing.assert_close(again.with_residual_dbm[held], column, rtol=0.0, atol=1e-6)


def test_a_moved_object_leaves_the_common_term(whole):
    """Physics is of the scene given; of the residual, levels and shared field stay, to the bit."""
    _, done, measured = whole
    moved = done.scene.moved("/thing", (0.3, -0.4, 0.0))
    said, plain = done.predict(measured, moved), rfsg.predict(moved, measured, QUALITY)
    torch.testing.assert_close(said.rssi_dbm(), plain.rssi_dbm(), rtol=0.0, atol=1e-9)
    residual = done.model.residual
    common = residual.at(Ends.of(_links(done, measured)), moved=True).quantile(0.5)
    np.testing.assert_allclose(
        (said.with_residual_dbm - said.rssi_dbm()).numpy(), common, atol=1e-9
    )
    off = (said.with_residual_dbm - measured.value[:, 0]).abs()
    assert off.median() < 0.5 * (said.rssi_dbm() - measured.value[:, 0]).abs().median()


def test_a_resumed_fit_has_the_same_residual_to_the_bit(whole, tmp_path):
    out, _, measured = whole
    scene = room()
    fitted(scene, measured, out=tmp_path / "fit", steps=2)
    fitted(scene, measured, out=tmp_path / "fit", resume=True)
    for name in ("residual.safetensors", "predictions.csv"):
        assert (tmp_path / "fit" / name).read_bytes() == (out / name).read_bytes()
    fitted(scene, measured, out=tmp_path / "fit", overwrite=True, residual=False)
    assert not (tmp_path / "fit" / "residual.safetensors").exists()


def test_what_is_no_residual_is_refused(whole, tmp_path):
    out, _, _ = whole
    data = (out / "residual.safetensors").read_bytes()
    file = tmp_path / "residual.safetensors"
    tensors = load_tensors(data)
    size = int.from_bytes(data[:8], "little")
    head = json.loads(data[8 : 8 + size])["__metadata__"]
    newer = json.dumps(json.loads(head["residual"]) | {"formatVersion": 2})
    nan = torch.full_like(tensors["left_db"], float("nan"))
    for broken, why in (
        (data[: len(data) // 2], "cannot|can be read"),
        (b"", "header"),
        (save_tensors(tensors), "can be read"),
        (save_tensors(tensors, metadata={"residual": newer}), "version 2"),
        (save_tensors(tensors | {"left_db": nan}, metadata=head), "left_db"),
        (save_tensors(tensors | {"whole": tensors["whole"][:3]}, metadata=head), "7 numbers"),
        (save_tensors(tensors | {"levels.own": tensors["levels.own"][:2]}, metadata=head), "own"),
    ):
        file.write_bytes(broken)
        with pytest.raises(LearnError, match=f"(?s)residual.safetensors.*({why})"):
            SceneResidual.unpack(file)
    with pytest.raises(LearnError, match=r"report.json: cannot be read"):
        load(tmp_path)


# the residual itself


def _links(done, measured):
    from rfsg.learn.links import link_up

    return link_up(done.scene, measured)


def ends_and_left(count=30):
    g = np.random.default_rng(3)
    places = g.uniform([0, 0, 1], [6, 4, 1.5], (count, 3))
    gateways = np.array([[0.1, 0.1, 2.0], [5.9, 3.9, 2.0]])
    ends = Ends(np.repeat(places, 2, axis=0), np.tile(gateways, (count, 1)))
    left = np.where(ends.tx[:, 0] > 3.0, -STEP, 0.0) + 0.5 * g.standard_normal(2 * count)
    return ends, torch.from_numpy(left)


def test_channels_are_reciprocal_and_so_is_the_residual():
    ends, left = ends_and_left()
    turned = Ends(ends.rx, ends.tx)
    one = SceneResidual.fit(ends, left, ONE).at(ends)
    two = SceneResidual.fit(turned, left, ONE)
    assert two.flipped
    np.testing.assert_allclose(two.at(turned).mean, one.mean, atol=1e-9)


def test_a_reading_has_no_part_in_what_it_is_compared_with():
    """Cross-validated predictions of a reading do not move with its own value."""
    ends, left = ends_and_left()
    residual = SceneResidual.fit(ends, left, ONE)
    before = residual.held_out()
    value = residual.rest.rssi.copy()
    value[7] += 30.0
    after = replace(residual, rest=replace(residual.rest, rssi=value)).held_out()
    assert after.mean[7, 0] == pytest.approx(before.mean[7, 0], abs=1e-9)
    assert abs(after.mean - before.mean).max() > 0.5


def test_a_gateway_never_heard_gets_what_all_share():
    ends, left = ends_and_left()
    residual = SceneResidual.fit(ends, left, ONE)
    new = Ends(ends.tx, np.full_like(ends.rx, 2.0))
    said = residual.at(new)
    east = ends.tx[:, 0] > 3.5
    assert said.mean[east].mean() < said.mean[~east].mean() - 0.5 * STEP


def test_too_little_is_said_to_be_too_little():
    ends, left = ends_and_left(5)
    with pytest.raises(LearnError, match="10 training readings of power.*at least 12"):
        SceneResidual.fit(ends, left, ONE)
    with pytest.raises(LearnError, match="residual: counts"):
        ResidualSettings(counts=())
