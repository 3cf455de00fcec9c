"""Distribution of the style scores."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cfx.plots.choice.style import INDICATORS, StyleHistogram
from cfx.plots.look import INK
from cfx.plots.matplotlib.canvas import canvas, styled


@styled
def draw_style(histogram: StyleHistogram, weights: Mapping[str, float]) -> Figure:
    """Draws the scores with the cuts and the cluster sizes; beside it the entropy weights."""
    figure = canvas(3.9)
    left, right = figure.subplots(1, 2, width_ratios=(2.3, 1.0))
    _histogram(left, histogram)
    _weights(right, weights)
    return figure


def _histogram(axes: Axes, histogram: StyleHistogram) -> None:
    edges = histogram.edges
    bottom = np.zeros(len(edges) - 1)
    for cluster in histogram.clusters:
        axes.bar(
            edges[:-1],
            cluster.counts,
            width=np.diff(edges),
            align="edge",
            bottom=bottom,
            color=cluster.colour,
            edgecolor="white",
            linewidth=0.8,
            label=cluster.label,
        )
        bottom += cluster.counts
    top = histogram.highest
    axes.set_ylim(0, 1.22 * top)
    for k, cut in enumerate(histogram.cuts):
        axes.axvline(cut, color=INK, linestyle=(0, (4, 2)), linewidth=1.2)
        side, text = ("right", f"{cut:.3f} ") if k == 0 else ("left", f" {cut:.3f}")
        axes.text(cut, 1.19 * top, text, ha=side, va="top", color=INK)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.grid(visible=False, axis="x")
    axes.set_xlabel(histogram.title)
    axes.set_ylabel("drivers")
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, handlelength=1.0, columnspacing=1.4
    )


def _weights(axes: Axes, weights: Mapping[str, float]) -> None:
    names, values = list(weights), list(weights.values())
    places = np.arange(len(names), dtype=float)
    axes.barh(places, values, height=0.62, color="#b5b5b5")
    axes.set_yticks(places, [INDICATORS.get(name, name) for name in names])
    axes.invert_yaxis()
    for place, value in zip(places, values, strict=True):
        axes.text(value, place, f" {value:.2f}", va="center", ha="left", color=INK, fontsize=9.5)
    axes.set_xlim(0, 1.22 * max([*values, 1e-6]))
    axes.grid(visible=False)
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", bottom=False, labelbottom=False)
    axes.set_title("entropy weight of each indicator")
