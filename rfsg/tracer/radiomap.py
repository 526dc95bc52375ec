"""Radio maps: power over the cells of a horizontal plane.

``rays`` (default): the Monte Carlo estimator of ``montecarlo``, every branch followed: what crosses a
cell, over its area. ``paths``: the exact path solver at the cell centres. The rays' map is the mean
over a cell, the solver's a point of it, so the reported error holds both the scatter between turned
lattices and the spread of power within the cell.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer.channel import power
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.montecarlo import COPIES, Flight, flights
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import positions, resolve_frequency, simulate, world_for

SUB = 4  # sub-cells per side, from which the spread within a cell is read
MOST_CELLS = (
    4_000_000  # a map larger than this is a mistyped cell size: refuse before taking memory
)


@dataclass(frozen=True)
class RadioMap:
    """Power over a plane. x, y: cell centres [m]; path_gain: linear, incoherent, strongest first by
    transmitter; 0 where nothing arrives. error_db: one standard deviation [dB], inf where nothing
    arrives, 0 for the path solver."""

    scene: Scene
    frequency: float
    height: float
    cell: float
    x: Float[Tensor, "nx"]
    y: Float[Tensor, "ny"]
    path_gain: Float[Tensor, "t ny nx"]
    error_db: Float[Tensor, "t ny nx"]
    method: str

    def rss_dbm(self) -> Float[Tensor, "t ny nx"]:
        """Received signal strength per transmitter [dBm]; -inf where nothing arrives."""
        sent = [r.power_dbm for r in self.scene.transmitters]
        level = torch.tensor(sent, dtype=torch.float64).reshape(-1, 1, 1)
        return level + 10.0 * torch.log10(self.path_gain.cpu())

    def best_dbm(self) -> Float[Tensor, "ny nx"]:
        """Strongest transmitter's signal in each cell [dBm]."""
        return self.rss_dbm().amax(0)


@torch.no_grad()
def radio_map(
    scene: Scene,
    frequency: float | None = None,
    *,
    height: float = 1.2,
    cell: float = 0.5,
    bounds: tuple[float, float, float, float] | None = None,
    quality: str | Quality = "standard",
    method: str = "rays",
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> RadioMap:
    """Path gain of every transmitter over cells of ``cell`` [m] at ``height`` [m].

    bounds: (x0, y0, x1, y1) [m]; None takes the objects' and radios' extent. Raises SceneError for
    a map of no or of too many cells, and for an unknown method.
    """
    if method not in ("rays", "paths"):
        raise SceneError([f"map method {method!r}: expected 'rays' or 'paths'"])
    quality = Quality.named(quality) if isinstance(quality, str) else quality
    f = resolve_frequency(scene, frequency)[:1].to(device)
    world = world_for(scene, quality, device)
    x0, y0, x1, y1 = bounds or _extent(world)
    nx, ny = (max(1, math.ceil(s / cell - 1e-9)) for s in (x1 - x0, y1 - y0))
    if not (cell > 0 and x1 > x0 and y1 > y0) or nx * ny > MOST_CELLS:
        raise SceneError(
            [
                f"map: {nx} x {ny} cells of {cell} m over {(x0, y0, x1, y1)}: expected 1 to {MOST_CELLS}"
            ]
        )
    x = x0 + cell * (torch.arange(nx, dtype=torch.float64) + 0.5)
    y = y0 + cell * (torch.arange(ny, dtype=torch.float64) + 0.5)
    make = _by_rays if method == "rays" else _by_paths
    gain, error = make(scene, world, f, quality, height, cell, x, y, seed)
    return RadioMap(scene, float(f[0]), height, cell, x, y, gain, error, method)


def _extent(world: World) -> tuple[float, float, float, float]:
    bounded = torch.isfinite(world.bounds_object).all(-1).all(-1)
    which = torch.nonzero(bounded).squeeze(-1)
    points = [Proxies(world).corners(which).reshape(-1, 3)]
    radios = (*world.scene.transmitters, *world.scene.receivers)
    points.append(positions(radios, world.device))
    every = torch.cat(points)
    if not len(every):
        raise SceneError(
            ["map: the scene is empty, so it has no extent; give bounds=(x0, y0, x1, y1)"]
        )
    low, high = every.amin(0), every.amax(0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _by_paths(
    scene: Scene,
    world: World,
    f: Tensor,
    quality: Quality,
    height: float,
    cell: float,
    x: Tensor,
    y: Tensor,
    seed: int,
) -> tuple[Tensor, Tensor]:
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    gy, gx = torch.meshgrid(y, x, indexing="ij")
    place = torch.stack([gx, gy, torch.full_like(gx, height)], -1).reshape(-1, 3)
    cells = [Radio(f"cell{k}", p, eye, zero) for k, p in enumerate(place)]
    result = simulate(scene.with_receivers(cells), f, quality, device=world.device)
    gain = power(result.channel, len(scene.transmitters), len(cells))[..., 0]
    gain = gain.reshape(-1, len(y), len(x))
    return gain, torch.zeros_like(gain)


def _by_rays(
    scene: Scene,
    world: World,
    f: Tensor,
    quality: Quality,
    height: float,
    cell: float,
    x: Tensor,
    y: Tensor,
    seed: int,
) -> tuple[Tensor, Tensor]:
    proxies = Proxies(world)
    tx = positions(scene.transmitters, world.device)
    fine = cell / SUB
    corner = (float(x[0]) - 0.5 * cell, float(y[0]) - 0.5 * cell)
    shape = (len(y) * SUB, len(x) * SUB)
    aperture = float((SPEED_OF_LIGHT / f) ** 2) / (4 * math.pi) / fine**2
    gains, errors = [], []
    for t, radio in enumerate(scene.transmitters):
        grid = torch.zeros(COPIES, shape[0] * shape[1], dtype=torch.float64, device=world.device)
        for copy, flight in flights(world, proxies, radio, tx[t], f, quality, "enumerate", seed):
            index, share = _deposit(flight, height, corner, fine, shape)
            grid[copy].index_add_(0, index, share)
        sub = (grid * aperture).reshape(COPIES, len(y), SUB, len(x), SUB).transpose(2, 3)
        sub = sub.reshape(COPIES, len(y), len(x), SUB * SUB)
        gain, error = _summary(sub)
        gains.append(gain)
        errors.append(error)
    blank = torch.zeros(0, len(y), len(x), dtype=torch.float64, device=world.device)
    return (torch.stack(gains), torch.stack(errors)) if gains else (blank, blank)


def _deposit(
    flight: Flight, height: float, corner: tuple[float, float], fine: float, shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """(flat sub-cell, power over |cos|) of rays that cross the plane."""
    o, d = flight.rays.origin, flight.rays.direction
    slope = d[:, 2]
    flat = slope.abs() < GRAZING
    t = (height - o[:, 2]) / torch.where(flat, torch.ones_like(slope), slope)
    ray = torch.nonzero(~flat & (t > 0)).squeeze(-1)
    place = o[ray] + t[ray, None] * d[ray]
    column = torch.floor((place[:, 0] - corner[0]) / fine)
    row = torch.floor((place[:, 1] - corner[1]) / fine)
    hit = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    ray, row, column = ray[hit], row[hit].long(), column[hit].long()
    return row * shape[1] + column, flight.power_at(ray, t[ray]) / slope[ray].abs()


GRAZING = 1e-3  # rays flatter than a milliradian cross a map's plane where it no longer matters


def _summary(sub: Float[Tensor, "n y x s"]) -> tuple[Tensor, Tensor]:
    """Mean gain of cells, and one standard deviation in dB of scatter and spread together."""
    mean = sub.mean((0, 3))
    scatter = sub.mean(3).std(0) / COPIES**0.5
    # the spread between sub-cells, less what their own scatter already explains
    noise = (sub.var(0) / COPIES).mean(-1)
    spread = torch.clamp(sub.mean(0).var(-1) - noise, min=0.0)
    deviation = torch.sqrt(scatter**2 + spread)
    safe = torch.where(mean > 0, mean, torch.ones_like(mean))
    error = 10.0 * torch.log10(1.0 + deviation / safe)
    return mean, torch.where(mean > 0, error, torch.full_like(error, torch.inf))
