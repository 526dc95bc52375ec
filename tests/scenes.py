"""Small scenes that many tests share."""

import torch
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene

ROOM = (6.0, 4.0, 3.0)


def vector(*xyz: float) -> Tensor:
    return torch.tensor(xyz, dtype=torch.float64)


def radio(path: str, *xyz: float, **options) -> Radio:
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    return Radio(path, vector(*xyz), options.pop("rotation", eye), zero, **options)


def concrete(thickness: float = 0.2) -> Slab:
    return Slab(thickness_m=thickness, eps_r=5.24, sigma=0.05)


def box_node(path: str, centre, half, surface=None, yaw_deg: float = 0.0) -> Node:
    return Node(path, Body(Box(half), surface or concrete()), Pose.at(*centre, yaw_deg))


def room_nodes(size=ROOM, wall: float = 0.1) -> tuple[Node, ...]:
    """Six slabs about an empty room whose inner faces lie at 0 and at ``size``."""
    nodes = []
    for axis, name in enumerate("xyz"):
        for side in (0, 1):
            centre = [s / 2 for s in size]
            half = [s / 2 for s in size]
            half[axis] = wall
            centre[axis] = size[axis] + wall if side else -wall
            nodes.append(box_node(f"/{name}{side}", centre, half))
    return tuple(nodes)


RECEIVERS = ((1.03, 1.21, 1.07), (5.17, 3.13, 2.29), (3.31, 0.71, 1.93), (4.47, 2.53, 0.41))


def room(receivers=RECEIVERS, transmitter=(1.31, 2.11, 1.73)) -> Scene:
    rx = tuple(radio(f"/rx{i}", *p) for i, p in enumerate(receivers))
    return Scene(room_nodes(), (radio("/tx", *transmitter),), rx, 2.4e9)
