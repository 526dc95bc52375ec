"""Why the peer has another number: each cause with the rule that recognises it.

A rule does not look at the case's name. It computes what the cause would do to this very path, from
rfsg's path or from the closed form, and asks whether that is what was found.
"""

from collections.abc import Callable
from dataclasses import dataclass

import edges
import numpy as np
import truth
import waves
from cases import Ball, Wall
from differences import THRESHOLD, Compared, Difference, decibel
from exchange import DIFFRACT

C = 299_792_458.0
SHORTEST = 1e-2  # [m] constants.py of Sionna RT 2.2: MIN_SEGMENT_LENGTH
FLOAT32 = float(np.finfo(np.float32).eps)
ROUNDINGS = 8  # of float32, that a delay may have gone through


@dataclass(frozen=True)
class Cause:
    name: str
    why: str
    explains: Callable[[Compared, Difference], bool]


def _segments(c: Compared, p: int) -> np.ndarray:
    rx = np.array(c.case.receivers[c.rfsg.rx[p]])
    line = c.rfsg.polyline(p, np.array(c.case.transmitter), rx)
    return np.linalg.norm(np.diff(line, axis=0), axis=1)


def short_segment(c: Compared, d: Difference) -> bool:
    """A path with a segment under a centimetre is missing, or a link lacks just such paths."""
    if d.quantity == "missing in the peer":
        return bool(_segments(c, d.p).min() < SHORTEST)
    if d.quantity != "link power [dB]":
        return False
    lost = {x.p for x in c.differences if x.quantity == "missing in the peer" and x.rx == d.rx}
    if not lost or not all(_segments(c, p).min() < SHORTEST for p in lost):
        return False
    mine = [p for p in np.nonzero(c.rfsg.rx == d.rx)[0] if p not in lost]
    left = abs(c.rfsg.share(c.case.frequency)[mine].sum())
    return abs(c.link_power(c.peer)[d.rx] - decibel(left)) < THRESHOLD[d.quantity]


def _walls(c: Compared, d: Difference) -> list[tuple[float, float]]:
    """(thickness, |cos|) of the walls that a path without bounces goes through."""
    if d.p < 0 or not c.rfsg.crossed[d.p]:
        return []
    walls = [t for t in c.case.standing() if isinstance(t, Wall)]
    axes = ["xyz".index(w.front[1]) for w in walls]
    return [
        (w.thickness, abs(float(c.rfsg.departure[d.p][a])))
        for w, a in zip(walls, axes, strict=True)
    ]


def slab_delay(c: Compared, d: Difference) -> bool:
    """The peer's delay is the straight length over c; the closed form's holds the group delay."""
    if d.quantity != "delay [ns]" or not _walls(c, d) or c.truth is None:
        return False
    straight = _segments(c, d.p).sum() / C
    exact = c.truth.delay[c.truth_of[d.p]]
    return max(abs(c.peer.delay[d.s] - straight), abs(c.rfsg.delay[d.p] - exact)) < 1e-12


def slab_phase(c: Compared, d: Difference) -> bool:
    """Off by exactly -k d cos(theta): the way through the wall is counted twice."""
    walls = _walls(c, d)
    if d.quantity != "phase [deg]" or not walls:
        return False
    twice = sum(thickness * cosine for thickness, cosine in walls)
    expected = -360.0 * c.case.frequency / C * twice
    return abs((d.value - expected + 180.0) % 360.0 - 180.0) < THRESHOLD[d.quantity]


def float32_phase(c: Compared, d: Difference) -> bool:
    """The delay agrees to float32's last places, and that much of it is the phase's difference."""
    f = c.case.frequency
    if d.quantity == "phase [deg]":
        error = c.peer.delay[d.s] - c.rfsg.delay[d.p]
        turned = (d.value + 360.0 * f * error + 180.0) % 360.0 - 180.0
        allowed = ROUNDINGS * FLOAT32 * c.rfsg.delay[d.p]
        return bool(abs(error) < allowed and abs(turned) < THRESHOLD[d.quantity])
    if d.quantity == "delay [ns]":
        return abs(d.value) * 1e-9 < ROUNDINGS * FLOAT32 * c.rfsg.delay[d.p]
    if d.quantity != "link power [dB]":
        return False
    mine = [(p, s) for p, s in c.pairs if c.rfsg.rx[p] == d.rx]
    if len(mine) != int((c.rfsg.rx == d.rx).sum()):
        return False
    p, s = np.array(mine).T
    turn = np.exp(-2j * np.pi * np.mod(f * c.rfsg.delay[p], 1.0))
    mended = decibel(np.array(abs((c.peer.gain[s] * turn).sum())))
    return bool(abs(mended - c.link_power(c.rfsg)[d.rx]) < THRESHOLD[d.quantity])


def float32_vertices(c: Compared, d: Difference) -> bool:
    """The closed form over the peer's own vertices has the peer's power: they are that far off."""
    if d.quantity != "power [dB]" or c.truth is None or _on_ball(c, d.p):
        return False
    rx = np.array(c.case.receivers[d.rx])
    points = c.peer.polyline(d.s, np.array(c.case.transmitter), rx)
    items = c.rfsg.item[d.p][c.rfsg.kind[d.p] >= 0]
    there = truth.gain_along(c.case, items, points)
    return bool(abs(decibel(there) - decibel(c.peer.gain[d.s])) < THRESHOLD[d.quantity] / 10)


# the signs in which Sionna RT 2.2 adds [KP]'s terms on a conductor lit on one face: read off its
# code (R_0 (D1 - D4) + R_n (D2 - D3) with R_n = -1, in radio_material.py) and off its answers
PEER_EDGE = np.array([[1, -1, 1, -1], [-1, -1, 1, 1]])


def _peer_edge(c: Compared, p: int) -> tuple[complex, float]:
    """The gain of one of rfsg's diffracted paths with the peer's signs, and the sum of the terms'
    magnitudes, of which a rounding is a share."""
    rx = np.array(c.case.receivers[c.rfsg.rx[p]])
    near = [e for e in edges.bending(c.case, rx) if np.allclose(e.point, c.rfsg.vertex[p, 0])]
    terms = edges.terms(c.case, near[0], rx)
    return complex((PEER_EDGE * terms).sum()), float(np.abs(terms).sum())


def edge_terms(c: Compared, d: Difference) -> bool:
    """The peer's answer is the closed form's four terms with other signs."""
    if d.quantity == "link power [dB]":
        mine = np.nonzero(c.rfsg.rx == d.rx)[0].tolist()
        bent = [p for p in mine if (c.rfsg.kind[p] == DIFFRACT).any()]
        turn = np.exp(-2j * np.pi * np.mod(c.case.frequency * c.rfsg.delay, 1.0))
        gain = c.rfsg.gain.copy()
        gain[bent] = [_peer_edge(c, p)[0] for p in bent]
        there = decibel((gain * turn)[mine].sum())
        return bool(bent) and abs(there - c.link_power(c.peer)[d.rx]) < THRESHOLD[d.quantity]
    if d.p < 0 or d.s < 0 or not (c.rfsg.kind[d.p] == DIFFRACT).any():
        return False
    expected, size = _peer_edge(c, d.p)
    return abs(c.peer.gain[d.s] - expected) < 0.01 * size


def _on_ball(c: Compared, p: int) -> Ball | None:
    ball = c.case.things[0]
    return ball if p >= 0 and (c.rfsg.kind[p] >= 0).any() and isinstance(ball, Ball) else None


def _flat(c: Compared, p: int, ball: Ball) -> tuple[complex, float]:
    """(gain, delay) of one of rfsg's glints were the ball its mesh: nothing where no triangle shows
    the transmitter, else a plane mirror's over that triangle."""
    tx, rx = np.array(c.case.transmitter), np.array(c.case.receivers[c.rfsg.rx[p]])
    points = truth.mirrored_on_facets(ball, tx, rx)
    if not len(points):
        return 0j, 0.0
    point = points[np.linalg.norm(points - c.rfsg.vertex[p, 0], axis=1).argmin()]
    length = float(np.linalg.norm(point - tx) + np.linalg.norm(rx - point))
    s1, s2 = _segments(c, p)
    cosine = np.sqrt((1 + c.rfsg.departure[p] @ c.rfsg.arrival[p]) / 2)
    curved = waves.divergence(s1, s2, cosine, ball.radius)
    return complex(c.rfsg.gain[p] / curved / length), length / C


def flat_facets(c: Compared, d: Difference) -> bool:
    """The peer has what the triangles of the mesh give as plane mirrors, or nothing where none of
    them is turned the right way; and its link is the sum of that and rfsg's other paths."""
    f = c.case.frequency
    if d.quantity == "link power [dB]":
        total, balls = 0j, 0
        for p in np.nonzero(c.rfsg.rx == d.rx)[0].tolist():
            gain, delay = c.rfsg.gain[p], c.rfsg.delay[p]
            if ball := _on_ball(c, p):
                gain, delay = _flat(c, p, ball)
                balls += 1
            total += gain * np.exp(-2j * np.pi * np.mod(f * delay, 1.0))
        there = decibel(np.array(total))
        return bool(balls and abs(there - c.link_power(c.peer)[d.rx]) < THRESHOLD[d.quantity])
    ball = _on_ball(c, d.p)
    if ball is None:
        return False
    gain, delay = _flat(c, d.p, ball)
    if d.quantity == "missing in the peer":
        return gain == 0
    if d.s < 0 or gain == 0:
        return False
    if d.quantity == "power [dB]":
        return bool(abs(decibel(c.peer.gain[d.s]) - decibel(gain)) < THRESHOLD[d.quantity])
    if d.quantity == "delay [ns]":
        return bool(abs(c.peer.delay[d.s] - delay) < ROUNDINGS * FLOAT32 * delay)
    share = gain * np.exp(-2j * np.pi * np.mod(f * delay, 1.0))
    turned = np.degrees(np.angle(c.peer.share(f)[d.s] / share))
    return bool(abs(turned) < THRESHOLD["phase [deg]"])


CAUSES = (
    Cause(
        "short segment",
        "Sionna RT drops every path with a segment under 1 cm (`MIN_SEGMENT_LENGTH` in its "
        "`constants.py`): here two bounces that near an edge. A link that lacks only such paths "
        "has the power of rfsg's other paths. rfsg keeps them.",
        short_segment,
    ),
    Cause(
        "delay of a wall",
        "The peer's delay through a wall is the straight length over c. A wave takes longer in "
        "the wall: rfsg adds the group delay of the slab, and equals the derivative of the closed "
        "form's phase.",
        slab_delay,
    ),
    Cause(
        "wall counted twice",
        "P.2040's transmission coefficient is from face to face: it holds the way through the "
        "thickness d. The path's length holds it too, so the peer's phase is off by "
        "-k d cos(theta), even where the wall is of vacuum, which should do nothing (case `wall of "
        "vacuum`). rfsg refers the coefficient to free space over the same stretch. Power of a "
        "single path is not touched; sums of paths are.",
        slab_phase,
    ),
    Cause(
        "float32",
        "The peer computes lengths and delays in float32, 24 bits: the delay is right to a few of "
        "its last places, and the phase is off by 2 pi f times that. With rfsg's delays and the "
        "peer's own amplitudes the power of the link agrees. Here the phase is even formed in "
        "float64 from the peer's delay.",
        float32_phase,
    ),
    Cause(
        "float32 vertices",
        "The peer's vertices are off by hundredths of a millimetre; between two that lie "
        "centimetres apart this turns the direction, and with it the angle at which a coefficient "
        "is taken. The closed form over the peer's own vertices gives the peer's power.",
        float32_vertices,
    ),
    Cause(
        "signs of an edge's terms",
        "On an edge both sides evaluate the four terms of Kouyoumjian and Pathak (1974), but "
        "Sionna RT 2.2 adds them with other signs (`_diffraction_matrix` in "
        "`radio_material.py`): the term that belongs to the reflection has the sign that does not "
        "close the gap which the reflected ray leaves where it ends, and the field across the "
        "edge has the terms of the field along it. The rule adds the closed form's terms with "
        "those signs and finds the peer's gain. That a field cannot step is the argument; see "
        "the table of steps.",
        edge_terms,
    ),
    Cause(
        "flat facets",
        "A mesh's triangle is a plane mirror. Most receivers see themselves in none, the rest in "
        "one that sends on lambda / (4 pi L), as if the ball were flat, by way of a point that lies "
        "below the ball. The rule looks for that triangle in the same mesh, and asks for its gain, "
        "delay and phase. More triangles make hits no better and no more frequent. "
        "rfsg's ball has a curvature, one path for each receiver, and the divergence factor of "
        "geometrical optics.",
        flat_facets,
    ),
)
SCATTERED = Cause(
    "polarisation of what scatters",
    "Sionna RT gives scattered waves the polarisation they came with, vertical to vertical; rfsg "
    "turns the field as the mirror's reflection, and from there to the tile's direction, so that "
    "a part of it is horizontal. The sum over both polarisations is the same in both, and that "
    "of the closed form. Effective roughness is a model of power and does not say which is right.",
    lambda c, d: False,  # takes two cases to see: compare.py
)
UNEXPLAINED = "UNEXPLAINED"


def cause_of(compared: Compared, difference: Difference) -> str:
    """Name of the first cause that explains a difference."""
    for cause in CAUSES:
        if cause.explains(compared, difference):
            return cause.name
    return UNEXPLAINED
