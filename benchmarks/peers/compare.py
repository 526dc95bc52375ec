"""rfsg beside Sionna RT on the same scenes, path by path, and both beside closed forms.

    make -C benchmarks/peers venv        # once: the peer, in an environment of its own
    python benchmarks/peers/compare.py [--out DIR] [--reuse] [--write-docs] [CASE ...]

Both sides run in processes of their own and leave their paths in DIR as .npz files; ``--reuse``
takes those that are there. Every difference above a threshold (``differences.py``) is given the
cause whose rule recognises it (``explain.py``), or none: then it counts as unexplained, and the exit
status is 1. DIR/differences.csv lists all. ``--write-docs`` also measures the time of one job and
writes the results into docs/peers.md.
"""

import argparse
import csv
import os
import platform
import resource
import subprocess
import sys
from collections import Counter, defaultdict
from pathlib import Path

import cases
import numpy as np
import truth
from differences import THRESHOLD, Compared, Difference
from exchange import Traced, file_of
from explain import CAUSES, UNEXPLAINED, cause_of

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PAGE = ROOT / "docs" / "peers.md"
PEER = HERE / ".venv" / "bin" / "python"
BEGIN, END = "<!-- results: written by benchmarks/peers/compare.py -->", "<!-- end of results -->"
TIMED = "room 2.4 GHz"
EACH = 40  # differences of one cause are listed singly up to here, and counted beyond
Explained = dict[Difference, str]


def run_side(side: str, out: Path, names: list[str]) -> float:
    """Trace cases in one process; its CPU seconds, all threads, imports and compilation included."""
    python = PEER if side == "sionna" else Path(sys.executable)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [str(python), str(HERE / f"{side}_side.py"), "--out", str(out), *names]
    subprocess.run(command, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def load(out: Path, case: cases.Case) -> Compared:
    rfsg, peer = (Traced.load(file_of(out, case.name, side)) for side in ("rfsg", "sionna"))
    return Compared(case, rfsg, peer, truth.solve(case))


def explain(compared: Compared) -> Explained:
    return {d: cause_of(compared, d) for d in compared.differences}


# tables


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines] + [""]


def worst(values: np.ndarray) -> str:
    most = np.abs(values).max() if len(values) else 0.0
    return "< 1e-5" if most < 1e-5 else f"{most:.2g}"


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
                str(c.case.things[0].facets) if isinstance(c.case.things[0], cases.Ball) else "",
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
    for cause in CAUSES:
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
            rows.append([name, quantity, str(len(values)), "" if not any(values) else spread])
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


def speed(out: Path) -> str:
    seconds = {
        side: sorted(run_side(side, out, [TIMED]) for _ in range(3)) for side in ("sionna", "rfsg")
    }
    said = " and ".join(
        f"{s[1]:.1f} ({s[0]:.1f} to {s[-1]:.1f}) for {n}"
        for n, s in (("Sionna RT", seconds["sionna"]), ("rfsg", seconds["rfsg"]))
    )
    return (
        f"CPU seconds of a whole process that traces `{TIMED}`, imports and compilation included, "
        f"median of 3 (least to most): {said}. One small job in a fresh process says little about "
        "either: Sionna RT is made for GPUs and large scenes."
    )


def machine() -> str:
    model = next(
        (x.split(":")[1].strip() for x in open("/proc/cpuinfo") if x.startswith("model name")),
        platform.processor(),
    )
    code = "import mitsuba, drjit, importlib.metadata as m; "
    code += "print(m.version('sionna-rt'), mitsuba.__version__, drjit.__version__)"
    said = subprocess.run([str(PEER), "-c", code], check=True, capture_output=True, text=True)
    sionna, mitsuba, drjit = said.stdout.split()
    import torch

    return (
        f"Machine: {os.cpu_count()} cores of {model}, no GPU used, {platform.system()}, Python "
        f"{platform.python_version()}, shared with other work. Sionna RT {sionna} (Mitsuba "
        f"{mitsuba}, Dr.Jit {drjit}, variant `llvm_ad_mono_polarized`); rfsg with torch "
        f"{torch.__version__.split('+')[0]}."
    )


def page(all_of: list[Compared], explained: dict[str, Explained]) -> list[str]:
    round_ones = [c for c in all_of if isinstance(c.case.things[0], cases.Ball)]
    flat = [c for c in all_of if c not in round_ones]
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


def write_docs(lines: list[str]) -> None:
    before, rest = PAGE.read_text().split(BEGIN)
    after = rest.split(END)[1]
    PAGE.write_text(before + "\n".join([BEGIN, "", *lines, END]) + after)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help="default: all of them")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "peers")
    parser.add_argument("--reuse", action="store_true", help="take the paths found there")
    parser.add_argument("--write-docs", action="store_true", help="write docs/peers.md too")
    options = parser.parse_args()
    known = {c.name: c for c in cases.all_cases()}
    wrong = sorted(set(options.cases) - set(known))
    if wrong:
        parser.error(f"case {wrong[0]!r}: expected one of {', '.join(known)}")
    if not PEER.exists():
        parser.error(f"{PEER} is not there; make it with: make -C benchmarks/peers venv")
    options.out.mkdir(parents=True, exist_ok=True)
    names = options.cases or list(known)
    for side in ("rfsg", "sionna"):
        there = [n for n in names if options.reuse and file_of(options.out, n, side).exists()]
        if set(names) - set(there):
            run_side(side, options.out, [n for n in names if n not in there])

    all_of = [load(options.out, known[n]) for n in names]
    explained = {c.case.name: explain(c) for c in all_of}
    with open(options.out / "differences.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["case", "rx", "path", "quantity", "peer_minus_rfsg", "cause"])
        for name, e in explained.items():
            rows.writerows([name, d.rx, d.path, d.quantity, d.value, w] for d, w in e.items())
    lines = page(all_of, explained)
    print("\n".join(lines))
    if options.write_docs:
        write_docs([machine(), "", *lines, "### Time", "", speed(options.out), ""])
        print(f"written: {PAGE}")
    if any(w == UNEXPLAINED for e in explained.values() for w in e.values()):
        sys.exit(1)


if __name__ == "__main__":
    main()
