"""How the networks learned."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from cfx.figures.look import INK, TRAIN_COLOUR, VALIDATION_COLOUR, canvas, styled
from cfx.learners.curves import over_networks

_COLUMNS = {
    "train_loss": ("training", TRAIN_COLOUR),
    "validation_loss": ("validation", VALIDATION_COLOUR),
}


@styled
def learning_curve(curves: pd.DataFrame) -> Figure:
    """Training and validation loss per epoch: the median over the networks and the band between the quartiles.

    The loss axis is logarithmic where all values are positive and span more than a factor of five.

    Args:
        curves: columns `network`, `epoch`, `train_loss`, `validation_loss`; NaN where not measured.
    """
    figure = canvas(3.9)
    axes = figure.subplots()
    networks = curves["network"].nunique() if len(curves) else 0
    drawn = [_curve(axes, over_networks(curves, column), *_COLUMNS[column]) for column in _COLUMNS]
    values = np.concatenate(drawn)
    if len(values) and values.min() > 0 and values.max() > 5 * values.min():
        _logarithmic(axes, float(values.max() / values.min()))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if len(curves) and curves["epoch"].min() == curves["epoch"].max():
        axes.set_xticks([int(curves["epoch"].iloc[0])])
    axes.set_xlabel("epoch")
    axes.set_ylabel("loss (as the learner defines it)")
    axes.margins(x=0.01)
    if not len(values):
        axes.text(
            0.5,
            0.5,
            "no loss was measured",
            transform=axes.transAxes,
            ha="center",
            va="center",
            color=INK,
        )
    what = f"{networks} networks: median and quartiles" if networks > 1 else "one network"
    figure.legend(loc="outside upper center", ncols=2, title=what, title_fontsize=10.5)
    return figure


def _curve(axes: Axes, losses: pd.DataFrame, label: str, colour: str) -> np.ndarray:
    """Draws one curve with its band and returns the values drawn."""
    if losses.empty:
        return np.empty(0)
    q1, median, q3 = (losses.quantile(q, axis=1).to_numpy() for q in (0.25, 0.5, 0.75))
    epochs = losses.index.to_numpy()
    few = len(epochs) < 3
    axes.plot(
        epochs,
        median,
        color=colour,
        linewidth=2.0,
        marker="o" if few else None,
        label=label,
        zorder=3,
    )
    if losses.shape[1] > 1:
        axes.fill_between(epochs, q1, q3, color=colour, alpha=0.25, linewidth=0)
    return np.concatenate([q1, median, q3])


def _logarithmic(axes: Axes, span: float) -> None:
    axes.set_yscale("log")
    marks = (1.0, 2.0, 5.0) if span < 1e3 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(base=10, subs=marks, numticks=12))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
