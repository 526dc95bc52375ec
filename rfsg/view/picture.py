"""The scene in space, drawn by viser: objects, radios, paths coloured by gain, a map."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy import ndarray
from viser import transforms

from rfsg.objects.plain import array
from rfsg.scene.colours import MAP, PATHS, colours
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Scene
from rfsg.tracer.cells import Grid
from rfsg.tracer.drawing import Line
from rfsg.tracer.radiomap import RadioMap
from rfsg.view.session import Session
from rfsg.view.shapes import Look, Looks, drawn, extent
from rfsg.view.words import short

RANGE_DB = 45.0  # below the strongest path; weaker ones are not drawn
MOST_PATHS = 2000  # lines that a browser turns smoothly
TX, RX = (192, 57, 43), (31, 111, 178)
CHOSEN = (245, 166, 35)
RADIO = 0.012  # radius of a radio's ball, of the scene's longest side
LINE = 0.0028  # thickness of a path, alike
PANEL = (
    0.16  # of the scene's size, by which it stands left of the middle: the panel is on the right
)
GRID_BELOW = 0.01  # [m] the grid lies under the floor


class Picture:
    """What is drawn at present. ``clicked`` is called with the path of an object or a radio."""

    def __init__(self, server: viser.ViserServer, clicked: Callable[[str], None]):
        self._scene, self._camera, self._clicked = server.scene, server.initial_camera, clicked
        self._looks = Looks()
        self._drawn: dict[str, _Drawn] = {}
        self._paths: Any = None
        self._map: tuple[Any, float, Any] = (None, 0.0, None)  # of what, how opaque, handle
        self.range_db = (-RANGE_DB, 0.0)
        self.map_range: tuple[float, float] | None = None
        self._scene.set_up_direction("+z")
        self._scene.configure_environment_map(None)
        self._scene.configure_default_lights(cast_shadow=False)
        self._scene.add_light_hemisphere(
            "/light", sky_color=(255, 255, 255), ground_color=(190, 185, 180), intensity=1.6
        )
        self._scene.world_axes.visible = False

    def look_from(self, scene: Scene) -> None:
        """Put the camera where all of a scene is seen, and a grid below it."""
        low, high = extent(scene)
        middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
        back = np.array([-0.42, -0.72, 0.82])
        aside = PANEL * size * np.array([-back[1], back[0], 0.0]) / np.hypot(*back[:2])
        self._camera.look_at = tuple(middle + aside)
        self._camera.position = tuple(middle + aside + size * back)
        self._camera.fov = 0.75
        side = 2.0 * float(np.ceil((high - low)[:2].max()))
        below = (middle[0], middle[1], low[2] - GRID_BELOW)
        self._scene.add_grid(
            "/grid", side, side, cell_size=side / 20, section_size=side / 4, position=below,
            cell_color=(225, 228, 232), section_color=(205, 210, 216), shadow_opacity=0.0,
        )  # fmt: skip

    def place(self, path: str, pose: Pose) -> None:
        """Move what is drawn, while it is dragged."""
        if path in self._drawn:
            rotation = drawn(pose, np.zeros((0, 3)), np.zeros((0, 3), np.int64))[0]
            for handle in self._drawn[path].handles:
                handle.position = array(pose.translation)
                handle.wxyz = transforms.SO3.from_matrix(rotation).wxyz

    def draw_scene(self, session: Session, walls: float) -> None:
        """Objects and radios; what did not change is left as it is. walls: their opacity."""
        scene = session.scene
        things = dict(self._objects(scene, session.selected, walls))
        things |= dict(self._radios(session))
        for path in [p for p in self._drawn if p not in things]:
            self._drawn.pop(path).remove()
        for path, (key, pose, make) in things.items():
            old = self._drawn.get(path)
            if old is None or old.key != key:
                if old is not None:
                    old.remove()
                self._drawn[path] = _Drawn(key, make())
            self.place(path, pose)

    def _objects(self, scene: Scene, selected: str | None, walls: float) -> Iterable[Any]:
        looks = self._looks.of(scene)
        for node in scene.nodes:
            look = looks.get(node.path)
            if look is None:
                continue
            chosen = node.path == selected
            mirror = bool(np.linalg.det(array(node.pose.rotation)) < 0)
            key = (id(look.vertices), float(node.pose.scale), mirror, look.color, look.opacity)
            key += (chosen, walls if look.wall else None)

            def make(node: Any = node, look: Look = look, chosen: bool = chosen) -> list[Any]:
                return [self._object(node.path, node.pose, look, chosen, walls)]

            yield node.path, (key, node.pose, make)

    def _object(self, path: str, pose: Pose, look: Look, chosen: bool, walls: float) -> Any:
        _, vertices, faces = drawn(pose, look.vertices, look.faces)
        opacity = min(look.opacity, walls) if look.wall and not chosen else look.opacity
        handle = self._scene.add_mesh_simple(
            f"/objects{path}", vertices, faces,
            color=CHOSEN if chosen else look.color,
            opacity=None if opacity >= 1.0 else opacity,
            flat_shading=len(faces) <= 12, side="double" if opacity < 1.0 else "front",
            cast_shadow=False, receive_shadow=False, visible=opacity > 0.0,
        )  # fmt: skip
        if not look.wall and not chosen:  # what is chosen leaves clicks to the gizmo in it
            handle.on_click(lambda _: self._clicked(path))
        return handle

    def _radios(self, session: Session) -> Iterable[Any]:
        scene = session.scene
        low, high = extent(scene)
        radius = RADIO * float((high - low).max())
        roles = [(r, TX) for r in scene.transmitters] + [(r, RX) for r in scene.receivers]
        for radio, color in roles:
            named = radio.path in (session.link or ()) or radio in scene.transmitters
            chosen = radio.path == session.selected
            size = radius if named else 0.6 * radius

            def make(
                path: str = radio.path, color: Any = color, named: bool = named,
                chosen: bool = chosen, size: float = size,
            ) -> list[Any]:  # fmt: skip
                name = f"/radios{path}"
                ball = self._scene.add_icosphere(
                    name, size, color=CHOSEN if chosen else color, subdivisions=3,
                    opacity=None if named else 0.55, cast_shadow=False, receive_shadow=False,
                )  # fmt: skip
                if not chosen:
                    ball.on_click(lambda _: self._clicked(path))
                if named:
                    above = (0.0, 0.0, 1.6 * size)
                    self._scene.add_label(
                        f"{name}/label", short(path), position=above, anchor="bottom-center"
                    )
                return [ball]

            pose = Pose(radio.rotation, radio.position, session.pose(radio.path).scale)
            yield radio.path, ((color, named, chosen, size), pose, make)

    def draw_paths(self, session: Session, kinds: set[str], every_link: bool) -> None:
        """The strongest paths of the kinds that are shown, coloured by gain."""
        lines = session.lines(every_link)
        best = max((line.gain_db for line in lines), default=0.0)
        self.range_db = (best - RANGE_DB, best)
        shown = [x for x in lines if x.kind in kinds and x.gain_db > best - RANGE_DB]
        shown = sorted(shown, key=lambda x: x.gain_db)[-MOST_PATHS:]
        if self._paths is not None:
            self._paths.remove()
            self._paths = None
        if shown:
            low, high = extent(session.scene)
            points, paint = segments(shown, self.range_db)
            self._paths = self._scene.add_line_segments(
                "/paths", points, paint, thickness=LINE * float((high - low).max())
            )

    def draw_map(self, session: Session, opacity: float) -> None:
        """The map of a scene at rest, of its best server; nothing for a map on an object."""
        found = session.radio_map
        if self._map[:2] == (found, opacity):
            return
        if self._map[2] is not None:
            self._map[2].remove()
        handle, self.map_range = None, None
        if found is not None and isinstance(found.cells, Grid):
            image, self.map_range = map_image(found, opacity)
            cells = found.cells
            turn = array(cells.plane.rotation)
            middle = np.array([float(cells.x.mean()), float(cells.y.mean()), 0.0])
            # viser's images have their first row at the bottom of -y: its y axis points down
            down = turn @ np.diag([1.0, -1.0, -1.0])
            ny, nx = cells.shape
            handle = self._scene.add_image(
                "/map", image, nx * cells.cell, ny * cells.cell, format="png",
                position=array(cells.plane.translation) + turn @ middle,
                wxyz=transforms.SO3.from_matrix(down).wxyz,
                cast_shadow=False, receive_shadow=False, visible=opacity > 0,
            )  # fmt: skip
        self._map = (found, opacity, handle)


@dataclass
class _Drawn:
    """What stands for an object: made anew when its key changes, else only moved."""

    key: Any
    handles: list[Any]

    def remove(self) -> None:
        for handle in self.handles:
            handle.remove()


def segments(lines: list[Line], range_db: tuple[float, float]) -> tuple[ndarray, ndarray]:
    """Stretches of polylines [n 2 3] m, and their colours [n 2 3]."""
    parts = [np.stack([line.points[:-1], line.points[1:]], axis=1) for line in lines]
    paint = colours(np.array([line.gain_db for line in lines]), *range_db, PATHS)
    paint = np.repeat(paint, [len(p) for p in parts], axis=0)
    return np.concatenate(parts), np.repeat(paint[:, None], 2, axis=1)


def map_image(found: RadioMap, opacity: float) -> tuple[ndarray, tuple[float, float]]:
    """RGBA of the best server's power [dBm], y upwards in the picture, and the ends of its scale."""
    value = array(found.best_dbm())
    heard = np.isfinite(value)
    low, high = np.percentile(value[heard], (1, 99.5)) if heard.any() else (0.0, 1.0)
    paint = colours(np.where(heard, value, low), low, high, MAP)
    alpha = np.where(heard, round(255 * opacity), 0).astype(np.uint8)
    image = np.concatenate([paint, alpha[..., None]], axis=-1)[::-1]
    return np.ascontiguousarray(image), (float(low), float(high))
