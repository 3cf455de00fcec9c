"""Improvement of the policy over the fixed parameters, driver by driver."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from cfx.evaluation.result import Evaluation, Improvement
from cfx.figures.look import COLOURS, INK, canvas, percent, short, styled

Array = NDArray[np.float64]
_SEPARATORS = "_-/:."
_NAMED = 40
"""Up to so many bars carry their pair's name."""


@styled
def improvement_per_driver(evaluation: Evaluation) -> Figure:
    """Sorted bars of every pair's RMSE improvement with mean, 95 % interval, trimmed mean and median.

    A bar has the colour of the method that was closer to the driver. A few very bad pairs do not shrink the others: their bars
    end in an arrow with the value. Pairs without an improvement (see `Improvement.undefined`) are counted in the axis label.
    """
    policy = evaluation.table[evaluation.table["method"] == "policy"]
    every = policy["pair_id"].astype(str).to_numpy()
    values = policy["improvement"].to_numpy(dtype=float)
    finite = np.isfinite(values)
    order = np.argsort(-values[finite], kind="stable")
    names, shown = [str(name) for name in every[finite][order]], values[finite][order]
    named = len(shown) <= _NAMED
    prefix = _common_prefix(names)
    ticks = [short(name.removeprefix(prefix), 16) for name in names]
    longest = max(map(len, ticks), default=0) if named else 0
    figure = canvas(4.3 + 0.075 * longest)
    axes = figure.subplots()
    low, high = _limits(shown, evaluation.improvement)
    clipped = np.clip(shown, low, high)
    places = np.arange(len(shown), dtype=float)
    axes.bar(
        places,
        clipped,
        width=0.82,
        color=np.where(shown > 0, COLOURS["policy"], COLOURS["fixed"]).tolist(),
    )
    axes.axhline(0, color=INK, linewidth=0.9)
    _label_clipped(axes, places, shown, low, high)
    handles = [
        Patch(
            color=COLOURS["policy"], label=f"policy closer to the driver: {int((shown > 0).sum())}"
        ),
        Patch(color=COLOURS["fixed"], label=f"fixed closer, or equal: {int((shown <= 0).sum())}"),
        *_statistics(axes, evaluation.improvement, low),
    ]
    axes.set_ylim(low, high)
    # A few bars stand in the middle, and no broader than those of a larger job.
    middle, half = (len(shown) - 1) / 2, max(len(shown), 8) / 2 + 0.3
    axes.set_xlim(middle - half, middle + half)
    axes.grid(visible=False, axis="x")
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: percent(value) if value else "0 %")
    )
    axes.set_ylabel("improvement of the RMSE of speed\nover fixed parameters (%)")
    if named:
        axes.set_xticks(places, ticks, rotation=90, fontsize=8.5)
        axes.tick_params(axis="x", length=0)
    else:
        axes.set_xticks([])
    undefined = int((~finite).sum())
    note = f"; {undefined} without a defined improvement" if undefined else ""
    where = f" of {short(prefix.rstrip(_SEPARATORS), 30)}" if prefix and named else ""
    axes.set_xlabel(
        f"{len(shown)} pair{'' if len(shown) == 1 else 's'}{where}, best to worst{note}"
    )
    if not len(shown):
        axes.text(
            0.5,
            0.75,
            "no pair has a defined improvement",
            transform=axes.transAxes,
            ha="center",
            va="center",
            color=INK,
        )
    figure.legend(
        handles=handles, loc="outside upper center", ncols=3, columnspacing=1.8, handlelength=1.8
    )
    return figure


def _common_prefix(names: list[str]) -> str:
    """Returns what all names start with, up to a separator: "i80-0400-" of "i80-0400-11-1" and "i80-0400-12-7"."""
    if len(names) < 2:
        return ""
    # The first and the last in alphabetical order differ earliest.
    first, last = min(names), max(names)
    same = next(
        (k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b),
        min(len(first), len(last)),
    )
    return first[: max(first.rfind(mark, 0, same) for mark in _SEPARATORS) + 1]


def _limits(values: Array, summary: Improvement) -> tuple[float, float]:
    """Returns the vertical axis: all bars if that is readable, else where the outliers begin.

    The rule: a bar is cut if it lies further below the lower quartile than three times the distance between the quartiles
    (Tukey's far-out values), and only if it is worse than -60 %.
    """
    if not len(values):
        return -1.0, 1.0
    q1, q3 = np.quantile(values, [0.25, 0.75])
    low, high = float(values.min()), float(max(values.max(), 0.0))
    fence = min(float(q1 - 3 * (q3 - q1)), -0.6)
    if low < fence:
        # The mean and its interval stay in view as long as they do not dwarf the bars themselves.
        known = [x for x in (summary.mean, summary.ci95_low) if np.isfinite(x) and x > 3 * fence]
        low = min([fence, *known])
    low = min(low, 0.0, *(x for x in (summary.ci95_low,) if np.isfinite(x) and x > 3 * fence))
    high = max(high, *(x for x in (summary.ci95_high,) if np.isfinite(x)), 0.0)
    margin = 0.07 * max(high - low, 0.1)
    return low - margin, high + margin


def _label_clipped(axes: Axes, places: Array, values: Array, low: float, high: float) -> None:
    cut = np.flatnonzero(values < low)
    for rank, index in enumerate(cut):
        axes.plot(
            places[index],
            low + 0.035 * (high - low),
            marker="v",
            color="white",
            markersize=5,
            zorder=4,
        )
        if len(cut) <= 8 or rank == len(cut) - 1:
            axes.annotate(
                percent(float(values[index])),
                (places[index], low),
                (0, 14),
                textcoords="offset points",
                ha="center",
                va="bottom",
                rotation=90,
                color="white",
                fontsize=9,
                fontweight="bold",
                zorder=5,
            )


def _statistics(axes: Axes, summary: Improvement, low: float) -> list[Line2D | Patch]:
    """Draws the summary's lines and returns their legend entries, which carry the numbers."""
    handles: list[Line2D | Patch] = []
    if np.isfinite(summary.ci95_low) and np.isfinite(summary.ci95_high):
        axes.axhspan(
            summary.ci95_low,
            summary.ci95_high,
            color="#000000",
            alpha=0.13,
            linewidth=0,
            zorder=0.5,
        )
        text = f"95 % interval of the mean: {percent(summary.ci95_low, 1)} to {percent(summary.ci95_high, 1)}"
        handles.append(Patch(color="#000000", alpha=0.13, label=text))
    lines: tuple[tuple[str, float, Any, float], ...] = (
        ("mean", summary.mean, "solid", 1.8),
        ("trimmed mean", summary.trimmed_mean, (0, (5, 1.8)), 1.4),
        ("median", summary.median, (0, (1.2, 1.4)), 1.6),
    )
    for name, value, dash, width in lines:
        outside = ""
        if np.isfinite(value):
            axes.axhline(value, color="black", linestyle=dash, linewidth=width, zorder=3)
            outside = " (below the axis)" if value < low else ""
        text = percent(value, 1) if np.isfinite(value) else "undefined"
        handles.append(
            Line2D(
                [],
                [],
                color="black",
                linestyle=dash,
                linewidth=width,
                label=f"{name} {text}{outside}",
            )
        )
    return handles
