"""What the page says: numbers of a link, what was modelled, the scale of colours, as Markdown and HTML.

Names come from scenes, which may be a stranger's: they are escaped, so that none becomes markup.
"""

import html
import math
import re
from collections.abc import Iterable

from rfsg.scene.colours import css
from rfsg.tracer.channel import Link
from rfsg.view.session import Session

_MARKUP = re.compile(r"([\\`*_{}\[\]()<>#+!|~$&])")


def plain(text: str) -> str:
    """Text that Markdown shows as it is."""
    return _MARKUP.sub(r"\\\1", " ".join(text.split()))


def short(path: str) -> str:
    """The last name of a prim path."""
    return path.rsplit("/", 1)[-1]


def status(session: Session) -> str:
    """One line: what is shown, or what went wrong."""
    answer = session.answer
    if answer is None:
        return "**Simulating** ..."
    if answer.fault:
        return f"**Failed:** {plain(answer.fault)}"
    count = 0 if answer.result is None else len(answer.result.paths.tx)
    done = f"{count} paths, {answer.quality}, {answer.seconds:.2f} s"
    if session.settled:
        return f"**Settled:** {done}"
    return f"**Before the edit:** {done}" if answer.settled else f"**Draft of this link:** {done}"


def rows(row: Link) -> dict[str, str]:
    """What is said of a link, by name; of one that nothing arrives over, that."""
    if row["n_paths"] == 0:
        return {"paths": "nothing arrives"}
    return {
        "path gain": f"{row['path_gain_db']:.2f} dB",
        "received": f"{row['rss_dbm']:.2f} dBm",
        "delay spread": f"{row['delay_spread_ns']:.2f} ns",
        "K factor": _decibel(row["k_factor_db"]),
        "paths": f"{row['n_paths']}",
        "line of sight": "yes" if row["los"] else "no",
        "azimuth spread, out / in": f"{row['asd_deg']:.1f}° / {row['asa_deg']:.1f}°",
        "zenith spread, out / in": f"{row['zsd_deg']:.1f}° / {row['zsa_deg']:.1f}°",
    }


def numbers(row: Link | None) -> str:
    """A table of one link."""
    if row is None:
        return "no numbers yet"
    lines = "\n".join(f"| {name} | {value} |" for name, value in rows(row).items())
    return f"| | |\n|:--|--:|\n{lines}"


def story(session: Session) -> str:
    """What was modelled, what was left out, and warnings."""
    answer = session.answer
    if answer is None or answer.result is None:
        return ""
    result = answer.result
    parts = [("Modelled", result.plan.modelled), ("Left out", result.plan.left_out)]
    parts += [("Warnings", (*session.scene.warnings, *result.warnings))]
    return "\n\n".join(f"**{name}**\n\n{_list(lines)}" for name, lines in parts if lines)


def _list(lines: Iterable[str]) -> str:
    return "\n".join(f"- {plain(line)}" for line in lines)


def scale_bar(name: str, low: float, high: float, unit: str, scale: str) -> str:
    """A bar of colours with its two ends, HTML."""
    return (
        f'<div style="padding:0.3em 0.9em 0.1em;font-size:0.8em">{html.escape(name)} [{unit}]'
        f'<div style="height:0.8em;border-radius:0.2em;background:{css(scale)}"></div>'
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{low:.0f}</span><span>{(low + high) / 2:.0f}</span><span>{high:.0f}</span></div></div>"
    )


def _decibel(value: float) -> str:
    return f"{value:.1f} dB" if math.isfinite(value) else "one path"
