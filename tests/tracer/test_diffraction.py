"""Edge diffraction in a scene: continuity, symmetry, images, gradients (coefficients: test_utd)."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.optimize import minimize

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Cylinder, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer import diffraction
from rfsg.tracer.channel import coefficients
from rfsg.tracer.edges import Edges, edges_in
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act
from rfsg.tracer.simulate import simulate
from tests.objects.physics import wedge_twin
from tests.objects.physics.wedges import metal, metal_slope
from tests.scenes import box_node, radio, vector

F = 2.4e9
K = 2 * math.pi * F / 299_792_458.0
QUALITY = Quality(depth=1, diffraction=1, floor_db=-300.0)
SURFACES = {
    "metal": Conductor(),
    "stone": DielectricHalfSpace(eps_r=5.0, sigma=0.1),
    "plaster": Slab(0.1, itu="plasterboard"),
}


def _around(surface, polarization, angles, oblique=1.3):
    """h over receivers on a circle about the edge at (-1, -1) of a tall block, at these angles [rad]
    from the +x axis, clockwise; a smooth phase taken off."""
    block = Node("/b", Body(Box([1.0, 1.0, 40.0]), surface), Pose.identity())
    tx = radio("/t", -6.0, -0.5, oblique, polarization=polarization)
    rx = [
        radio(f"/r{k}", -1 + 5 * math.cos(a), -1 - 5 * math.sin(a), -0.7, polarization=polarization)
        for k, a in enumerate(angles)
    ]
    result = simulate(Scene((block,), (tx,), tuple(rx)), F, QUALITY)
    return result.transfer()[0, :, 0]


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("polarization", ["none", "V", "H"])
@pytest.mark.parametrize("boundary", ["incidence", "reflection"])
def test_the_total_field_has_no_step_and_no_kink_at_shadow_boundaries(
    surface, polarization, boundary
):
    """Direct, reflected and diffracted waves together, from one side of a boundary to the other: the
    direct ray grazes the edge, or the mirror point on the face x = -1 reaches it."""
    graze = math.atan2(0.5, 5.0)
    middle = graze if boundary == "incidence" else math.pi - graze
    step = 2e-4
    h = _around(SURFACES[surface], polarization, [middle + step * s for s in (-2, -1, 1, 2)])
    scale = float(h.abs().max())
    jump = abs(complex(h[2] - h[1]))
    # what the field changes by over the gap of two steps, by its slope on either side
    before, after = complex(h[1] - h[0]), complex(h[3] - h[2])
    assert jump <= 2.5 * max(abs(before), abs(after)) + 1e-9 * scale
    # metal's slopes agree; a heuristic wedge's face coefficient may turn a little at the boundary
    slack = 0.02 if surface == "metal" else 0.2
    assert abs(complex(h[2] - h[1]) - (before + after)) <= slack * (abs(before) + abs(after))


@pytest.mark.parametrize("surface", ["metal", "stone"])
def test_unpolarised_links_have_the_mean_power_deep_in_a_shadow(surface):
    """Far from all boundaries |h|^2 is the mean over the polarisations: here V is along the edge and H
    across it, and nothing turns one into the other."""
    block = Node("/b", Body(Box([1.0, 1.0, 40.0]), SURFACES[surface]), Pose.identity())
    power = {}
    for p in ("none", "V", "H"):
        tx = radio("/t", -6.0, 3.0, 0.0, polarization=p)
        # round the corner (-1, -1), well inside the shadow of the block, below its face y = -1
        rx = [radio(f"/r{k}", 4.0, -1.6 - 0.3 * k, 0.0, polarization=p) for k in range(3)]
        result = simulate(Scene((block,), (tx,), tuple(rx)), F, QUALITY)
        order = torch.argsort(result.paths.length)
        power[p] = result.channel.gain[order, 0].abs() ** 2
    expected = 0.5 * (power["V"] + power["H"])
    assert len(expected) >= 3 and bool((expected > 0).all())
    assert float((10 * torch.log10(power["none"] / expected)).abs().max()) < 0.5


def test_there_is_a_field_in_the_shadow_and_less_of_it_further_in():
    graze = math.atan2(0.5, 5.0)
    h = _around(SURFACES["metal"], "H", [graze * s for s in (0.9, 0.6, 0.3)]).abs()
    assert bool((h > 0).all()) and bool((h[1:] < h[:-1]).all())


@pytest.mark.parametrize("count", [1, 2])
def test_reciprocity(count):
    """Swapped ends: the same paths and coefficients, with one and two edges, polarised."""
    nodes = (
        Node("/b", Body(Box([0.5, 0.4, 3.0]), Conductor()), Pose.at(0, 0, 0, 20.0)),
        Node("/c", Body(Box([0.2, 1.0, 3.0]), SURFACES["stone"]), Pose.at(2.0, 0.5, 0, -10.0)),
        box_node("/floor", (0, 0, -1.6), (6.0, 6.0, 0.1)),
    )
    ends = (
        radio("/t", -3.0, 0.2, 0.3, polarization="V"),
        radio("/r", 3.5, 2.9, -0.4, polarization="H"),
    )
    quality = replace(QUALITY, depth=2, diffraction=count)
    found = []
    for tx, rx in (ends, ends[::-1]):
        result = simulate(Scene(nodes, (tx,), (rx,)), F, quality)
        found.append(sorted(coefficients(result.channel)[:, 0].tolist(), key=lambda c: abs(c)))
        assert int((result.paths.act == int(Act.DIFFRACT)).sum(1).max()) == count
    there, back = (torch.tensor(c) for c in found)
    assert len(there) == len(back) >= 8
    assert float((there - back).abs().max()) <= 1e-9 * float(there.abs().max())


def test_a_mirror_and_an_edge_are_the_edge_seen_from_the_image():
    """Over a perfect ground: the wave that reflects and then bends is the image's wave."""
    block = Node("/b", Body(Box([0.5, 0.5, 30.0]), Conductor()), Pose.identity())
    ground = box_node("/g", (0, 0, -2.1), (40.0, 40.0, 0.1), Conductor())
    tx, rx = radio("/t", -4.0, 0.1, 1.0), radio("/r", 3.0, 2.3, 4.0)
    both = simulate(Scene((block, ground), (tx,), (rx,)), F, replace(QUALITY, depth=2))
    acts = both.paths.act.tolist()
    bounced = [p for p, a in enumerate(acts) if a == [0, 1] and both.paths.which[p, 0] == 1]
    image = radio("/t", -4.0, 0.1, -5.0)
    alone = simulate(Scene((block,), (image,), (rx,)), F, QUALITY)
    bent = torch.nonzero(alone.paths.act[:, 0] == 1).squeeze(-1)
    a = sorted(coefficients(both.channel)[bounced, 0].tolist(), key=abs)
    b = sorted((-coefficients(alone.channel)[bent, 0]).tolist(), key=abs)
    assert len(a) == len(b) > 0
    for x, y in zip(a, b, strict=True):
        assert abs(x - y) <= 1e-9 * abs(y)


def test_edges_flush_with_another_object_do_not_diffract():
    wavelength = 0.125
    alone = Scene((box_node("/a", (0, 0, 0), (1.0, 1.0, 1.0)),))
    assert len(edges_in(World(alone), wavelength)) == 12
    flush = Scene((*alone.nodes, box_node("/b", (2.0, 0, 0), (1.0, 1.0, 1.0))))
    edges = edges_in(World(flush), wavelength)
    assert len(edges) == 16  # the four of each at the joint are none
    on_floor = Scene((*alone.nodes, box_node("/f", (0, 0, -1.5), (9.0, 9.0, 0.5))))
    assert int((edges_in(World(on_floor), wavelength).node == 0).sum()) == 8


def test_smooth_objects_and_empty_scenes_have_no_edges():
    ball = Node("/s", Body(Sphere(0.5), Conductor()), Pose.identity())
    tx, rx = radio("/t", -2.0, 0, 0.1), radio("/r", 1.0, 1.7, 0)
    for nodes in ((), (ball,)):
        with_it = simulate(Scene(nodes, (tx,), (rx,)), F, QUALITY)
        without = simulate(Scene(nodes, (tx,), (rx,)), F, replace(QUALITY, diffraction=0))
        assert torch.equal(with_it.transfer(), without.transfer())


def test_spreading_of_two_edges_is_that_of_the_unfolded_path():
    """1 / sqrt(s0 s1 s2 (s0 + s1 + s2)) for parallel edges."""
    block = Node("/b", Body(Box([0.5, 0.5, 9.0]), Conductor()), Pose.identity())
    scene = Scene((block,), (radio("/t", -4.0, 0.1, 1.0),), (radio("/r", 3.0, 0.3, 0.5),))
    result = simulate(scene, F, replace(QUALITY, diffraction=2))
    two = torch.nonzero((result.paths.act == 1).sum(1) == 2).squeeze(-1)
    assert len(two) >= 2
    v = result.paths.vertices[two]
    s = (v[:, 1:] - v[:, :-1]).norm(dim=-1)
    vertical = (v[:, 1] - v[:, 2])[:, :2].norm(dim=-1) > 0.9
    expected = 1.0 / torch.sqrt(s.prod(1) * s.sum(1))
    found = result.paths.spread[two]
    torch.testing.assert_close(found[vertical], expected[vertical], rtol=1e-9, atol=0)


@pytest.mark.parametrize("polarization", ["V", "H"])
@pytest.mark.parametrize("count", [1, 2])
def test_a_metal_block_diffracts_as_the_articles_write_it(count, polarization):
    """Round the edges (-0.6, 0.5) and (0.6, 0.5), all at one height: V is soft there, and H hard."""
    block = Node("/b", Body(Box([0.6, 0.5, 40.0]), Conductor()), Pose.identity())
    source, receiver = (-4.0, 0.1), ((3.0, 0.2) if count == 2 else (0.1, 1.7))
    tx, rx = (radio(f"/{x}", *x, 0.0, polarization=polarization) for x in (source, receiver))
    result = simulate(Scene((block,), (tx,), (rx,)), F, replace(QUALITY, diffraction=count))
    over = result.paths.vertices[:, 1:-1, 1] > 0.4
    (p,) = torch.nonzero(over.all(1) & ((result.paths.act == 1).sum(1) == count)).flatten().tolist()

    def seen(corner, along, place):
        """Azimuth from the face y = 0.5, and distance."""
        x, y = place[0] - corner, place[1] - 0.5
        return math.atan2(y, along * x) % (2 * math.pi), math.hypot(x, y)

    phi_in, s_in = seen(-0.6, 1, source)
    if count == 1:
        phi_out, s_out = seen(-0.6, 1, receiver)
        found, lengths = metal(phi_in, phi_out, 1.5, s_in, s_out, K), (s_in, s_out)
    else:
        (phi_out, s_out), d = seen(0.6, -1, receiver), 1.2
        found, lengths = wedge_twin.along_face(
            metal(phi_in, 0.0, 1.5, s_in, d, K),
            metal(0.0, phi_out, 1.5, d, s_out, K),
            metal_slope(0.0, phi_in, 1.5, d, s_in, K),
            metal_slope(0.0, phi_out, 1.5, d, s_out, K),
            *vector(math.pi / 2, math.pi / 2, d, K),
        ), (s_in, d, s_out)  # fmt: skip
    spread = 1.0 / math.sqrt(math.prod(lengths) * sum(lengths))
    expected = complex(found["VH".index(polarization)]) * spread / (2 * K)
    ours = complex(result.channel.gain[p, 0])
    # of which of its two ways a horizontal antenna counts as positive nothing is said here
    sign = 1 if polarization == "V" or abs(ours - expected) < abs(ours + expected) else -1
    assert abs(sign * ours - expected) < 1e-9 * abs(expected)


@pytest.mark.parametrize("count", [1, 2])
def test_gradients(count):
    """Path gain by the receiver's place, the block's place and its width, against differences."""
    quality = replace(QUALITY, diffraction=count)

    def power(x):
        block = Box([0.5, 0.4, 3.0])
        del block.half_size  # a plain tensor in its place carries the gradient
        block.half_size = torch.stack([x[4], *vector(0.4, 3.0)])
        pose = Pose.at(0, 0, 0, 20.0)
        pose = Pose(pose.rotation, pose.translation + x[3] * vector(0, 1.0, 0), pose.scale)
        rx = replace(radio("/r", 0, 0, 0, polarization="V"), position=x[:3])
        tx = radio("/t", -3.0, 0.2, 0.3, polarization="V")
        scene = Scene((Node("/b", Body(block, Conductor()), pose),), (tx,), (rx,))
        return simulate(scene, F, quality, gradients=True).path_gain().sum() * 1e8

    start = vector(4.0, 0.1, -0.4, 0.05, 0.5)
    x = start.clone().requires_grad_(True)
    found = torch.autograd.grad(power(x), x)[0]
    for k in range(5):
        h = torch.zeros(5, dtype=torch.float64)
        h[k] = 1e-6
        expected = float(power(start + h) - power(start - h)) / 2e-6
        assert float(found[k]) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def _can(polarization, heights):
    """Receivers behind a metal drum, by height [m] over the line that grazes its rim."""
    drum = Node("/d", Body(Cylinder(0.6, 1.0), Conductor()), Pose.identity())
    tx = radio("/t", -3.0, 0.0, 1.48, polarization=polarization)
    # from the transmitter over the far rim (0.6, 0, 1): 0.48 down in 3.6 m, 0.96 m high at 0.9 m
    rx = [
        radio(f"/r{k}", 0.9, 0.0, 0.96 + h, polarization=polarization)
        for k, h in enumerate(heights)
    ]
    quality = replace(QUALITY, curved=0)
    return simulate(Scene((drum,), (tx,), tuple(rx)), F, quality)


def test_points_on_a_rim_are_stationary_and_spread_by_its_curvature():
    """Keller's cone at every point found, and S against the second derivative of the length."""
    result = _can("V", [1.0, 2.0])
    bent = torch.nonzero((result.paths.act == 1).any(1)).squeeze(-1)
    assert len(bent) >= 4
    for p in bent.tolist():
        a, x, b = result.paths.vertices[p][:3]
        centre = vector(0, 0, float(x[2]))

        def length(turn, x=x, centre=centre, a=a, b=b):
            c, s = math.cos(turn), math.sin(turn)
            arm = x - centre
            y = centre + torch.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1], arm[2]])
            return float((y - a).norm() + (b - y).norm())

        h = 1e-4
        rise = (length(h) - length(-h)) / (2 * h)
        bend = (length(h) - 2 * length(0.0) + length(-h)) / h**2 / 0.36
        assert abs(rise) < 1e-7
        u = (x - a) / (x - a).norm()
        tangent = torch.linalg.cross(vector(0, 0, 1.0), (x - centre) / 0.6)
        sine = float(torch.linalg.cross(u, tangent).norm())
        expected = sine / (float((x - a).norm() * (b - x).norm()) * math.sqrt(abs(bend)))
        assert float(result.paths.spread[p]) == pytest.approx(expected, rel=1e-5)
        assert int(result.paths.caustics[p]) == int(bend < 0)


@pytest.mark.parametrize("polarization", ["V", "H"])
def test_no_step_where_the_direct_ray_grazes_a_rim(polarization):
    h = _can(polarization, [-1e-4, -1e-7, 1e-7, 1e-4]).transfer()[0, :, 0]
    assert abs(complex(h[2] - h[1])) <= 1e-3 * float(h.abs().max())


def test_newton_finds_the_shortest_way_over_two_edges():
    """Against scipy's minimiser, for random pairs of edges and ends."""
    generator = torch.Generator().manual_seed(3)
    start = torch.rand(60, 2, 3, dtype=torch.float64, generator=generator) * 4 - 2
    along = torch.nn.functional.normalize(
        torch.rand(60, 2, 3, dtype=torch.float64, generator=generator) - 0.5, dim=-1
    )
    ends = torch.rand(60, 2, 3, dtype=torch.float64, generator=generator) * 8 - 4
    flat = (start.reshape(-1, 3), along.reshape(-1, 3))
    none, zero = torch.zeros(120, dtype=torch.int64), torch.zeros_like(flat[0])
    edges = Edges(
        none, none, none, *flat, zero[:, 0] + 9.0, zero, zero, zero, zero[:, 0] + torch.inf
    )
    t, settled = diffraction._newton(
        edges, torch.zeros(60, 2, dtype=torch.float64), ends[:, 0], ends[:, 1]
    )
    assert bool(settled.all())
    for c in range(60):

        def length(t, c=c):
            x = start[c] + torch.tensor(t)[:, None] * along[c]
            line = torch.cat([ends[c, :1], x, ends[c, 1:]])
            return float((line[1:] - line[:-1]).norm(dim=-1).sum())

        best = minimize(
            length, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 0}
        )
        assert length(t[c].tolist()) <= best.fun + 1e-9
