"""Where radios and objects may stand: inside, on, touching, coincident, a hair apart; none and many."""

import itertools
import math
import resource
import sys
import time
from collections.abc import Sequence

import torch
from mpmath import mp, mpc, mpf

from extremes import truths
from extremes.measure import DEEP, FLOOR_DB, Measured, Point, measure, node, wall_of
from extremes.table import GOOD, Note, Row, Section
from extremes.waves import NEAR
from rfsg.objects.body import Body
from rfsg.objects.contract import Shape, Surface
from rfsg.objects.shapes.analytic import Box, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.solid import Solid
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import Result, simulate

F = 2.4e9
DIRECT = Quality(depth=0, floor_db=FLOOR_DB)


def _free(a: Point, b: Point) -> mpc:
    return truths.friis(F, truths.distance(a, b))


# radios

COINCIDE = Note(
    "Two radios in one place: no direction and no path gain is defined; the link has no path.",
    "Move one of them; for two ports of one antenna simulate each against the rest.",
)
INSIDE = Note(
    "Nothing comes out of a conductor or an opaque half-space, and the result warns that the radio is "
    "inside.",
    "Place the radio outside, or give the object a material that lets waves through.",
)
WHOLE = Note(
    "A slab is one layer, crossed whole wherever in it the radio stands, and the result warns that "
    "the radio is inside.",
    "Give the object the material model `solid`, or place the radio outside.",
)
ON_FACE = Note(
    "On the face itself the path to it has no length and no direction: it is left out, and the line "
    "of sight stays. A hair before the face both are there, as (1 + R); the result warns of it.",
    "Set antennas where they are, in front of what they are mounted on.",
)


def radios(quick: bool) -> Section:
    metal, glass = node(Body(Sphere(0.5), Conductor())), _slab()
    far: Point = (5.0, 0.3, 0.2)
    face: Point = (0.1, 0.0, 0.0)
    straight = [_free(face, far)]
    rows = [
        _row("tx and rx coincide", [], far, far, None, COINCIDE),
        _row("tx and rx 1e-10 m apart", [], (0.0, 0.0, 0.0), (1e-10, 0.0, 0.0), None, COINCIDE),
        _row("tx and rx 1 um apart", [], (0.0, 0.0, 0.0), (1e-6, 0.0, 0.0),
             [_free((0.0, 0.0, 0.0), (1e-6, 0.0, 0.0))], NEAR),
        _row("tx in a metal ball", [metal], (0.1, 0.0, 0.0), far, [], INSIDE),
        _row("tx at its centre", [metal], (0.0, 0.0, 0.0), far, [], INSIDE),
        _row("both in it", [metal], (0.1, 0.0, 0.0), (-0.2, 0.1, 0.0), [], INSIDE),
        _row("tx on its pole", [metal], (0.5, 0.0, 0.0), far, [_free((0.5, 0.0, 0.0), far)], ON_FACE),
        _row("tx in a slab", [glass], (0.03, 0.0, 0.0), far, [_through_slab((0.03, 0.0, 0.0), far)],
             WHOLE),
        _row("tx on its face, rx in front", [glass], face, far, straight, ON_FACE),
        _row("tx on its face, rx behind", [glass], face, (-5.0, 0.3, 0.2),
             [_through_slab(face, (-5.0, 0.3, 0.2))], ON_FACE),
        _row("tx on its edge", [glass], (0.1, 2.0, 0.0), far, [_free((0.1, 2.0, 0.0), far)], ON_FACE),
        _row("tx on its corner", [glass], (0.1, 2.0, 2.0), far, [_free((0.1, 2.0, 2.0), far)], ON_FACE),
        _row("tx under the ground", [_ground()], (0.0, 0.0, -1.0), (5.0, 0.0, 2.0), [], INSIDE),
        _row("both on the ground", [_ground()], (0.0, 0.0, 0.0), (5.0, 0.0, 0.0),
             [_free((0.0, 0.0, 0.0), (5.0, 0.0, 0.0))], ON_FACE),
    ]  # fmt: skip
    return Section(
        "Radios inside, on and at each other",
        "Friis, a slab's T, or no path at all, as each case has it; reflections asked for throughout.",
        ("worst path",),
        tuple(rows[:: 4 if quick else 1]),
        "radios outside objects, further from surfaces and each other than lambda / 2 pi.",
    )


def _slab() -> Node:
    return node(Body(Box([0.1, 2.0, 2.0]), wall_of(0.2)))


def _ground() -> Node:
    return node(Body(HalfSpace(), DielectricHalfSpace(eps_r=5.0, sigma=0.01)))


def _through_slab(a: Point, b: Point, thickness: float = 0.2) -> mpc:
    """Through a wall across x, drawn or cut as one layer."""
    length = truths.distance(a, b)
    eps = truths.permittivity(5.24, 0.05, F)
    cosine = abs(mpf(a[0]) - mpf(b[0])) / length
    return truths.scalar(truths.slab(cosine, eps, thickness, F)[1]) * truths.friis(F, length)


def _row(
    case: str,
    nodes: Sequence[Node],
    tx: Point,
    rx: Point,
    true: Sequence[mpc] | None,
    note: Note | None = None,
    quality: Quality = DEEP,
) -> Row:
    found = measure(nodes, tx, rx, F, quality)
    error = None if true is None else found.errors(true)
    words = found.status + (", warned" if found.result.warnings else "")
    return Row(case, (error,), words, found.gradient, note)


# objects

OPAQUE = Note("True: metal stands on the only path.", "Nothing to do.")
TWICE = Note(
    "True of what is drawn: two slabs, each crossed whole. Slabs that overlap, are nested, or are "
    "cut in thickness are not the one wall that they look like.",
    "Draw a slab in one piece; cut, overlap and nest with the material model `solid`.",
)
SEAM = Note(
    "f of each half is 0 on the seam, where a ray along it runs: the model sees two surfaces there, "
    "and not the middle of one wall.",
    "Draw a stochastic object in one piece.",
)
HALVED = Note(
    "The model has a boundary for each piece: two halves lose what two surfaces lose. Their bulk "
    "alone (kappa) adds up.",
    "Draw a stochastic object in one piece.",
)


def objects(quick: bool) -> Section:
    a, b = (-4.0, 0.3, 0.2), (4.0, 1.2, -0.3)
    wall = wall_of(0.2)
    one = _through_slab(a, b)
    half = wall_of(0.1)
    mirror = Pose.at(0.0, 0.0, 0.0)
    flip = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    mirrored = Node("/n", Body(Box([0.1, 3.0, 3.0]), wall),
                    Pose(mirror.rotation @ flip, mirror.translation, mirror.scale))  # fmt: skip
    scaled = Node("/n", Body(Box([100.0, 3000.0, 3000.0]), wall), Pose.at(0, 0, 0, 0.0, 1e-3))
    solid = Solid(eps_r=5.24, sigma=0.05)
    cloth = StochasticSurface(m=0.5, alpha=0.8, sharpness=30.0)
    cloth_alone = _stochastic(a, b, 0.2)
    along = (-4.0, 0.0, 0.0), (4.0, 0.0, 0.0)
    cases: list[tuple[str, list[Node], list[mpc] | None, Note | None]] = [
        ("one wall", _boxes(wall, ((0, 0, 0), (0.1, 3, 3))), [one], None),
        ("mirrored", [mirrored], [one], None),
        ("drawn in millimetres, scale 1e-3", [scaled], [one], None),
        ("halves side by side", _halves(wall), [one], None),
        ("flush halves in thickness, slab", _boxes(half, *_STACKED), [_product(a, b)], TWICE),
        ("flush halves in thickness, solid", _boxes(solid, *_STACKED), [one], None),
        ("flush halves in thickness, stochastic", _boxes(cloth, *_STACKED),
         [_stochastic(a, b, 0.1, 2)], HALVED),
        ("stochastic, one piece", _boxes(cloth, ((0, 0, 0), (0.1, 3, 3))), [cloth_alone], None),
        ("coincident slabs", _boxes(wall, *[((0, 0, 0), (0.1, 3, 3))] * 2), [_product(a, b, 0.2)],
         TWICE),
        ("overlapping slabs", _boxes(wall, ((0, 0, 0), (0.1, 3, 3)), ((0.05, 0, 0), (0.1, 3, 3))),
         [_product(a, b, 0.2)], TWICE),
        ("coincident solids", _boxes(solid, *[((0, 0, 0), (0.1, 3, 3))] * 2), [one], None),
        ("overlapping solids",
         _boxes(solid, ((-0.05, 0, 0), (0.05, 3, 3)), ((0.0, 0, 0), (0.1, 3, 3))), [one], None),
        ("metal in a slab", [*_boxes(wall, ((0, 0, 0), (0.1, 3, 3))),
                             *_boxes(Conductor(), ((0, 0.75, 0), (0.02, 1, 1)), first=1)], [], OPAQUE),
        ("coincident metal and slab", [*_boxes(wall, ((0, 0, 0), (0.1, 3, 3))),
                                       *_boxes(Conductor(), ((0, 0, 0), (0.1, 3, 3)), first=1)], [],
         OPAQUE),
    ]  # fmt: skip
    rows = [_row(name, nodes, a, b, true, note, DIRECT) for name, nodes, true, note in cases]
    seams: list[tuple[str, Surface, mpc | None, Note | None]] = [
        ("ray along the seam of two slabs", wall, _through_slab(*along), None),
        ("ray along the seam of two solids", solid, _through_slab(*along), None),
        ("ray along the seam of two stochastic halves", cloth, None, SEAM),
    ]
    rows += [
        _row(name, _halves(surface), *along, None if true is None else [true], note, DIRECT)
        for name, surface, true, note in seams
    ]
    rows += [_tiles(pieces) for pieces in (2, 4)]
    return Section(
        "Objects touching, overlapping, nested, mirrored",
        "One wall of 20 cm (T of a layer, or the stochastic integral in closed form), whole and in "
        "pieces; a metal floor, whole and in tiles, whose bounce lies on their seam.",
        ("worst path",),
        tuple(rows[:: 4 if quick else 1]),
        "slabs and stochastic objects in one piece; solids in any number of flush or overlapping ones.",
    )


_STACKED = (((-0.05, 0, 0), (0.05, 3, 3)), ((0.05, 0, 0), (0.05, 3, 3)))
Place = tuple[Sequence[float], Sequence[float]]


def _boxes(surface: Surface, *places: Place, first: int = 0) -> list[Node]:
    return [
        node(Body(_box(h), surface), (float(c[0]), float(c[1]), float(c[2])), path=f"/n{first + i}")
        for i, (c, h) in enumerate(places)
    ]


def _box(half: Sequence[float]) -> Shape:
    return Box([float(x) for x in half])


def _halves(surface: Surface) -> list[Node]:
    return _boxes(surface, ((0, -1.5, 0), (0.1, 1.5, 3)), ((0, 1.5, 0), (0.1, 1.5, 3)))


def _product(a: Point, b: Point, thickness: float = 0.1) -> mpc:
    """Two slabs, one after the other: with scalar links the mean power of each."""
    return _through_slab(a, b, thickness) ** 2 / _free(a, b)


def _stochastic(a: Point, b: Point, thickness: float, times: int = 1) -> mpc:
    length = truths.distance(a, b)
    cosine = abs(mpf(a[0]) - mpf(b[0])) / length
    t = truths.stochastic_plate("logistic", 30.0, 0.5, 0.8, cosine, thickness, 0.05)
    return t**times * truths.friis(F, length)


def _tiles(pieces: int) -> Row:
    """A metal floor whose tiles meet where the path bounces."""
    places = [((-1.5, 0.0), (1.5, 3.0)), ((1.5, 0.0), (1.5, 3.0))]
    if pieces == 4:
        places = [((x, y), (1.5, 1.5)) for x, y in itertools.product((-1.5, 1.5), repeat=2)]
    nodes = _boxes(Conductor(), *(((*c, -0.1), (*h, 0.1)) for c, h in places))
    tx, rx = (-2.0, 0.0, 2.0), (2.0, 0.0, 2.0)
    found = measure(nodes, tx, rx, F)
    error = found.errors([_free(tx, rx), -_free(tx, (2.0, 0.0, -2.0))])
    one = found.status == f"OK 2, DUPLICATE {pieces - 1}"
    return Row(f"bounce where {pieces} tiles meet", (error,), found.status, found.gradient,
               expected=one)  # fmt: skip


# vertices

HAIR = Note(
    "Vertices nearer than a nanometre define no direction: the candidate ends as DEGENERATE.",
    "Nothing to do: the corner is sharp to less than an atom.",
)


def vertices(quick: bool) -> Section:
    """Two bounces in a corner of metal, so and so far apart."""
    rows = []
    for apart in (1.0, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10)[:: 3 if quick else 1]:
        e = apart / math.sqrt(2)
        tx, rx = (e + 3.0, 3.0, 0.3), (2.0, e + 2.0, -0.2)
        nodes = _boxes(Conductor(), ((-0.1, 4.8, 0), (0.1, 5, 5)), ((5, -0.1, 0), (5, 0.1, 5)))
        found = measure(nodes, tx, rx, F, Quality(depth=2, floor_db=FLOOR_DB))
        images = [(tx, 1), ((-tx[0], tx[1], tx[2]), -1), ((tx[0], -tx[1], tx[2]), -1)]
        hair = apart < 1e-9
        if not hair:
            images.append(((-tx[0], -tx[1], tx[2]), 1))
        true = sorted((truths.distance(p, rx), sign) for p, sign in images)
        shares = [sign * truths.friis(F, length) for length, sign in true]
        rows.append(
            Row(f"{apart:g} m", (found.errors(shares),), found.status, found.gradient,
                HAIR if hair else None)
        )  # fmt: skip
    return Section(
        "Vertices close together",
        "Two bounces in a corner of metal walls, so far apart, beside the single bounces and the line "
        "of sight: all four against the image method. (A peer drops segments under 1 cm.)",
        ("worst path",),
        tuple(rows),
        "down to a nanometre.",
    )


# depth

ROOM = (6.0, 4.0, 3.0)
TX, RX = (1.31, 2.11, 1.73), (4.47, 2.53, 0.41)
CANDIDATES = Note(
    "All paths are there. The rest are candidates that the search proposed and the exact solver "
    "dropped, each counted under its reason.",
    "Nothing to do.",
)


def depth(quick: bool) -> Section:
    rows = []
    for most in (0, 2, 5) if quick else range(11):
        start = time.perf_counter()
        found = measure(_room(), TX, RX, F, Quality(depth=most, floor_db=FLOOR_DB))
        spent = time.perf_counter() - start
        true = _images(most)
        rows.append(
            Row(f"{most}: {len(true)} paths, {spent:.2g} s", (found.errors(true),), found.status,
                found.gradient, CANDIDATES if "OFF_SURFACE" in found.status else None)
        )  # fmt: skip
    return Section(
        "Depth",
        "An empty room of 6 x 4 x 3 m with walls of metal, one link: every path to that many "
        "reflections, 1 + sum of 4 n^2 + 2, against the image method (Allen and Berkley 1979). "
        "Seconds as they came, with gradients.",
        ("worst path",),
        tuple(rows),
        "as many reflections as time allows; the count of candidates triples with each in a room.",
    )


def _room() -> list[Node]:
    nodes = []
    for axis, side in itertools.product(range(3), (0, 1)):
        centre, half = [s / 2 for s in ROOM], [s / 2 for s in ROOM]
        half[axis], centre[axis] = 0.1, ROOM[axis] + 0.1 if side else -0.1
        nodes += _boxes(Conductor(), (centre, half), first=len(nodes))
    return nodes


def _images(most: int) -> list[mpc]:
    """Shares of all images up to so many reflections, by length; each reflection turns the sign."""
    found = []
    for n in itertools.product(range(-most, most + 1), repeat=3):
        count = sum(abs(k) for k in n)
        if count > most:
            continue
        image = [
            mpf(ROOM[a]) * n[a] + (mpf(TX[a]) if n[a] % 2 == 0 else mpf(ROOM[a]) - mpf(TX[a]))
            for a in range(3)
        ]
        length = mp.sqrt(sum((x - mpf(y)) ** 2 for x, y in zip(image, RX, strict=True)))
        found.append((length, (-1) ** count * truths.friis(F, length)))
    return [share for _, share in sorted(found, key=lambda x: x[0])]


# count

RAYS = Note(
    "Too many sequences of faces to try them all: the search launches rays, says so in the plan "
    "(`SearchReport.complete` is false), and may miss thin beams. What it finds is exact.",
    "Ask for more rays where a path counts, or for fewer objects: those near the link.",
)
NOBODY = Note("Nobody sends or nobody listens: an empty answer, not an error.", "Nothing to do.")


def count(quick: bool) -> Section:
    rows = [_nobody(), _crowd(0), _crowd(1)]
    if not quick:
        rows += [_crowd(100), _crowd(10_000)]
    return Section(
        "Number of objects",
        "Instances of one box on metal ground, draft quality, one receiver. The error is that of the "
        "line of sight above them; seconds and the process's peak memory as they came.",
        ("line of sight",),
        tuple(rows),
        "some thousand objects with every sequence of faces looked at, 10^4 by rays.",
    )


def _nobody() -> Row:
    result = simulate(Scene((), (), ()), F, "draft")
    empty = result.transfer().shape == (0, 0, 1) and result.links() == []
    return Row("no radios, no objects", (0.0 if empty else math.inf,), "empty", None, NOBODY)


def _crowd(number: int) -> Row:
    side = max(1, math.isqrt(number))
    body = Body(Box([0.2, 0.2, 1.0]), wall_of())
    turn = torch.rand(number, generator=torch.Generator().manual_seed(0)).tolist()
    nodes = [
        node(body, (i % side + 0.3 * turn[i], float(i // side), 1.0), 90.0 * turn[i], f"/n{i}")
        for i in range(number)
    ]
    ground = node(Body(HalfSpace(), Conductor()), path="/ground") if number else None
    everything = tuple([*nodes, *([ground] if ground else [])])
    tx, rx = (side / 2, side / 2, 6.0), (side / 2 + 7.3, side / 2 + 4.1, 3.5)
    start = time.perf_counter()
    result = simulate(Scene(everything, (Radio.at("/t", *tx),), (Radio.at("/r", *rx),)), F, "draft")
    spent = time.perf_counter() - start
    error = _line_of_sight_error(result, _free(tx, rx))
    complete = result.search.complete or not number
    status = Measured(result, [], None, torch.zeros(3)).status
    what = f"{number} objects, {spent:.2g} s, {_peak():.2g} GiB"
    note = None if complete else RAYS
    if complete and set(status) - set("OK 0123456789"):
        note = CANDIDATES
    return Row(what, (error,), status, None, note, GOOD)


def _line_of_sight_error(result: Result, true: mpc) -> float:
    direct = torch.nonzero((result.paths.which < 0).all(1)).squeeze(-1).tolist()
    if len(direct) != 1:
        return math.inf
    turns = mp.frac(mpf(F) * mpf(result.channel.delay[direct[0]].item()))
    share = mpc(result.channel.gain[direct[0], 0].item()) * mp.expjpi(-2 * turns)
    return float(abs(share - true) / abs(true))


def _peak() -> float:
    """Most memory that this process held so far [GiB]."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (2**30 if sys.platform == "darwin" else 2**20)


SECTIONS = (radios, objects, vertices, depth, count)
