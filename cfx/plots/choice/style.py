"""Driving style: how the scores of the drivers are distributed, and where the clusters are cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfx.plots.choice.common import Array, finite
from cfx.plots.look import CLUSTER_COLOURS
from cfx.plots.words import plural
from cfx.style.result import CLUSTERS

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
