"""A real browser without a window, and where things of a page are on its screen."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

CHROMIUM = Path("/usr/bin/chromium")
WIDTH, HEIGHT = 1280, 800
PATIENCE_MS = 60_000  # for a machine under load
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--enable-webgl", "--ignore-gpu-blocklist",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
]  # fmt: skip


@contextmanager
def browser() -> Iterator[Any]:
    """A page of headless Chromium; ``page.elsewhere`` lists what it asked of other machines: nothing
    may be, and nothing is let through."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        page = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(PATIENCE_MS)
        page.elsewhere = []

        def guard(route: Any) -> None:
            if route.request.url.startswith(("http://127.0.0.1:", "file:", "blob:", "data:")):
                route.continue_()
            else:
                page.elsewhere.append(route.request.url)
                route.abort()

        page.route("**/*", guard)
        try:
            yield page
        finally:
            chromium.close()


def on_screen(camera: Any, point: Any) -> tuple[float, float]:
    """Pixel of a point of the world, by a viser client's camera: a pinhole that looks along +z with y
    down, its field of view the vertical one."""
    from viser import transforms

    turn = transforms.SO3(np.asarray(camera.wxyz)).as_matrix()
    x, y, z = turn.T @ (np.asarray(point, np.float64) - np.asarray(camera.position))
    scale = HEIGHT / 2 / np.tan(camera.fov / 2)
    return WIDTH / 2 + scale * x / z, HEIGHT / 2 + scale * y / z
