"""The table of errors by site."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping

import pandas as pd
from rich.markup import escape
from rich.table import Table

from cfx.evaluation.metrics.base import MetricInfo
from cfx.evaluation.result import METHODS, Evaluation
from cfx.evaluation.sites import ALL_SITES, BASELINES
from cfx.evaluation.tables import scope_label
from cfx.figures.wording import short_label
from cfx.results.table import Column, ResultTable


class Sites(ResultTable):
    """Errors and improvements by site, where pairs of several sites were tested.

    The row `all` is the mean over sites: each counts once, however many pairs it has.
    """

    meaning = "a row per site and type of driver, where several sites were tested"
    suffix = ".csv"
    order = 30
    columns = (
        Column("scope", "", "`test` or `full_trajectory`", "text"),
        Column("site", "", "the road or area; `all`: the mean over sites", "text"),
        Column("driver_type", "", "what drives, `all` for all of them", "text"),
        Column("pairs", "1", "tested pairs", "int"),
        Column("drivers", "1", "their drivers", "int"),
        Column("rmse_speed_METHOD", "m/s", "RMSE of speed, mean over pairs"),
        Column("rmse_gap_METHOD", "m", "RMSE of the gap, mean over pairs"),
        Column(
            "METRIC_METHOD", "as of the metric", "the error that was minimised, mean over pairs"
        ),
        Column("over_BASELINE", "1", "the policy's improvement of that error, geometric"),
        Column("over_BASELINE_median", "1", "its median over pairs"),
        Column("over_BASELINE_low", "1", "lower end of the mean's 95 % interval over drivers"),
        Column("over_BASELINE_high", "1", "its upper end"),
    )

    def metrics(self, evaluation: Evaluation) -> Mapping[str, float]:
        columns = {}
        for method in METHODS:
            for metric in (evaluation.judge, "rmse_speed", "rmse_gap"):
                columns[f"{metric}_{method}"] = f"{metric}/{method}"
        for baseline in BASELINES:
            columns[f"over_{baseline}"] = f"improvement/{evaluation.judge}/{baseline}"
        metrics: dict[str, float] = {}
        table = evaluation.tables["sites"]
        for _, row in table[table["driver_type"] == ALL_SITES].iterrows():
            site = re.sub(r"[^\w.\- ]", "_", str(row["site"]))  # as MLflow takes names
            scope = "" if row["scope"] == "test" else "full_trajectory/"
            for column in row.index.intersection(list(columns)):
                metrics[f"{scope}site/{site}/{columns[column]}"] = float(row[column])
        return metrics

    def console(self, evaluation: Evaluation, metrics: Mapping[str, float]) -> Iterable[Table]:
        for scope, rows in evaluation.tables["sites"].groupby("scope", sort=False):
            yield _sites_printed(rows, scope_label(str(scope)), evaluation.judge_info)


def _sites_printed(rows: pd.DataFrame, scope: str, judge: MetricInfo) -> Table:
    """Returns the error by site and method, and the policy's improvement with its interval."""
    table = Table(title=f"By site, {scope}: {judge.title}; improvement, %", title_justify="left")
    table.add_column("site")
    table.add_column("drivers", justify="right")
    measured = set(rows.dropna(axis=1, how="all"))
    error_columns = []
    for method in METHODS:
        column = f"{judge.name}_{method}"
        if column in measured and method != "shrunk":
            table.add_column(short_label(method), justify="right")
            error_columns.append(column)
    improvement_columns = []
    for baseline in BASELINES:
        column = f"over_{baseline}"
        if column in measured:
            table.add_column(f"over {short_label(baseline)}", justify="right")
            improvement_columns.append(column)
    for _, row in rows.iterrows():
        name = escape(str(row["site"]))
        if row["driver_type"] != ALL_SITES:
            name = f"  {escape(str(row['driver_type']))}"
        cells = [f"{row[column]:.3f}" for column in error_columns]
        for column in improvement_columns:
            cell = f"{100 * row[column]:+.1f}"
            low, high = row[f"{column}_low"], row[f"{column}_high"]
            if math.isfinite(low):
                cell += f"\n{100 * low:+.1f} to {100 * high:+.1f}"
            cells.append(cell)
        table.add_row(name, f"{row['drivers']}", *cells)
    return table
