"""How much results depend on the seed: jobs that differ in it alone, in one row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cfx.report.blocks import Block, Table, Text
from cfx.report.figures.values import finite
from cfx.report.figures.words import explained, percent, short_label
from cfx.report.job import Job, Runs
from cfx.report.names import Row, any_adapts, baselines_of, methods_of, rows_over_seeds
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, number, tested, text

_INTRODUCTION = (
    "Jobs that differ in the seed alone share a row: their mean, and below it the least and the"
    " largest of them. The seed decides how drivers are divided into folds, what optimizers draw,"
    " and how networks begin. A difference between rows that is no larger than these ranges says"
    " nothing. Whether it holds for other drivers, the intervals of each job say."
)


class SeedsSection(Section):
    """How much results depend on the seed: jobs that differ in it alone, in one row."""

    title = "Over seeds"
    entry = "Over seeds"
    order = 100

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a table of the jobs over their seeds; nothing where no two differ in it alone."""
        rows = rows_over_seeds(runs.jobs)
        if len(rows) == len(runs.jobs):
            return []
        return [Text(_INTRODUCTION), Table(over_seeds(rows), compact=True, explain=True)]


def over_seeds(rows: Sequence[Row]) -> Sheet:
    """Returns a row per group of jobs: errors of each method, and the policy's improvement."""
    jobs: list[Job] = []
    for row in rows:
        jobs += row.jobs
    columns = [
        Column("Jobs", "Named by what differs between them, without the seed.", number=False),
        Column("Seeds", "Jobs of the row."),
    ]
    cells: list[list[Cell]] = []
    for row in rows:
        count = len(row.jobs)
        cells.append([text(row.name), number(count, str(count))])
    methods, baselines = methods_of(rows), baselines_of(rows)
    for method in methods:
        meaning = f"RMSE of speed over {tested(jobs)}, with {explained(method)}."
        columns.append(Column(short_label(method), meaning))
        for line, row in zip(cells, rows, strict=True):
            line.append(_error(row, method))
    for baseline in baselines:
        meaning = f"Mean improvement of the RMSE of speed over {explained(baseline)}, test part."
        columns.append(Column(f"over {short_label(baseline)}", meaning))
        for line, row in zip(cells, rows, strict=True):
            line.append(_gain(row, baseline))
    groups = [("", 2), ("Test part: RMSE of speed in m/s", len(methods))]
    if baselines:
        groups.append(("Improvement of the policy", len(baselines)))
    return Sheet(tuple(columns), tuple(map(tuple, cells)), tuple(groups))


def _error(row: Row, method: str) -> Cell:
    """Returns a method's mean error and its range; empty where its jobs have no such method."""
    known = finite(row.values("rmse_speed", method))
    if not len(known) or (method == "policy" and not any_adapts([row])):
        return number(np.nan, "")
    cell = number(float(known.mean()), f"{known.mean():.3f}")
    return _with_range(cell, [f"{end:.3f}" for end in (known.min(), known.max())])


def _gain(row: Row, baseline: str) -> Cell:
    known = finite(row.improvements("mean", baseline))
    if not len(known):
        return number(np.nan, "")
    cell = number(float(known.mean()), percent(float(known.mean()), 1))
    ends = [percent(float(end), 1).removesuffix(" %") for end in (known.min(), known.max())]
    return _with_range(cell, ends)


def _with_range(cell: Cell, ends: Sequence[str]) -> Cell:
    """Returns a cell with the least and the largest value below it, where they differ."""
    if len(set(ends)) < 2:
        return cell
    return replace(cell, second=" to ".join(ends))
