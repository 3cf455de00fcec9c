"""What an evaluation delivers: plain arrays and tables that tracking, figures and the command line read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]

METHODS = ("default", "fixed", "policy")
"""The methods that every evaluation compares, on the same frames from the same measured state."""


@dataclass(frozen=True)
class Drive:
    """One pair's test part: K + 1 frames, the first being the last measured state before the simulation takes over.

    Attributes:
        pair_id: which pair.
        driver: its follower.
        time: `(K + 1,)` s, from the start of the pair.
        leader_speed, real_speed, real_gap: `(K + 1,)`, measured.
        speed, gap: per method, `(K + 1,)`, simulated.
        parameters: per method, `(K + 1, n)` in SI units: what held at each frame.
    """

    pair_id: str
    driver: str
    time: Array
    leader_speed: Array
    real_speed: Array
    real_gap: Array
    speed: Mapping[str, Array]
    gap: Mapping[str, Array]
    parameters: Mapping[str, Array]


@dataclass(frozen=True)
class Improvement:
    """`(RMSE_fixed - RMSE_policy) / RMSE_fixed` of speed over the pairs, as fractions (0.1 is 10 %).

    Attributes:
        mean, trimmed_mean, median: over pairs; the trimmed mean drops the top and the bottom 10 %.
        ci95_low, ci95_high: bootstrap confidence interval of the mean.
        win_rate: share of pairs with a positive improvement.
        p_value: two-sided Wilcoxon signed-rank test of RMSE_fixed against RMSE_policy.
        pairs: number of pairs that count.
        undefined: number of pairs left out because RMSE_fixed is 0 or a rollout diverged.
    """

    mean: float
    trimmed_mean: float
    median: float
    ci95_low: float
    ci95_high: float
    win_rate: float
    p_value: float
    pairs: int
    undefined: int


@dataclass(frozen=True)
class Evaluation:
    """The comparison of all methods.

    Attributes:
        table: a row per pair and method: pair_id, recording, leader_id, follower_id, driver, cluster, style_score, method,
            rmse_speed (m/s), rmse_gap (m), improvement (against fixed, a fraction), collisions (1 if the gap became negative),
            frames, fold, and one column `parameter_NAME` with the mean of each tuned parameter.
        improvement: statistics over pairs.
        drives: the closed loops themselves, in the order of the pairs.
        names: the tuned parameters' names.
        units: their units.
        bounds: `(2, n)`.
    """

    table: pd.DataFrame
    improvement: Improvement
    drives: tuple[Drive, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    bounds: Array

    def metrics(self) -> dict[str, float]:
        """Returns the metrics under their MLflow names."""
        values: dict[str, float] = {}
        for column in ("rmse_speed", "rmse_gap"):
            means = self.table.groupby("method")[column].mean()
            values |= {f"{column}/{method}": float(means[method]) for method in METHODS}
        for name in ("mean", "trimmed_mean", "median", "ci95_low", "ci95_high", "win_rate", "p_value"):
            values[f"rmse_improvement/{name}"] = float(getattr(self.improvement, name))
        collisions = self.table.groupby("method")["collisions"].sum()
        values |= {f"collisions/{method}": float(collisions[method]) for method in METHODS}
        return values
