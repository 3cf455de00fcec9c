"""Errors of forecasts against their horizon, and against the history that was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from cfx.plots.choice.trajectories import Line

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
