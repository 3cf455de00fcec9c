"""Calibrated parameters: how they are spread over drivers, and how they correlate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from cfx.evaluation.result import Purpose
from cfx.figures import canvas, colours, wording
from cfx.results.figure import JobFigure

if TYPE_CHECKING:
    from cfx.results.result import ParameterAxis, Result

__all__ = [
    "AT_BOUND",
    "ParameterSpread",
    "parameter_spreads",
    "spread_offsets",
]
"""What plugins may use, as `cfx.plugin.parameter_spread`."""


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
    values: canvas.Array
    pooled: canvas.Array
    default: float

    def places(self, values: canvas.Array) -> canvas.Array:
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
    spreads = []
    for axis in axes:
        column = f"parameter_{axis.name}"
        if column not in table or axis.low is None or axis.high is None or axis.high <= axis.low:
            continue
        values = _known(table, "driver_specific", column)
        default = _known(table, "default", column)
        if len(values) and len(default):
            pooled = np.unique(_known(table, "pooled", column))
            spreads.append(ParameterSpread(axis, values, pooled, float(default[0])))
    return tuple(spreads)


def _known(table: pd.DataFrame, method: str, column: str) -> canvas.Array:
    values = np.asarray(table.loc[table["method"] == method, column], dtype=np.float64)
    return np.asarray(values[np.isfinite(values)], dtype=np.float64)


def spread_offsets(count: int) -> canvas.Array:
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
    rows = table.loc[table["method"] == "driver_specific", list(columns)].rename(columns=columns)
    return rows.astype(float).corr("spearman")


_WIDTH = 0.3
"""Of a line of dots, half of it; lines are 1 apart."""


@canvas.styled
def draw_calibration(spreads: Sequence[ParameterSpread], table: pd.DataFrame) -> Figure:
    """Draws each parameter's calibrated values between its bounds; beside it their correlations.

    Args:
        spreads: of at least one parameter.
        table: as `correlations` returns it.
    """
    figure = canvas.blank(1.7 + 0.42 * max(len(spreads), 4))
    left, right = canvas.side_by_side(figure, (2.0, 1.0))
    _values(left, spreads)
    _correlations(right, table)
    canvas.legend_above(figure, left.get_legend_handles_labels()[0], handlelength=1.2)
    return figure


def _values(axes: Axes, spreads: Sequence[ParameterSpread]) -> None:
    rows = np.arange(len(spreads), dtype=float)
    for row, spread in zip(rows, spreads, strict=True):
        axes.vlines((0, 1), row - 0.42, row + 0.42, color=colours.EDGE, linewidth=1)
        places = spread.places(spread.values)
        labels = dict.fromkeys(("driver_specific", "default", "pooled"), "")
        if row == 0:  # the legend names each method once
            for method in labels:
                labels[method] = wording.method_label(method)
        aside = row + _WIDTH * spread_offsets(len(places))
        dots: dict[str, Any] = {
            "alpha": 0.55,
            "markeredgewidth": 0,
            "label": labels["driver_specific"],
        }
        canvas.draw_points(
            axes, places, aside, "o", colours.colour_of("driver_specific"), 3.2, **dots
        )
        pooled = spread.places(spread.pooled)
        label = labels["pooled"] if len(pooled) else ""
        rows_of_it = np.full(len(pooled), row)
        canvas.draw_points(
            axes, pooled, rows_of_it, "D", colours.colour_of("pooled"), 6, label=label
        )
        default, bar = spread.places(np.array([spread.default])), {"markeredgewidth": 2.2}
        canvas.draw_points(
            axes,
            default,
            [row],
            "|",
            colours.colour_of("default"),
            17,
            label=labels["default"],
            **bar,
        )
        _ends(axes, spread, row)
    names = []
    for spread in spreads:
        names.append(wording.unit_label(spread.axis.name, spread.axis.unit))
    axes.set_yticks(rows, names)
    axes.set_ylim(len(spreads) - 0.4, -0.6)
    axes.set_xlim(-0.16, 1.16)
    axes.set_xticks((0, 0.25, 0.5, 0.75, 1.0))
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(
        canvas.wrapped(
            "place between the bounds; at the ends: the bound, and the share of pairs at it"
        )
    )


def _ends(axes: Axes, spread: ParameterSpread, row: float) -> None:
    for place, bound, share, side in (
        (-0.02, spread.axis.low, spread.at_low, "right"),
        (1.02, spread.axis.high, spread.at_high, "left"),
    ):
        assert bound is not None
        text = wording.number_text(bound)
        if share > 0:
            text += f"\n{wording.percent(share).lstrip('+')}"
        axes.text(
            place, row, text, ha=side, va="center", fontsize=canvas.points(8.5), color=colours.INK
        )


def _correlations(axes: Axes, table: pd.DataFrame) -> None:
    values = table.to_numpy(dtype=float)
    axes.imshow(values, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    places = np.arange(len(table))
    axes.set_xticks(places, list(table.columns), rotation=90)
    axes.set_yticks(places, list(table.columns))
    axes.grid(visible=False)
    axes.tick_params(length=0)
    if len(table) <= 7:
        for row, column in np.argwhere(np.isfinite(values)):
            value = values[row, column]
            colour = "white" if abs(value) > 0.6 else colours.INK
            axes.text(
                column,
                row,
                f"{value:z.1f}",
                ha="center",
                va="center",
                color=colour,
                size=canvas.points(9),
            )
    axes.set_title("rank correlation over drivers")


class Calibration(JobFigure):
    """Calibrated parameters of all drivers between their bounds, and their correlations."""

    title = "Calibrated parameters of all drivers, and their rank correlations"
    caption = (
        "Driver-specific parameters (a dot per pair), calibrated on the first part of their"
        " trajectory; pooled and default parameters beside them. Where values gather at a bound, or"
        " spread over the whole range, these recordings may hardly determine the parameter."
    )
    order = 70

    def is_usual(self, result: Result) -> bool:
        """Returns whether the job is a calibration; of a policy its own choices say more."""
        return result.purpose is Purpose.CALIBRATION

    def draw(self, result: Result) -> Figure | None:
        """Draws it where drivers have parameters of their own."""
        spreads = parameter_spreads(result.pairs, result.parameters)
        if not spreads:
            return None
        table = correlations(result.pairs, [spread.axis for spread in spreads])
        return draw_calibration(spreads, table)
