"""How well calibration knows parameters: slices of the loss, fits, labels over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.plugin import (
    JobFigure,
    ParameterAxis,
    Result,
    canvas,
    colours,
    identifiability,
    pair_lines,
    wording,
)

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
        measured = shares[axis.name].dropna()
        near, flat = float(measured.median()), float((measured == 1).mean())
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
    fits: dict[str, pd.DataFrame] = {}
    if "test_rmse_speed" not in table:
        return fits
    for method in ("driver_specific", "pooled", "default"):
        rows = table[table["method"] == method]
        measured = np.isfinite(rows[errors].to_numpy(dtype=float)).all(axis=1)
        if measured.any():
            fits[method] = rows.loc[measured]
    return fits


def labels_of(
    labels: pd.DataFrame, pairs: pd.DataFrame, axes: Sequence[ParameterAxis]
) -> dict[str, pd.DataFrame]:
    """Return the labels of some pairs, spread evenly over those that have driver-specific ones.

    Args:
        labels: as `WindowLabels.to_frame` returns it.
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
    driver_specific = (
        pairs[pairs["method"] == "driver_specific"].drop_duplicates("pair_id").set_index("pair_id")
    )
    ids = labels["pair_id"].astype(str)
    candidates = []
    for candidate in driver_specific.index.astype(str):
        if candidate in set(ids):
            candidates.append(candidate)
    if not candidates:
        return {}
    scale = float(np.quantile(labels["sensitivity"].to_numpy(dtype=float), 0.9)) or 1.0
    places = (
        np.linspace(0, len(candidates) - 1, min(len(candidates), MOST_DRIVERS)).round().astype(int)
    )
    drawn = {}
    for pair_id in (candidates[place] for place in places):
        rows = labels[ids == pair_id].sort_values("time_s")
        rows = rows.assign(weight=(rows["sensitivity"] / scale).clip(0, 1))
        for name in names:
            rows[f"fixed_{name}"] = float(driver_specific.loc[pair_id, f"parameter_{name}"])
        drawn[pair_id] = rows
    return drawn


_ACROSS = 5
_MARKERS = {"driver_specific": "o", "pooled": "D", "default": "|"}


@canvas.styled
def draw_slices(panels: Sequence[SlicePanel]) -> Figure:
    """Draws the loss along each parameter: a line per pair, and their median."""
    across = min(canvas.most_across(_ACROSS), len(panels))
    rows = -(-len(panels) // across)
    figure = canvas.blank(0.9 + 2.3 * rows)
    grid = figure.subplots(rows, across, squeeze=False, sharey=True)
    for place, panel in zip(grid.flat, panels, strict=False):
        place.plot(
            panel.places,
            panel.lines.T,
            color=colours.colour_of("driver_specific"),
            alpha=0.15,
            linewidth=0.8,
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
        is_driver_specific, colour = method == "driver_specific", colours.colour_of(method)
        highest = max(highest, float(np.quantile(np.concatenate([train, test]), 0.98)))
        medians = f"median {np.median(train):.2f} and {np.median(test):.2f} m/s"
        size, above, filled = (4.5, 3, colour) if is_driver_specific else (5.5, 2, "none")
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
        place.axhline(fixed, color=colours.colour_of("driver_specific"), linewidth=1.6)
        place.set_ylabel(
            wording.unit_label(axis.name, axis.unit).replace(" ", "\n"),
            fontsize=canvas.points(9),
        )
        if axis.low is not None and axis.high is not None:
            room = 0.06 * (axis.high - axis.low)
            place.set_ylim(axis.low - room, axis.high + room)
    grid[-1].plot(
        times, labels["sensitivity"].to_numpy(dtype=float), color=colours.INK, linewidth=1.2
    )
    grid[-1].set_ylabel("sensi-\ntivity", fontsize=canvas.points(9))
    grid[-1].set_ylim(bottom=0)
    grid[-1].set_xlabel(pair_lines.TIME_TITLE)
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
        fits = {} if table is None else fits_of(table)
        return draw_fits(fits) if fits else None


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
