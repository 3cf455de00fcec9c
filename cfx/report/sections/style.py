"""Driving style of all drivers."""

from __future__ import annotations

import hashlib

import numpy as np

from cfx.plots.choice.common import finite
from cfx.plots.choice.style import style_histogram
from cfx.plots.plotly.figure import Plot
from cfx.plots.plotly.style import style_plot
from cfx.report.blocks import (
    Block,
    Figure,
    Grid,
    Group,
    Heading,
    Section,
    Text,
    missing_file,
)
from cfx.report.job import Job, Runs

_INTRODUCTION = (
    "Each driver's score by the entropy weight method, of all drivers of the data; the dashed lines"
    " cut them into conservative, normal and aggressive."
)


def blocks(runs: Runs) -> list[Block]:
    """Returns a plot for each different scoring of the drivers, with the jobs that it holds for."""
    jobs: dict[str, list[Job]] = {}
    for job in runs.jobs:
        if job.style is not None and len(job.style):
            jobs.setdefault(_scoring(job), []).append(job)
    cards = []
    for together in jobs.values():
        parts: list[Block] = [Figure(style(together[0]))]
        if len(jobs) > 1:
            parts.insert(0, Heading(", ".join(job.name for job in together)))
        cards.append(Group(tuple(parts), "card"))
    lacking = missing_file(runs, "style.csv", "the distribution of the style scores")
    return [Text(_INTRODUCTION), Grid(tuple(cards)), *lacking]


def _scoring(job: Job) -> str:
    assert job.style is not None
    table = job.style[["driver", "score", "cluster"]].to_csv()
    return hashlib.sha256(table.encode()).hexdigest()


def style(job: Job) -> Plot:
    """Histogram of the style scores of a job that has them."""
    assert job.style is not None
    scores = job.style["score"].to_numpy(dtype=float)
    clusters = job.style["cluster"].astype(float).astype(int).to_numpy()
    percentiles = job.setting("style.percentiles")
    if not isinstance(percentiles, list):
        percentiles = [25.0, 75.0]
    known = finite(scores)
    cuts = np.percentile(known, percentiles).tolist() if len(known) else []
    return style_plot(style_histogram(scores, clusters, cuts))


SECTION = Section("style", "Driving style", "Driving style", blocks)
