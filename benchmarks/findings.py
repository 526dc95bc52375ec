"""What docs/tradeoff.md advises, each finding with the figures that it stands on, taken from what was measured.

A finding names its tables. Where the figures are missing from a run, or do not bear it out, it says so in
the place of what it would say: nothing here is typed that a run could contradict.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

from rfsg.tracer.tradeoff import Outcome, Tradeoff

RAYS = "search rays, rays"
LAUNCHED = "search rays, rays 50000, intersection"


class Missing(Exception):
    """A setting that a finding needs was not run."""


@dataclass(frozen=True)
class Told:
    """The figures of a finding in words, and whether they bear it out."""

    text: str
    holds: bool


@dataclass(frozen=True)
class Finding:
    """advice: what to do. tables: where its figures stand. tell: these figures."""

    advice: str
    tables: str
    tell: Callable[["Measured"], Told]


@dataclass(frozen=True)
class Measured:
    """All that was measured: scenes by name, rows of the dial, what widths.py found (or None)."""

    scenes: dict[str, Tradeoff]
    dial: list[dict[str, Any]]
    widths: dict[str, Any] | None

    def at(self, scene: str, setting: str) -> Outcome:
        """An outcome, under the name of an equal setting if it was not run by its own."""
        found = self.scenes.get(scene)
        if found is None:
            raise Missing(f"{scene} was not measured")
        equal = [s.split("'")[1] for s in found.left_out if s.startswith(f"{setting}: the same as")]
        named = {o.setting: o for o in found.outcomes}
        for name in (setting, *equal):
            if name in named:
                return named[name]
        raise Missing(f"`{setting}` was not run on {scene}")

    def dearer(self, scene: str, setting: str, base: str) -> str:
        return factor(self.at(scene, setting).seconds / self.at(scene, base).seconds)

    def error(self, scene: str, setting: str) -> float:
        return self.at(scene, setting).error.gain_90_db

    def learned(self) -> dict[str, Any]:
        if self.widths is None:
            raise Missing("benchmarks/widths.py has not run")
        return self.widths


def factor(ratio: float) -> str:
    return f"{ratio:.2g} times"


def db(value: float) -> str:
    return f"{value:.2g} dB" if math.isfinite(value) else "no limit (a link is lost)"


def say(measured: Measured) -> str:
    """The numbered list."""
    lines = []
    for number, finding in enumerate(FINDINGS, 1):
        try:
            told = finding.tell(measured)
            text = told.text + ("" if told.holds else " *This run does not bear it out.*")
        except Missing as missing:
            text = f"*Not shown by this run: {missing}.*"
        lines.append(f"{number}. **{finding.advice}** {text} ({finding.tables})")
    return "\n".join(lines) + "\n"


def accuracy(m: Measured) -> Told:
    if not m.dial:
        raise Missing("benchmarks/dial.py has not run")
    kept = sum(row["true_db"] <= 1.0 for row in m.dial)
    careful = median(row["true_db"] / row["error_db"] for row in m.dial if row["error_db"] > 0.0)
    dearer = sum(row["saving"] < 1.0 for row in m.dial)
    return Told(
        f"`--accuracy 1dB` kept its promise on {kept} of {len(m.dial)} random scenes. It is careful: in the "
        f"median {careful:.2g} of the estimated error was true. Where a scene needs the top of the ladder, "
        f"the climb costs more than going there at once: {dearer} of {len(m.dial)}.",
        kept >= 0.95 * len(m.dial),
    )


def first_edge(m: Measured) -> Told:
    without, with_ = m.error("street", "three bounces"), m.error("street", "standard")
    lab = m.at("lab", "diffraction 1").moved_db
    return Told(
        f"On the street the first edge takes {m.dearer('street', 'standard', 'three bounces')} the time and "
        f"brings the error from {db(without)} to {db(with_)}; the second {db(m.error('street', 'diffraction 2'))}"
        f" for another {m.dearer('street', 'diffraction 2', 'standard')}. In the lab the first moves {db(lab)}.",
        with_ < 0.5 * without,
    )


def bounces(m: Measured) -> Told:
    three, five = m.at("street", "standard"), m.at("street", "five bounces")
    among = m.at("tetam_lab", "standard")
    against = m.scenes["tetam_lab"].reference
    return Told(
        f"On the street five bounces in place of three cost {factor(five.seconds / three.seconds)} the time, "
        f"and the worst link goes from {db(three.error.gain_most_db)} to {db(five.error.gain_most_db)} off. In "
        f"tetam_lab, among 47 boxes, `standard` is {db(among.error.gain_90_db)} from `{against}`.",
        five.error.gain_most_db <= three.error.gain_most_db and five.seconds < 4 * three.seconds,
    )


def planes_by_rays(m: Measured) -> Told:
    enumerated, few = m.at("street", "standard"), m.at("street", f"{RAYS} 2000")
    many = m.at("street", f"{RAYS} 20000")
    return Told(
        f"On the street enumeration finds {enumerated.paths} paths; 2,000 rays find {few.paths} in "
        f"{factor(few.seconds / enumerated.seconds)} the time, 20,000 find {many.paths} in "
        f"{factor(many.seconds / enumerated.seconds)}.",
        max(few.paths, many.paths) <= enumerated.paths and many.seconds > enumerated.seconds,
    )


def rings(m: Measured) -> Told:
    one, four = m.at("lab", "zone_rings 1"), m.at("lab", "zone_rings 4")
    return Told(
        f"In the lab one ring takes {m.dearer('lab', 'zone_rings 1', 'draft')} draft's time and moves "
        f"{db(one.moved_db)}; four rings {m.dearer('lab', 'zone_rings 4', 'draft')} and {db(four.moved_db)}.",
        one.moved_db > 3.0 * four.moved_db,
    )


def longer_chains(m: Measured) -> Told:
    three, none = m.at("lab", "curved_depth 3"), m.at("lab", "curved 0")
    return Told(
        f"`curved_depth` 3 takes {m.dearer('lab', 'curved_depth 3', 'draft')} the time of draft for "
        f"{db(three.moved_db)}; without reflections on learned objects (`curved=0`) it takes "
        f"{m.dearer('lab', 'curved 0', 'draft')}, and moves {db(none.moved_db)} at 2.44 GHz.",
        max(three.moved_db, none.moved_db) < 0.5,
    )


def integral(m: Measured) -> Told:
    names = ["crossing_samples 4", "crossing_samples 64"]
    names += [f"integral riemann, crossing_samples {n}" for n in (16, 128)]
    most = max(m.at("lab", name).moved_db for name in names)
    thin, thick = (m.at("lab", f"{RAYS} 20000, epsilon {e}") for e in (0.001, 0.05))
    apart = abs(thin.moved_db - thick.moved_db)
    return Told(
        f"From 4 to 64 `crossing_samples`, and telescoped against Riemann sums of 16 and 128: {db(most)} at "
        f"most in the lab. By 20,000 rays `epsilon` of 1 and of 50 mm move it alike to {db(apart)}.",
        max(most, apart) < 0.1,
    )


def floor(m: Measured) -> Told:
    low, base = m.at("street", "floor_db -50.0"), m.at("street", "standard")
    high = m.at("street", "floor_db -30.0")
    return Told(
        f"On the street -50 in place of -80 dB keeps {low.paths} of {base.paths} paths, takes "
        f"{factor(low.seconds / base.seconds)} the time and moves {db(low.moved_db)}; -30 dB moves "
        f"{db(high.moved_db)}. Use it to keep files small.",
        min(low.seconds, high.seconds) > 0.7 * base.seconds,
    )


def delays(m: Measured) -> Told:
    bare, edge = (m.at("street", name).error for name in ("three bounces", "standard"))
    return Told(
        f"On the street the first arrival is {bare.arrival_ns:.2g} ns off without edges and "
        f"{edge.arrival_ns:.2g} ns with one; the delay spread {bare.spread_ns:.2g} and {edge.spread_ns:.2g} ns.",
        edge.arrival_ns < 1.0 and edge.spread_ns < 1.0,
    )


def meeting(m: Measured) -> Told:
    ways = {way: m.at("lab", f"{LAUNCHED} {way}") for way in ("newton", "mesh", "grid")}
    certain = m.at("lab", f"{LAUNCHED} certain")
    march = m.at("lab", f"{RAYS} 49999")
    paths = ", ".join(f"`{way}` {one.paths}" for way, one in ways.items())
    apart = max(abs(one.moved_db - certain.moved_db) for one in ways.values())
    return Told(
        f"The lab by 50,000 rays: `certain` {certain.paths} paths, {paths}, and a march on the networks as they "
        f"are {march.paths}, in {factor(march.seconds / certain.seconds)} the time of `certain`. Paths come to "
        f"rest on the network whatever found them: the ways move the channel alike to {db(apart)}.",
        apart < 0.5,
    )


def widths(m: Measured) -> Told:
    found = m.learned()
    rows = found["rows"]
    narrow, wide = rows["16"], rows[found["widest"]]
    shipped = rows["shipped"]
    return Told(
        f"Of 64 for 16 the shape is {rows['64']['off_mm'][1]:.2g} in place of {narrow['off_mm'][1]:.2g} mm off at "
        f"99 % of the surface; {found['widest']} brings {wide['off_mm'][1]:.2g} mm at "
        f"{factor(wide['g32'] / rows['64']['g32'])} the price of a gradient. The shipped cabinet, 64 trained for "
        f"longer: {shipped['off_mm'][1]:.2g} mm, and {db(shipped['from_widest']['moved_db'])} from the widest.",
        shipped["off_mm"][1] < min(narrow["off_mm"][1], wide["off_mm"][1]),
    )


def plain_mesh(m: Measured) -> Told:
    rows = m.learned()["rows"]
    network, mesh = rows["shipped"], rows["mesh"]
    return Told(
        f"The cabinet as its own mesh: {factor(mesh['seconds'] / network['seconds'])} the time of a scene with "
        f"the network, and {db(network['from_mesh']['moved_db'])} apart where the cabinet matters.",
        mesh["seconds"] < network["seconds"],
    )


def precision(m: Measured) -> Told:
    found = m.learned()
    half, brief = found["stored"]["float16"], found["stored"]["bfloat16"]
    march = found["searched"]
    return Told(
        f"f in float32 is {found['rows']['shipped']['rounding_mm'][1]:.2g} mm from f in float64; rays marched in "
        f"float64 take {factor(march['float64']['seconds'] / march['float32']['seconds'])} the time for "
        f"{db(march['float32']['moved_db'])}. Weights in float16 move {db(half['moved_db'])} for half the bytes, "
        f"in bfloat16 {db(brief['moved_db'])}.",
        march["float32"]["moved_db"] < 0.1,
    )


FINDINGS = (
    Finding("Say the accuracy, not the setting.", "[the dial](#the-dial)", accuracy),
    Finding("The first edge is worth its price, the second rarely.", "street, lab", first_edge),
    Finding("Bounces among planes are cheap: take five.", "street, tetam_lab", bounces),
    Finding("Never search planes by rays.", "street", planes_by_rays),
    Finding("Measure learned faces at two rings, no fewer.", "lab", rings),
    Finding(
        "Longer chains over learned objects cost most there, and are weak.", "lab", longer_chains
    ),
    Finding("Do not spend on the transport integral.", "lab", integral),
    Finding("The floor saves no time.", "street", floor),
    Finding("Delays converge before gains.", "street", delays),
    Finding("How rays meet learned shapes decides the time, not the channel.", "lab", meeting),
    Finding("Train longer before wider.", "widths and precision", widths),
    Finding("What is made of planes is better left a mesh.", "widths and precision", plain_mesh),
    Finding("float32 is enough to search and to store.", "widths and precision", precision),
)
