"""What a scene says of readings: paths kept, summed per link, offsets added."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.learn.kept import Kept, Shares
from rfsg.learn.links import Links, link_up
from rfsg.learn.losses import LEAST_POWER, Predicted
from rfsg.learn.measurements import Measurements
from rfsg.scene.scene import Scene
from rfsg.tracer.plan import Quality

AT_ONCE = 512  # readings predicted together where no gradient is asked for


def predict(
    scene: Scene,
    measured: Measurements,
    quality: str | Quality = "draft",
    *,
    coherent: bool = True,
    gains_db: Mapping[str, float] | None = None,
    offset_db: float = 0.0,
) -> Predicted:
    """What a scene says of readings, without gradients; the readings' values are not looked at.

    gains_db: of radios by path, as a fit found them. offset_db: of the powers of what sends and is
    no transmitter of the scene, whose own powers a fit has already put right.
    """
    kept = search(scene, measured, quality)
    return predict_kept(kept, scene, coherent, gains_db or {}, offset_db)


def search(scene: Scene, measured: Measurements, quality: str | Quality = "draft") -> Kept:
    """The paths of every reading's link; nothing of them is learned."""
    quality = Quality.named(quality) if isinstance(quality, str) else quality
    return Kept(scene, link_up(scene, measured), quality, [], [])


def predict_kept(
    kept: Kept, scene: Scene, coherent: bool, gains_db: Mapping[str, float], offset_db: float
) -> Predicted:
    """As ``predict``, over paths that were found already."""
    gains = {k: torch.tensor(v, dtype=torch.float64) for k, v in gains_db.items()}
    own = {id(r) for r in scene.transmitters}
    radios = kept.links.transmitters
    offset = torch.tensor([0.0 if id(r) in own else offset_db for r in radios])
    return predict_all(kept, scene, coherent, gains, offset)


@torch.no_grad()
def predict_all(
    kept: Kept,
    scene: Scene,
    coherent: bool,
    gains_db: Mapping[str, Tensor],
    offset_db: Tensor | None,
) -> Predicted:
    """Every reading of the kept links, some at a time."""
    rows = torch.arange(len(kept.links.link_of)).split(AT_ONCE)
    parts = [predict_rows(kept, scene, i, coherent, gains_db, offset_db) for i in rows]
    names = Predicted.__dataclass_fields__
    return Predicted(*(torch.cat([getattr(p, n) for p in parts]) for n in names))


def predict_rows(
    kept: Kept,
    scene: Scene,
    rows: Int[Tensor, "b"],
    coherent: bool,
    gains_db: Mapping[str, Tensor],
    offset_db: Tensor | None,
) -> Predicted:
    """What is said of some readings, with the parameters as they are now; differentiable.

    offset_db: of every power, one for all or one per transmitter of the links.
    """
    links = kept.links
    asked, place = torch.unique(links.link_of[rows], return_inverse=True)
    shares = kept.shares(asked, scene)
    shape = len(asked), len(links.frequency)
    transfer = shares.value.new_zeros(shape).index_add(0, shares.link, shares.value)
    if coherent:
        power = transfer.real**2 + transfer.imag**2
    else:
        square = shares.value.real**2 + shares.value.imag**2
        power = square.new_zeros(shape).index_add(0, shares.link, square)
    f = links.frequency_of[rows]
    offset = _antennas_db(links, asked, gains_db)[place]
    amplitude = 10.0 ** (offset / 20.0)
    sent = torch.tensor([r.power_dbm for r in links.transmitters], dtype=torch.float64)
    sent = sent if offset_db is None else sent + offset_db
    power = power[place, f] * amplitude**2
    strongest = _strongest(shares, len(asked))[place]
    found = strongest >= 0
    row = strongest.clamp(min=0)
    silent = torch.zeros(len(rows), 3, dtype=torch.float64)
    none = not len(shares.link)
    return Predicted(
        transfer[place, f] * amplitude,
        power,
        sent[links.tx[asked[place]]],
        silent[:, 0] if none else shares.delay[row],
        silent if none else shares.departure[row],
        silent if none else shares.arrival[row],
        found & (power.detach() > LEAST_POWER),
    )


def _antennas_db(
    links: Links, asked: Int[Tensor, "k"], gains_db: Mapping[str, Tensor]
) -> Float[Tensor, "k"]:
    """What both ends' gain offsets add to some links [dB]."""
    total = torch.zeros(len(asked), dtype=torch.float64)
    if not gains_db:
        return total
    zero = torch.zeros((), dtype=torch.float64)
    for radios, which in ((links.transmitters, links.tx), (links.receivers, links.rx)):
        own = torch.stack([gains_db.get(r.path, zero) for r in radios])
        total = total + own[which[asked]]
    return total


@torch.no_grad()
def _strongest(shares: Shares, links: int) -> Int[Tensor, "k"]:
    """The row of each link's strongest path, at the first frequency; -1 where it has none."""
    row = torch.full((links,), -1, dtype=torch.int64)
    order = torch.argsort(shares.value.detach()[:, 0].abs(), stable=True)
    order = order[torch.argsort(shares.link[order], stable=True)]
    last = torch.cumsum(torch.bincount(shares.link, minlength=links), 0) - 1
    there = torch.bincount(shares.link, minlength=links) > 0
    row[there] = order[last[there]]
    return row
