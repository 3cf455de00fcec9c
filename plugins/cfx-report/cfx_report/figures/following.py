"""Gap against relative speed: how closely a simulated driver circles as the real one does."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from cfx.plugin import JobFigure, PairTrajectory, Result, canvas, colours, pair_lines, wording
from cfx_report.figures.simulated_methods import simulated_methods

_PAIRS = 3


@canvas.styled
def draw_following(trajectories: Sequence[PairTrajectory], methods: Sequence[str]) -> Figure:
    """Draws the gap of some pairs against the leader's speed less the follower's.

    Args:
        trajectories: test parts; a panel each.
        methods: those to show, beside the real driver.
    """
    across = min(canvas.most_across(_PAIRS), len(trajectories))
    rows = -(-len(trajectories) // across)
    figure = canvas.blank(0.7 + 3.2 * rows)
    grid = figure.subplots(rows, across, squeeze=False)
    for axes, trajectory in zip(grid.flat, trajectories, strict=False):
        speeds = {"real": trajectory.real_speed, **trajectory.speed}
        gaps = {"real": trajectory.real_gap, **trajectory.gap}
        for method in ("real", *methods):
            axes.plot(
                trajectory.leader_speed - speeds[method],
                gaps[method],
                color=colours.colour_of(method),
                linestyle=canvas.DASHES.get(method, "solid"),
                linewidth=canvas.points(1.4),
            )
        axes.axvline(0, color=colours.EDGE, linewidth=canvas.points(0.9))
        axes.set_title(wording.shortened(trajectory.pair_id))
        axes.set_xlabel("relative speed (m/s)")
    for row in grid:
        row[0].set_ylabel("gap (m)")
    for unused in grid.flat[len(trajectories) :]:
        unused.set_visible(False)
    canvas.method_legend(figure, ["real", *methods])
    return figure


class Following(JobFigure):
    """Gap against relative speed, of the real driver and of each method."""

    title = "Gap against relative speed"
    caption = (
        "The gap against the leader's speed less the follower's over the test part, of the best,"
        " the median and the worst pair. Drivers circle around the gap that they want: to the right"
        " of 0 the gap grows."
    )
    order = 31

    def draw(self, result: Result) -> Figure | None:
        """Draws it where trajectories are known."""
        if not len(result.trajectories):
            return None
        pairs = [trajectory for _, trajectory in pair_lines.chosen_pairs(result, None, _PAIRS)]
        return draw_following(pairs, simulated_methods(result))
