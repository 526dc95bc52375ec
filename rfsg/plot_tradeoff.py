"""The picture of a tradeoff: error against time, memory as the size of a mark, the Pareto front."""

from typing import Any

from rfsg import plot
from rfsg.tracer.tradeoff import Outcome, Tradeoff

LEAST_ERROR_DB = 1e-3  # what is smaller is drawn here: a logarithm has no zero
MOST_NAMES = 14  # more labels than this cover what they name
_FRONT, _OTHER, _PICK = "#1f6fb2", "#b9c2cd", "#c0392b"


def tradeoff_figure(found: Tradeoff, title: str = "") -> Any:
    """Error of path gain at 90 % of links [dB] over seconds, both logarithmic.

    The front is a line and named; the recommended setting is red; a dashed line is the accuracy asked
    for. Settings that lose a link altogether, whose error is infinite, stand at the top.
    """
    figure = plot.Figure(figsize=(8.5, 5.4), layout="constrained")
    axes = figure.add_subplot()
    top = _top(found)
    for one in found.outcomes:
        colour = _PICK if one.setting == found.recommended else _FRONT if one.front else _OTHER
        height = drawn_error_db(one, top)
        look: dict[str, Any] = {"s": _size(one, found), "color": colour, "alpha": 0.85}
        axes.scatter([one.seconds], [height], zorder=3 if one.front else 2, **look)
    front = [o for o in found.outcomes if o.front]
    places = [(o.seconds, drawn_error_db(o, top)) for o in front]
    axes.plot(*zip(*places, strict=True), color=_FRONT, linewidth=1.0, drawstyle="steps-post")
    named = front[-MOST_NAMES:] + [o for o in found.outcomes if o.setting == found.recommended]
    for one in {o.setting: o for o in named}.values():
        place = (one.seconds, drawn_error_db(one, top))
        axes.annotate(one.setting, place, (5, 5), textcoords="offset points", fontsize=8)
    axes.axhline(found.accuracy_db, color=_PICK, linewidth=0.8, linestyle="--")
    axes.set(xscale="log", yscale="log", xlabel="time [s]")
    axes.set_ylabel(f"error of path gain at 90 % of {found.links} links [dB]")
    axes.set_title(title or f"against {found.reference}", loc="left", fontsize=10)
    axes.grid(alpha=0.3)
    axes.margins(0.12)
    return figure


def drawn_error_db(one: Outcome, top: float) -> float:
    """Where an error is drawn: no lower than ``LEAST_ERROR_DB``, no higher than ``top``."""
    return min(max(one.error.gain_90_db, LEAST_ERROR_DB), top)


def _top(found: Tradeoff) -> float:
    finite = [o.error.gain_90_db for o in found.outcomes if o.error.gain_90_db < float("inf")]
    return 2.0 * max([*finite, found.accuracy_db])


def _size(one: Outcome, found: Tradeoff) -> float:
    """Area of a mark, in proportion to memory; all alike where it is not known."""
    most = max((o.peak_mib or 0.0) for o in found.outcomes)
    return 40.0 if not most or one.peak_mib is None else 15.0 + 105.0 * one.peak_mib / most
