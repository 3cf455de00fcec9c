"""A row of the benchmark: one job's errors on the frozen pairs, with intervals over drivers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from cfx.errors import DataError
from cfx.plugin import files, statistics
from cfx_report.benchmark.i80 import I80
from cfx_report.benchmark.score import METRICS

ROW, PAIRS, DRIVES = "benchmark.json", "benchmark_pairs.csv", "drives.parquet"
"""What a row leaves: itself, the errors of each pair, and three drives to be looked at."""

COUNTS = ("collisions", "hard_braking")
"""Metrics that are summed over pairs; of the others the mean counts."""

Value = tuple[float, float | None, float | None]
"""A value with the ends of its 95 % interval, where it has one."""


@dataclass(frozen=True)
class Row:
    """One method in the benchmark.

    Attributes:
        name: of the row.
        protocol: version and hash of what is frozen.
        data: what the pairs are.
        command: which gives the row again.
        cfx: version of cfx.
        seconds: CPU time of learning and driving, s.
        pairs, drivers: that were tested.
        values: by metric, or by task and metric: value, low, high; counts have no interval.
        parts: the CPU time of learning (`train`) and of driving (`drive`), s.
        flows: by which share flows behind leaders of constant speed are wrong
            (`cfx_report.benchmark.equilibrium`), in the mean over folds.
        card: who, paper, licence and what was learned from, of a submission.
    """

    name: str
    protocol: str
    data: str
    command: str
    cfx: str
    seconds: float
    pairs: int
    drivers: int
    values: Mapping[str, Value]
    parts: Mapping[str, float] = field(default_factory=dict)
    flows: Mapping[str, float] = field(default_factory=dict)
    card: Mapping[str, str] = field(default_factory=dict)

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
        if not path.is_file():
            raise DataError(f"{path}: there is no such file; give a row's folder, or its file")
        try:
            return cls.of(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise DataError(f"{path}: is no row of the benchmark ({error})") from None

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Row:
        """Returns the row of its fields, as JSON has them.

        Raises:
            ValueError, TypeError, KeyError, AttributeError: they are none.
        """
        by_metric = {}
        for name, (value, low, high) in fields["values"].items():
            by_metric[name] = (float(value), low, high)
        return cls(**{**fields, "values": by_metric})


def values_of(errors: pd.DataFrame) -> dict[str, Value]:
    """Returns each metric of each task: its mean with its 95 % interval over drivers, or its sum.

    Of several sites the mean is over sites, each of which counts once, and has no interval: scores
    over the baseline have.

    Args:
        errors: as `cfx_report.benchmark.score.errors_of` returns them.
    """
    values: dict[str, Value] = {}
    tasks = list(errors.groupby("task", sort=False))
    for task, table in tasks:
        prefix = f"{task}/" if len(tasks) > 1 else ""
        for metric in METRICS:
            if not table[metric].notna().any():
                continue
            if metric in COUNTS:
                values[prefix + metric] = (float(table[metric].sum()), None, None)
            elif len(set(table["site"])) > 1:
                mean = float(table.groupby("site")[metric].mean().mean())
                values[prefix + metric] = (mean, None, None)
            else:
                drivers = table["driver"].astype(str).tolist()
                values[prefix + metric] = statistics.mean_interval(table[metric].tolist(), drivers)
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
    for row in sorted(rows, key=lambda row: row.values["rmse_speed"][0]):
        name = row.name
        if row.protocol != I80.protocol:
            name += f" (other pairs: {row.data})"
        cells = [name, _cell(row, "rmse_speed", 3), _cell(row, "rmse_gap", 2)]
        cells += [f"{row.values[metric][0]:.0f}" for metric in COUNTS]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _cell(row: Row, metric: str, decimals: int) -> str:
    value, low, high = row.values[metric]
    if low is None or high is None:
        return f"{value:.{decimals}f}"
    return f"{value:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f})"
