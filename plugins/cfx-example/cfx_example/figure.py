"""A figure of a finished job. This one compares the policy with constant parameters.

A job that names it calls `draw` once at its end, `cfx report` and `cfx figures` when they need it.
"""

from __future__ import annotations

from cfx.plugin import JobFigure, Result, canvas
from matplotlib.figure import Figure


class PolicyErrors(JobFigure):
    """Compares the policy with constant parameters, a point for each pair."""

    title = "Errors of the policy and of constant parameters"
    caption = (
        "Each point is a pair: its RMSE of speed on the test part. Below the line the policy"
        " follows it better than constant parameters do."
    )

    def draw(self, result: Result) -> Figure | None:
        if not {"policy", "driver_specific"} <= set(result.shown_methods):
            return None
        errors = result.pairs.pivot(index="pair_id", columns="method", values="rmse_speed")
        figure = canvas.blank(3.9)
        axes = figure.subplots()
        axes.scatter(errors["driver_specific"], errors["policy"])
        axes.axline((0, 0), slope=1, color="0.5", linewidth=1)
        axes.set_xlabel("RMSE of speed, constant parameters (m/s)")
        axes.set_ylabel("policy (m/s)")
        return figure
