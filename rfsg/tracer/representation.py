"""How an object is best asked where a ray meets it: the cheapest way whose error is small enough.

Boxes, cylinders, spheres and flat faces have closed forms and need no choice. A learned shape can be
met on its network, with certainty or by one step from its zero mesh, or on stand-ins for it. A way
that places a face wrongly by e along its normal lengthens a reflected path by at most 2 e (twice e
times the cosine of incidence; the extra length between two parallel planes, Born and Wolf,
Principles of Optics, section 7.6.1), and its phase by 4 pi e / lambda. The path's phasor moves by no
more, |exp(j x) - 1| <= x, so that the gain of a link that this object alone reflects onto, however
its paths sum up, changes by at most

    20 log10(1 + 4 pi e / lambda) dB

of the sum of their amplitudes. What the shape itself is wrong by, its training, no way mends.
"""

import math

from rfsg.scene.scene import Node

# Position error at 99 % of hits against the network's own surface, largest of the shapes measured
# by benchmarks/intersect.py [m]; cheapest way first. "certain" is the way that nothing is lost on.
POSITION_ERROR = {"mesh": 1e-3, "grid": 1e-3, "newton": 2e-5, "certain": 1e-7}
CERTAIN = "certain"
MOST_TOLD = 20  # objects in a report


def phase_error_db(position_error: float, wavelength: float) -> float:
    """Most that a face wrong by so much [m] changes a reflected wave of this wavelength [m], in dB of
    amplitude: 20 log10(1 + 4 pi e / lambda). Raises ValueError for numbers that are not positive."""
    if not (position_error >= 0.0 and 0.0 < wavelength < math.inf):
        raise ValueError(
            f"position error {position_error!r} m, wavelength {wavelength!r} m: expected at least 0 "
            "and above 0"
        )
    return 20.0 * math.log10(1.0 + 4.0 * math.pi * position_error / wavelength)


def choose(node: Node, wavelength: float, accuracy_db: float) -> tuple[str, str]:
    """The cheapest way to meet an object that keeps within an accuracy [dB], and why, in a sentence.

    wavelength: [m]. The way is "analytic" or "faces" for shapes known exactly, else a key of
    ``POSITION_ERROR``; "certain" where no cheaper one is accurate enough. Raises ValueError for a
    wavelength or an accuracy that is not positive.
    """
    if not 0.0 < accuracy_db < math.inf:
        raise ValueError(f"accuracy_db={accuracy_db!r}: expected a positive finite number")
    shape = node.body.shape
    if shape.exact:
        way = "faces" if shape.kind == "mesh" else "analytic"
        closed = "flat faces" if shape.faceted else "a closed form"
        return way, f"{node.path}: {closed} ({shape.kind}), exact"
    scale = float(node.pose.scale.detach())
    most = {way: phase_error_db(scale * e, wavelength) for way, e in POSITION_ERROR.items()}
    way = next((way for way in most if most[way] <= accuracy_db), CERTAIN)
    return way, (
        f"{node.path}: learned, met by {way!r}: {1e3 * scale * POSITION_ERROR[way]:.2g} mm at 99 % "
        f"of hits are at most {most[way]:.2g} dB at a wavelength of {1e3 * wavelength:.3g} mm"
    )


def told(nodes: tuple[Node, ...], wavelength: float, accuracy_db: float) -> tuple[str, ...]:
    """A sentence per object, learned ones first; past ``MOST_TOLD`` one says how many more there are."""
    learned_first = sorted(nodes, key=lambda node: node.body.shape.exact)
    sentences = [choose(node, wavelength, accuracy_db)[1] for node in learned_first[:MOST_TOLD]]
    more = len(nodes) - len(sentences)
    return (*sentences, f"and {more} more objects alike") if more else tuple(sentences)


def strictest(nodes: tuple[Node, ...], wavelength: float, accuracy_db: float) -> str:
    """The one way that is accurate enough for every object, where all are met alike."""
    ways = list(POSITION_ERROR)
    needed = [choose(node, wavelength, accuracy_db)[0] for node in nodes]
    ranks = [ways.index(way) for way in needed if way in POSITION_ERROR]
    return ways[max(ranks)] if ranks else CERTAIN
