"""Planar faces laid out for the search, against each object asked alone."""

import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.scene.world import World
from rfsg.tracer.faces import _box_rectangles, _rectangles, planes_of
from rfsg.tracer.prefixes import Prefixes, visible
from tests.scenes import vector

MIRROR = torch.diag(vector(1.0, -1.0, 1.0))


def world() -> World:
    box = Body(Box([0.3, 0.2, 0.5]), Conductor())
    turned = Pose.at(1.0, 2.0, 0.5, 33.0, 2.0)
    nodes = (
        Node("/ground", Body(HalfSpace(), Conductor()), Pose.at(0.0, 0.0, -1.0)),
        Node("/box", box, turned),
        Node("/twin", box, Pose(turned.rotation @ MIRROR, vector(-3.0, 0.0, 1.0), turned.scale)),
        Node("/ball", Body(Sphere(0.4), Conductor()), Pose.at(0.0, 5.0, 0.0)),
        Node("/post", Body(Cylinder(0.1, 0.7), Conductor()), Pose.at(4.0, 0.0, 0.0, 10.0)),
    )
    return World(Scene(nodes))


def test_every_planar_face_lies_on_its_object():
    scene = world()
    faces = planes_of(scene)
    owners = [0, *[1] * 6, *[2] * 6, 4, 4]
    assert faces.node.tolist() == owners
    assert faces.patch.tolist() == [0, *range(6), *range(6), 0, 1]
    normal, offset, planar = scene.plane(faces.node, faces.patch)
    assert bool(planar.all())
    torch.testing.assert_close(faces.normal, normal)
    torch.testing.assert_close(faces.offset, offset)
    # the middle lies on the surface, where the object itself gives the same normal
    assert float(scene.sdf(faces.node, faces.centre).abs().max()) < 1e-12
    torch.testing.assert_close(scene.normal(faces.node, faces.centre), faces.normal)
    frame = torch.cat([faces.edges, faces.normal[:, None]], 1)
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3).double().expand(len(faces), 3, 3))


def test_corners_of_boxes_are_theirs():
    scene = world()
    faces = planes_of(scene)
    boxes = (faces.node == 1) | (faces.node == 2)
    corner = faces.corners()[boxes].reshape(-1, 3)
    local = scene.point_object(faces.node[boxes].repeat_interleave(4), corner).abs()
    torch.testing.assert_close(local, vector(0.3, 0.2, 0.5).expand_as(local))
    assert bool(torch.isinf(faces.half[0]).all())
    torch.testing.assert_close(faces.half[-1], vector(0.1, 0.1))  # the cap within its bounds


def test_no_planar_faces():
    assert len(planes_of(World(Scene()))) == 0
    ball = Node("/ball", Body(Sphere(1.0), Conductor()), Pose.identity())
    assert len(planes_of(World(Scene((ball,))))) == 0


def test_which_faces_may_come_next_against_a_plain_loop():
    scene = world()
    faces = planes_of(scene)
    generator = torch.Generator().manual_seed(1)
    last = torch.randint(len(faces), (40, 2), generator=generator)
    found = visible(faces, Prefixes(torch.zeros(40, 3, dtype=torch.float64), last))
    corners = faces.corners()
    for row, k in enumerate(last[:, 1].tolist()):
        for face in range(len(faces)):
            highest = float((corners[face] @ faces.normal[k] - faces.offset[k]).max())
            if face == k or abs(highest) > 1e-9:  # faces that share an edge: as rounding has it
                assert bool(found[row, face]) == (face != k and highest > 0)


def test_boxes_are_laid_out_together_as_each_alone():
    shapes = {k: Box([0.1 + k, 0.2, 3.0 - k]) for k in range(3)} | {7: Sphere(1.0)}
    found = _box_rectangles(shapes)
    assert list(found) == [0, 1, 2]
    for key, columns in found.items():
        for together, alone in zip(columns, _rectangles(shapes[key]), strict=True):
            assert torch.equal(together, alone)
