"""The page in a real browser: an object is dragged with the mouse, and the numbers follow."""

import time
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.scene.library import Library
from rfsg.scene.scene import Scene
from rfsg.tracer.simulate import simulate
from rfsg.view.page import Page
from rfsg.view.session import Session
from tests.scenes import box_node, concrete, radio
from tests.view.browser import CHROMIUM, browser, on_screen

pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason="no browser")

BOX = "/World/Box"
WAIT_S = 60.0


@pytest.fixture
def session(tmp_path):
    nodes = (
        box_node("/World/Wall", (0.0, 3.0, 1.5), (4.0, 0.1, 1.5)),
        box_node(BOX, (0.0, 0.2, 0.5), (0.4, 0.3, 0.5)),
    )
    radios = (radio("/tx", -2.0, 0.0, 0.8),), (radio("/rx", 2.5, 0.9, 0.9),)
    scene = Scene(nodes, *radios, 2.4e9)
    post = Body(Box((0.15, 0.15, 0.9)), concrete())
    Scene((replace(nodes[1], body=post),)).export(BOX, tmp_path / "post")
    opened = Session(scene, quality="draft", library=Library(tmp_path))
    yield opened
    opened.close()


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def tried(act: Callable[[], None], true: Callable[[], bool], times: int = 8) -> None:
    """Do it again where the picture was not ready for the hand: a busy machine draws late."""
    for _ in range(times):
        act()
        end = time.monotonic() + 2.0
        while time.monotonic() < end:
            if true():
                return
            time.sleep(0.02)
    raise AssertionError(f"{act.__name__}: nothing came of it, {times} times")


def hover(page, where: tuple[float, float]) -> None:
    """Rest the mouse somewhere: what lies under it is found between two frames."""
    page.mouse.move(where[0] - 3, where[1])
    page.mouse.move(*where, steps=3)
    page.wait_for_timeout(500)


def gain_of(scene: Scene) -> str:
    return f"{simulate(scene, quality='draft').links()[0]['path_gain_db']:.2f} dB"


def test_drag_and_swap_with_the_mouse(session: Session, tmp_path):
    served = Page(session, port=0)
    before = session.scene
    try:
        with browser() as page:
            page.goto(served.url)
            page.wait_for_selector("canvas")
            page.get_by_text("Settled").wait_for()
            assert page.get_by_text(gain_of(before), exact=True).count()
            until(lambda: len(served.server.get_clients()) == 1)
            camera = next(iter(served.server.get_clients().values())).camera
            until(lambda: camera.update_timestamp > 0)

            place = before.node(BOX).pose.translation.numpy()
            top = place + [0.0, 0.0, 0.45]
            page.wait_for_timeout(1000)  # meshes reach the picture after the panel

            def click() -> None:
                hover(page, on_screen(camera, top))
                page.mouse.down()
                page.wait_for_timeout(100)
                page.mouse.up()

            tried(click, lambda: session.selected == BOX)

            page.wait_for_timeout(1000)  # the gizmo, too
            arrow = place + [0.35, 0.0, 0.0]
            drafts = []
            heard = session.changed
            session.changed = lambda: (drafts.append(not session.answer.settled), heard())

            def drag() -> None:
                hover(page, on_screen(camera, arrow))
                page.mouse.down()
                for step in range(1, 11):
                    page.mouse.move(*on_screen(camera, arrow + [0.08 * step, 0.0, 0.0]))
                    page.wait_for_timeout(30)
                page.mouse.up()

            tried(drag, lambda: session.can_undo)
            assert session.wait(WAIT_S), session.answer
            moved = session.scene.node(BOX).pose.translation - before.node(BOX).pose.translation
            assert 0.4 < float(moved[0]) < 1.2 and float(moved[1:].abs().max()) < 1e-6
            assert any(drafts)  # the paths followed before the hand was off
            there = before.moved(BOX, pose=session.scene.node(BOX).pose)
            assert gain_of(there) != gain_of(before)
            page.get_by_text(gain_of(there), exact=True).wait_for()

            page.get_by_label("swap for").click()
            page.get_by_role("option", name="post").click()
            until(lambda: session.scene.node(BOX).asset is not None)
            swapped = there.replaced(BOX, session.library["post"])
            assert torch.equal(swapped.node(BOX).pose.translation, session.pose(BOX).translation)
            page.get_by_text(gain_of(swapped), exact=True).wait_for()
            assert gain_of(swapped) != gain_of(there)
            page.screenshot(path=tmp_path / "viewer.png")
            assert not page.elsewhere
    finally:
        served.close()
