"""Improvements of the policy, pair by pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from cfx.evaluation.metrics.base import RMSE_SPEED
from cfx.figures import canvas, colours, wording
from cfx.results.figure import JobFigure

if TYPE_CHECKING:
    from cfx.evaluation.statistics import Improvement
    from cfx.results.result import Result

__all__ = [
    "ImprovementAxis",
    "ImprovementBars",
    "improvement_axis",
    "improvement_bars",
    "improvement_title",
    "vertical_improvements",
]
"""What plugins may use, as `cfx.plugin.improvement_bars`."""


WORST_WITHOUT_CUT = -0.6
"""Improvements above this are never cut off, however far they lie from the others."""

_FAR_OUT = 3.0
"""Distances between the quartiles beyond which Tukey calls a value "far out" (Exploratory Data
Analysis, 1977)."""

_MARGIN = 0.07
"""Share of the axis that stays empty at its ends."""


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
    values: canvas.Array
    shown: canvas.Array
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


def improvement_title(baseline: str, error: str = RMSE_SPEED.heading) -> str:
    """Returns what an axis of improvements of an error over a baseline is called."""
    return f"improvement of the {error} over {wording.method_label(baseline)}"


def improvement_axis(
    values: canvas.Array,
    marks: Sequence[float] = (),
    *,
    baseline: str,
    error: str = RMSE_SPEED.heading,
    what: str = "improvements",
) -> ImprovementAxis:
    """Chooses an axis that a few very bad improvements do not shrink.

    The rule: an improvement is cut off if it lies further below the lower quartile than three times
    the distance between the quartiles (Tukey's far-out values), and only if it is worse than -60 %.

    Args:
        values: all improvements that are shown, fractions; those that are not finite do not count.
        marks: further values that should be in view, such as the mean and the ends of its interval;
            one far below the fence does not move the axis.
        baseline: the method that the policy is compared with.
        error: which error is smaller.
        what: what is cut off, in the note.
    """
    title, finite = improvement_title(baseline, error), canvas.finite(values)
    undefined = len(np.asarray(values).ravel()) - len(finite)
    if not len(finite):
        note = f"No pair has a defined improvement ({undefined} are undefined)."
        return ImprovementAxis(-1.0, 1.0, title, note)
    q1, q3 = np.quantile(finite, [0.25, 0.75])
    fence = min(float(q1 - _FAR_OUT * (q3 - q1)), WORST_WITHOUT_CUT)
    lowest = float(finite.min())
    # The mean and its interval stay in view as long as they do not dwarf the bars themselves.
    finite_marks = canvas.finite(marks)
    near = finite_marks[finite_marks > _FAR_OUT * fence]
    low = min([max(lowest, fence), 0.0, *near])
    high = max([float(finite.max()), 0.0, *finite_marks])
    margin = _MARGIN * max(high - low, 0.1)
    if lowest >= fence:
        low -= margin
    count = int((finite < low).sum())
    parts = []
    if count:
        parts.append(
            f"The axis is cut at {wording.percent(low)}: {count} of {len(finite)} {what} are lower,"
            f" the lowest is {wording.percent(lowest)}."
        )
    if undefined:
        parts.append(f"{wording.plural(undefined, 'improvement')} not defined and not shown.")
    return ImprovementAxis(low, high + margin, title, " ".join(parts))


def vertical_improvements(axes: Axes, axis: ImprovementAxis) -> None:
    """Make the vertical axis one of improvements."""
    axes.set_ylim(axis.low, axis.high)
    axes.set_ylabel(axis.title.replace(" over ", "\nover ") + " (%)")
    canvas.percent_axis(axes)


def improvement_bars(
    names: Sequence[str],
    pair_ids: Sequence[Sequence[str]],
    improvements: Sequence[canvas.Array],
    *,
    baseline: str = "driver_specific",
    error: str = RMSE_SPEED.heading,
    marks: Sequence[float] = (),
) -> ImprovementBars:
    """Chooses the bars of every pair, best to worst in each job.

    Args:
        names: of J jobs.
        pair_ids: of each job's pairs.
        improvements: of each job's pairs, fractions.
        baseline: the method that the policy is compared with.
        error: which error is smaller.
        marks: as in `improvement_axis`.
    """
    every = np.concatenate([np.empty(0), *improvements])
    axis = improvement_axis(every, marks, baseline=baseline, error=error)
    series = []
    for name, ids, values in zip(names, pair_ids, improvements, strict=True):
        series.append(_series(name, ids, np.asarray(values, dtype=np.float64), axis.low))
    return ImprovementBars(tuple(series), axis, int((~np.isfinite(every)).sum()))


def _series(
    name: str, pair_ids: Sequence[str], values: canvas.Array, low: float
) -> ImprovementSeries:
    defined = np.flatnonzero(np.isfinite(values))
    order = defined[np.argsort(-values[defined], kind="stable")]
    ordered = values[order]
    ids = np.array(pair_ids, dtype=object)[order]
    return ImprovementSeries(
        name, tuple(map(str, ids)), ordered, np.maximum(ordered, low), ordered < low
    )


_NAMED = 40
"""Up to so many bars carry their pair's name."""

_LABELLED = 8
"""Up to so many bars that are cut off carry their value; of more, only the worst."""


@canvas.styled
def draw_improvements(bars: ImprovementBars, summary: Improvement) -> Figure:
    """Draws sorted bars of every pair's improvement with its summaries and the 95 % interval.

    A bar has the colour of the method that was closer to the driver. Bars that are cut off end in
    an arrow with the value. Pairs without a defined improvement are counted in the axis label.

    Args:
        bars: of one job.
        summary: statistics over the pairs.
    """
    (series,) = bars.series
    named = len(series.pair_ids) <= _NAMED
    prefix = wording.common_prefix(list(series.pair_ids))
    ticks = []
    for name in series.pair_ids:
        ticks.append(wording.shortened(name.removeprefix(prefix), 16))
    longest = max(map(len, ticks), default=0) if named else 0
    figure = canvas.blank(4.3 + 0.075 * longest)
    axes = figure.subplots()
    vertical_improvements(axes, bars.axis)
    _bars(axes, series, bars.axis.low)
    handles = _closer(series) + _statistics(axes, summary, bars.axis.low)
    # A few bars stand in the middle, and no broader than those of a larger job.
    count = len(series.values)
    middle, half = (count - 1) / 2, max(count, 8) / 2 + 0.3
    axes.set_xlim(middle - half, middle + half)
    axes.grid(visible=False, axis="x")
    if named:
        axes.set_xticks(np.arange(count), ticks, rotation=90, fontsize=canvas.points(8.5))
        axes.tick_params(axis="x", length=0)
    else:
        axes.set_xticks([])
    axes.set_xlabel(_pairs_title(bars, prefix if named else ""))
    if not count:
        canvas.write_note(axes, "no pair has a defined improvement")
    canvas.legend_above(figure, handles, columnspacing=1.8, handlelength=1.8)
    return figure


def _bars(axes: Axes, series: ImprovementSeries, low: float) -> None:
    places = np.arange(len(series.values))
    bar_colours = np.where(
        series.values > 0, colours.COLOURS["policy"], colours.COLOURS["driver_specific"]
    ).tolist()
    drawn = axes.bar(places, series.shown, width=0.82, color=bar_colours)
    for bar, pair, value in zip(drawn, series.pair_ids, series.values, strict=True):
        canvas.hover(bar, f"pair {pair}: {wording.percent(float(value), 1)}")
    axes.axhline(0, color=colours.INK, linewidth=0.9)
    cut = np.flatnonzero(series.clipped)
    arrow = low + 0.035 * (axes.get_ylim()[1] - low)
    for index in cut:
        axes.plot(places[index], arrow, marker="v", color="white", markersize=5, zorder=4)
        if len(cut) <= _LABELLED or index == cut[-1]:
            axes.annotate(
                wording.percent(float(series.values[index])),
                (float(places[index]), low),
                (0, 14),
                textcoords="offset points",
                ha="center",
                va="bottom",
                rotation=90,
                color="white",
                fontsize=canvas.points(9),
                fontweight="bold",
                zorder=5,
            )


def _closer(series: ImprovementSeries) -> list[Line2D | Patch]:
    policy = int((series.values > 0).sum())
    others = len(series.values) - policy
    return [
        Patch(color=colours.COLOURS["policy"], label=f"policy closer to the driver: {policy}"),
        Patch(
            color=colours.COLOURS["driver_specific"],
            label=f"{wording.method_label('driver_specific')} closer, or equal: {others}",
        ),
    ]


def _statistics(axes: Axes, summary: Improvement, low: float) -> list[Line2D | Patch]:
    """Draws the summary's lines and returns their legend entries, which carry the numbers."""
    handles: list[Line2D | Patch] = []
    lines: tuple[tuple[str, float, canvas.Dash, float], ...] = (
        ("improvement (geometric)", summary.geometric, "solid", 1.8),
        ("of the mean errors", summary.ratio_of_means, (0, (5, 1.8)), 1.4),
        ("median", summary.median, (0, (1.2, 1.4)), 1.6),
    )
    for name, value, dash, width in lines:
        text = f"{name} {wording.percent_or_undefined(value, 1)}"
        if np.isfinite(value):
            axes.axhline(value, color="black", linestyle=dash, linewidth=width, zorder=3)
        if value < low:
            text += " (below the axis)"
        handles.append(Line2D([], [], color="black", linestyle=dash, linewidth=width, label=text))
    ends = (summary.ci95_low, summary.ci95_high)
    if np.isfinite(ends).all():
        axes.axhspan(*ends, color="#000000", alpha=0.13, linewidth=0, zorder=0.5)
        text = f"95 % interval {wording.percent(ends[0], 1)} to {wording.percent(ends[1], 1)}"
        handles.insert(1, Patch(color="#000000", alpha=0.13, label=text))
    return handles


def _pairs_title(bars: ImprovementBars, prefix: str) -> str:
    title = wording.plural(len(bars.series[0].values), "pair")
    if prefix:
        title += f" of {wording.shortened(prefix.rstrip('_-/:.'), 30)}"
    title += ", best to worst"
    if bars.undefined:
        title += f"; {bars.undefined} without a defined improvement"
    return title


class ImprovementPerDriver(JobFigure):
    """The policy's improvement of every pair, best to worst."""

    title = "Improvement of every pair over driver-specific calibration"
    caption = (
        "A bar per pair, in the colour of the method that was closer to the driver, with the"
        " geometric improvement over drivers, its 95 % interval, that of the mean errors, and the"
        " median."
    )
    order = 10

    def draw(self, result: Result) -> Figure | None:
        """Draws it where a policy adapts."""
        if "driver_specific" not in result.improvements:
            return None
        return draw_improvement(result, "driver_specific")


def draw_improvement(result: Result, baseline: str) -> Figure:
    """Draws the improvement of every pair over a baseline."""
    rows = result.pairs[result.pairs["method"] == "policy"]
    summary = result.improvements[baseline]
    bars = improvement_bars(
        [""],
        [rows["pair_id"].astype(str).tolist()],
        [rows[f"improvement_over_{baseline}"].to_numpy(dtype=float)],
        baseline=baseline,
        error=result.judge.heading,
        marks=(summary.geometric, summary.ci95_low, summary.ci95_high),
    )
    return draw_improvements(bars, summary)
