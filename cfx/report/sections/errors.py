"""How errors grow from the measured state on."""

from __future__ import annotations

from cfx.plots.choice.errors import error_panels
from cfx.plots.choice.trajectories import HIDDEN
from cfx.plots.plotly.errors import errors_plot
from cfx.plots.plotly.figure import Plot
from cfx.report.blocks import Block, Figure, Section, Text, job_fold
from cfx.report.job import Job, Runs

_INTRODUCTION = (
    "RMSE of speed and of gap over all pairs at each moment since the test part began, as long as"
    " nine in ten pairs last. All methods begin in the measured state; constant parameters leave it"
    " for their own gap at once. The dashed line is the end of the transient."
)


def blocks(runs: Runs) -> list[Block]:
    """Returns a plot for each job that kept its trajectories."""
    jobs = [job for job in runs.jobs if job.pair_trajectories]
    if not jobs:
        return []
    found: list[Block] = [Text(_INTRODUCTION)]
    for k, job in enumerate(jobs):
        found.append(job_fold(job.name, [Figure(errors_over_time(job))], first=k == 0))
    return found


def errors_over_time(job: Job) -> Plot:
    """Errors of a job's methods over time."""
    simulated = job.pair_trajectories[0].speed
    methods = []
    for method in job.meaningful_methods:
        if method in simulated and method not in HIDDEN:
            methods.append(method)
    return errors_plot(error_panels(job.pair_trajectories, methods, job.transient_s))


SECTION = Section("errors", "Errors over time", "Errors over time", blocks)
