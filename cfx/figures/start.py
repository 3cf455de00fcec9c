"""How errors grow from the measured state on in which a test part begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cfx.evaluation.result import Array, Evaluation, PairTrajectory
from cfx.figures.look import INK, canvas, method_handles, method_line, styled

_LEAST = 0.9
"""Share of the pairs that must still drive for a moment to be drawn: with fewer, the errors would be other drivers'."""


@styled
def error_over_time(evaluation: Evaluation) -> Figure:
    """RMSE of speed and of gap over all pairs at each moment since the test part began, as long as nearly all of them drive.

    All methods begin in the measured state. Constant parameters leave it for their own gap at once, so that a good part of what a
    policy gains may be gained in the first seconds: here it is seen.
    """
    figure = canvas(3.9)
    methods = evaluation.methods
    for axes, signal, unit in zip(
        figure.subplots(1, 2), ("speed", "gap"), ("m/s", "m"), strict=True
    ):
        for method in methods:
            seconds, error = errors_over_time(evaluation.trajectories, method, signal)
            method_line(axes, method, seconds, error)
        axes.set_xlabel("time since the test part began (s)")
        axes.set_ylabel(f"RMSE of {signal} over pairs ({unit})")
        axes.set_ylim(bottom=0)
        axes.margins(x=0.01)
        axes.axhline(0, color=INK, linewidth=0.9)
    figure.legend(handles=method_handles(methods), loc="outside upper center", ncols=len(methods))
    return figure


def errors_over_time(
    drives: Sequence[PairTrajectory], method: str, signal: str
) -> tuple[Array, Array]:
    """Returns seconds since the test part began, and the RMSE over the pairs that drive then, `(T,)` each.

    Args:
        signal: `speed` (m/s) or `gap` (m).
    """
    longest = max(drives, key=lambda drive: len(drive.time))
    errors = np.full((len(drives), len(longest.time)), np.nan)
    for row, drive in zip(errors, drives, strict=True):
        real = drive.real_speed if signal == "speed" else drive.real_gap
        row[: len(real)] = getattr(drive, signal)[method] - real
    frames = int((np.isfinite(errors).mean(0) >= _LEAST).sum())
    return longest.time[:frames] - longest.time[0], np.sqrt(
        np.nanmean(errors[:, :frames] ** 2, axis=0)
    )
