"""What calibration found beyond its parameters: slices of the loss, fits, labels over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from cfx.calibration.flatness import flat_shares
from cfx.plots.choice.common import Array
from cfx.plots.choice.trajectories import ParameterAxis

RATIO_TITLE = "loss, as a multiple of the best"
HIGHEST = 2.0
"""Multiple of the best loss at which the axis ends."""

MOST_LINES = 60
"""Pairs whose slices are drawn, spread evenly over all."""

MOST_DRIVERS = 6
"""Drivers whose labels are shown."""


@dataclass(frozen=True)
class SlicePanel:
    """The loss along one parameter; D pairs, G places.

    Attributes:
        axis: name, unit and bounds.
        places: `(G,)`, 0 at the lower bound to 1 at the upper.
        values: `(G,)`, the parameter there, SI units.
        ratios: `(D, G)`, the loss as a multiple of the pair's best.
        near: median over pairs of the share of the range in which the loss is nearly the best
            (`cfx.calibration.flatness`).
        flat: share of the pairs for which that is the whole range.
    """

    axis: ParameterAxis
    places: Array
    values: Array
    ratios: Array
    near: float
    flat: float

    @property
    def lines(self) -> Array:
        """The ratios of those pairs that are drawn."""
        few = min(len(self.ratios), MOST_LINES)
        chosen = np.linspace(0, len(self.ratios) - 1, few).round().astype(int)
        return np.asarray(self.ratios[chosen], dtype=np.float64)

    @property
    def median(self) -> Array:
        """Median over the pairs, `(G,)`."""
        return np.asarray(np.median(self.ratios, axis=0), dtype=np.float64)


def slice_panels(table: pd.DataFrame, axes: Sequence[ParameterAxis]) -> tuple[SlicePanel, ...]:
    """Returns a panel per parameter.

    Args:
        table: as `cfx.calibration.identifiability.slices` returns it.
        axes: the tuned parameters.
    """
    panels = []
    shares = flat_shares(table)
    for axis in axes:
        rows = table[table["parameter"] == axis.name]
        if rows.empty:
            continue
        wide = rows.pivot_table(index="pair_id", columns="place", values="loss", sort=True)
        best = rows.drop_duplicates("pair_id").set_index("pair_id")["best_loss"]
        best = best.reindex(wide.index)
        counts = np.isfinite(best.to_numpy(dtype=float)) & (best.to_numpy(dtype=float) > 0)
        losses = wide.to_numpy(dtype=np.float64)[counts]
        ratios = losses / best.to_numpy(dtype=np.float64)[counts, None]
        ratios = np.where(np.isfinite(ratios), ratios, np.inf)
        if not len(ratios):
            continue
        values = rows.drop_duplicates("place").sort_values("place")["value"]
        known = shares[axis.name].dropna()
        near, flat = float(known.median()), float((known == 1).mean())
        places = wide.columns.to_numpy(dtype=np.float64)
        of_axis = values.to_numpy(dtype=np.float64)
        panels.append(SlicePanel(axis, places, of_axis, ratios, near, flat))
    return tuple(panels)


@dataclass(frozen=True)
class Fit:
    """Errors of one method on both parts of P pairs.

    Attributes:
        method: whose.
        pair_ids: of the pairs.
        train, test: `(P,)`, RMSE of speed, m/s, on the part that was calibrated on and on the test.
    """

    method: str
    pair_ids: tuple[str, ...]
    train: Array
    test: Array


def fits_of(table: pd.DataFrame) -> tuple[Fit, ...]:
    """Returns the fit of each method, driver-specific parameters first.

    Args:
        table: columns pair_id, method, train_rmse_speed, test_rmse_speed.
    """
    found = []
    for method in ("fixed", "population", "default"):
        rows = table[table["method"] == method]
        train = rows["train_rmse_speed"].to_numpy(dtype=np.float64)
        test = rows["test_rmse_speed"].to_numpy(dtype=np.float64)
        known = np.isfinite(train) & np.isfinite(test)
        if known.any():
            ids = tuple(rows["pair_id"].astype(str)[known])
            found.append(Fit(method, ids, train[known], test[known]))
    return tuple(found)


@dataclass(frozen=True)
class DriverLabels:
    """Per-window calibrated parameters of one pair; W windows, n parameters.

    Attributes:
        pair_id: which pair.
        time: `(W,)` s, from the start of the pair.
        values: by parameter, `(W,)`, SI units.
        weight: `(W,)`, 0 to 1: how much the choice mattered in the window, as a share of the 90 %
            quantile over all windows; 0 is arbitrary.
        sensitivity: `(W,)`, in the objective's unit.
        fixed: by parameter, the driver-specific one.
    """

    pair_id: str
    time: Array
    values: dict[str, Array]
    weight: Array
    sensitivity: Array
    fixed: dict[str, float]


def labels_of(
    labels: pd.DataFrame, pairs: pd.DataFrame, axes: Sequence[ParameterAxis]
) -> tuple[DriverLabels, ...]:
    """Returns the labels of some pairs, spread evenly over those that have driver-specific ones.

    Args:
        labels: as `Labels.to_frame` returns it.
        pairs: a row per pair and method with columns `pair_id`, `method`, `parameter_NAME`.
        axes: the tuned parameters.
    """
    names = [axis.name for axis in axes if f"parameter_{axis.name}" in labels]
    if labels.empty or not names:
        return ()
    own = pairs[pairs["method"] == "fixed"].drop_duplicates("pair_id").set_index("pair_id")
    known = [one for one in own.index.astype(str) if one in set(labels["pair_id"].astype(str))]
    if not known:
        return ()
    scale = float(np.quantile(labels["sensitivity"].to_numpy(dtype=float), 0.9)) or 1.0
    places = np.linspace(0, len(known) - 1, min(len(known), MOST_DRIVERS)).round().astype(int)
    found = []
    for place in dict.fromkeys(places.tolist()):
        rows = labels[labels["pair_id"].astype(str) == known[place]].sort_values("time_s")
        sensitivity = rows["sensitivity"].to_numpy(dtype=np.float64)
        values = {}
        fixed = {}
        for name in names:
            values[name] = rows[f"parameter_{name}"].to_numpy(dtype=np.float64)
            fixed[name] = float(own.loc[known[place], f"parameter_{name}"])
        found.append(
            DriverLabels(
                known[place],
                rows["time_s"].to_numpy(dtype=np.float64),
                values,
                np.clip(sensitivity / scale, 0, 1),
                sensitivity,
                fixed,
            )
        )
    return tuple(found)
