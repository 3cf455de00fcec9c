"""What tells the jobs of one report apart, and rows of jobs that one setting alone tells apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cfx.errors import ConfigError
from cfx.plugin import Purpose, Result, comparison, flatten, wording
from cfx_report.jobs import any_baselines

GROUPS = ("model", "policy", "learner", "protocol", "objective", "optimizer", "data")
_NO_DIFFERENCE = (
    "tracking.",
    "cache.",
    "figures.",
    "simulation.",
    "simulator.compile",
    "simulator.memory_mb",
    "threads",
    "device",
    "preset",
)
"""Settings that change where or how fast a job runs, not what comes out."""

SEPARATOR = " · "

_MOST = 4
"""Most parts of a name that are all shown; of more, those that tell the jobs apart are."""

_LONG = 24
"""Characters of a value from which on what all jobs' values begin with is left out."""


def named(jobs: Sequence[Result]) -> tuple[Result, ...]:
    """Gives every job a short name: its driving model, and what else differs between the jobs."""
    columns = _columns(jobs, ())
    if len(columns) > _MOST:
        columns = _distinguishing(columns)
    names = _joined(columns)
    renamed = []
    for k, job in enumerate(jobs):
        name = names[k]
        if names.count(name) > 1:
            name += f" ({names[: k + 1].count(name)})"
        renamed.append(replace(job, name=name))
    return tuple(renamed)


def shortest_names(jobs: Sequence[Result], ignored: Sequence[str] = ()) -> list[str]:
    """Returns names of as few parts as tell apart what `differences` tells apart."""
    return _joined(_distinguishing(_columns(jobs, ignored)))


def _joined(columns: Sequence[Sequence[str]]) -> list[str]:
    """Returns a name for each job: its values in the columns, without the absent ones."""
    names = []
    for values in zip(*columns, strict=True):
        names.append(SEPARATOR.join(filter(None, values)))
    return names


def _distinguishing(columns: Sequence[list[str]]) -> list[list[str]]:
    """Returns the first column, and as few others as tell apart what all columns tell apart.

    Greedy: each time the column is added that tells most jobs apart.
    """
    chosen, candidates = [0], list(range(1, len(columns)))
    while candidates and _distinct_rows(columns, chosen) < len(set(zip(*columns, strict=True))):
        best = max(candidates, key=lambda number: _distinct_rows(columns, [*chosen, number]))
        candidates.remove(best)
        chosen.append(best)
    return [columns[number] for number in sorted(chosen)]


def _distinct_rows(columns: Sequence[Sequence[str]], numbers: Sequence[int]) -> int:
    """Returns how many different rows the columns of these numbers have."""
    chosen = [columns[number] for number in numbers]
    return len(set(zip(*chosen, strict=True)))


def differences(jobs: Sequence[Result], ignored: Sequence[str] = ()) -> list[list[str]]:
    """Returns for every job its driving model and every other component and setting that differs.

    A setting of a component counts only between jobs that share the component: that of another one
    is another setting.

    Args:
        jobs: that are compared.
        ignored: full names of settings that do not count.
    """
    parts = []
    for values in zip(*_columns(jobs, ignored), strict=True):
        parts.append(list(filter(None, values)))
    return parts


def _columns(jobs: Sequence[Result], ignored: Sequence[str]) -> list[list[str]]:
    """Returns the models, and a column for everything else that differs; "" where it is absent."""
    columns = [[job.component("model") or "model" for job in jobs]]
    for group in GROUPS[1:]:
        columns.append([job.component(group) for job in jobs])
    flat = [flatten(dict(job.config)) for job in jobs]
    keys: dict[str, None] = {}
    for values in flat:
        keys |= dict.fromkeys(values)
    for key in keys:
        counts = key not in ignored and not key.startswith(_NO_DIFFERENCE)
        if counts and not key.endswith(".name") and _differs(key, jobs, flat):
            columns.append(_in_words(key, flat))
    differing = columns[:1]  # the models, also where all jobs have the same
    for column in columns[1:]:
        if len(set(column)) > 1:
            differing.append(column)
    return differing


def _differs(key: str, jobs: Sequence[Result], flat: Sequence[Mapping[str, Any]]) -> bool:
    """Says whether a setting differs between jobs that share the component it belongs to."""
    group = key.partition(".")[0]
    by_peer: dict[str, set[Any]] = {}
    for job, values in zip(jobs, flat, strict=True):
        peer = job.component(group) if group in GROUPS else ""
        by_peer.setdefault(peer, set()).add(values.get(key, ""))
    return any(len(values) > 1 for values in by_peer.values())


def _in_words(key: str, flat: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns a setting of each job in words; "" for a job that does not have it.

    Long values stand without what they all begin with.
    """
    values = [str(settings.get(key, "")) for settings in flat]
    prefix = ""
    if max(map(len, values)) > _LONG:
        prefix = wording.common_prefix(list(filter(None, values)))
    words = []
    for value in values:
        shown = value
        if value and prefix:
            shown = f"…{value.removeprefix(prefix)}"
        if not value or key == "style.cluster":
            words.append(shown)
        elif key == "seed":
            words.append(f"seed {shown}")
        else:
            words.append(f"{key.partition('.')[2] or key}={shown}")
    return words


@dataclass(frozen=True)
class Row:
    """Jobs that a row sums up: one, or several that differ in one setting.

    Attributes:
        name: what tells the row from the others.
        jobs: at least one.
    """

    name: str
    jobs: tuple[Result, ...]

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
                values[place] = getattr(job.statistics(baseline), statistic)
        return values


def rows_of(jobs: Sequence[Result], group_by: str | None = None) -> tuple[Row, ...]:
    """Returns the rows of a table, in the order of the jobs.

    Raises:
        ConfigError: no job has the setting `group_by`.
    """
    ignored: tuple[str, ...] = ()
    if group_by is not None:
        ignored = (group_by,)
        settings: set[str] = set()
        for job in jobs:
            settings.update(flatten(dict(job.config)))
        if group_by not in settings:
            raise ConfigError(
                f"--group-by {group_by}: no job has this setting; name one as config.yaml does, for"
                " instance seed or data.max_pairs"
            )
    names = shortest_names(jobs, ignored)
    by_name: dict[str, list[Result]] = {}
    for number, (name, job) in enumerate(zip(names, jobs, strict=True)):
        key = name if group_by is not None or names.count(name) == 1 else f"{name} ({number + 1})"
        by_name.setdefault(key, []).append(job)
    return tuple(Row(name, tuple(alike)) for name, alike in by_name.items())


def rows_over_seeds(jobs: Sequence[Result]) -> tuple[Row, ...]:
    """Returns the jobs in rows, those that differ in the seed alone together."""
    if len({job.setting("seed") for job in jobs}) < 2:
        return rows_of(jobs)
    return rows_of(jobs, "seed")


def comparison_of(jobs: Sequence[Result]) -> comparison.Comparison:
    """Returns the jobs beside one another, those that differ in the seed alone as one."""
    return comparison.Comparison.of({row.name: row.jobs for row in rows_over_seeds(jobs)})


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Returns the methods that any job measured; a calibration's policy is no method of its own."""
    methods: dict[str, None] = {}
    for row in rows:
        for job in row.jobs:
            methods |= dict.fromkeys(job.shown_methods)
    last = "policy" if any_adapts(rows) else "driver_specific"  # what the jobs are judged by
    methods.pop("policy", None)
    methods.pop(last, None)
    return [*methods, last]


def any_adapts(rows: Sequence[Row]) -> bool:
    """Says whether any job has a policy that adapts; without one they are calibrations."""
    for row in rows:
        for job in row.jobs:
            if job.purpose is not Purpose.CALIBRATION:
                return True
    return False


def baselines_of(rows: Sequence[Row]) -> list[str]:
    """Returns the calibrations that any job compares its policy with."""
    jobs: list[Result] = []
    for row in rows:
        jobs += row.jobs
    baselines = []
    for baseline in any_baselines(jobs):
        if baseline in {"driver_specific", "pooled"}:
            baselines.append(baseline)
    return baselines
