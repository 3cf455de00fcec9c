"""Figures of a page: those that jobs write, and others that the page alone has."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cfx.report.blocks import Block, Figure, View, job_folds
from cfx.report.figures.figure import draw, figure_named
from cfx.report.job import Job, Runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing


def figure_of(name: str, job: Job) -> Figure | None:
    """Returns the figure of that name as the job has written it; None if the job lacks its data."""
    found = figure_named(name)
    drawing = draw(found, job.results)
    return None if drawing is None else single_view(drawing, found.part.title)


def figure_folds(name: str, runs: Runs) -> list[Block]:
    """Return the figure of that name of each job that has its data, in a fold; the first open."""
    return job_folds(runs, lambda job: [figure_of(name, job)])


def caption(name: str) -> str:
    """Returns what a reader needs to know of the figure of that name."""
    return figure_named(name).part.caption


def single_view(drawing: Drawing, label: str) -> Figure:
    """Returns a drawing as a figure of the page with one view."""
    return Figure({"": view(drawing)}, label)


def view(drawing: Drawing, note: str = "") -> View:
    """Returns a drawing as one view of a figure."""
    from cfx.report.figures.write import inline_svg

    return View(inline_svg(drawing), note)
