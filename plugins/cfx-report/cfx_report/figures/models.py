"""Model against model: each pair's error of the closest job, against that of others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.plugin import MetricInfo, canvas, colours, headline, statistics, wording

_ACROSS = 3
_MOST = 6
"""Others that are shown; the next best come first."""


@canvas.styled
def draw_models(
    errors: Mapping[str, pd.DataFrame],
    compared: Sequence[statistics.Against],
    judge: MetricInfo,
) -> Figure:
    """Draws a panel per other job: a dot per pair; above the line the best job is closer.

    Args:
        errors: of each job a row per pair: `pair_id`, `frames` and `error`.
        compared: as `cfx.evaluation.statistics.ranking_of` returns them in `against`; at least one.
        judge: the error by which they are compared.
    """
    shown = compared[:_MOST]
    across = min(canvas.most_across(_ACROSS), len(shown))
    rows = -(-len(shown) // across)
    figure = canvas.blank(0.4 + 3.3 * rows, 3.5 * across)
    grid = figure.subplots(rows, across, squeeze=False)
    for place, comparison in enumerate(shown):
        axes = grid.flat[place]
        both = errors[comparison.best].merge(
            errors[comparison.other], on=["pair_id", "frames"], suffixes=("", "_other")
        )
        best, other = both["error"].to_numpy(float), both["error_other"].to_numpy(float)
        end = 1.08 * float(np.nanmax(np.concatenate([best, other])))
        axes.plot([0, end], [0, end], color=colours.EDGE, linewidth=canvas.points(1), zorder=1)
        canvas.draw_points(axes, best, other, "o", colours.JOB_COLOURS[place], 4.5, alpha=0.65)
        axes.set_xlim(0, end)
        axes.set_ylim(0, end)
        axes.set_aspect("equal")
        improvement = comparison.improvement
        lead = f"{wording.percent(improvement.geometric, 1)} (p = {comparison.p_value:.2g})"
        note = headline.summaries_disagree(improvement.geometric, improvement.ratio_of_means)
        if note:
            lead += f"; {note}"
        axes.set_title(f"{comparison.best} over {comparison.other}\n{lead}")
        unit = f" ({judge.unit})" if judge.unit else ""
        axes.set_xlabel(canvas.wrapped(f"{judge.heading}, {comparison.best}{unit}"))
        axes.set_ylabel(canvas.wrapped(f"{judge.heading}, {comparison.other}{unit}"))
    for unused in grid.flat[len(shown) :]:
        unused.set_visible(False)
    return figure
