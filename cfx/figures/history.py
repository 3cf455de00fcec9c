"""What a policy gains from the measured history that it has read before it drives."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from cfx.evaluation.statistics import mean_interval
from cfx.figures.look import COLOURS, INK, canvas, percent, styled

BASES = {"own": "fixed", "population": "population"}
"""The method whose colour and name a base has: the parameters that the policy's answers are offsets from."""

BASE_LABELS = {
    "own": "offsets from the driver's own fixed parameters",
    "population": "offsets from the population's parameters",
}


@styled
def history_gain(history: pd.DataFrame) -> Figure:
    """Mean improvement over the driver's own fixed parameters, and its 95 % interval, against the amount of history read.

    Args:
        history: as `Evaluation.history`.
    """
    figure = canvas(3.9)
    axes = figure.subplots()
    amounts = amounts_of(history)
    for k, (base, gains) in enumerate(history_means(history).items()):
        places = np.array([amounts.index(amount) for amount in gains.index]) + 0.06 * (
            k - 0.5 * (history["base"].nunique() - 1)
        )
        mean, low, high = (gains[name].to_numpy(dtype=float) for name in ("mean", "low", "high"))
        distance = np.nan_to_num(np.stack([mean - low, high - mean]))
        colour = COLOURS.get(BASES.get(base, ""), INK)
        axes.errorbar(
            places,
            mean,
            distance,
            color=colour,
            marker="o",
            linewidth=1.8,
            capsize=4,
            label=BASE_LABELS.get(base, base),
        )
    axes.axhline(0, color=INK, linewidth=0.9)
    axes.set_xticks(range(len(amounts)), amounts)
    axes.set_xlim(-0.4, len(amounts) - 0.6)
    axes.set_xlabel("measured history that the policy reads before it drives")
    axes.set_ylabel("improvement of the RMSE of speed\nover own fixed parameters (%)")
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: percent(value) if value else "0 %")
    )
    figure.legend(
        loc="outside upper center",
        ncols=2,
        title="mean over pairs and its 95 % interval",
        title_fontsize=10.5,
    )
    return figure


def amounts_of(history: pd.DataFrame) -> list[str]:
    """Returns the amounts of history in words, the smallest first; what is a share of a drive comes after seconds."""
    longest = history.groupby("amount")["history_s"].max()
    return [
        str(amount)
        for amount in sorted(longest.index, key=lambda one: (str(one).endswith("%"), longest[one]))
    ]


def history_means(history: pd.DataFrame) -> Mapping[str, pd.DataFrame]:
    """Returns for each base a row per amount: mean, low and high (of the 95 % interval), fractions, and pairs."""
    found = {}
    for base in sorted(
        history["base"].unique(),
        key=lambda one: (list(BASES).index(one) if one in BASES else len(BASES), one),
    ):
        rows = {}
        for amount in amounts_of(history):
            chosen = history[(history["base"] == base) & (history["amount"] == amount)]
            if len(chosen):
                gains, drivers = (
                    chosen["improvement"].to_numpy(dtype=float),
                    chosen["driver"].astype(str).tolist(),
                )
                rows[amount] = (
                    *mean_interval(gains, drivers, seed=0),
                    int(np.isfinite(gains).sum()),
                )
        found[str(base)] = pd.DataFrame.from_dict(
            rows, orient="index", columns=["mean", "low", "high", "pairs"]
        )
    return found
