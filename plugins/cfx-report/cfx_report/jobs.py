"""Jobs that stand in one report."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from cfx.plugin import MetricInfo, Purpose, Result, comparison, wording


@dataclass(frozen=True)
class Unfinished:
    """A job that cannot be reported: where it is, and why."""

    place: str
    reason: str


@dataclass(frozen=True)
class Runs:
    """What was found: finished jobs, each with a name of its own, and the others."""

    jobs: tuple[Result, ...]
    unfinished: tuple[Unfinished, ...] = ()


def of_purpose(jobs: Iterable[Result], *purposes: Purpose) -> list[Result]:
    """Returns the jobs that have one of these purposes."""
    return [job for job in jobs if job.purpose in purposes]


def are_calibrations(jobs: Iterable[Result]) -> bool:
    """Says whether none of the jobs has a policy that adapts: nothing is said of policies then."""
    return all(job.purpose is Purpose.CALIBRATION for job in jobs)


def any_baselines(jobs: Iterable[Result], scope: str = wording.TEST) -> list[str]:
    """Returns what the policy of any of the jobs is compared with, in the order of the jobs."""
    baselines: dict[str, None] = {}
    for job in jobs:
        baselines |= dict.fromkeys(job.baselines(scope))
    return list(baselines)


def any_has_metric(
    jobs: Iterable[Result], name: str, method: str, scope: str = wording.TEST
) -> bool:
    """Says whether any of the jobs has measured a metric."""
    return any(job.has_metric(name, method, scope) for job in jobs)


def judge_of(jobs: Iterable[Result]) -> MetricInfo:
    """Returns the error by which jobs are compared: what all minimised, else the RMSE of speed."""
    return comparison.common_judge(
        [(job.judge, comparison.objective_of(job.judge, job.data)) for job in jobs]
    )


def metric_title(metric: MetricInfo) -> str:
    """Returns a heading with the unit: "RMSE of speed (m/s)"."""
    heading = metric.heading[:1].upper() + metric.heading[1:]
    return f"{heading} ({wording.pretty_unit(metric.unit)})" if metric.unit else heading
