"""Jobs in rows: one each, or those that differ in one setting alone, such as the seed, together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cfx.core.errors import ConfigError
from cfx.report.job import Job, any_baselines
from cfx.report.names import shortest_names
from cfx.results.provenance import flatten


@dataclass(frozen=True)
class Row:
    """Jobs that a row sums up: one, or several that differ in one setting.

    Attributes:
        name: what tells the row from the others.
        jobs: at least one.
    """

    name: str
    jobs: tuple[Job, ...]

    def values(self, name: str, method: str) -> np.ndarray:
        """Returns a metric of a method in each job, `(jobs,)`."""
        return np.array([job.metric(name, method) for job in self.jobs])

    def improvements(self, statistic: str, baseline: str) -> np.ndarray:
        """Returns a statistic of the policy's improvement in each job, `(jobs,)`, a fraction.

        NaN for jobs that do not compare their policy with the baseline.
        """
        values = np.full(len(self.jobs), np.nan)
        for place, job in enumerate(self.jobs):
            if baseline in job.baselines():
                values[place] = job.improvement(statistic, baseline)
        return values


def rows_of(jobs: Sequence[Job], group_by: str | None = None) -> tuple[Row, ...]:
    """Returns the rows of a table, in the order of the jobs.

    Raises:
        ConfigError: no job has the setting `group_by`.
    """
    ignored = () if group_by is None else (group_by,)
    if group_by is not None and not any(group_by in flatten(dict(job.config)) for job in jobs):
        raise ConfigError(
            f"--group-by {group_by}: no job has this setting; name one as config.yaml does, for"
            " instance seed or data.max_pairs"
        )
    names = shortest_names(jobs, ignored)
    found: dict[str, list[Job]] = {}
    for number, (name, job) in enumerate(zip(names, jobs, strict=True)):
        key = name if group_by is not None or names.count(name) == 1 else f"{name} ({number + 1})"
        found.setdefault(key, []).append(job)
    return tuple(Row(name, tuple(alike)) for name, alike in found.items())


def rows_over_seeds(jobs: Sequence[Job]) -> tuple[Row, ...]:
    """Returns the jobs in rows, those that differ in the seed alone together."""
    if len({job.setting("seed") for job in jobs}) < 2:
        return rows_of(jobs)
    return rows_of(jobs, "seed")


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Returns the methods that any job measured; a calibration's policy is no method of its own."""
    found: dict[str, None] = {}
    for row in rows:
        for job in row.jobs:
            found |= dict.fromkeys(job.meaningful_methods)
    found.pop("policy", None)
    if any_adapts(rows):
        return [*found, "policy"]
    return [method for method in found if method != "fixed"] + ["fixed"]


def any_adapts(rows: Sequence[Row]) -> bool:
    """Says whether any job has a policy that adapts; without one they are calibrations."""
    for row in rows:
        for job in row.jobs:
            if job.adapts:
                return True
    return False


def baselines_of(rows: Sequence[Row]) -> list[str]:
    """Returns the calibrations that any job compares its policy with."""
    jobs: list[Job] = []
    for row in rows:
        jobs += row.jobs
    found = any_baselines(jobs)
    return [baseline for baseline in found if baseline in {"fixed", "population"}]
