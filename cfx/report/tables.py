"""Tables of a report: columns that say what a row shows, cells, and words that several share."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from cfx.report.figures.text import MINUS, NOTHING, explained, percent, short_label
from cfx.report.job import Job

R = TypeVar("R")


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
class Column(Generic[R]):
    """A column of a table.

    Attributes:
        heading: of the column.
        cell: takes a row and returns its cell; a text is one too.
        meaning: a sentence on it that needs no other document.
        group: a heading above it and those of its neighbours that have the same.
    """

    heading: str
    cell: Callable[[R], Cell | str]
    meaning: str = ""
    group: str = ""


@dataclass(frozen=True)
class Sheet:
    """A table: its columns, and rows of a cell per column."""

    columns: tuple[Column[Any], ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def of(cls, columns: Sequence[Column[R]], rows: Iterable[R]) -> Sheet:
        """Returns a table with a row for each of `rows`."""
        found = []
        for row in rows:
            cells = [column.cell(row) for column in columns]
            found.append(tuple(text(cell) if isinstance(cell, str) else cell for cell in cells))
        return cls(tuple(columns), tuple(found))

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The headings above the columns, each with how many it spans; none without any."""
        if not any(column.group for column in self.columns):
            return []
        runs = itertools.groupby(self.columns, key=lambda column: column.group)
        return [(group, len(list(columns))) for group, columns in runs]

    def holds_numbers(self, column: int) -> bool:
        """Says whether a column holds numbers."""
        return any(row[column].number for row in self.rows)

    def explained(self) -> list[Column[Any]]:
        """Returns the columns that have something to explain."""
        return [column for column in self.columns if column.meaning]


def text(value: object) -> Cell:
    """Returns a cell with a text, sorted as one."""
    return Cell(str(value) or NOTHING)


def number(value: float, form: str, second: str = "") -> Cell:
    """Returns a cell with a number in a format as of `formatted`; undefined ones are sorted last.

    Args:
        value: the number.
        form: its format.
        second: a smaller line below.
    """
    if not math.isfinite(value):
        return Cell(NOTHING, number=True, second=second)
    return Cell(formatted(value, form), repr(float(value)), number=True, second=second)


def formatted(value: float, form: str) -> str:
    """Returns a number in a format such as ".2f" or "+.0%", with a real minus sign."""
    if not math.isfinite(value):
        return NOTHING
    return f"{value:{form}}".replace("%", " %").replace("-", MINUS)


def interval(low: float, high: float) -> Cell:
    """Returns a cell with an interval of signed percentages, sorted by its lower end."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return Cell(NOTHING, number=True)
    return Cell(f"{percent(low, 1)} to {percent(high, 1)}", repr(low), number=True)


def method_cell(method: str) -> Cell:
    """Returns a cell that names a method in its colour."""
    return Cell(short_label(method), colour=method)


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
