"""The page in a browser: what a session holds, drawn by viser, and hands that edit it.

viser calls back from threads of its own, and the session from its solver's; one lock keeps the drawing
whole. What the scene is, and what it answers, is the session's alone: nothing here is state.
"""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import viser
from numpy import ndarray
from viser import transforms

from rfsg.objects.plain import array
from rfsg.scene.pose import Pose
from rfsg.scene.scene import SceneError
from rfsg.view.guard import guarded
from rfsg.view.panel import Panel
from rfsg.view.picture import Picture
from rfsg.view.session import Session

HOST = "127.0.0.1"


class Page:
    """Serves a session on this machine alone, until ``close``. port: 0 takes a free one."""

    def __init__(self, session: Session, port: int = 8080, title: str = "rfsg"):
        self.session = session
        self._lock = threading.RLock()
        self._closed = False
        self.server = guarded(
            lambda: viser.ViserServer(host=HOST, port=port or free_port(), verbose=False)
        )
        self.server.gui.configure_theme(
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(31, 111, 178),
        )
        self.server.gui.set_panel_label(title)
        self.picture = Picture(self.server, self._clicked)
        self.panel = Panel(self.server, session, self._act, self.draw)
        self.picture.look_from(session.scene)
        self._gizmo: Any = None
        session.changed = self.draw_answer
        self.draw()

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop serving."""
        with self._lock:  # an answer may be on its way
            self.session.changed = lambda: None
            self._closed = True
            self.server.stop()

    def refresh(self) -> None:
        """Take over what others edited on the stage (``Session.refresh``), and show it."""
        with self._lock:
            try:
                changed = self.session.refresh()
            except (SceneError, OSError) as error:
                self.panel.tell(str(error))
                return
            if changed:
                self.panel.tell("the scene was changed elsewhere: this is how it stands now")
                self.draw()

    def draw(self) -> None:
        """Everything anew: after an edit."""
        with self._lock:
            self.picture.draw_scene(self.session, self.panel.walls.value)
            self._hold()
            self.draw_answer()

    def draw_answer(self) -> None:
        """What the simulation says, and the panel: after an answer."""
        with self._lock, self.server.atomic():
            if self._closed:
                return
            self.picture.draw_paths(self.session, self.panel.shown(), self.panel.every_link.value)
            self.picture.draw_map(self.session, self.panel.opacity.value)
            self.panel.refresh(self.picture.range_db, self.picture.map_range)

    def _clicked(self, path: str) -> None:
        self._act(lambda: self.session.select(path))

    def _act(self, edit: Callable[[], Any]) -> None:
        """Do an edit and show it; what it refuses is told, not raised into a server's thread."""
        with self._lock:
            try:
                said = edit()
            except (SceneError, KeyError, OSError, ValueError) as error:
                self.panel.tell(str(error))
            else:
                self.panel.tell(said if isinstance(said, str) else "")
            self.draw()

    # the gizmo, on what is selected

    def _hold(self) -> None:
        path = self.session.selected
        if self._gizmo is not None and (path is None or self._gizmo.name != f"/gizmo{path}"):
            self._gizmo.remove()
            self._gizmo = None
        if path is None:
            return
        position, wxyz = place(self.session.pose(path))
        if self._gizmo is not None:
            self._gizmo.position, self._gizmo.wxyz = position, wxyz
            return
        gizmo = self.server.scene.add_transform_controls(
            f"/gizmo{path}",
            scale=0.7,
            line_width=4.0,
            depth_test=False,
            position=position,
            wxyz=wxyz,
        )
        self._gizmo = gizmo

        @gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:  # async: in the order of the hand
            self._dragged(path, event)

    def _dragged(self, path: str, event: viser.TransformControlsEvent) -> None:
        held = event.target
        with self._lock:
            if event.phase == "end":
                self.session.release()
                self.draw()
            elif self.session.selected == path:
                old = self.session.pose(path)
                pose = pose_at(held.position, held.wxyz, old)
                self.session.drag(path, pose)
                self.picture.place(path, pose)
                self.panel.show_place(pose)


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    import socket

    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


def place(pose: Pose) -> tuple[ndarray, ndarray]:
    """(position, quaternion) of a pose, a mirror left out."""
    rotation = array(pose.rotation)
    if np.linalg.det(rotation) < 0:
        rotation = rotation * np.array([-1.0, 1.0, 1.0])
    return array(pose.translation), transforms.SO3.from_matrix(rotation).wxyz


def pose_at(position: Any, wxyz: Any, old: Pose) -> Pose:
    """The pose of a gizmo, with the size and the mirror of what it holds."""
    # a quaternion over the wire is not quite a unit one, and a pose's rotation is orthonormal
    quaternion = np.asarray(wxyz, np.float64)
    quaternion = quaternion / np.linalg.norm(quaternion)
    rotation = transforms.SO3(quaternion).as_matrix()
    if np.linalg.det(array(old.rotation)) < 0:
        rotation = rotation * np.array([-1.0, 1.0, 1.0])
    if np.allclose(rotation, array(old.rotation), atol=1e-9):
        rotation = array(old.rotation)
    translation = np.asarray(position, np.float64)
    return Pose(torch.tensor(rotation), torch.tensor(translation), old.scale)
