"""Improvements of the policy, pair by pair: the axis, and what lies below it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cfx.plots.choice.common import Array, finite
from cfx.plots.words import label, percent, plural

WORST_WITHOUT_CUT = -0.6
"""Improvements above this are never cut off, however far they lie from the others."""

_FAR_OUT = 3.0
_MARGIN = 0.07


@dataclass(frozen=True)
class ImprovementAxis:
    """An axis of improvements, fractions.

    Attributes:
        low, high: its ends; what is lower than `low` is cut off there.
        title: what the axis is of.
        note: a sentence if something is cut off or undefined, else "".
    """

    low: float
    high: float
    title: str
    note: str


@dataclass(frozen=True)
class ImprovementSeries:
    """The pairs of one job.

    Attributes:
        name: of the job.
        pair_ids: P pairs whose improvement is defined.
        values: `(P,)` improvements.
        shown: `(P,)`, how far the bars reach: those below the axis end at its lower end.
        clipped: `(P,)` bool, which are cut off.
    """

    name: str
    pair_ids: tuple[str, ...]
    values: Array
    shown: Array
    clipped: np.ndarray


@dataclass(frozen=True)
class ImprovementBars:
    """Improvement of every pair, of one job or of several.

    Attributes:
        series: the jobs.
        axis: common to all.
        undefined: number of improvements that are not defined.
    """

    series: tuple[ImprovementSeries, ...]
    axis: ImprovementAxis
    undefined: int


def improvement_title(baseline: str) -> str:
    """Returns what an axis of improvements over a baseline is called."""
    return f"improvement of the RMSE of speed over {label(baseline)}"


def improvement_axis(
    values: Array, marks: Sequence[float] = (), *, baseline: str, what: str = "improvements"
) -> ImprovementAxis:
    """Chooses an axis that a few very bad improvements do not shrink.

    The rule: an improvement is cut off if it lies further below the lower quartile than three times
    the distance between the quartiles (Tukey's far-out values), and only if it is worse than -60 %.

    Args:
        values: all improvements that are shown, fractions; those that are not finite do not count.
        marks: further values that should be in view, such as the mean and the ends of its interval;
            one far below the fence does not move the axis.
        baseline: the method that the policy is compared with.
        what: what is cut off, in the note.
    """
    title, known = improvement_title(baseline), finite(values)
    undefined = len(np.asarray(values).ravel()) - len(known)
    if not len(known):
        note = f"No pair has a defined improvement ({undefined} are undefined)."
        return ImprovementAxis(-1.0, 1.0, title, note)
    q1, q3 = np.quantile(known, [0.25, 0.75])
    fence = min(float(q1 - _FAR_OUT * (q3 - q1)), WORST_WITHOUT_CUT)
    lowest = float(known.min())
    # The mean and its interval stay in view as long as they do not dwarf the bars themselves.
    near = [mark for mark in finite(marks) if mark > _FAR_OUT * fence]
    low = min([max(lowest, fence), 0.0, *near])
    high = max([float(known.max()), 0.0, *finite(marks)])
    margin = _MARGIN * max(high - low, 0.1)
    if lowest >= fence:
        low -= margin
    count = int((known < low).sum())
    parts = []
    if count:
        parts.append(
            f"The axis is cut at {percent(low)}: {count} of {len(known)} {what} are lower,"
            f" the lowest is {percent(lowest)}."
        )
    if undefined:
        parts.append(f"{plural(undefined, 'improvement')} not defined and not shown.")
    return ImprovementAxis(low, high + margin, title, " ".join(parts))


def improvement_bars(
    names: Sequence[str],
    pair_ids: Sequence[Sequence[str]],
    improvements: Sequence[Array],
    *,
    baseline: str = "fixed",
    marks: Sequence[float] = (),
) -> ImprovementBars:
    """Chooses the bars of every pair, best to worst in each job.

    Args:
        names: of J jobs.
        pair_ids: of each job's pairs.
        improvements: of each job's pairs, fractions.
        baseline: the method that the policy is compared with.
        marks: as in `improvement_axis`.
    """
    every = np.concatenate([np.empty(0), *improvements])
    axis = improvement_axis(every, marks, baseline=baseline)
    series = []
    for name, ids, values in zip(names, pair_ids, improvements, strict=True):
        series.append(_series(name, ids, np.asarray(values, dtype=np.float64), axis.low))
    return ImprovementBars(tuple(series), axis, int((~np.isfinite(every)).sum()))


def _series(name: str, pair_ids: Sequence[str], values: Array, low: float) -> ImprovementSeries:
    defined = np.flatnonzero(np.isfinite(values))
    order = defined[np.argsort(-values[defined], kind="stable")]
    kept = values[order]
    ids = tuple(str(pair_ids[index]) for index in order)
    return ImprovementSeries(name, ids, kept, np.maximum(kept, low), kept < low)
