"""What sections are made of: small objects that one template draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from cfx.report.job import Job, Runs
from cfx.report.tables import Sheet


@dataclass(frozen=True)
class Block:
    """Base of all blocks."""

    @property
    def kind(self) -> str:
        """How the template calls it."""
        return type(self).__name__.lower()


@dataclass(frozen=True)
class Text(Block):
    """A paragraph; `style` is "", "note", "fine" or "lacking" (something is missing)."""

    words: str
    style: str = ""


@dataclass(frozen=True)
class Heading(Block):
    """A heading inside a section, with a smaller remark behind it."""

    words: str
    fine: str = ""


@dataclass(frozen=True)
class Items(Block):
    """A list of sentences."""

    words: tuple[str, ...]


@dataclass(frozen=True)
class Facts(Block):
    """Names and values, in columns."""

    rows: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Listing(Block):
    """Text as it stands in a file."""

    words: str


@dataclass(frozen=True)
class Table(Block):
    """A table.

    Attributes:
        sheet: its content.
        compact: whether it is set small.
        sortable: whether a click on a heading sorts it.
        explain: whether what the columns mean is said below it.
    """

    sheet: Sheet
    compact: bool = False
    sortable: bool = True
    explain: bool = False


@dataclass(frozen=True)
class View:
    """A figure as the page shows it: an `svg` element, and what must be said below it."""

    svg: str
    note: str = ""


@dataclass(frozen=True)
class Figure(Block):
    """A figure with one or several views, of which the reader chooses.

    Attributes:
        views: by what the reader chooses; at least one.
        label: what it shows, for readers who do not see it.
        chooser: what the views differ in, the label of the choice.
    """

    views: Mapping[str, View]
    label: str
    chooser: str = "Policy"


@dataclass(frozen=True)
class Group(Block):
    """Blocks that stay together; `style` is "card" in a grid, or "pair"."""

    blocks: tuple[Block, ...]
    style: str = "pair"


@dataclass(frozen=True)
class Grid(Block):
    """Groups beside each other."""

    groups: tuple[Group, ...]


@dataclass(frozen=True)
class Fold(Block):
    """Blocks that a click shows.

    Attributes:
        summary: what stands there when it is folded.
        blocks: what is shown.
        unfolded: whether it is open at first.
        style: "job" for one of several jobs, else "".
    """

    summary: str
    blocks: tuple[Block, ...]
    unfolded: bool = False
    style: str = ""


MOST = 6
"""Jobs that are drawn at once, or named in a sentence; of more, the others are folded away."""


def cards(groups: Sequence[Group]) -> list[Block]:
    """Returns the cards of some jobs, beside each other, and the others' in a fold."""
    found: list[Block] = [Grid(tuple(groups[:MOST]))]
    others = groups[MOST:]
    if others:
        found.append(Fold(f"{len(others)} more jobs", (Grid(tuple(others)),)))
    return found


def job_folds(runs: Runs, parts: Callable[[Job], Sequence[Block | None]]) -> list[Block]:
    """Return a fold for each job that has something to show; the first is open.

    Args:
        runs: the jobs.
        parts: takes a job and returns its blocks; None is left out.
    """
    found: list[Block] = []
    for job in runs.jobs:
        blocks = [block for block in parts(job) if block is not None]
        if blocks:
            found.append(job_fold(job.name, blocks, first=not found))
    return found


def job_fold(name: str, blocks: Sequence[Block], *, first: bool) -> Fold:
    """Returns the fold of one job; the first is open."""
    return Fold(name, tuple(blocks), unfolded=first, style="job")


def missing_file(runs: Runs, file: str, what: str) -> list[Block]:
    """Returns a remark on the jobs that lack a file; nothing if none does.

    Args:
        runs: the jobs.
        file: its name.
        what: what cannot be shown without it.
    """
    without = [job.name for job in runs.jobs if file in job.missing]
    if not without:
        return []
    reason = "an older version of cfx wrote it, or the file was removed"
    names = ", ".join(without)
    return [Text(f"Not shown for {names}: {what}; this job has no {file} ({reason}).", "lacking")]
