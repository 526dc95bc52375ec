"""Laws over scenes drawn at random: every shape and surface, 1 mm to 100 km, 100 MHz to 300 GHz.

Each scene is small, so a law is held against many of them. Sizes are drawn first as one length for
the whole scene, then as shares of it, half of them round numbers: things that touch, coincide and
stand in line come from those. Materials are in SI units whatever the scene's size, so walls thinner
and thicker than the wavelength, opaque or hardly there, all come up.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.catalogue import SURFACES, shape_class, surface_class
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.channel import coefficients
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Status
from rfsg.tracer.simulate import Result, simulate
from tests.laws.catalogue import angle_iron
from tests.scenes import radio, vector

C = 299_792_458.0
IRON = angle_iron()  # not convex
# what is refracted through curved solids is looked for with rays, which may miss some
QUALITY = Quality(depth=2, floor_db=-300.0, refraction=False)


def laws(examples: int):
    return settings(max_examples=examples, deadline=None, derandomize=True, database=None)


# what is drawn is plain numbers; scenes are made of them outside of the strategies


@dataclass(frozen=True)
class Turn:
    """A rotation by its quaternion, with a mirror or without."""

    quaternion: tuple[float, ...]
    mirror: float

    def matrix(self) -> Tensor:
        q = vector(*self.quaternion)
        q = q / q.norm() if float(q.norm()) > 0.1 else vector(1.0, 0.0, 0.0, 0.0)
        w, x, y, z = q.tolist()
        rotation = vector(
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ).reshape(3, 3)
        return rotation @ torch.diag(vector(1.0, self.mirror, 1.0))


@dataclass(frozen=True)
class Thing:
    """One object: its shape's sizes and its place in units of the scene."""

    kind: str
    sizes: tuple[float, ...]
    surface: tuple[str, dict[str, Any]]
    turn: Turn
    place: tuple[float, ...]
    scale: float

    def node(self, size: float, index: int) -> Node:
        a, b, c = (s * size / self.scale for s in self.sizes)
        rotation = self.turn.matrix()
        place = size * vector(*self.place)
        arguments = {
            "box": {"half_size": [a, b, c]},
            "halfspace": {},
            "mesh": {
                "vertices": IRON.vertices * vector(a, b, c),
                "triangles": IRON.triangles,
            },
            "sphere": {"radius": a},
            "cylinder": {"radius": a, "half_height": b},
            "capsule": {"radius": a, "half_height": b},
        }[self.kind]
        if self.kind == "halfspace":
            place = place - 2.0 * size * rotation[:, 2]
        kind, constants = self.surface
        body = Body(shape_class(self.kind)(**arguments), surface_class(kind)(**constants))
        return Node(f"/n{index}", body, Pose(rotation, place, vector(self.scale)[0]))


@dataclass(frozen=True)
class Drawn:
    """A whole scene: one length [m], objects, the transmitter and receivers, a frequency [Hz]."""

    size: float
    things: tuple[Thing, ...]
    radios: tuple[tuple[float, ...], ...]
    frequency: float

    def scene(self) -> Scene:
        nodes = tuple(t.node(self.size, i) for i, t in enumerate(self.things))
        at = [[self.size * x for x in place] for place in self.radios]
        rx = tuple(radio(f"/r{i}", *place) for i, place in enumerate(at[1:]))
        return Scene(nodes, (radio("/t", *at[0]),), rx, self.frequency)


def decades(low: float, high: float):
    """Numbers spread evenly over decades."""
    return st.floats(math.log10(low), math.log10(high)).map(lambda e: 10.0**e)


def three(numbers):
    return st.tuples(numbers, numbers, numbers)


SHARE = st.one_of(st.sampled_from([0.25, 0.5, 1.0]), st.floats(0.05, 1.0))
PLACE = st.one_of(st.sampled_from([-1.0, -0.5, 0.0, 0.25, 0.5]), st.floats(-1.0, 1.0))
TURN = st.builds(Turn, st.tuples(PLACE, PLACE, PLACE, PLACE), st.sampled_from([1.0, -1.0]))
CONSTANTS = {"eps_r": st.floats(1.0, 80.0), "sigma": decades(1e-6, 1e2)}
ARGUMENTS = {
    "conductor": {},
    "halfspace": CONSTANTS,
    "solid": CONSTANTS,
    "slab": {**CONSTANTS, "thickness_m": decades(1e-4, 10.0)},
    "stochastic": {
        "m": st.one_of(st.just(0.0), decades(1e-3, 1e6)),
        "alpha": st.floats(0.0, 1.0),
        "phi": st.floats(-math.pi / 2, math.pi / 2),
        "sharpness": decades(1e-3, 1e6),
        "bulk": st.one_of(st.none(), decades(1e-3, 1e2)),
        "law": st.sampled_from(["logistic", "gaussian", "laplace"]),
        "samples": st.just(8),
    },
}
SURFACE = st.one_of(
    *(
        st.tuples(st.just(kind), st.fixed_dictionaries(arguments))
        for kind, arguments in ARGUMENTS.items()
    )
)
PLANAR = ("box", "halfspace", "mesh")
CURVED = ("sphere", "cylinder", "capsule")


def scenes(most: int = 3, receivers: int = 1, kinds: tuple[str, ...] = PLANAR + CURVED):
    """Scenes of up to ``most`` objects, one transmitter and some receivers."""
    thing = st.builds(
        Thing,
        st.sampled_from(kinds),
        three(SHARE),
        SURFACE,
        TURN,
        three(PLACE.map(lambda x: 1.5 * x)),
        st.one_of(st.just(1.0), decades(1e-2, 1e2)),
    )
    at = three(PLACE.map(lambda x: 2.0 * x))
    return st.builds(
        Drawn,
        decades(1e-3, 1e5),
        st.lists(thing, max_size=most).map(tuple),
        st.tuples(*[at] * (receivers + 1)),
        decades(1e8, 3e11),
    )


def run(scene: Scene, quality: Quality = QUALITY, **options) -> Result:
    return simulate(scene, quality=quality, **options)


def alike(a: Result, b: Result, relative: float) -> None:
    """The same paths in both, each to ``relative``; where they stand in the table says nothing."""
    ours, theirs = (
        torch.stack([r.paths.length.to(torch.complex128), coefficients(r.channel)[:, 0]], -1)
        for r in (a, b)
    )
    assert len(ours) == len(theirs)
    if len(ours):
        length, gain = (ours[:, None] - theirs[None]).abs().unbind(-1)
        slack = relative * ours.abs().amax(0)
        near = (length <= slack[0]) & (gain <= slack[1])
        assert bool(near.any(0).all() & near.any(1).all())
        assert abs(complex((a.transfer() - b.transfer()).sum())) <= len(ours) * float(slack[1])


def turned_round(scene: Scene) -> Scene:
    return replace(scene, transmitters=scene.receivers, receivers=scene.transmitters)


def test_every_surface_is_drawn():
    assert set(ARGUMENTS) == set(SURFACES)


@laws(20)
@given(scenes(), st.booleans())
def test_everything_is_finite(drawn, on_surface):
    """Numbers and gradients with respect to radios, poses, sizes and materials; every candidate that
    is dropped is counted under a status that has a sentence."""
    scene = drawn.scene()
    if on_surface and scene.nodes:  # the transmitter where a surface is
        pose = scene.nodes[0].pose
        at = pose.point_world(scene.nodes[0].body.shape.bounds()[1].nan_to_num(posinf=0.0))
        scene = scene.with_transmitters([replace(scene.transmitters[0], position=at)])
    inputs = [scene.transmitters[0].position, scene.receivers[0].position]
    for node in scene.nodes:
        inputs += [node.pose.translation, node.pose.scale, *node.body.shape.parameters()]
        inputs += [p for p in node.body.surface.parameters() if p.numel() < 8]
    for x in inputs:
        x.requires_grad_(True)
    result = run(scene, replace(QUALITY, refraction=True), gradients=True)
    channel, paths = result.channel, result.paths
    for value in (channel.gain, channel.delay, channel.doppler, channel.departure, channel.arrival):
        assert bool(torch.isfinite(value.detach()).all())
    for value in (paths.vertices, paths.length, paths.spread, paths.normal):
        assert bool(torch.isfinite(value.detach()).all())
    counts = result.status_counts
    assert sum(counts.values()) >= len(result.chains.tx)  # refraction finds more on the way
    assert counts.get("OK", 0) + counts.get("CAUSTIC_CAPPED", 0) == len(paths.tx)
    assert all(Status[name].sentence for name in counts)
    gain = result.path_gain().sum()
    if gain.requires_grad:
        for g in torch.autograd.grad(gain, inputs, allow_unused=True):
            assert g is None or bool(torch.isfinite(g).all())


@laws(20)
@given(scenes(kinds=PLANAR))
def test_no_path_off_planes_is_stronger_than_free_space(drawn):
    result = run(drawn.scene())
    free = C / drawn.frequency / (4 * math.pi) / result.paths.length
    assert bool((result.channel.gain[:, 0].abs() <= free * (1 + 1e-12)).all())


@laws(15)
@given(scenes())
def test_reciprocity(drawn):
    scene = drawn.scene()
    alike(run(scene), run(turned_round(scene)), 1e-9)


@laws(15)
@given(scenes(most=2), TURN, three(PLACE))
def test_rigid_motion_changes_nothing(drawn, turn, shift):
    """Turned, mirrored, and carried off by ten times its own size."""
    # float64 holds places to 1e-16 of themselves: of so many waves it leaves 1e-8 turns to rounding
    drawn = replace(drawn, frequency=min(drawn.frequency, 1e5 * C / drawn.size))
    scene = drawn.scene()
    outer = Pose(turn.matrix(), 10.0 * drawn.size * vector(*shift), vector(1.0)[0])
    move = lambda r: replace(r, position=outer.point_world(r.position))  # noqa: E731
    moved = replace(
        scene,
        nodes=tuple(replace(n, pose=outer.compose(n.pose)) for n in scene.nodes),
        transmitters=tuple(map(move, scene.transmitters)),
        receivers=tuple(map(move, scene.receivers)),
    )
    alike(run(scene), run(moved), 1e-7)


@laws(10)
@given(scenes())
def test_order_of_objects_changes_nothing(drawn):
    scene = drawn.scene()
    alike(run(scene), run(replace(scene, nodes=scene.nodes[::-1])), 1e-9)


@laws(8)
@given(scenes(most=2, receivers=2))
def test_batch_equals_loop(drawn):
    scene = drawn.scene()
    together = run(scene)
    for r, receiver in enumerate(scene.receivers):
        alone = run(scene.with_receivers([receiver]))
        strongest = max(alone.channel.gain.abs().amax(), 0.0) if len(alone.paths.tx) else 0.0
        apart = together.transfer()[0, r, 0] - alone.transfer()[0, 0, 0]
        assert abs(complex(apart)) <= 1e-9 * float(strongest)


@laws(8)
@given(SHARE, three(PLACE), three(PLACE), decades(1e8, 3e11), st.sampled_from([0, 1, 2]))
def test_a_wall_cut_into_flush_halves(cut, tx, rx, frequency, axis):
    """A solid in two pieces is the solid, whichever way it is cut. A slab is as thick as it says, and
    a stochastic surface counts each of its boundaries, so these are cut across, and off the path."""
    half = [0.1, 2.0, 2.0]
    ends = (radio("/t", -1.0, tx[1], tx[2]),), (radio("/r", 1.0, rx[1], rx[2]),)

    def gain(parts, surface):
        nodes = tuple(
            Node(f"/{i}", Body(Box(h), surface), Pose.at(*c)) for i, (c, h) in enumerate(parts)
        )
        quality = replace(QUALITY, depth=0)
        return complex(simulate(Scene(nodes, *ends), frequency, quality).transfer()[0, 0, 0])

    def halves(axis, at):
        low, high = [list(half), list(half)], [[0.0] * 3, [0.0] * 3]
        low[0][axis], low[1][axis] = (half[axis] + at) / 2, (half[axis] - at) / 2
        high[0][axis], high[1][axis] = (at - half[axis]) / 2, (at + half[axis]) / 2
        return list(zip(high, low, strict=True))

    whole = [([0.0, 0.0, 0.0], half)]
    pieces = halves(axis, half[axis] * (cut - 0.5))
    solid = Solid(eps_r=4.0, sigma=0.01)
    expected = gain(whole, solid)
    assert gain(pieces, solid) == pytest.approx(expected, rel=1e-7)
    off = halves(1, 1.5)  # no path here comes so far out
    for surface in (
        Slab(0.2, eps_r=4.0, sigma=0.01),
        StochasticSurface(m=0.5, alpha=0.8, sharpness=30.0, bulk=0.5),
    ):
        assert gain(off, surface) == pytest.approx(gain(whole, surface), rel=1e-9)
