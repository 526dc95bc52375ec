"""A page that nothing serves: one HTML file with the picture, its numbers and its colours.

viser's own client, with the scene inside, opened from a disk or a paper's supplement. Its panel needs a
server and is left out; a card of numbers takes its place.
"""

import html
from pathlib import Path

from rfsg.scene.colours import MAP, PATHS
from rfsg.scene.weights import write_beside
from rfsg.view import words
from rfsg.view.page import Page
from rfsg.view.session import Session

_CARD = """<div style="position:fixed;top:1em;right:1em;width:19em;max-height:92vh;overflow:auto;
background:#fffe;border-radius:.4em;box-shadow:0 1px 6px #0003;padding:.8em 1em;z-index:1000;
font:13px system-ui,sans-serif;color:#222" id="rfsg-card">"""


def write_html(session: Session, file: Path, title: str = "rfsg") -> Path:
    """Write what a session shows, at rest, as one self-contained file; returns its place."""
    page = Page(session, port=0, title=title)
    try:
        text = page.server.get_scene_serializer().as_html()
        card = _card(session, title, page.picture.range_db, page.picture.map_range)
    finally:
        page.close()
    text = text.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>")
    end = text.rindex("</body>")
    write_beside(file, (text[:end] + card + text[end:]).encode(), overwrite=True)
    return file


def _card(
    session: Session,
    title: str,
    range_db: tuple[float, float],
    map_range: tuple[float, float] | None,
) -> str:
    parts = [f"{_CARD}<b>{html.escape(title)}</b>"]
    row = session.numbers()
    if row is not None:
        ends = f"{words.short(row['tx'])} to {words.short(row['rx'])}"
        cells = "".join(
            f"<tr><td>{html.escape(name)}</td><td style='text-align:right'>{html.escape(value)}</td></tr>"
            for name, value in words.rows(row).items()
        )
        parts.append(f"<div>{html.escape(ends)}</div><table style='width:100%'>{cells}</table>")
    parts.append(words.scale_bar("path gain", *range_db, "dB", PATHS))
    if map_range is not None:
        parts.append(words.scale_bar("received power, best server", *map_range, "dBm", MAP))
    return "".join(parts) + "</div>"
