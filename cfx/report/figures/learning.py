"""How the networks of a job learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter

from cfx.learners.curves import first_sampled_epoch, over_networks
from cfx.report.figures.canvas import canvas, say, styled
from cfx.report.figures.figure import JobFigure
from cfx.report.figures.results import Results
from cfx.report.figures.values import Array
from cfx.results.look import EDGE, TRAIN_COLOUR, VALIDATION_COLOUR

_COLUMNS = {
    "train_loss": ("training", TRAIN_COLOUR, False),
    "validation_loss": ("validation", VALIDATION_COLOUR, True),
}
_MOST_POINTS = 250
_LOGARITHMIC_FROM = 5.0


@dataclass(frozen=True)
class LossCurve:
    """One kind of loss over the networks.

    Attributes:
        label: training or validation.
        colour: of the line and its band.
        dashed: whether the line is.
        epochs: `(E,)`.
        low, median, high: `(E,)`, quartiles over the networks.
    """

    label: str
    colour: str
    dashed: bool
    epochs: Array
    low: Array
    median: Array
    high: Array


@dataclass(frozen=True)
class LearningCurves:
    """What is shown of the training.

    Attributes:
        title: how many networks, and what line and band are.
        curves: those that were measured.
        networks: how many learned.
        logarithmic: whether the loss axis is.
        ticks: of a logarithmic loss axis.
        sampled_from: epoch from which on the training loss has more terms; None if it never has.
    """

    title: str
    curves: tuple[LossCurve, ...]
    networks: int
    logarithmic: bool
    ticks: tuple[float, ...]
    sampled_from: float | None = None


LOSS_TITLE = "loss (as the learner defines it)"
SAMPLED = "training counts sampled paths, too (CRPS)"
"""What the training loss has from `LearningCurves.sampled_from` on."""


def learning_curves(curves: pd.DataFrame) -> LearningCurves:
    """Chooses median and quartiles over the networks, and whether the axis is logarithmic.

    Args:
        curves: columns `network`, `epoch`, `train_loss`, `validation_loss`; NaN where not measured;
            `sampled_paths` where a head draws.
    """
    chosen = []
    for column, (label, colour, dashed) in _COLUMNS.items():
        losses = over_networks(curves, column)
        if not losses.empty:
            chosen.append(_curve(losses, label, colour, dashed=dashed))
    networks = int(curves["network"].nunique())
    title = "one network"
    if networks > 1:
        title = f"{networks} networks: median and quartiles"
    shown = [np.empty(0)]
    for curve in chosen:
        shown += [curve.low, curve.high]
    ticks = _logarithmic_ticks(np.concatenate(shown))
    sampled_from = first_sampled_epoch(curves)
    return LearningCurves(title, tuple(chosen), networks, bool(ticks), ticks, sampled_from)


def _curve(losses: pd.DataFrame, label: str, colour: str, *, dashed: bool) -> LossCurve:
    count = min(_MOST_POINTS, len(losses))
    kept = np.unique(np.linspace(0, len(losses) - 1, count).round().astype(int))
    thinned = losses.iloc[kept]
    epochs = thinned.index.to_numpy(dtype=float)
    low, median, high = (thinned.quantile(q, axis=1).to_numpy() for q in (0.25, 0.5, 0.75))
    return LossCurve(label, colour, dashed, epochs, low, median, high)


def _logarithmic_ticks(values: Array) -> tuple[float, ...]:
    """Returns ticks where all losses are positive and span more than a factor of five."""
    if not len(values):
        return ()
    low, high = float(values.min()), float(values.max())
    if not (low > 0 and high > _LOGARITHMIC_FROM * low):
        return ()
    digits = (1, 2, 5) if high < 1e3 * low else (1,)
    ticks = []
    for power in range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1):
        for digit in digits:
            ticks.append(digit * 10.0**power)
    return tuple(ticks)


@styled
def draw_learning(curves: LearningCurves) -> Figure:
    """Draws training and validation loss per epoch: median over the networks, and quartiles."""
    figure = canvas(3.9)
    axes = figure.subplots()
    for curve in curves.curves:
        axes.plot(
            curve.epochs,
            curve.median,
            color=curve.colour,
            linestyle=(0, (5.0, 1.8)) if curve.dashed else "solid",
            linewidth=2.0,
            marker="o" if len(curve.epochs) < 3 else None,
            label=curve.label,
            zorder=3,
        )
        if curves.networks > 1:
            axes.fill_between(
                curve.epochs, curve.low, curve.high, color=curve.colour, alpha=0.25, linewidth=0
            )
    if curves.sampled_from is not None:
        axes.axvline(
            curves.sampled_from, color=EDGE, linewidth=0.9, linestyle=(0, (4, 2)), label=SAMPLED
        )
    if curves.logarithmic:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(FixedLocator(curves.ticks))
        axes.yaxis.set_major_formatter(FuncFormatter(_plain))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("epoch")
    axes.set_ylabel(LOSS_TITLE)
    axes.margins(x=0.01)
    if not curves.curves:
        say(axes, "no loss was measured")
    elif len(curves.curves[0].epochs) == 1:
        axes.set_xticks([int(curves.curves[0].epochs[0])])
    figure.legend(loc="outside upper center", ncols=3, title=curves.title, title_fontsize=10.5)
    return figure


def _plain(value: float, _position: int) -> str:
    return f"{value:g}"


class LearningCurve(JobFigure):
    """Training and validation loss by epoch."""

    title = "Learning curves"
    caption = (
        "Loss by epoch as the learner defines it: the median over the networks and, where there"
        " are several, the band between the quartiles. A network that stopped early keeps its last"
        " loss."
    )
    order = 80

    def draw(self, results: Results) -> Figure | None:
        """Draws it where something was learned."""
        if results.curves is None or not len(results.curves):
            return None
        return draw_learning(learning_curves(results.curves))
