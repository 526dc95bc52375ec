"""Solids as surfaces: layers between parallel planes, half-spaces and straight passes elsewhere; files."""

import math

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.contract import Contact, Crossing
from rfsg.objects.physics import fresnel
from rfsg.objects.shapes.analytic import Box, Capsule, Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.solid import Solid, depth_behind, stretch_of
from rfsg.scene import usd
from rfsg.scene.materials import Material, material_of
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.world import World
from tests.objects.surfaces.surface_scenes import F64, chords, contacts, reverse, through_wall

FREQUENCY = torch.tensor([2.4e9, 28e9], dtype=F64)
MEDIA = [
    {"itu": "concrete"},
    {"itu": "glass"},
    {"eps_r": 1.0},
    {"eps_r": 2.5, "sigma": 0.3},
    {"eps_r": 1e4, "sigma": 1e7},
]


def rows(*values):
    return torch.tensor(values, dtype=F64)


# layers


@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.1])
@pytest.mark.parametrize("medium", MEDIA)
def test_between_parallel_planes_a_solid_is_a_slab(medium, cosine):
    box, crossing = through_wall(0.07, cosine)
    solid, slab = Solid(**medium), Slab(0.07, **medium)
    for answer in ("transmission", "excess_delay"):
        found, expected = (getattr(s, answer)(box, crossing, FREQUENCY) for s in (solid, slab))
        torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-300)
    d = unit_towards(cosine)
    contact = Contact(crossing.start, d, d * rows(-1, 1, 1), crossing.normal_start)
    torch.testing.assert_close(
        solid.reflection(box, contact, FREQUENCY), slab.reflection(box, contact, FREQUENCY)
    )


def unit_towards(cosine):
    return rows([cosine, math.sqrt(1 - cosine**2), 0.0])


def test_how_deep_a_shape_is_behind_its_faces():
    inf = math.inf
    box, cylinder = Box([0.1, 0.2, 0.3]), Cylinder(0.2, 0.45)
    faces = torch.arange(6)
    torch.testing.assert_close(depth_behind(box, faces), rows(0.2, 0.2, 0.4, 0.4, 0.6, 0.6))
    torch.testing.assert_close(depth_behind(cylinder, faces[:3]), rows(0.9, 0.9, inf))
    for shape, patches in ((Sphere(1.0), faces[:1]), (HalfSpace(), faces[:1])):
        assert bool(torch.isinf(depth_behind(shape, patches)).all())


def test_round_faces_reflect_as_half_spaces():
    """Also at a ball's poles, whose opposite normals are antiparallel: they are no planes."""
    shape, contact = contacts(50)
    solid = Solid(eps_r=4.0, sigma=0.1)
    cosine = (contact.incoming * contact.normal).sum(-1).abs()[:, None]
    expected = torch.stack(fresnel.interface(cosine, solid.medium.permittivity(FREQUENCY)), -1)
    found = solid.reflection(shape, contact, FREQUENCY)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("shape", [Sphere(0.5), Capsule(0.5, 0.3), Cylinder(0.5, 1.0)])
def test_round_faces_are_no_layer_even_through_the_middle(shape):
    """A half-wave ball is not the half-wave plate of its diameter: that one passes everything."""
    end = rows([0.5, 0.0, 0.0])
    crossing = Crossing(-end, end, -2 * end, 2 * end)
    assert not bool(stretch_of(shape, crossing).parallel.any())
    f = rows(fresnel.SPEED_OF_LIGHT / 2.0 / 2.0 * 7)  # seven half waves of n = 2 in a metre
    t = Solid(eps_r=4.0).transmission(shape, crossing, f)
    assert t.abs().squeeze().tolist() == pytest.approx([8 / 9, 8 / 9], rel=1e-12)  # 4 n / (n + 1)^2
    plate = Solid(eps_r=4.0).transmission(Box([0.5, 1.0, 1.0]), crossing, f)
    assert plate.abs().squeeze().tolist() == pytest.approx([1.0, 1.0], rel=1e-9)


def test_scale_is_physical_and_so_is_thickness():
    """A solid shown at twice its size is twice as thick, to all that asks the world."""
    doubled = Node("/w", Body(Box([0.05, 1, 1]), Solid(itu="brick")), Pose.at(0, 0, 0, 0.0, 2.0))
    built = Node("/w", Body(Box([0.1, 2, 2]), Solid(itu="brick")), Pose.identity())
    slab = Node("/w", Body(Box([0.1, 2, 2]), Slab(0.2, itu="brick")), Pose.identity())
    d = unit_towards(0.8)
    start, end = rows([-0.1, 0.0, 0.0]), rows([-0.1, 0.0, 0.0]) + 0.25 * d
    x = rows([1.0, 0.0, 0.0])
    answers = []
    for node in (doubled, built, slab):
        world, which = World(Scene((node,))), torch.zeros(1, dtype=torch.int64)
        crossing, contact = Crossing(start, end, -x, x), Contact(start, d, d * rows(-1, 1, 1), -x)
        answers.append(
            (
                world.transmission(which, crossing, FREQUENCY[:1]),
                world.reflection(which, contact, FREQUENCY[:1]),
                world.excess_delay(which, crossing, FREQUENCY[:1]),
            )
        )
    for other in answers[1:]:
        for a, b in zip(answers[0], other, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-11, atol=0)
    # a curved one, too: the way through is longer
    ball = Node("/b", Body(Sphere(0.5), Solid(eps_r=2.0, sigma=0.1)), Pose.at(0, 0, 0, 0.0, 3.0))
    big = Node("/b", Body(Sphere(1.5), Solid(eps_r=2.0, sigma=0.1)), Pose.identity())
    crossing = Crossing(-1.5 * x, 1.5 * x, -x, x)
    a, b = (
        World(Scene((n,))).transmission(torch.zeros(1, dtype=torch.int64), crossing, FREQUENCY)
        for n in (ball, big)
    )
    torch.testing.assert_close(a, b, rtol=1e-11, atol=0)


# laws of straight passes


@pytest.mark.parametrize("medium", MEDIA)
def test_passive_and_reciprocal(medium):
    solid = Solid(**medium)
    shape, crossing = chords(2000)
    t = solid.transmission(shape, crossing, FREQUENCY)
    assert bool(torch.isfinite(t).all()) and float(t.abs().max()) <= 1 + 1e-12
    torch.testing.assert_close(
        solid.transmission(shape, reverse(crossing), FREQUENCY), t, rtol=1e-12, atol=1e-300
    )
    shape, contact = contacts(2000)
    assert float(solid.reflection(shape, contact, FREQUENCY).abs().max()) <= 1 + 1e-12


def test_a_face_passes_what_it_does_not_reflect():
    solid = Solid(eps_r=3.0)
    cosine = torch.linspace(0, 1, 101, dtype=F64)
    passed = solid.face(cosine, FREQUENCY).abs() ** 2
    eps = solid.medium.permittivity(FREQUENCY)
    reflected = torch.stack(fresnel.interface(cosine[:, None], eps), -1).abs() ** 2
    torch.testing.assert_close(passed + reflected, torch.ones_like(passed), rtol=0, atol=1e-12)


@pytest.mark.parametrize("sigma", [0.5, 5.0, 500.0])
def test_a_face_of_a_lossy_solid_passes_no_more_than_all(sigma):
    """sqrt(1 - R^2), and where that would amplify, its phase alone."""
    lossy = Solid(eps_r=3.0, sigma=sigma)
    cosine = torch.linspace(0, 1, 101, dtype=F64)
    r = torch.stack(fresnel.interface(cosine[:, None], lossy.medium.permittivity(FREQUENCY)), -1)
    square, passed = 1 - r**2, lossy.face(cosine, FREQUENCY)
    assert float(square.abs().max()) > 1.001  # the case is among them
    torch.testing.assert_close(
        passed**2, square / square.abs().clamp(min=1.0), rtol=1e-9, atol=1e-9
    )
    assert float(passed.abs().max()) <= 1 + 1e-12


def test_a_solid_of_vacuum_is_not_there():
    shape, crossing = chords(100)
    t = Solid(eps_r=1.0).transmission(shape, crossing, FREQUENCY)
    torch.testing.assert_close(t, torch.ones_like(t), rtol=0, atol=1e-12)
    delay = Solid(eps_r=1.0).excess_delay(shape, crossing, FREQUENCY)
    assert float(delay.abs().max()) == 0.0


@pytest.mark.parametrize("medium", [{"itu": "wood"}, {"eps_r": 4.0, "sigma": 0.05}])
def test_delay_inside_is_the_slope_of_the_phase(medium):
    """Dispersion included: -(1 / 2 pi) d arg / df of exp(-j k (n_c - 1) L)."""
    solid, length, f = Solid(**medium), rows(0.4), 6e9
    h = 1e4
    low, high = solid.inside(length, rows(f - h, f + h))[0]
    slope = -float((high / low).angle()) / (4 * math.pi * h)
    assert float(solid.inside_delay(length, rows(f))) == pytest.approx(slope, rel=1e-6)


def test_an_end_inside_is_matched_to_the_medium():
    """Two ends inside: Friis' law of the medium, 1 / n of the free-space amplitude."""
    shape, crossing = chords(20)
    none = torch.zeros_like(crossing.normal_start)
    inside = Crossing(crossing.start, crossing.end, none, none)
    t = Solid(eps_r=6.25).transmission(shape, inside, FREQUENCY)
    torch.testing.assert_close(t.abs(), torch.full_like(t.abs(), 0.4))


def test_nothing_comes_through_a_thick_loss_and_nothing_breaks():
    """A kilometre of sea: T underflows to 0, delays and gradients stay finite; yet it is not opaque."""
    solid = Solid(eps_r=80.0, sigma=4.0)
    for p in solid.parameters():
        p.requires_grad_(True)
    assert not solid.opaque
    for shape, crossing in (chords(5, radius=1e3), through_wall(1e3, 0.5)):
        t = solid.transmission(shape, crossing, FREQUENCY)
        delay = solid.excess_delay(shape, crossing, FREQUENCY)
        assert float(t.detach().abs().max()) == 0.0
        assert bool(torch.isfinite(delay).all())
        total = t.abs().sum() + t.real.sum() + 1e9 * delay.sum()
        gradients = torch.autograd.grad(total, list(solid.parameters()), allow_unused=True)
        assert all(g is None or bool(torch.isfinite(g).all()) for g in gradients)


def test_gradients():
    """Ends of the crossing, permittivity and conductivity, of passes and layers alike."""
    layer = through_wall(0.05, 0.6)
    shape, crossing = chords(3)

    def run(start, end, eps_r, sigma, shape, normals):
        solid = Solid(eps_r=1.0)
        del solid.medium.eps_r, solid.medium.sigma
        solid.medium.eps_r, solid.medium.sigma = eps_r, sigma
        stretch = Crossing(start, end, *normals)
        t = solid.transmission(shape, stretch, FREQUENCY[:1])
        return torch.view_as_real(t), 1e9 * solid.excess_delay(shape, stretch, FREQUENCY[:1])

    for s, c in ((shape, crossing), layer):
        normals = (c.normal_start, c.normal_end)
        inputs = (c.start, c.end, torch.tensor(3.0, dtype=F64), torch.tensor(0.2, dtype=F64))
        inputs = tuple(x.clone().requires_grad_(True) for x in inputs)

        def flat(*x, s=s, normals=normals):
            return run(*x, s, normals)

        assert torch.autograd.gradcheck(flat, inputs, eps=1e-7, atol=1e-4, rtol=1e-4)


def test_gradients_are_finite_at_grazing_incidence():
    solid = Solid(eps_r=2.0)
    cosine = rows(0.0, 1e-12, 1.0).requires_grad_(True)
    solid.face(cosine, FREQUENCY).abs().sum().backward()
    assert bool(torch.isfinite(cosine.grad).all())


def test_single_precision_points_give_single_precision_answers():
    shape, crossing = chords(4)
    narrow = Crossing(*(x.float() for x in vars(crossing).values()))
    assert Solid(eps_r=2.0).transmission(shape, narrow, FREQUENCY).dtype == torch.complex64
    assert Solid(eps_r=2.0).excess_delay(shape, narrow, FREQUENCY).dtype == torch.float32


# files


def test_solids_are_written_and_read(tmp_path):
    bodies = (
        Body(Sphere(0.4), Solid(itu="glass")),
        Body(Box([0.1, 1.0, 2.0]), Solid(eps_r=3.5, sigma=0.02)),
        Body(
            Cylinder(0.2, 0.5), Solid(itu="wood", extrapolate=True, scattering={"coefficient": 0.3})
        ),
    )
    nodes = tuple(Node(f"/World/n{k}", b, Pose.at(k, 0, 0)) for k, b in enumerate(bodies))
    again = usd.read(usd.write(Scene(nodes), tmp_path / "scene.usda"))
    for node, body in zip(again.nodes, bodies, strict=True):
        assert node.body.surface.kind == "solid"
        assert node.body.surface.config() == body.surface.config()
        assert node.body.shape.config() == body.shape.config()
    text = (tmp_path / "scene.usda").read_text()
    assert 'rfsg:material:model = "solid"' in text and "thickness" not in text


def test_material_of_a_solid():
    solid = Solid(eps_r=2.0, sigma=0.1)
    material = material_of(solid)
    assert material == Material("solid", eps_r=2.0, sigma=0.1)
    assert material.surface().config() == solid.config()


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ("", "model solid needs itu, or epsR and sigma"),
        ("custom double rfsg:material:thickness = 0.1", "model solid is as thick as its shape"),
        ('custom token rfsg:material:itu = "cheese"', "cheese"),
        ("custom double rfsg:material:epsR = 0.5", "eps_r"),
    ],
)
def test_check_says_what_is_amiss_with_a_solid(tmp_path, more, expected):
    given = more if not more or "itu" in more or "epsR" in more else more + GLASS
    path = tmp_path / "scene.usda"
    path.write_text(SCENE.format(more=given))
    with pytest.raises(SceneError) as error:
        usd.read(path)
    assert expected in str(error.value) and "/World/Ball" in str(error.value)


def test_the_command_line_simulates_a_solid(tmp_path):
    from rfsg import cli

    path = tmp_path / "scene.usda"
    path.write_text(SCENE.format(more=GLASS))
    out = tmp_path / "out"
    assert cli.run(["check", str(path)]) == 0
    assert cli.run(["simulate", str(path), "--out", str(out), "--set", "diffraction=0"]) == 0
    assert "refraction in solids" in (out / "report.json").read_text()
    paths = (out / "paths.csv").read_text()
    assert "refraction_in(/World/Ball)" in paths and "refraction_out(/World/Ball)" in paths


GLASS = '\n        custom token rfsg:material:itu = "glass"'
SCENE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{{
    custom double rfsg:frequencyHz = 5000000000
    def Sphere "Ball"
    {{
        double radius = 0.3
        custom token rfsg:material:model = "solid"
        {more}
    }}
    def Xform "tx"
    {{
        custom token rfsg:radio:role = "tx"
        double3 xformOp:translate = (-2, 0, 0.1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Xform "rx"
    {{
        custom token rfsg:radio:role = "rx"
        double3 xformOp:translate = (2, 0.1, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"""
