"""Several jobs beside each other: their mean improvements, their errors, their clusters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cfx.plots.choice.common import Array, finite
from cfx.plots.choice.improvements import ImprovementAxis, improvement_axis
from cfx.plots.words import label, number, plural

_WIDE = 1.6
"""An axis of errors reaches so many times as far as the largest error but the default's."""


@dataclass(frozen=True)
class Statistics:
    """A job's improvement over one baseline, fractions; NaN where it is not defined."""

    job: str
    mean: float
    low: float
    high: float
    trimmed_mean: float
    median: float


@dataclass(frozen=True)
class Overview:
    """Statistics of several jobs over one baseline, and their common axis."""

    baseline: str
    rows: tuple[Statistics, ...]
    axis: ImprovementAxis


@dataclass(frozen=True)
class ErrorDots:
    """Errors of several jobs.

    Attributes:
        title: of the axis.
        unit: of the errors.
        jobs: J names.
        values: by method `(J,)`; NaN where a job has no such method.
        high: end of the axis.
        note: a sentence on what lies beyond it, else "".
    """

    title: str
    unit: str
    jobs: tuple[str, ...]
    values: Mapping[str, Array]
    high: float
    note: str


@dataclass(frozen=True)
class ClusterGroup:
    """The pairs of some jobs, by cluster.

    Attributes:
        name: of the jobs.
        clusters: of P pairs, their clusters' names.
        pair_ids: of P pairs.
        values: `(P,)` improvements, fractions.
    """

    name: str
    clusters: tuple[str, ...]
    pair_ids: tuple[str, ...]
    values: Array


@dataclass(frozen=True)
class ClusterBoxes:
    """Improvements over one baseline by cluster, and their common axis."""

    groups: tuple[ClusterGroup, ...]
    axis: ImprovementAxis


def overview(rows: Sequence[Statistics], baseline: str) -> Overview:
    """Chooses the axis of several jobs' statistics."""
    values: list[float] = []
    for row in rows:
        values += finite([row.mean, row.low, row.high, row.trimmed_mean, row.median]).tolist()
    what = "means, medians and ends of intervals"
    axis = improvement_axis(np.array(values), baseline=baseline, what=what)
    return Overview(baseline, tuple(rows), axis)


def error_dots(
    jobs: Sequence[str], values: Mapping[str, Array], *, unit: str, what: str
) -> ErrorDots:
    """Chooses the axis of several jobs' errors; a default far off the others does not stretch it.

    Args:
        jobs: J names.
        values: by method `(J,)`.
        unit: of the values.
        what: what they are, in the axis' title.
    """
    near, far = [0.0], np.empty(0)
    for method, errors in values.items():
        if method == "default":
            far = finite(errors)
        else:
            near += finite(errors).tolist()
    largest = max(*near, 1e-9)
    beyond = far[far > _WIDE * largest]
    note = ""
    if len(beyond):
        high = _WIDE * largest
        note = (
            f"{plural(len(beyond), 'job')} with {label('default')} further off, up to"
            f" {number(float(beyond.max()))} {unit}."
        )
    else:
        high = 1.06 * max(largest, float(far.max(initial=0.0)))
    return ErrorDots(f"{what} ({unit})", unit, tuple(jobs), dict(values), high, note)


def cluster_boxes(groups: Sequence[ClusterGroup], baseline: str) -> ClusterBoxes:
    """Chooses the axis of the improvements by cluster."""
    every = np.concatenate([np.empty(0), *(group.values for group in groups)])
    return ClusterBoxes(tuple(groups), improvement_axis(every, baseline=baseline))
