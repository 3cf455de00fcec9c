"""Errors of forecasts against their horizon, and against the history that was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cfx.evaluation.forecasts import errors_by, errors_by_history
from cfx.report.figures.canvas import (
    Line,
    canvas,
    draw_lines,
    logarithmic,
    mark_points,
    method_legend,
    styled,
)
from cfx.report.figures.figure import JobFigure
from cfx.report.figures.results import Results

HORIZON_TITLE = "horizon (s)"
HISTORY_TITLE = "measured history (s)"

_ERRORS = (("rmse_speed", "RMSE of speed (m/s)"), ("rmse_position", "RMSE of position (m)"))
_PANELS = 3


@dataclass(frozen=True)
class ForecastPanel:
    """Mean errors over drivers, a line per method.

    Attributes:
        title: which error, with its unit.
        lines: by method; what `Line` calls time is what the errors stand against.
        logarithmic: whether errors span so much that only ratios can be seen.
    """

    title: str
    lines: tuple[Line, ...]
    logarithmic: bool = False


def horizon_panels(summary: pd.DataFrame, methods: Sequence[str]) -> tuple[ForecastPanel, ...]:
    """Chooses a panel for speed and one for position.

    Args:
        summary: as `Forecasts.summary`.
        methods: those to show.
    """
    panels = []
    for error, title in _ERRORS:
        lines = _lines(summary, methods, "horizon_s", error)
        panels.append(ForecastPanel(title, lines, logarithmic=True))
    return tuple(panels)


def history_panels(by_history: pd.DataFrame, methods: Sequence[str]) -> tuple[ForecastPanel, ...]:
    """Chooses a panel for a short, a middle and a long horizon; none for a single span of history.

    Args:
        by_history: as `errors_by_history` returns it.
        methods: those to show.
    """
    if by_history["span_s"].nunique() < 2:
        return ()
    horizons = sorted(by_history["horizon_s"].unique())
    chosen = sorted({horizons[0], horizons[len(horizons) // 2], horizons[-1]})[:_PANELS]
    panels = []
    for horizon in chosen:
        rows = by_history[by_history["horizon_s"] == horizon]
        title = f"RMSE of speed after {horizon:g} s (m/s)"
        panels.append(ForecastPanel(title, _lines(rows, methods, "span_s", "rmse_speed")))
    return tuple(panels)


def _lines(
    table: pd.DataFrame, methods: Sequence[str], against: str, error: str
) -> tuple[Line, ...]:
    lines = []
    for method in methods:
        rows = table[table["method"] == method].sort_values(against)
        seconds = rows[against].to_numpy(dtype=float)
        lines.append(Line(method, seconds, rows[error].to_numpy(dtype=float)))
    return tuple(lines)


@styled
def draw_forecasts(panels: Sequence[ForecastPanel], methods: Sequence[str], against: str) -> Figure:
    """Draws mean errors over drivers, a panel for each error.

    Args:
        panels: the panels, side by side.
        methods: of the legend.
        against: title of the horizontal axes.
    """
    figure = canvas(4.4)
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(grid, panels, strict=True):
        draw_panel(axes, panel, against)
        if panel.logarithmic:
            logarithmic(axes)
        else:
            axes.set_ylim(bottom=0)
    method_legend(figure, methods)
    return figure


def draw_panel(axes: Axes, panel: ForecastPanel, against: str) -> None:
    """Draws the lines of one panel.

    Args:
        axes: to draw on.
        panel: its lines and the title of its vertical axis.
        against: title of the horizontal axis.
    """
    draw_lines(axes, panel.lines)
    mark_points(axes)
    axes.set_xlabel(against)
    axes.set_ylabel(panel.title)


class ForecastErrors(JobFigure):
    """Errors of forecasts against their horizon."""

    title = "Errors of forecasts against the horizon"
    caption = (
        "From each of many moments (origins) of the test trajectories, knowing what was measured up"
        " to it, where will the driver be some seconds later? RMSE over the origins of each driver,"
        " then the mean over drivers."
    )
    order = 110

    def draw(self, results: Results) -> Figure | None:
        """Draws it where forecasts were made."""
        found = results.forecasts
        if found is None:
            return None
        of_driver = errors_by(found.table, ["method", "horizon_s", "driver"])
        grouped = of_driver.groupby(["method", "horizon_s"], sort=False, observed=True)
        summary = grouped[[error for error, _ in _ERRORS]].mean().reset_index()
        panels = horizon_panels(summary, found.methods)
        return draw_forecasts(panels, found.methods, HORIZON_TITLE)


class ForecastsByHistory(JobFigure):
    """Errors of forecasts against how much of a driver had been measured."""

    title = "Errors of forecasts against the measured history"
    caption = "The same forecasts, by how much of the driver had been measured before the origin."
    order = 111

    def draw(self, results: Results) -> Figure | None:
        """Draws it where origins have so different histories that they can be told apart."""
        found = results.forecasts
        if found is None:
            return None
        panels = history_panels(errors_by_history(found.table), found.methods)
        return draw_forecasts(panels, found.methods, HISTORY_TITLE) if panels else None
