"""How an object is best asked where a ray meets it: the cheapest way whose error is small enough.

Boxes, cylinders, spheres and flat faces have closed forms and need no choice. A learned shape can be
met on its network, with certainty or by one step from its zero mesh, or on stand-ins for it. A way
that places a face wrongly by e along its normal lengthens a reflected path by at most 2 e (twice e
times the cosine of incidence; the extra length between two parallel planes, Born and Wolf,
Principles of Optics, section 7.6.1), and its phase by 4 pi e / lambda. The path's phasor moves by no
more, |exp(j x) - 1| <= x, and that of a path that is lost by its own length. So where a way may lack a
share p of the surface, the gain of a link that this object alone reflects onto, however its paths sum
up, changes by at most

    20 log10(1 + 4 pi e / lambda + p) dB

of the sum of their amplitudes. e and p are those measured of this very shape when it was baked
(``offs``): e of 99 % of the surface, p an upper bound. Of a shape that is not baked nothing is known, so
nothing stands in for it. What the shape itself is wrong by, its training, no way mends.
"""

import math

from rfsg.objects.shapes.kept import offs_of
from rfsg.scene.scene import Node

# Cheapest first, as docs/intersection.md measures them. "grid" is not among them: it costs more than
# "certain" there.
WAYS = ("mesh", "newton", "certain")
CERTAIN = "certain"
MOST_TOLD = 20  # objects in a report


def error_db(position_error: float, wavelength: float, lost: float = 0.0) -> float:
    """Most that a face wrong by so much [m], a share of which is lost, changes a reflected wave of this
    wavelength [m], in dB of amplitude: 20 log10(1 + 4 pi e / lambda + p). Raises ValueError for lengths
    that are not positive, or a share that is none."""
    if not (position_error >= 0.0 and 0.0 < wavelength < math.inf and 0.0 <= lost <= 1.0):
        raise ValueError(
            f"position error {position_error!r} m, wavelength {wavelength!r} m, lost {lost!r}: "
            "expected at least 0, above 0, and 0 to 1"
        )
    return 20.0 * math.log10(1.0 + 4.0 * math.pi * position_error / wavelength + lost)


def choose(node: Node, wavelength: float, accuracy_db: float) -> tuple[str, str]:
    """The cheapest way to meet an object that keeps within an accuracy [dB], and why, in a sentence.

    wavelength: [m]. The way is "analytic" or "faces" for shapes known exactly, else one of ``WAYS``;
    "certain" where no cheaper one is known to be accurate enough. Raises ValueError for a wavelength
    or an accuracy that is not positive.
    """
    if not 0.0 < accuracy_db < math.inf:
        raise ValueError(f"accuracy_db={accuracy_db!r}: expected a positive finite number")
    shape = node.body.shape
    if shape.exact:
        way = "faces" if shape.kind == "mesh" else "analytic"
        closed = "flat faces" if shape.faceted else "a closed form"
        return way, f"{node.path}: {closed} ({shape.kind}), exact"
    offs = offs_of(shape)
    if offs is None:
        return CERTAIN, (
            f"{node.path}: learned, met by {CERTAIN!r}: not baked, so that nothing is known of "
            "what stands in for its network"
        )
    scale = float(node.pose.scale.detach())
    most = {way: error_db(scale * offs[way].usual, wavelength, offs[way].lost) for way in WAYS}
    way = next((way for way in WAYS if most[way] <= accuracy_db), CERTAIN)
    off = offs[way]
    return way, (
        f"{node.path}: learned, met by {way!r}: off by {1e3 * scale * off.usual:.2g} mm on 99 % of it, "
        f"at most {1e3 * scale * off.most:.2g} mm, and no more than {100 * off.lost:.2g} % lost, is "
        f"at most {most[way]:.2g} dB at a wavelength of {1e3 * wavelength:.3g} mm"
    )


def told(nodes: tuple[Node, ...], wavelength: float, accuracy_db: float) -> tuple[str, ...]:
    """A sentence per object, learned ones first; past ``MOST_TOLD`` one says how many more there are."""
    learned_first = sorted(nodes, key=lambda node: node.body.shape.exact)
    sentences = [choose(node, wavelength, accuracy_db)[1] for node in learned_first[:MOST_TOLD]]
    more = len(nodes) - len(sentences)
    return (*sentences, f"and {more} more objects alike") if more else tuple(sentences)


def strictest(nodes: tuple[Node, ...], wavelength: float, accuracy_db: float) -> str:
    """The one way that is accurate enough for every object, where all are met alike."""
    needed = [choose(node, wavelength, accuracy_db)[0] for node in nodes]
    ranks = [WAYS.index(way) for way in needed if way in WAYS]
    return WAYS[max(ranks)] if ranks else CERTAIN
