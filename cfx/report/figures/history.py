"""What a policy gains from the burn-in: the measured history before the test part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.report.figures.canvas import canvas, percent_axis, styled
from cfx.report.figures.figure import JobFigure
from cfx.report.figures.improvements import improvement_title
from cfx.report.figures.results import Results
from cfx.report.figures.values import Array
from cfx.results.look import COLOURS, INK

BASES = {"own": "fixed", "population": "population"}
"""The method whose colour a base has: the parameters that the policy's answers are offsets from."""

BASE_LABELS = {
    "own": "offsets from driver-specific calibration",
    "population": "offsets from pooled calibration",
}
AMOUNT_TITLE = "burn-in: measured history before the test part"
SUBTITLE = "mean over pairs and its 95 % interval"


@dataclass(frozen=True)
class HistoryCurve:
    """Improvements by amount of burn-in, with one base.

    Attributes:
        base: key of the base.
        label: what the base is.
        colour: of the line.
        amounts: A of them, in words.
        mean, low, high: `(A,)`, fractions; mean over pairs and its 95 % interval.
        pairs: `(A,)`, pairs with a defined improvement.
    """

    base: str
    label: str
    colour: str
    amounts: tuple[str, ...]
    mean: Array
    low: Array
    high: Array
    pairs: tuple[int, ...]


def history_curves(history: pd.DataFrame) -> tuple[HistoryCurve, ...]:
    """Chooses a curve per base; the improvement is over driver-specific calibration.

    Args:
        history: as `Evaluation.history`.
    """
    curves = []
    for base in sorted(history["base"].unique(), key=_place_of_base):
        curves.append(_curve(history[history["base"] == base], str(base), amounts_of(history)))
    return tuple(curves)


def amounts_of(history: pd.DataFrame) -> list[str]:
    """Returns the amounts of history in words, the smallest first; a share comes after seconds."""
    longest = history.groupby("amount")["history_s"].max()
    return sorted(
        (str(amount) for amount in longest.index),
        key=lambda amount: (amount.endswith("%"), longest[amount]),
    )


def _place_of_base(base: str) -> tuple[int, str]:
    known = list(BASES)
    return (known.index(base) if base in known else len(known), base)


def _curve(history: pd.DataFrame, base: str, order: list[str]) -> HistoryCurve:
    from cfx.evaluation.statistics import mean_interval  # imports scipy

    amounts, pairs, intervals = [], [], []
    for amount in order:
        chosen = history[history["amount"] == amount]
        if len(chosen):
            gains = chosen["improvement"].astype(float).tolist()
            drivers = chosen["driver"].astype(str).tolist()
            amounts.append(amount)
            pairs.append(int(np.isfinite(gains).sum()))
            intervals.append(mean_interval(gains, drivers, seed=0))
    mean, low, high = np.array(intervals, dtype=float).T
    label = BASE_LABELS.get(base, base)
    colour = COLOURS.get(BASES.get(base, ""), INK)
    return HistoryCurve(base, label, colour, tuple(amounts), mean, low, high, tuple(pairs))


@styled
def draw_history(curves: Sequence[HistoryCurve], amounts: Sequence[str]) -> Figure:
    """Draws the mean improvement and its 95 % interval against the amount of burn-in.

    Args:
        curves: one for each base.
        amounts: all of them, in their order.
    """
    figure = canvas(3.9)
    axes = figure.subplots()
    for k, curve in enumerate(curves):
        aside = 0.06 * (k - 0.5 * (len(curves) - 1))
        places = np.array([amounts.index(amount) for amount in curve.amounts]) + aside
        interval = np.nan_to_num(np.stack([curve.mean - curve.low, curve.high - curve.mean]))
        axes.errorbar(
            places,
            curve.mean,
            interval,
            color=curve.colour,
            marker="o",
            linewidth=1.8,
            capsize=4,
            label=curve.label,
        )
    axes.axhline(0, color=INK, linewidth=0.9)
    axes.set_xticks(range(len(amounts)), amounts)
    axes.set_xlim(-0.4, len(amounts) - 0.6)
    axes.set_xlabel(AMOUNT_TITLE)
    axes.set_ylabel(improvement_title("fixed").replace(" over ", "\nover ") + " (%)")
    percent_axis(axes)
    figure.legend(loc="outside upper center", ncols=2, title=SUBTITLE, title_fontsize=10.5)
    return figure


class History(JobFigure):
    """What a policy gains from the measured history before the test part."""

    title = "Improvement by the amount of burn-in"
    caption = (
        "Before the test part, the policy is fed with measured history of the driver, its burn-in."
        " Here the same test part after less and after more of it: mean improvement over"
        " driver-specific calibration, with its 95 % interval."
    )
    order = 100

    def draw(self, results: Results) -> Figure | None:
        """Draws it where the history was varied."""
        table = results.tables.get("history")
        if table is None:
            return None
        return draw_history(history_curves(table), amounts_of(table))
