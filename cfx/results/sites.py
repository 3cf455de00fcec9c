"""The table of results by site."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping

import pandas as pd
from rich.markup import escape
from rich.table import Table

from cfx.evaluation.result import METHODS
from cfx.evaluation.sites import ALL, BASELINES
from cfx.evaluation.tables import scope_label
from cfx.results.table import Column, Findings, ResultTable


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
        Column("over_BASELINE", "1", "the policy's improvement of the RMSE of speed, mean"),
        Column("over_BASELINE_median", "1", "its median over pairs"),
        Column("over_BASELINE_low", "1", "lower end of the mean's 95 % interval over drivers"),
        Column("over_BASELINE_high", "1", "its upper end"),
    )

    def rows(self, findings: Findings) -> Iterable[pd.DataFrame | None]:
        return [findings.sites]

    def metrics(self, findings: Findings) -> Mapping[str, float]:
        found: dict[str, float] = {}
        table = findings.sites
        if table is None:
            return found
        for _, row in table[table["driver_type"] == ALL].iterrows():
            site = re.sub(r"[^\w.\- ]", "_", str(row["site"]))
            prefix = f"site/{site}" if row["scope"] == "test" else f"full_trajectory/site/{site}"
            for method in METHODS:
                for metric in ("rmse_speed", "rmse_gap"):
                    if f"{metric}_{method}" in row:
                        found[f"{prefix}/{metric}/{method}"] = float(row[f"{metric}_{method}"])
            for baseline in BASELINES:
                if f"over_{baseline}" in row:
                    value = float(row[f"over_{baseline}"])
                    found[f"{prefix}/rmse_improvement/{baseline}"] = value
        return found

    def console(self, findings: Findings, metrics: Mapping[str, float]) -> Iterable[Table]:
        if findings.sites is not None:
            for scope, rows in findings.sites.groupby("scope", sort=False):
                yield _printed(rows, scope_label(str(scope)))


def _printed(rows: pd.DataFrame, scope: str) -> Table:
    """Returns RMSE of speed by site and method, and the policy's improvement with its interval."""
    table = Table(
        title=f"By site, {scope}: RMSE of speed, m/s; improvement, %", title_justify="left"
    )
    table.add_column("site")
    table.add_column("drivers", justify="right")
    methods = [one for one in METHODS if _is_there(rows, f"rmse_speed_{one}") and one != "shrunk"]
    for method in methods:
        table.add_column(method, justify="right")
    baselines = [one for one in BASELINES if _is_there(rows, f"over_{one}")]
    for baseline in baselines:
        table.add_column(f"over {baseline}", justify="right")
    for _, row in rows.iterrows():
        name = escape(str(row["site"]))
        if row["driver_type"] != ALL:
            name = f"  {escape(str(row['driver_type']))}"
        cells = [f"{row[f'rmse_speed_{method}']:.3f}" for method in methods]
        for baseline in baselines:
            value, low, high = (row[f"over_{baseline}{end}"] for end in ("", "_low", "_high"))
            cell = f"{100 * value:+.1f}"
            if math.isfinite(low):
                cell += f"\n{100 * low:+.1f} to {100 * high:+.1f}"
            cells.append(cell)
        table.add_row(name, f"{row['drivers']}", *cells)
    return table


def _is_there(rows: pd.DataFrame, name: str) -> bool:
    return name in rows and bool(rows[name].notna().any())
