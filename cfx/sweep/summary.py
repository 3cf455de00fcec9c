"""The table of a sweep: a row per job, by what differs between the jobs."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfx.console import blank_table
from cfx.files import atomic_write
from cfx.sweep.status import JobStatus, metrics_of

if TYPE_CHECKING:
    from rich.table import Table

SUMMARY = "summary.csv"
"""Says in a sweep's folder what came of it."""

_BASELINES = ("population", "fixed")
"""What a policy is compared with, the first that was measured: one set for all training drivers if drivers are unseen."""

_FIXED_COLUMNS = frozenset(
    ["folder", "improvement_over", "seconds", "state", "message"]
    + [f"improvement_{name}" for name in ("mean", "ci95_low", "ci95_high")]
    + [f"rmse_speed_{name}" for name in ("default", "fixed", "population", "policy")]
)


def rows(statuses: Mapping[Path, JobStatus]) -> list[dict[str, Any]]:
    """Returns a row per job of the summary: folder, the overrides that differ, improvement, RMSE of speed, seconds and state."""
    given = [
        dict(one.partition("=")[::2] for one in status.overrides) for status in statuses.values()
    ]
    keys = list(dict.fromkeys(key for one in given for key in one))
    differing = [key for key in keys if len({one.get(key) for one in given}) > 1] or keys
    table = []
    for (folder, status), own in zip(statuses.items(), given, strict=True):
        found = {} if status.code else metrics_of(folder)
        baseline = next((one for one in _BASELINES if f"rmse_improvement/{one}/mean" in found), "")
        prefix = f"rmse_improvement/{baseline}" if baseline else "rmse_improvement"
        improvement = {
            f"improvement_{name}": found.get(f"{prefix}/{name}")
            for name in ("mean", "ci95_low", "ci95_high")
        }
        rmse = {
            f"rmse_speed_{name}": found.get(f"rmse_speed/{name}")
            for name in ("default", "fixed", "population", "policy")
        }
        table.append(
            {
                "folder": folder.name,
                **{key: own.get(key, "") for key in differing},
                "improvement_over": (baseline or "fixed")
                if improvement["improvement_mean"] is not None
                else "",
                **improvement,
                **rmse,
                "seconds": round(status.seconds, 1),
                "state": status.state,
                "message": status.message,
            }
        )
    return table


def write_summary(path: Path, table: Sequence[Mapping[str, Any]]) -> None:
    """Writes `rows` as CSV; a cell without a value is empty."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


def summary_table(table: Sequence[Mapping[str, Any]]) -> Table:
    """Returns `rows` as a rich table."""
    over = {row["improvement_over"] for row in table} - {""}
    several = len(over) > 1
    columns = [key for key in table[0] if key not in _FIXED_COLUMNS]
    shown = blank_table(*(columns or ["job"]), title="The sweep")
    heading = f"improvement over {min(over)}" if len(over) == 1 else "improvement"
    shown.add_column(f"{heading}\n(95 % interval)", justify="right")
    for name in ("default", "fixed", "policy"):
        shown.add_column(f"RMSE speed [m/s]\n{name}", justify="right")
    shown.add_column("time [s]", justify="right")
    shown.add_column("state")
    for row in table:
        shown.add_row(
            *([str(row[column]) for column in columns] or [row["folder"]]),
            _improvement(row)
            + (f" over {row['improvement_over']}" if several and row["improvement_over"] else ""),
            *(_number(row[f"rmse_speed_{name}"]) for name in ("default", "fixed", "policy")),
            f"{row['seconds']:.1f}",
            row["state"],
        )
    return shown


def _improvement(row: Mapping[str, Any]) -> str:
    if row["improvement_mean"] is None:
        return ""
    ends = [row["improvement_ci95_low"], row["improvement_ci95_high"]]
    interval = "" if None in ends else f" ({ends[0]:+.1%} to {ends[1]:+.1%})"
    return f"{row['improvement_mean']:+.1%}{interval}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
