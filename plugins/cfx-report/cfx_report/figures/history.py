"""Figure: how much a policy gains from the measured history that it observes before the test."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.plugin import JobFigure, Result, canvas, colours, improvement_bars, wording

BASES = ("driver_specific", "pooled")
"""The parameters that a policy's answers are offsets from, in the order in which they are shown."""


def history_curves(history: pd.DataFrame) -> pd.DataFrame:
    """Return the improvement over driver-specific calibration by base and amount of burn-in.

    Args:
        history: as `Evaluation.history`.

    Returns:
        A row per base and amount of burn-in. `base` is in the order of `BASES`, `amount` as
        `amounts_of` sorts it. `geometric`, `low` and `high` are the improvement and the ends of its
        95 % interval over drivers, as fractions. `pairs` counts pairs whose improvement is defined.
    """
    from cfx.plugin import statistics  # imports scipy

    rows = []
    for base in sorted(history["base"].unique(), key=_place_of_base):
        for amount in amounts_of(history):
            chosen = history[(history["base"] == base) & (history["amount"] == amount)]
            if len(chosen):
                ratios = 1.0 - chosen["improvement"].to_numpy(dtype=float)
                drivers = chosen["driver"].astype(str).tolist()
                improvement = statistics.improvement_statistics(
                    np.ones_like(ratios), ratios, drivers
                )
                numbers = (
                    improvement.geometric,
                    improvement.ci95_low,
                    improvement.ci95_high,
                    improvement.pairs,
                )
                rows.append((str(base), amount, *numbers))
    return pd.DataFrame(rows, columns=["base", "amount", "geometric", "low", "high", "pairs"])


def amounts_of(history: pd.DataFrame) -> list[str]:
    """Returns the amounts of history as axis labels, the smallest first: "0 s", "10 s", "80 %".

    The share of the trajectory stands last: it is all the history that there is.
    """
    longest = history.groupby("amount")["history_s"].max()
    return sorted(
        (str(amount) for amount in longest.index),
        key=lambda amount: (amount.endswith("%"), longest[amount]),
    )


def _place_of_base(base: str) -> tuple[int, str]:
    return (BASES.index(base) if base in BASES else len(BASES), base)


@canvas.styled
def draw_history(history: pd.DataFrame) -> Figure:
    """Draw the improvement and its 95 % interval against the amount of burn-in.

    Args:
        history: as `Evaluation.history`.
    """
    figure = canvas.blank(3.9)
    axes = figure.subplots()
    amounts, curves = amounts_of(history), history_curves(history)
    bases = curves["base"].unique()
    for k, base in enumerate(bases):
        curve = curves[curves["base"] == base]
        aside = 0.06 * (k - 0.5 * (len(bases) - 1))  # so that intervals do not hide each other
        places = np.array([amounts.index(amount) for amount in curve["amount"]]) + aside
        middle, low, high = curve[["geometric", "low", "high"]].to_numpy(dtype=float).T
        axes.errorbar(
            places,
            middle,
            np.nan_to_num(np.stack([middle - low, high - middle])),
            color=colours.COLOURS.get(base, colours.INK),
            marker="o",
            linewidth=1.8,
            capsize=4,
            label=f"offsets from {wording.method_label(base)}",
        )
    axes.axhline(0, color=colours.INK, linewidth=0.9)
    axes.set_xticks(range(len(amounts)), amounts)
    axes.set_xlim(-0.4, len(amounts) - 0.6)
    axes.set_xlabel("burn-in: measured history before the test part")
    axes.set_ylabel(
        improvement_bars.improvement_title("driver_specific").replace(" over ", "\nover ") + " (%)"
    )
    canvas.percent_axis(axes)
    title = "geometric over drivers, and its 95 % interval"
    canvas.legend_above(figure, columns=2, title=title)
    return figure


class History(JobFigure):
    """What a policy gains from the measured history before the test part."""

    title = "Improvement by the amount of burn-in"
    caption = (
        "Before the test part, the policy is fed with measured history of the driver, its burn-in."
        " Here the same test part after less and after more of it: the improvement over"
        " driver-specific calibration, with its 95 % interval over drivers."
    )
    order = 100

    def draw(self, result: Result) -> Figure | None:
        """Draws it where the history was varied."""
        table = result.tables.get("history")
        if table is None:
            return None
        return draw_history(table)
