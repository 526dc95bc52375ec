"""The paper's stochastic surface from nothing to a wall, and materials outside their bands."""

import itertools
import math

import torch
from mpmath import mpc, mpf

from extremes import truths
from extremes.measure import DEEP, GONE, Measured, measure, node, refusal
from extremes.table import GOOD, Note, Row, Section
from rfsg.objects.body import Body
from rfsg.objects.physics import media, transport
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.surfaces.slab import Slab
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.simulate import Result, simulate

LAWS = ("logistic", "gaussian", "laplace")
LENGTH = 0.05  # [m] interaction length
FREQUENCY = 2.4e9
SHARPNESS = tuple(10.0**k for k in range(-3, 7))
MATERIAL = (0.0, 1e-3, 1.0, 30.0, 1e3, 1e6)

NOTHING = Note(
    "True: less than -600 dB comes through or back, which counts as nothing, whatever the floor.",
    "Nothing to do.",
)
MIRROR = Note(
    "The paper's model, not its arithmetic: R = exp(-a l) tends to 1 as s tends to 0, for a boundary "
    "spread over metres takes nothing from a wave; and to 0 as s grows, for a sharp one takes all.",
    "Choose the interaction length with the sharpness: s l of about 1 is a reflector of some dB.",
)


STEEPNESS = (-1e4, -100.0, -1.0, 0.0, 1.0, 20.0, 100.0, 1e4)


def laws(quick: bool) -> Section:
    """ln o and H themselves, in both precisions, the worst of the three laws."""
    precisions = ((torch.float64, 1e-14, 1e-300), (torch.float32, 1e-6, 1e-37))
    rows = []
    for (dtype, limit, least), u in itertools.product(precisions, STEEPNESS[:: 3 if quick else 1]):
        found = [_law(name, u, dtype, least) for name in LAWS]
        errors = tuple(max(e[k] for e, _ in found) for k in (0, 1))
        finite = all(ok for _, ok in found)
        rows.append(Row(f"u {u:g}, {str(dtype)[6:]}", errors, "OK", finite, limit=limit))
    return Section(
        "The laws at s f",
        "ln of the occupancy and the hazard of the three laws at u = s f, against their definitions.",
        ("ln o", "H"),
        tuple(rows),
        "u from -1e4 to 1e4 in both precisions; values below the smallest normal number may be 0.",
    )


def _law(name: str, u: float, dtype: torch.dtype, least: float) -> tuple[tuple[float, float], bool]:
    """Relative errors of ln o and H, and whether they and their slopes are finite."""
    law = transport.law_named(name)
    x = torch.tensor(u, dtype=dtype, requires_grad=True)
    with truths.mp.workdps(120):  # o is 1 to 44 digits at u = -100
        true = truths.mp.log(truths.occupancy(name, mpf(u))), truths.hazard(name, mpf(u))
    errors, finite = [], True
    for value, exact in zip((law.log_occupancy(x), law.hazard(x)), true, strict=True):
        (slope,) = torch.autograd.grad(value, x)
        finite &= bool(torch.isfinite(value) & torch.isfinite(slope))
        errors.append(float(abs(value.item() - exact) / max(abs(exact), mpf(least))))
    return (errors[0], errors[1]), finite


def sharpness(quick: bool) -> Section:
    rows = [
        _plate(f"s {s:g} /m, {law}", law, s, 1.0, 0.7, 0.5, MIRROR if _is_extreme(s) else None)
        for s, law in itertools.product(SHARPNESS[:: 9 if quick else 1], LAWS)
    ]
    return Section(
        "Sharpness",
        "A plate of 1 m, m = 1, alpha = 0.7, crossed 27 degrees from the normal (s f reaches -s / 2) "
        "and met as a mirror: the integral of Eq. 19 in closed form, and R on the boundary.",
        ("T", "R"),
        tuple(rows),
        "1e-3 to 1e6 per metre in every law; s f from -5e5 to 0.",
    )


def _is_extreme(s: float) -> bool:
    return not 1e-1 <= s * LENGTH <= 1e1


def material(quick: bool) -> Section:
    rows = [
        _plate(f"m {m:g}, {law}", law, 40.0, m, 0.7, 0.5)
        for m, law in itertools.product(MATERIAL[:: 5 if quick else 1], LAWS)
    ]
    return Section(
        "Material m",
        "The same plate with s = 40 /m. |T| falls as exp(-m / 2 ... -m) with the angle.",
        ("T", "R"),
        tuple(rows),
        "0 to 1e6; from about 100 nothing is left of the wave.",
    )


def alpha(quick: bool) -> Section:
    rows = [
        _plate(f"alpha {a:g}, rise {rise:g}", "logistic", 40.0, 1.0, a, rise)
        for a, rise in itertools.product(
            (0.0, 1e-9, 0.5, 1.0)[:: 3 if quick else 1], (0.0, 0.5, 2.0)[:: 2 if quick else 1]
        )
    ]
    return Section(
        "Anisotropy alpha",
        "The same plate at 0, 27 and 63 degrees from the normal (rise over run 0, 0.5, 2).",
        ("T", "R"),
        tuple(rows),
        "0 to 1, ends included, at any angle.",
    )


def _plate(
    case: str, law: str, s: float, m: float, a: float, rise: float, note: Note | None = None
) -> Row:
    """T through a plate of 1 m, and R off it, in two scenes."""
    surface = lambda: StochasticSurface(m=m, alpha=a, sharpness=s, law=law, samples=16)  # noqa: E731
    plate = node(Body(Box([0.5, 500.0, 500.0]), surface()))
    across, up = 10.0, 10.0 * rise
    through = measure([plate], (-across, -up, 0.0), (across, up, 0.0), FREQUENCY)
    length = truths.distance((-across, -up, 0.0), (across, up, 0.0))
    t = truths.stochastic_plate(law, s, m, a, 2 * across / length, 1.0, LENGTH)
    mirror = node(Body(Box([0.5, 500.0, 500.0]), surface()))
    front = 0.5 + across
    off = measure([mirror], (front, -up - 0.1, 0.0), (front, up + 0.1, 0.0), FREQUENCY)
    straight = 2 * (mpf(up) + mpf("0.1"))
    bounced = truths.mp.sqrt(straight**2 + (2 * mpf(across)) ** 2)
    r = truths.stochastic_reflection(law, s, m, a, 2 * across / bounced, LENGTH)
    te = _error(through, 1, t, truths.friis(FREQUENCY, length))
    re = _error(off, 2, r, truths.friis(FREQUENCY, bounced))
    gone = te is None or re is None
    nepers = max(-float(truths.mp.log(abs(x))) if x else 0.0 for x in (t, r))
    gradient = all(x.gradient is not False for x in (through, off))
    status = " / ".join(dict.fromkeys((through.status, off.status)))
    # the exponent is held to float64's rounding, of itself and of the fields' own networks (1e-13)
    limit = GOOD + 1e-12 * min(nepers, 70.0)
    return Row(case, (te, re), status, gradient, NOTHING if gone else note, limit)


def _error(found: Measured, count: int, factor: mpf, free: mpc) -> float | None:
    """Of the longest of so many paths; None where it has faded to nothing, and truly has."""
    if len(found.paths) == count - 1 and abs(factor) < GONE:
        return None
    if len(found.paths) != count:
        return math.inf
    return float(abs(found.paths[-1][1] - factor * free) / abs(factor * free))


# bands

EXTRAPOLATED = Note(
    "Refused, with the prim, the bands and the way out in words; or, where the scene says so, the "
    "formula of the nearest band used beyond it, with a warning that names the prims and the bands.",
    "Treat such materials as a guess, wilder with every octave, or give eps_r and sigma.",
)
WALL = 0.01  # [m]
CASES = (
    ("concrete", (1e8, 9.99e8, 1e9, 1e11, 1.05e11, 3.3e11)),
    ("glass", (1e8, 2.5e11, 4.5e11, 5e11)),
    ("metal", (1e8, 1e11, 3e11)),
    ("very_dry_ground", (1e8, 1e10, 3e11)),
)


def bands(quick: bool) -> Section:
    rows = [
        _material(name, f) for name, frequencies in CASES[:: 2 if quick else 1] for f in frequencies
    ]
    return Section(
        "Materials beyond their band",
        "ITU-R P.2040 materials in a wall of 1 cm. Outside their bands they are refused, or "
        "extrapolated where the scene says so; T of that wall against the characteristic matrix with "
        "the formula of the nearest band.",
        ("T",),
        tuple(rows),
        "the bands of the Recommendation; a gap between two bands is outside.",
    )


def _material(name: str, f: float) -> Row:
    strict, soft = (
        node(Body(Box([WALL / 2, 5.0, 5.0]), Slab(WALL, itu=name, extrapolate=e)), path="/World/W")
        for e in (False, True)
    )
    inside = not media.outside(name, torch.tensor([f], dtype=torch.float64))
    found = measure([soft], *ENDS, f)
    said = refusal(lambda: _simulated(strict, f))
    told = said.startswith(f"refused: /World/W: {name}: ITU-R P.2040-4 gives it for")
    right = (said == "not refused") if inside else (told and found.warned("extrapolation"))
    error = _material_error(name, f, found) if right else math.inf
    words = found.status if inside else f"refused; extrapolated: {found.status}, warned"
    note = EXTRAPOLATED if not inside else NOTHING if error is None else None
    return Row(f"{name}, {f / 1e9:g} GHz", (error,), words, found.gradient, note)


ENDS = (-3.0, 0.0, 0.0), (3.0, 0.5, 0.0)


def _simulated(wall: Node, frequency: float) -> Result:
    tx, rx = (Radio.at(p, *at) for p, at in zip(("/t", "/r"), ENDS, strict=True))
    return simulate(Scene((wall,), (tx,), (rx,)), frequency, DEEP)


def _material_error(name: str, f: float, found: Measured) -> float | None:
    """Against the layer of the nearest band's formula; None where nothing is left of the wave."""
    rows = media.MATERIALS[name]
    away = lambda r: max(math.log2(r.low * 1e9 / f), math.log2(f / (r.high * 1e9)))  # noqa: E731
    row = next((r for r in rows if r.low <= f / 1e9 <= r.high), min(rows, key=away))
    ghz = mpf(f) / 10**9
    eps = truths.permittivity(mpf(row.a) * ghz ** mpf(row.b), mpf(row.c) * ghz ** mpf(row.d), f)
    length = truths.distance(*ENDS)
    t = truths.scalar(truths.slab(6 / length, eps, WALL, f)[1])
    if abs(t) < GONE and not found.paths:
        return None
    return found.errors([t * truths.friis(f, length)])


SECTIONS = (laws, sharpness, material, alpha, bands)
