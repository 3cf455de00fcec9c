"""What came out, in a few sentences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cfx.evaluation.headline import Comparison, contradiction
from cfx.evaluation.result import Purpose
from cfx.report.figures.text import TEST, explained, few_drivers, percent, plural, short_label
from cfx.report.job import Job, of_purpose
from cfx.report.names import Row, rows_over_seeds

_MOST = 3
"""Up to so many jobs have a sentence each."""


def summary(jobs: Sequence[Job]) -> list[str]:
    """Returns sentences: against driver-specific calibration, and against pooled calibration."""
    first = (
        f"{_amount(jobs)}: is a policy that adapts the parameters closer to the real driver than"
        f" {explained('fixed')}?"
    )
    compared = of_purpose(jobs, Purpose.ADAPTATION)
    warnings = _few(compared)
    references = [_reference(job) for job in of_purpose(jobs, Purpose.POLICY)]
    constant = of_purpose(jobs, Purpose.CALIBRATION)
    if not compared and not references:
        first = f"{_amount(jobs)}: how close does the driving model come with constant parameters?"
    if len(constant) <= _MOST:
        references += [_calibration(job) for job in constant]
    else:
        references.append(f"{len(constant)} jobs are calibrations, without adaptation.")
    if len(compared) <= _MOST:
        return [first, *map(_verdict, compared), *warnings, *references]
    counts = f"{_counts(compared)} (by the 95 % interval of the mean improvement)."
    return [first, counts, _best(jobs), *warnings, *references]


def _few(jobs: Sequence[Job]) -> list[str]:
    """Returns a warning if any of the jobs compares its policy on few drivers."""
    if not jobs:
        return []
    fewest = min(job.pairs["driver"].nunique() for job in jobs)
    warning = few_drivers(fewest)
    return [warning] if warning else []


def _counts(jobs: Sequence[Job]) -> str:
    """Returns in how many jobs the policy is closer, over each of two baselines."""
    said = []
    for baseline, against in (
        ("fixed", f"Of {len(jobs)} jobs"),
        ("population", "against pooled calibration"),
    ):
        sides = [_side(job, baseline) for job in jobs if baseline in job.baselines()]
        if sides:
            counts = ", ".join(
                f"{side} in {sides.count(side)}" for side in ("yes", "no", "undecided")
            )
            said.append(f"{against}: {counts}")
    return "; ".join(said)


def _best(jobs: Sequence[Job]) -> str:
    """Says which job improves most, or which jobs over their seeds: no lucky seed is picked."""
    rows = [row for row in rows_over_seeds(jobs) if of_purpose(row.jobs, Purpose.ADAPTATION)]
    best = max(rows, key=_mean_for_ranking)
    if len(best.jobs) == 1:
        return f"The best mean: {_verdict(best.jobs[0])}"
    gains = best.improvements("mean", "fixed")
    least, most = (percent(float(end), 1) for end in (np.nanmin(gains), np.nanmax(gains)))
    return (
        f"The best mean over seeds: {best.name}. Improvement of the RMSE of speed:"
        f" {percent(float(np.nanmean(gains)), 1)} on average ({least} to {most} in"
        f" {len(best.jobs)} seeds)."
    )


def _mean_for_ranking(row: Row) -> float:
    means = row.improvements("mean", "fixed")
    known = means[np.isfinite(means)]
    return float(known.mean()) if len(known) else -np.inf


def _reference(job: Job) -> str:
    """Says what a policy reaches that sets the acceleration itself."""
    speed, gap = job.metric("rmse_speed", "policy"), job.metric("rmse_gap", "policy")
    return (
        f"{job.name}: the policy sets the acceleration itself. RMSE of speed {speed:.3f} m/s, of"
        f" gap {gap:.2f} m: an upper reference for the models that follow."
    )


def _calibration(job: Job) -> str:
    """Says how close constant parameters come."""
    errors = []
    for method in job.methods:
        error = job.metric("rmse_speed", method)
        if method != "policy" and np.isfinite(error):
            errors.append(f"{short_label(method)} {error:.3f}")
    return (
        f"{job.name}: a calibration; its parameters stay constant. RMSE of speed (m/s):"
        f" {', '.join(errors)}."
    )


def _amount(jobs: Sequence[Job]) -> str:
    pairs: set[tuple[str, str]] = set()
    sources: dict[str, None] = {}
    for job in jobs:
        source = str(job.data.get("source", ""))
        if source:
            sources[source] = None
        for pair in job.pairs["pair_id"].unique():
            pairs.add((source, pair))
    where = f" from {Path(next(iter(sources))).name}" if len(sources) == 1 else ""
    return f"{plural(len(pairs), 'pair')} of leader and follower{where}"


def _side(job: Job, baseline: str = "fixed") -> str:
    if job.improvement("ci95_low", baseline) > 0:
        return "yes"
    return "no" if job.improvement("ci95_high", baseline) < 0 else "undecided"


def _verdict(job: Job) -> str:
    if not np.isfinite(job.improvement("mean")):
        return f"{job.name}: no pair has a defined improvement."
    pooled = ""
    if "population" in job.baselines():
        pooled = f"; over pooled calibration {_gain(job, 'population')}"
    gain = _gain(job, "fixed")
    return f"{job.name}: {_side(job)}. Improvement of the RMSE of speed: {gain}{pooled}."


def _gain(job: Job, baseline: str) -> str:
    mean = job.improvement("mean", baseline)
    low, high = job.improvement("ci95_low", baseline), job.improvement("ci95_high", baseline)
    if not np.isfinite(mean):
        return "not defined"
    sure = "no interval for a single driver"
    if np.isfinite(low):
        sure = f"95 % interval {percent(low, 1)} to {percent(high, 1)}"
    said = f"{percent(mean, 1)} on average ({sure})"
    opposite = contradiction(job.metrics, Comparison(baseline, TEST))
    return f"{said}, {opposite}" if opposite else said
