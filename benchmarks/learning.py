"""How well is received power predicted where nobody measured? rfsg beside what interpolates.

    python benchmarks/learning.py --data DIR [DIR] [--only baselines] [--crops W NE] [--write-docs]

DIR is the folder of nerf2-ble (with splits.json), of tetam-ble, or both. Every result is stored in the
folder --work as soon as it is there, so that a run that was killed goes on where it stopped; a result
is computed anew when its readings, its method's code or its budget changed. --only takes names of
methods, or `baselines`; --stored computes nothing and makes the page of what is there. The page gets
what was asked for and is stored: without --only, --crops, --densities and --seeds that is everything.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy
import torch
from learn import nerf2, page, plan, tetam
from learn.cases import Case, DataError
from learn.methods import Entry, methods
from learn.page import Result
from learn.store import outcome, stored
from machine import ROOT, measured_on, write_page

PAGE = ROOT / "docs" / "learning.md"
PICTURE = ROOT / "docs" / "images" / "learning_cdf.png"

HEAD = """# Learning from few readings

Written by `python benchmarks/learning.py --data NERF2_BLE TETAM_BLE --write-docs`, the folders of the
two data sets. How far are predictions of received power from readings that no method saw? *random*
holds out a fifth of the places, *blocks* all places in squares of 3 m, *unseen-gateway* all readings of
one gateway, scored at held-out places, and *unseen-both* the same inside held-out blocks. Densities are
training readings, each of one place and one gateway, a square foot of the crop. The runs are fixed:
`splits.json` of the data set. A cell is over the errors of all seeds (0, 1, 2) together. Readings that
were not received are neither learned from nor scored.

A dash: the method has one model per gateway, and that gateway was never heard. Empty: not run; a number
in brackets: run for so many of the seeds only.

Parameters come from training readings alone, by least squares, maximum likelihood or leaving one out.
What these do not decide was chosen on crop S and is used unchanged everywhere: the shape of the common
field of joint kriging, the octaves of NeRF2 (4: at 0.175, random, seed 0 these gave a median of
3.7 dB, the paper's 10 gave 5.7), the size and the law of the regions, the empty scene below the residual,
and of the residual one more fit of the physics, and how little the shares of the levels may weigh against
neighbours. No test reading of W, NE or tetam-ble chose anything, but for one doubt: the last of these
bounds was widened because S had met it, after W and NE had been looked at once.

The floor plan's settings for tetam-ble were chosen on set_1 ([tetam.md](tetam.md)). That what it leaves is
modelled only where held-out training places ask for it was decided after set_2 had been scored once with
the field always there: 2.40 / 5.81, all positions, and a coverage of 71 %.

Objects that are learned and then moved, and which settings of a fit earn their place, need no data:
[learning-moved.md](learning-moved.md), [learning-ablations.md](learning-ablations.md).

What stands in the way of the 90th percentiles in `blocks` and `unseen-both` has a page of its own,
[learning-blocks.md](learning-blocks.md), with what was tried.
"""

SOURCES = """## Data

- nerf2-ble: BLE readings published with NeRF2 (X. Zhao, Z. An, Q. Pan, L. Yang, ACM MobiCom 2023;
  github `XPengZhao/NeRF2`, MIT), 6000 places and 21 gateways in three campaigns. Crops W, S and NE are
  adjacent rooms of one campaign each.
- tetam-ble: github `philotuxo/Position-Annotated-BLE-RSSI-Dataset`, CC0 1.0 ([tetam.md](tetam.md)).
  Learned from set_1 (81 places, or 20 of them drawn by the seed), asked at set_2, nine months later, and
  along nine walks; or from a share of the squares of 0.25 m that the walks crossed, asked in all others.
  Nothing is refitted where it is asked.

The data are not part of this project.
"""


def cases(folders: Sequence[Path], crops: Sequence[str]) -> list[Case]:
    """All cases of the folders. Raises DataError for a folder that is neither data set."""
    found = []
    for folder in folders:
        if all((folder / name).is_file() for name in nerf2.FILES):
            found += nerf2.cases(folder, crops)
        elif all((folder / name).is_file() for name in tetam.FILES):
            found += tetam.cases(folder)
        else:
            raise DataError(
                f"{folder}: --data expects the folder of nerf2-ble ({', '.join(nerf2.FILES)}) or of "
                f"tetam-ble ({', '.join(tetam.FILES)})"
            )
    return found


def chosen(only: Sequence[str], known: dict[str, Entry]) -> dict[str, Entry]:
    """The methods that --only names. Raises DataError for a name that is none."""
    if not only:
        return known
    unknown = sorted(set(only) - set(known) - {"baselines"})
    if unknown:
        raise DataError(
            f"--only {', '.join(unknown)}: no such method; expected `baselines` or some of "
            f"{', '.join(known)}"
        )
    take_all = "baselines" in only
    return {n: e for n, e in known.items() if n in only or (take_all and e.baseline)}


def compute(todo: Sequence[Case], entries: dict[str, Entry], work: Path) -> None:
    """Every method on every case, the cheap methods first; what is stored is not computed again."""
    for name, entry in entries.items():
        for case in todo:
            if not entry.serves(case) or stored(case, name, entry, work) is not None:
                continue
            begin = time.perf_counter()
            found = outcome(case, name, entry, work).score
            said = "refused" if found is None else f"{found.median_db:.2f} / {found.p90_db:.2f}"
            took = time.perf_counter() - begin
            print(f"{case.data_set} {case.name} {name}: {said} dB, {took:.1f} s", flush=True)


def collected(todo: Sequence[Case], entries: dict[str, Entry], work: Path) -> list[Result]:
    """What is stored, by data set, crop, split and density."""
    found = []
    for case in todo:
        for name, entry in entries.items():
            result = stored(case, name, entry, work) if entry.serves(case) else None
            if result is not None:
                found.append(Result(case, name, result))
    order = list(dict.fromkeys((c.data_set, c.crop, c.split) for c in todo))
    return sorted(
        found,
        key=lambda r: (order.index((r.case.data_set, r.case.crop, r.case.split)), r.case.density),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data set folders")
    parser.add_argument("--only", nargs="+", default=(), help="methods, or `baselines`")
    parser.add_argument("--crops", nargs="+", default=(), help="crops of nerf2-ble (default: all)")
    parser.add_argument("--densities", nargs="+", type=float, default=(), help="only these")
    parser.add_argument("--seeds", nargs="+", type=int, default=(), help="only these")
    parser.add_argument("--nerf2-steps", type=int, default=600, help="budget of NeRF2")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "learning", help="results")
    parser.add_argument("--stored", action="store_true", help="compute nothing")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--write-docs", action="store_true", help="write docs/learning.md")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        todo = [
            case
            for case in cases(options.data, options.crops)
            if (not options.densities or case.density in options.densities)
            and (not options.seeds or case.seed in options.seeds)
        ]
        entries = chosen(options.only, methods(options.nerf2_steps) | plan.entries())
    except DataError as fault:
        parser.error(str(fault))
    if not options.stored:
        compute(todo, entries, options.work)
    results = collected(todo, entries, options.work)
    if not results:
        sys.exit(f"{options.work}: no result stored; run once without --stored")
    tables = page.tables(results, entries)
    print(tables)
    if options.write_docs:
        of_crops = [r for r in results if r.case.data_set == nerf2.NAME]
        picture = ""
        if of_crops:
            page.cdf_picture(of_crops, entries, PICTURE)
            picture = f"## Distribution of the errors\n\n![error CDF](images/{PICTURE.name})\n\n"
        seconds = sum(r.outcome.fit_s + r.outcome.predict_s for r in results)
        line = f"numpy {np.__version__}, scipy {scipy.__version__}. {measured_on(seconds)}"
        parts = (HEAD, page.described(entries), "", line, "## Results\n", tables, picture + SOURCES)
        write_page(PAGE, *parts)


if __name__ == "__main__":
    main()
