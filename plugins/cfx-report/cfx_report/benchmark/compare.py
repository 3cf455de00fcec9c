"""Pair by pair against another's errors."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from cfx.errors import DataError
from cfx.plugin import Improvement, headline, names, statistics
from cfx_report.benchmark.row import COUNTS

_NEEDED = ("row", "pair_id", "driver")
_LABELS = {"protocol", "row", "task", "site", "pair_id", "driver", "frames"}

ONLY_TASK = "unseen"
"""The task of tables that name none."""


def read_errors(path: Path) -> pd.DataFrame:
    """Reads errors per pair, of one row or several.

    Raises:
        DataError: the file cannot be read, or is none of the benchmark's.
    """
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as CSV ({error})") from None
    missing = [name for name in (*_NEEDED, "protocol") if name not in table.columns]
    if missing:
        raise DataError(
            f"{path}: column {missing[0]} is missing; --against takes the benchmark_pairs.csv that"
            " cfx benchmark writes"
        )
    if "task" not in table.columns:
        table["task"] = ONLY_TASK
    return table.assign(pair_id=names.names_of(table["pair_id"]))


def compared(
    mine: pd.DataFrame, others: pd.DataFrame, source: str
) -> dict[tuple[str, str], Improvement]:
    """Compares errors with those of every row of a table.

    Returns:
        By row and metric (of several tasks, task and metric): how much smaller my errors are, as a
        share of theirs, with the interval over drivers and the t test.

    Raises:
        DataError: the other pairs or their protocol are not mine.
    """
    improvements: dict[tuple[str, str], Improvement] = {}
    protocol = mine["protocol"].iloc[0]
    tasks = list(mine.groupby("task", sort=False))
    for name, other in others.groupby("row", sort=False):
        theirs = sorted(set(other["protocol"].astype(str)))
        if theirs != [protocol]:
            raise DataError(
                f"{source}, row '{name}': is of the protocol {', '.join(theirs)}, this is of"
                f" {protocol}; errors of different protocols or pairs do not compare"
            )
        for task, table in tasks:
            of_task = _compared(table, other[other["task"] == task], f"{source}, row '{name}'")
            for metric, improvement in of_task.items():
                label = metric if len(tasks) == 1 else f"{task}/{metric}"
                improvements[str(name), label] = improvement
    return improvements


def _compared(mine: pd.DataFrame, other: pd.DataFrame, source: str) -> dict[str, Improvement]:
    """Compares the errors of one row in one task."""
    twice = names.named_twice(other["pair_id"].tolist())
    if twice is not None:
        raise DataError(f"{source}: pair '{twice}' stands in it twice")
    both = mine.merge(other, on="pair_id", suffixes=("", "_other"))
    if len(both) < len(mine) or len(other) != len(mine):
        raise DataError(
            f"{source}: has {len(other)} pairs, of which {len(both)} are among my {len(mine)}; the"
            " benchmark compares all of them"
        )
    improvements = {}
    for metric in mine.columns:
        if metric in _LABELS or metric in COUNTS or mine[metric].isna().all():
            continue
        if f"{metric}_other" not in both:
            raise DataError(f"{source}: column {metric} is missing")
        improvements[str(metric)] = statistics.improvement_statistics(
            both[f"{metric}_other"].to_numpy(float),
            both[metric].to_numpy(float),
            both["driver"].astype(str).tolist(),
        )
    return improvements


def lines_of(improvements: dict[tuple[str, str], Improvement]) -> list[str]:
    """Returns a comparison as a Markdown table."""
    lines = [
        "| against | error | smaller by | 95 % interval | pairs won | p |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for (row, metric), improvement in improvements.items():
        # 0.0 is added so that no difference is +0.0 %, not -0.0 %.
        interval = headline.interval_in_words(
            improvement.ci95_low + 0.0, improvement.ci95_high + 0.0, "%"
        )
        lines.append(
            f"| {row} | {metric} | {improvement.geometric + 0.0:+.1%} | {interval} |"
            f" {improvement.win_rate:.0%} of {improvement.pairs} | {improvement.p_value:.2g} |"
        )
    return lines
