"""How objects are drawn: where they stand, which are walls, what has no end."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import HalfSpace
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene
from rfsg.view.page import place, pose_at
from rfsg.view.shapes import Looks, drawn, extent
from tests.scenes import box_node, radio, room_nodes

MIRROR = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))


def poses():
    plain = replace(Pose.at(1.0, -2.0, 0.5, 35.0), scale=torch.tensor(1.7, dtype=torch.float64))
    return [plain, replace(plain, rotation=plain.rotation @ MIRROR)]


@pytest.mark.parametrize("pose", poses(), ids=["turned", "mirrored"])
def test_a_mesh_is_drawn_where_its_pose_puts_it(pose):
    points = np.random.default_rng(0).normal(size=(5, 3))
    faces = np.array([[0, 1, 2], [2, 3, 4]])
    rotation, vertices, turned = drawn(pose, points, faces)
    assert np.linalg.det(rotation) == pytest.approx(1.0)  # what a viewer can turn by
    shown = vertices @ rotation.T + pose.translation.numpy()
    assert np.allclose(shown, pose.point_world(torch.tensor(points)).numpy(), atol=1e-12)
    # outsides stay outsides: a mirror turns the winding round
    flipped = bool(torch.linalg.det(pose.rotation) < 0)
    assert (turned == (faces[:, ::-1] if flipped else faces)).all()


@pytest.mark.parametrize("pose", poses(), ids=["turned", "mirrored"])
def test_a_gizmo_gives_back_the_pose_it_was_given(pose):
    position, wxyz = place(pose)
    again = pose_at(position, wxyz * 1.001, pose)  # over the wire it is not quite a unit
    assert torch.equal(again.rotation, pose.rotation)  # the same to the bit
    assert torch.allclose(again.translation, pose.translation, atol=1e-12)
    assert again.scale is pose.scale


def test_walls_are_walls_the_floor_is_none_and_furniture_is_none():
    desk = box_node("/desk", (3.0, 2.0, 0.4), (0.5, 0.3, 0.4))
    looks = Looks().of(Scene((*room_nodes(), desk)))
    walls = {path for path, look in looks.items() if look.wall}
    assert {"/x0", "/x1", "/y0", "/y1", "/z1"} == walls and "/desk" in looks


def test_what_has_no_end_is_left_out():
    ground = Node("/ground", Body(HalfSpace(), Conductor()), Pose.identity())
    scene = Scene((ground, box_node("/box", (1.0, 2.0, 3.0), (0.5, 0.5, 0.5))))
    assert set(Looks().of(scene)) == {"/box"}
    low, high = extent(scene)
    assert np.allclose(low, [0.5, 1.5, 2.5]) and np.allclose(high, [1.5, 2.5, 3.5])
    assert np.isfinite(extent(Scene())).all()


def test_the_extent_holds_turned_boxes_and_radios():
    scene = Scene(
        (box_node("/box", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), yaw_deg=45.0),),
        (radio("/tx", 0.0, 5.0, 0.0),),
    )
    low, high = extent(scene)
    assert np.allclose(low, [-(2**0.5), -(2**0.5), -1.0])
    assert np.allclose(high, [2**0.5, 5.0, 1.0])


def test_a_mesh_is_made_once_for_a_shape():
    looks, node = Looks(), box_node("/box", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    one = looks.of(Scene((node,)))["/box"].vertices
    moved = replace(node, path="/other", pose=Pose.at(1.0, 0.0, 0.0))
    both = looks.of(Scene((node, moved)))
    assert both["/box"].vertices is both["/other"].vertices is one
