"""Learn what a cabinet is made of from 200 readings, then move it. Nothing is trained again.

The truth is simulated: 22 mm of chipboard. The fit knows the cabinet's shape and begins with a
learned surface that knows nothing. 60 other places are never seen, and none after the move.
"""

from pathlib import Path

import torch

import rfsg
from rfsg.learn.losses import Losses
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface

CABINET, MOVE = "/World/Cabinet", (0.5, 0.3, 0.0)
torch.manual_seed(0)
quality = rfsg.Quality.named("draft", depth=1)
lab = rfsg.Scene.from_usd(Path(__file__).parents[1] / "assets" / "scenes" / "lab.usda")
for path in ("Desk", "Chairs/Chair_0", "Chairs/Chair_1", "Person"):
    lab = lab.without(f"/World/{path}")

# a beacon in one corner; readings behind the cabinet, where it matters
low, high = torch.tensor([2.3, 1.2, 0.7]), torch.tensor([4.6, 4.0, 1.5])
places = (low + (high - low) * torch.rand(260, 3)).tolist()
beacon = rfsg.Radio.at("/World/Radios/Beacon", 0.8, 5.4, 1.1)
receivers = [rfsg.Radio.at(f"/World/Readings/r{i}", *p) for i, p in enumerate(places)]
lab = lab.with_transmitters([beacon]).with_receivers(receivers)
shape = lab.node(CABINET).body.shape
truth = lab.replaced(CABINET, rfsg.Body(shape, Slab(thickness_m=0.022, itu="chipboard")))
blank = lab.replaced(CABINET, rfsg.Body(shape, StochasticSurface()))


def readings(scene: rfsg.Scene) -> rfsg.Measurements:
    """Path gains [dB] from the beacon to every place, as a scene gives them."""
    gain = rfsg.simulate(scene, frequency=2.44e9, quality=quality).path_gain()[0, :, 0]
    return rfsg.Measurements.of(
        rx=[r.path for r in scene.receivers],
        path_gain_db=(10 * torch.log10(gain)).tolist(),
        frequency_hz=2.44e9,
    )


def say(when: str, predicted: torch.Tensor, measured: rfsg.Measurements) -> None:
    error = (predicted - measured.value[:, 0]).abs()
    print(f"{when}: median {error.median():.2f} dB, 90 % within {error.quantile(0.9):.2f} dB")


measured = readings(truth)
seen, unseen = measured.take(torch.arange(200)), measured.take(torch.arange(200, 260))
fitted = rfsg.fit(
    blank,
    seen,
    select=[f"{CABINET}.surface"],
    steps=400,
    batch=16,
    learning_rate=3e-3,
    schedule="cosine",
    losses=Losses(law="student"),
    quality=quality,
)
print(f"{fitted.report['readings']['say_something']} readings met the cabinet")
say("unseen places before", rfsg.predict(blank, unseen, quality).path_gain_db(), unseen)
say("unseen places after ", fitted.predict(unseen).path_gain_db(), unseen)
moved = readings(truth.moved(CABINET, MOVE)).take(torch.arange(200, 260))
said = fitted.predict(moved, fitted.scene.moved(CABINET, MOVE))
say("the cabinet moved   ", said.path_gain_db(), moved)
