"""Small scenes, edits of them drawn at random, and whether two results say the same."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.contract import Surface
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import Box, Cylinder, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.assets import load_asset
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.records import Act
from rfsg.tracer.simulate import Result
from tests.scenes import room_nodes

SIZE = (6.0, 4.0, 3.0)
CABINET = Path(__file__).resolve().parents[2] / "assets" / "objects" / "cabinet" / "cabinet.usda"
LEARNED_AT = (4.4, 2.9, 0.01, 25.0)


def surface(draw: np.random.Generator, kinds: tuple[str, ...]) -> Surface:
    """A material of one of the kinds."""
    kind = draw.choice(kinds)
    if kind == "metal":
        return Conductor()
    if kind == "ground":
        return DielectricHalfSpace(itu="concrete")
    if kind == "solid":
        return Solid(itu=str(draw.choice(["wood", "glass"])))
    if kind == "rough":
        return Slab(itu="concrete", thickness_m=0.2, scattering=Scattering(0.3))
    return Slab(itu=str(draw.choice(["wood", "glass"])), thickness_m=float(draw.uniform(0.02, 0.3)))


def body(draw: np.random.Generator, kinds: tuple[str, ...], round_ones: bool) -> Body:
    """A box, or a cylinder or a sphere."""
    shape = Box(draw.uniform((0.1, 0.1, 0.2), (0.5, 0.5, 0.8)).tolist())
    if round_ones and draw.random() < 0.3:
        shape = Cylinder(0.25, 0.6) if draw.random() < 0.5 else Sphere(0.3)
    return Body(shape, surface(draw, kinds))


def pose(draw: np.random.Generator) -> Pose:
    """Anywhere in the room: things may touch, overlap, and stand in walls; half of them are flush with
    the floor."""
    x, y, z = draw.uniform((0.4, 0.4, 0.3), (5.6, 3.6, 2.2)).tolist()
    yaw = float(draw.choice([0.0, 90.0, 31.0, -72.5]))
    return Pose.at(x, y, 0.25 if draw.random() < 0.5 else z, yaw_deg=yaw)


def radio(draw: np.random.Generator, path: str) -> Radio:
    return Radio.at(path, *draw.uniform((0.2, 0.2, 0.2), (5.8, 3.8, 2.8)).tolist())


def scene(
    seed: int,
    kinds: tuple[str, ...],
    *,
    things: int = 3,
    receivers: int = 3,
    round_ones: bool = False,
    learned: bool = False,
) -> Scene:
    """A room with a few things in it; and a learned one."""
    draw = np.random.default_rng(seed)
    nodes = [Node(f"/thing{k}", body(draw, kinds, round_ones), pose(draw)) for k in range(things)]
    if learned:
        nodes.append(Node("/learned", load_asset(CABINET).body, Pose.at(*LEARNED_AT)))
    rx = tuple(radio(draw, f"/rx{k}") for k in range(receivers))
    return Scene((*room_nodes(SIZE), *nodes), (radio(draw, "/tx0"),), rx, 2.4e9)


def edit(
    before: Scene, draw: np.random.Generator, kinds: tuple[str, ...], round_ones: bool
) -> tuple[str, Scene]:
    """One edit, and its name."""
    names = [n.path for n in before.nodes]
    which = str(draw.choice(names)) if names else ""
    edits: dict[str, Callable[[], Scene]] = {
        "moved": lambda: before.moved(which, draw.normal(0.0, 0.4, 3).tolist(), yaw_deg=20.0),
        "nudged": lambda: before.moved(which, (1e-3, 0.0, 0.0)),
        "replaced": lambda: before.replaced(which, body(draw, kinds, round_ones)),
        "painted": lambda: before.replaced(
            which, Body(before.node(which).body.shape, surface(draw, kinds))
        ),
        "removed": lambda: before.without(which),
        "added": lambda: replace(
            before,
            nodes=(
                Node(f"/new{draw.integers(1 << 30)}", body(draw, kinds, round_ones), pose(draw)),
                *before.nodes,
            ),
        ),
        "doubled": lambda: replace(
            before,
            nodes=(*before.nodes, replace(before.node(which), path=f"/a{draw.integers(1 << 30)}")),
        ),
        "set going": lambda: replace(
            before,
            nodes=tuple(
                replace(n, velocity=torch.ones(3, dtype=torch.float64)) if n.path == which else n
                for n in before.nodes
            ),
        ),
        "receiver moved": lambda: before.with_receivers(
            [radio(draw, before.receivers[0].path), *before.receivers[1:]]
        ),
        "receivers": lambda: before.with_receivers(
            [*before.receivers[1:], radio(draw, f"/rx{draw.integers(1 << 30)}")]
        ),
        "transmitter": lambda: before.with_transmitters(
            [*before.transmitters[-1:], radio(draw, f"/tx{draw.integers(1 << 30)}")]
        ),
        "antenna": lambda: before.with_receivers(
            [replace(r, pattern="half_wave_dipole") for r in before.receivers]
        ),
        "nothing": lambda: replace(before, nodes=before.nodes[::-1]),
    }
    name = str(draw.choice(list(edits)))
    if not which and name not in ("added", "receivers", "transmitter"):
        name = "added"
    return name, edits[name]()


# whether two results are the same


def rows(result: Result) -> Tensor:
    """One row of whole numbers for every path: its radios, what it visits and does there, and where, to
    a micrometre."""
    paths = result.paths
    item = torch.where(paths.act == int(Act.DIFFRACT), 0, paths.item)
    where = torch.round(paths.vertices.flatten(1) * 1e6).long()
    ends = torch.stack([paths.tx, paths.rx], 1)
    return torch.cat([ends, paths.which, paths.act, item, where], 1)


def in_order(result: Result) -> Tensor:
    """Paths in an order that is their own."""
    key = rows(result)[:, : 2 + 2 * result.paths.which.shape[1]]
    order = torch.argsort(result.paths.length, stable=True)
    for column in key.unbind(1):
        order = order[torch.argsort(column[order], stable=True)]
    return order


def assert_same(found: Result, full: Result) -> None:
    """The same paths, in any order: geometry to 1e-9 m, gains to 1e-9 of each."""
    assert len(found.paths.tx) == len(full.paths.tx)
    depth = max(found.paths.which.shape[1], full.paths.which.shape[1])
    a, b = (replace(r, paths=r.paths.padded(depth)) for r in (found, full))
    i, j = in_order(a), in_order(b)
    for name in ("tx", "rx", "which", "act", "caustics", "status"):
        assert torch.equal(getattr(a.paths, name)[i], getattr(b.paths, name)[j]), name
    for name in ("vertices", "length"):
        torch.testing.assert_close(
            getattr(a.paths, name)[i], getattr(b.paths, name)[j], rtol=0.0, atol=1e-9
        )
    g, h = a.channel.gain[i], b.channel.gain[j]
    assert bool(((g - h).abs() <= 1e-9 * h.abs()).all())
    if h.numel():
        torch.testing.assert_close(a.channel.delay[i], b.channel.delay[j], rtol=1e-9, atol=0.0)
        torch.testing.assert_close(a.channel.doppler[i], b.channel.doppler[j], rtol=1e-9, atol=1e-6)
    crossed = [
        sorted((int(torch.argsort(order)[p]), n, s) for p, n, s in r.channel.crossed.tolist())
        for r, order in ((a, i), (b, j))
    ]
    assert crossed[0] == crossed[1]
    assert found.status_counts == full.status_counts
    assert found.search.complete == full.search.complete
    assert found.plan.left_out == full.plan.left_out
