"""How errors grow from the measured state on in which a test part begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cfx.plots.choice.common import Array
from cfx.plots.choice.trajectories import Line

if TYPE_CHECKING:
    from cfx.evaluation.result import PairTrajectory

TIME_TITLE = "time since the test part began (s)"

_LEAST = 0.9
"""Share of the pairs that a moment needs: with fewer, the errors would be other drivers'."""


@dataclass(frozen=True)
class ErrorPanel:
    """RMSE over all pairs at each moment, a line per method.

    Attributes:
        title: which error, with its unit.
        lines: by method.
        transient_s: where the transient ends, s; the errors after it are the metrics `steady/...`.
    """

    title: str
    lines: tuple[Line, ...]
    transient_s: float

    @property
    def shows_transient(self) -> bool:
        """Whether the lines go on after the transient."""
        return any(line.time[-1:] > self.transient_s for line in self.lines)


def error_panels(
    trajectories: Sequence[PairTrajectory], methods: Sequence[str], transient_s: float
) -> tuple[ErrorPanel, ...]:
    """Chooses the panels of speed and gap.

    Args:
        trajectories: test parts of all pairs.
        methods: those to show.
        transient_s: as in `ErrorPanel`.
    """
    panels = []
    for signal, unit in (("speed", "m/s"), ("gap", "m")):
        lines = []
        for method in methods:
            seconds, error = errors_over_time(trajectories, method, signal)
            lines.append(Line(method, seconds, error))
        title = f"RMSE of {signal} over pairs ({unit})"
        panels.append(ErrorPanel(title, tuple(lines), transient_s))
    return tuple(panels)


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
