"""Several jobs beside each other: their mean improvements, their errors, their clusters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter

from cfx.plugin import (
    Improvement,
    canvas,
    colours,
    improvement_bars,
    parameter_spread,
    style,
    wording,
)

_WIDE = 1.6
"""An axis of errors reaches so many times as far as the largest error but the default's."""


_MARKERS = ("o", "s", "D", "P", "X", "*", "h", "p")
_SHOWN = ("geometric", "ci95_low", "ci95_high", "ratio_of_means", "median")
"""Statistics of an improvement that are drawn."""

_NAMED = 90
"""Up to so many pairs carry their names under the axis."""

_BARS = 3
"""Up to so many jobs are drawn as bars beside each other, more as dots."""


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
    values: canvas.Array


def statistics_axis(
    improvements: Iterable[Improvement], baseline: str
) -> improvement_bars.ImprovementAxis:
    """Return the axis of several jobs' statistics."""
    values: list[float] = []
    for improvement in improvements:
        values += canvas.finite([getattr(improvement, name) for name in _SHOWN]).tolist()
    what = "improvements, medians and ends of intervals"
    return improvement_bars.improvement_axis(np.array(values), baseline=baseline, what=what)


def error_limit(values: Mapping[str, canvas.Array], unit: str) -> tuple[float, str]:
    """Return the end of an axis of several jobs' errors, and a sentence on what lies beyond it.

    A default far off the others does not stretch the axis.

    Args:
        values: by method `(J,)`; NaN where a job has no such method.
        unit: of the values.
    """
    near, far = [0.0], np.empty(0)
    for method, errors in values.items():
        if method == "default":
            far = canvas.finite(errors)
        else:
            near += canvas.finite(errors).tolist()
    largest = max(*near, 1e-9)
    beyond = far[far > _WIDE * largest]
    if not len(beyond):
        return 1.06 * max(largest, float(far.max(initial=0.0))), ""
    jobs, most = wording.plural(len(beyond), "job"), wording.number_text(float(beyond.max()))
    return (
        _WIDE * largest,
        f"{jobs} with {wording.method_label('default')} further off, up to {most} {unit}.",
    )


@canvas.styled
def draw_overview(
    improvements: Mapping[str, Improvement], baseline: str, axis: improvement_bars.ImprovementAxis
) -> Figure:
    """Draws the improvement with its interval, that of the mean errors, and the median, by job."""
    figure, axes, places = _by_job(list(improvements))
    colour = colours.colour_of(baseline)
    for (job, row), place in zip(improvements.items(), places, strict=True):
        centre = row.geometric
        reach = np.nan_to_num([[centre - row.ci95_low], [row.ci95_high - centre]])
        drawn = axes.errorbar(
            [centre], [place], xerr=reach, color=colour, marker="o", markersize=8, capsize=4
        )
        interval = wording.percent_interval(row.ci95_low, row.ci95_high)
        said = f"{job}: {wording.percent_or_undefined(centre, 1)}, 95 % interval {interval}"
        canvas.hover(drawn.lines[0], said)
        for name, value, marker in (
            ("of the mean errors", row.ratio_of_means, "D"),
            ("median", row.median, "|"),
        ):
            mark = canvas.draw_points(
                axes, [value], [place], marker, "black", 8 if marker == "D" else 13
            )
            mark.set(markerfacecolor="none", markeredgewidth=1.3)
            canvas.hover(mark, f"{job}: {name} {wording.percent_or_undefined(value, 1)}")
    axes.axvline(0, color=colours.INK, linewidth=0.9, zorder=1)
    axes.set_xlim(axis.low, axis.high)
    axes.xaxis.set_major_formatter(FuncFormatter(canvas.percent_tick))
    axes.set_xlabel(f"{axis.title} (%)")
    handles = [_mark("o", colour, "improvement and its 95 % interval")]
    handles += [_mark("D", "black", "of the mean errors"), _mark("|", "black", "median")]
    canvas.legend_above(figure, handles)
    return figure


@canvas.styled
def draw_error_dots(
    jobs: Sequence[str], values: Mapping[str, canvas.Array], *, unit: str, what: str
) -> Figure:
    """Draw the errors of each method: a line per job.

    Args:
        jobs: J names.
        values: by method `(J,)`; NaN where a job has no such method.
        unit: of the values.
        what: what they are, in the axis' title.
    """
    figure, axes, places = _by_job(jobs)
    handles = []
    for method, errors in values.items():
        marker = "D" if method == "policy" else "o"
        handles.append(_mark(marker, colours.colour_of(method), wording.method_label(method)))
        for job, value, place in zip(jobs, errors, places, strict=True):
            mark = canvas.draw_points(axes, [value], [place], marker, colours.colour_of(method), 8)
            canvas.hover(mark, f"{job}, {wording.method_label(method)}: {value:.3f} {unit}")
    axes.set_xlim(0, error_limit(values, unit)[0])
    axes.set_xlabel(f"{what} ({unit})")
    canvas.legend_above(figure, handles, 5)
    return figure


@canvas.styled
def draw_clusters(groups: Sequence[ClusterGroup], axis: improvement_bars.ImprovementAxis) -> Figure:
    """Draw the improvement by cluster: a box and its pairs for each group of jobs."""
    figure = canvas.blank(4.4)
    axes = figure.subplots()
    present: set[str] = set()
    for group in groups:
        present |= set(group.clusters)
    order = [cluster for cluster in style.CLUSTERS if cluster in present]
    width = 0.8 / max(len(groups), 1)
    handles = []
    for k, group in enumerate(groups):
        colour = colours.JOB_COLOURS[k % len(colours.JOB_COLOURS)]
        handles.append(Patch(color=colour, label=wording.shortened(group.name, 60)))
        for place, cluster in enumerate(order):
            inside = np.asarray(group.clusters, dtype=object) == cluster
            values = canvas.finite(group.values[inside])
            if not len(values):
                continue
            centre = place + (k - 0.5 * (len(groups) - 1)) * width
            _box(axes, values, centre, 0.8 * width, colour)
            offsets = 0.25 * width * parameter_spread.spread_offsets(len(values))
            pairs = canvas.draw_points(axes, centre + offsets, values, "o", colour, 3.5, alpha=0.6)
            pairs.set(markeredgewidth=0)
    axes.axhline(0, color=colours.INK, linewidth=0.9, zorder=1)
    axes.set_xticks(range(len(order)), order)
    axes.set_xlim(-0.6, max(len(order), 1) - 0.4)
    axes.grid(visible=False, axis="x")
    axes.set_xlabel("cluster of driving style")
    improvement_bars.vertical_improvements(axes, axis)
    canvas.legend_above(figure, handles)
    return figure


def _box(axes: Axes, values: canvas.Array, centre: float, width: float, colour: str) -> None:
    axes.boxplot(
        [values],
        positions=[centre],
        widths=[width],
        manage_ticks=False,
        showfliers=False,
        showmeans=True,
        meanline=True,
        boxprops={"color": colour},
        whiskerprops={"color": colour},
        capprops={"color": colour},
        medianprops={"color": colour, "linewidth": 2},
        meanprops={"color": colour, "linestyle": "--"},
    )


@canvas.styled
def draw_every_pair(bars: improvement_bars.ImprovementBars, pair_ids: Sequence[str]) -> Figure:
    """Draws the improvement of every pair, of all jobs beside each other.

    Args:
        bars: of J jobs.
        pair_ids: all pairs, in the order of the axis.
    """
    named = len(pair_ids) <= _NAMED
    prefix = wording.common_prefix(list(pair_ids)) if named else ""
    ticks = [wording.shortened(pair.removeprefix(prefix), 18) for pair in pair_ids] if named else []
    figure = canvas.blank(4.3 + 0.075 * max(map(len, ticks), default=0))
    axes = figure.subplots()
    place_of = {pair: place for place, pair in enumerate(pair_ids)}
    as_bars = len(bars.series) <= _BARS
    width = 0.82 / max(len(bars.series), 1) if as_bars else 0.0
    handles: list[Line2D | Patch] = []
    for k, series in enumerate(bars.series):
        colour = colours.JOB_COLOURS[k % len(colours.JOB_COLOURS)]
        marker = _MARKERS[(k // len(colours.JOB_COLOURS)) % len(_MARKERS)]
        aside = (k - 0.5 * (len(bars.series) - 1)) * width
        places = np.array([place_of[pair] for pair in series.pair_ids], dtype=float) + aside
        named_as = wording.shortened(series.name, 60)
        if as_bars:
            drawn = axes.bar(places, series.shown, width=width, color=colour)
            for bar, pair, value in zip(drawn, series.pair_ids, series.values, strict=True):
                canvas.hover(
                    bar,
                    f"pair {pair}, {series.name}: {wording.percent_or_undefined(float(value), 1)}",
                )
            handles.append(Patch(color=colour, label=named_as))
        else:
            canvas.hover(
                canvas.draw_points(axes, places, series.shown, marker, colour, 4.5), series.name
            )
            handles.append(_mark(marker, colour, named_as))
        cut = series.clipped
        arrows = canvas.draw_points(
            axes, places[cut], series.shown[cut], "v", colour, 8, clip_on=False
        )
        arrows.set(markeredgecolor="black")
    axes.axhline(0, color=colours.INK, linewidth=0.9)
    axes.set_xlim(-0.7, max(len(pair_ids), 8) - 0.3)
    axes.set_xticks(range(len(ticks)), ticks, rotation=90, fontsize=canvas.points(8.5))
    axes.grid(visible=False, axis="x")
    of_what = f" of {wording.shortened(prefix.rstrip('_-/:.'), 30)}" if prefix else ""
    axes.set_xlabel(f"{wording.plural(len(pair_ids), 'pair')} of a leader and a follower{of_what}")
    improvement_bars.vertical_improvements(axes, bars.axis)
    canvas.legend_above(figure, handles)
    return figure


def _by_job(jobs: Sequence[str]) -> tuple[Figure, Axes, canvas.Array]:
    """Returns a figure with a line for each job, the first on top."""
    figure = canvas.blank(1.35 + 0.34 * len(jobs))
    axes = figure.subplots()
    places = np.arange(len(jobs), dtype=np.float64)
    axes.set_yticks(places, [wording.shortened(job, 60) for job in jobs])
    axes.set_ylim(len(jobs) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    return figure, axes, places


def _mark(marker: str, colour: str, text: str) -> Line2D:
    return Line2D(
        [],
        [],
        color=colour,
        marker=marker,
        markersize=8,
        markerfacecolor="none" if colour == "black" else colour,
        linestyle="none",
        label=text,
    )
