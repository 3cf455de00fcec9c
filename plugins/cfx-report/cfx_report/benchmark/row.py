"""A row of the benchmark: one job's errors on the frozen pairs, with intervals over drivers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from cfx.errors import DataError
from cfx.plugin import column_of, files, names, statistics
from cfx_report.benchmark.frozen import METRICS, SCOPE, VERSION, protocol_hash

ROW, PAIRS = "benchmark.json", "benchmark_pairs.csv"
"""What a job of the benchmark leaves beside its own results."""

COUNTS = ("collisions", "hard_braking")
"""Metrics that are summed over pairs; of the others the mean counts."""

_DIGITS = 6
"""Digits after the point in the files that people compare."""


@dataclass(frozen=True)
class Row:
    """One method in the benchmark.

    Attributes:
        name: of the row.
        protocol: version and hash of what is frozen.
        data: what the pairs are.
        command: which gives the row again.
        cfx: version of cfx.
        seconds: that the job took, beside whatever else ran.
        pairs, drivers: that were tested.
        values: by metric: value, low, high; counts have no interval.
    """

    name: str
    protocol: str
    data: str
    command: str
    cfx: str
    seconds: float
    pairs: int
    drivers: int
    values: Mapping[str, tuple[float, float | None, float | None]]

    def write(self, path: Path) -> None:
        """Writes the row.

        Raises:
            OutputError: the file cannot be written.
        """
        files.write_json(path, asdict(self))

    @classmethod
    def read(cls, path: Path) -> Row:
        """Reads a row.

        Raises:
            DataError: the file is none.
        """
        try:
            values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            found = {}
            for name, (value, low, high) in values.pop("values").items():
                found[name] = (float(value), low, high)
            return cls(values=found, **values)
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise DataError(f"{path}: is no row of the benchmark ({error})") from None


def protocol_name(data: str) -> str:
    """Returns the version and the hash of the protocol on pairs with this fingerprint."""
    return f"{VERSION}/{protocol_hash(data)}"


def errors_of(job: Path, row: str, protocol: str, method: str) -> pd.DataFrame:
    """Returns the errors of a finished job: a row per tested pair.

    Columns: `protocol`, `row`, `pair_id`, `driver`, and the metrics in SI units.

    Args:
        job: its folder.
        row: the row's name.
        method: whose errors they are, as the job calls it.

    Raises:
        DataError: the job has none of this method.
    """
    table = pd.read_csv(job / "pairs.csv")
    table = table[table["method"] == method]
    columns = {metric: column_of(metric, SCOPE) for metric in METRICS}
    if table.empty or not set(columns.values()) <= set(table.columns):
        raise DataError(f"{job}: has no errors of '{method}' over full trajectories")
    pair_ids = names.names_of(table["pair_id"])
    found = pd.DataFrame({"protocol": protocol, "row": row, "pair_id": pair_ids}, table.index)
    found["driver"] = table["driver"]
    for metric, column in columns.items():
        found[metric] = table[column].astype(float).round(_DIGITS)
    return found.sort_values("pair_id").reset_index(drop=True)


def values_of(errors: pd.DataFrame) -> dict[str, tuple[float, float | None, float | None]]:
    """Returns each metric's mean over pairs with its 95 % interval over drivers, or its sum."""
    drivers = errors["driver"].astype(str).tolist()
    values: dict[str, tuple[float, float | None, float | None]] = {}
    for metric in METRICS:
        if metric in COUNTS:
            values[metric] = (float(errors[metric].sum()), None, None)
        else:
            values[metric] = statistics.mean_interval(errors[metric].tolist(), drivers)
    return values


def markdown(rows: Sequence[Row]) -> list[str]:
    """Returns a table of rows, the best RMSE of speed first.

    Rows of other protocols or pairs are marked: their errors do not compare. Braking frames are
    those with an acceleration below -8 m/s2.
    """
    lines = [
        "| row | RMSE of speed [m/s] | RMSE of the gap [m] | collisions | braking frames |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in sorted(rows, key=lambda one: one.values["rmse_speed"][0]):
        name = row.name
        if row.protocol != protocol_name_of_frozen():
            name += f" (other pairs: {row.data})"
        cells = [name, _cell(row, "rmse_speed", 3), _cell(row, "rmse_gap", 2)]
        cells += [f"{row.values[metric][0]:.0f}" for metric in COUNTS]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def protocol_name_of_frozen() -> str:
    """Returns the version and the hash of the protocol on the frozen pairs."""
    return f"{VERSION}/{protocol_hash()}"


def _cell(row: Row, metric: str, decimals: int) -> str:
    value, low, high = row.values[metric]
    if low is None or high is None:
        return f"{value:.{decimals}f}"
    return f"{value:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f})"
