"""The scenes of the comparison, in plain numbers: neither rfsg nor its peer is known here.

Everything is axis-aligned, in metres and hertz, and drawn once. A ``Wall`` is a slab: rfsg gets the
box it fills, a tracer of sheets its front face and its thickness. A ``Block`` and a ``Ground`` let
nothing through: a sheet of them is given ``THICK`` metres, so that its back is never felt.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray

THICK = 10.0  # [m], thickness that stands for a half-space
Point = tuple[float, ...]  # x, y, z


@dataclass(frozen=True)
class Wall:
    """A slab that fills the box from ``low`` to ``high``; ``front`` is the face drawn as a sheet."""

    name: str
    low: Point
    high: Point
    front: str  # "+x", "-x", ...
    itu: str = "concrete"
    scattering: float = 0.0  # S, Lambertian, nothing cross-polarised

    @property
    def thickness(self) -> float:
        axis = "xyz".index(self.front[1])
        return self.high[axis] - self.low[axis]

    def faces(self) -> list[ndarray]:
        return [box_face(self.low, self.high, self.front)]


@dataclass(frozen=True)
class Block:
    """An opaque box."""

    name: str
    low: Point
    high: Point
    itu: str = "concrete"
    thickness = THICK

    def faces(self) -> list[ndarray]:
        return [box_face(self.low, self.high, s + a) for a in "xyz" for s in "-+"]


@dataclass(frozen=True)
class Ground:
    """Everything below z = 0; as a sheet it reaches ``reach`` metres to all sides."""

    name: str
    reach: float
    itu: str = "concrete"
    thickness = THICK

    def faces(self) -> list[ndarray]:
        return [box_face((-self.reach, -self.reach, -1.0), (self.reach, self.reach, 0.0), "+z")]


@dataclass(frozen=True)
class Ball:
    """A sphere; ``facets`` is how many triangles a mesh tracer gets."""

    name: str
    centre: Point
    radius: float
    facets: int = 0
    itu: str = "metal"
    thickness = THICK

    def faces(self) -> list[ndarray]:
        return []

    def triangles(self) -> ndarray:
        """[facets 3 3]: an icosahedron whose triangles are cut in four and pushed out."""
        g = (1 + 5**0.5) / 2
        v = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
        v = np.array(v + [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)])
        t = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4)]
        t += [(11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8)]
        t += [(3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
        corners = _unit(v)[np.array(t)]
        while len(corners) < self.facets:
            a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
            ab, bc, ca = _unit(a + b), _unit(b + c), _unit(c + a)
            parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
            corners = np.concatenate([np.stack(p, 1) for p in parts])
        return np.array(self.centre) + self.radius * corners


def _unit(v: ndarray) -> ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


Thing = Wall | Block | Ground | Ball


@dataclass(frozen=True)
class Case:
    """One question. ``move``: an object shifted by metres after the scene has been built."""

    name: str
    things: tuple[Thing, ...]
    transmitter: Point
    receivers: tuple[Point, ...]
    frequency: float
    depth: int
    refraction: bool = False
    move: tuple[str, Point] | None = None
    floor_db: float = -200.0
    polarization: str = "V"
    receiver_polarization: str = ""  # "": the same
    diffraction: bool = False  # round one edge, without reflections beside it
    diffuse: bool = False

    def standing(self) -> tuple[Thing, ...]:
        """The things where they stand once the move is made."""
        if self.move is None:
            return self.things
        name, by = self.move
        return tuple(_shifted(t, by) if t.name == name else t for t in self.things)


def box_face(low: Point, high: Point, which: str) -> ndarray:
    """[3 3]: a corner of one face of a box and its two edges u, v, with u x v outward."""
    axis, up = "xyz".index(which[1]), which[0] == "+"
    lo, hi = np.array(low, float), np.array(high, float)
    u, v = np.zeros(3), np.zeros(3)
    u[(axis + 1) % 3], v[(axis + 2) % 3] = (hi - lo)[(axis + 1) % 3], (hi - lo)[(axis + 2) % 3]
    corner = lo.copy()
    corner[axis] = hi[axis] if up else lo[axis]
    return np.stack([corner, u, v] if up else [corner, v, u])


def _shifted(thing: Thing, by: Point) -> Thing:
    assert isinstance(thing, Block)
    low, high = ((np.array(p) + by).tolist() for p in (thing.low, thing.high))
    return replace(thing, low=tuple(low), high=tuple(high))


# the scenes

ROOM = (6.0, 4.0, 3.0)
ROOM_TX = (1.31, 2.11, 1.73)
ROOM_RX = (
    (1.03, 1.21, 1.07), (5.17, 3.13, 2.29), (3.31, 0.71, 1.93), (4.47, 2.53, 0.41),
    (2.71, 3.37, 1.13), (5.63, 0.43, 1.51), (0.59, 3.61, 2.47), (3.93, 1.79, 2.83),
    (3.66, 3.054, 1.4),  # on purpose: it sees the transmitter in a corner, two bounces mm apart
)  # fmt: skip


def room_walls(size: Point = ROOM, thickness: float = 0.1) -> tuple[Wall, ...]:
    """Six slabs about an empty room whose inner faces lie at 0 and at ``size``."""
    walls = []
    for axis, letter in enumerate("xyz"):
        for side in (0, 1):
            low, high = [0.0, 0.0, 0.0], list(size)
            low[axis] = size[axis] if side else -thickness
            high[axis] = low[axis] + thickness
            front = ("-" if side else "+") + letter
            walls.append(Wall(f"{letter}{side}", tuple(low), tuple(high), front))
    return tuple(walls)


def rooms() -> list[Case]:
    return [
        Case(f"room {_ghz(f)}", room_walls(), ROOM_TX, ROOM_RX, f, depth=3) for f in (2.4e9, 28e9)
    ]


def moved_boxes() -> list[Case]:
    """A metal box in the room, where it stood and where it is moved to."""
    box = Block("box", (2.3, 1.2, 0.2), (3.1, 1.8, 1.9), "metal")
    things = (*room_walls(), box)
    still = Case("box 2.4 GHz", things, ROOM_TX, ROOM_RX, 2.4e9, depth=3)
    moved = replace(still, name="box moved 2.4 GHz", move=("box", (1.37, 0.83, 0.31)))
    return [still, moved, replace(moved, name="box moved 28 GHz", frequency=28e9)]


def grounds() -> list[Case]:
    distances = np.geomspace(10.0, 10_000.0, 13) * 1.0037  # no round numbers
    receivers = tuple((float(d), 0.0, 1.5) for d in distances)
    ground = (Ground("ground", 20_000.0),)
    return [
        Case(f"two-ray {_ghz(f)}", ground, (0.0, 0.0, 10.0), receivers, f, depth=1)
        for f in (2.4e9, 28e9)
    ]


def slabs() -> list[Case]:
    """One wall between the transmitter and half of the receivers."""
    wall = (Wall("wall", (0.0, -50.0, -50.0), (0.1, 50.0, 50.0), "-x"),)
    angles = np.radians([0.0, 15.0, 30.0, 45.0, 60.0, 75.0])
    behind = [(2.0, 5.0 * float(np.tan(a)), 0.0) for a in angles]
    before = [(-2.0, 5.0 * float(np.tan(a)), 0.4) for a in angles]
    return [
        Case(f"slab {_ghz(f)}", wall, (-3.0, 0.0, 0.0), (*behind, *before), f, 1, refraction=True)
        for f in (2.4e9, 28e9)
    ]


def vacuum() -> Case:
    """A wall of nothing, in the way: whatever changes the wave is the tracer's own."""
    case = slabs()[0]
    nothing = tuple(replace(w, itu="vacuum") for w in case.things)
    return replace(case, name="wall of vacuum", things=nothing, receivers=case.receivers[:6])


SPHERE_FACETS = (320, 1_280, 5_120, 20_480)


def spheres() -> list[Case]:
    """Receivers all about a ball's lit side, 5 m away like the transmitter, near its own height."""
    draw = np.random.default_rng(7)
    angle, lift = np.radians(draw.uniform((20.0, -15.0), (110.0, 15.0), (400, 2))).T
    places = np.stack([np.cos(angle), np.sin(angle) * np.cos(lift), np.sin(angle) * np.sin(lift)])
    receivers = tuple(tuple(p) for p in (5.0 * places.T).tolist())
    return [
        Case(
            f"sphere {n} facets",
            (Ball("ball", (0.0, 0.0, 0.0), 1.0, n),),
            (5.0, 0.0, 0.0),
            receivers,
            2.4e9,
            depth=1,
        )
        for n in SPHERE_FACETS
    ]


def canyons() -> list[Case]:
    """The buildings of Sionna RT's bundled simple_street_canyon, with its dimensions, as boxes."""
    buildings = {
        "b1": ((-62.108, -36.500), (-30.986, -8.613), 21.846, "glass"),
        "b2": ((32.357, 10.337), (63.478, 38.224), 21.846, "brick"),
        "b3": ((-62.411, 9.572), (-31.290, 37.458), 29.129, "marble"),
        "b4": ((-15.119, 9.572), (16.002, 37.458), 50.975, "marble"),
        "b5": ((31.519, -36.500), (62.640, -8.613), 29.129, "glass"),
        "b6": ((-15.119, -36.500), (16.002, -8.613), 50.975, "wood"),
    }
    things = [Block(n, (*a, 0.0), (*b, h), itu) for n, (a, b, h, itu) in buildings.items()]
    floor = Block("floor", (-93.966, -60.331, -1.0), (92.427, 60.808, 0.0), "concrete")
    draw = np.random.default_rng(3)
    low, high = np.array([-60.0, -7.5, 1.0]), np.array([60.0, 8.5, 6.0])
    receivers = tuple(tuple(p) for p in draw.uniform(low, high, (20, 3)).round(2).tolist())
    return [
        Case(f"canyon {_ghz(f)}", (*things, floor), (-33.3, 0.7, 32.1), receivers, f, depth=3)
        for f in (3.5e9, 28e9)
    ]


def wedges() -> list[Case]:
    """The corner of a tall metal building, receivers all round it: lit, reflected, in shadow; the
    last four on either side of where the reflection and the direct ray end."""
    corner = (Block("corner", (0.0, 0.0, -30.0), (30.0, 30.0, 30.0), "conductor"),)
    x, y = -6.1, 3.2
    ends = np.degrees([np.arctan2(-y, x), np.arctan2(-y, -x)]) % 360.0
    beside = (ends[:, None] + [-0.05, 0.05]).reshape(-1)
    angles = np.radians(np.concatenate([np.linspace(95.0, 355.0, 27), beside]))
    receivers = tuple((5.0 * float(np.cos(a)), 5.0 * float(np.sin(a)), 1.3) for a in angles)
    vertical = Case("wedge V", corner, (x, y, 0.2), receivers, 2.4e9, depth=1, diffraction=True)
    return [vertical, replace(vertical, name="wedge H", polarization="H")]


def diffuse() -> list[Case]:
    """A rough wall; the receivers' power is the sum of what both polarisations get."""
    wall = (Wall("wall", (0.0, -5.0, -3.0), (0.1, 5.0, 3.0), "-x", scattering=0.6),)
    receivers = ((-2.0, 2.0, 0.4), (-1.2, -3.0, 1.1), (-4.0, 0.7, -1.3), (-2.7, 4.2, 2.2))
    case = Case("", wall, (-3.1, -0.9, 0.3), receivers, 2.4e9, depth=1, diffuse=True)
    return [replace(case, name=f"diffuse V to {p}", receiver_polarization=p) for p in "VH"]


def all_cases() -> list[Case]:
    return [
        *rooms(),
        *moved_boxes(),
        *grounds(),
        *slabs(),
        vacuum(),
        *spheres(),
        *canyons(),
        *wedges(),
        *diffuse(),
    ]


def named(name: str) -> Case:
    return next(c for c in all_cases() if c.name == name)


def _ghz(frequency: float) -> str:
    return f"{frequency / 1e9:g} GHz"
