"""The panel beside the picture: the link and its numbers, the selected thing, what is shown."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import viser
from viser import uplot

from rfsg.objects.plain import array
from rfsg.scene.colours import MAP, PATHS
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node
from rfsg.tracer.drawing import KINDS
from rfsg.view import words
from rfsg.view.session import Session

NOTHING = "(nothing)"
NO_ASSET = NO_VARIANT = "(choose)"
STEP = 0.001  # [m] of the numbers that say a place
WALLS = 0.16  # opacity of what is large


class Panel:
    """Widgets over a session. ``act`` does an edit and draws anew; ``draw`` only draws."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        act: Callable[[Callable[[], Any]], None],
        draw: Callable[[], None],
    ):
        self._session, self._act, self._draw = session, act, draw
        self._gui = server.gui
        self._variants: dict[tuple[str, str], Any] = {}  # by prim and set: there while they concern
        self.said = ""  # above the panel
        self._writing = False  # values that we set ourselves are no wishes
        gui = server.gui
        self._status = gui.add_markdown("")
        self._told = gui.add_markdown("", visible=False)
        with gui.add_folder("Link"):
            self._build_link(gui)
        self._selected = gui.add_folder("Selected")
        with self._selected:
            self._build_selected(gui)
        with gui.add_folder("Shown", expand_by_default=False):
            self._build_shown(gui)
        with gui.add_folder("What was modelled", expand_by_default=False):
            self._story = gui.add_markdown("")

    def _build_link(self, gui: Any) -> None:
        self._tx = gui.add_dropdown("transmitter", ("-",))
        self._rx = gui.add_dropdown("receiver", ("-",))
        self._numbers = gui.add_markdown("")
        self._scale = gui.add_html("")
        none = np.zeros(1)
        self._delays = gui.add_uplot(
            (none, none),
            (
                uplot.Series(label="delay [ns]"),
                uplot.Series(
                    label="path gain [dB]", stroke="#1f6fb2", width=1.5, points={"show": False}
                ),
            ),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
            axes=(uplot.Axis(label="delay [ns]"), uplot.Axis(label="path gain [dB]")),
            legend=uplot.Legend(show=False),
            height=190,
        )
        for widget in (self._tx, self._rx):
            widget.on_update(self._wish(self._look))

    def _build_selected(self, gui: Any) -> None:
        self._chosen = gui.add_dropdown("object or radio", (NOTHING,))
        self._chosen.on_update(self._wish(self._choose))
        self._place = gui.add_vector3("place [m]", (0.0, 0.0, 0.0), step=STEP)
        self._yaw = gui.add_number("turn about z [deg]", 0.0, step=1.0)
        self._place.on_update(self._wish(self._move))
        self._yaw.on_update(self._wish(self._move))
        library = self._session.library
        names = (NO_ASSET, *(library or ()))
        self._asset = gui.add_dropdown("swap for", names, visible=library is not None)
        self._asset.on_update(self._wish(self._swap))
        edits: dict[str, Callable[[], Any]] = {
            "Duplicate": self._duplicate, "Remove": self._remove, "Undo": self._session.undo,
        }  # fmt: skip
        if self._session.save_to is not None:
            edits["Save edits"] = self._save
        buttons = gui.add_button_group("edit", tuple(edits))
        buttons.on_click(lambda event: self._act(edits[event.target.value]))

    def _build_shown(self, gui: Any) -> None:
        self._kinds = {kind: gui.add_checkbox(kind, True) for kind in reversed(KINDS)}
        self.every_link = gui.add_checkbox("paths of every link", False)
        self.walls = gui.add_slider("walls", 0.0, 1.0, 0.02, WALLS)
        self.opacity = gui.add_slider("radio map", 0.0, 1.0, 0.05, 0.75)
        self._map_scale = gui.add_html("")
        for widget in (*self._kinds.values(), self.every_link, self.walls, self.opacity):
            widget.on_update(self._wish(lambda: self._draw()))

    def _wish(self, act: Callable[[], Any]) -> Callable[[Any], None]:
        """A callback for what somebody chose; not for what we write."""

        def told(event: Any) -> None:
            if event.client is not None and not self._writing:
                self._act(act)

        return told

    # wishes

    def _path(self) -> str:
        path = self._session.selected
        if path is None:
            raise ValueError("nothing is selected: click an object, or choose one in the list")
        return path

    def _look(self) -> None:
        self._session.look_at(self._tx.value, self._rx.value)

    def _choose(self) -> None:
        name = self._chosen.value
        self._session.select(None if name == NOTHING else name)

    def _move(self) -> None:
        path = self._path()
        old = self._session.pose(path)
        turn = Pose.at(0.0, 0.0, 0.0, self._yaw.value - yaw_of(old)).rotation
        there = np.array(self._place.value)
        was = array(old.translation)
        # the widget rounds: a coordinate that it shows as it was stays as it was
        there = np.where(np.abs(there - was) < STEP / 2, was, there)
        self._session.move(path, Pose(turn @ old.rotation, torch.tensor(there), old.scale))

    def _swap(self) -> None:
        if self._asset.value != NO_ASSET:
            self._session.swap(self._path(), self._asset.value)

    def _vary(self, key: tuple[str, str]) -> None:
        self._session.vary(*key, self._variants[key].value)

    def _duplicate(self) -> None:
        self._session.duplicate(self._path())

    def _remove(self) -> None:
        self._session.remove(self._path())

    def _save(self) -> str:
        return f"saved: {self._session.save()}"

    # what is said

    def shown(self) -> set[str]:
        """Kinds of paths to draw."""
        return {kind for kind, box in self._kinds.items() if box.value}

    def tell(self, sentence: str) -> None:
        """Say something above the panel; empty to say nothing."""
        self.said = sentence
        self._told.content, self._told.visible = words.plain(sentence), bool(sentence)

    def show_place(self, pose: Pose) -> None:
        """Where the selected thing is now."""
        self._write(self._place, tuple(round(x, 4) for x in array(pose.translation).tolist()))
        self._write(self._yaw, round(yaw_of(pose), 3))

    def refresh(self, range_db: tuple[float, float], map_range: tuple[float, float] | None) -> None:
        """Everything that the session says."""
        session = self._session
        scene, link = session.scene, session.link or ("-", "-")
        radios = (scene.transmitters, scene.receivers)
        for widget, chosen, every in zip((self._tx, self._rx), link, radios, strict=True):
            self._choices(widget, tuple(r.path for r in every) or ("-",), chosen)
        things = (*scene.nodes, *scene.transmitters, *scene.receivers)
        selected = session.selected or NOTHING
        self._choices(self._chosen, (NOTHING, *(t.path for t in things)), selected)
        self._write(self._asset, NO_ASSET)
        object_is = session.selected is not None and isinstance(session.thing(selected), Node)
        self._place.disabled = self._yaw.disabled = session.selected is None
        self._asset.disabled = not object_is
        self._show_variants()
        if session.selected is not None:
            self.show_place(session.pose(session.selected))
        self._status.content = words.status(session)
        self._numbers.content = words.numbers(session.numbers())
        self._story.content = words.story(session)
        self._scale.content = words.scale_bar("path gain", *range_db, "dB", PATHS)
        there = map_range is not None
        self._map_scale.content = (
            words.scale_bar("received power, best server", *map_range, "dBm", MAP) if there else ""
        )
        self._show_delays()

    def _show_variants(self) -> None:
        """One list for each variant set that the selected thing is part of."""
        sets = {(one.path, one.name): one for one in self._session.variants()}
        for key in [key for key in self._variants if key not in sets]:
            self._variants.pop(key).remove()
        for key, one in sets.items():
            options = one.choices if one.chosen else (NO_VARIANT, *one.choices)
            if key not in self._variants:
                with self._selected:
                    name = f"{words.short(one.path)}: {one.name}"
                    widget = self._gui.add_dropdown(name, options)
                widget.on_update(self._wish(lambda key=key: self._vary(key)))
                self._variants[key] = widget
            self._choices(self._variants[key], options, one.chosen or NO_VARIANT)

    def _show_delays(self) -> None:
        lines = sorted(self._session.lines(), key=lambda line: line.delay_ns)
        if lines:
            gain = np.array([line.gain_db for line in lines])
            self._delays.data = stems(np.array([line.delay_ns for line in lines]), gain)

    def _choices(self, widget: Any, options: tuple[str, ...], value: str) -> None:
        if tuple(widget.options) != options:
            self._writing = True
            widget.options = options
            self._writing = False
        self._write(widget, value)

    def _write(self, widget: Any, value: Any) -> None:
        if widget.value != value:
            self._writing = True
            widget.value = value
            self._writing = False


def stems(delay: Any, gain: Any, depth: float = 60.0) -> tuple[Any, Any]:
    """One line that rises from a floor at every delay: a power-delay profile of a plot that only draws
    lines. Paths more than ``depth`` dB below the strongest stay below the floor."""
    floor = gain.max() - depth
    rise = np.stack([np.full_like(gain, floor), gain.clip(floor), np.full_like(gain, floor)], -1)
    room = max(
        0.05 * np.ptp(delay), 0.5
    )  # [ns] so that the first and the last do not hug the frame
    ends = np.array([delay.min() - room]), np.array([delay.max() + room])
    low = np.array([floor])
    return (
        np.concatenate([ends[0], np.repeat(delay, 3), ends[1]]),
        np.concatenate([low, rise.reshape(-1), low]),
    )


def yaw_of(pose: Pose) -> float:
    """The turn of a pose's x axis about world +z [deg]."""
    x, y = array(pose.rotation)[:2, 0]
    return float(np.degrees(np.arctan2(y, x)))
