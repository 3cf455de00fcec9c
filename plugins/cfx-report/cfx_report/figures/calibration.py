"""What calibration found: parameters, slices of the loss, fits, labels over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from cfx.plugin import JobFigure, ParameterAxis, Result, canvas, colours, identifiability, wording
from cfx_report.figures.trajectories import TIME_TITLE

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
    rows = table.loc[table["method"] == "fixed", list(columns)].rename(columns=columns)
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
        named = {
            method: wording.method_label(method) if row == 0 else ""
            for method in ("fixed", "default")
        }
        aside = row + _WIDTH * spread_offsets(len(places))
        dots: dict[str, Any] = {"alpha": 0.55, "markeredgewidth": 0, "label": named["fixed"]}
        canvas.draw_points(axes, places, aside, "o", colours.colour_of("fixed"), 3.2, **dots)
        pooled = spread.places(spread.pooled)
        said = wording.method_label("population") if row == 0 and len(pooled) else ""
        rows_of_it = np.full(len(pooled), row)
        canvas.draw_points(
            axes, pooled, rows_of_it, "D", colours.colour_of("population"), 6, label=said
        )
        default, bar = spread.places(np.array([spread.default])), {"markeredgewidth": 2.2}
        canvas.draw_points(
            axes,
            default,
            [row],
            "|",
            colours.colour_of("default"),
            17,
            label=named["default"],
            **bar,
        )
        _ends(axes, spread, row)
    names = [wording.unit_label(spread.axis.name, spread.axis.unit) for spread in spreads]
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
        "Each driver's own parameters (a dot per pair), calibrated on the first part of their"
        " trajectory; pooled and default parameters beside them. Where values gather at a bound, or"
        " spread over the whole range, these recordings may hardly determine the parameter."
    )
    order = 70

    def draw(self, result: Result) -> Figure | None:
        """Draws it where drivers have parameters of their own."""
        spreads = parameter_spreads(result.pairs, result.parameters)
        if not spreads:
            return None
        table = correlations(result.pairs, [spread.axis for spread in spreads])
        return draw_calibration(spreads, table)


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
            (`cfx.calibration.identifiability`).
        flat: share of the pairs for which that is the whole range.
    """

    axis: ParameterAxis
    places: canvas.Array
    values: canvas.Array
    ratios: canvas.Array
    near: float
    flat: float

    @property
    def lines(self) -> canvas.Array:
        """The ratios of those pairs that are drawn."""
        few = min(len(self.ratios), MOST_LINES)
        chosen = np.linspace(0, len(self.ratios) - 1, few).round().astype(int)
        return np.asarray(self.ratios[chosen], dtype=np.float64)

    @property
    def median(self) -> canvas.Array:
        """Median over the pairs, `(G,)`."""
        return np.asarray(np.median(self.ratios, axis=0), dtype=np.float64)


def slice_panels(table: pd.DataFrame, axes: Sequence[ParameterAxis]) -> tuple[SlicePanel, ...]:
    """Returns a panel per parameter.

    Args:
        table: as `cfx.calibration.identifiability.slices` returns it.
        axes: the tuned parameters.
    """
    panels = []
    shares = identifiability.flat_shares(table)
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


def fits_of(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return by method the pairs whose errors are known, driver-specific parameters first.

    Args:
        table: columns pair_id, method, train_rmse_speed, test_rmse_speed (m/s): on the part that
            was calibrated on and on the test part, without which there is nothing to show.
    """
    errors = ["train_rmse_speed", "test_rmse_speed"]
    found: dict[str, pd.DataFrame] = {}
    if "test_rmse_speed" not in table:
        return found
    for method in ("fixed", "population", "default"):
        rows = table[table["method"] == method]
        known = np.isfinite(rows[errors].to_numpy(dtype=float)).all(axis=1)
        if known.any():
            found[method] = rows.loc[known]
    return found


def labels_of(
    labels: pd.DataFrame, pairs: pd.DataFrame, axes: Sequence[ParameterAxis]
) -> dict[str, pd.DataFrame]:
    """Return the labels of some pairs, spread evenly over those that have driver-specific ones.

    Args:
        labels: as `Labels.to_frame` returns it.
        pairs: a row per pair and method with columns `pair_id`, `method`, `parameter_NAME`.
        axes: the tuned parameters.

    Returns:
        By pair its rows of `labels` by time, with `weight`, 0 to 1: how much the choice mattered in
        the window, as a share of the 90 % quantile over all windows (0 is arbitrary), and
        `fixed_NAME`, the driver-specific parameters.
    """
    names = [axis.name for axis in axes if f"parameter_{axis.name}" in labels]
    if labels.empty or not names:
        return {}
    own = pairs[pairs["method"] == "fixed"].drop_duplicates("pair_id").set_index("pair_id")
    ids = labels["pair_id"].astype(str)
    known = [one for one in own.index.astype(str) if one in set(ids)]
    if not known:
        return {}
    scale = float(np.quantile(labels["sensitivity"].to_numpy(dtype=float), 0.9)) or 1.0
    places = np.linspace(0, len(known) - 1, min(len(known), MOST_DRIVERS)).round().astype(int)
    found = {}
    for pair_id in (known[place] for place in places):
        rows = labels[ids == pair_id].sort_values("time_s")
        fixed = {f"fixed_{name}": float(own.loc[pair_id, f"parameter_{name}"]) for name in names}
        found[pair_id] = rows.assign(weight=(rows["sensitivity"] / scale).clip(0, 1), **fixed)
    return found


_ACROSS = 5
_MARKERS = {"fixed": "o", "population": "D", "default": "|"}


@canvas.styled
def draw_slices(panels: Sequence[SlicePanel]) -> Figure:
    """Draws the loss along each parameter: a line per pair, and their median."""
    across = min(canvas.most_across(_ACROSS), len(panels))
    rows = -(-len(panels) // across)
    figure = canvas.blank(0.9 + 2.3 * rows)
    grid = figure.subplots(rows, across, squeeze=False, sharey=True)
    for place, panel in zip(grid.flat, panels, strict=False):
        place.plot(
            panel.places, panel.lines.T, color=colours.colour_of("fixed"), alpha=0.15, linewidth=0.8
        )
        place.plot(panel.places, panel.median, color=colours.INK, linewidth=2)
        place.axhline(
            1 + identifiability.NEARLY_BEST, color=colours.EDGE, linestyle="--", linewidth=1
        )
        share = wording.percent(panel.near).lstrip("+")
        place.set_title(f"{wording.unit_label(panel.axis.name, panel.axis.unit)}: {share}")
        ends = [wording.number_text(panel.values[0]), wording.number_text(panel.values[-1])]
        place.set_xticks([0, 1], ends)
        place.set_ylim(0.97, HIGHEST)
    for unused in grid.flat[len(panels) :]:
        unused.set_visible(False)
    figure.supylabel(RATIO_TITLE, fontsize=canvas.points(10.5), color=colours.INK)
    drivers = wording.plural(len(panels[0].ratios), "pair")
    figure.supxlabel(
        canvas.wrapped(
            f"one parameter moved from bound to bound, the others held; {drivers} and their median."
            " Percentages: the range on which\na pair's loss is within"
            f" {wording.percent(identifiability.NEARLY_BEST).lstrip('+')} of its best (dashed),"
            " median over pairs"
        ),
        fontsize=canvas.points(10.5),
        color=colours.INK,
    )
    return figure


@canvas.styled
def draw_fits(fits: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw each pair's error on the part that was calibrated on against that on the test part."""
    figure = canvas.blank(5.2, 6.4)
    axes = figure.subplots()
    highest = 0.0
    for method, rows in fits.items():
        train = rows["train_rmse_speed"].to_numpy(dtype=float)
        test = rows["test_rmse_speed"].to_numpy(dtype=float)
        own, colour = method == "fixed", colours.colour_of(method)
        highest = max(highest, float(np.quantile(np.concatenate([train, test]), 0.98)))
        medians = f"median {np.median(train):.2f} and {np.median(test):.2f} m/s"
        size, above, filled = (4.5, 3, colour) if own else (5.5, 2, "none")
        drawn = canvas.draw_points(axes, train, test, _MARKERS[method], colour, size, alpha=0.65)
        drawn.set(
            label=canvas.wrapped(f"{wording.method_label(method)}: {medians}"),
            zorder=above,
            markerfacecolor=filled,
        )
    end = 1.15 * highest
    axes.plot([0, end], [0, end], color=colours.EDGE, linewidth=1, zorder=1)
    axes.set_xlim(0, end)
    axes.set_ylim(0, end)
    axes.set_aspect("equal")
    axes.set_xlabel(canvas.wrapped("RMSE of speed on the part calibrated on (m/s)"))
    axes.set_ylabel("RMSE of speed on the test part (m/s)")
    canvas.legend_above(figure, columns=1, handlelength=1.0)
    return figure


@canvas.styled
def draw_labels(pair_id: str, labels: pd.DataFrame, axes: Sequence[ParameterAxis]) -> Figure:
    """Draw one pair's per-window parameters; pale ones did not matter in their window.

    Args:
        pair_id: which pair.
        labels: as `labels_of` returns it for the pair.
        axes: the tuned parameters.
    """
    shown = [axis for axis in axes if f"fixed_{axis.name}" in labels]
    figure = canvas.blank(1.0 + 1.15 * (len(shown) + 1))
    grid = figure.subplots(len(shown) + 1, 1, sharex=True)
    times = labels["time_s"].to_numpy(dtype=float)
    for place, axis in zip(grid, shown, strict=False):
        place.scatter(
            times,
            labels[f"parameter_{axis.name}"].to_numpy(dtype=float),
            s=11,
            color=colours.colour_of("policy"),
            alpha=np.maximum(labels["weight"].to_numpy(dtype=float), 0.08),
            linewidths=0,
        )
        fixed = float(labels[f"fixed_{axis.name}"].iloc[0])
        place.axhline(fixed, color=colours.colour_of("fixed"), linewidth=1.6)
        place.set_ylabel(
            wording.unit_label(axis.name, axis.unit).replace(" ", "\n"), fontsize=canvas.points(9)
        )
        if axis.low is not None and axis.high is not None:
            room = 0.06 * (axis.high - axis.low)
            place.set_ylim(axis.low - room, axis.high + room)
    grid[-1].plot(
        times, labels["sensitivity"].to_numpy(dtype=float), color=colours.INK, linewidth=1.2
    )
    grid[-1].set_ylabel("sensi-\ntivity", fontsize=canvas.points(9))
    grid[-1].set_ylim(bottom=0)
    grid[-1].set_xlabel(TIME_TITLE)
    figure.suptitle(
        canvas.wrapped(
            f"{wording.shortened(pair_id)}: per-window calibrated parameters; the paler, the less"
            " the choice mattered; line: driver-specific"
        ),
        fontsize=canvas.points(10.5),
        color=colours.INK,
    )
    return figure


class Slices(JobFigure):
    """How well recordings determine each calibrated parameter."""

    title = "The loss when one parameter is moved and the others are held"
    caption = (
        "How well the recordings determine each parameter: one is moved from bound to bound, the"
        " others stay at the driver's calibrated values. Where the loss stays near its best"
        " (dashed: 5 % above), the parameter is not determined. Where it rises, others might still"
        " make up for it."
    )
    order = 130

    def draw(self, result: Result) -> Figure | None:
        """Draws it where the loss was examined."""
        table = result.tables.get("slices")
        if table is None:
            return None
        panels = slice_panels(table, result.parameters)
        return draw_slices(panels) if panels else None


class FitTrainTest(JobFigure):
    """Errors where calibrated, and on the test part."""

    title = "Errors where calibrated, and on the test part"
    caption = (
        "Each driver's error on the part of their trajectory that was calibrated on, against that"
        " on the test part. Where a driver-specific dot lies far above the line, its parameters"
        " were fitted to more than the driver's style."
    )
    order = 131

    def draw(self, result: Result) -> Figure | None:
        """Draws it where errors on both parts are known."""
        table = result.tables.get("fits")
        found = {} if table is None else fits_of(table)
        return draw_fits(found) if found else None


class LabelsOverTime(JobFigure):
    """Per-window calibrated parameters of one driver."""

    title = "Per-window calibrated parameters over time, and how much they mattered"
    caption = (
        "Per-window calibrated parameters (labels) over time. Pale ones hardly mattered in their"
        " window, so that their values are arbitrary. The sensitivity below says how much a choice"
        " mattered, in the objective's unit."
    )
    order = 132

    def draw(self, result: Result) -> Figure | None:
        """Draws it where windows were calibrated."""
        table = result.tables.get("labels")
        if table is None:
            return None
        drivers = labels_of(table, result.pairs, result.parameters)
        if not drivers:
            return None
        pair_id = list(drivers)[len(drivers) // 2]
        return draw_labels(pair_id, drivers[pair_id], result.parameters)
