"""The page of one file: opened from disk, by a browser that may ask nobody for anything."""

import pytest

from rfsg.scene.scene import Scene
from rfsg.view.session import Session
from rfsg.view.still import write_html
from tests.scenes import box_node, radio
from tests.view.browser import CHROMIUM, browser

pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason="no browser")


def test_it_shows_the_scene_and_its_numbers_from_disk(tmp_path):
    nodes = (box_node("/World/Box", (0.0, 1.2, 0.5), (0.4, 0.3, 0.5)),)
    scene = Scene(nodes, (radio("/tx", -2.0, 0.0, 0.8),), (radio("/rx", 2.5, 0.2, 0.9),), 2.4e9)
    session = Session(scene, quality="draft")
    try:
        assert session.wait(60.0)
        file = write_html(session, tmp_path / "out.html", title="<b>a room")
        gain = f"{session.numbers()['path_gain_db']:.2f} dB"
    finally:
        session.close()
    assert [f.name for f in tmp_path.iterdir()] == ["out.html"]
    with browser() as page:
        page.goto(file.as_uri())
        page.wait_for_selector("canvas")
        assert page.get_by_text(gain, exact=True).is_visible()
        assert page.title() == "<b>a room"
        page.wait_for_timeout(4000)
        page.screenshot(path=tmp_path / "still.png")
        assert not page.elsewhere
