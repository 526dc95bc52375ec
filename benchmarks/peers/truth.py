"""Closed forms to hold both sides against: plain numpy in float64, slow, short, and no tracer.

Flat scenes: the image method (Allen & Berkley 1979, for any rectangles), with exact blocking. Sphere:
the divergence factor of geometrical optics (Balanis 2012, section 13.3). Coefficients: the single
layer of Recommendation ITU-R P.2040-4 section 2.2.2. Edges: the uniform theory of diffraction for a
perfect conductor (Kouyoumjian & Pathak 1974, Proc. IEEE 62(11), here [KP]). Time convention exp(+j 2 pi f t).
"""

from itertools import product

import edges
import numpy as np
from cases import Ball, Case, Thing, Wall
from exchange import DIFFRACT, REFLECT, Traced
from numpy import ndarray
from waves import C, antenna, bent, divergence, layer, permittivity

ENDS = 1e-9  # of a segment: what it meets this near to its ends is where it comes from
INSIDE = 1e-9  # [m] how far beyond a rectangle's edge still counts as on it


# flat scenes


class _Faces:
    """All rectangles of a scene: corner, u, v, n [m 3], owner [m], one-sided [m]."""

    def __init__(self, things: tuple[Thing, ...]):
        flat = [(i, f) for i, t in enumerate(things) for f in t.faces()]
        self.owner = np.array([i for i, _ in flat], int)
        self.corner, self.u, self.v = np.stack([f for _, f in flat], 1)
        n = np.cross(self.u, self.v)
        self.n = n / np.linalg.norm(n, axis=1, keepdims=True)
        self.sheet = np.array([isinstance(things[i], Wall) for i in self.owner])

    def mirror(self, face: ndarray, point: ndarray) -> ndarray:
        height = ((point - self.corner[face]) * self.n[face]).sum(-1, keepdims=True)
        return point - 2 * height * self.n[face]

    def meet(self, face: ndarray, start: ndarray, end: ndarray) -> tuple[ndarray, ndarray]:
        """Where lines from start to end meet the faces' planes, and whether within the faces and
        strictly between the ends."""
        a = ((start - self.corner[face]) * self.n[face]).sum(-1)
        b = ((end - self.corner[face]) * self.n[face]).sum(-1)
        parallel = a == b
        t = np.where(parallel, -1.0, a / np.where(parallel, 1.0, a - b))
        point = start + t[..., None] * (end - start)
        within = (t > ENDS) & (t < 1 - ENDS)
        for edge in (self.u, self.v):
            length = np.linalg.norm(edge[face], axis=-1)
            along = ((point - self.corner[face]) * edge[face]).sum(-1) / length
            within &= (along > -INSIDE) & (along < length + INSIDE)
        return point, within


def gain_along(case: Case, items: ndarray, points: ndarray) -> complex:
    """What the closed form gives on a polyline [k 3] that bounces on ``items``, exact or not."""
    faces = _Faces(case.standing())
    sequence = []
    for item, point in zip(items, points[1:-1], strict=True):
        off = np.abs(((point - faces.corner) * faces.n).sum(1))
        sequence.append(np.where(faces.owner == item, off, np.inf).argmin())
    row = _path(case, case.standing(), faces, np.array(sequence, int), points)
    return 0j if row is None else row[2]


def images(case: Case) -> Traced:
    """Every path of a scene of rectangles, by the image method."""
    things = case.standing()
    faces = _Faces(things)
    rows = []
    for r, receiver in enumerate(np.array(case.receivers)):
        for depth in range(case.depth + 1):
            sequences = _sequences(len(faces.n), depth)
            ends = np.array(case.transmitter), receiver
            for sequence, points in _reflected(faces, sequences, *ends):
                row = _path(case, things, faces, sequence, points)
                if row is not None:
                    kinds = np.full(depth, REFLECT)
                    rows.append((r, kinds, faces.owner[sequence], points[1:-1], *row))
        if case.diffraction:
            rows += [(r, *row) for row in _diffracted(case, faces, receiver)]
    return _traced(case, things, rows)


def _sequences(count: int, depth: int) -> ndarray:
    """[n depth]: all sequences of faces without the same one twice running."""
    all_of = np.array(list(product(range(count), repeat=depth)), int).reshape(count**depth, depth)
    return all_of[(all_of[:, 1:] != all_of[:, :-1]).all(1)]


def _reflected(faces: _Faces, sequences: ndarray, tx: ndarray, rx: ndarray):
    """(sequence, [d+2 3] points) of those whose images see each other through their faces."""
    depth = sequences.shape[1]
    image = [np.broadcast_to(tx, (len(sequences), 3))]
    for level in range(depth):
        image.append(faces.mirror(sequences[:, level], image[-1]))
    points = np.empty((len(sequences), depth + 2, 3))
    points[:, 0], points[:, -1] = tx, rx
    good = np.ones(len(sequences), bool)
    for level in range(depth, 0, -1):
        face = sequences[:, level - 1]
        points[:, level], within = faces.meet(face, points[:, level + 1], image[level])
        good &= within
    for i in np.nonzero(good)[0]:
        before, after = points[i, :-2] - points[i, 1:-1], points[i, 2:] - points[i, 1:-1]
        n = faces.n[sequences[i]]
        sides = (before * n).sum(1), (after * n).sum(1)
        front = (sides[0] > 0) & (sides[1] > 0)
        back = (sides[0] < 0) & (sides[1] < 0) & faces.sheet[sequences[i]]
        if (front | back).all():
            yield sequences[i], points[i]


def _path(case: Case, things, faces: _Faces, sequence: ndarray, points: ndarray):
    """(crossed, delay, gain, departure, arrival) of one path; None where it is blocked."""
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=1)
    k = step / length[:, None]
    field = antenna(case.polarization, k[0]).astype(complex)
    crossed, excess = 0, 0.0
    for s in range(len(k)):
        own = sequence[max(s - 1, 0) : s + 1]
        for face in np.nonzero(faces.meet(np.arange(len(faces.n)), points[s], points[s + 1])[1])[0]:
            if face in own:
                continue
            if not (faces.sheet[face] and case.refraction):
                return None
            n, thing = faces.n[face], things[faces.owner[face]]
            cosine = abs(k[s] @ n)
            te, tm, _, delay = _crossing(thing, cosine, case.frequency)
            field = bent(field, k[s], k[s], n, te, tm)
            excess += delay
            crossed += 1
        if s < len(sequence):
            n, thing = faces.n[sequence[s]], things[faces.owner[sequence[s]]]
            eps = permittivity(thing.itu, case.frequency)
            te, tm, _, _ = layer(abs(k[s] @ n), eps, thing.thickness, case.frequency)
            rough = thing.scattering if isinstance(thing, Wall) else 0.0
            field = bent(field, k[s], k[s + 1], n, te, tm) * np.sqrt(1 - rough**2)
    total = length.sum()
    gain = (antenna(case.polarization, -k[-1]) @ field) * C / case.frequency / (4 * np.pi * total)
    gain *= np.exp(2j * np.pi * np.mod(case.frequency * excess, 1.0))
    return crossed, total / C + excess, gain, k[0], -k[-1]


def _crossing(thing: Thing, cosine: float, frequency: float):
    """T_TE, T_TM and their phase relative to free space over the same stretch, and the group delay
    of TE beyond it [s].

    A path's length counts the thickness; T of the layer holds the travel through it too. Both
    together would count it twice, so T is divided by exp(-j k d cos).
    """

    def relative(f: float) -> ndarray:
        te, tm = layer(cosine, permittivity(thing.itu, f), thing.thickness, f)[2:]
        return np.array([te, tm]) * np.exp(2j * np.pi * f / C * thing.thickness * cosine)

    step = 1e4  # [Hz]
    te, tm = relative(frequency)
    turn = np.angle(relative(frequency + step)[0] / relative(frequency - step)[0])
    return te, tm, np.angle(te), -turn / (4 * np.pi * step)


def _diffracted(case: Case, faces: _Faces, rx: ndarray):
    """(kinds, items, vertex, crossed, delay, gain, departure, arrival) round each edge in sight."""
    tx, every = np.array(case.transmitter), np.arange(len(faces.n))
    for edge in edges.bending(case, rx):
        if any(faces.meet(every, end, edge.point)[1].any() for end in (tx, rx)):
            continue
        first, last = edge.point - tx, rx - edge.point
        s1, s2 = np.linalg.norm(first), np.linalg.norm(last)
        gain = (edges.CONDUCTOR * edges.terms(case, edge, rx)).sum()
        kinds, items = np.array([DIFFRACT]), np.array([edge.item])
        ends = first / s1, -last / s2
        yield kinds, items, edge.point[None], 0, (s1 + s2) / C, gain, *ends


def diffuse_power(case: Case) -> ndarray:
    """What a rough wall scatters to each receiver, both polarisations together, by quadrature.

    (lambda / 4 pi)^2 S^2 integral |R|^2 cos(theta_i) p / (d1 d2)^2 dA, p = cos(theta_s) / pi (the
    effective roughness model, Degli-Esposti et al. 2007, IEEE Trans. AP 55(1), Lambertian).
    """
    (wall,) = (t for t in case.things if isinstance(t, Wall))
    corner, u, v = wall.faces()[0]
    n = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    place, weight = np.polynomial.legendre.leggauss(200)
    a, b = (x[..., None] for x in np.meshgrid((place + 1) / 2, (place + 1) / 2))
    point = corner + a * u + b * v
    area = np.outer(weight, weight) / 4 * np.linalg.norm(np.cross(u, v))
    first = point - np.array(case.transmitter)
    d1 = np.linalg.norm(first, axis=-1)
    k = first / d1[..., None]
    across = np.cross(k, n)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    field = np.apply_along_axis(lambda x: antenna(case.polarization, x), -1, k)
    te_share = (field * across).sum(-1) ** 2
    cosine = -(k @ n)
    te, tm, _, _ = layer(
        cosine, permittivity(wall.itu, case.frequency), wall.thickness, case.frequency
    )
    power = te_share * np.abs(te) ** 2 + (1 - te_share) * np.abs(tm) ** 2
    total = []
    for rx in np.array(case.receivers):
        d2 = np.linalg.norm(rx - point, axis=-1)
        lobe = ((rx - point) @ n) / d2 / np.pi
        total.append((area * power * cosine * lobe / (d1 * d2) ** 2).sum())
    return np.array(total) * (wall.scattering * C / case.frequency / (4 * np.pi)) ** 2


# sphere


def sphere(case: Case) -> Traced:
    """Line of sight and the one glint on a ball, for every receiver on its lit side."""
    (ball,) = case.things
    assert isinstance(ball, Ball)
    centre, tx = np.array(ball.centre), np.array(case.transmitter)
    eps, way = permittivity(ball.itu, case.frequency), case.polarization
    rows = []
    for r, rx in enumerate(np.array(case.receivers)):
        u = rx - tx
        near = tx + u * np.clip((centre - tx) @ u / (u @ u), 0, 1)
        wave = C / case.frequency / (4 * np.pi)
        none = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3))
        if np.linalg.norm(near - centre) > ball.radius:
            distance = np.linalg.norm(u)
            k = u / distance
            gain = antenna(way, k) @ antenna(way, -k) * wave / distance
            rows.append((r, *none, 0, distance / C, gain, k, -k))
        glint, n = _glint(centre, ball.radius, tx, rx)
        s1, s2 = float(np.linalg.norm(glint - tx)), float(np.linalg.norm(rx - glint))
        k, onward = (glint - tx) / s1, (rx - glint) / s2
        cosine = -float(k @ n)
        spread = divergence(s1, s2, cosine, ball.radius)
        te, tm, _, _ = layer(cosine, eps, ball.thickness, case.frequency)
        field = bent(antenna(way, k).astype(complex), k, onward, n, te, tm)
        gain = (antenna(way, -onward) @ field) * wave * spread
        rows.append(
            (r, np.array([REFLECT]), np.array([0]), glint[None], 0, (s1 + s2) / C, gain, k, -onward)
        )
    return _traced(case, case.things, rows)


def mirrored_on_facets(ball: Ball, tx: ndarray, rx: ndarray) -> ndarray:
    """[m 3]: where triangles of the ball's mesh show the transmitter to the receiver as mirrors."""
    a, b, c = ball.triangles().transpose(1, 0, 2)
    n = np.cross(b - a, c - a)
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    height, above = (((p - a) * n).sum(1) for p in (tx, rx))
    point = tx + (height / (height + above))[:, None] * (rx - 2 * above[:, None] * n - tx)
    sides = [(np.cross(q - p, point - p) * n).sum(1) > 0 for p, q in ((a, b), (b, c), (c, a))]
    return point[(height > 0) & (above > 0) & np.all(sides, 0)]


def _glint(centre: ndarray, radius: float, tx: ndarray, rx: ndarray) -> tuple[ndarray, ndarray]:
    """The shortest way over the sphere's lit side: bisection on the angle between the two radii."""
    a, b = tx - centre, rx - centre
    e1 = a / np.linalg.norm(a)
    e2 = b - (b @ e1) * e1
    e2 /= np.linalg.norm(e2)
    low, high = 0.0, np.arctan2(b @ e2, b @ e1)
    for _ in range(100):
        angle = (low + high) / 2
        n = np.cos(angle) * e1 + np.sin(angle) * e2
        p = centre + radius * n
        along = np.cross(np.cross(e1, e2), n)  # of growing angle
        slope = along @ ((p - tx) / np.linalg.norm(p - tx) + (p - rx) / np.linalg.norm(p - rx))
        low, high = (angle, high) if slope < 0 else (low, angle)
    return p, n


def _traced(case: Case, things: tuple[Thing, ...], rows: list) -> Traced:
    deep = max(1, case.depth)
    kind, item = np.full((2, len(rows), deep), -1)
    vertex = np.full((len(rows), deep, 3), np.nan)
    for p, (_, kinds, items, points, *_) in enumerate(rows):
        used = slice(0, len(kinds))
        kind[p, used], item[p, used], vertex[p, used] = kinds, items, points
    rx, _, _, _, crossed, delay, gain, departure, arrival = zip(*rows, strict=True)
    return Traced(
        names=np.array([t.name for t in things]),
        rx=np.array(rx),
        kind=kind,
        item=item,
        vertex=vertex,
        crossed=np.array(crossed),
        delay=np.array(delay),
        gain=np.array(gain, complex),
        departure=np.stack(departure),
        arrival=np.stack(arrival),
    )


def solve(case: Case) -> Traced:
    """The closed form of whichever kind of scene this is."""
    return sphere(case) if any(isinstance(t, Ball) for t in case.things) else images(case)
