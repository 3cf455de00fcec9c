"""How errors are distributed over pairs: cumulative, so that a few pairs can be read too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from cfx.plugin import JobFigure, Result, canvas, colours

_ERRORS = {"rmse_speed": "RMSE of speed (m/s)", "rmse_gap": "RMSE of gap (m)"}
_FEWEST = 3
"""Pairs from which on there is a distribution."""


@canvas.styled
def draw_error_distribution(pairs: pd.DataFrame, methods: Sequence[str]) -> Figure:
    """Draws the share of pairs whose error is at most so large, a line per method.

    Args:
        pairs: a row per pair and method: `method`, `rmse_speed`, `rmse_gap`.
        methods: those to show.
    """
    figure = canvas.blank(3.9)
    for axes, (column, title) in zip(
        canvas.side_by_side(figure, (1, 1)), _ERRORS.items(), strict=True
    ):
        for method in methods:
            measured = pairs.loc[pairs["method"] == method, column]
            errors = np.sort(canvas.finite(measured.to_numpy(dtype=float)))
            if len(errors):
                axes.ecdf(
                    errors,
                    color=colours.colour_of(method),
                    linestyle=canvas.DASHES.get(method, "solid"),
                    linewidth=canvas.points(1.6),
                )
        axes.set_xlim(left=0)
        axes.set_xlabel(title)
        axes.set_ylabel("share of pairs")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    canvas.method_legend(figure, methods)
    return figure


class ErrorDistribution(JobFigure):
    """How the errors of each method are distributed over pairs."""

    title = "Distribution of errors over pairs"
    caption = (
        "The share of pairs whose RMSE on the test part is at most so large, for each method: the"
        " farther to the left a line, the closer the method is to the drivers."
    )
    order = 41

    def draw(self, result: Result) -> Figure | None:
        """Draws it where several pairs were driven by calibrated parameters or a policy."""
        methods = [method for method in result.shown_methods if method not in canvas.HIDDEN]
        if result.pairs["pair_id"].nunique() < _FEWEST or set(methods) <= {"default"}:
            return None
        return draw_error_distribution(result.pairs, methods)
