"""How strong the prior of driver-specific parameters is, and what it was chosen from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from cfx.plugin import JobFigure, Result, canvas, colours


def draw_strengths(priors: Sequence[Mapping[str, Any]], error_label: str) -> Figure:
    """Draws the held-out error by the prior's weight, and which weight was taken.

    Args:
        priors: of `data.json`: `weight`, `pairs`, and `held_out_error` by weight; one for each
            choice, such as each fold's.
        error_label: name and unit of the error.
    """
    figure = canvas.blank(3.0)
    axes = figure.subplots()
    axes.set_xscale("log")
    weights: set[float] = set()
    for prior in priors:
        tried = [float(weight) for weight in prior["held_out_error"]]
        weights.update(tried)
        errors = canvas.finite(list(prior["held_out_error"].values()))
        (line,) = axes.plot(
            tried,
            errors,
            color=colours.COLOURS["driver_specific"],
            linewidth=canvas.points(1.6),
            marker="o",
            markersize=canvas.points(3.5),
        )
        canvas.hover(line, f"held-out error, {prior['pairs']} pairs")
        chosen = axes.axvline(
            prior["weight"], color=colours.INK, linewidth=canvas.points(1.0), linestyle="dashed"
        )
        canvas.hover(chosen, f"chosen: {prior['weight']:.2g}")
    axes.set_xticks(sorted(weights))
    axes.xaxis.set_major_formatter(FuncFormatter(canvas.plain_tick))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("weight of the prior; dashed: chosen for all that is calibrated on")
    axes.set_ylabel(error_label)
    return figure


class PriorStrengths(JobFigure):
    """The strength of the prior that was chosen, and the held-out errors."""

    title = "How strong the prior is"
    caption = (
        "Error of driver-specific parameters on thirds of the calibrated part that were left out,"
        " by the weight of the prior: geometric mean over the drivers that were tried. The dashed"
        " weight was taken: two thirds of where a parabola has its least error, since all that is"
        " calibrated on is half as long again as what was tried."
    )
    order = 133

    def draw(self, result: Result) -> Figure | None:
        """Draws it where the strength was chosen."""
        priors = []
        for prior in result.data.get("priors") or ():
            errors = np.array(list(prior["held_out_error"].values()), dtype=float)
            if prior["pairs"] and np.isfinite(errors).all():
                priors.append(prior)
        if not priors:
            return None
        unit = (result.data.get("objective") or {}).get("unit", "")
        label = f"held-out error ({unit})" if unit else "held-out error"
        return draw_strengths(priors, label)
