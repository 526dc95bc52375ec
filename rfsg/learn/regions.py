"""Where there is no floor plan: region objects, boxes over the area that learn a loss inside.

    fitted = fit_regions(Measurements.from_csv("readings.csv"))

A region is a Body as any other, of shape Box with the paper's learned surface and a bulk loss
kappa(x). It begins as nothing: its boundary is so blurred that a wave passes it, its kappa near 0.
Only kappa is learned, from direct paths: they never move, so every path is a number times what the
regions take from it (``factors``). What is learned is an image of losses, as in radio tomographic
imaging (Wilson and Patwari, IEEE Trans. Mobile Computing 9(5), 2010), in objects of the scene.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rfsg.learn.baselines.readings import LEAST_DISTANCE
from rfsg.learn.errors import LearnError
from rfsg.learn.fit import Fitted, Progress, fit
from rfsg.learn.losses import Losses
from rfsg.learn.measurements import Measurements, Place, Quantity
from rfsg.learn.model import REPORT
from rfsg.learn.output import to_json
from rfsg.learn.over_scene import ResidualSettings
from rfsg.learn.regularisation import Regularisation
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.scene.weights import write_beside
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.plan import Quality

MOST_REGIONS = 400  # each is a network of its own, asked at every step
# A box blurred over 10 km has no boundary that a wave of a room could feel: crossing 100 m of it
# costs 0.02 dB beside kappa. Its occupancy is 1/2 throughout, so a wave loses kappa / 2 a metre.
SHARPNESS = 1e-4  # [1/m]
# R = exp(-s L / 4) of a boundary with m = alpha = 0: with this length -104 dB, a mirror of nothing.
INTERACTION_LENGTH = 48.0 / SHARPNESS  # [m]
# 0.004 dB a metre. So small a start is a prior as well: kappa grows by factors, so little data
# makes few regions dense and leaves the others empty.
EMPTY = 1e-3  # [Np/m]
# Direct paths only; none is too weak to be followed. Two intervals: kappa is smooth in a region.
QUALITY = Quality.named("draft", depth=0, crossing_samples=2, floor_db=-300.0)
TRANSMITTERS, RECEIVERS, REGIONS = (f"/World/{n}" for n in ("Transmitters", "Receivers", "Regions"))


# the scene


def region_scene(
    transmitters: Float[Tensor, "n 3"],
    receivers: Float[Tensor, "m 3"],
    *,
    links: Int[Tensor, "k 2"] | None = None,
    cell_m: float = 3.0,
    margin_m: float = 0.5,
    height_m: float | None = None,
    seed: int = 0,
) -> Scene:
    """Empty regions over the bounding box of all links, and the radios at the positions given [m].

    links: (transmitter, receiver) that were measured; all pairs by default. cell_m: longest side of a
    region along the floor. height_m: its greatest height; None is one layer for all heights.
    margin_m: how far the regions reach beyond the outermost radio. seed: of the networks, which
    begin alike in all regions.

    The regions stand flush and never overlap; those that no link crosses are left out. The grid turns
    with the positions: its first axis is the principal axis of the positions in the plane, looking to
    the side where they reach out further, so a scene moved or turned about z gets the same regions.

    Paths are ``/World/Transmitters/t0``, ``/World/Receivers/r0``, ``/World/Regions/x0_y0_z0``.
    Raises LearnError for positions that are not finite, sizes out of range, more than MOST_REGIONS
    cells, or links that have no length.
    """
    tx, rx = transmitters.double(), receivers.double()
    _check(tx, rx, cell_m, margin_m, height_m)
    if links is None:
        links = torch.cartesian_prod(torch.arange(len(tx)), torch.arange(len(rx)))
    yaw = _principal(torch.cat([tx, rx])[:, :2])
    turn = Pose.at(0.0, 0.0, 0.0, math.degrees(yaw)).rotation
    begin, end = tx[links[:, 0]] @ turn, rx[links[:, 1]] @ turn
    low, half, index = _cells(torch.cat([begin, end]), cell_m, margin_m, height_m)
    middle = low + (2 * index + 1) * half
    crossed = torch.stack([_crosses(begin, end, c - half, c + half).any() for c in middle])
    if not bool(crossed.any()):
        raise LearnError("regions: every link has a length of 0; expected radios apart")
    nodes = []
    for (i, j, k), centre in zip(index[crossed].tolist(), middle[crossed], strict=True):
        x, y, z = (turn @ centre).tolist()
        body = Body(Box(half.tolist()), _nothing(seed))
        pose = Pose.at(x, y, z, math.degrees(yaw))
        nodes.append(Node(f"{REGIONS}/x{i}_y{j}_z{k}", body, pose))
    return Scene(tuple(nodes), _radios(f"{TRANSMITTERS}/t", tx), _radios(f"{RECEIVERS}/r", rx))


def _radios(stem: str, places: Float[Tensor, "n 3"]) -> tuple[Radio, ...]:
    return tuple(Radio.at(f"{stem}{i}", x, y, z) for i, (x, y, z) in enumerate(places.tolist()))


def _check(tx: Tensor, rx: Tensor, cell_m: float, margin_m: float, height_m: float | None) -> None:
    for name, places in (("transmitters", tx), ("receivers", rx)):
        if not len(places) or not bool(torch.isfinite(places).all()):
            raise LearnError(f"regions: {name}: expected at least one position, all finite [m]")
    if not 0 < cell_m < math.inf:
        raise LearnError(f"regions: cell_m={cell_m!r}: expected metres > 0")
    if not 0 < margin_m < math.inf:
        # radios in the outermost faces would see along them, past the regions
        raise LearnError(f"regions: margin_m={margin_m!r}: expected metres > 0")
    if height_m is not None and not 0 < height_m < math.inf:
        raise LearnError(f"regions: height_m={height_m!r}: expected None or metres > 0")


def _principal(place: Float[Tensor, "n 2"]) -> float:
    """Angle [rad] of the principal axis of places in the plane, towards their longer tail."""
    place = torch.unique(place, dim=0)
    off = place - place.mean(0)
    axis = torch.linalg.eigh(off.T @ off).eigenvectors[:, 1]
    skewed = ((off @ axis) ** 3).sum()
    axis = torch.where(skewed < 0, -axis, axis)
    return math.atan2(float(axis[1]), float(axis[0]))


def _cells(
    place: Float[Tensor, "n 3"], cell_m: float, margin_m: float, height_m: float | None
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], Int[Tensor, "c 3"]]:
    """Lowest corner, half size and whole-number places of equal cells over a bounding box."""
    low, high = place.amin(0) - margin_m, place.amax(0) + margin_m
    extent = high - low
    side = torch.tensor([cell_m, cell_m, math.inf if height_m is None else height_m])
    count = torch.ceil(extent / side.to(extent)).clamp(min=1.0)
    if float(count.prod()) > MOST_REGIONS:
        across = " x ".join(f"{float(e):.3g}" for e in extent)
        raise LearnError(
            f"regions: cell_m={cell_m:g}, height_m={height_m}: {count.prod():.0f} regions over "
            f"{across} m; expected at most {MOST_REGIONS}. Take larger cells; a likely cause is a "
            "position far from all others"
        )
    index = torch.cartesian_prod(*(torch.arange(int(c)) for c in count)).reshape(-1, 3)
    return low, 0.5 * extent / count, index


def _crosses(
    begin: Float[Tensor, "k 3"],
    end: Float[Tensor, "k 3"],
    low: Float[Tensor, "3"],
    high: Float[Tensor, "3"],
) -> Bool[Tensor, "k"]:
    """Which links run for some length in a box or in its faces (the slab method)."""
    way = end - begin
    still = way == 0
    safe = torch.where(still, 1.0, way)
    a, b = (low - begin) / safe, (high - begin) / safe
    beside = (begin < low) | (begin > high)
    enter = torch.where(still, torch.where(beside, math.inf, -math.inf), torch.minimum(a, b))
    leave = torch.where(still, torch.where(beside, -math.inf, math.inf), torch.maximum(a, b))
    long = leave.amin(1).clamp(max=1.0) - enter.amax(1).clamp(min=0.0)
    return (long > 0) & ~still.all(1)


def _nothing(seed: int) -> StochasticSurface:
    """A surface that neither reflects nor, yet, absorbs."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return StochasticSurface(
            m=0.0,
            alpha=0.0,
            sharpness=SHARPNESS,
            interaction_length=INTERACTION_LENGTH,
            bulk=EMPTY,
            # "conserving" says the same of such a boundary, in more time
            interface="paper",
        )


# the fit


@dataclass(frozen=True)
class Budget:
    """How regions are learned; tried on crop S of nerf2-ble only.

    steps, batch, learning_rate: Adam, the rate falling to 1 %. A rate moves all 129 numbers behind a
    region's kappa at once. offset_rate: step of power and gain offsets [dB] at the first step.
    receiver_gains: learn an offset of every receiver; leave out where each was read a few times only.
    losses: by what readings are compared.
    """

    steps: int = 150
    batch: int = 64
    learning_rate: float = 2e-2
    offset_rate: float = 0.2
    receiver_gains: bool = True
    losses: Losses = field(default_factory=lambda: Losses(noise_db=4.0, law="huber"))


def fit_regions(
    measurements: Measurements,
    *,
    cell_m: float = 3.0,
    margin_m: float = 0.5,
    height_m: float | None = None,
    budget: Budget | None = None,
    seed: int = 0,
    validation: float = 0.2,
    residual: bool | ResidualSettings = False,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Fitted:
    """Learn what stands between radios at known positions, where no scene is given.

    measurements: between positions; powers and gains (delays of direct paths say nothing). The sizes
    as in ``region_scene``; from ``validation`` on as in ``rfsg.fit``. The level of the readings is found
    first, in closed form: readings 20 dB below free space would else fill every region before the
    offset has moved.

    Of what comes back, ``scene`` can be looked at, simulated and written as any other; ``predict`` takes
    readings at other positions, and ``/World/Receivers/r0`` for a receiver whose offset is to count.
    Raises LearnError for readings of named radios, and as ``region_scene`` and ``rfsg.fit`` do.
    """
    tx, rx = (_positions(p) for p in (measurements.tx_places, measurements.rx_places))
    pairs = torch.unique(torch.stack([measurements.tx, measurements.rx], -1), dim=0)
    sizes = {"cell_m": cell_m, "margin_m": margin_m, "height_m": height_m}
    scene = region_scene(tx, rx, links=pairs, **sizes, seed=seed)
    named = replace(
        measurements,
        tx_places=tuple(r.path for r in scene.transmitters),
        rx_places=tuple(r.path for r in scene.receivers),
    )
    fitted = learned(
        scene,
        named,
        budget or Budget(),
        seed,
        validation=validation,
        residual=residual,
        out=out,
        resume=resume,
        overwrite=overwrite,
        progress=progress,
    )
    if out is not None:  # with the whole level, which the fit itself does not know
        write_beside(Path(out) / REPORT, to_json(fitted.report), True)
    return fitted


def _positions(places: tuple[Place, ...]) -> Float[Tensor, "n 3"]:
    names = [p for p in places if isinstance(p, str)]
    if names:
        raise LearnError(
            f"regions: radio {names[0]!r} is given by name; expected positions, for there is no scene "
            "that would know the name"
        )
    return torch.tensor(places, dtype=torch.float64).reshape(-1, 3)


def learned(
    scene: Scene,
    measured: Measurements,
    budget: Budget,
    seed: int,
    *,
    validation: float = 0.0,
    **writing: Any,
) -> Fitted:
    """Fit the regions of a scene to readings of its radios, which these name by path.

    ``writing`` goes to ``rfsg.fit`` as it is.
    """
    select = [f"{REGIONS}/*.surface.bulk"]
    level = _level_dbm(scene, measured)
    if level is not None:
        select.append("power.offset_db")
        powered = tuple(replace(r, power_dbm=level) for r in scene.transmitters)
        scene = replace(scene, transmitters=powered)
    if budget.receiver_gains:
        select.append(f"{RECEIVERS}/*.gain_db")
    fitted = fit(
        scene,
        measured,
        select=select,
        steps=budget.steps,
        batch=budget.batch,
        quality=QUALITY,
        seed=seed,
        learning_rate=budget.learning_rate,
        schedule="cosine",
        rates={name: budget.offset_rate / budget.learning_rate for name in select[1:]},
        losses=budget.losses,
        # The features under kappa are smooth already, and Eq. 25 in every region doubles the time.
        regularisation=Regularisation(laplacian=0.0, eikonal=0.0),
        validation=validation,
        **writing,
    )
    if level is None:
        return fitted
    # What sends and is no radio of the scene sends 0 dBm: its offset is the whole level.
    offsets = fitted.report["offsets"]
    whole = {**offsets, "power_db": level + offsets["power_db"]}
    return replace(fitted, report={**fitted.report, "offsets": whole})


def _level_dbm(scene: Scene, measured: Measurements) -> float | None:
    """Median of received rssi over free space (Friis): the transmit power without any object.

    None where no rssi was received.
    """
    rows = measured.received & (measured.quantity == int(Quantity.RSSI))
    if not bool(rows.any()):
        return None
    some = measured.take(rows)
    position = {r.path: r.position for r in (*scene.transmitters, *scene.receivers)}
    tx, rx = (
        torch.stack([position[str(p)] for p in places])[of]
        for places, of in ((some.tx_places, some.tx), (some.rx_places, some.rx))
    )
    apart = (tx - rx).norm(dim=-1).clamp(min=LEAST_DISTANCE)
    return float((some.value[:, 0] - friis_db(apart, some.frequency)).median())


def friis_db(distance: Float[Tensor, "n"], frequency: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Free-space path gain 20 log10(c / (4 pi d f)) [dB] between isotropic antennas (ITU-R P.525)."""
    return 20.0 * torch.log10(SPEED_OF_LIGHT / (4.0 * math.pi * distance * frequency))
