"""Learning curves of many networks as one."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pandas as pd

log = logging.getLogger(__name__)

_TYPES = {"network": str, "epoch": "int64", "train_loss": float, "validation_loss": float}


def learning_curves(curves: pd.DataFrame) -> pd.DataFrame:
    """Returns learning curves whose columns have the same types whether anything was learned."""
    types: dict[str, Any] = _TYPES
    return curves.astype(types)


def over_networks(curves: pd.DataFrame, column: str) -> pd.DataFrame:
    """Returns one column per network and one row per epoch at which any was measured.

    A network that was stopped early keeps its last loss: otherwise the average would jump whenever
        one leaves it.

    Args:
        curves: columns `network`, `epoch`, `train_loss`, `validation_loss`; NaN where not measured.
        column: `train_loss` or `validation_loss`.
    """
    values = curves[column].astype(float)
    measured = curves[np.isfinite(values)]
    return (
        measured.pivot_table(index="epoch", columns="network", values=column, aggfunc="last")
        .sort_index()
        .ffill()
    )


def first_sampled_epoch(curves: pd.DataFrame) -> float | None:
    """Returns the epoch from which on the training loss also scores sampled paths.

    Before it the loss is of paths without noise alone, and smaller. None where the loss means the
    same in all epochs.

    Args:
        curves: with a column `sampled_paths` where the policy's head draws.
    """
    if "sampled_paths" not in curves:
        return None
    sampled = curves["sampled_paths"] > 0
    if not sampled.any() or sampled.all():
        return None
    return float(curves["epoch"][sampled].min())


def best_losses(curves: pd.DataFrame) -> dict[str, float]:
    """Returns the metric `validation_loss/best`.

    It is the mean over the networks of each one's lowest validation loss. Hyper-parameters are
    chosen by it, never by what was tested. Empty if nothing was validated.
    """
    lowest = curves.groupby("network")["validation_loss"].min().astype(float).dropna()
    if lowest.empty:
        return {}
    return {"validation_loss/best": float(lowest.mean())}


def networks_without_loss(curves: pd.DataFrame) -> list[str]:
    """Returns the networks whose training loss is finite in no epoch: they have learned nothing."""
    losses = curves["train_loss"].astype(float).replace([np.inf, -np.inf], np.nan)
    measured = losses.groupby(curves["network"]).count()
    return [str(name) for name in measured.index[measured == 0]]


def warn_of_nothing_learned(curves: pd.DataFrame) -> None:
    """Warns of networks whose loss was never a number."""
    lost = networks_without_loss(curves)
    if lost:
        log.warning(
            "%d of %d networks have learned nothing: their training loss is not a number in any"
            " epoch (curves.parquet); their parameters are those that training began with",
            len(lost),
            curves["network"].nunique(),
        )
