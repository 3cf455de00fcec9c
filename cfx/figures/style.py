"""Driving style: how the scores of the drivers are spread, and where the clusters are cut."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cfx.figures.look import CLUSTER_COLOURS, INK, canvas, styled
from cfx.style.result import CLUSTERS, StyleResult

_NAMES = {
    "mean_speed": "mean speed",
    "variance_speed": "variance of speed",
    "mean_acceleration": "mean acceleration",
    "variance_acceleration": "variance of acceleration",
    "mean_space_headway": "mean space headway",
    "mean_time_headway": "mean time headway",
}


@styled
def style_distribution(style: StyleResult) -> Figure:
    """Histogram of the style scores with the cuts and the cluster sizes; beside it the entropy weights.

    Drivers whose score is not a finite number are left out of the bars and counted in the axis label.
    """
    figure = canvas(3.9)
    left, right = figure.subplots(1, 2, width_ratios=(2.3, 1.0))
    _histogram(left, style)
    _weights(right, style)
    return figure


def _histogram(axes: Axes, style: StyleResult) -> None:
    table = style.table
    scores = table["score"].to_numpy(dtype=float)
    clusters = table["cluster"].to_numpy(dtype=int)
    finite = np.isfinite(scores)
    edges = _edges(scores[finite])
    groups = [scores[finite & (clusters == index)] for index in range(len(CLUSTERS))]
    counts = [np.histogram(group, edges)[0] for group in groups]
    bottom = np.zeros(len(edges) - 1)
    for index, count in enumerate(counts):
        axes.bar(
            edges[:-1],
            count,
            width=np.diff(edges),
            align="edge",
            bottom=bottom,
            color=CLUSTER_COLOURS[index],
            edgecolor="white",
            linewidth=0.8,
            label=f"{CLUSTERS[index]}: {len(groups[index])}",
        )
        bottom += count
    top = max(1.0, float(bottom.max(initial=0.0)))
    axes.set_ylim(0, 1.22 * top)
    for cut, side in zip(style.cuts, ("right", "left"), strict=True):
        if np.isfinite(cut):
            axes.axvline(cut, color=INK, linestyle=(0, (4, 2)), linewidth=1.2)
            gap = " " if side == "left" else ""
            axes.text(
                cut,
                1.19 * top,
                f"{gap}{cut:.3f}{' ' if not gap else ''}",
                ha=side,
                va="top",
                color=INK,
            )
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.grid(visible=False, axis="x")
    missing = int((~finite).sum())
    axes.set_xlabel(
        "style score (0 calm, 1 aggressive)"
        + (f"; {missing} drivers without a score" if missing else "")
    )
    axes.set_ylabel("drivers")
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, handlelength=1.0, columnspacing=1.4
    )


def _edges(scores: np.ndarray) -> np.ndarray:
    """Returns edges of 8 to 24 equal bins over the scores."""
    if not len(scores):
        return np.linspace(0.0, 1.0, 9)
    low, high = float(scores.min()), float(scores.max())
    if high - low < 1e-6:
        return np.linspace(low - 0.05, high + 0.05, 9)
    return np.linspace(low, high, int(np.clip(2 * np.sqrt(len(scores)), 8, 24)) + 1)


def _weights(axes: Axes, style: StyleResult) -> None:
    names = list(style.weights)
    values = [float(style.weights[name]) for name in names]
    places = [float(place) for place in range(len(names))]
    axes.barh(places, values, height=0.62, color="#b5b5b5")
    axes.set_yticks(places, [_NAMES.get(name, name) for name in names])
    axes.invert_yaxis()
    for place, value in zip(places, values, strict=True):
        axes.text(value, place, f" {value:.2f}", va="center", ha="left", color=INK, fontsize=9.5)
    axes.set_xlim(0, 1.22 * max([*values, 1e-6]))
    axes.grid(visible=False)
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", bottom=False, labelbottom=False)
    axes.set_title("entropy weight of each indicator")
