"""What a section of the report is: a template, and what the template shows of some jobs.

An entry point of the group `cfx.sections` makes it known; its name becomes its anchor in the page.
Its tables are `Sheet`s: columns that say what a row shows, and cells.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from cfx.plugin import Component, Result, wording
from cfx_report.jobs import Runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class View:
    """One view of a figure of which the reader chooses, and what must be said below it."""

    drawing: Figure
    note: str = ""

    @property
    def svg(self) -> str:
        """The drawing as an `svg` element."""
        from cfx_report.inline import inline_svg

        return inline_svg(self.drawing)


class Section(Component):
    """A section of the page about finished jobs.

    Its template is Jinja's; what stands between braces is escaped. Beside what `context` gives, it
    has `runs` and these functions:

    - `table(sheet, compact, sortable, explain)`: a `cfx_report.section.Sheet`; set small, sorted by
      a click on a heading, with what its columns say below it.
    - `drawn(name, job)`: the figure of that name as the job has written it; nothing if the job
      lacks its data. `drawn_folds(name, jobs)`: the same of several jobs, a fold each.
    - `figure(views, label, chooser)`: `View`s by what the reader chooses.
    - `caption(name)`: what a reader needs to know of a figure.
    - `fold(summary, unfolded, style)`: what a click shows, as `{% call fold("More") %}`.
    - `cards(name, headed)`: the figure of that name of several jobs beside each other; `headed` has
      a heading, a smaller remark and a job for each.
    - `missing(file, what)`: a remark on the jobs that lack a file.

    Attributes:
        title: its heading.
        entry: its name in the contents.
        order: its place in the page; cfx's own stand at 100, 200, ...
        figures: names of the figures that it shows. Those of other distributions that no section
            shows stand in "Further figures".
        template: by default the figures with their captions, of each job that has their data.
    """

    kind = "section"
    title: ClassVar[str] = ""
    entry: ClassVar[str] = ""
    order: ClassVar[int] = 1000
    figures: ClassVar[tuple[str, ...]] = ()
    template: ClassVar[str] = """
{% for name in section.figures %}
{% set folds = drawn_folds(name, runs.jobs) | trim %}
{% if folds %}
<p>{{ caption(name) }}</p>
{{ folds }}
{% endif %}
{% endfor %}
"""

    @classmethod
    def complaint(cls) -> str:
        """Returns what is wrong with what a class declares; "" if nothing is."""
        return "" if cls.title and cls.entry else " has no title or no entry; give it both"

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Returns what the template shows by name; None where there is nothing to show."""
        return {}


MOST = 6
"""Jobs that are drawn at once, or named in a sentence; of more, the others are folded away."""


def lacking(jobs: tuple[Result, ...], file: str, what: str) -> str:
    """Returns a sentence on the jobs that lack a file; "" if none does.

    Args:
        jobs: of the page.
        file: its name.
        what: what cannot be shown without it.
    """
    without = [job.name for job in jobs if file in job.missing]
    if not without:
        return ""
    reason = "an older version of cfx wrote it, or the file was removed"
    return f"Not shown for {', '.join(without)}: {what}; this job has no {file} ({reason})."


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
        lines = []
        for row in rows:
            cells = []
            for column in columns:
                cell = column.cell(row)
                cells.append(text(cell) if isinstance(cell, str) else cell)
            lines.append(tuple(cells))
        return cls(tuple(columns), tuple(lines))

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
    return Cell(str(value) or wording.NOTHING)


def number(value: float, form: str, second: str = "") -> Cell:
    """Returns a cell with a number in a format as of `formatted`; undefined ones are sorted last.

    Args:
        value: the number.
        form: its format.
        second: a smaller line below.
    """
    if not math.isfinite(value):
        return Cell(wording.NOTHING, number=True, second=second)
    return Cell(formatted(value, form), repr(float(value)), number=True, second=second)


def formatted(value: float, form: str) -> str:
    """Returns a number in a format such as ".2f" or "+.0%", with a real minus sign."""
    if not math.isfinite(value):
        return wording.NOTHING
    return f"{value:{form}}".replace("%", " %").replace("-", wording.MINUS)


def interval(low: float, high: float) -> Cell:
    """Returns a cell with an interval of signed percentages, sorted by its lower end."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return Cell(wording.NOTHING, number=True)
    return Cell(wording.percent_interval(low, high), repr(low), number=True)


def method_cell(method: str) -> Cell:
    """Returns a cell that names a method in its colour."""
    return Cell(wording.short_label(method), colour=method)


def tested(jobs: Iterable[Result]) -> str:
    """Returns which frames are tested, for instance "the last 20 % of each pair's frames"."""
    splits = set()
    for job in jobs:
        if math.isfinite(job.split):
            splits.add(job.split)
    if not splits:
        return "the test part of each pair's frames"
    if splits == {1.0}:
        return "all of each pair's frames, which were calibrated on"
    percentages = " or ".join(f"{100 * (1 - split):.3g}" for split in sorted(splits))
    return f"the last {percentages} % of each pair's frames"


def methods_explained(methods: Iterable[str]) -> str:
    """Returns what each method is, as one sentence."""
    explanations = []
    for method in dict.fromkeys(methods):
        explanations.append(f"{wording.short_label(method)}: {wording.explained(method)}")
    return f"{'; '.join(explanations)}."


def job_names(jobs: Sequence[Result]) -> str:
    """Returns the names of jobs in a row."""
    return ", ".join(job.name for job in jobs)
