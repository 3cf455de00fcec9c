"""How errors grow from the measured state on in which a test part begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cfx.evaluation.result import PairTrajectory
from cfx.report.figures.canvas import HIDDEN, Line, canvas, draw_lines, method_legend, styled
from cfx.report.figures.figure import JobFigure
from cfx.report.figures.results import Results
from cfx.report.figures.values import Array
from cfx.results.look import EDGE, INK

TIME_TITLE = "time since the test part began (s)"

_LEAST = 0.9
"""Share of the pairs that a moment needs: with fewer, the errors would be other drivers'."""


def errors_over_time(
    trajectories: Sequence[PairTrajectory], method: str, signal: str
) -> tuple[Array, Array]:
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
    seconds: Array = longest.time[:frames] - longest.time[0]
    return seconds, np.sqrt(np.nanmean(squares[:, :frames], axis=0))


@styled
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
    figure = canvas(3.9)
    for axes, (signal, unit) in zip(
        figure.subplots(1, 2), (("speed", "m/s"), ("gap", "m")), strict=True
    ):
        lines = []
        for method in methods:
            seconds, error = errors_over_time(trajectories, method, signal)
            lines.append(Line(method, seconds, error))
        draw_lines(axes, lines)
        axes.set_xlabel(TIME_TITLE)
        axes.set_ylabel(f"RMSE of {signal} over pairs ({unit})")
        axes.set_ylim(bottom=0)
        axes.axhline(0, color=INK, linewidth=0.9)
        if any(line.time[-1:] > transient_s for line in lines):
            axes.axvline(transient_s, color=EDGE, linewidth=0.9, linestyle=(0, (4, 2)))
    method_legend(figure, methods)
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

    def draw(self, results: Results) -> Figure | None:
        """Draws it where trajectories are known."""
        if not len(results.trajectories):
            return None
        simulated = results.trajectories[0].speed
        methods = []
        for method in results.methods:
            if method in simulated and method not in HIDDEN:
                methods.append(method)
        return draw_errors(results.trajectories, methods, results.transient_s)
