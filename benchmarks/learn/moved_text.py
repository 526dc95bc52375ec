"""The words of docs/learning-moved.md."""

from pathlib import Path

from learn import moved_figures, moved_page, moved_remedies
from learn.moved_methods import OBJECTS, ROOM, SETTLED
from learn.moved_rooms import GATEWAYS, HEARD, NEW, ROOMS

HEAD = """# Objects that were moved

Written by `python benchmarks/moved.py --write-section`; all of it is simulated, no data are needed. Three
objects are learned together from readings anywhere in room A ({size_a}): a cabinet (a box of 22 mm
plywood), a person (a capsule of muscle, which nothing passes) and a partition (a box, 10 cm of brick).
Their shapes and the walls are known, their materials are not. Then nothing is trained any more, and the
same objects are asked

- *before*: where they were learned, on links that no method saw;
- *moved*: in room A, each at another place and turned;
- *room B*: in another room ({size_b});
- *copies*: in room A, two of each, at new places.

A reading is the path gain at 2.44 GHz between a random place and one of {gateways} gateways, with normal noise;
power is the sum over paths, as a receiver of a wide band has it. The gateways stand at the same places
in all situations, so that what interpolates can be asked everywhere. *Heard gateways* are those of the
readings; with *new gateways* both ends of a link are new. Per situation, seed and kind of gateways there
are {asked} such links. A link *matters* where the objects change its true path gain by more than
{matters_db:g} dB (by situation, all seeds: {mattering}). Errors are against the truth without noise; a
cell is median / 90th percentile over all links of seeds {seeds} [dB]. Every seed draws its own poses,
gateways and places. In brackets: median after / median before.

The truth is `reference` quality with 3 reflections instead of 5 (2 on paths that meet the person), one
edge instead of two, and all sequences of faces enumerated instead of 200 000 rays: what can be computed
for thousands of links. The fits know less than the truth: no diffraction, no third reflection.
*True materials* is what their quality leaves of the truth when nothing has to be learned: the floor.

| method | |
|---|---|
| rfsg | three blank stochastic surfaces with bulk loss, one start. {ours} |
| rfsg, two starts | the same fit twice, from rfsg's default surface and from one that is nearly clear \
(s 125 per metre, interaction length 0.2 m, phi 1.45), and of the two the one whose loss of the *training* \
readings, mean of the last {settled} steps, is less. |
| one network for the room | the paper's own form: one neural object over the whole room, \
its loss a field over the world's coordinates (as `rfsg.learn.regions` has it, with the walls known beside). \
It cannot be moved: it stays, in room B too, as it was learned. {room} |
| log-distance ... joint kriging | as in [learning.md](learning.md), learned in room A before the move |
| ..., retrained | the same, learned anew from as many new readings after the move |
| no objects; rfsg, not learned; true materials | the rooms without the objects; \
with blank surfaces; with the true ones |

Steps, batch, rate and law are one setting that did well on other scenes
([learning-ablations.md](learning-ablations.md)) and then on seed 100, which is in no table. Seeds 0 and 1 had
been looked at with older settings (first row of *Remedies*), and their errors are why others were looked for;
seed 2 was new. Two starts came last, after the results of one start had been seen on all three seeds: seed 1
was bad, and the loss of its training readings says so too. So which start counts is chosen by training
readings, but the remedy was thought of because of these tables; only new seeds could judge it.
"""

DOUBTS = """
Where the ratio of rfsg is missed, that of the true materials is mostly missed too: paths with edges and third
reflections, which neither has, are another share of the links after a move than before. One ratio over all
seeds also mixes scenes of unlike floors, and few links of seed 2 matter before.

1000 readings, and readings without noise, are asked on seed 0 only.
"""

REMEDIES = """
## Remedies

What was tried for the ratio of at most 1.3: 200 readings with noise of 2 dB, median / 90th percentile [dB]
over the links that matter, {heard} and {new} together, of one start. *As in the
tables* differs from the first row by the rate, the batch, the law and the step of the heads, all at once;
what each does alone is asked in [learning-ablations.md](learning-ablations.md). The first
row is of an earlier version of rfsg.

| what | seed | before | moved | room B | copies | s |
|---|---|---|---|---|---|---|
| 300 steps of 8, normal law, rate 0.001, heads' step 1 | 0, 1 | 0.86 / 1.74 | 1.45 / 2.51 | 1.14 / 2.01 | \
1.25 / 2.48 | 113 |
{rows}

Asking with one edge lowers the floor of the true materials and makes it more alike, but hardly the errors of
what was learned without edges, at four times the cost of asking; so the tables stay without. Learning with
edges too was stopped after more than 4 minutes of one core, without a result.
"""


def page(results: moved_page.Results, picture_name: str, measured_on: str, work: Path) -> str:
    """The whole page; ``measured_on``: the machine, in a line; ``work``: where remedies are stored."""
    seeds = sorted({r.case.seed for r in results.every})
    said = {
        "size_a": _size("A"),
        "size_b": _size("B"),
        "gateways": GATEWAYS,
        "asked": moved_page.PLAN.asked,
        "matters_db": moved_page.MATTERS_DB,
        "mattering": moved_page.mattering_share(results),
        "seeds": ", ".join(map(str, seeds)),
        "ours": OBJECTS.said(),
        "room": ROOM.said(),
        "settled": SETTLED,
    }
    parts = (
        HEAD.format(**said),
        measured_on,
        "## Results\n",
        f"![median errors before and after](images/{picture_name})\n",
        moved_figures.summary(results),
        "\n### Asked and met\n",
        moved_figures.met(results),
        "\nSeed by seed, 200 readings with noise of 2 dB, as above:\n",
        moved_figures.by_seed(results, 200, 2.0),
        DOUBTS,
        REMEDIES.format(heard=HEARD, new=NEW, rows="\n".join(moved_remedies.rows(work))),
        moved_page.tables(results),
    )
    return "\n".join(parts)


def _size(room: str) -> str:
    of = ROOMS[room]
    across = " x ".join(f"{length:g}" for length in of.size)
    return f"{across} m, {of.thickness_m:g} m of {of.itu}"
