"""Radio maps: power over the cells of a plane of any orientation, or of a surface.

``rays``: the Monte Carlo estimator of ``montecarlo``, every branch followed: what crosses a cell,
over its area. It follows reflection, mirror-like and diffuse, and penetration. ``paths``: the exact
path solver at a point of each cell, with all that the quality asks for. ``images``: the same mirrors
and penetration, as exactly, for scenes of boxes and half-spaces, many times faster. The rays' map is
the mean over a cell, the others' a point of it, so the rays' reported error holds both the scatter
between turned lattices and the spread of power within the cell.

A map by rays refines while one watches: it is a mean over rounds, each a turned lattice, and may stop
when its time is up or its error small enough.

Power is summed over paths without phase, as it is where phases average out over a cell.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.objects.displayed import Displayed
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer import validity
from rfsg.tracer.cells import Grid, extent, grid_on
from rfsg.tracer.channel import power, thermal_noise_dbm
from rfsg.tracer.embree import Proxies
from rfsg.tracer.imagemap import power_by_images
from rfsg.tracer.labelled import map_dataset
from rfsg.tracer.montecarlo import COPIES, per_round
from rfsg.tracer.patches import Patches, patches_from, patches_of
from rfsg.tracer.plan import Quality, make_plan
from rfsg.tracer.rounds import Rounds, median_db
from rfsg.tracer.simulate import positions, resolve_frequency, simulate, world_for

RECEIVERS_AT_ONCE = 4096  # of a map by paths: memory stays bounded, and the answer the same
LEAST_ROUNDS = 2  # fewer have no scatter, so no error
MOST_ROUNDS = 4096  # an error that so many do not reach is out of reach
METHODS = ("rays", "paths", "images")


@dataclass(frozen=True)
class RadioMap(Displayed):
    """Power over cells, by transmitter in scene order; ``*c`` is [ny nx] on a plane, [c] on a surface.

    path_gain: linear, from the transmitter's antenna to an isotropic one, 0 where nothing arrives.
    error_db: one standard deviation [dB], inf where nothing arrives, 0 for paths and images.
    scatter_db: for rays the part of it that more rays bring down, the standard error of the cells'
    means; None for the others, which have none.
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
    scatter_db: Float[Tensor, "t *c"] | None = None

    def __repr__(self) -> str:
        cells = " x ".join(map(str, self.cells.shape))
        return (
            f"radio map of {len(self.path_gain)} transmitters over {cells} cells "
            f"at {self.frequency / 1e9:g} GHz, by {self.method}"
        )

    def to_xarray(self) -> Any:
        """An xarray.Dataset over transmitters and cells; see ``labelled.map_dataset``."""
        return map_dataset(self)

    def to_pandas(self) -> Any:
        """A pandas.DataFrame, one row per transmitter and cell: the same quantities."""
        return map_dataset(self).to_dataframe()

    def to_usd(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the best server's signal as a coloured mesh, in a layer over the scene's source; see
        ``rfsg.scene.usd.results.write_map``."""
        from rfsg.scene.usd.results import write_map
        from rfsg.tracer.drawing import map_faces

        drawn = map_faces(self)
        rss_dbm = self.best_dbm().reshape(-1).numpy()[drawn.cell]
        return write_map(self.scene, path, drawn.vertices, drawn.faces, rss_dbm, overwrite)

    def current_error_db(self) -> float:
        """Median standard error over the cells that hear something [dB]; 0 where nothing scatters."""
        return 0.0 if self.scatter_db is None else median_db([self.scatter_db])

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
    budget_s: float | None = None,
    error_db: float | None = None,
    progress: Callable[[RadioMap], None] | None = None,
) -> RadioMap:
    """Path gain of every transmitter over square cells of side ``cell`` [m] on a plane.

    plane: a pose whose x and y axes span it (``cells.plane_through``); None is level, at ``height``
    [m]. bounds: (x0, y0, x1, y1) [m] in the plane's frame, for a level one the world's; None takes
    the extent of objects and radios.

    method: "rays", "paths" or "images". Of rays: budget_s [s] stops after the last round that fits;
    error_db [dB] stops when the median standard error over the cells that hear something is below
    it (``RadioMap.current_error_db``), after 8 rounds at least; without either 8 rounds share the
    quality's ``map_rays``. progress: called with the map so far after every round. A rule that looks
    at the error stops a little too early in the mean: the bias is of the order of the error squared.

    Raises SceneError for a map of no or of too many cells, for an unknown method, a budget for an
    exact method, and for scenes of more than boxes and half-spaces by images.
    """
    until = _Until(budget_s, error_db, progress)
    question = _question(scene, frequency, quality, method, seed, device, until)
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
    budget_s: float | None = None,
    error_db: float | None = None,
    progress: Callable[[RadioMap], None] | None = None,
) -> RadioMap:
    """Path gain over the outside of a surface, in triangles no longer than ``cell`` [m].

    where: the prim path of an object, or a mesh (vertices [v 3] m in the world, faces [k 3]), which
    waves do not see. offset: how far before the surface the field is taken [m], as an antenna
    mounted there would; what the surface itself reflects is part of it. Raises SceneError for an
    object that is not there or has no bounded surface, and for a mesh that is not one.
    """
    until = _Until(budget_s, error_db, progress)
    question = _question(scene, frequency, quality, method, seed, device, until)
    if isinstance(where, str):
        return question.answer(patches_of(question.world, where, cell, offset))
    return question.answer(patches_from(*where, cell, offset))


@dataclass(frozen=True)
class _Until:
    """When to stop, and whom to tell meanwhile."""

    budget_s: float | None
    error_db: float | None
    progress: Callable[[RadioMap], None] | None

    def check(self, method: str) -> None:
        for name, value in (("budget_s", self.budget_s), ("error_db", self.error_db)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise SceneError([f"map: {name} is {value!r}; expected a finite number above 0"])
        if self.budget_s is not None and method != "rays":
            raise SceneError(
                [f"map: budget_s goes with method 'rays', which refines; {method!r} is exact"]
            )

    def at_least(self, rounds: Rounds) -> int:
        """Rounds to add before looking: one where time counts or somebody watches."""
        watched = self.budget_s is not None or self.progress is not None
        return 1 if watched else max(1, COPIES - rounds.count)

    def enough(self, rounds: Rounds, left_s: float, longest_s: float) -> bool:
        """Whether to stop, with so much time left, after rounds that took as long as ``longest_s``."""
        if left_s < longest_s or rounds.count >= MOST_ROUNDS:
            return True
        if rounds.count < COPIES:  # fewer say too little of how they scatter
            return False
        if self.error_db is None:
            return self.budget_s is None
        return rounds.error_db() <= self.error_db

    def short_of(self, rounds: Rounds) -> tuple[str, ...]:
        """A sentence if the error asked for is not reached."""
        if self.error_db is None or rounds.error_db() <= self.error_db:
            return ()
        return (
            f"map: after {rounds.count} rounds the median standard error is {rounds.error_db():.3g} "
            f"dB, not the {self.error_db:g} dB asked for",
        )


@dataclass(frozen=True)
class _Question:
    """What every map is asked with."""

    world: World
    frequency: Float[Tensor, "1"]
    quality: Quality
    method: str
    seed: int
    until: _Until
    warnings: tuple[str, ...]

    def answer(self, cells: Grid | Patches) -> RadioMap:
        if self.method == "rays":
            return _by_rays(self, cells)
        found = _by_paths(self, cells) if self.method == "paths" else _by_images(self, cells)
        if self.until.progress is not None:
            self.until.progress(found)
        return found


def _question(
    scene: Scene,
    frequency: float | None,
    quality: str | Quality,
    method: str,
    seed: int,
    device: torch.device | str,
    until: _Until,
) -> _Question:
    if method not in METHODS:
        raise SceneError([f"map method {method!r}: expected one of {', '.join(METHODS)}"])
    until.check(method)
    quality = Quality.named(quality) if isinstance(quality, str) else quality
    f = resolve_frequency(scene, frequency)[:1].to(device)
    world = world_for(scene, quality, device)
    validity.refuse(world, f)
    warnings = (*scene.warnings, *validity.sentences(world, f))
    return _Question(world, f, quality, method, seed, until, warnings)


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


def _by_images(question: _Question, cells: Grid | Patches) -> RadioMap:
    world, quality = question.world, question.quality
    scene = world.scene
    tx = positions(scene.transmitters, world.device)
    gain = power_by_images(
        world,
        scene.transmitters,
        tx,
        cells.rows.to(world.device),
        cells.point.to(world.device),
        question.frequency,
        quality,
    )
    plan = make_plan(world, quality)
    gain = gain.reshape(-1, *cells.shape)
    round_edges = ("edge diffraction: a map by images knows mirrors alone",)
    return RadioMap(
        scene,
        float(question.frequency[0]),
        cells,
        gain,
        torch.zeros_like(gain),
        "images",
        plan.modelled,
        (*plan.left_out, *round_edges[: quality.diffraction]),
        question.warnings,
    )


def _by_rays(question: _Question, cells: Grid | Patches) -> RadioMap:
    """Rounds of turned lattices until the budget is spent or the error small enough."""
    rounds = Rounds(question.world, question.frequency, question.quality, question.seed, cells)
    until, begun, longest = question.until, time.monotonic(), 0.0
    while True:
        before = time.monotonic()
        rounds.add(until.at_least(rounds))
        now = time.monotonic()
        longest = max(longest, now - before)
        if rounds.count < LEAST_ROUNDS:
            continue
        left = math.inf if until.budget_s is None else begun + until.budget_s - now
        done = until.enough(rounds, left, longest)
        if until.progress is not None or done:
            found = _map_of(question, cells, rounds)
            if until.progress is not None:
                until.progress(found)
            if done:
                return found


def _map_of(question: _Question, cells: Grid | Patches, rounds: Rounds) -> RadioMap:
    scene, quality = question.world.scene, question.quality
    gain, error, scatter = (x.reshape(-1, *cells.shape) for x in rounds.summary())
    return RadioMap(
        scene,
        float(question.frequency[0]),
        cells,
        gain,
        error,
        "rays",
        _by_rays_in_words(quality, rounds.count),
        (*make_plan(question.world, quality).left_out, _NOT_BY_RAYS),
        (*question.warnings, *question.until.short_of(rounds)),
        scatter,
    )


_NOT_BY_RAYS = (
    "diffraction, bending inside solids and polarisation: rays of a map go straight on or are sent "
    "back by surfaces; a map by paths follows what the quality asks for"
)


def _by_rays_in_words(quality: Quality, rounds: int) -> tuple[str, ...]:
    scattered = ", diffuse once" if quality.diffuse else ""
    return (
        f"{rounds * per_round(quality)} rays from each transmitter, in {rounds} turned lattices, with "
        f"{quality.depth} reflections at most{scattered}, and what they go through",
    )
