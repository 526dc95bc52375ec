"""Frequency, distance, size, thickness and incidence, against closed forms in 50 digits."""

import math
from collections.abc import Callable

from mpmath import mpc, mpf

from extremes import truths
from extremes.measure import Measured, measure, node, wall_of
from extremes.table import GOOD, Note, Row, Section
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, HalfSpace, Sphere
from rfsg.objects.shapes.mesh import extruded
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace

EPS, SIGMA = 5.0, 0.01
CONCRETE, SEA_WATER = (5.24, 0.05), (80.0, 5.0)  # eps_r, sigma [S/m]
FREQUENCIES = (1e8, 3e8, 1e9, 2.4e9, 1e10, 2.8e10, 6e10, 1e11, 3e11)
DISTANCES = tuple(10.0**k for k in range(-3, 6))
SIZES = (0.01, 0.03, 0.1, 0.125, 0.25, 1.0, 10.0, 100.0, 1000.0)
THICKNESSES = (1e-4, 1e-3, 1e-2, 0.1, 0.3, 1.0, 3.0, 10.0)
ANGLES = (0.0, 10.0, 45.0, 70.0, 80.0, 89.0, 89.9, 89.99, 89.999, 90.0)

ELL = ((0.0, 0.0), (1.0, 0.0), (1.0, 0.4), (0.4, 0.4), (0.4, 1.0), (0.0, 1.0))  # in widths
ON_IT, BESIDE_IT = (0.2, 0.7), (0.7, 0.7)

TURNS = Note(
    "float64 holds a path of N wavelengths to N x 1e-16 turns of phase: what is left is rounding of "
    "coordinates, not of the tracer.",
    "Nothing to do; amplitudes are exact to 1e-15, and phases of real links are not known so well.",
)
NEAR = Note(
    "The radios stand closer than lambda / 2 pi: the tracer computes Friis exactly and warns, for "
    "Friis does not hold there; a path gain above 1 is its way of saying so.",
    "Do not use path gains between antennas in each other's near field.",
)
BLOCKED = Note(
    "True: the wall lets through less than -600 dB, which counts as nothing, whatever the floor.",
    "Nothing to do.",
)
SMALL = Note(
    "The ball is narrower than a wavelength: rays do not describe how it scatters, and the tracer "
    "warns by name. What it computes is still exactly the reflection of rays, capped near the focus.",
    "Leave such objects out, or measure what they do; raise the frequency to ask of their shape.",
)
FLAT = Note(
    "At exactly 90 degrees the line of sight runs in the face: it is free, and there is no "
    "reflection. A hair above, the reflection is there and cancels the line of sight.",
    "Do not put both radios in the plane of a face; a millimetre of height decides.",
)


def two_ray(frequency: float, d: float, up: float, down: float) -> tuple[Measured, float]:
    """A link over ground, and the worst error of its two paths."""
    ground = node(Body(HalfSpace(), DielectricHalfSpace(eps_r=EPS, sigma=SIGMA)))
    tx, rx = (0.0, 0.0, up), (d, 0.0, down)
    found = measure([ground], tx, rx, frequency)
    bounced = truths.distance(tx, (d, 0.0, -down))
    eps = truths.permittivity(EPS, SIGMA, frequency)
    r = truths.scalar(truths.fresnel((mpf(up) + mpf(down)) / bounced, eps))
    straight = truths.friis(frequency, truths.distance(tx, rx))
    return found, found.errors([straight, r * truths.friis(frequency, bounced)])


def free(frequency: float, d: float) -> tuple[Measured, float]:
    found = measure([], (0.0, 0.0, 0.0), (d, 0.0, 0.0), frequency)
    return found, found.errors([truths.friis(frequency, mpf(d))])


def through(
    frequency: float, thickness: float, rise: float = 1.0, medium: tuple[float, float] = CONCRETE
) -> tuple[Measured, float]:
    """A wall between two radios, and the error of the path through it."""
    wall = node(Body(Box([thickness / 2, 50.0, 50.0]), wall_of(thickness, *medium)))
    tx, rx = (-10.0, 0.0, 0.0), (10.0, rise, 0.0)
    found = measure([wall], tx, rx, frequency)
    length = truths.distance(tx, rx)
    eps = truths.permittivity(*medium, frequency)
    t = truths.scalar(truths.slab(20 / length, eps, thickness, frequency)[1])
    return found, found.errors([t * truths.friis(frequency, length)])


def glint(frequency: float, radius: float, away: float, beta: float) -> tuple[Measured, float]:
    """A metal ball; the error of the path that it reflects."""
    ball = node(Body(Sphere(radius), Conductor()))
    tx, rx = ((away * math.cos(s * beta), away * math.sin(s * beta), 0.0) for s in (1, -1))
    found = measure([ball], tx, rx, frequency)
    length, spread, _ = truths.sphere(radius, away, beta)
    wave = truths.C / (4 * truths.mp.pi * mpf(frequency))
    bounced = -wave * spread * truths.phase(frequency, length)
    straight = truths.friis(frequency, truths.distance(tx, rx))
    return found, found.errors([straight, bounced])


def _turns(frequency: float, length: float) -> float:
    """Phase that rounding of a length leaves open [rad]: a few units in the last place."""
    return GOOD + 4 * 2 * math.pi * length * frequency / 3e8 * 2.0**-53


def _joined(found: list[Measured]) -> tuple[str, bool]:
    """One status and one verdict on gradients for several scenes of one row."""
    words = list(dict.fromkeys(m.status for m in found))
    return " / ".join(words), all(m.gradient is not False for m in found)


def frequency(quick: bool) -> Section:
    rows = []
    for f in FREQUENCIES[:: 4 if quick else 1]:
        runs = [free(f, 100.0), two_ray(f, 100.0, 10.0, 1.5), through(f, 0.2), glint(f, 3, 50, 0.9)]
        found, errors = zip(*runs, strict=True)
        status, gradient = _joined(list(found))
        limit = _turns(f, 100.0)
        note = TURNS if max(errors) > GOOD else None
        rows.append(Row(f"{f / 1e9:g} GHz", errors, status, gradient, note, limit, expected=True))
    return Section(
        "Frequency",
        "100 m of free space (Friis), two rays over ground (Fresnel), a wall of 20 cm between radios "
        "20 m apart (characteristic matrix), a metal ball of 3 m (divergence factor): relative error "
        "of the worst path, amplitude and phase.",
        ("free space", "two rays", "wall", "ball"),
        tuple(rows),
        "from 100 MHz to 300 GHz without limit in the tracer; objects end earlier (see sizes), and "
        "ITU materials (see bands).",
    )


def distance(quick: bool) -> Section:
    rows = []
    for d in DISTANCES[:: 4 if quick else 1]:
        for f in (2.4e9, 3e11):
            line, error = free(f, d)
            ground, bounce = two_ray(f, d, 0.1 * d, 0.05 * d)
            gain = abs(line.paths[0][1]) ** 2
            slope = abs(float(line.slope[0]) / (-2 * gain / d) - 1)
            status, gradient = _joined([line, ground])
            near = line.warned("near field")
            note = NEAR if near else TURNS if max(error, bounce) > GOOD else None
            rows.append(
                Row(f"{d:g} m, {f / 1e9:g} GHz", (error, bounce, slope), status, gradient, note,
                    _turns(f, d), expected=True)
            )  # fmt: skip
    return Section(
        "Distance",
        "Friis, two rays over ground with the radios at 0.1 and 0.05 of the distance, and the slope "
        "of the path gain along the line against -2 G / d.",
        ("free space", "two rays", "slope"),
        tuple(rows),
        "from lambda / 2 pi to 100 km; beyond that as far as float64 holds the coordinates (a metre "
        "in 1e9 m at 300 GHz keeps a hundredth of a turn).",
    )


def size(quick: bool) -> Section:
    f = 2.4e9
    rows = []
    for width in SIZES[:: 4 if quick else 1]:
        found, error = glint(f, width / 2, 20 * width, 0.9)
        small = found.warned("narrower than a wavelength")
        exact = truths.mie_backscatter(width / 2, f) if width < 20 else None
        remark = "" if exact is None else f"{10 * math.log10(exact):+.2f} dB"
        words = found.status + (", warned" if small else "")
        note = SMALL if small else None
        (on, flat), (off, hole) = (plate(f, width, at) for at in (ON_IT, BESIDE_IT))
        finite = found.gradient and on.gradient and off.gradient is not False
        errors = (error, max(flat, hole))
        rows.append(Row(f"{width:g} m", errors, words, finite, note, remark=remark))
    return Section(
        "Object size",
        "A metal ball at 2.4 GHz (wavelength 12.5 cm), radios 20 diameters away: the reflected path "
        "against the divergence factor of geometrical optics; a metal plate with an outline like an "
        "L, drawn as a mesh, against its image, and nothing where the L has none of its rectangle; and "
        "backscatter from the ball by the exact wave solution (Mie) relative to that of rays.",
        ("against rays", "mesh"),
        tuple(rows),
        "objects wider than a wavelength: backscatter of a ball of one wavelength is 1.2 dB off, of "
        "two 0.03 dB. Below, a warning names the objects.",
        "waves against rays",
    )


def plate(frequency: float, width: float, at: tuple[float, float]) -> tuple[Measured, float]:
    """A link that meets the plane of the L's upper face at a place in units of its width, and the
    worst error of its paths."""
    half = 0.05 * width
    body = Body(extruded([(x * width, y * width) for x, y in ELL], half), Conductor())
    x, y, away = at[0] * width, at[1] * width, 20.0 * width
    tx, rx = (x - away, y, half + away), (x + away, y, half + away)
    found = measure([node(body)], tx, rx, frequency)
    true = [truths.friis(frequency, truths.distance(tx, rx))]
    if at == ON_IT:
        image = (rx[0], rx[1], 2 * mpf(half) - mpf(rx[2]))
        true.append(-truths.friis(frequency, truths.distance(tx, image)))
    return found, found.errors(true)


def thickness(quick: bool) -> Section:
    cases = [("", d, f, CONCRETE) for d in THICKNESSES for f in (1e8, 2.4e9, 3e11)][
        :: 7 if quick else 1
    ]
    cases += [("sea water, ", d, 2.4e9, SEA_WATER) for d in (0.3, 10.0)]
    rows = []
    for name, d, f, medium in cases:
        found, error = through(f, d, 10.0, medium)
        case = f"{name}{d:g} m, {f / 1e9:g} GHz"
        if not found.paths:
            rows.append(Row(case, (None, None), found.status, found.gradient, BLOCKED))
            continue
        limit = _turns(f, 20.0 + 10 * d)
        note = TURNS if error > GOOD else None
        delay = _delay_error(found, f, d, 10.0, medium)
        rows.append(Row(case, (error, delay), found.status, found.gradient, note, limit))
    return Section(
        "Wall thickness",
        "Concrete (eps_r 5.24, sigma 0.05 S/m) between two radios, 27 degrees from the normal: "
        "amplitude and phase against the characteristic matrix, group delay against its derivative.",
        ("T", "delay"),
        tuple(rows),
        "any thickness. A slab is one layer with parallel faces, as thick as its material says, "
        "whatever it is drawn with; draw it in one piece.",
    )


def _delay_error(
    found: Measured, frequency: float, thickness: float, rise: float, medium: tuple[float, float]
) -> float:
    """Relative to the larger of the excess delay and a femtosecond."""
    length = truths.distance((-10.0, 0.0, 0.0), (10.0, rise, 0.0))
    true = truths.slab_delay(20 / length, *medium, thickness, frequency)
    excess = mpf(found.result.channel.delay.tolist()[0]) - length / truths.C
    return float(abs(excess - true) / max(abs(true), mpf("1e-15")))


def incidence(quick: bool) -> Section:
    rows = []
    for angle in ANGLES[:: 3 if quick else 1]:
        reach, up = 10 * math.sin(math.radians(angle)), 10 * math.cos(math.radians(angle))
        up = 0.0 if angle == 90.0 else up
        if angle == 0.0:
            reach = 1e-3  # a receiver on the transmitter would be no receiver
        errors: list[float | None] = []
        found: list[Measured] = []
        for surface, truth in _mirrors():
            mirror = node(Body(Box([50.0, 50.0, 0.1]), surface), (0.0, 0.0, -0.1))
            tx, rx = (-reach, 0.0, up), (reach, 0.0, up)
            run = measure([mirror], tx, rx, 2.4e9)
            straight, bounced = mpf(2 * reach), 2 * truths.mp.sqrt(mpf(reach) ** 2 + mpf(up) ** 2)
            true = [truths.friis(2.4e9, straight)]
            if up:
                true.append(truth(2 * mpf(up) / bounced) * truths.friis(2.4e9, bounced))
            errors.append(run.errors(true))
            found.append(run)
        status, gradient = _joined(found)
        rows.append(
            Row(f"{angle:g} deg", tuple(errors), status, gradient, None if up else FLAT,
                _turns(2.4e9, 20.0))
        )  # fmt: skip
    return Section(
        "Incidence",
        "Reflection off a dielectric half-space and off a slab of 10 cm, from normal to grazing, "
        "with the line of sight beside it: Fresnel and the characteristic matrix.",
        ("half-space", "slab"),
        tuple(rows),
        "to 89.999 degrees and beyond; at 90 degrees the path runs in the face.",
    )


def _mirrors() -> list[tuple[object, Callable[[mpf], mpc]]]:
    f = 2.4e9
    eps = truths.permittivity(EPS, SIGMA, f)
    wall = truths.permittivity(5.24, 0.05, f)
    return [
        (
            DielectricHalfSpace(eps_r=EPS, sigma=SIGMA),
            lambda c: truths.scalar(truths.fresnel(c, eps)),
        ),
        (wall_of(0.1), lambda c: truths.scalar(truths.slab(c, wall, 0.1, f)[0])),
    ]


SECTIONS = (frequency, distance, size, thickness, incidence)
