"""Meshes in scenes: the same channel as the boxes that they are, and what only a mesh can be."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.physics.lobes import Scattering
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.mesh import Mesh, extruded
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.radiomap import radio_map
from rfsg.tracer.records import Act
from rfsg.tracer.simulate import Result, simulate
from tests.scenes import box_node, radio, room

FREQUENCY = 2.4e9


def meshed(node: Node) -> Node:
    """The same object, drawn as twelve triangles."""
    x, y, z = node.body.shape.half_size.tolist()
    shape = extruded([(-x, -y), (x, -y), (x, y), (-x, y)], z)
    return replace(node, body=Body(shape, node.body.surface))


def in_both(scene: Scene) -> tuple[Scene, Scene]:
    return scene, replace(scene, nodes=tuple(meshed(n) for n in scene.nodes))


def furnished(surface=None, **options) -> Scene:
    made = room(**options)
    cabinet = box_node("/cabinet", (3.0, 2.0, 0.9), (0.4, 0.3, 0.9), surface or Conductor(), 30.0)
    return replace(made, nodes=(*made.nodes, cabinet))


def paths_by_place(result: Result) -> dict[tuple, torch.Tensor]:
    """Coefficients of paths by link, objects, acts and vertices to 0.1 mm."""
    paths = result.paths
    found = {}
    for i in range(len(paths.tx)):
        place = (paths.vertices[i] * 1e4).round().long().reshape(-1).tolist()
        which, act = paths.which[i].tolist(), paths.act[i].tolist()
        found[(int(paths.tx[i]), int(paths.rx[i]), *which, *act, *place)] = result.channel.gain[i]
    return found


@pytest.mark.parametrize(
    ("quality", "surface"),
    [
        (Quality(depth=3, diffraction=1, diffraction_depth=2), Conductor()),
        (Quality(depth=1, diffraction=2), Slab(0.02, eps_r=4.0, sigma=0.1)),
        (Quality(depth=2), Solid(eps_r=2.2, sigma=0.02)),
    ],
)
def test_a_room_of_meshes_is_the_room_of_boxes(quality, surface):
    """The same paths, reflected, diffracted, refracted, to rounding."""
    a, b = (simulate(s, FREQUENCY, quality=quality) for s in in_both(furnished(surface)))
    ours, theirs = paths_by_place(b), paths_by_place(a)
    assert ours.keys() == theirs.keys() and len(ours) > 30
    for key, gain in theirs.items():
        torch.testing.assert_close(ours[key], gain, rtol=1e-9, atol=0)
    if quality.diffraction:
        assert bool((b.paths.act == int(Act.DIFFRACT)).any())


def test_rays_find_what_the_enumeration_finds():
    scene = in_both(furnished())[1]
    listed, launched = (
        simulate(scene, FREQUENCY, quality=Quality(depth=2, search=search, rays=20_000))
        for search in ("enumerate", "rays")
    )
    assert paths_by_place(launched).keys() == paths_by_place(listed).keys()


def ell() -> list[tuple[float, float]]:
    return [(0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0)]


def around_an_ell(surface) -> tuple[Scene, Scene]:
    """A building of two wings as one mesh, and as two boxes that stand flush."""
    radios = (
        (radio("/t", 2.6, 2.2, 1.2),),
        (
            radio("/into the corner", 1.7, 1.9, 0.8),
            radio("/behind a wing", 2.0, -1.5, 1.0),
            radio("/behind both", -1.2, -0.7, 0.4),
        ),
    )
    lying = box_node("/a", (2.0, 0.5, 0.0), (2.0, 0.5, 1.5), surface)
    standing = box_node("/b", (0.5, 2.0, 0.0), (0.5, 1.0, 1.5), surface)
    one = Node("/a", Body(extruded(ell(), 1.5), surface), Pose.identity())
    return Scene((one,), *radios), Scene((lying, standing), *radios)


@pytest.mark.parametrize("frequency", [FREQUENCY, 28e9])
def test_an_ell_is_two_flush_boxes(frequency):
    """Over its inner corner it reflects once, twice, and hides what is behind; its inner edge
    does not diffract, its outer ones do."""
    quality = Quality(depth=2, diffraction=1, diffraction_depth=2)
    one, two = (simulate(s, frequency, quality=quality) for s in around_an_ell(Conductor()))
    assert not one.scene.nodes[0].body.shape.convex
    acts = [[a for a, w in zip(*rows, strict=True) if w >= 0]
            for rows in zip(one.paths.act.tolist(), one.paths.which.tolist(), strict=True)]  # fmt: skip
    assert [int(Act.REFLECT)] * 2 in acts and [int(Act.DIFFRACT)] in acts
    direct = (one.paths.which < 0).all(1)
    assert one.paths.rx[direct].tolist() == [0]
    torch.testing.assert_close(one.transfer(), two.transfer(), rtol=1e-9, atol=0)
    assert len(one.paths.tx) == len(two.paths.tx)


def test_a_hollow_is_crossed_twice():
    """Straight through both arms of a U, a wave goes through two slabs and the air between."""
    wall = Slab(0.1, eps_r=4.0, sigma=0.02)
    outline = [(0, 0), (3, 0), (3, 2), (2.9, 2), (2.9, 0.1), (0.1, 0.1), (0.1, 2), (0, 2)]
    u = Node(
        "/u", Body(extruded([(float(x), float(y)) for x, y in outline], 1.0), wall), Pose.identity()
    )
    arms = [
        box_node(f"/{k}", (x, 1.0, 0.0), (0.05, 1.0, 1.0), wall) for k, x in ((0, 0.05), (1, 2.95))
    ]
    radios = ((radio("/t", -1.0, 1.2, 0.1),), (radio("/r", 4.0, 0.9, 0.2),))
    got = [
        simulate(Scene(nodes, *radios), FREQUENCY, quality=Quality(depth=0)).transfer()
        for nodes in ((u,), tuple(arms))
    ]
    torch.testing.assert_close(*got, rtol=1e-9, atol=0)


@pytest.mark.parametrize("apex_deg", [40.0, 60.0])
def test_a_prism_of_any_angle_deviates_by_snells_law(apex_deg):
    """Least deviation D of a prism of angle A: n sin(A / 2) = sin((A + D) / 2) (Born and Wolf,
    section 4.7.2)."""
    n, apex, height = 1.5, math.radians(apex_deg), 2.0
    wide = height * math.tan(apex / 2)
    body = Body(extruded([(-wide, 0.0), (wide, 0.0), (0.0, height)], 3.0), Solid(eps_r=n * n))
    turn = math.asin(n * math.sin(apex / 2)) - apex / 2  # half of D
    level = 0.8
    face = (height - level) * math.tan(apex / 2)
    tx = np.array([-face, level, 0.0]) - 1.5 * np.array([math.cos(turn), math.sin(turn), 0.0])
    scene = Scene(
        (Node("/p", body, Pose.identity()),),
        (radio("/t", *tx),),
        (radio("/r", *(tx * [-1, 1, 1])),),
    )
    result = simulate(scene, 30e9, quality=Quality(depth=0, diffraction=0))
    k = int((result.paths.vertices[:, 1, 1] - level).abs().argmin())
    expected = torch.tensor([[-face, level, 0.0], [face, level, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(result.paths.vertices[k, 1:3], expected, rtol=0, atol=1e-8)
    bent = -float(result.channel.departure[k] @ result.channel.arrival[k])
    assert math.acos(bent) == pytest.approx(2 * turn, rel=1e-7)


def test_diffuse_power_of_a_rough_mesh():
    """Tiles laid by lines, about two boxes in one; against the planar tiles of the boxes."""
    surface = DielectricHalfSpace(eps_r=5.24, sigma=0.05, scattering=Scattering(0.8))
    quality = Quality(depth=1, diffuse=12, diffraction=0, floor_db=-300.0)
    totals = []
    for scene in around_an_ell(surface):
        result = simulate(scene, FREQUENCY, quality=quality)
        rough = (result.paths.act == int(Act.SCATTER)).any(1)
        power = torch.zeros(3, dtype=torch.float64)
        power.index_add_(0, result.paths.rx[rough], result.channel.gain[rough, 0].abs() ** 2)
        totals.append(power[0])
    assert float(totals[0]) == pytest.approx(float(totals[1]), rel=0.02)


def test_a_map_of_meshes_is_that_of_boxes():
    quality = Quality(depth=1, map_rays=2_000)
    got = [
        radio_map(s, FREQUENCY, height=1.0, cell=0.5, quality=quality).path_gain
        for s in in_both(furnished())
    ]
    lit = got[1] > 0
    assert bool((lit == (got[0] > 0)).all()) and bool(lit.any())
    torch.testing.assert_close(got[0][lit], got[1][lit], rtol=1e-6, atol=0)


def test_gain_by_vertex_of_a_mesh():
    """A mirror that is moved by its vertices, against differences, and against its pose."""
    mesh = extruded([(-0.5, -0.4), (0.5, -0.4), (0.5, 0.4), (-0.5, 0.4)], 0.6)
    radios = (radio("/t", 1.5, 2.0, 0.1),), (radio("/r", -1.3, 2.4, -0.2),)
    scene = Scene((Node("/m", Body(mesh, Conductor()), Pose.identity()),), *radios)
    mesh.vertices.requires_grad_(True)

    def real_part():
        return simulate(scene, 1e9, quality=Quality(depth=1), gradients=True).transfer().real.sum()

    (slope,) = torch.autograd.grad(real_part(), mesh.vertices)
    step = 1e-6
    with torch.no_grad():
        mesh.vertices[:, 1] += step
        up = real_part()
        mesh.vertices[:, 1] -= 2 * step
        down = real_part()
        mesh.vertices[:, 1] += step
    assert float(slope[:, 1].sum()) == pytest.approx(float((up - down) / (2 * step)), rel=1e-6)
    mesh.vertices.requires_grad_(False)


def test_a_round_mesh_is_said_to_be_one():
    """Facets of a tessellated cylinder are mirrors of their own; of a house they are walls."""
    turn = np.linspace(0.0, 2 * math.pi, 40, endpoint=False)
    column = extruded(
        [(float(x), float(y)) for x, y in zip(np.cos(turn), np.sin(turn), strict=True)], 1.0
    )
    radios = (radio("/t", 3.0, 0.0, 0.1),), (radio("/r", 0.0, 3.0, 0.0),)
    for shape, said in (
        (column, True),
        (extruded(ell(), 1.5), False),
        (Box([1.0, 1.0, 1.0]), False),
    ):
        scene = Scene((Node("/it", Body(shape, Conductor()), Pose.at(0, 0, -4)),), *radios)
        result = simulate(scene, FREQUENCY, quality=Quality(depth=1))
        assert any("/it" in w and "round" in w for w in result.warnings) == said
    assert isinstance(column, Mesh)
