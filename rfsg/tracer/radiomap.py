"""Radio maps: power over the cells of a plane of any orientation, or of a surface.

``rays``: the Monte Carlo estimator of ``montecarlo``, every branch followed: what crosses a cell,
over its area. It follows reflection, mirror-like and diffuse, and penetration. ``paths``: the exact
path solver at a point of each cell, with all that the quality asks for. The rays' map is the mean
over a cell, the solver's a point of it, so the reported error holds both the scatter between turned
lattices and the spread of power within the cell.

Power is summed over paths without phase, as it is where phases average out over a cell.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer.cells import Grid, extent, grid_on
from rfsg.tracer.channel import power, thermal_noise_dbm
from rfsg.tracer.embree import Proxies
from rfsg.tracer.field import SPEED_OF_LIGHT
from rfsg.tracer.montecarlo import COPIES, flights
from rfsg.tracer.patches import Patches, patches_from, patches_of
from rfsg.tracer.plan import Quality, make_plan
from rfsg.tracer.simulate import positions, resolve_frequency, simulate, world_for

RECEIVERS_AT_ONCE = 4096  # of a map by paths: memory stays bounded, and the answer the same


@dataclass(frozen=True)
class RadioMap:
    """Power over cells, by transmitter in scene order; ``*c`` is [ny nx] on a plane, [c] on a surface.

    path_gain: linear, from the transmitter's antenna to an isotropic one, 0 where nothing arrives.
    error_db: one standard deviation [dB], inf where nothing arrives, 0 for the path solver.
    """

    scene: Scene
    frequency: float
    cells: Grid | Patches
    path_gain: Float[Tensor, "t *c"]
    error_db: Float[Tensor, "t *c"]
    method: str
    modelled: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def path_loss_db(self) -> Float[Tensor, "t *c"]:
        """-10 log10 of the path gain, the transmitter's pattern included; inf where nothing arrives."""
        return -10.0 * torch.log10(self.path_gain.cpu())

    def rss_dbm(self) -> Float[Tensor, "t *c"]:
        """Received signal strength of each transmitter [dBm]; -inf where nothing arrives."""
        sent = torch.tensor([r.power_dbm for r in self.scene.transmitters], dtype=torch.float64)
        return sent.reshape(-1, *[1] * len(self.cells.shape)) - self.path_loss_db()

    def best_dbm(self) -> Float[Tensor, "*c"]:
        """Strongest transmitter's signal in each cell [dBm]; -inf where there is none."""
        silence = torch.full((1, *self.cells.shape), -torch.inf, dtype=torch.float64)
        return torch.cat([silence, self.rss_dbm()]).amax(0)

    def best_server(self) -> Int[Tensor, "*c"]:
        """Number of the strongest transmitter in each cell, the first of equals; -1 for none."""
        if not len(self.path_gain):
            return torch.full(self.cells.shape, -1, dtype=torch.int64)
        best = self.rss_dbm().argmax(0)
        return torch.where(self.best_dbm() > -torch.inf, best, torch.full_like(best, -1))

    def snr_db(
        self, bandwidth_hz: float, noise_figure_db: float = 0.0, temperature_k: float = 290.0
    ) -> Float[Tensor, "t *c"]:
        """Signal of each transmitter over thermal noise k T B F [dB]. ValueError as for the noise."""
        return self.rss_dbm() - thermal_noise_dbm(bandwidth_hz, noise_figure_db, temperature_k)

    def sinr_db(
        self, bandwidth_hz: float, noise_figure_db: float = 0.0, temperature_k: float = 290.0
    ) -> Float[Tensor, "t *c"]:
        """Signal of each transmitter over noise and all other transmitters together [dB].

        All transmit in the one band, all the time. ValueError as for the noise.
        """
        noise = 10.0 ** (
            thermal_noise_dbm(bandwidth_hz, noise_figure_db, temperature_k) / 10.0
        )  # [mW]
        signal = 10.0 ** (self.rss_dbm() / 10.0)
        # summed without the own signal, not subtracted: a strong one would take the others' digits
        others = 1.0 - torch.eye(len(signal), dtype=torch.float64)
        return 10.0 * torch.log10(signal / (noise + torch.tensordot(others, signal, dims=1)))

    def coverage(self, threshold_dbm: float) -> float:
        """Share of the area in which the best server reaches a signal strength [dBm]."""
        area = self.cells.area.cpu().reshape(self.cells.shape)
        return float(area[self.best_dbm() >= threshold_dbm].sum() / area.sum())


@torch.no_grad()
def radio_map(
    scene: Scene,
    frequency: float | None = None,
    *,
    height: float = 1.2,
    cell: float = 0.5,
    bounds: tuple[float, float, float, float] | None = None,
    plane: Pose | None = None,
    quality: str | Quality = "standard",
    method: str = "rays",
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> RadioMap:
    """Path gain of every transmitter over square cells of side ``cell`` [m] on a plane.

    plane: a pose whose x and y axes span it (``cells.plane_through``); None is level, at ``height``
    [m]. bounds: (x0, y0, x1, y1) [m] in the plane's frame, for a level one the world's; None takes
    the extent of objects and radios. Raises SceneError for a map of no or of too many cells, and for
    an unknown method.
    """
    question = _question(scene, frequency, quality, method, seed, device)
    plane = Pose.at(0.0, 0.0, height) if plane is None else plane
    bounds = bounds or extent(scene, _corners(question.world), plane)
    return question.answer(grid_on(plane, bounds, cell))


@torch.no_grad()
def radio_map_on(
    scene: Scene,
    where: str | tuple[Any, Any],
    frequency: float | None = None,
    *,
    cell: float = 0.25,
    offset: float = 0.01,
    quality: str | Quality = "standard",
    method: str = "paths",
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> RadioMap:
    """Path gain over the outside of a surface, in triangles no longer than ``cell`` [m].

    where: the prim path of an object, or a mesh (vertices [v 3] m in the world, faces [k 3]), which
    waves do not see. offset: how far before the surface the field is taken [m], as an antenna
    mounted there would; what the surface itself reflects is part of it. Raises SceneError for an
    object that is not there or has no bounded surface, and for a mesh that is not one.
    """
    question = _question(scene, frequency, quality, method, seed, device)
    if isinstance(where, str):
        return question.answer(patches_of(question.world, where, cell, offset))
    return question.answer(patches_from(*where, cell, offset))


@dataclass(frozen=True)
class _Question:
    """What every map is asked with."""

    world: World
    frequency: Float[Tensor, "1"]
    quality: Quality
    method: str
    seed: int

    def answer(self, cells: Grid | Patches) -> RadioMap:
        make = _by_rays if self.method == "rays" else _by_paths
        return make(self, cells)


def _question(
    scene: Scene,
    frequency: float | None,
    quality: str | Quality,
    method: str,
    seed: int,
    device: torch.device | str,
) -> _Question:
    if method not in ("rays", "paths"):
        raise SceneError([f"map method {method!r}: expected 'rays' or 'paths'"])
    quality = Quality.named(quality) if isinstance(quality, str) else quality
    f = resolve_frequency(scene, frequency)[:1].to(device)
    return _Question(world_for(scene, quality, device), f, quality, method, seed)


def _corners(world: World) -> Float[Tensor, "k 3"]:
    """Corners of all bounded objects [m]."""
    bounded = torch.isfinite(world.bounds_object).all(-1).all(-1)
    return Proxies(world).corners(torch.nonzero(bounded).squeeze(-1)).reshape(-1, 3)


def _by_paths(question: _Question, cells: Grid | Patches) -> RadioMap:
    scene, world = question.world.scene, question.world
    eye, still = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    gains, warnings = [], {}
    modelled, left_out = {}, {}  # dictionaries as ordered sets
    for places in cells.point.split(RECEIVERS_AT_ONCE):
        some = [Radio(f"cell{k}", p, eye, still) for k, p in enumerate(places)]
        result = simulate(
            scene.with_receivers(some), question.frequency, question.quality, device=world.device
        )
        gains.append(power(result.channel, len(scene.transmitters), len(some))[..., 0])
        warnings |= dict.fromkeys(result.warnings)
        modelled |= dict.fromkeys(result.plan.modelled)
        left_out |= dict.fromkeys(result.plan.left_out)
    gain = torch.cat(gains, -1).reshape(-1, *cells.shape)
    return RadioMap(
        scene,
        float(question.frequency[0]),
        cells,
        gain,
        torch.zeros_like(gain),
        "paths",
        tuple(modelled),
        tuple(left_out),
        tuple(warnings),
    )


def _by_rays(question: _Question, cells: Grid | Patches) -> RadioMap:
    world, quality, f = question.world, question.quality, question.frequency
    scene, proxies = world.scene, Proxies(world)
    tx = positions(scene.transmitters, world.device)
    owner, area = cells.owner.to(world.device), cells.subarea.to(world.device)
    aperture = float((SPEED_OF_LIGHT / f) ** 2) / (4 * math.pi)
    gain = torch.zeros(len(tx), math.prod(cells.shape), dtype=torch.float64, device=f.device)
    error = torch.full_like(gain, torch.inf)
    for t, radio in enumerate(scene.transmitters):
        total = torch.zeros(COPIES, len(area), dtype=torch.float64, device=world.device)
        for copy, flight in flights(
            world, proxies, radio, tx[t], f, quality, "enumerate", question.seed
        ):
            met = cells.meet(flight.rays)
            share = flight.power_at(met.ray, met.distance) / met.cosine
            total[copy].index_add_(0, met.subcell, share)
        gain[t], error[t] = _summary(total * aperture / area, area, owner, gain.shape[1])
    return RadioMap(
        scene,
        float(f[0]),
        cells,
        gain.reshape(-1, *cells.shape),
        error.reshape(-1, *cells.shape),
        "rays",
        _by_rays_in_words(quality),
        (*make_plan(world, quality).left_out, _NOT_BY_RAYS),
        scene.warnings,
    )


_NOT_BY_RAYS = (
    "diffraction, bending inside solids and polarisation: rays of a map go straight on or are sent "
    "back by surfaces; a map by paths follows what the quality asks for"
)


def _by_rays_in_words(quality: Quality) -> tuple[str, ...]:
    scattered = ", diffuse once" if quality.diffuse else ""
    return (
        f"{quality.map_rays} rays from each transmitter with {quality.depth} reflections at most"
        f"{scattered}, and what they go through",
    )


def _summary(
    density: Float[Tensor, "n s"], area: Float[Tensor, "s"], owner: Int[Tensor, "s"], count: int
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """Mean gain of cells, and one standard deviation in dB of scatter and spread together."""
    zero = torch.zeros(count, dtype=area.dtype, device=area.device)
    share = area / zero.index_add(0, owner, area)[owner]

    def over_cells(value: Float[Tensor, "s"]) -> Float[Tensor, "c"]:
        return zero.index_add(0, owner, share * value)

    mean = over_cells(density.mean(0))
    scatter = torch.stack([over_cells(copy) for copy in density]).std(0) / COPIES**0.5
    # the spread between sub-cells, less what their own scatter already explains
    noise = density.var(0) / COPIES
    spread = over_cells((density.mean(0) - mean[owner]) ** 2 - noise).clamp(min=0.0)
    deviation = torch.sqrt(scatter**2 + spread)
    safe = torch.where(mean > 0, mean, torch.ones_like(mean))
    error = 10.0 * torch.log10(1.0 + deviation / safe)
    return mean, torch.where(mean > 0, error, torch.full_like(error, torch.inf))
