"""Driving style: how the scores of the drivers are distributed, and where the clusters are cut."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cfx.data.style.result import CLUSTERS
from cfx.report.figures.canvas import canvas, styled
from cfx.report.figures.figure import JobFigure
from cfx.report.figures.results import Results
from cfx.report.figures.values import Array, finite
from cfx.report.figures.words import plural
from cfx.results.look import CLUSTER_COLOURS, INK

INDICATORS = {
    "mean_speed": "mean speed",
    "variance_speed": "variance of speed",
    "mean_acceleration": "mean acceleration",
    "variance_acceleration": "variance of acceleration",
    "mean_space_headway": "mean space headway",
    "mean_time_headway": "mean time headway",
}


@dataclass(frozen=True)
class ClusterBars:
    """The drivers of one cluster: their number in each bin, and in all."""

    name: str
    colour: str
    counts: NDArray[np.int64]
    drivers: int

    @property
    def label(self) -> str:
        """What the legend says."""
        return f"{self.name}: {self.drivers}"


@dataclass(frozen=True)
class StyleHistogram:
    """Scores of all drivers.

    Attributes:
        edges: `(B + 1,)` of the bins.
        clusters: stacked bars, from conservative to aggressive.
        cuts: scores that separate the clusters, those that are finite.
        title: of the score axis; it counts the drivers without a score.
        highest: drivers in the fullest bin, at least 1.
    """

    edges: Array
    clusters: tuple[ClusterBars, ...]
    cuts: tuple[float, ...]
    title: str
    highest: int


def style_histogram(
    scores: Array, clusters: NDArray[np.integer], cuts: Sequence[float]
) -> StyleHistogram:
    """Chooses 8 to 24 equal bins over the scores, stacked by cluster.

    Args:
        scores: `(D,)`, of each driver; one that is not finite is left out and counted.
        clusters: `(D,)`, 0, 1 or 2.
        cuts: scores that separate the clusters.
    """
    known = finite(scores)
    edges = _edges(known)
    bars = []
    for index, name in enumerate(CLUSTERS):
        mine = finite(scores[clusters == index])
        counts = np.histogram(mine, edges)[0]
        bars.append(ClusterBars(name, CLUSTER_COLOURS[index], counts, len(mine)))
    title = "style score (0 conservative, 1 aggressive)"
    missing = len(scores) - len(known)
    if missing:
        title += f"; {plural(missing, 'driver')} without a score"
    highest = max(1, int(np.histogram(known, edges)[0].max()))
    kept = tuple(float(cut) for cut in finite(cuts))
    return StyleHistogram(edges, tuple(bars), kept, title, highest)


def _edges(scores: Array) -> Array:
    if not len(scores):
        return np.linspace(0.0, 1.0, 9)
    low, high = float(scores.min()), float(scores.max())
    if high - low < 1e-6:
        return np.linspace(low - 0.05, high + 0.05, 9)
    bins = int(np.clip(2 * np.sqrt(len(scores)), 8, 24))
    return np.linspace(low, high, bins + 1)


@styled
def draw_style(histogram: StyleHistogram, weights: Mapping[str, float]) -> Figure:
    """Draws the scores with the cuts and the cluster sizes, and the entropy weights if known."""
    figure = canvas(3.9)
    if not weights:
        _histogram(figure.subplots(), histogram)
        return figure
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


class StyleDistribution(JobFigure):
    """The drivers' style scores, and how their clusters are cut."""

    title = "Distribution of the style scores"
    caption = (
        "Each driver's score by the entropy weight method, of all drivers of the data; the dashed"
        " lines cut them into conservative, normal and aggressive."
    )
    order = 60

    def draw(self, results: Results) -> Figure | None:
        """Draws it where scores are known."""
        if results.style is None:
            return None
        table = results.style.table
        scores = table["score"].to_numpy(dtype=float)
        clusters = table["cluster"].astype(float).astype(int).to_numpy()
        return draw_style(
            style_histogram(scores, clusters, results.style.cuts), results.style.weights
        )
