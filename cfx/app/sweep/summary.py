"""The table of a sweep: a row per job, by what differs between the jobs."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfx.app.sweep.folder import JobStatus, metrics_of
from cfx.core.console import blank_table
from cfx.core.files import atomic_write
from cfx.errors import DataError
from cfx.evaluation.headline import main_comparison, summaries_disagree
from cfx.figures.wording import short_label

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

    from cfx.evaluation.metrics.base import MetricInfo

SUMMARY = "summary.csv"
"""Says in a sweep's folder what came of it."""

_STATISTICS = ("geometric", "ci95_low", "ci95_high", "ratio_of_means", "drivers")
_COMPARED = ["pair_id", "driver", "frames", "method", "rmse_speed"]
_METHODS = ("default", "driver_specific", "pooled", "policy")
_SHOWN = ("default", "pooled", "driver_specific", "policy")
_OVER = "improvement_over"
_AFTER_OVERRIDES = (_OVER, "rmse_speed_default")
"""The columns behind the overrides: the second, where no job has a policy."""


def metric_columns(folders: Sequence[Path]) -> list[MetricInfo]:
    """Returns the metrics that any of these jobs has measured, besides the RMSE of speed."""
    from cfx.core.job_folder import optional, read_json, read_metrics
    from cfx.results.result import known_metrics

    found: dict[str, MetricInfo] = {}
    for folder in folders:
        with suppress(DataError):  # a job that failed, or whose files are damaged, adds none
            data = optional(folder / "data.json", read_json) or {}
            metrics = optional(folder / "metrics.json", read_metrics) or {}
            for one in known_metrics(data, metrics):
                if one.name != "rmse_speed":
                    found.setdefault(one.name, one)
    return list(found.values())


def rows(statuses: Mapping[Path, JobStatus]) -> list[dict[str, Any]]:
    """Returns a row per job of the summary.

    Columns: folder, the overrides that differ, the improvement, the RMSE of speed, other metrics of
        the policy, seconds and state. Where all jobs are calibrations, the improvement is left out,
        and the other metrics are those of driver-specific parameters.
    """
    given = [_as_mapping(status.overrides) for status in statuses.values()]
    differing = _differing(given)
    columns = metric_columns(list(statuses))
    measured = []
    for folder, status in statuses.items():
        measured.append({} if status.code else metrics_of(folder))
    adapts = any("rmse_speed/policy" in found for found in measured)
    are_calibrations = not adapts and any(
        "rmse_speed/driver_specific" in found for found in measured
    )
    judged = "driver_specific" if are_calibrations else "policy"
    table = []
    for (folder, status), own, found in zip(statuses.items(), given, measured, strict=True):
        row: dict[str, Any] = {"folder": folder.name}
        for key in differing:
            row[key] = own.get(key, "")
        if judged == "policy":
            row |= _improvement(found)
        for method in _METHODS:
            if method != "policy" or judged == "policy":
                row[f"rmse_speed_{method}"] = found.get(f"rmse_speed/{method}")
        for column in columns:
            row[f"{column.name}_{judged}"] = found.get(f"{column.name}/{judged}")
        row["seconds"] = round(status.seconds, 1)
        row["state"] = status.state
        row["message"] = status.message
        table.append(row)
    return table


def errors_of(statuses: Mapping[Path, JobStatus]) -> dict[str, pd.DataFrame]:
    """Returns the errors of each job's pairs, by what differs between the jobs.

    Those of jobs that differ in the seed alone are averaged. Of a job with a policy they are the
    policy's, of a calibration those of driver-specific parameters.

    Returns:
        A row per pair: `pair_id`, `driver`, `frames` and `error` (RMSE of speed, m/s).
    """
    import pandas as pd

    done = {folder: status for folder, status in statuses.items() if not status.code}
    given = [_as_mapping(status.overrides) for status in done.values()]
    differing = [key for key in _differing(given) if key != "seed"]
    alike: dict[str, list[pd.DataFrame]] = {}
    for folder, own in zip(done, given, strict=True):
        name = " ".join(f"{key}={own.get(key, '')}" for key in differing)
        with suppress(OSError, ValueError):  # a job's files may have gone, or be damaged
            table = pd.read_csv(folder / "pairs.csv", usecols=_COMPARED)
            own_method = "policy" if (table["method"] == "policy").any() else "driver_specific"
            rows_of_it = table[table["method"] == own_method]
            alike.setdefault(name, []).append(rows_of_it.rename(columns={"rmse_speed": "error"}))
    found = {}
    for name, tables in alike.items():
        together = pd.concat(tables).groupby(["pair_id", "driver", "frames"])
        found[name] = together[["error"]].mean().reset_index()
    return found


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
    first = list(table[0])
    end = next(first.index(name) for name in _AFTER_OVERRIDES if name in first)
    overrides = first[1:end]
    adapts = _OVER in first
    over = {row[_OVER] for row in table if adapts} - {""}
    methods = [
        one for one in _SHOWN if any(row.get(f"rmse_speed_{one}") is not None for row in table)
    ]
    judged = "policy" if adapts else "driver_specific"
    headlines = [column for column in columns if column.headline]
    shown = blank_table(*(overrides or ["job"]), title="The sweep")
    if adapts:
        heading = "improvement"
        if len(over) == 1:
            heading = f"improvement over {_in_words(min(over))}"
        shown.add_column(f"{heading}\n(95 % interval)", justify="right")
    for method in methods:
        shown.add_column(f"RMSE speed [m/s]\n{short_label(method)}", justify="right")
    for column in headlines:
        title = f"{column.heading} [{column.unit}]" if column.unit else column.heading
        shown.add_column(f"{title}\n{short_label(judged)}", justify="right")
    shown.add_column("time [s]", justify="right")
    shown.add_column("state")
    for row in table:
        cells = [str(row[key]) for key in overrides] or [row["folder"]]
        if adapts:
            cells.append(_improvement_said(row, named=len(over) > 1))
        for method in methods:
            cells.append(_number(row[f"rmse_speed_{method}"]))
        for column in headlines:
            cells.append(_number(row[f"{column.name}_{judged}"]))
        shown.add_row(*cells, f"{row['seconds']:.1f}", row["state"])
    return shown


def _in_words(over: str) -> str:
    """Returns how a baseline is named, with the part of trajectories behind it."""
    baseline, comma, part = over.partition(",")
    return f"{short_label(baseline)}{comma}{part}"


def _as_mapping(overrides: Sequence[str]) -> dict[str, str]:
    return {key: value for key, _, value in (one.partition("=") for one in overrides)}


def _differing(given: Sequence[Mapping[str, str]]) -> list[str]:
    """Returns the keys in which the jobs differ; all if they differ in none."""
    keys = dict.fromkeys(key for one in given for key in one)
    return [key for key in keys if len({one.get(key) for one in given}) > 1] or list(keys)


def _improvement(found: Mapping[str, float]) -> dict[str, Any]:
    """Returns the improvement over the baseline that counts, None where it was not measured."""
    compared = main_comparison(found)
    row: dict[str, Any] = {_OVER: ""}
    row |= dict.fromkeys(f"improvement_{name}" for name in _STATISTICS)
    if compared is None:
        return row
    row[_OVER] = compared.baseline
    if compared.scope != "test":
        row[_OVER] += ", full"
    for name in _STATISTICS:
        row[f"improvement_{name}"] = found.get(f"{compared.key}/{name}")
    return row


def _improvement_said(row: Mapping[str, Any], *, named: bool) -> str:
    """Returns the improvement in words; `named`: with its baseline."""
    geometric = row["improvement_geometric"]
    if geometric is None:
        return ""
    said = f"{geometric:+.1%}"
    low, high = row["improvement_ci95_low"], row["improvement_ci95_high"]
    if low is not None and high is not None:
        said += f" ({low:+.1%} to {high:+.1%})"
    ratio = row["improvement_ratio_of_means"]
    note = "" if ratio is None else summaries_disagree(geometric, ratio)
    if note:
        said += f"\n{note}"
    if named:
        said += f" over {_in_words(row[_OVER])}"
    return said


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
