"""Errors over all pairs at each moment since the test part began."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cfx.plugin import JobFigure, PairTrajectory, Result, canvas, colours
from cfx_report.figures.simulated_methods import simulated_methods

TIME_TITLE = "time since the test part began (s)"

_LEAST = 0.9
"""Share of the pairs that a moment needs: with fewer, the errors would be other drivers'."""


def errors_over_time(
    trajectories: Sequence[PairTrajectory], method: str, signal: str
) -> tuple[canvas.Array, canvas.Array]:
    """Returns seconds since the test part began, and the RMSE over the pairs that last so long.

    Args:
        trajectories: test parts of P pairs.
        method: who drives.
        signal: `speed` (m/s) or `gap` (m).

    Returns:
        `(T,)` each; they end where a tenth of the pairs have ended.
    """
    longest = max(trajectories, key=lambda trajectory: len(trajectory.time))
    squares = np.full((len(trajectories), len(longest.time)), np.nan)
    for row, trajectory in zip(squares, trajectories, strict=True):
        if signal == "speed":
            simulated, real = trajectory.speed[method], trajectory.real_speed
        else:
            simulated, real = trajectory.gap[method], trajectory.real_gap
        row[: len(real)] = (simulated - real) ** 2
    frames = int((np.isfinite(squares).mean(axis=0) >= _LEAST).sum())
    seconds: canvas.Array = longest.time[:frames] - longest.time[0]
    return seconds, np.sqrt(np.nanmean(squares[:, :frames], axis=0))


@canvas.styled
def draw_errors(
    trajectories: Sequence[PairTrajectory], methods: Sequence[str], transient_s: float
) -> Figure:
    """Draw RMSE of speed and of gap over all pairs at each moment since the test part began.

    All methods begin in the measured state. Constant parameters leave it for their own gap at once,
    so that a good part of what a policy gains may be gained in the first seconds: here it is seen.

    Args:
        trajectories: test parts of all pairs.
        methods: those to show.
        transient_s: where the transient ends, s; the errors after it are the metrics `steady/...`.
    """
    figure = canvas.blank(3.9)
    for axes, (signal, unit) in zip(
        canvas.side_by_side(figure, (1, 1)), (("speed", "m/s"), ("gap", "m")), strict=True
    ):
        lines = []
        for method in methods:
            seconds, error = errors_over_time(trajectories, method, signal)
            lines.append(canvas.Line(method, seconds, error))
        canvas.draw_lines(axes, lines)
        axes.set_xlabel(TIME_TITLE)
        axes.set_ylabel(f"RMSE of {signal} over pairs ({unit})")
        axes.set_ylim(bottom=0)
        axes.axhline(0, color=colours.INK, linewidth=0.9)
        if any(line.time[-1:] > transient_s for line in lines):
            axes.axvline(transient_s, color=colours.EDGE, linewidth=0.9, linestyle=(0, (4, 2)))
    canvas.method_legend(figure, methods)
    return figure


class ErrorOverTime(JobFigure):
    """RMSE over all pairs at each moment since the test part began."""

    title = "Errors over all pairs since the test part began"
    caption = (
        "RMSE of speed and of gap over all pairs at each moment since the test part began, as long"
        " as nine in ten pairs last. All methods begin in the measured state; constant parameters"
        " leave it for their own gap at once. The dashed line is the end of the transient."
    )
    order = 40

    def draw(self, result: Result) -> Figure | None:
        """Draws it where trajectories are known."""
        if not len(result.trajectories):
            return None
        return draw_errors(result.trajectories, simulated_methods(result), result.transient_s)
