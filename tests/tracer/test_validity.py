"""What is refused before it is traced, and what is said with the answer."""

import math
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Capsule, HalfSpace, Sphere
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.errors import SceneError
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.validity import refuse, sentences
from tests.scenes import box_node, concrete, radio, vector

GHZ = torch.tensor([1e9], dtype=torch.float64)
WAVE = 0.299792458  # [m] at 1 GHz
NEAR = WAVE / (2 * math.pi)


def said(nodes, tx=(10.0, 0.0, 0.0), rx=(0.0, 10.0, 0.0), frequency=GHZ) -> tuple[str, ...]:
    scene = Scene(tuple(nodes), (radio("/t", *tx),), (radio("/r", *rx),))
    return sentences(World(scene), frequency)


def refused(node: Node, frequency=GHZ) -> str:
    with pytest.raises(SceneError) as error:
        refuse(World(Scene((node,))), frequency)
    return str(error.value)


def test_nothing_is_said_of_a_scene_within_the_model():
    nodes = [box_node("/wall", (0.0, 0.0, 0.0), (0.05, 2.0, 1.5))]
    nodes += [Node("/ground", Body(HalfSpace(), Conductor()), Pose.at(0, 0, -3.0))]
    assert said(nodes) == ()
    refuse(World(Scene(tuple(nodes))), GHZ)
    assert said([]) == () and sentences(World(Scene()), GHZ) == ()


def test_objects_below_a_wavelength_are_named():
    """Across the second longest side: a wall may be thin, a post may be long."""
    nodes = [
        Node("/ball", Body(Sphere(0.49 * WAVE), Conductor()), Pose.at(0, 0, 0)),
        Node("/post", Body(Capsule(0.02, 2.0), Conductor()), Pose.at(3, 0, 0)),
        Node("/large", Body(Sphere(0.51 * WAVE), Conductor()), Pose.at(6, 0, 0)),
        Node("/grown", Body(Sphere(0.1 * WAVE), Conductor()), Pose.at(9, 9, 0, 0.0, 6.0)),
        box_node("/pane", (0.0, 5.0, 0.0), (0.001, 1.0, 1.0)),
    ]
    (sentence,) = said(nodes, (20.0, 0, 0))
    assert sentence.startswith("/ball, /post: narrower than a wavelength (0.3 m)")
    assert said(nodes, (20.0, 0, 0), frequency=30 * GHZ) == ()
    # of several frequencies the lowest decides
    assert said(nodes, (20.0, 0, 0), frequency=torch.cat([GHZ, 30 * GHZ])) == (sentence,)


def test_many_names_are_cut_short():
    ball = Body(Sphere(0.01), Conductor())
    nodes = [Node(f"/b{i}", ball, Pose.at(i, 0, 0)) for i in range(9)]
    (sentence,) = said(nodes, (-20.0, 0, 0))
    assert "/b0, /b1, /b2, /b3, /b4 and 4 more: " in sentence


def test_radios_in_each_others_near_field():
    assert said([], (0.0, 0, 0), (1.01 * NEAR, 0, 0)) == ()
    (sentence,) = said([], (0.0, 0, 0), (0.99 * NEAR, 0, 0))
    assert sentence.startswith("/t and /r: closer than lambda / 2 pi")
    assert "/t and /r" in said([], (1.0, 0, 0), (1.0, 0, 0))[0]


@pytest.mark.parametrize("gap", [0.99, 1.01])
def test_radios_near_surfaces(gap):
    turned = Pose(
        Pose.at(0, 0, 0, 30.0).rotation @ torch.diag(vector(1, -1, 1)),
        vector(5.0, 1.0, 0.0),
        torch.tensor(2.0, dtype=torch.float64),
    )
    box = Node("/box", Body(Box([0.5, 1.0, 1.0]), concrete()), turned)
    at = turned.point_world(vector(0.5, 0.0, 0.0)) + gap * NEAR * turned.rotation[:, 0]
    found = said([box], tuple(at.tolist()))
    expected = "/t at /box: closer to a surface than lambda / 2 pi"
    assert found == () if gap > 1 else found[0].startswith(expected)
    # off a corner both ways count
    corner = turned.point_world(vector(0.5, 1.0, 0.0))
    away = gap * NEAR * (turned.rotation[:, 0] + turned.rotation[:, 1]) / math.sqrt(2)
    found = said([box], tuple((corner + away).tolist()))
    assert found == () if gap > 1 else found[0].startswith(expected)


def test_radios_inside_objects():
    ground = Node("/ground", Body(HalfSpace(), Conductor()), Pose.identity())
    (sentence,) = said([ground], (10.0, 0, -4.0), (0, 10, 1.0))
    assert sentence.startswith("/t at /ground: inside the object")
    (sentence,) = said([ground], (10.0, 0, 0.0), (0, 10, 1.0))
    assert sentence.startswith("/t at /ground: closer to a surface")


def test_materials_beyond_their_band():
    """P.2040-4 gives concrete from 1 GHz: refused with the prim's name, or said to be extrapolated."""
    low = torch.tensor([0.4e9, 2.4e9], dtype=torch.float64)
    wall = box_node("/World/Wall", (0, 0, 0), (0.1, 2, 2), Slab(0.2, itu="concrete"))
    assert "/World/Wall: concrete: ITU-R P.2040-4 gives it for 1-100 GHz" in refused(wall, low)
    refuse(World(Scene((wall,))), low[1:])
    soft = box_node(
        "/World/Wall", (0, 0, 0), (0.1, 2, 2), DielectricHalfSpace("concrete", extrapolate=True)
    )
    refuse(World(Scene((soft,))), low)
    (sentence,) = said([soft], frequency=low)
    assert sentence.startswith("/World/Wall: concrete at 0.4 GHz is an extrapolation: ITU-R P.2040")
    assert said([soft], frequency=low[1:]) == ()


def test_parameters_that_are_no_numbers_or_no_lengths():
    node = Node("/ball", Body(Sphere(1.0), concrete()), Pose.identity())
    for value, words in ((math.nan, "not finite"), (-1.0, "lengths > 0"), (0.0, "lengths > 0")):
        with torch.no_grad():
            node.body.shape.radius.fill_(value)
        assert "/ball: shape.radius" in refused(node) and words in refused(node)
    wall = box_node("/wall", (0, 0, 0), (1, 1, 1))
    with torch.no_grad():
        wall.body.surface.medium.sigma.fill_(math.inf)
    assert "/wall: surface.medium.sigma holds a number that is not finite" in refused(wall)


def test_learned_shapes_without_a_surface():
    shape = NeuralShape([[-0.5] * 3, [0.5] * 3], width=8, depth=3, skip=1, lipschitz=2.0)
    node = Node("/World/Cabinet", Body(shape, Conductor()), Pose.identity())
    refuse(World(Scene((node,))), GHZ)
    with torch.no_grad():
        shape.to_value.bias += 3.0
    words = "/World/Cabinet: the neural shape has no surface within its bounds: nothing to hit"
    assert words in refused(node)
    with torch.no_grad():
        shape.to_value.bias.fill_(math.nan)
    assert "/World/Cabinet: shape.to_value.bias holds a number that is not finite" in refused(node)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: replace(p, translation=vector(0, math.nan, 0)), "translation is not finite"),
        (lambda p: replace(p, scale=0 * p.scale), "scale is not a finite number > 0"),
        (lambda p: replace(p, scale=-p.scale), "scale is not a finite number > 0"),
        (lambda p: replace(p, rotation=2 * p.rotation), "rotation is not orthonormal"),
        (lambda p: replace(p, rotation=math.nan * p.rotation), "rotation is not orthonormal"),
    ],
)
def test_poses_that_are_none(change, words):
    node = box_node("/wall", (0, 0, 0), (1, 1, 1), yaw_deg=20.0)
    assert f"/wall: pose: {words}" in refused(replace(node, pose=change(node.pose)))
