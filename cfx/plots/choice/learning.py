"""How the networks of a job learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from cfx.learners.curves import first_sampled_epoch, over_networks
from cfx.plots.choice.common import Array
from cfx.plots.look import TRAIN_COLOUR, VALIDATION_COLOUR

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
