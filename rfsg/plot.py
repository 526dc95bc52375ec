"""Pictures: a scene with its paths, power-delay profiles, radio maps, measured against predicted.

Figures are made without a window system and without global state; ``save`` writes them. Objects are
drawn from their own implicit functions, so that a learned object looks as the tracer sees it.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from scipy.spatial import ConvexHull

from rfsg.objects.plain import array
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.cells import Grid
from rfsg.tracer.patches import Patches
from rfsg.tracer.radiomap import RadioMap

MOST_PATHS = 300  # more lines than this only blacken a picture; the strongest are drawn
DYNAMIC_RANGE_DB = 45.0  # below the strongest path; weaker ones are not drawn
MOST_NAMES = 12  # more labels than this cover what they name
SLICES = 7  # horizontal cuts that show a curved or learned object in 3-D
CUT = 240  # samples each way where a plane cuts an object
GRID = (56, 56, 28)  # samples of an implicit function across an object's bounds

_EDGE = "#2f3b4a"
_WALL = "#e6e9ee"
_THING = "#c3ccd8"
_TX = "#c0392b"
_RX = "#1f6fb2"
_PATHS = "plasma_r"
_MAP = "viridis"
_ERROR = "RdBu_r"
_NOTHING = "#d8d8d8"
_BOX_EDGES = [(i, i + step) for step in (1, 2, 4) for i in range(8) if not i & step]


def save(figure: Figure, file: str | Path, dpi: int = 130) -> Path:
    """Write a figure beside its place and rename it there; returns the place."""
    file = Path(file)
    beside = file.with_name(f".{file.stem}-partial{file.suffix}")
    figure.savefig(beside, dpi=dpi, facecolor="white")
    os.replace(beside, file)
    return file


def scene_figure(scene: Scene, paths: Any = None, channel: Any = None, title: str = "") -> Figure:
    """The scene from above and in space; with paths and channel, its paths coloured by gain."""
    figure = Figure(figsize=(14.0, 6.2), layout="constrained")
    top = figure.add_subplot(1, 2, 1)
    space = figure.add_subplot(1, 2, 2, projection="3d")
    draw_top(top, scene)
    _draw_space(space, scene)
    if paths is not None and channel is not None:
        lines, gain_db = path_lines(paths, channel)
        if lines:
            scale = ScalarMappable(Normalize(gain_db.min(), gain_db.max()), _PATHS)
            strength = np.asarray(scale.norm(gain_db))
            look: dict[str, Any] = {"array": gain_db, "cmap": _PATHS}
            look |= {"linewidths": 0.3 + 1.2 * strength**2, "alpha": 0.15 + 0.8 * strength}
            flat = LineCollection([line[:, :2] for line in lines], zorder=3, **look)
            top.add_collection(flat)
            space.add_collection3d(Line3DCollection(lines, **look))
            bar = figure.colorbar(scale, ax=[top, space], shrink=0.75, pad=0.02)
            bar.set_label(f"path gain [dB], the {len(lines)} strongest")
    _radios(top, scene)
    figure.suptitle(title or f"{_plural(len(scene.nodes), 'object')}")
    return figure


def path_lines(paths: Any, channel: Any) -> tuple[list[np.ndarray], np.ndarray]:
    """Polylines [m] of the arriving paths that a picture can carry, and their gains [dB].

    Weakest first, so that the strongest lie on top.
    """
    power = array(channel.gain)[:, 0]
    power = np.abs(power) ** 2 * ~array(channel.blocked)
    if not (power > 0).any():
        return [], np.zeros(0)
    floor = power.max() * 10 ** (-DYNAMIC_RANGE_DB / 10)
    chosen = [p for p in np.argsort(power)[-MOST_PATHS:] if power[p] > floor]
    vertices, corners = array(paths.vertices), (array(paths.which) >= 0).sum(axis=1) + 2
    return [vertices[p, : corners[p]] for p in chosen], 10 * np.log10(power[chosen])


def delay_figure(scene: Scene, channel: Any, links: Sequence[tuple[int, int]]) -> Figure:
    """Power-delay profiles: one panel per link (transmitter index, receiver index)."""
    rows = max(1, len(links))
    figure = Figure(figsize=(8.0, 1.2 + 1.9 * rows), layout="constrained")
    panels = figure.subplots(rows, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    power, delay = np.abs(array(channel.gain)[:, 0]) ** 2, 1e9 * array(channel.delay)
    heard = (power > 0) & ~array(channel.blocked)
    peak = 10 * np.log10(power[heard].max()) if heard.any() else 0.0
    for panel, (tx, rx) in zip(panels, links, strict=False):
        mine = heard & (array(channel.tx) == tx) & (array(channel.rx) == rx)
        level = 10 * np.log10(power[mine])
        seen = level > peak - 2 * DYNAMIC_RANGE_DB
        bottom = peak - 2 * DYNAMIC_RANGE_DB
        if seen.any():
            bottom = min(level[seen].min() - 5.0, peak - 30.0)
        panel.vlines(delay[mine][seen], bottom, level[seen], color=_RX, linewidth=1.2)
        panel.plot(delay[mine][seen], level[seen], "o", color=_RX, markersize=3.5)
        names = f"{_name(scene.transmitters[tx].path)} to {_name(scene.receivers[rx].path)}"
        panel.set_title(f"{names}: {_plural(int(mine.sum()), 'path')}", fontsize=9, loc="left")
        panel.set_ylabel("path gain [dB]")
        panel.grid(alpha=0.3)
    panels[-1].set_xlabel("delay [ns]")
    return figure


def map_figure(
    radio_map: RadioMap,
    scene: Scene,
    transmitter: int | None = None,
    metric: str = "rss",
    bandwidth_hz: float = 20e6,
    noise_figure_db: float = 0.0,
    title: str = "",
) -> Figure:
    """A map as a picture: on a plane with the objects that stand in it, on a surface in space.

    transmitter: its index; None shows the best in each cell. metric: "rss", "path-loss", "sinr"
    (over noise in ``bandwidth_hz``) or "best-server". Grey where nothing arrives. Raises ValueError
    for another metric.
    """
    value, label = metric_values(radio_map, transmitter, metric, bandwidth_hz, noise_figure_db)
    look = _map_look(value, len(scene.transmitters) if metric == "best-server" else None)
    cells = radio_map.cells
    if isinstance(cells, Patches):
        figure, axes = _surface_figure(cells, value, look)
        place = f"on {cells.name}"
    else:
        figure, axes = _plane_figure(cells, scene, value, look)
        place = f"at z = {float(cells.plane.translation[2]):g} m" if _is_level(cells.plane) else ""
    bar = figure.colorbar(ScalarMappable(look["norm"], look["cmap"]), ax=axes, shrink=0.85)
    if metric == "best-server":
        names = [_name(radio.path) for radio in scene.transmitters]
        bar.set_ticks(range(len(names)), labels=names)
    bar.set_label(label)
    axes.set_title(title or place, loc="right", fontsize=11)
    return figure


def metric_values(
    radio_map: RadioMap,
    transmitter: int | None,
    metric: str,
    bandwidth_hz: float,
    noise_figure_db: float,
) -> tuple[np.ma.MaskedArray, str]:
    """Values per cell of one transmitter, or of the best (None), masked where there are none; label.

    Raises ValueError for an unknown metric.
    """
    if metric == "best-server":
        best = array(radio_map.best_server())
        return np.ma.masked_less(best, 0), "best server"
    if metric == "rss":
        every, label = radio_map.rss_dbm(), "received signal strength [dBm]"
    elif metric == "path-loss":
        every, label = -radio_map.path_loss_db(), "path loss [dB]"  # the best has the least
    elif metric == "sinr":
        every, label = radio_map.sinr_db(bandwidth_hz, noise_figure_db), "SINR [dB]"
    else:
        raise ValueError(f"metric {metric!r}: expected rss, path-loss, sinr or best-server")
    silence = np.full((1, *radio_map.cells.shape), -np.inf)
    shown = array(every) if transmitter is None else array(every)[[transmitter]]
    value = np.ma.masked_invalid(np.concatenate([silence, shown]).max(axis=0))
    return (-value if metric == "path-loss" else value), label


def _map_look(value: np.ma.MaskedArray, servers: int | None) -> dict[str, Any]:
    """Colours and their range: the bulk of the values, or one colour for each server."""
    if servers is not None:
        count = max(1, servers)
        colours = colormaps["tab20"].resampled(min(20, count)) if count > 10 else colormaps["tab10"]
        cmap = ListedColormap([colours(i % colours.N) for i in range(count)])
        return {"cmap": cmap, "norm": Normalize(-0.5, count - 0.5)}
    known = value.compressed()
    low, high = np.percentile(known, (1, 99.5)) if known.size else (0.0, 1.0)
    return {"cmap": colormaps[_MAP], "norm": Normalize(low, high)}


def _plane_figure(
    cells: Grid, scene: Scene, value: np.ma.MaskedArray, look: dict[str, Any]
) -> tuple[Figure, Axes]:
    x, y = _edges(array(cells.x), cells.cell), _edges(array(cells.y), cells.cell)
    tall = min(1.4, np.ptp(y) / np.ptp(x))
    figure = Figure(figsize=(8.5, 1.6 + 7.0 * tall), layout="constrained")
    axes = figure.add_subplot()
    axes.pcolormesh(x, y, value, **look)
    axes.set_facecolor(_NOTHING)
    level = _is_level(cells.plane)
    for node in scene.nodes:
        for ring in footprint(node) if level else cut(node, cells.plane, _ends(x), _ends(y)):
            halo = [withStroke(linewidth=2.2, foreground="black", alpha=0.5)]
            axes.add_patch(Polygon(ring, fill=False, edgecolor="white", path_effects=halo))
    if level:
        _radios(axes, scene, receivers=False)
    axes.set(xlim=_ends(x), ylim=_ends(y), aspect="equal")
    axes.set(xlabel="x [m]" if level else "along u [m]", ylabel="y [m]" if level else "along v [m]")
    return figure, axes


def _surface_figure(
    cells: Patches, value: np.ma.MaskedArray, look: dict[str, Any]
) -> tuple[Figure, Any]:
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    triangles, value = array(cells.triangle), value[array(cells.owner)]
    colours = look["cmap"](look["norm"](value.filled(0.0)))
    colours[np.ma.getmaskarray(value)] = to_rgba(_NOTHING)
    # edges of the same colour close the seams between triangles
    look = {"facecolors": colours, "edgecolors": colours, "linewidths": 0.4}
    axes.add_collection3d(Poly3DCollection(triangles, **look))
    corner = triangles.reshape(-1, 3)
    _frame_space(axes, corner.min(axis=0), corner.max(axis=0))
    return figure, axes


def cut(
    node: Node, plane: Pose, x: tuple[float, float], y: tuple[float, float]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Outlines of an object within a plane [m], in the plane's frame, over a window of it."""
    across, up = (np.linspace(low, high, CUT) for low, high in (x, y))
    grid = np.stack([*np.meshgrid(across, up), np.zeros((CUT, CUT))], axis=-1).reshape(-1, 3)
    point = node.pose.point_object(plane.point_world(torch.tensor(grid))).detach()
    low, high = node.body.shape.bounds().detach()
    beyond = (point - point.clamp(low, high)).norm(dim=-1)  # there a learned shape means nothing
    with torch.no_grad():
        parts = point.clamp(low, high).to(_dtype(node)).split(16_384)
        value = torch.cat([node.body.shape.sdf(part) for part in parts]).double() + beyond
    return _contours(across, up, array(value).reshape(CUT, CUT))


def _is_level(plane: Pose) -> bool:
    """Whether x and y of the plane are those of the world."""
    turned = torch.equal(plane.rotation.cpu(), torch.eye(3, dtype=torch.float64))
    return turned and not bool(plane.translation[:2].any())


def comparison_figure(
    measured: Float[np.ndarray, "n"],
    predicted: dict[str, Float[np.ndarray, "n"]],
    unit: str = "dBm",
    title: str = "",
) -> Figure:
    """Measured against predicted: a scatter of the first prediction, and the CDF of every error."""
    figure = Figure(figsize=(11.0, 4.8), layout="constrained")
    scatter, cdf = figure.subplots(1, 2)
    _draw_cdf(cdf, {name: values - measured for name, values in predicted.items()})
    for name, values in list(predicted.items())[:1]:
        scatter.plot(measured, values, ".", markersize=3, alpha=0.35, color="C0", label=name)
    ends = np.concatenate([measured, *list(predicted.values())[:1]])
    if len(ends):
        scatter.plot(_ends(ends), _ends(ends), color="black", linewidth=0.8)
    scatter.set(xlabel=f"measured [{unit}]", ylabel=f"predicted [{unit}]", aspect="equal")
    scatter.grid(alpha=0.3)
    scatter.legend(fontsize=8, loc="best")
    figure.suptitle(title)
    return figure


def error_map_figure(
    scene: Scene,
    place: Float[np.ndarray, "n 2"],
    error_db: dict[str, Float[np.ndarray, "n"]],
    title: str = "",
) -> Figure:
    """Errors at the places of readings [m], over the scene from above: a panel for each prediction.

    error_db: predicted less measured, of every reading. Of several readings at a place the mean of the
    errors is shown; red is predicted too strong, blue too weak, one scale for all panels.
    """
    where, of = np.unique(np.round(place, 3), axis=0, return_inverse=True)
    count = np.bincount(of.ravel())
    mean = {n: np.bincount(of.ravel(), e) / count for n, e in error_db.items()}
    most = max((float(np.percentile(np.abs(m), 95)) for m in mean.values()), default=1.0) or 1.0
    figure = Figure(figsize=(1.5 + 6.0 * max(1, len(mean)), 6.0), layout="constrained")
    panels = figure.subplots(1, max(1, len(mean)), squeeze=False)[0]
    look: dict[str, Any] = {"cmap": _ERROR, "norm": Normalize(-most, most)}
    for axes, (name, values) in zip(panels, mean.items(), strict=False):
        draw_top(axes, scene.with_receivers(()))
        _radios(axes, scene, receivers=False)
        axes.scatter(*where.T, c=values, s=18, linewidths=0.3, edgecolors=_EDGE, zorder=7, **look)
        size = np.abs(error_db[name]).mean()
        axes.set_title(f"{name}: mean of |error| {size:.1f} dB", fontsize=9)
        _widen(axes, where)
    bar = figure.colorbar(ScalarMappable(look["norm"], _ERROR), ax=panels, shrink=0.8)
    bar.set_label("predicted less measured [dB]")
    figure.suptitle(title)
    return figure


def cdf_figure(error_db: dict[str, Float[np.ndarray, "n"]], title: str = "") -> Figure:
    """Distribution functions of absolute errors [dB], one line for each prediction."""
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    _draw_cdf(figure.add_subplot(), error_db)
    figure.suptitle(title)
    return figure


def _draw_cdf(axes: Axes, error_db: dict[str, Float[np.ndarray, "n"]]) -> None:
    for i, (name, values) in enumerate(error_db.items()):
        error = np.sort(np.abs(values))
        share = np.arange(1, len(error) + 1) / max(1, len(error))
        median, tail = np.percentile(error, (50, 90)) if len(error) else (np.nan, np.nan)
        label = f"{name}: median {median:.1f} dB, 90 % {tail:.1f} dB"
        axes.step(error, share, where="post", label=label, color=f"C{i}")
    axes.set(xlabel="absolute error [dB]", ylabel="share of measurements", ylim=(0, 1))
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")


def loss_figure(history: dict[str, list[float]], title: str = "") -> Figure:
    """How a fit went: loss and its parts, and the error of each batch, step by step.

    Thin lines are steps, thick ones the median of a hundredth of the run. Steps whose loss was not
    finite were refused and are left out.
    """
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for i, (axes, name) in enumerate(
        ((left, "data"), (left, "regularisation"), (right, "error_db"))
    ):
        value = np.asarray(history[name], dtype=np.float64)
        step = np.flatnonzero(np.isfinite(value)) + 1
        value = value[step - 1]
        if not len(step) or not value.any():
            continue
        width = max(1, len(step) // 100)
        whole = len(step) // width * width
        middle = np.median(value[:whole].reshape(-1, width), axis=1)
        axes.plot(step, value, linewidth=0.4, alpha=0.4, color=f"C{i}")
        axes.plot(step[width - 1 : whole : width], middle, color=f"C{i}", label=name)
        if (value > 0).all():
            axes.set_yscale("log")
    left.set(xlabel="step", ylabel="loss")
    right.set(xlabel="step", ylabel="median error of a batch [dB]")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    left.legend(fontsize=8)
    figure.suptitle(title)
    return figure


def draw_top(axes: Axes, scene: Scene) -> None:
    """Outlines of the objects from above [m], named where they are small; sets the limits.

    Flat ones (floors, ceilings) are left unfilled: they would hide what stands on them.
    """
    low, high = scene_bounds(scene)
    named = []
    for node in scene.nodes:
        rings = footprint(node)
        thin, _, tall = _extent(node)
        thing = _is_thing(node, float((high - low)[:2].max()))
        for ring in rings:
            color = _THING if thing else _WALL
            patch = Polygon(ring, fill=bool(tall > 0.5 * thin), facecolor=color, zorder=2)
            patch.set(edgecolor=_EDGE, linewidth=1.0)
            axes.add_patch(patch)
        if rings and thing:
            named.append((_name(node.path), np.concatenate(rings).mean(axis=0)))
    for name, middle in named if len(named) <= MOST_NAMES else []:
        label = axes.annotate(name, middle, ha="center", va="center", zorder=5)
        label.set(fontsize=8, path_effects=[withStroke(linewidth=2.5, foreground="white")])
    margin = 0.04 * (high - low)[:2].max()
    axes.set(xlim=(low[0] - margin, high[0] + margin))
    axes.set(ylim=(low[1] - margin, high[1] + margin))
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def footprint(node: Node) -> list[Float[np.ndarray, "_ 2"]]:
    """Closed outlines [m] of an object seen from above; none for an unbounded one."""
    box = corners(node)
    if not np.isfinite(box).all():
        return []
    if node.body.shape.kind == "box":
        return [box[ConvexHull(box[:, :2]).vertices, :2]]
    frame, x, y, z, value = sampled(node)
    rings = _contours(x, y, value.min(axis=0))
    return [_to_world(frame, ring, 0.0)[:, :2] for ring in rings]


def slices(node: Node) -> list[Float[np.ndarray, "_ 3"]]:
    """Closed outlines [m] of level cuts through an object; none for an unbounded one."""
    if not np.isfinite(corners(node)).all():
        return []
    frame, x, y, z, value = sampled(node)
    levels = np.linspace(2, len(z) - 3, SLICES).round().astype(int)
    return [
        _to_world(frame, ring, float(z[k])) for k in levels for ring in _contours(x, y, value[k])
    ]


def sampled(node: Node) -> tuple[Pose, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A frame with z upward, coordinates x, y, z in it and the implicit function [nz, ny, nx].

    The frame is the object's own where that stands upright (a thin wall that is turned keeps its
    resolution), else the world's.
    """
    upright = (
        abs(float(node.pose.rotation[2, 2].detach())) > 1.0 - 1e-9
    )  # rounding of a turn about z
    frame = node.pose if upright else Pose.identity()
    box = array(frame.point_object(torch.as_tensor(corners(node))))
    low, high = box.min(axis=0), box.max(axis=0)
    margin = 2.0 * (high - low) / np.array(GRID)  # two cells: every outline closes in the grid
    spans = zip(low - margin, high + margin, GRID, strict=True)
    x, y, z = (np.linspace(a, b, n) for a, b, n in spans)
    grid = torch.tensor(np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1))
    point = node.pose.point_object(frame.point_world(grid.reshape(-1, 3))).to(_dtype(node))
    with torch.no_grad():
        value = torch.cat([node.body.shape.sdf(part) for part in point.split(16_384)])
    return frame, x, y, z, array(value.double()).reshape(grid.shape[:-1])


def corners(node: Node) -> Float[np.ndarray, "8 3"]:
    """Corners [m, world] of an object's own bounding box, x fastest; infinite if unbounded."""
    low, high = node.body.shape.bounds().detach().double()
    if not bool(torch.isfinite(torch.stack([low, high])).all()):
        return np.full((8, 3), np.inf)
    pick = torch.tensor([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], device=low.device)
    return array(node.pose.point_world(torch.where(pick.bool(), high, low)))


def scene_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [m] of all bounded objects and radios; a metre cube if empty."""
    points = [box for box in map(corners, scene.nodes) if np.isfinite(box).all()]
    points += [array(r.position)[None] for r in (*scene.transmitters, *scene.receivers)]
    if not points:
        return np.zeros(3), np.ones(3)
    every = np.concatenate(points)
    return every.min(axis=0), every.max(axis=0)


def _widen(axes: Axes, place: np.ndarray) -> None:
    """Let limits take in places [m] that stand outside."""
    margin = 0.02 * float(np.ptp(axes.get_xlim()))
    for i, (ends, set_ends) in enumerate(
        ((axes.get_xlim(), axes.set_xlim), (axes.get_ylim(), axes.set_ylim))
    ):
        set_ends(min(ends[0], place[:, i].min() - margin), max(ends[1], place[:, i].max() + margin))


def _draw_space(axes: Any, scene: Scene) -> None:
    low, high = scene_bounds(scene)
    for node in scene.nodes:
        box = corners(node)
        boxy = node.body.shape.kind == "box"
        edges = [box[list(pair)] for pair in _BOX_EDGES] if boxy else slices(node)
        thing = _is_thing(node, float((high - low)[:2].max()))
        look: dict[str, Any] = {"linewidths": 0.9 if thing else 0.5, "alpha": 1.0 if thing else 0.5}
        if edges:
            axes.add_collection3d(Line3DCollection(edges, colors=_EDGE, **look))
    for radios, colour, mark in ((scene.transmitters, _TX, "^"), (scene.receivers, _RX, ".")):
        if radios:
            place = np.stack([array(radio.position) for radio in radios])
            axes.plot(*place.T, mark, color=colour, markersize=7)
    _frame_space(axes, low, high)


def _frame_space(axes: Any, low: np.ndarray, high: np.ndarray) -> None:
    """Limits, view and labels of a picture in space [m], no side of it quite flat."""
    size = np.maximum(high - low, 0.1 * (high - low).max() + 1e-3)
    axes.set(xlim=(low[0], low[0] + size[0]), ylim=(low[1], low[1] + size[1]))
    axes.set(zlim=(low[2], low[2] + size[2]))
    axes.set_box_aspect(size)
    axes.view_init(elev=38, azim=-62)
    axes.grid(False)
    axes.locator_params(axis="z", nbins=3)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x [m]", fontsize=8)
    axes.set_ylabel("y [m]", fontsize=8)
    axes.set_zlabel("z [m]", fontsize=8)


def _radios(axes: Axes, scene: Scene, receivers: bool = True) -> None:
    groups = [(scene.transmitters, _TX, "^", 9.0, "transmitter")]
    if receivers:
        groups.append((scene.receivers, _RX, "o", 4.0, "receiver"))
    for radios, colour, mark, size, label in groups:
        if radios:
            place = np.stack([array(radio.position) for radio in radios])
            style = {"color": colour, "markersize": size, "markeredgecolor": "white"}
            axes.plot(place[:, 0], place[:, 1], mark, zorder=6, label=label, **style)
    if any(group[0] for group in groups):
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
        axes.legend(fontsize=8, ncols=2, frameon=False, borderaxespad=0.2, **place)


def _contours(x: np.ndarray, y: np.ndarray, value: np.ndarray) -> list[np.ndarray]:
    """Zero lines of samples [ny, nx]."""
    axes = Figure().add_subplot()
    rings = axes.contour(x, y, value, levels=[0.0]).allsegs[0] if (value < 0).any() else []
    return [ring for ring in rings if len(ring) > 2]


def _is_thing(node: Node, scene_size: float) -> bool:
    """Furniture rather than part of the building: neither long nor wall-like. For looks only."""
    thin, wide, _ = _extent(node)
    return wide < 0.4 * scene_size and thin > 0.2 * wide


def _extent(node: Node) -> tuple[float, float, float]:
    """Smaller and larger horizontal side and height [m] of an object's own box."""
    low, high = array(node.body.shape.bounds())
    size = (high - low) * float(node.pose.scale.detach())
    up = int(np.argmax(np.abs(array(node.pose.rotation)[2])))  # its axis nearest to the vertical
    across = sorted(float(side) for i, side in enumerate(size) if i != up)
    return across[0], across[1], float(size[up])


def _to_world(frame: Pose, ring: np.ndarray, z: float) -> np.ndarray:
    flat = np.column_stack([ring, np.full(len(ring), z)])
    return array(frame.point_world(torch.tensor(flat)))


def _dtype(node: Node) -> torch.dtype:
    """A network answers fast in its own precision; closed forms cost nothing in float64."""
    return torch.float64 if node.body.shape.exact else torch.float32


def _edges(centre: np.ndarray, cell: float) -> np.ndarray:
    """Edges of cells with these middles."""
    return np.concatenate([centre - cell / 2, centre[-1:] + cell / 2])


def _ends(values: np.ndarray) -> tuple[float, float]:
    return float(np.min(values)), float(np.max(values))


def _name(path: str) -> str:
    return path.rsplit("/", 1)[-1]


def _plural(count: int, word: str) -> str:
    return f"{count} {word}" if count == 1 else f"{count} {word}s"
