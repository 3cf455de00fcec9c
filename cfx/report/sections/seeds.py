"""How much results depend on the seed: jobs that differ in it alone, in one row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from cfx.report.figures.text import explained, short_label
from cfx.report.figures.values import finite
from cfx.report.job import Runs
from cfx.report.names import Row, any_adapts, baselines_of, methods_of, rows_over_seeds
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, number, tested


class SeedsSection(Section):
    """How much results depend on the seed: jobs that differ in it alone, in one row."""

    title = "Over seeds"
    entry = "Over seeds"
    order = 100
    template = """
<p>Jobs that differ in the seed alone share a row: their mean, and below it the least and the
largest of them. The seed decides how drivers are divided into folds, what optimizers draw, and how
networks begin. A difference between rows that is no larger than these ranges says nothing. Whether
it holds for other drivers, the intervals of each job say.</p>
{{ table(rows, compact=true, explain=true) }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return the jobs over their seeds; nothing where no two differ in it alone."""
        rows = rows_over_seeds(runs.jobs)
        return None if len(rows) == len(runs.jobs) else {"rows": over_seeds(rows)}


def over_seeds(rows: Sequence[Row]) -> Sheet:
    """Returns a row per group of jobs: errors of each method, and the policy's improvement."""
    where = tested(chain.from_iterable(row.jobs for row in rows))
    columns = [
        Column[Row](
            "Jobs", lambda row: row.name, "Named by what differs between them, without the seed."
        ),
        Column("Seeds", lambda row: number(len(row.jobs), "d"), "Jobs of the row."),
    ]
    errors = "Test part: RMSE of speed in m/s"
    for method in methods_of(rows):
        meaning = f"RMSE of speed over {where}, with {explained(method)}."
        cell = partial(_error, method=method)
        columns.append(Column(short_label(method), cell, meaning, errors))
    for baseline in baselines_of(rows):
        meaning = f"Mean improvement of the RMSE of speed over {explained(baseline)}, test part."
        heading, cell = f"over {short_label(baseline)}", partial(_gain, baseline=baseline)
        columns.append(Column(heading, cell, meaning, "Improvement of the policy"))
    return Sheet.of(columns, rows)


def _error(row: Row, method: str) -> Cell:
    """Returns a method's mean error and its range; empty where its jobs have no such method."""
    if method == "policy" and not any_adapts([row]):
        return number(np.nan, "")
    return _mean_and_range(row.values("rmse_speed", method), ".3f")


def _gain(row: Row, baseline: str) -> Cell:
    return _mean_and_range(row.improvements("mean", baseline), "+.1%")


def _mean_and_range(values: np.ndarray, form: str) -> Cell:
    """Returns the mean, and below it the least and the largest value, where they differ."""
    known = finite(values)
    if not len(known):
        return number(np.nan, form)
    ends = []
    for end in (known.min(), known.max()):
        ends.append(formatted(float(end), form).removesuffix(" %"))
    second = " to ".join(ends) if len(set(ends)) > 1 else ""
    return number(float(known.mean()), form, second)
