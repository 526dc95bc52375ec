"""What the page is about, without the page: a scene that is edited, and what is known of its channel."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rfsg.scene.library import Library
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError, merged
from rfsg.scene.usd.live import LiveScene
from rfsg.scene.usd.variants import VariantSet, variant_sets
from rfsg.tracer.channel import Link
from rfsg.tracer.drawing import Line, path_lines
from rfsg.tracer.radiomap import RadioMap
from rfsg.view.solver import Answer, Question, Solver

MOST_UNDONE = 200  # scenes share what did not change, so that each is small


class Session:
    """A scene under edit. Every edit is simulated again in the background (``solver``); ``changed`` is
    called, in that thread, when there is an answer.

    selected: the prim path of an object or a radio, None for nothing. link: paths of the transmitter
    and the receiver looked at. answer: the latest; its result may be a draft of the link alone, of a
    scene that was a moment ago. radio_map: the latest, of a scene at rest. save_to: where ``save``
    writes. live: what ``scene`` was read by, if ``refresh`` is to follow what others edit there.
    Methods may be called from any thread. Raises SceneError as the edits of a ``Scene`` do.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        frequency: float | None = None,
        quality: Any = "standard",
        library: Library | None = None,
        save_to: Path | None = None,
        overwrite: bool = False,
        map_options: dict[str, Any] | None = None,
        live: LiveScene | None = None,
        changed: Callable[[], None] = lambda: None,
    ):
        self.scene, self.library, self.save_to = scene, library, save_to
        self.selected: str | None = None
        self.link = _link_of(scene, None)
        self.answer: Answer | None = None
        self.radio_map: RadioMap | None = None
        self.changed = changed
        self._overwrite = overwrite
        self._live, self._followed = live, None if live is None else live.scene
        self._variants: tuple[Any, tuple[VariantSet, ...]] = (None, ())
        self._undo: list[Scene] = []
        self._held: Scene | None = None  # what a drag began with
        self._lines: tuple[Any, list[Line]] = (None, [])
        self._told = threading.Condition(threading.RLock())
        self._solver = Solver(self._hear, frequency, quality, map_options)
        self._ask()

    def close(self) -> None:
        """Stop the thread."""
        self._solver.close()

    # what there is

    def thing(self, path: str) -> Node | Radio:
        """The object or radio at a path. Raises SceneError."""
        radios = (*self.scene.transmitters, *self.scene.receivers)
        found = next((radio for radio in radios if radio.path == path), None)
        return self.scene.node(path) if found is None else found

    def pose(self, path: str) -> Pose:
        """Where an object or a radio stands. Raises SceneError."""
        thing = self.thing(path)
        if isinstance(thing, Node):
            return thing.pose
        return replace(Pose.identity(), rotation=thing.rotation, translation=thing.position)

    def variants(self) -> tuple[VariantSet, ...]:
        """The variant sets that what is selected is part of."""
        scene, path = self.scene, self.selected
        if path is None:
            return ()
        if self._variants[0] is not scene.source:
            self._variants = (scene.source, variant_sets(scene))
        return tuple(one for one in self._variants[1] if one.concerns(path))

    @property
    def settled(self) -> bool:
        """Whether the answer is that of the scene as it stands, whole, at the quality asked for."""
        answer = self.answer
        return answer is not None and answer.settled and answer.question.scene is self.scene

    @property
    def can_undo(self) -> bool:
        return bool(self._undo)

    def numbers(self) -> Link | None:
        """The record of the link looked at, as ``rfsg simulate`` writes it; None before there is one."""
        answer, link = self.answer, self.link
        if answer is None or answer.result is None or link is None:
            return None
        return next((r for r in answer.result.links() if (r["tx"], r["rx"]) == link), None)

    def lines(self, every_link: bool = False) -> list[Line]:
        """Arriving paths of the link looked at, or of all links that the answer has."""
        answer, link = self.answer, self.link
        if answer is None or answer.result is None:
            return []
        result = answer.result
        if self._lines[0] is not result:
            self._lines = (result, path_lines(result))
        if every_link or link is None:
            return self._lines[1]
        tx, rx = result.scene.transmitters, result.scene.receivers
        return [x for x in self._lines[1] if (tx[x.tx].path, rx[x.rx].path) == link]

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the scene is settled, or has failed; whether it is settled."""
        with self._told:
            self._told.wait_for(lambda: self.settled or self._failed(), timeout)
            return self.settled

    def wait_for_all(self, timeout: float | None = None) -> bool:
        """As ``wait``, for the map too, if one was asked for."""
        with self._told:
            self._told.wait_for(lambda: self._complete() or self._failed(), timeout)
            return self._complete()

    def _complete(self) -> bool:
        return self.settled and (self.radio_map is not None or not self._solver.maps)

    def _failed(self) -> bool:
        answer = self.answer
        return answer is not None and bool(answer.fault) and answer.question.scene is self.scene

    # what can be done

    def select(self, path: str | None) -> None:
        """Select an object or a radio; a radio takes its place in the link looked at."""
        if path is not None:
            self.thing(path)
        with self._told:
            self.selected = path
            tx, rx = self.link or (None, None)
            if any(r.path == path for r in self.scene.transmitters) and rx:
                self.look_at(str(path), rx)
            elif any(r.path == path for r in self.scene.receivers) and tx:
                self.look_at(tx, str(path))

    def look_at(self, tx: str, rx: str) -> None:
        """Look at another link."""
        with self._told:
            if self.link != (tx, rx):
                self.link = (tx, rx)
                if not self.settled:
                    self._ask()

    def drag(self, path: str, pose: Pose) -> None:
        """Something is under a hand, here now: simulated as a draft. ``release`` ends it."""
        with self._told:
            self._held = self._held or self.scene
            self.scene = self.scene.moved(path, pose=pose)
            self._ask(at_rest=False)

    def release(self) -> None:
        """The hand is off."""
        with self._told:
            if self._held is not None:
                self._remember(self._held)
                self._held = None
                self._ask()

    def move(self, path: str, pose: Pose) -> None:
        """Put an object or a radio elsewhere, at once."""
        self._edit(self.scene.moved(path, pose=pose))

    def swap(self, path: str, asset: str) -> None:
        """Put an asset of the library, by name, in an object's place."""
        if self.library is None:
            raise SceneError([f"{path}: no library was given to take {asset} from (--library)"])
        self._edit(self.scene.replaced(path, self.library[asset]))

    def vary(self, path: str, variant_set: str, name: str) -> None:
        """Choose a variant of a prim."""
        self._edit(self.scene.with_variant(path, variant_set, name))

    def remove(self, path: str) -> None:
        """Take an object or a radio out, and what stands below it."""
        self._edit(self.scene.without(path))

    def duplicate(self, path: str) -> str:
        """One more of an object, beside it; returns its path, which is selected."""
        node = self.scene.node(path)
        low, high = node.body.shape.bounds().detach().double()
        width = float(high[0] - low[0]) * float(node.pose.scale.detach())
        aside = node.pose.rotation[:, 0] * (1.1 * width)
        pose = replace(node.pose, translation=node.pose.translation + aside)
        new = self._free(path)
        self._edit(
            replace(self.scene, nodes=(*self.scene.nodes, replace(node, path=new, pose=pose)))
        )
        self.selected = new
        return new

    def undo(self) -> None:
        """Take the last edit back."""
        with self._told:
            if self._undo:
                self.scene = self._undo.pop()
                self._tidy()
                self._ask()

    def refresh(self) -> bool:
        """Take over what was edited on the stage by pxr calls, or in its files by another program,
        below the edits made here; whether there was something. Raises SceneError, as ``LiveScene``.

        Not while another thread edits the stage: OpenUSD allows one or many that read."""
        if self._live is None:
            return False
        with self._told:
            new = self._live.scene
            if new is self._followed:
                return False
            below = _Below(new)
            scene, undo = below.put(self.scene), [below.put(old) for old in self._undo]
            held = None if self._held is None else below.put(self._held)
            self._followed, self.scene, self._undo, self._held = new, scene, undo, held
            self._tidy()
            self._ask(at_rest=held is None)
            return True

    def save(self) -> Path:
        """Write the edits as a layer over the scene. Raises SceneError, as ``Scene.save_edits``."""
        if self.save_to is None:
            raise SceneError(["no file was named to save the edits to (--save)"])
        path = self.scene.save_edits(self.save_to, overwrite=self._overwrite)
        self._overwrite = True  # from now on it is ours
        return path

    def _edit(self, scene: Scene) -> None:
        with self._told:
            self._remember(self.scene)
            self.scene = scene
            self._tidy()
            self._ask()

    def _remember(self, scene: Scene) -> None:
        self._undo = [*self._undo, scene][-MOST_UNDONE:]

    def _tidy(self) -> None:
        """Nothing that is gone stays selected or looked at."""
        self.link = _link_of(self.scene, self.link)
        try:
            self.select(self.selected)
        except SceneError:
            self.selected = None

    def _free(self, path: str) -> str:
        stem = path.rstrip("0123456789").rstrip("_")
        taken = {
            t.path for t in (*self.scene.nodes, *self.scene.transmitters, *self.scene.receivers)
        }
        return next(name for i in range(2, len(taken) + 3) if (name := f"{stem}_{i}") not in taken)

    def _ask(self, at_rest: bool = True) -> None:
        self._solver.ask(Question(self.scene, self.link, at_rest))

    def _hear(self, answer: Answer) -> None:
        with self._told:
            self.answer = answer
            if answer.settled:
                self.radio_map = answer.radio_map
            self._told.notify_all()
        self.changed()


class _Below:
    """A scene read anew, to be put below edits of what it was before."""

    def __init__(self, scene: Scene):
        self._scene = scene
        self._varied: dict[str, Scene] = {}

    def put(self, edited: Scene) -> Scene:
        """The new scene with those edits, the chosen variants included."""
        chosen = edited.source.options.variants
        new = self._varied.get(repr(chosen))
        if new is None:
            new = self._scene
            for path, sets in chosen.items():
                for name, choice in sets.items():
                    if self._scene.source.options.variants.get(path, {}).get(name) != choice:
                        new = new.with_variant(path, name, choice)
            self._varied[repr(chosen)] = new
        return merged(edited, edited.source.base, new)


def _link_of(scene: Scene, last: tuple[str, str] | None) -> tuple[str, str] | None:
    """The link looked at: the last one as far as its ends are there, else the first."""
    tx, rx = ([r.path for r in radios] for radios in (scene.transmitters, scene.receivers))
    if not tx or not rx:
        return None
    old_tx, old_rx = last or (tx[0], rx[0])
    return (old_tx if old_tx in tx else tx[0], old_rx if old_rx in rx else rx[0])
