"""Rows, sections and footnotes of the stability table, and what makes a cell a bad one."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

GOOD = 1e-9  # relative error below which a cell is good, where a row says nothing else


@dataclass(frozen=True)
class Note:
    """Why a cell is bad, and what a user should do."""

    why: str
    do: str


@dataclass(frozen=True)
class Row:
    """One case. errors: relative error against each truth of the section, None where a truth does not
    apply. limit: the largest good one. status: how candidates ended, or what was refused. gradient:
    are all derivatives finite; None where there is nothing to differentiate. expected: the status is
    the right answer, however it reads. remark: what the section's own column says."""

    case: str
    errors: tuple[float | None, ...]
    status: str
    gradient: bool | None
    note: Note | None = None
    limit: float = GOOD
    expected: bool = False
    remark: str = ""

    def bad(self) -> bool:
        """Wrong, not finite, or an ending other than a path; what a note must explain."""
        wrong = any(e is not None and not e <= self.limit for e in self.errors)
        odd = not self.expected and bool(set(re.findall(r"[A-Za-z_]+", self.status)) - {"OK"})
        return wrong or self.gradient is False or odd


@dataclass(frozen=True)
class Section:
    """A table: what was varied, the truth, the columns of errors, and where validity ends."""

    title: str
    truth: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    valid: str
    remark: str = ""  # heading of the column of remarks, if there is one

    def unexplained(self) -> list[Row]:
        """Bad rows without a footnote: there must be none."""
        return [row for row in self.rows if row.bad() and row.note is None]


def markdown(sections: Iterable[Section]) -> str:
    """All sections, each with its own footnotes."""
    return "\n".join(_section(s) for s in sections)


def _section(section: Section) -> str:
    notes = list(dict.fromkeys(r.note for r in section.rows if r.note))
    remark = [section.remark] if section.remark else []
    head = ["case", *section.columns, *remark, "status", "gradient"]
    lines = [f"## {section.title}", "", section.truth, "", _line(head), _line(["---"] * len(head))]
    lines += [_line(_cells(row, notes, bool(remark))) for row in section.rows]
    lines += ["", f"Valid: {section.valid}", ""]
    for k, note in enumerate(notes, 1):
        lines += [f"{k}. {note.why} *{note.do}*"]
    return "\n".join([*lines, ""] if notes else lines)


def _cells(row: Row, notes: Sequence[Note], remark: bool) -> list[str]:
    mark = f" [{notes.index(row.note) + 1}]" if row.note else ""
    errors = [short(e) for e in row.errors]
    gradient = {True: "finite", False: "NOT FINITE", None: "-"}[row.gradient]
    remarks = [row.remark or "-"] if remark else []
    return [row.case + mark, *errors, *remarks, row.status, gradient]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def short(error: float | None) -> str:
    """An error to one digit; what is below rounding is 0."""
    if error is None:
        return "-"
    if not math.isfinite(error):
        return str(error)
    return "0" if error < 1e-16 else f"{error:.0e}"
