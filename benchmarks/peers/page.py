"""The comparison as tables and sentences."""

from collections import Counter, defaultdict

import numpy as np
from cases import Ball
from differences import THRESHOLD, Compared, Difference
from explain import CAUSES, SCATTERED, UNEXPLAINED
from rough import RoughWall

EACH = 40  # differences of one cause are listed singly up to here, and counted beyond
Explained = dict[Difference, str]


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines] + [""]


def worst(values: np.ndarray) -> str:
    most = np.abs(values).max() if len(values) else 0.0
    if most < 1e-5:
        return "< 1e-5"
    return f"{most:.0f}" if most >= 10 else f"{most:.3g}"


def agreement(all_of: list[Compared]) -> list[str]:
    """Flat scenes: how far each side is from the closed form, at worst."""
    rows = []
    for c in all_of:
        n, peer, ours = (len(t.rx) for t in (c.truth, c.peer, c.rfsg) if t is not None)
        cells = []
        for quantity in ("power [dB]", "delay [ns]", "phase [deg]", "angle [deg]"):
            a, b = (worst(c.error_to_truth(side, quantity)) for side in ("peer", "rfsg"))
            cells.append(f"{a} / {b}")
        rows.append([c.case.name, f"{n} / {peer} / {ours}", *cells])
    head = ["case", "paths: closed form / Sionna RT / rfsg", "power [dB]", "delay [ns]"]
    return table([*head, "phase [deg]", "angle [deg]"], rows)


def tessellation(all_of: list[Compared]) -> list[str]:
    """The sphere: how the mesh's error goes with its facets, beside rfsg's ball."""
    rows = []
    for c in all_of:
        assert c.truth is not None
        bounced = c.peer.kind[:, 0] >= 0
        met = (c.rfsg.kind[c.pairs[:, 0], 0] >= 0) & (c.pairs[:, 0] >= 0)
        error = c.errors("power [dB]")[met]
        exact = (np.abs(c.truth.gain[c.truth.kind[:, 0] >= 0]) ** 2).sum()
        ratio = (np.abs(c.peer.gain[bounced]) ** 2).sum() / exact
        span = f"{error.min():+.1f} to {error.max():+.1f}" if len(error) else "-"
        rows.append(
            [
                str(c.case.things[0].facets) if isinstance(c.case.things[0], Ball) else "",
                f"{len(set(c.peer.rx[bounced]))} of {len(c.case.receivers)}",
                span,
                f"{ratio:.2f}",
                f"{int((c.rfsg.kind[:, 0] >= 0).sum())} of {len(c.case.receivers)}",
                worst(c.error_to_truth("rfsg", "power [dB]")),
            ]
        )
    head = ["facets", "Sionna RT: receivers with the reflection", "its error [dB]"]
    head += ["reflected power of all receivers, of the exact", "rfsg: receivers with it"]
    return table([*head, "its error [dB]"], rows)


def by_cause(explained: dict[str, Explained]) -> list[str]:
    """Each cause: what it did, and why."""
    lines = []
    for cause in (*CAUSES, SCATTERED):
        found: dict[tuple[str, str], list[float]] = defaultdict(list)
        for name, differences in explained.items():
            for d, why in differences.items():
                if why == cause.name:
                    found[d.quantity, name].append(d.value)
        if not found:
            continue
        lines += [f"**{cause.name}.** {cause.why}", ""]
        rows = []
        for (quantity, name), values in found.items():
            spread = f"{min(values):+.3g} to {max(values):+.3g}"
            rows.append([name, quantity, str(len(values)), spread if any(values) else ""])
        lines += table(["case", "quantity", "number", "Sionna RT - rfsg"], rows)
    return lines


def one_by_one(explained: dict[str, Explained]) -> list[str]:
    """Every difference whose cause is not too common to list."""
    count = Counter(why for e in explained.values() for why in e.values())
    rows = [
        [name, f"rx{d.rx}", d.path, d.quantity, f"{d.value:+.3g}" if d.value else "", why]
        for name, e in explained.items()
        for d, why in e.items()
        if count[why] <= EACH
    ]
    return table(["case", "link", "path", "quantity", "Sionna RT - rfsg", "cause"], rows)


def steps(all_of: list[Compared]) -> list[str]:
    """How the power of links steps where a geometrical ray ends: the last four receivers."""
    rows = []
    for c in all_of:
        assert c.truth is not None
        power = [c.link_power(t)[-4:].reshape(2, 2) for t in (c.truth, c.peer, c.rfsg)]
        jump = [(p[:, 1] - p[:, 0]).tolist() for p in power]
        for b, ray in enumerate(("the reflection", "the direct ray")):
            rows.append([c.case.name, ray, *(f"{j[b]:+.2f}" for j in jump)])
    return table(["case", "what ends", "closed form", "Sionna RT", "rfsg"], rows)


def scattered(walls: list[RoughWall]) -> list[str]:
    """A rough wall's power at each receiver, both polarisations together and the part across."""
    rows = []
    for wall in walls:
        exact = 10 * np.log10(wall.exact)
        sums = [10 * np.log10(wall.total(side)) - exact for side in ("peer", "rfsg")]
        parts = [wall.crossed(side) for side in ("peer", "rfsg")]
        for r in range(len(exact)):
            cells = [f"{s[r]:+.4f}" for s in sums] + [f"{100 * x[r]:.1f} %" for x in parts]
            rows.append([f"rx{r}", f"{exact[r]:.2f}", *cells])
    head = ["receiver", "closed form [dB]", "Sionna RT - it [dB]", "rfsg - it [dB]"]
    return table([*head, "Sionna RT: part across", "rfsg: part across"], rows)


def page(
    all_of: list[Compared], walls: list[RoughWall], explained: dict[str, Explained]
) -> list[str]:
    round_ones = [c for c in all_of if isinstance(c.case.things[0], Ball)]
    edged = [c for c in all_of if c.case.diffraction]
    flat = [c for c in all_of if c not in round_ones and c not in edged]
    unexplained = sum(w == UNEXPLAINED for e in explained.values() for w in e.values())
    total = sum(len(e) for e in explained.values())
    limits = ", ".join(f"{v:g} {q.split('[')[1][:-1]}" for q, v in list(THRESHOLD.items())[:3])
    return [
        "### Flat scenes",
        "",
        "Largest absolute error of any path against the closed form: Sionna RT / rfsg.",
        "",
        *agreement(flat),
        "### A metal sphere",
        "",
        "Radius 1 m, transmitter and 400 receivers 5 m from its centre, 2.4 GHz.",
        "",
        *tessellation(round_ones),
        "### An edge",
        "",
        "The corner of a block of perfect conductor (1e10 S/m in Sionna RT), 30 m high, receivers all "
        "round it 5 m away; line of sight, one reflection, one edge. Largest error of any path "
        "against the closed form (Kouyoumjian and Pathak 1974): Sionna RT / rfsg.",
        "",
        *agreement(edged),
        "A field has no steps. From 0.05 degrees on one side of the place where a ray ends to 0.05 on "
        "the other, the power of the link changes by [dB]:",
        "",
        *steps(edged),
        "### A rough wall",
        "",
        "Lambertian, S = 0.6, concrete of 0.1 m, 2.4 GHz, transmitter vertical. Power scattered to "
        "a vertical and a horizontal receiver together.",
        "",
        *scattered(walls),
        "### Differences and their causes",
        "",
        f"{total} differences above {limits} of a path, 0.1 dB of a link's coherent power, or a "
        f"path that only one has; {unexplained} of them without a cause.",
        "",
        *by_cause(explained),
        f"One by one, causes with at most {EACH} differences (the others: `differences.csv`):",
        "",
        *one_by_one(explained),
    ]
