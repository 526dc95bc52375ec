"""docs/images/viewer.png: the lab in the viewer, in a real browser.

python benchmarks/viewer_picture.py [OUT.png]
"""

import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from rfsg.scene.library import Library  # noqa: E402
from rfsg.scene.scene import Scene  # noqa: E402
from rfsg.view.page import Page  # noqa: E402
from rfsg.view.session import Session  # noqa: E402
from tests.view.browser import browser  # noqa: E402


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs/images/viewer.png"
    scene = Scene.from_usd(ROOT / "assets/scenes/lab.usda")
    library = Library(ROOT / "assets/objects")
    session = Session(scene, quality="standard", library=library, map_options={"cell": 0.25})
    page = Page(session, port=0, title="lab.usda")
    try:
        assert session.wait_for_all(), session.answer
        session.select("/World/Cabinet")
        page.draw()
        with browser() as shown:
            shown.goto(page.url)
            shown.get_by_text("Settled").wait_for()
            close = shown.locator(".mantine-Notification-closeButton")
            close.first.wait_for()  # a note that the browser draws without a graphics card
            close.first.click()
            time.sleep(6.0)
            shown.screenshot(path=out)
    finally:
        page.close()
        session.close()


if __name__ == "__main__":
    main()
