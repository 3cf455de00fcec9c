"""Learning curves."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter

from cfx.plots.choice.learning import LOSS_TITLE, SAMPLED, LearningCurves
from cfx.plots.look import EDGE
from cfx.plots.matplotlib.canvas import canvas, say, styled


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
