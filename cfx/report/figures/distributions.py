"""Sampled forecasts: their scores as distributions, and whether they are as wide as reality."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.evaluation.distributions import (
    LEVEL,
    centre_errors,
    sampled_methods,
    summarize_distributions,
)
from cfx.report.figures.canvas import DASHES, Line, canvas, logarithmic, method_legend, styled
from cfx.report.figures.figure import JobFigure
from cfx.report.figures.forecasts import HORIZON_TITLE, ForecastPanel, draw_panel
from cfx.report.figures.results import Results
from cfx.report.figures.values import Array
from cfx.results.look import EDGE, colour_of

CRPS_TITLE = "CRPS of speed (m/s)"
COVERAGE_TITLE = f"share within the central {100 * LEVEL:.0f} %"
PIT_TITLE = "share of samples below reality"

PIT_BINS = 10


@dataclass(frozen=True)
class PitHistogram:
    """Where reality lies among the sampled speeds of one method.

    Attributes:
        method: whose.
        density: `(PIT_BINS,)`, mean over drivers, of bins from 0 to 1; 1 everywhere if all is well.
    """

    method: str
    density: Array


@dataclass(frozen=True)
class DistributionView:
    """Scores against the horizon, and the histograms of one horizon.

    Attributes:
        crps: a line per sampled method, and `policy`, the absolute error of the policy's centre.
        coverage: a line per sampled method.
        pit: of the horizon nearest to three seconds.
        horizon: which that is, s.
    """

    crps: ForecastPanel
    coverage: ForecastPanel
    pit: tuple[PitHistogram, ...]
    horizon: float

    @property
    def methods(self) -> tuple[str, ...]:
        """What a legend names."""
        return tuple(line.method for line in self.crps.lines)


def sampled_name(method: str) -> str:
    """Returns what a sampled method is called beside the policy's centre, which is `policy`."""
    return "policy_sampled" if method == "policy" else method


def distribution_view(table: pd.DataFrame, forecasts: pd.DataFrame) -> DistributionView:
    """Chooses what is shown of sampled forecasts.

    Args:
        table: as `score_distributions` returns it.
        forecasts: as `Forecasts.table`, of the same origins.
    """
    summary = summarize_distributions(table)
    methods = sampled_methods(table)
    crps, coverage = [], []
    for method in methods:
        rows = summary[summary["method"] == method].sort_values("horizon_s")
        crps.append(_line(sampled_name(method), rows, "crps_speed"))
        coverage.append(_line(sampled_name(method), rows, "coverage"))
    crps.append(_line("policy", centre_errors(forecasts), "crps_speed"))
    horizons = sorted(table["horizon_s"].unique())
    horizon = float(min(horizons, key=lambda seconds: abs(seconds - 3.0)))
    here = table[table["horizon_s"] == horizon]
    pit = []
    for method in methods:
        rows = here[here["method"] == method]
        pit.append(PitHistogram(sampled_name(method), _pit_density(rows)))
    return DistributionView(
        ForecastPanel(CRPS_TITLE, tuple(crps), logarithmic=True),
        ForecastPanel(COVERAGE_TITLE, tuple(coverage)),
        tuple(pit),
        horizon,
    )


def _line(method: str, rows: pd.DataFrame, column: str) -> Line:
    return Line(method, rows["horizon_s"].to_numpy(dtype=float), rows[column].to_numpy(dtype=float))


def _pit_density(rows: pd.DataFrame) -> Array:
    """Returns the histogram of the PIT, in which drivers count alike."""
    found = []
    for _, of_driver in rows.groupby("driver"):
        counts, _ = np.histogram(of_driver["pit"], bins=PIT_BINS, range=(0.0, 1.0))
        found.append(PIT_BINS * counts / max(1, counts.sum()))
    return np.asarray(np.mean(found, axis=0))


@styled
def draw_distributions(view: DistributionView) -> Figure:
    """Draws CRPS and coverage against the horizon, and the PIT of one horizon."""
    figure = canvas(4.2)
    crps, coverage, pit = figure.subplots(1, 3)
    draw_panel(crps, view.crps, HORIZON_TITLE)
    logarithmic(crps)
    draw_panel(coverage, view.coverage, HORIZON_TITLE)
    coverage.axhline(LEVEL, color=EDGE, linewidth=1.0, zorder=1)
    coverage.set_ylim(0.0, 1.0)
    for histogram in view.pit:
        pit.stairs(
            histogram.density,
            [k / len(histogram.density) for k in range(len(histogram.density) + 1)],
            color=colour_of(histogram.method),
            linestyle=DASHES.get(histogram.method, "solid"),
            linewidth=1.6,
        )
    pit.axhline(1.0, color=EDGE, linewidth=1.0, zorder=1)
    pit.set_xlabel(PIT_TITLE)
    pit.set_ylabel(f"density, {view.horizon:g} s ahead")
    pit.set_ylim(bottom=0)
    method_legend(figure, view.methods)
    return figure


class Distributions(JobFigure):
    """Sampled forecasts as distributions: CRPS, coverage, PIT."""

    title = "CRPS, coverage and PIT of sampled forecasts"
    caption = (
        "The CRPS of speed is smallest, in the mean, for the distribution that reality is drawn"
        " from. Coverage: the share of moments whose real speed lies in the central"
        f" {100 * LEVEL:.0f} % of the sampled ones. The last panel has the share of sampled speeds"
        " below the real one: flat if the spread is right, high at both ends if the paths are too"
        " much alike. Means over drivers."
    )
    order = 112

    def draw(self, results: Results) -> Figure | None:
        """Draws it where forecasts were sampled."""
        found = results.forecasts
        if found is None or found.distributions is None:
            return None
        return draw_distributions(distribution_view(found.distributions, found.table))
