"""The table of a sweep: a row per job, by what differs between the jobs."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfx.app.sweep.record import JobStatus, metrics_of
from cfx.core.console import blank_table
from cfx.core.errors import DataError
from cfx.core.files import atomic_write
from cfx.evaluation.headline import main_comparison, ratio_of_means

if TYPE_CHECKING:
    from rich.table import Table

    from cfx.evaluation.metrics.base import MetricInfo

SUMMARY = "summary.csv"
"""Says in a sweep's folder what came of it."""

_STATISTICS = ("mean", "ci95_low", "ci95_high")
_OF_MEANS = "of_means"
_METHODS = ("default", "fixed", "population", "policy")
_SHOWN = ("default", "fixed", "policy")
_AFTER_OVERRIDES = "improvement_over"


def metric_columns(folders: Sequence[Path]) -> list[MetricInfo]:
    """Returns the metrics that any of these jobs has measured, besides the RMSE of speed."""
    from cfx.core.job_folder import optional, read_json, read_metrics
    from cfx.report.job import known_metrics

    found: dict[str, MetricInfo] = {}
    for folder in folders:
        with suppress(DataError):  # a job that failed, or whose files are damaged, adds none
            data = optional(folder / "data.json", read_json) or {}
            metrics = optional(folder / "metrics.json", read_metrics) or {}
            for one in known_metrics(data, metrics):
                if one.name != "rmse_speed":
                    found.setdefault(one.name, one)
    return list(found.values())


def _column(metric: MetricInfo) -> str:
    """Returns the column of `summary.csv` with a metric of the policy."""
    return f"{metric.name}_policy"


def rows(statuses: Mapping[Path, JobStatus]) -> list[dict[str, Any]]:
    """Returns a row per job of the summary.

    Columns: folder, the overrides that differ, the improvement, the RMSE of speed, other metrics of
        the policy, seconds and state.
    """
    given = [_as_mapping(status.overrides) for status in statuses.values()]
    differing = _differing(given)
    columns = metric_columns(list(statuses))
    table = []
    for (folder, status), own in zip(statuses.items(), given, strict=True):
        found: dict[str, float] = {}
        if not status.code:
            found = metrics_of(folder)
        row: dict[str, Any] = {"folder": folder.name}
        for key in differing:
            row[key] = own.get(key, "")
        row |= _improvement(found)
        for method in _METHODS:
            row[f"rmse_speed_{method}"] = found.get(f"rmse_speed/{method}")
        for column in columns:
            row[_column(column)] = found.get(f"{column.name}/policy")
        row["seconds"] = round(status.seconds, 1)
        row["state"] = status.state
        row["message"] = status.message
        table.append(row)
    return table


def write_summary(path: Path, table: Sequence[Mapping[str, Any]]) -> None:
    """Writes `rows` as CSV; a cell without a value is empty."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


def summary_table(table: Sequence[Mapping[str, Any]], columns: Sequence[MetricInfo] = ()) -> Table:
    """Returns `rows` as a rich table.

    Args:
        columns: what else than the RMSE of speed was measured; those that are headlines are shown.
    """
    over = {row["improvement_over"] for row in table} - {""}
    several = len(over) > 1
    first = list(table[0])
    overrides = first[1 : first.index(_AFTER_OVERRIDES)]
    headlines = [column for column in columns if column.headline]
    shown = blank_table(*(overrides or ["job"]), title="The sweep")
    heading = "improvement"
    if len(over) == 1:
        heading = f"improvement over {min(over)}"
    shown.add_column(f"{heading}\n(95 % interval)", justify="right")
    for method in _SHOWN:
        shown.add_column(f"RMSE speed [m/s]\n{method}", justify="right")
    for column in headlines:
        title = f"{column.heading} [{column.unit}]" if column.unit else column.heading
        shown.add_column(f"{title}\npolicy", justify="right")
    shown.add_column("time [s]", justify="right")
    shown.add_column("state")
    for row in table:
        cells = [str(row[key]) for key in overrides] or [row["folder"]]
        cells.append(_improvement_said(row, named=several))
        for method in _SHOWN:
            cells.append(_number(row[f"rmse_speed_{method}"]))
        for column in headlines:
            cells.append(_number(row[_column(column)]))
        shown.add_row(*cells, f"{row['seconds']:.1f}", row["state"])
    return shown


def _as_mapping(overrides: Sequence[str]) -> dict[str, str]:
    found = {}
    for one in overrides:
        key, _, value = one.partition("=")
        found[key] = value
    return found


def _differing(given: Sequence[Mapping[str, str]]) -> list[str]:
    """Returns the keys in which the jobs differ; all if they differ in none."""
    keys: dict[str, set[str | None]] = {}
    for one in given:
        for key in one:
            keys.setdefault(key, set())
    for one in given:
        for key, values in keys.items():
            values.add(one.get(key))
    return [key for key, values in keys.items() if len(values) > 1] or list(keys)


def _improvement(found: Mapping[str, float]) -> dict[str, Any]:
    """Returns the improvement over the baseline that counts, None where it was not measured."""
    compared = main_comparison(found)
    row: dict[str, Any] = {_AFTER_OVERRIDES: ""}
    row |= dict.fromkeys(f"improvement_{name}" for name in (*_STATISTICS, _OF_MEANS))
    if compared is None:
        return row
    row[_AFTER_OVERRIDES] = compared.baseline
    if compared.scope != "test":
        row[_AFTER_OVERRIDES] += ", full"
    for name in _STATISTICS:
        row[f"improvement_{name}"] = found.get(f"{compared.key}/{name}")
    ratio = ratio_of_means(found, compared)
    row[f"improvement_{_OF_MEANS}"] = ratio if math.isfinite(ratio) else None
    return row


def _improvement_said(row: Mapping[str, Any], *, named: bool) -> str:
    """Returns the improvement in words; `named`: with its baseline."""
    mean = row["improvement_mean"]
    if mean is None:
        return ""
    said = f"{mean:+.1%}"
    low, high = row["improvement_ci95_low"], row["improvement_ci95_high"]
    if low is not None and high is not None:
        said += f" ({low:+.1%} to {high:+.1%})"
    ratio = row[f"improvement_{_OF_MEANS}"]
    if ratio is not None and mean * ratio < 0:
        said += f"\nof the mean RMSE {ratio:+.1%}"
    if named:
        said += f" over {row['improvement_over']}"
    return said


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3f}"
