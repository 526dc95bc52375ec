"""Fitting: known truths come back, slopes are right, nothing not finite gets in, kills are survived."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

import rfsg
from rfsg.learn import training as trainings
from rfsg.learn.errors import LearnError
from rfsg.learn.fit import Fitted
from rfsg.learn.kept import Kept
from rfsg.learn.links import link_up
from rfsg.learn.losses import Losses
from rfsg.learn.regularisation import Regularisation
from rfsg.learn.selection import select
from rfsg.learn.training import Settings, Training
from rfsg.objects.body import Body
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.scene import SceneError
from tests.learn.rooms import (
    QUALITY,
    halfspace,
    learned,
    readings,
    room_with,
    thing,
    with_surface,
)
from tests.scenes import box_node, radio

NONE = Regularisation(laplacian=0.0, eikonal=0.0)


def fitted(scene, measured, patterns, **options) -> Fitted:
    standard = {
        "quality": QUALITY,
        "steps": 150,
        "batch": 10,
        "schedule": "cosine",
        "validation": 0.0,
        "regularisation": NONE,
    }
    return rfsg.fit(scene, measured, select=patterns, **{**standard, **options})


def training(scene, measured, patterns, **options) -> Training:
    """A fit under way, before its first step, everything in float64."""
    links = link_up(scene, measured)
    selection = select(scene, patterns)
    for node in selection.base.nodes:
        node.body.double()
    held = torch.zeros(len(measured), dtype=torch.bool)
    standard = {"quality": QUALITY, "batch": len(measured), "regularisation": NONE}
    settings = Settings(exact=True, **{**standard, **options})
    return Training(scene, selection, measured, links, held, settings)


def test_smoothness_is_asked_seldom_and_as_strongly_in_the_mean():
    """At a step that asks, so many times what one asking costs; nothing at the others."""
    start = room_with(thing(StochasticSurface()), count=4)
    each, seldom = (
        training(
            start,
            readings(start, "rssi"),
            ["/thing.surface"],
            regularisation=Regularisation(every=k),
        )
        for k in (1, 3)
    )
    for asked in (each, seldom):
        asked.search()
    for step in range(7):
        once, now = (float(t._regularisation(step).detach()) for t in (each, seldom))
        assert once > 0
        assert now == (pytest.approx(3.0 * once) if step % 3 == 0 else 0.0)


# truths come back


def test_a_walls_constants_come_back():
    scene = room_with(count=10)
    truth = with_surface(scene, "/x1", halfspace(4.3, 0.03))
    start = with_surface(scene, "/x1", halfspace(5.2, 0.06))
    done = fitted(
        start,
        readings(truth),
        ["/x1.surface.*"],
        steps=400,
        learning_rate=1e-3,
        rates={"*.eps_r": 60.0, "*.sigma": 4.0},
    )
    medium = done.scene.node("/x1").body.surface.medium
    assert medium.eps_r.item() == pytest.approx(4.3, rel=1e-3)
    assert medium.sigma.item() == pytest.approx(0.03, rel=1e-3)
    assert done.report["train"]["after"]["p90_db"] < 1e-3 < done.report["train"]["before"]["p90_db"]
    assert start.node("/x1").body.surface.medium.eps_r.item() == 5.2
    assert done.report["settings"]["steps"] == 400


def test_a_pose_comes_back():
    """Mirrors on two sides of a box say where it stands on the floor (and nothing of its height)."""
    sides = (radio("/tx1", 1.3, 2.1, 1.7), radio("/tx2", 3.4, 0.5, 1.4))
    places = ((1.0, 1.5, 1.0), (1.5, 3.2, 1.1), (2.2, 0.6, 1.4), (4.2, 0.7, 1.5), (2.6, 0.5, 1.9))
    scene = room_with(thing(halfspace(5.0, 0.5))).with_transmitters(sides)
    scene = scene.with_receivers([radio(f"/rx{i}", *p) for i, p in enumerate(places)])
    start = scene.moved("/thing", (0.008, -0.006, 0.0))
    done = fitted(
        start,
        readings(scene),
        ["/thing.pose.translation"],
        steps=120,
        refresh=60,
        batch=10,
        learning_rate=1e-3,
        rates={"*": 1.0},
    )
    place = done.scene.node("/thing").pose.translation
    torch.testing.assert_close(place, scene.node("/thing").pose.translation, rtol=0.0, atol=1e-4)
    assert not place.requires_grad and done.report["searches"] == 3


@pytest.mark.parametrize("kind", ["rssi", "gain"])
def test_offsets_come_back(kind):
    scene = room_with(count=8)
    measured = readings(scene, kind)
    patterns, wanted = (["power"], 6.0) if kind == "rssi" else (["/rx3.gain_db"], -2.0)
    if kind == "rssi":
        louder = replace(measured, value=measured.value + torch.tensor([6.0, 0.0]))
    else:
        quiet = measured.value * 10.0 ** (-2.0 / 20.0)
        mine = measured.rx == measured.rx_places.index("/rx3")
        louder = replace(measured, value=torch.where(mine[:, None], quiet, measured.value))
    options = {"steps": 300, "learning_rate": 2e-3, "rates": {"*": 100.0}}
    done = fitted(scene, louder, patterns, **options)
    if kind == "rssi":
        assert done.scene.transmitters[0].power_dbm == pytest.approx(10.0 + wanted, abs=1e-4)
        again = done.predict(louder).rssi_dbm()
        torch.testing.assert_close(again, louder.value[:, 0], rtol=0.0, atol=1e-4)
    else:
        assert done.gains_db["/rx3"] == pytest.approx(wanted, abs=1e-4)
        assert set(done.gains_db) == {"/rx3"}


def test_a_learned_surface_learns():
    """A stochastic surface comes to answer as another of its kind does."""
    truth = room_with(thing(learned(0, m=0.3, sharpness=15.0, phi=0.3)), count=24)
    start = with_surface(truth, "/thing", learned(1))
    done = fitted(
        start, readings(truth), ["/thing.surface"], steps=150, learning_rate=1e-3, validation=0.25
    )
    before, after = (done.report["validation"][k]["p90_db"] for k in ("before", "after"))
    assert after < 0.3 * before
    assert done.report["refused_steps"] == {}


# slopes


def neural_thing() -> Body:
    """An object of which everything is a network, and not the plainest of its kind."""
    shape = NeuralShape([[-0.6] * 3, [0.6] * 3], width=16, depth=4, skip=2, frequencies=2, seed=1)
    surface = learned(2, sharpness=8.0, m=0.4, phi=0.2, bulk=0.3)
    with torch.no_grad():
        surface.head_weight.normal_(0.0, 0.02)
    return Body(shape, surface)


SLOPES = {
    "constants": (lambda: halfspace(5.0, 0.5), ["/thing.surface"]),
    "learned surface": (lambda: learned(0, sharpness=8.0), ["/thing.surface"]),
    "pose": (lambda: halfspace(5.0, 0.5), ["/thing.pose"]),
    "pose of what is crossed": (lambda: learned(0, sharpness=8.0), ["/thing.pose", "/tx.gain_db"]),
    "network": (None, ["/thing", "/thing.pose"]),
}


@pytest.mark.parametrize(
    ("kind", "case"),
    [
        # of the dear case one kind is enough at every turn
        pytest.param(k, c, marks=[pytest.mark.slow] * ((k, c) == ("rssi", "network")))
        for k in ("rssi", "polarised")
        for c in SLOPES
    ],
)
def test_the_slope_of_the_loss_is_that_of_differences(case, kind):
    """Envelope and implicit function theorems against whole evaluations, chains kept, in float64."""
    make, patterns = SLOPES[case]
    node = thing(make() if make else None)
    if make is None:
        node = replace(node, body=neural_thing())
    scene = room_with(node)
    if kind == "polarised":
        slanted = [replace(r, polarization="+45") for r in scene.receivers]
        upright = [replace(r, polarization="V") for r in scene.transmitters]
        scene, kind = scene.with_receivers(slanted).with_transmitters(upright), "gain"
    measured = readings(scene, kind)
    measured = replace(measured, value=measured.value * 1.03)
    run = training(scene, measured, patterns)
    run.search()
    if case in ("pose", "pose of what is crossed", "network"):
        assert run.kept.tracks.groups and bool(run.kept.traced.any())
    rows = run.pool
    total, _ = run._loss(rows, 0)
    slopes = run._gradients(total)
    generator = torch.Generator().manual_seed(4)
    ways = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in run.parameters]
    ways = [w / max(1.0, float(w.norm())) for w in ways]
    slope = sum(float((s * w).sum()) for s, w in zip(slopes, ways, strict=True))
    assert slope != 0.0
    step, values = 1e-6, []
    for move in (step, -2.0 * step):
        with torch.no_grad():
            for p, w in zip(run.parameters, ways, strict=True):
                p.add_(w, alpha=move)
        values.append(float(run._loss(rows, 0)[0].detach()))
    assert slope == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=2e-5)


def test_a_mirrors_place_comes_back_from_delays():
    """A screen hides the radios from each other; a mirror at x = 4 joins them. Moved by d along its
    normal, it makes each path 2 d cos(theta) longer: the envelope theorem's slope, in closed form."""
    mirror = box_node("/mirror", (4.5, 2.0, 1.5), (0.5, 4.0, 3.0), Conductor())
    screen = box_node("/screen", (0.0, 2.0, 1.5), (2.5, 0.05, 3.0), Conductor())
    rx = tuple(radio(f"/rx{i}", 1.0, 2.6 + 0.3 * i, 1.2) for i in range(4))
    scene = rfsg.Scene((mirror, screen), (radio("/tx", 1.0, 1.0, 1.5),), rx, 2.4e9)
    measured = readings(scene, "delay")
    start = scene.moved("/mirror", (0.05, 0.0, 0.0))
    run = training(start, measured, ["/mirror.pose.translation"])
    run.search()
    delay = run.predicted(run.pool).delay
    (slope,) = torch.autograd.grad(delay[0], run.parameters)
    across = 2 * (4.05 - 1.0)
    along = float(torch.linalg.vector_norm(rx[0].position[1:] - torch.tensor([1.0, 1.5])))
    cosine = across / math.hypot(across, along)
    assert float(slope[0]) == pytest.approx(2 * cosine / 299_792_458.0, rel=1e-12)
    done = fitted(
        start,
        measured,
        ["/mirror.pose.translation"],
        batch=4,
        learning_rate=1e-3,
        rates={"*": 2.0},
        losses=Losses(noise_delay_s=1e-10),
    )
    place = done.scene.node("/mirror").pose.translation
    torch.testing.assert_close(place, mirror.pose.translation, rtol=0.0, atol=3e-4)
    assert done.report["train"]["after"]["median_delay_s"] < 3e-12


@pytest.mark.parametrize(
    ("surface", "patterns", "quality"),
    [
        (learned(0), ["/thing.surface"], QUALITY),
        (halfspace(5.0, 0.5), ["/thing.pose"], QUALITY),
        (learned(0), ["/thing.surface"], rfsg.Quality.named("standard", depth=1)),
    ],
    ids=["factored", "traced", "bent round edges"],
)
def test_kept_paths_say_what_a_simulation_says(surface, patterns, quality):
    """Coherent sums over kept paths are those of ``simulate``, but for its floor."""
    scene = room_with(thing(surface))
    run = training(scene, readings(scene), patterns, quality=quality)
    run.search()
    h = rfsg.simulate(scene, 2.4e9, quality).transfer()[0, :, 0]
    torch.testing.assert_close(run.predicted_all().gain, h, rtol=1e-3, atol=0.0)


def test_float32_fields_are_near_float64():
    scene = room_with(thing(learned(0, sharpness=8.0)))
    run = training(scene, readings(scene), ["/thing.surface"])
    exact = run.search()
    quick = Kept(run.scene(), run.links, QUALITY, run.surface, run.moving)
    every = torch.arange(len(run.links))
    with torch.no_grad():
        a, b = (k.shares(every, run.scene()).value for k in (exact, quick))
    torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(a.abs().max()))


# what must not get in


def test_what_is_not_finite_never_reaches_the_weights(monkeypatch):
    scene = room_with(thing())
    measured = readings(scene, "rssi")
    real, seen, calls = trainings.loss, [], []

    def broken(predicted, given, how):
        calls.append(len(calls))
        costs, counts = real(predicted, given, how)
        bad = {3: float("nan"), 5: float("inf")}.get(calls[-1], 1.0)
        if calls[-1] == 7:  # a finite loss with a slope that is none
            costs = costs + 0.0 * torch.sqrt(0.0 * costs.abs())
        return costs * bad, counts

    monkeypatch.setattr(trainings, "loss", broken)
    run = training(scene, measured, ["/thing.surface"])
    run.search()
    for step in range(10):
        before = [p.detach().clone() for p in run.parameters]
        run.step(step)
        same = all(torch.equal(a, b) for a, b in zip(before, run.parameters, strict=True))
        seen.append(same)
        assert all(bool(p.isfinite().all()) for p in run.parameters)
    assert [k for k, same in enumerate(seen) if same] == [3, 5, 7]
    assert run.refused["loss"] == 2 and sum(run.refused.values()) == 3
    assert any("gradient of /thing.surface" in cause for cause in run.refused)
    assert int(run.optimiser.tensors()["steps"]) == 7


def test_nothing_but_refused_steps_ends_the_fit(monkeypatch):
    scene = room_with(thing())
    monkeypatch.setattr(trainings, "MOST_REFUSED", 5)
    monkeypatch.setattr(trainings, "loss", lambda p, m, how: (p.power * float("nan"), p.arrives))
    run = training(scene, readings(scene, "rssi"), ["/thing.surface"])
    run.search()
    with pytest.raises(LearnError, match="5 steps one after another were refused"):
        for step in range(10):
            run.step(step)


def test_a_loss_without_slope_stops_at_once_and_says_why():
    far = replace(thing(), pose=rfsg.Pose.at(60.0, 60.0, 1.0))
    scene = room_with(far)
    with pytest.raises(LearnError, match="(?s)no measured link has a path that meets /thing.*away"):
        fitted(scene, readings(scene), ["/thing.surface"])
    near = room_with(thing())
    heard = readings(near, "rssi")
    silent = replace(
        heard,
        received=torch.zeros(len(heard), dtype=torch.bool),
        threshold=torch.full((len(heard),), 500.0, dtype=torch.float64),
    )
    with pytest.raises(LearnError, match="censored and all well below"):
        fitted(near, silent, ["/thing.surface"], losses=Losses(noise_db=1.0))


def test_settings_out_of_range_are_refused():
    scene = room_with(thing(), count=3)
    for wrong, why in (
        ({"steps": 0}, "steps=0"),
        ({"learning_rate": -1.0}, "learning_rate"),
        ({"schedule": "linear"}, "constant, cosine"),
        ({"validation": 1.0}, "validation"),
    ):
        with pytest.raises(LearnError, match=why):
            fitted(scene, readings(scene), ["/thing.surface"], **wrong)


# files, kills


def test_a_fit_writes_all_there_is_to_know(tmp_path):
    scene = room_with(thing(), count=8)
    measured = readings(scene, "rssi")
    out = tmp_path / "fit"
    done = fitted(scene, measured, ["/thing.surface"], out=out, steps=6, validation=0.25)
    read = rfsg.Scene.from_usd(out / "scene.usda")
    h = [rfsg.simulate(s, 2.4e9, QUALITY).transfer() for s in (read, done.scene)]
    torch.testing.assert_close(h[0], h[1], rtol=1e-12, atol=0.0)
    report = json.loads((out / "report.json").read_text())
    assert report["steps"] == 6 and report["train"]["after"]["median_db"] >= 0
    rows = list(csv.DictReader((out / "history.csv").open()))
    assert [float(r["loss"]) for r in rows] == done.history["loss"]
    used = list(csv.DictReader((out / "predictions.csv").open()))
    assert sum(r["used"] == "validation" for r in used) == 2
    again = rfsg.Measurements.from_csv(out / "measurements.csv")
    assert torch.equal(again.value, measured.value)
    asset = (out / "assets" / "thing.usda").read_text()
    assert "frequency_band_hz" in asset
    with pytest.raises(SceneError, match="already exists"):
        fitted(scene, measured, ["/thing.surface"], out=out, steps=6)
    with pytest.raises(LearnError, match="another fit"):
        fitted(scene, measured, ["/thing.surface"], out=out, steps=6, batch=3, resume=True)
    fitted(scene, measured, ["/thing.surface"], out=out, steps=3, overwrite=True)
    assert json.loads((out / "report.json").read_text())["steps"] == 3


CHILD = """
    import sys, time
    import torch
    torch.set_num_threads(1)
    import rfsg
    from tests.learn.rooms import QUALITY, readings, room_with, thing

    out, slow, resume = sys.argv[1], sys.argv[2] == "slow", sys.argv[3] == "resume"
    scene = room_with(thing(), count=8)

    def progress(done, steps, word):
        if slow and done >= 12:
            time.sleep(0.2)

    rfsg.fit(
        scene.moved("/thing", (0.02, 0.0, 0.0)), readings(scene), out=out,
        select=["/thing.surface", "/thing.pose"], steps=18, refresh=7, checkpoint_every=5,
        quality=QUALITY, learning_rate=1e-3, resume=resume, progress=progress,
    )
"""


def test_a_killed_fit_ends_in_the_same_bits(tmp_path):
    """SIGKILL amid the steps, between a search and the next checkpoint; then resumed elsewhere."""
    code = textwrap.dedent(CHILD)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.getcwd()}

    def child(*arguments: str) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, "-c", code, *arguments], env=environment)

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    first = child(str(whole), "fast", "anew")
    second = child(str(killed), "slow", "anew")
    checkpoint = killed / "checkpoint.safetensors"
    deadline = time.monotonic() + 120
    while not (checkpoint.exists() and _steps(checkpoint) == 10):
        assert second.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(0.5)
    second.send_signal(signal.SIGKILL)
    assert second.wait() == -signal.SIGKILL
    assert not (killed / "report.json").exists()
    assert child(str(killed), "fast", "resume").wait(120) == 0
    assert first.wait(120) == 0
    a, b = (load_file(p / "checkpoint.safetensors") for p in (whole, killed))
    assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
    assert len(a["history"]) == 18
    for name in ("history.csv", "predictions.csv", "assets/thing.safetensors"):
        assert (whole / name).read_bytes() == (killed / name).read_bytes()


def _steps(checkpoint) -> int:
    return len(load_file(checkpoint)["history"])
