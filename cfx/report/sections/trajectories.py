"""Speed, gap and parameters of the best, the median and the worst pair over time."""

from __future__ import annotations

import math

from cfx.evaluation.result import Purpose
from cfx.report.blocks import (
    Block,
    Figure,
    Group,
    Heading,
    Text,
    job_folds,
    missing_file,
)
from cfx.report.figure_blocks import single_view
from cfx.report.figures.trajectories import draw_pair
from cfx.report.figures.values import RankedPair, rank_pairs
from cfx.report.figures.words import percent_or_undefined, short_label
from cfx.report.job import Job, Runs, of_purpose
from cfx.report.section import Section

_ADAPTING = (
    "The pair that improves most over driver-specific calibration, the one in the middle and the"
    " one that improves least, on the test part."
)
_CONSTANT = "Of a calibration: the pairs with the least, the median and the largest RMSE of speed."
_BOUNDS = "What lies outside a parameter's bounds is shaded."


class TrajectoriesSection(Section):
    """Speed, gap and parameters of the best, the median and the worst pair over time."""

    title = "Trajectories"
    entry = "Trajectories"
    order = 1600

    def blocks(self, runs: Runs) -> list[Block]:
        """Return the chosen pairs of each job."""
        jobs = [job for job in runs.jobs if "trajectories" in job.tables]
        constant = of_purpose(jobs, Purpose.CALIBRATION)
        chosen = [_BOUNDS]
        if constant:
            chosen.insert(0, _CONSTANT)
        if len(constant) < len(jobs):
            chosen.insert(0, _ADAPTING)
        what = "speed, gap and parameters over time"
        lacking = missing_file(runs, "trajectories.parquet", what)
        return [Text(" ".join(chosen)), *job_folds(runs, _pairs), *lacking]


def _pairs(job: Job) -> list[Block]:
    if "trajectories" not in job.tables:
        return []
    groups: list[Block] = []
    for pair in chosen_pairs(job):
        heading = Heading(_title(job, pair), _errors(job, pair))
        groups.append(Group((heading, pair_of(job, pair.pair_id))))
    return groups


def chosen_pairs(job: Job) -> tuple[RankedPair, ...]:
    """Returns the best, the median and the worst pair; fewer if there are fewer."""
    present = [trajectory.pair_id for trajectory in job.pair_trajectories]
    table = job.by_pair[job.by_pair["pair_id"].isin(present)]
    if job.purpose is Purpose.CALIBRATION:
        gains = -table[f"rmse_speed/{job.judged}"].to_numpy(dtype=float)
    else:
        gains = table["improvement/fixed"].to_numpy(dtype=float)
    return rank_pairs(table["pair_id"].astype(str).tolist(), gains)


def pair_of(job: Job, pair_id: str) -> Figure:
    """Speed, gap and each tuned parameter of one pair of a job."""
    title = f"Speed, gap and parameters of pair {pair_id}"
    return single_view(draw_pair(job.results, pair_id), title)


def _title(job: Job, pair: RankedPair) -> str:
    title = pair.title[:1].upper() + pair.title[1:]
    if job.purpose is Purpose.ADAPTATION and math.isfinite(pair.improvement):
        improvement = percent_or_undefined(pair.improvement, 1)
        title += f": {improvement} over {short_label('fixed')} calibration"
    return title


def _errors(job: Job, pair: RankedPair) -> str:
    row = job.by_pair.set_index("pair_id").loc[pair.pair_id]
    errors = []
    for method in job.meaningful_methods:
        errors.append(f"{short_label(method)} {row[f'rmse_speed/{method}']:.3f}")
    return f"RMSE of speed (m/s): {', '.join(errors)}"
