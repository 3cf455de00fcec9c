"""Errors of forecasts by horizon and by history, and scores of samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cfx.plugin import JobFigure, Result, canvas, colours
from cfx_forecasts.distributions import (
    LEVEL,
    centre_errors,
    sampled_methods,
    summarize_distributions,
)
from cfx_forecasts.errors import errors_by, errors_by_history, forecast_methods

HORIZON_TITLE = "horizon (s)"
HISTORY_TITLE = "measured history (s)"
PIT_BINS = 10

_ERRORS = (("rmse_speed", "RMSE of speed (m/s)"), ("rmse_position", "RMSE of position (m)"))
_PANELS = 3


@canvas.styled
def draw_by_horizon(summary: pd.DataFrame, methods: Sequence[str]) -> Figure:
    """Draw errors of speed and of position against the horizon.

    Args:
        summary: as `summarize_forecasts` returns it.
        methods: those to show.
    """
    figure = canvas.blank(4.4)
    for axes, (error, title) in zip(
        canvas.side_by_side(figure, [1] * len(_ERRORS)), _ERRORS, strict=True
    ):
        _draw_panel(axes, _lines(summary, methods, "horizon_s", error), title, HORIZON_TITLE)
        canvas.logarithmic(axes)
    canvas.method_legend(figure, methods)
    return figure


@canvas.styled
def draw_by_history(by_history: pd.DataFrame, methods: Sequence[str]) -> Figure:
    """Draw a panel for a short, a middle and a long horizon.

    Args:
        by_history: as `errors_by_history` returns it.
        methods: those to show.
    """
    horizons = sorted(by_history["horizon_s"].unique())
    chosen = sorted({horizons[0], horizons[len(horizons) // 2], horizons[-1]})[:_PANELS]
    figure = canvas.blank(4.4)
    grid = canvas.side_by_side(figure, [1] * len(chosen))
    for axes, horizon in zip(grid, chosen, strict=True):
        rows = by_history[by_history["horizon_s"] == horizon]
        title = f"RMSE of speed after {horizon:g} s (m/s)"
        _draw_panel(axes, _lines(rows, methods, "span_s", "rmse_speed"), title, HISTORY_TITLE)
        axes.set_ylim(bottom=0)
    canvas.method_legend(figure, methods)
    return figure


def _lines(
    table: pd.DataFrame, methods: Sequence[str], against: str, error: str
) -> list[canvas.Line]:
    lines = []
    for method in methods:
        rows = table[table["method"] == method].sort_values(against)
        seconds = rows[against].to_numpy(dtype=float)
        lines.append(canvas.Line(method, seconds, rows[error].to_numpy(dtype=float)))
    return lines


def _draw_panel(axes: Axes, lines: Sequence[canvas.Line], title: str, against: str) -> None:
    canvas.draw_lines(axes, lines)
    canvas.mark_points(axes)
    axes.set_xlabel(against)
    axes.set_ylabel(title)


def sampled_name(method: str) -> str:
    """Return what a sampled method is called beside the policy's centre, which is `policy`."""
    return "policy_sampled" if method == "policy" else method


def pit_density(rows: pd.DataFrame) -> canvas.Array:
    """Return the histogram of the PIT of one method, `(PIT_BINS,)`, in which drivers count alike.

    Where reality lies among the sampled speeds, from 0 to 1; 1 everywhere if all is well.
    """
    densities = []
    for _, of_driver in rows.groupby("driver"):
        counts, _ = np.histogram(of_driver["pit"], bins=PIT_BINS, range=(0.0, 1.0))
        densities.append(PIT_BINS * counts / max(1, counts.sum()))
    return np.asarray(np.mean(densities, axis=0))


@canvas.styled
def draw_distributions(table: pd.DataFrame, forecasts: pd.DataFrame) -> Figure:
    """Draw CRPS and coverage against the horizon, and the PIT of the horizon nearest to 3 s.

    Args:
        table: as `score_distributions` returns it.
        forecasts: single ones of the same origins; the policy's centre is in the first panel, with
            its absolute error.
    """
    figure = canvas.blank(4.2)
    crps, coverage, pit = canvas.side_by_side(figure, (1, 1, 1))
    summary = summarize_distributions(table)
    summary["method"] = summary["method"].astype(str).map(sampled_name)
    sampled = sampled_methods(table)
    names = [sampled_name(method) for method in sampled]
    centre = centre_errors(forecasts).assign(method="policy")
    crps_lines = _lines(summary, names, "horizon_s", "crps_speed")
    crps_lines += _lines(centre, ["policy"], "horizon_s", "crps_speed")
    _draw_panel(crps, crps_lines, "CRPS of speed (m/s)", HORIZON_TITLE)
    canvas.logarithmic(crps)
    title = f"share within the central {100 * LEVEL:.0f} %"
    _draw_panel(coverage, _lines(summary, names, "horizon_s", "coverage"), title, HORIZON_TITLE)
    coverage.axhline(LEVEL, color=colours.EDGE, linewidth=1.0, zorder=1)
    coverage.set_ylim(0.0, 1.0)
    horizon = min(sorted(table["horizon_s"].unique()), key=lambda seconds: abs(seconds - 3.0))
    here = table[table["horizon_s"] == horizon]
    for method, name in zip(sampled, names, strict=True):
        pit.stairs(
            pit_density(here[here["method"] == method]),
            [k / PIT_BINS for k in range(PIT_BINS + 1)],
            color=colours.colour_of(name),
            linestyle=canvas.DASHES.get(name, "solid"),
            linewidth=1.6,
        )
    pit.axhline(1.0, color=colours.EDGE, linewidth=1.0, zorder=1)
    pit.set_xlabel("share of samples below reality")
    pit.set_ylabel(f"density, {horizon:g} s ahead")
    pit.set_ylim(bottom=0)
    canvas.method_legend(figure, [*names, "policy"])
    return figure


class ForecastErrors(JobFigure):
    """Errors of forecasts against their horizon."""

    title = "Errors of forecasts against the horizon"
    caption = (
        "From each of many moments (origins) of the test trajectories, knowing what was measured up"
        " to it, where will the driver be some seconds later? RMSE over the origins of each driver,"
        " then the mean over drivers."
    )
    order = 110

    def draw(self, result: Result) -> Figure | None:
        """Draws it where forecasts were made."""
        table = result.tables.get("forecasts")
        if table is None:
            return None
        of_driver = errors_by(table, ["method", "horizon_s", "driver"])
        grouped = of_driver.groupby(["method", "horizon_s"], sort=False, observed=True)
        summary = grouped[[error for error, _ in _ERRORS]].mean().reset_index()
        return draw_by_horizon(summary, forecast_methods(table))


class ForecastsByHistory(JobFigure):
    """Errors of forecasts against how much of a driver had been measured."""

    title = "Errors of forecasts against the measured history"
    caption = "The same forecasts, by how much of the driver had been measured before the origin."
    order = 111

    def draw(self, result: Result) -> Figure | None:
        """Draws it where origins have so different histories that they can be told apart."""
        table = result.tables.get("forecasts")
        if table is None:
            return None
        by_history = errors_by_history(table)
        if by_history["span_s"].nunique() < 2:
            return None
        return draw_by_history(by_history, forecast_methods(table))


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

    def draw(self, result: Result) -> Figure | None:
        """Draws it where forecasts were sampled."""
        if not {"distributions", "forecasts"} <= set(result.tables):
            return None
        return draw_distributions(result.tables["distributions"], result.tables["forecasts"])
