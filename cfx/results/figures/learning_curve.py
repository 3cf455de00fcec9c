"""How the networks of a job learned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter

from cfx.figures import canvas, colours
from cfx.learners import curves
from cfx.results.figure import JobFigure

if TYPE_CHECKING:
    from cfx.results.result import Result

LOSS_TITLE = "loss (as the learner defines it)"
SAMPLED = "training counts sampled paths, too (CRPS)"
"""What the training loss has from the first sampled epoch on."""

_COLUMNS = {
    "train_loss": ("training", colours.TRAIN_COLOUR, "solid"),
    "validation_loss": ("validation", colours.VALIDATION_COLOUR, (0, (5.0, 1.8))),
}
_MOST_POINTS = 250
"""Of a curve: more lie closer together than a line is wide."""

_LOGARITHMIC_FROM = 5.0
"""Ratio of the largest to the smallest loss above which the axis is logarithmic."""


def loss_quartiles(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return quartiles over the networks of each loss that was measured.

    Args:
        table: columns `network`, `epoch`, `train_loss`, `validation_loss`; NaN where not measured.

    Returns:
        By column of `table`; a row per epoch, columns 0.25, 0.5 and 0.75.
    """
    quartiles = {}
    for column in _COLUMNS:
        losses = curves.over_networks(table, column)
        if not losses.empty:
            count = min(_MOST_POINTS, len(losses))
            drawn = np.unique(np.linspace(0, len(losses) - 1, count).round().astype(int))
            quartiles[column] = losses.iloc[drawn].quantile((0.25, 0.5, 0.75), axis=1).T
    return quartiles


def _logarithmic_ticks(values: canvas.Array) -> list[float]:
    """Return ticks where all losses are positive and span more than a factor of five."""
    if not len(values):
        return []
    low, high = float(values.min()), float(values.max())
    if not (low > 0 and high > _LOGARITHMIC_FROM * low):
        return []
    digits = (1, 2, 5) if high < 1e3 * low else (1,)
    ticks = []
    for power in range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1):
        for digit in digits:
            ticks.append(digit * 10.0**power)
    return ticks


@canvas.styled
def draw_learning(table: pd.DataFrame) -> Figure:
    """Draw training and validation loss per epoch: median over the networks, and quartiles.

    Args:
        table: as for `loss_quartiles`; `sampled_paths` where a head draws.
    """
    figure = canvas.blank(3.9)
    axes = figure.subplots()
    networks = int(table["network"].nunique())
    losses = loss_quartiles(table)
    for column, quartiles in losses.items():
        label, colour, dash = _COLUMNS[column]
        epochs = quartiles.index.to_numpy(dtype=float)
        axes.plot(
            epochs,
            quartiles[0.5],
            color=colour,
            linestyle=dash,
            linewidth=2.0,
            marker="o" if len(epochs) < 3 else None,
            label=label,
            zorder=3,
        )
        if networks > 1:
            low, high = quartiles[0.25], quartiles[0.75]
            axes.fill_between(epochs, low, high, color=colour, alpha=0.25, linewidth=0)
    sampled_from = curves.first_sampled_epoch(table)
    if sampled_from is not None:
        dash = (0, (4, 2))
        axes.axvline(sampled_from, color=colours.EDGE, linewidth=0.9, linestyle=dash, label=SAMPLED)
    drawn = [np.empty(0)]
    for quartiles in losses.values():
        drawn.append(quartiles[[0.25, 0.75]].to_numpy(dtype=float).ravel())
    ticks = _logarithmic_ticks(np.concatenate(drawn))
    if ticks:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(FixedLocator(ticks))
        axes.yaxis.set_major_formatter(FuncFormatter(canvas.plain_tick))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("epoch")
    axes.set_ylabel(LOSS_TITLE)
    axes.margins(x=0.01)
    if not losses:
        canvas.write_note(axes, "no loss was measured")
    elif len(next(iter(losses.values()))) == 1:
        axes.set_xticks([int(table["epoch"].iloc[0])])
    title = f"{networks} networks: median and quartiles" if networks > 1 else "one network"
    canvas.legend_above(figure, title=title)
    return figure


class LearningCurve(JobFigure):
    """Training and validation loss by epoch."""

    title = "Learning curves"
    caption = (
        "Loss by epoch as the learner defines it: the median over the networks and, where there"
        " are several, the band between the quartiles. A network that stopped early keeps its last"
        " loss."
    )
    order = 80

    def draw(self, result: Result) -> Figure | None:
        """Draws it where something was learned."""
        table = result.tables.get("curves")
        if table is None or not len(table):
            return None
        return draw_learning(table)
