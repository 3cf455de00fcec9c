"""The table of a sweep: a row per job, the smallest error first, by what differs between them."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfx.app.sweep.folder import JobStatus, data_of, metrics_of
from cfx.core.console import blank_table
from cfx.core.files import atomic_write
from cfx.evaluation.headline import (
    doubts,
    interval_in_words,
    judged_method,
    main_comparison,
)
from cfx.evaluation.metrics.base import MetricInfo, key_of
from cfx.evaluation.statistics import Ranking, ranking_of
from cfx.figures.wording import short_label
from cfx.results.comparison import Comparison, common_judge, minimised_the_same, objective_of
from cfx.results.result import judge_of, known_metrics

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

SUMMARY = "summary.csv"
"""Says in a sweep's folder what came of it."""

_STATISTICS = ("geometric", "ci95_low", "ci95_high", "ratio_of_means", "drivers")
_CONSTANT = ("default", "pooled", "driver_specific")


@dataclass(frozen=True)
class SweptJob:
    """A job of a sweep, as its folder tells.

    Attributes:
        folder: of the job.
        status: how it ended.
        data: its `data.json`; {} if it failed or left none.
        metrics: its finite metrics; {} likewise.
    """

    folder: Path
    status: JobStatus
    data: Mapping[str, Any]
    metrics: Mapping[str, float]

    @classmethod
    def read(cls, folder: Path, status: JobStatus) -> SweptJob:
        """Reads what a job left; damaged files are as if they were not there."""
        if status.code:
            return cls(folder, status, {}, {})
        return cls(folder, status, data_of(folder), metrics_of(folder))

    @cached_property
    def overrides(self) -> dict[str, str]:
        """What was typed, by key."""
        overrides = {}
        for override in self.status.overrides:
            key, _, value = override.partition("=")
            overrides[key] = value
        return overrides

    @property
    def judge(self) -> MetricInfo:
        """The error by which it is judged."""
        return judge_of(self.data, self.metrics)

    def pairs(self, judge: str) -> pd.DataFrame | None:
        """Returns `pair_id`, `driver`, `frames` and `error` of each pair; None: they are gone."""
        import pandas as pd

        method = judged_method(self.metrics, judge)
        columns = ["pair_id", "driver", "frames", "method", judge]
        with suppress(OSError, ValueError):  # a job's files may have gone, or be damaged
            table = pd.read_csv(self.folder / "pairs.csv", usecols=columns)
            return table[table["method"] == method].rename(columns={judge: "error"})
        return None


@dataclass(frozen=True)
class SweepSummary:
    """What came of a sweep.

    Attributes:
        jobs: of the sweep, in the order in which they were started.
    """

    jobs: tuple[SweptJob, ...]

    @classmethod
    def of(cls, statuses: Mapping[Path, JobStatus]) -> SweepSummary:
        """Reads the jobs of a sweep."""
        return cls(tuple(SweptJob.read(*item) for item in statuses.items()))

    @cached_property
    def judge(self) -> MetricInfo:
        """The error by which jobs are compared: what all minimised, else the RMSE of speed."""
        return common_judge(self._objectives)

    @property
    def _objectives(self) -> list[tuple[MetricInfo, str]]:
        """What each job that ended well minimised."""
        objectives = []
        for job in self.jobs:
            if job.metrics:
                objectives.append((job.judge, objective_of(job.judge, job.data)))
        return objectives

    @cached_property
    def differing(self) -> list[str]:
        """The keys in which the jobs differ; all if they differ in none."""
        keys: dict[str, None] = {}  # as the jobs give them, each once
        for job in self.jobs:
            keys |= dict.fromkeys(job.overrides)
        differing = []
        for key in keys:
            if len({job.overrides.get(key) for job in self.jobs}) > 1:
                differing.append(key)
        return differing or list(keys)

    @cached_property
    def ranking(self) -> Ranking:
        """Jobs by the error of the method that each is judged by, on the same held-out pairs.

        Those that differ in the seed alone are one: their errors are averaged.
        """
        errors: dict[str, list[pd.DataFrame]] = {}
        for job in self.jobs:
            table = job.pairs(self.judge.name) if job.metrics else None
            if table is not None:
                errors.setdefault(self._name(job), []).append(table)
        return ranking_of(errors)

    def _name(self, job: SweptJob) -> str:
        """Returns what differs between jobs, besides the seed."""
        parts = [f"{key}={job.overrides.get(key, '')}" for key in self.differing if key != "seed"]
        return " ".join(parts)

    @cached_property
    def metrics(self) -> list[MetricInfo]:
        """What any of the jobs has measured besides the error by which they are compared."""
        infos: dict[str, MetricInfo] = {}
        for job in self.jobs:
            for metric in known_metrics(job.data, job.metrics):
                if metric.name not in {self.judge.name, "objective"}:
                    infos.setdefault(metric.name, metric)
        return list(infos.values())

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """A row per job: those that are ranked first, the smallest error first.

        Columns: folder; the overrides that differ; rank; method, by which the job is judged, and
            its error on the test part, `error_METRIC`; the same of constant parameters,
            `METRIC_METHOD`; other metrics of that method; the improvement over the baseline that
            counts; seconds, state and message.
        """
        ranks = {name: rank for rank, name in enumerate(self.ranking.jobs, start=1)}
        rows = []
        for job in self.jobs:
            rank = ranks.get(self._name(job)) if job.metrics else None
            rows.append(self._row(job, rank))
        for name in ("over", *_STATISTICS):
            column = f"improvement_{name}"
            if not any(row[column] for row in rows):  # calibrations have no improvement
                for row in rows:
                    del row[column]
        return sorted(rows, key=lambda row: row["rank"] or math.inf)

    def _row(self, job: SweptJob, rank: int | None) -> dict[str, Any]:
        judge, metrics = self.judge.name, job.metrics
        method = judged_method(metrics, judge)
        row: dict[str, Any] = {"folder": job.folder.name}
        for key in self.differing:
            row[key] = job.overrides.get(key, "")
        row["rank"], row["method"] = rank, method
        row[f"error_{judge}"] = metrics.get(key_of(judge, method))
        for constant in _CONSTANT:
            row[f"{judge}_{constant}"] = metrics.get(key_of(judge, constant))
        for metric in self.metrics:
            row[metric.name] = metrics.get(key_of(metric.name, method))
        compared = main_comparison(metrics, judge)
        row["improvement_over"] = ""
        if compared is not None:
            part = "" if compared.scope == "test" else ", full"
            row["improvement_over"] = f"{compared.baseline}{part}"
        for name in _STATISTICS:
            value = None if compared is None else metrics.get(f"{compared.key}/{name}")
            row[f"improvement_{name}"] = value
        row["seconds"] = round(job.status.seconds, 1)
        row["state"], row["message"] = job.status.state, job.status.message
        return row

    def write(self, path: Path) -> None:
        """Writes `rows` as CSV; a cell without a value is empty."""
        with (
            atomic_write(path) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            writer = csv.DictWriter(file, list(self.rows[0]))
            writer.writeheader()
            writer.writerows(self.rows)

    def table(self) -> Table:
        """Returns `rows` as a rich table, without columns that say the same of all jobs."""
        import pandas as pd

        rows = pd.DataFrame(self.rows, dtype=object)
        columns: dict[str, list[str]] = {}
        for key in self.differing:
            columns[key] = rows[key].map(str).tolist()
        if not self.differing:
            columns["job"] = rows["folder"].tolist()
        candidates = {
            "judged by": rows["method"].map(short_label),
            self.judge.title: rows[f"error_{self.judge.name}"].map(_number),
        }
        for constant in _CONSTANT:
            title = f"{self.judge.heading},\n{short_label(constant)}"
            candidates[title] = rows[f"{self.judge.name}_{constant}"].map(_number)
        for metric in self.metrics:
            if metric.headline:
                candidates[metric.title] = rows[metric.name].map(_number)
        candidates["improvement\n(95 % interval)"] = pd.Series(map(self._improvement, self.rows))
        candidates["state"] = rows["state"]
        for title, cells in candidates.items():
            differs = len(set(cells)) > 1 or len(cells) == 1
            if cells.any() and (differs or title == self.judge.title):
                columns[title] = cells.tolist()
        columns["time [s]"] = rows["seconds"].map("{:.1f}".format).tolist()
        table = blank_table(title="The sweep, the smallest error on the same pairs first")
        for title in columns:
            is_text = title in {*self.differing, "job", "judged by", "state"}
            table.add_column(title, justify="left" if is_text else "right", overflow="fold")
        for row in zip(*columns.values(), strict=True):
            table.add_row(*row)
        return table

    def _improvement(self, row: Mapping[str, Any]) -> str:
        """Returns the improvement in words, with its baseline and what is to be known beside it."""
        geometric = row.get("improvement_geometric")
        if geometric is None:
            return ""
        cell = f"{100 * geometric:+.1f} %"
        low, high = row.get("improvement_ci95_low"), row.get("improvement_ci95_high")
        if low is not None and high is not None:
            cell += f" ({interval_in_words(low, high)})"
        baseline, comma, part = row["improvement_over"].partition(",")
        cell += f"\nover {short_label(baseline)}{comma}{part}"
        estimates = {"geometric": geometric}
        for name in ("ratio_of_means", "drivers"):
            if row.get(f"improvement_{name}") is not None:
                estimates[name] = row[f"improvement_{name}"]
        return "\n".join([cell, *doubts(estimates)])

    def sentences(self) -> list[str]:
        """Returns how the jobs were compared, and which is closest to the drivers."""
        is_same = minimised_the_same(self._objectives)
        return Comparison(self.judge, self.ranking, is_same).sentences()


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
