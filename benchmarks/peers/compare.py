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
from pathlib import Path

import cases
import rough
import truth
from differences import Compared
from exchange import Traced, file_of
from explain import UNEXPLAINED, cause_of
from page import Explained, page

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PAGE = ROOT / "docs" / "peers.md"
PEER = HERE / ".venv" / "bin" / "python"
BEGIN, END = "<!-- results: written by benchmarks/peers/compare.py -->", "<!-- end of results -->"
TIMED = "room 2.4 GHz"


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
    return Compared(case, rfsg, peer, None if case.diffuse else truth.solve(case))


def explain(compared: Compared) -> Explained:
    return {d: cause_of(compared, d) for d in compared.differences}


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

    smooth = [load(options.out, known[n]) for n in names if not known[n].diffuse]
    explained = {c.case.name: explain(c) for c in smooth}
    walls = rough.pairs([load(options.out, known[n]) for n in names if known[n].diffuse])
    explained |= {w.name: w.differences() for w in walls}
    with open(options.out / "differences.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["case", "rx", "path", "quantity", "peer_minus_rfsg", "cause"])
        for name, e in explained.items():
            rows.writerows([name, d.rx, d.path, d.quantity, d.value, w] for d, w in e.items())
    lines = page(smooth, walls, explained)
    print("\n".join(lines))
    if options.write_docs:
        write_docs([machine(), "", *lines, "### Time", "", speed(options.out), ""])
        print(f"written: {PAGE}")
    if any(w == UNEXPLAINED for e in explained.values() for w in e.values()):
        sys.exit(1)


if __name__ == "__main__":
    main()
