"""How a scene's objects look on the page: meshes, colours, and which are walls to be seen through."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.objects.contract import Shape
from rfsg.objects.plain import array
from rfsg.objects.shapes.shown import shown_mesh
from rfsg.scene.colours import srgb
from rfsg.scene.export import color_of
from rfsg.scene.materials import material_of
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene

WALL = 0.3  # of the scene's longest side: an object as long hides what stands behind it
SHELL = 0.15  # the same for one that is outermost: a piece of an outer wall
TOUCH = 1e-6  # [m] within which it is outermost
FLAT = 0.1  # a wall that is this thin, of its longest side, and lies below everything is the floor
LEARNED = (0.23, 0.37, 0.5)  # linear RGB of objects whose surface is learned
CLEAR = 0.35  # opacity of glass


@dataclass(frozen=True)
class Look:
    """A node's mesh in its own frame [m], where it is drawn, and how. wall: large, so that it is drawn
    to be seen through and does not catch clicks that are meant for what stands behind it."""

    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "t 3"]
    color: tuple[int, int, int]
    opacity: float
    wall: bool


class Looks:
    """Looks of nodes; a mesh is extracted once for each shape."""

    def __init__(self) -> None:
        self._meshes: dict[int, tuple[Shape, ndarray, ndarray] | None] = {}

    def of(self, scene: Scene) -> dict[str, Look]:
        """By prim path; shapes without a surface to draw (half-spaces) are left out."""
        low, high = extent(scene)
        looks = {}
        for node in scene.nodes:
            mesh = self._mesh(node.body.shape)
            if mesh is None:
                continue
            wall, floor = _role(node, low, high)
            see_through = CLEAR if _is_glass(node) else 1.0
            color = _color(node)
            looks[node.path] = Look(*mesh, color, see_through, wall and not floor)
        return looks

    def _mesh(self, shape: Shape) -> tuple[ndarray, ndarray] | None:
        if id(shape) not in self._meshes:
            try:
                vertices, faces, _ = shown_mesh(shape)
                self._meshes[id(shape)] = (shape, vertices, faces)  # held: its id stays its own
            except ValueError:
                self._meshes[id(shape)] = None
        found = self._meshes[id(shape)]
        return None if found is None else found[1:]


def drawn(pose: Pose, vertices: ndarray, faces: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """(rotation, vertices, faces) that draw a mesh at a pose by a proper rotation: the size, and a
    mirror if there is one, go into the mesh."""
    rotation, size = array(pose.rotation), float(pose.scale.detach())
    if np.linalg.det(rotation) > 0:
        return rotation, size * vertices, faces
    flip = np.array([-1.0, 1.0, 1.0])
    return rotation * flip, size * vertices * flip, faces[:, ::-1]


def extent(scene: Scene) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    """Corners of the box about all objects that have an end, and all radios [m]."""
    corners = [array(r.position)[None] for r in (*scene.transmitters, *scene.receivers)]
    corners += [_corners(node) for node in scene.nodes if _has_end(node)]
    if not corners:
        return np.zeros(3), np.ones(3)
    every = np.concatenate(corners)
    return every.min(axis=0), every.max(axis=0)


def _has_end(node: Node) -> bool:
    return bool(node.body.shape.bounds().isfinite().all())


def _corners(node: Node) -> Float[ndarray, "8 3"]:
    low, high = node.body.shape.bounds().detach().double()
    pick = np.array([[(i >> k) & 1 for k in range(3)] for i in range(8)])
    corner = np.where(pick == 1, array(high), array(low))
    size, turn = float(node.pose.scale.detach()), array(node.pose.rotation)
    return size * corner @ turn.T + array(node.pose.translation)


def _role(node: Node, low: ndarray, high: ndarray) -> tuple[bool, bool]:
    """(is it a wall, is it the floor)."""
    corner = _corners(node)
    side = np.ptp(corner, axis=0)
    room = high - low
    long = side.max() >= WALL * room.max()
    outermost = (corner.min(axis=0) <= low + TOUCH)[:2].any() or (
        corner.max(axis=0) >= high - TOUCH
    ).any()
    shell = bool(outermost) and side.max() >= SHELL * room.max()
    flat = side[2] <= FLAT * side.max() and side[2] <= FLAT * room.max()
    floor = flat and long and corner[:, 2].max() <= low[2] + max(side[2], FLAT * room[2]) + 1e-6
    return bool(long or shell), bool(floor)


def _color(node: Node) -> tuple[int, int, int]:
    material = material_of(node.body.surface)
    return srgb(LEARNED if material is None else color_of(node.body))


def _is_glass(node: Node) -> bool:
    material = material_of(node.body.surface)
    return material is not None and material.look()[1] < 1.0
