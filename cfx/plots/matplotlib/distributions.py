"""Sampled forecasts as distributions."""

from __future__ import annotations

from matplotlib.figure import Figure

from cfx.evaluation.distributions import LEVEL
from cfx.plots.choice.distributions import PIT_TITLE, DistributionView
from cfx.plots.choice.forecasts import HORIZON_TITLE
from cfx.plots.look import EDGE, colour_of
from cfx.plots.matplotlib.canvas import DASHES, canvas, logarithmic, method_legend, styled
from cfx.plots.matplotlib.forecasts import draw_panel


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
