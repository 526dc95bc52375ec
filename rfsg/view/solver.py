"""One thread that answers what the page asks: the latest question wins, and nothing queues.

While something is dragged only the link that is looked at is simulated, as a draft. At rest the whole
scene follows, at the quality that was asked for, and then its map. Each simulation goes on from the
last of its kind (``simulate(previous=...)``). A run at rest is given up between two of its stages when
there is a newer question; a draft is finished, or paths would never follow a hand that keeps moving.
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from rfsg.scene.scene import Scene
from rfsg.tracer.plan import PRESETS
from rfsg.tracer.radiomap import RadioMap, radio_map
from rfsg.tracer.simulate import Result, simulate

DRAFT = "draft"


@dataclass(frozen=True)
class Question:
    """A scene, the link (paths of transmitter and receiver) looked at, and whether it is at rest."""

    scene: Scene
    link: tuple[str, str] | None
    at_rest: bool = True

    def narrowed(self) -> Scene:
        """The scene with the radios of the link alone."""
        if self.link is None:
            return self.scene
        tx, rx = self.link
        scene = self.scene
        return replace(
            scene,
            transmitters=tuple(r for r in scene.transmitters if r.path == tx),
            receivers=tuple(r for r in scene.receivers if r.path == rx),
        )


@dataclass(frozen=True)
class Answer:
    """What came of a question. settled: of the whole scene, at the quality asked for; else a draft of
    one link. fault: one sentence, in place of a result."""

    question: Question
    settled: bool
    quality: str
    seconds: float = 0.0
    result: Result | None = None
    radio_map: RadioMap | None = None
    fault: str | None = None


class Solver:
    """Answers in a thread of its own, through ``tell``, until ``close``.

    map_options: those of ``radio_map``; None for no map.
    """

    def __init__(
        self,
        tell: Callable[[Answer], None],
        frequency: float | None = None,
        quality: Any = "standard",
        map_options: dict[str, Any] | None = None,
    ):
        self._tell, self._frequency, self._quality = tell, frequency, quality
        self._map_options = map_options
        self._last: dict[bool, Result] = {}  # by whether it was at rest
        self._drafted: Question | None = None
        self._pending: Question | None = None
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="rfsg-view", daemon=True)
        self._thread.start()

    @property
    def maps(self) -> bool:
        """Whether a scene at rest gets a map."""
        return self._map_options is not None

    def ask(self, question: Question) -> None:
        """Ask; a question that still waits is forgotten."""
        with self._changed:
            self._pending = question
            self._changed.notify_all()

    def close(self) -> None:
        """Stop, after the stage that runs."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while (question := self._next()) is not None:
            try:
                for answer in self._answers(question):
                    self._tell(answer)
            except _Overtaken:
                continue
            except Exception as error:  # whatever it was: the page says so and stays open
                self._last.clear()
                self._tell(Answer(question, False, self._word(), fault=_sentence(error)))

    def _next(self) -> Question | None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._pending is not None)
            question, self._pending = self._pending, None
            return None if self._closed else question

    def _answers(self, question: Question) -> Iterator[Answer]:
        if not self._is_drafted(question):
            yield self._simulated(question, settled=False)
            self._drafted = question
        if not question.at_rest:
            return
        self._go_on()
        settled = self._simulated(question, settled=True)
        yield settled
        if self._map_options is not None:
            options = {"quality": self._quality, "progress": self._go_on} | self._map_options
            found = radio_map(question.scene, self._frequency, **options)
            yield replace(settled, radio_map=found)

    def _is_drafted(self, question: Question) -> bool:
        last = self._drafted
        return last is not None and last.scene is question.scene and last.link == question.link

    def _simulated(self, question: Question, settled: bool) -> Answer:
        start = time.monotonic()
        options: dict[str, Any] = {"previous": self._last.get(settled)}
        if settled:
            options |= {"quality": self._quality, "progress": self._go_on}
        else:
            options |= {"quality": DRAFT, "progress": self._not_closed}
        scene = question.scene if settled else question.narrowed()
        result = simulate(scene, self._frequency, **options)
        self._last[settled] = result
        word = self._word() if settled else DRAFT
        return Answer(question, settled, word, time.monotonic() - start, result)

    def _word(self) -> str:
        if isinstance(self._quality, str):
            return self._quality
        same = (name for name, preset in PRESETS.items() if preset == self._quality)
        return next(same, "a quality of your own")

    def _go_on(self, *_: Any) -> None:
        """Between stages. Raises _Overtaken when there is a newer question."""
        if self._closed or self._pending is not None:
            raise _Overtaken

    def _not_closed(self, *_: Any) -> None:
        if self._closed:
            raise _Overtaken


class _Overtaken(Exception):
    """There is a newer question, or nobody asks any more."""


def _sentence(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text or type(error).__name__
