"""Calibrated parameters: where between their bounds they lie, and how they go together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from cfx.plots.choice.common import Array
from cfx.plots.choice.trajectories import ParameterAxis

AT_BOUND = 0.01
"""So near to a bound, as a share of the distance between both, a value is at it."""


@dataclass(frozen=True)
class ParameterSpread:
    """Calibrated values of one parameter, D drivers' pairs; SI units.

    Attributes:
        axis: its name, unit and bounds.
        values: `(D,)`, driver-specific.
        pooled: `(F,)`, each different pooled value; empty if none was calibrated.
        default: the model's.
    """

    axis: ParameterAxis
    values: Array
    pooled: Array
    default: float

    def places(self, values: Array) -> Array:
        """Returns where values lie between the bounds: 0 at the lower, 1 at the upper."""
        assert self.axis.low is not None
        assert self.axis.high is not None
        return (values - self.axis.low) / (self.axis.high - self.axis.low)

    @property
    def at_low(self) -> float:
        """Share of the pairs at the lower bound."""
        return float((self.places(self.values) < AT_BOUND).mean())

    @property
    def at_high(self) -> float:
        """Share of the pairs at the upper bound."""
        return float((self.places(self.values) > 1 - AT_BOUND).mean())


def parameter_spreads(
    table: pd.DataFrame, axes: Sequence[ParameterAxis]
) -> tuple[ParameterSpread, ...]:
    """Returns the spread of each parameter whose bounds and values are known.

    Args:
        table: a row per pair and method with columns `method` and `parameter_NAME`.
        axes: the tuned parameters.
    """
    found = []
    for axis in axes:
        column = f"parameter_{axis.name}"
        if column not in table or axis.low is None or axis.high is None or axis.high <= axis.low:
            continue
        values = _known(table, "fixed", column)
        default = _known(table, "default", column)
        if len(values) and len(default):
            pooled = np.unique(_known(table, "population", column))
            found.append(ParameterSpread(axis, values, pooled, float(default[0])))
    return tuple(found)


def _known(table: pd.DataFrame, method: str, column: str) -> Array:
    values = np.asarray(table.loc[table["method"] == method, column], dtype=np.float64)
    return np.asarray(values[np.isfinite(values)], dtype=np.float64)


def spread_offsets(count: int) -> Array:
    """Returns offsets of dots across their line, `(count,)`, -1 to 1, the same each time.

    They follow the golden ratio, so that neighbours lie apart.
    """
    steps = np.arange(count, dtype=np.float64) * 0.6180339887498949
    return np.asarray(2 * (steps % 1) - 1, dtype=np.float64)


def correlations(table: pd.DataFrame, axes: Sequence[ParameterAxis]) -> pd.DataFrame:
    """Returns Spearman's rank correlations of driver-specific parameters, names by names.

    NaN where a parameter does not vary.
    """
    columns = {}
    for axis in axes:
        if f"parameter_{axis.name}" in table:
            columns[f"parameter_{axis.name}"] = axis.name
    rows = table.loc[table["method"] == "fixed", list(columns)].rename(columns=columns)
    return rows.astype(float).corr("spearman")
