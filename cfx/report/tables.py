"""Tables of a report: cells, columns with the words that explain them, and what several share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cfx.report.figures.words import MINUS, NOTHING, explained, percent, short_label
from cfx.report.job import Job


@dataclass(frozen=True)
class Cell:
    """One cell.

    Attributes:
        text: what is shown.
        sort: by what the column is sorted.
        number: whether it holds a number.
        colour: a method or a cluster, whose colour marks it.
        second: a smaller line below.
        best: whether it is the best of its column.
    """

    text: str
    sort: str = ""
    number: bool = False
    colour: str = ""
    second: str = ""
    best: bool = False


@dataclass(frozen=True)
class Column:
    """A column: its heading, and a sentence on it that needs no other document."""

    heading: str
    meaning: str = ""
    number: bool = True


@dataclass(frozen=True)
class Sheet:
    """A table.

    Attributes:
        columns: of the table.
        rows: a cell per column each.
        groups: headings above the columns, each with how many it spans.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    groups: tuple[tuple[str, int], ...] = ()

    def explained(self) -> tuple[Column, ...]:
        """Returns the columns that have something to explain."""
        return tuple(column for column in self.columns if column.meaning)


def text(value: object) -> Cell:
    """Returns a cell with a text, sorted as one."""
    return Cell(str(value) or NOTHING)


def number(value: float, shown: str) -> Cell:
    """Returns a cell with a number; one that is not defined is sorted last."""
    if not math.isfinite(value):
        return Cell(NOTHING, number=True)
    return Cell(shown, repr(float(value)), number=True)


def formatted(value: float, form: str) -> str:
    """Returns a number in a format such as ".2f" or ".0%", with a real minus sign."""
    if not math.isfinite(value):
        return NOTHING
    return f"{value:{form}}".replace("%", " %").replace("-", MINUS)


def share(value: float) -> Cell:
    """Returns a cell with a signed percentage."""
    return number(value, percent(value, 1))


def interval(low: float, high: float) -> Cell:
    """Returns a cell with an interval, sorted by its lower end."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return Cell(NOTHING, number=True)
    return Cell(f"{percent(low, 1)} to {percent(high, 1)}", repr(low), number=True)


def method_cell(method: str) -> Cell:
    """Returns a cell that names a method in its colour."""
    return Cell(short_label(method), colour=method)


def probability(value: float) -> str:
    """Returns a p value as one writes it."""
    return "< 0.0001" if value < 1e-4 else f"{value:.2g}"


def tested(jobs: Iterable[Job]) -> str:
    """Returns which frames are tested, for instance "the last 20 % of each pair's frames"."""
    splits = sorted({job.split for job in jobs if math.isfinite(job.split)})
    if not splits:
        return "the test part of each pair's frames"
    parts = " or ".join(f"{100 * (1 - split):.3g}" for split in splits)
    return f"the last {parts} % of each pair's frames"


def methods_explained(methods: Iterable[str]) -> str:
    """Returns what each method is, as one sentence."""
    parts = [f"{short_label(method)}: {explained(method)}" for method in dict.fromkeys(methods)]
    return f"{'; '.join(parts)}."


def job_names(jobs: Sequence[Job]) -> str:
    """Returns the names of jobs in a row."""
    return ", ".join(job.name for job in jobs)
