"""All metrics of all methods, whoever brought them: what the files of a job say of them."""

from __future__ import annotations

import math

from cfx.report.blocks import Block, Table, Text, job_folds
from cfx.report.figures.words import explained, short_label
from cfx.report.job import Job, Runs
from cfx.report.metrics import metric_title
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, number, text

_INTRODUCTION = (
    "Every metric that a job measured, those of plugins too: one number for each method, which is"
    " the mean, the sum, the least or the largest value over the pairs. Every method starts from"
    " the same measured state and covers the same frames."
)


class MetricsSection(Section):
    """All metrics of all methods, whoever brought them: what the files of a job say of them."""

    title = "All metrics"
    entry = "All metrics"
    order = 600

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a table for each job."""
        return [Text(_INTRODUCTION), *job_folds(runs, _parts)]


def _parts(job: Job) -> list[Block]:
    parts: list[Block] = [Table(all_metrics(job), compact=True)]
    for one in job.data.get("metrics_left_out") or ():
        name, distribution = one.get("name"), one.get("distribution")
        said = f"{name} of {distribution} could not be measured: {one.get('reason')}"
        parts.append(Text(said, "lacking"))
    return parts


def all_metrics(job: Job) -> Sheet:
    """Returns a row for each metric and part of the trajectories, a column for each method."""
    methods = list(job.meaningful_methods)
    if any(key.endswith("/real") for key in job.metrics):
        methods.insert(0, "real")
    columns = [
        Column("Metric", number=False),
        Column("Frames", number=False),
        Column("Over pairs", number=False),
        Column("Better", number=False),
    ]
    for method in methods:
        columns.append(Column(short_label(method), explained(method)))
    columns.append(Column("Meaning", number=False))
    rows = []
    for metric in job.known_metrics:
        for scope in metric.scopes:
            frames = job.scope_label(scope)
            about = [text(metric_title(metric)), text(frames), text(metric.summary)]
            better = metric.direction if metric.direction != "none" else ""
            cells = []
            for method in methods:
                cells.append(_value(job.metric(metric.name, method, scope)))
            meaning = metric.meaning
            if metric.distribution and not metric.distribution.startswith("cfx-driving"):
                meaning += f" (of {metric.distribution})"
            rows.append((*about, text(better), *cells, text(meaning)))
    return Sheet(tuple(columns), tuple(rows))


def _value(value: float) -> Cell:
    if math.isfinite(value) and value == round(value) and abs(value) < 1e6:
        return number(value, formatted(value, ".0f"))
    return number(value, formatted(value, ".3g"))
