"""The viewer's state, without a browser: edits, and the numbers of ``simulate`` itself."""

import threading
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.scene.library import Library
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Scene, SceneError
from rfsg.tracer.simulate import simulate
from rfsg.view import solver
from rfsg.view.session import Session
from rfsg.view.solver import Question, Solver
from tests.scenes import box_node, concrete, radio

WAIT_S = 120.0  # for a machine under load; an answer takes a second


@pytest.fixture
def scene() -> Scene:
    nodes = (
        box_node("/World/Wall", (0.0, 3.0, 1.5), (4.0, 0.1, 1.5)),
        box_node("/World/Box", (0.5, 1.0, 0.5), (0.4, 0.3, 0.5)),
    )
    return Scene(nodes, (radio("/tx", -2.0, 0.0, 1.0),), (radio("/rx", 2.5, 0.2, 1.1),
                 radio("/rx2", 1.5, -1.0, 1.2)), 2.4e9)  # fmt: skip


@pytest.fixture
def session(scene: Scene):
    opened = Session(scene, quality="draft")
    yield opened
    opened.close()


def agrees(session: Session, scene: Scene) -> None:
    """The link's numbers are those of a plain run on the same scene."""
    assert session.wait(WAIT_S), session.answer
    rows = simulate(scene, quality="draft").links()
    expected = next(r for r in rows if (r["tx"], r["rx"]) == session.link)
    numbers = session.numbers()
    assert numbers is not None and numbers["n_paths"] == expected["n_paths"]
    assert numbers["path_gain_db"] == pytest.approx(expected["path_gain_db"], abs=1e-7)
    assert numbers["delay_spread_ns"] == pytest.approx(expected["delay_spread_ns"], abs=1e-7)


def test_the_numbers_are_those_of_simulate(session: Session, scene: Scene):
    agrees(session, scene)
    assert len(session.lines()) == session.numbers()["n_paths"]
    assert len(session.lines(every_link=True)) > len(session.lines())


def test_a_drag_settles_where_it_ends_and_is_one_edit(session: Session, scene: Scene):
    for x in (0.6, 0.7, 0.8):
        session.drag("/World/Box", Pose.at(x, 0.4, 0.5))
    session.release()
    agrees(session, scene.moved("/World/Box", pose=Pose.at(0.8, 0.4, 0.5)))
    session.undo()
    assert session.scene is scene and not session.can_undo
    agrees(session, scene)


def test_a_radio_moves_as_an_object_does(session: Session, scene: Scene):
    session.move("/rx", Pose.at(1.0, 0.1, 1.0))
    agrees(session, scene.moved("/rx", to=(1.0, 0.1, 1.0)))


def test_an_asset_takes_the_place_of_an_object(scene: Scene, tmp_path):
    small = Body(Box((0.2, 0.2, 0.9)), concrete())
    folder = Scene((replace(scene.nodes[1], body=small),)).export("/World/Box", tmp_path / "post")
    session = Session(scene, quality="draft", library=Library(tmp_path))
    try:
        session.swap("/World/Box", "post")
        agrees(session, scene.replaced("/World/Box", folder))
        with pytest.raises(KeyError, match="post"):
            session.swap("/World/Box", "no_such_asset")
    finally:
        session.close()


def test_what_is_duplicated_stands_beside_and_what_is_removed_is_gone(session: Session):
    session.select("/World/Box")
    new = session.duplicate("/World/Box")
    assert session.selected == new == "/World/Box_2"
    one, two = session.scene.node("/World/Box"), session.scene.node(new)
    assert one.body is two.body
    assert torch.dist(one.pose.translation, two.pose.translation) > 0.8  # its width: no overlap
    session.remove(new)
    assert session.selected is None
    with pytest.raises(SceneError, match="no object"):
        session.scene.node(new)


def test_a_radio_that_is_selected_is_looked_at_until_it_is_gone(session: Session):
    session.select("/rx2")
    assert session.link == ("/tx", "/rx2")
    session.remove("/rx2")
    assert session.link == ("/tx", "/rx")


def test_edits_are_kept_as_a_layer(scene: Scene, tmp_path):
    read = Scene.from_usd(scene.to_usd(tmp_path / "scene.usda"))
    session = Session(read, quality="draft", save_to=tmp_path / "edits.usda")
    try:
        path = read.nodes[1].path
        session.move(path, Pose.at(0.9, 0.5, 0.5))
        session.duplicate(path)
        kept = Scene.from_usd(session.save())
        session.remove(path)
        again = Scene.from_usd(session.save())  # its own file may be replaced
        assert {n.path for n in kept.nodes} - {n.path for n in again.nodes} == {path}
        assert torch.allclose(kept.node(path).pose.translation, Pose.at(0.9, 0.5, 0.5).translation)
    finally:
        session.close()


def test_a_failed_run_is_told_and_the_next_one_answers(session: Session, scene: Scene):
    session.move("/rx", Pose.at(float("nan"), 0.0, 0.0))
    assert not session.wait(WAIT_S)
    assert "finite" in session.answer.fault
    session.undo()
    agrees(session, scene)


def test_the_latest_question_wins(scene: Scene, monkeypatch):
    """Of many positions of a drag that arrive while one is simulated, the last alone is."""
    begun, go_on, told, asked = (
        threading.Event(), threading.Event(), threading.Event(), []
    )  # fmt: skip

    def slow(asked_scene, *_, **__):
        asked.append(asked_scene)
        begun.set()
        assert go_on.wait(WAIT_S)
        return None

    monkeypatch.setattr(solver, "simulate", slow)
    worker = Solver(lambda answer: told.set() if answer.question.scene is last else None)
    scenes = [scene.moved("/World/Box", (0.01 * i, 0.0, 0.0)) for i in range(20)]
    last = scenes[-1]
    worker.ask(Question(scenes[0], None, at_rest=False))
    assert begun.wait(WAIT_S)
    for one in scenes[1:]:
        worker.ask(Question(one, None, at_rest=False))
    go_on.set()
    assert told.wait(WAIT_S)
    worker.close()
    assert len(asked) == 2 and asked[0] is scenes[0] and asked[1] is last
