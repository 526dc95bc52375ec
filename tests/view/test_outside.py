"""A scene that others edit too: variants, pxr calls, another program that writes its files."""

from pathlib import Path

import pytest
from pxr import Usd, UsdGeom

from rfsg.scene.pose import Pose
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.usd.live import LiveScene
from rfsg.tracer.simulate import simulate
from rfsg.view.page import Page
from rfsg.view.session import Session
from tests.scenes import box_node, radio
from tests.view.browser import CHROMIUM, browser

WAIT_S = 120.0
DOOR, BOX, RX = "/World/Door", "/World/Box", "/World/rx"
PANEL = """
    def Xform "Door" (
        variants = { string state = "open" }
        prepend variantSets = "state"
    )
    {
        variantSet "state" = {
            "open" { }
            "shut" {
                def Cube "Leaf"
                {
                    double size = 2
                    custom token rfsg:material:model = "conductor"
                    double3 xformOp:translate = (0.2, -1.5, 1)
                    double3 xformOp:scale = (0.6, 0.05, 1)
                    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
                }
            }
        }
        def Cube "Frame"
        {
            double size = 2
            custom token rfsg:material:model = "conductor"
            double3 xformOp:translate = (0.2, -1, 1)
            double3 xformOp:scale = (0.05, 0.05, 1)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        }
    }
"""
FRAME, LEAF = f"{DOOR}/Frame", f"{DOOR}/Leaf"


@pytest.fixture
def file(tmp_path) -> Path:
    """A box and a door between two radios."""
    nodes = (box_node(BOX, (0.5, 1.5, 0.5), (0.4, 0.3, 0.5)),)
    radios = (radio("/World/tx", -2.0, 0.0, 1.0),), (radio(RX, 2.5, 0.2, 1.1),)
    path = Scene(nodes, *radios, 2.4e9).to_usd(tmp_path / "room.usda")
    text = path.read_text()
    at = text.index("{", text.index('"World"')) + 1
    path.write_text(text[:at] + PANEL + text[at:])
    return path


def opened(live: LiveScene, **options) -> Session:
    return Session(live.scene, quality="draft", live=live, **options)


def gain(scene: Scene) -> float:
    return simulate(scene, quality="draft").links()[0]["path_gain_db"]


def agrees(session: Session, scene: Scene) -> None:
    assert session.wait(WAIT_S), session.answer
    numbers = session.numbers()
    assert numbers is not None
    assert numbers["path_gain_db"] == pytest.approx(gain(scene), abs=1e-7)


def test_a_variant_is_chosen_and_taken_back(file):
    read = Scene.from_usd(file)
    session = Session(read, quality="draft")
    try:
        session.select(BOX)
        assert session.variants() == ()
        session.select(FRAME)  # part of the door, whose prim has the set
        (state,) = session.variants()
        assert (state.path, state.name, state.choices) == (DOOR, "state", ("open", "shut"))
        assert state.chosen == "open"
        session.move(BOX, Pose.at(0.5, 1.2, 0.5))
        session.vary(state.path, state.name, "shut")
        assert session.variants()[0].chosen == "shut"
        assert session.scene.node(LEAF) and session.selected == FRAME
        moved = read.moved(BOX, pose=Pose.at(0.5, 1.2, 0.5))
        agrees(session, moved.with_variant(DOOR, "state", "shut"))
        session.undo()
        agrees(session, moved)
        assert gain(moved.with_variant(DOOR, "state", "shut")) != gain(moved)
        with pytest.raises(SceneError, match="no variant state=ajar"):
            session.vary(DOOR, "state", "ajar")
    finally:
        session.close()


def test_a_scene_made_in_python_has_no_variants(tmp_path):
    session = Session(Scene((box_node(BOX, (0, 0, 0), (1, 1, 1)),)), quality="draft")
    try:
        session.select(BOX)
        assert session.variants() == () and not session.refresh()
    finally:
        session.close()


def test_pxr_calls_are_seen_below_the_edits_made_here(file):
    stage = Usd.Stage.Open(str(file))
    live = LiveScene(stage)
    session = opened(live)
    try:
        before = session.scene
        assert not session.refresh() and session.scene is before
        session.vary(DOOR, "state", "shut")
        session.move(BOX, Pose.at(0.5, 1.2, 0.5))
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath(RX)).SetTranslate((2.0, 0.6, 0.9))
        assert session.refresh() and not session.refresh()
        now = Scene.from_usd(stage, variants={DOOR: {"state": "shut"}})
        assert now.receivers[0].position.tolist() == pytest.approx([2.0, 0.6, 0.9])
        agrees(session, now.moved(BOX, pose=Pose.at(0.5, 1.2, 0.5)))
        session.undo()  # of what was done here alone
        agrees(session, now)
        session.undo()
        agrees(session, Scene.from_usd(stage))
        assert not session.can_undo
    finally:
        session.close()


def test_what_another_program_writes_is_seen(file):
    session = opened(LiveScene(file))
    try:
        session.move(RX, Pose.at(2.0, 0.6, 0.9))
        other = Scene.from_usd(file).moved(BOX, (0.0, -0.4, 0.0))
        again = other.to_usd(file.with_name("again.usda"))
        again.replace(file)
        assert session.refresh()
        agrees(session, Scene.from_usd(file).moved(RX, to=(2.0, 0.6, 0.9)))
        assert session.scene.node(BOX).pose.translation[1].item() == pytest.approx(1.1)
    finally:
        session.close()


def test_a_file_at_fault_is_told_and_the_next_one_is_taken(file):
    session = opened(LiveScene(file))
    page = Page(session, port=0)
    good = file.read_text()
    try:
        before = session.scene
        file.write_text(good[: len(good) // 2])  # cut short, as while it is written
        page.refresh()
        assert session.scene is before and page.panel.said
        file.write_text(good.replace("(0.2, -1, 1)", "(0.2, -0.7, 1)"))
        page.refresh()
        assert "changed elsewhere" in page.panel.said
        assert session.scene.node(FRAME).pose.translation[1].item() == pytest.approx(-0.7)
    finally:
        page.close()
        session.close()


@pytest.mark.skipif(not CHROMIUM.exists(), reason="no browser")
def test_variants_and_changes_on_disk_on_the_page(file):
    session = opened(LiveScene(file))
    served = Page(session, port=0)

    def shown(scene: Scene) -> str:
        return f"{gain(scene):.2f} dB"

    try:
        session.select(FRAME)
        served.draw()
        with browser() as page:
            page.goto(served.url)
            page.get_by_text(shown(session.scene), exact=True).wait_for()
            page.get_by_label("Door: state").click()
            page.get_by_role("option", name="shut").click()
            shut = Scene.from_usd(file, variants={DOOR: {"state": "shut"}})
            page.get_by_text(shown(shut), exact=True).wait_for()
            file.write_text(file.read_text().replace("(0.2, -1.5, 1)", "(0.2, -1.5, 2.9)"))
            served.refresh()
            up = Scene.from_usd(file, variants={DOOR: {"state": "shut"}})
            assert shown(up) != shown(shut)
            page.get_by_text(shown(up), exact=True).wait_for()
            assert not page.elsewhere
    finally:
        served.close()
        session.close()
