"""Driving style: how the scores of the drivers are distributed, and where the clusters are cut."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cfx.plugin import JobFigure, Result, StyleResult, canvas, colours, style, wording


def score_bins(scores: canvas.Array) -> canvas.Array:
    """Return the edges of 8 to 24 equal bins over finite scores."""
    if not len(scores):
        return np.linspace(0.0, 1.0, 9)
    low, high = float(scores.min()), float(scores.max())
    if high - low < 1e-6:
        return np.linspace(low - 0.05, high + 0.05, 9)
    bins = int(np.clip(2 * np.sqrt(len(scores)), 8, 24))
    return np.linspace(low, high, bins + 1)


@canvas.styled
def draw_style(of_drivers: StyleResult) -> Figure:
    """Draw the scores with the cuts and the cluster sizes, and the entropy weights if known."""
    figure = canvas.blank(3.9)
    if not of_drivers.weights:
        _histogram(figure.subplots(), of_drivers)
        return figure
    left, right = canvas.side_by_side(figure, (2.3, 1.0))
    _histogram(left, of_drivers)
    _weights(right, of_drivers.weights)
    return figure


def _histogram(axes: Axes, of_drivers: StyleResult) -> None:
    scores = of_drivers.table["score"].to_numpy(dtype=float)
    clusters = of_drivers.table["cluster"].astype(float).astype(int).to_numpy()
    measured = canvas.finite(scores)
    edges = score_bins(measured)
    bottom = np.zeros(len(edges) - 1)
    for index, name in enumerate(style.CLUSTERS):
        mine = canvas.finite(scores[clusters == index])
        counts = np.histogram(mine, edges)[0]
        axes.bar(
            edges[:-1],
            counts,
            width=np.diff(edges),
            align="edge",
            bottom=bottom,
            color=colours.CLUSTER_COLOURS[index],
            edgecolor="white",
            linewidth=0.8,
            label=f"{name}: {len(mine)}",
        )
        bottom += counts
    top = max(1, int(np.histogram(measured, edges)[0].max()))
    axes.set_ylim(0, 1.22 * top)
    for k, cut in enumerate(canvas.finite(of_drivers.cuts)):
        axes.axvline(cut, color=colours.INK, linestyle=(0, (4, 2)), linewidth=1.2)
        side, text = ("right", f"{cut:.3f} ") if k == 0 else ("left", f" {cut:.3f}")
        axes.text(cut, 1.19 * top, text, ha=side, va="top", color=colours.INK)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.grid(visible=False, axis="x")
    title = "style score (0 conservative, 1 aggressive)"
    if len(scores) > len(measured):
        title += f"; {wording.plural(len(scores) - len(measured), 'driver')} without a score"
    axes.set_xlabel(title)
    axes.set_ylabel("drivers")
    axes.legend(
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=canvas.most_across(3),
        handlelength=1.0,
        columnspacing=1.4,
    )


def _weights(axes: Axes, weights: Mapping[str, float]) -> None:
    names, values = list(weights), list(weights.values())
    places = np.arange(len(names), dtype=float)
    axes.barh(places, values, height=0.62, color="#b5b5b5")
    axes.set_yticks(places, [style.name_of_indicator(name) for name in names])
    axes.invert_yaxis()
    for place, value in zip(places, values, strict=True):
        axes.text(
            value,
            place,
            f" {value:.2f}",
            va="center",
            ha="left",
            color=colours.INK,
            fontsize=canvas.points(9.5),
        )
    axes.set_xlim(0, 1.22 * max([*values, 1e-6]))
    axes.grid(visible=False)
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", bottom=False, labelbottom=False)
    axes.set_title("entropy weight of each indicator")


class StyleDistribution(JobFigure):
    """The drivers' style scores, and how their clusters are cut."""

    title = "Distribution of the style scores"
    caption = (
        "Each driver's score by the entropy weight method, of all drivers of the data; the dashed"
        " lines cut them into conservative, normal and aggressive."
    )
    order = 60

    def draw(self, result: Result) -> Figure | None:
        """Draws it where scores are known."""
        return None if result.style is None else draw_style(result.style)
